"""The benchmarks measure what they say: replayed torques, equal taxels, counted bytes; and they run where there is no
GPU."""

from __future__ import annotations

import importlib
import json

import forked
import mujoco
import numpy as np
import pytest
import torch
import yaml
from worlds import grasp_env

from benchmarks import physics, tools
from benchmarks import touch as touch_benchmark
from benchmarks.learning import Bare
from benchmarks.tape import Tape
from benchmarks.touch_alternatives import alternatives
from benchmarks.touch_cost import cost_of
from dexsim.errors import UserError
from dexsim.paths import CONFIGS


@pytest.fixture(scope="module")
def env():
    env = grasp_env("task.objects.train=[box,sphere]", "task.objects.emphasis={}", worlds=4)
    tools.close_hand(env, 40)
    return env


def test_bare_physics_repeats_the_driven_run_to_the_bit(env):
    e, k, steps = env.engine, env.decimation, 5
    grasp, tape = tools.Snapshot(env), Tape(e, env.servo, steps * k)

    def run(before) -> torch.Tensor:
        grasp.restore(env)
        tape.rewind()
        states = []
        for _ in range(steps):
            e.step(k, before)
            states.append(torch.cat([e.t.qpos, e.t.qvel], 1).clone())
        return torch.stack(states)

    driven = run(tape.record)
    assert torch.equal(run(tape.play), driven)
    assert torch.equal(run(env.servo.before_each), driven)
    assert not torch.equal(run(None), driven), "without the servo it must go elsewhere, or this compares nothing"


def test_a_snapshot_puts_another_environment_there(env):
    grasp = tools.Snapshot(env)
    other = grasp_env("task.objects.train=[box,sphere]", "task.objects.emphasis={}", worlds=4, seed=5)
    assert not torch.equal(other.engine.field("body_mass"), env.engine.field("body_mass"))
    grasp.restore(other, fields=True)
    grasp.restore(env)
    for e in (env, other):
        e.engine.step(e.decimation, e.servo.before_each)
    assert torch.equal(env.engine.t.qpos, other.engine.t.qpos)


def test_bare_environment_steps_the_physics_of_the_last_rollout(env):
    class Agent:
        class alg:  # noqa: N801
            actor = staticmethod(lambda obs, stochastic_output: torch.zeros(4, 12))

    bare = Bare(env, 3)
    env.pushes = False  # the torques are replayed, a push is not
    tools.Snapshot(env).restore(env)
    bare.record(Agent)
    end = env.engine.t.qpos.clone()
    for _ in range(2):  # it begins anew by itself
        for _ in range(3):
            bare.step(torch.ones(4, 12))
        assert torch.equal(env.engine.t.qpos, end)


def test_an_edited_scene_is_edited_only_inside():
    with physics.edited(physics._pyramidal):
        env = grasp_env("task.objects.train=[box]", "task.objects.emphasis={}", worlds=1)
    assert env.engine.mjm.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    assert (
        grasp_env("task.objects.train=[box]", "task.objects.emphasis={}", worlds=1).engine.mjm.opt.cone
        == mujoco.mjtCone.mjCONE_ELLIPTIC
    )
    with physics.edited(physics._no_self):
        m = grasp_env("task.objects.train=[box]", "task.objects.emphasis={}", worlds=1).engine.mjm
    on_object = m.geom_bodyid == m.body("object").id
    type_, affinity = m.geom_contype, m.geom_conaffinity
    meet = (type_[:, None] & affinity[None]) | (affinity[:, None] & type_[None])
    assert not meet[~on_object][:, ~on_object].any() and meet[~on_object][:, on_object].all()


@pytest.fixture(scope="module")
def touch_scene():
    default = yaml.safe_load((CONFIGS / "tactile" / "default.yaml").read_text())
    poses = touch_benchmark.grasp_poses(np.random.default_rng(0))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(touch_benchmark, "GRIDS", (32,))  # finer ones are measured on a GPU: 16 million cells
        return default, poses, touch_benchmark.shape_set("cpu")


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["box", "sphere", "grid"])
def test_alternatives_feel_the_same_taxels(touch_scene, shape):
    default, poses, shapes = touch_scene
    scene = touch_benchmark.Scene(6, shape, default, "cpu", shapes, poses)
    touch = scene.touch({**default, "sum": "spring", "raw": True, "others": False})
    touch.launch()
    ours = touch.raw_clean
    name, size = touch_benchmark.SHAPES[shape]
    # inside a box,
    allowed = {
        "mesh query": 0.015,
        "wp.Volume": 0.005,
        "MuJoCo tactile": {"box": 0.3, "sphere": 1e-5, "grid": 0.05}[shape],
    }
    # MuJoCo's value is no distance (test_depths_are_those_of_mujocos_tactile_sensor)
    for what, make in alternatives(scene, touch, name, np.asarray(size), poses[2]).items():
        way = make()
        way.launch()
        found = way.forces()
        assert found.shape == ours.shape
        assert ((found > 0) == (ours > 0)).float().mean() > 0.99
        assert float(found.sum() / ours.sum()) == pytest.approx(1.0, abs=allowed[what]), what


def test_costs_follow_the_layout(touch_scene):
    default, poses, shapes = touch_scene
    scene = touch_benchmark.Scene(2, "box", default, "cpu", shapes, poses)
    reduced, raw = (scene.touch({**default, "raw": r}) for r in (False, True))
    assert cost_of(raw, "box", 10).bytes - cost_of(reduced, "box", 10).bytes == 10 * 600 * 4
    assert cost_of(raw, "box", 20).flops == 2 * cost_of(raw, "box", 10).flops
    assert cost_of(raw, "rock", 10).flops > cost_of(raw, "sphere", 10).flops
    assert 0.1 < cost_of(raw, "box", 16384).floor_us() < 100


@pytest.mark.parametrize(
    "name, setting",
    [
        ("step", "steps=none"),
        ("learning", "worlds=0"),
        ("touch", "wrlds=3"),
        ("physics", "only=chosn"),
        ("engines", "worlds=many"),
        ("trace", "device=cpu"),
        ("minutes", "task=walk"),
    ],
)
def test_bad_settings_are_one_clear_line(name, setting):
    with pytest.raises(UserError) as error:
        importlib.import_module(f"benchmarks.{name}").main(
            [setting] + (["device=cpu"] if name in ("learning", "physics") else [])
        )
    assert setting.split("=")[0].replace("device", "CUDA") in str(error.value) and "\n" not in str(error.value)


@pytest.mark.slow
@pytest.mark.parametrize("command, keys", [
    (("benchmarks.engines", "worlds=8", "seconds=2"), ("physics_ratio", "env_ratio", "rows")),
    (("benchmarks.learning", "device=cpu", "worlds=8", "iterations=1", "settle=2"), ("rows",)),
    (("benchmarks.minutes", "device=cpu", "worlds=8", "seconds=400", "iterations=2", "preset=none", "episodes=2",
      "judge=task.evaluation.cap_s=1"), ("training", "trained_and_judged_s", "capped")),
    (("benchmarks.physics", "device=cpu", "worlds=8", "steps=2", "only=chosen,impratio 1"), ("rows",)),
    (("benchmarks.startup", "device=cpu", "worlds=4", "engines=mujoco"), ("mujoco_cold", "mujoco_warm")),
    (("benchmarks.touch", "device=cpu", "worlds=4", "alternatives=false"), ("us", "bytes", "flops")),
])  # fmt: skip
def test_they_run_on_a_cpu_and_end_in_one_json_line(command, keys, tmp_path):
    writes = command[0] in ("benchmarks.physics", "benchmarks.minutes")
    done = forked.run(*command, *((f"out={tmp_path}",) if writes else ()))
    assert done.returncode == 0, done.stderr[-2000:]
    out = json.loads(done.stdout.splitlines()[-1])
    assert out["benchmark"] == command[0].split(".")[1] and "versions" in out and "device" in out
    for key in keys:
        assert out[key], key
    if command[0] == "benchmarks.physics":
        assert {"physics.json", "physics.md", "physics.png"} <= {p.name for p in tmp_path.iterdir()}
        rows = out["rows"]
        assert rows["chosen"]["k_ratio"] == pytest.approx(1.0, abs=0.02)
        assert rows["impratio 1"]["creep_mm_s"] > rows["chosen"]["creep_mm_s"]
    if command[0] == "benchmarks.startup":
        assert out["mujoco_cold"]["modules"] > 0 and out["mujoco_warm"]["modules"] == 0


def test_numbers_and_settings_are_split():
    assert tools.numbers("8, 16", "worlds") == [8, 16]
    with pytest.raises(UserError, match="worlds=8,x"):
        tools.numbers("8,x", "worlds")
    assert tools.split(["a=1", "b=2", "c"], {"a": "0"}) == ({"a": "1"}, ["b=2", "c"])


def test_replayed_metrics_are_compared_seed_by_seed():
    """A metric that moves with the seed alone is the same; one that is off by as much in each seed differs."""
    from benchmarks import replayed

    metrics = {"capped": 30, "successes": {"average": 4.0, "all": [1, 2]}, "range_N": [1.0, 3.0], "rate": 0.5,
               "rate_interval": [0.4, 0.6], "episodes": 60, "policy": "x.pt", "commands": ["a", "b"]}  # fmt: skip
    flat = replayed.numbers(metrics, 60)
    assert flat == {"capped": 0.5, "successes average": 4.0, "range_N low": 1.0, "range_N high": 3.0, "rate": 0.5}
    mujoco = {str(s): {"seed's": float(s), "moved": float(s)} for s in range(5)}
    hand = {str(s): {"seed's": s + 0.01 * (-1) ** s, "moved": s + 0.5 + 0.01 * (-1) ** s} for s in range(5)}
    rows = replayed.compare(hand, mujoco, {"seed's": 2.0, "moved": 40.0}, 0.25)
    assert rows["seed's"]["same"] and rows["seed's"]["as_before"]
    assert not rows["moved"]["same"] and not rows["moved"]["as_before"]
    assert rows["moved"]["difference"][0] == pytest.approx(0.502)
    assert "differs not as before" in replayed.table(rows)
    for task, said in (("grasp", "hold_rate_pushed"), ("rotate", "seconds_per_success")):
        kept = json.loads((tools.ROOT / "checkpoints" / f"{task}.metrics.json").read_text())
        assert replayed.numbers(kept, kept["episodes"])[said] == kept[said]
