"""The rotation with a user's own objects: their held poses, their place among cubes, kept-out ones. CPU, C MuJoCo."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
import torch
import trimesh

from dexsim import export, rotation
from dexsim.calibration.file import Calibration
from dexsim.cli import start
from dexsim.cli import train as training
from dexsim.cli.stable_grasps import main as stable_grasps
from dexsim.deploy import bundle
from dexsim.deploy.driver import VirtualClock
from dexsim.deploy.loop import Loop, LoopSettings
from dexsim.deploy.simulated_hand import SimulatedHand, SimulatedXHand
from dexsim.errors import UserError
from dexsim.hand import load_hand
from dexsim.paths import CONFIGS
from dexsim.tasks import make_env
from dexsim.tasks.make_grasps import candidates
from dexsim.tasks.reach import Reach
from dexsim.tasks.stable_grasps import ROWS, GraspSet, held_poses

torch.set_num_threads(1)
HULL = ["object_scale=0.001", "object_hulls=1"]


@pytest.fixture(scope="module")
def meshes(tmp_path_factory):
    """Return the paths of a cube of 50 mm, a flat plate and a block, in millimetres."""
    at = tmp_path_factory.mktemp("meshes")
    for name, size in (("cube", (50, 50, 50)), ("plate", (60, 44, 12)), ("block", (48, 44, 40))):
        trimesh.creation.box(size).export(at / f"{name}.stl")
    return {name: str(at / f"{name}.stl") for name in ("cube", "plate", "block")}


def config(*overrides: str, worlds: int = 4) -> dict:
    return start.for_train(["task=rotate", "device=cpu", f"worlds={worlds}", *overrides], CONFIGS).cfg


def cubes(count: int) -> GraspSet:
    """Return, of the right xHand's own held poses those of cubes of nearly 50 mm."""
    known = held_poses(load_hand())
    return known[(known.edge - 0.05).abs().argsort()[:count]]


def test_a_file_of_held_poses_says_what_it_holds(tmp_path):
    one = cubes(4)
    one.save(tmp_path / "cubes.npz")
    with np.load(tmp_path / "cubes.npz") as file:
        assert set(file) == set(ROWS)  # of cubes alone, as ever
    two = GraspSet(one.edge, one.hand, one.target, one.pose, shape=torch.tensor([0, 1, 1, 0]), names=("cup.obj", "box"))
    two.save(tmp_path / "two.npz")
    back = GraspSet.load(tmp_path / "two.npz")
    assert back.names == two.names and back.shape.tolist() == [0, 1, 1, 0] and torch.equal(back.pose, two.pose)
    mine = back.numbered(("box", "cup.obj"), "two.npz")
    assert mine.shape.tolist() == [1, 0, 0, 1]
    assert back.numbered(("box",), "two.npz").edge.tolist() == one.edge[1:3].tolist()
    assert len(back.within(0.2, 0.3)) == 2  # the sizes asked of cubes are not asked of a cup
    assert GraspSet.join([back, back]).shape.tolist() == [0, 1, 1, 0] * 2
    with pytest.raises(UserError, match="two.npz: none of object 'mug.obj', of cup.obj, box only"):
        back.numbered(("mug.obj",), "two.npz")
    np.savez(tmp_path / "bad.npz", **{k: getattr(one, k).numpy() for k in ROWS}, shape=[0, 1, 2, 9], names=["a", "b"])
    with pytest.raises(UserError, match="bad.npz: cannot read them .shape: must number"):
        GraspSet.load(tmp_path / "bad.npz")


@pytest.mark.slow
def test_a_mesh_of_a_cube_is_held_and_turned_as_the_cube_is(tmp_path, meshes):
    """The same poses, the same draws: a mesh's contacts, its mass and its goals are those of the built-in cube."""
    known = cubes(4)
    known.edge[:] = 0.05
    poses = tmp_path / "poses.npz"
    seen = []
    for name, more in (("box", []), ("cube.stl", [f"objects=[{meshes['cube']}]", *HULL])):
        GraspSet(*(getattr(known, k) for k in ROWS), names=(name,)).save(poses)
        env = make_env(config(f"task.initial.poses={poses}", *more), 4, "cpu", 3, "mujoco")
        env.in_order = True
        env.reset_all()
        mass, lie = env.objects.mass.clone(), env.object_pose.clone()
        ends = torch.zeros(4, dtype=torch.bool)
        for _ in range(12):
            ends |= env.step(torch.zeros(4, env.num_actions))[2].bool()
        moved = (env.object_pose[:, :3] - lie[:, :3]).norm(dim=1), rotation.error(env.object_pose[:, 3:], lie[:, 3:])
        seen.append((mass, env.engine.field("body_inertia")[:, env.objects.body].clone(), env.goal.clone()))
        assert env.names == (name,) and not ends.any() and moved[0].max() < 0.006 and moved[1].max() < 0.15
    (mass, inertia, goal), (mass2, inertia2, goal2) = seen
    assert torch.equal(mass, mass2) and torch.allclose(inertia, inertia2, rtol=0.02)
    assert torch.allclose(goal, goal2, atol=1e-6)


@pytest.mark.slow
def test_a_flat_object_is_not_dropped_as_it_lies_and_falls_with_any_axis_up(tmp_path, meshes):
    one = cubes(3)
    poses = tmp_path / "poses.npz"
    names = ("plate.stl", "box")
    GraspSet(*(getattr(one, k) for k in ROWS), shape=torch.tensor([0, 1, 1]), names=names).save(poses)
    cfg = config(f"objects=[{meshes['plate']},box]", *HULL, f"task.initial.poses={poses}", worlds=12)
    env = make_env(cfg, 12, "cpu", 3, "mujoco")
    low = env.unit * cfg["task"]["termination"]["below"] + env.rise
    assert env.names == names and env.lowest[1] == pytest.approx(low)
    assert env.lowest[0] == pytest.approx(0.4 * 0.012 + env.rise, abs=1e-4)
    env.reset_all()
    assert set(env.objects.variant.tolist()) == {0, 1}
    edge = 2 * env.objects.size[env.objects.variant == 1, 0]
    assert ((edge - 0.05).abs() < 0.01).all()
    rng = torch.Generator().manual_seed(1)
    let_go = candidates(env, 12, (0.045, 0.06), rng, Reach(env.hand, np.random.default_rng(1)))
    assert let_go.shape.tolist() == [0, 1] * 6 and let_go.names == names
    plates = let_go[let_go.shape == 0]
    turn = rotation.to_matrix(plates.pose[:, 3:])
    size = torch.tensor(env.objects.scene.variants[0].shape.extents, dtype=torch.float32)
    half = (turn.abs() @ size[:, None])[:, 2, 0] / 2  # along the palm's normal
    bottom = plates.pose[:, 2] - half - float(env.places.catch[2])
    torch.testing.assert_close(bottom, torch.full((6,), 0.01 * env.unit), atol=1e-5, rtol=0)
    assert len({round(float(x), 4) for x in half}) > 1, "more than one axis is up"
    assert (plates.edge <= 0.045).all(), "the narrower of its sides"


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["objects=[{block}]"], "task.initial.poses: must name a file of held poses of block.stl.*stable-grasps"),
        (["objects=[{block}]", "task.initial.poses={cubes}"], "cubes.npz: none of object 'block.stl', of box only"),
        (["objects=[{block}]", "kept_out=[{block}]"], "kept_out: .*block.stl' is trained on as well"),
        (["task.objects.train=[cross]"], "task.objects.train: 'cross': this task turns 'box' or the path of a mesh"),
        (["task.objects.train=[]"], r"task.objects.train=\[\]: must name 'box'"),
        (["objects=[{block},{again}]"], "block.stl, block.stl: two of one name"),
    ],
)  # fmt: skip
def test_what_cannot_be_turned_is_one_line(tmp_path, meshes, more, said):
    cubes(2).save(tmp_path / "cubes.npz")
    with pytest.raises(UserError, match=said) as error:
        again = tmp_path / "block.stl"
        shutil.copy(meshes["block"], again)
        words = [x.format(**meshes, cubes=tmp_path / "cubes.npz", again=again) for x in more]
        make_env(config(*words, *HULL), 2, "cpu", 0, "mujoco")
    assert "\n" not in str(error.value)


def test_fingertips_turn_cubes_only(meshes):
    with pytest.raises(UserError, match="task=rotate_fingertips has its own object"):
        start.for_train(["task=rotate_fingertips", "device=cpu", f"objects=[{meshes['block']}]"], CONFIGS)


@pytest.mark.slow
def test_from_a_mesh_to_a_policy_and_its_bundle(tmp_path, meshes):
    """Searched for, trained on, judged on another that was kept out, exported, deployed in simulation."""
    poses, run = tmp_path / "poses.npz", tmp_path / "run"
    objects = [f"objects=[{meshes['block']}]", f"kept_out=[{meshes['cube']}]", *HULL]
    assert stable_grasps([*objects, f"out={poses}", "count=4", "worlds=32", "seed=1"]) == 0
    found = GraspSet.load(poses)
    assert found.names == ("block.stl", "cube.stl") and found.shape.bincount().tolist() == [2, 2]
    few = ["device=cpu", "worlds=4", "iterations=1", "final_episodes=4", "task.evaluation.cap_s=1.5"]
    few += [f"task.initial.poses={poses}", f"out={run}"]
    assert training.run(start.for_train(["task=rotate", *objects, *few], CONFIGS)) == 0
    metrics = json.loads((run / "play" / "metrics.json").read_text())
    metrics = metrics.get("metrics", metrics)
    assert metrics["episodes"] == 4 and metrics["kept_out"]["episodes"] == 2
    assert set(metrics["successes_by_object"]) == {"block.stl", "cube.stl"}
    out = export.export(str(run / "policy.pt"), tmp_path / "bundle", steps=6)
    assert export.check(out)
    b, clock = bundle.load(out), VirtualClock()
    assert b.manifest["grip"]["object"] == "block.stl"
    calibration = Calibration.from_dict(b.manifest["calibration"], "bundle", None, b.hand)
    driver = SimulatedXHand(b.config, calibration, clock, seed=1, grip=b.manifest["grip"])
    settings = LoopSettings(seconds=0.5, home_speed=5.0, wait=0.2, grip=0.3)
    report = Loop(b, driver, driver, calibration, settings, clock, keep=True).run()
    assert report.ended == "done" and report.acts >= 10 and np.isfinite(report.actions).all()
    env = SimulatedHand(b.config, calibration, grip=b.manifest["grip"]).env
    assert env.names[int(env.objects.variant[0])] == "block.stl"
    with pytest.raises(UserError, match="shape=.*cube.stl: the policy begins with 'block.stl' in the hand"):
        SimulatedHand(b.config, calibration, shape=meshes["cube"], grip=b.manifest["grip"])
