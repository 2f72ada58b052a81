"""The whole chain for a hand that is not the xHand: three fingers, nine joints, a left one whose thumb is last
(`tests/made_hand.py`), with touch pads and without: held poses, two iterations of training, a replay, a bundle, the
simulated deployment."""

from __future__ import annotations

import json
import socket
import time

import numpy as np
import pytest
import torch

from dexsim import export
from dexsim.calibration.file import Calibration
from dexsim.cli import play as playing
from dexsim.cli import start
from dexsim.cli import train as training
from dexsim.deploy import bundle
from dexsim.deploy.driver import VirtualClock
from dexsim.deploy.loop import Loop, LoopSettings
from dexsim.deploy.simulated_hand import SimulatedXHand
from dexsim.errors import UserError
from dexsim.hand import load_hand
from dexsim.paths import CONFIGS
from dexsim.recording import led_object, mechanism, read
from dexsim.recording.compare import compare
from dexsim.tasks import grasp_eval, make_env
from dexsim.tasks.building import UNIT_SPAN
from dexsim.tasks.make_grasps import generate
from dexsim.view import plots
from tests.made_hand import made_hand

FEW = ("device=cpu", "worlds=4", "sim.threads=1")


def train(argv: list[str]) -> int:
    return training.run(start.for_train(argv, CONFIGS))


def play(argv: list[str]) -> int:
    return playing.run(start.for_play(argv, CONFIGS))


def config(folder, task: str, *more: str) -> dict:
    return start.for_train([f"task={task}", f"hand={folder}", *FEW, *more], CONFIGS).cfg


@pytest.fixture(scope="module")
def hands(tmp_path_factory):
    """Return the folders by pads (True, False); held poses are found once and serve both."""
    at = tmp_path_factory.mktemp("hands")
    folders = {pads: made_hand(at / f"made_{pads}", pads=pads) for pads in (True, False)}
    hand = load_hand(folders[False])
    sizes = (0.045 * hand.span / UNIT_SPAN, 0.06 * hand.span / UNIT_SPAN)
    poses = generate(config(folders[False], "rotate", f"task.initial.poses={at}/none.npz"), 6, 16, 1, sizes, report=str)
    for folder in folders.values():
        poses.save(folder / "held_cubes.npz")
    return folders


@pytest.fixture(autouse=True)
def no_pictures(monkeypatch):
    """Curves of each term and of an evaluation take seconds, and know nothing of the hand."""
    monkeypatch.setattr(plots, "curves", lambda columns, path, title: path)
    monkeypatch.setattr(plots, "draw", lambda functions, folder: [])


@pytest.fixture
def moment(monkeypatch, tmp_path):
    """Settings of a grasp's evaluation that is over in 1.5 s of simulation instead of 10.5 s."""
    monkeypatch.setattr(grasp_eval, "SETTLE", 0.5)
    monkeypatch.setattr(grasp_eval, "HOLD", 0.8)
    path = tmp_path / "moment.csv"
    path.write_text("t,x,y,z\n" + "".join(f"{0.05 * k:.2f},0,0,0\n" for k in range(5)))
    return [f"task.evaluation.base={path}"]


@pytest.mark.parametrize("pads", [True, False])
def test_observations_follow_the_hand(hands, pads):
    touch = 3 + 9 if pads else 0
    for task, actor, critic in (
        ("grasp", 9 + 9 + 3 + 3 + touch + 9 + 1, 9 + 4 + 6 + 3 + 4 + 1 + 3 + 1 + 1 + 1 + 3 + 3 + 1 + 9 + 9 + 9 + 1),
        ("rotate", 9 + 6 + 9 + touch + 9, 6 + 18 + 18 + 9 + 3 + 3 + 3 + 1 + 1 + 3 + 1 + 1 + 3 + 1 + 9 + 9),
    ):
        env = make_env(config(hands[pads], task), 4, "cpu", 1, "mujoco")
        obs = env.get_observations()
        assert obs["actor"].shape == (4, actor) and obs["critic"].shape == (4, actor + critic), task
        groups = env.describe()["observations"]
        assert sum(r[1] for r in groups["actor"]) == actor and sum(r[1] for r in groups["critic"]) == actor + critic
        assert any("contact" in r[0] for r in groups["actor"]) is pads
        assert any("no touch" in note for note in env.describe()["notes"]) is not pads
        assert any("guessed" in note and "palm.normal" in note for note in env.describe()["notes"])
        out = env.step(torch.zeros(4, 9))[0]
        assert out["actor"].isfinite().all() and env.q.shape == (4, 9) and env.tip_force.shape == (4, 3)
        # joints are the hand's, in its order: none is another's position
        at = {j: env.engine.t.qpos[0, env.engine.qpos_index([j])[0]].item() for j in env.hand.joints}
        assert env.q[0].tolist() == pytest.approx(list(at.values()), abs=1e-6)


def test_lengths_are_in_units_of_the_hand(hands):
    env = make_env(config(hands[True], "grasp"), 4, "cpu", 1, "mujoco")
    large = make_env(config(hands[True], "grasp", "hand_scale=1.5"), 4, "cpu", 1, "mujoco")
    assert env.unit == pytest.approx(0.8) and large.unit == pytest.approx(1.2)
    assert torch.allclose(large.centre0, 1.5 * env.centre0) and large.f_max == pytest.approx(env.f_max / 1.5)
    assert torch.allclose(large.objects.size[:, 0] / env.objects.size[:, 0], torch.full((4,), 1.5))
    mirrored = make_env(config(hands[True], "grasp", "hand_mirror=true"), 4, "cpu", 1, "mujoco")
    assert torch.allclose(mirrored.centre0, env.centre0 * torch.tensor([1.0, -1.0]))


def test_a_finger_that_closes_with_negative_angles_is_paid_alike(hands):
    """R_diff: both fingers equally bent, one by positive and one by negative angles, differ by nothing."""
    env = make_env(config(hands[False], "grasp"), 4, "cpu", 1, "mujoco")
    a, b = (env.hand.joints.index(j) for j in ("a_curl", "b_curl"))
    env.q[:, a], env.q[:, b] = 0.7, -0.7
    assert env.rewards()["diff"].abs().max() < 1e-9
    env.q[:, b] = 0.7
    assert (env.rewards()["diff"] < -1e-3).all()


def test_the_finger_that_presses_against_the_others_is_paid_for_a_band_wherever_it_stands(hands):
    """The made hand's thumb is its last finger; the first is told a force as any other is."""
    env = make_env(config(hands[False], "grasp"), 4, "cpu", 1, "mujoco")
    assert env.hand.opposing == (2,)

    def paid(finger: int, command: float, own: float = -1.0, term: str = "force") -> float:
        env.tip_force.zero_()
        env.tip_force[:, finger] = 0.5 * env.f_max
        env.command.fill_(command), env.thumb_command.fill_(own)
        return float(env.rewards()[term][0])

    whole = paid(0, 0.5)
    assert whole > 0 and paid(0, 0.1) < 0.5 * whole  # told, and far off
    assert paid(2, 0.5) == paid(2, 0.1) == pytest.approx(whole)  # not told
    assert paid(2, 0.1, own=0.5) == pytest.approx(whole) and paid(2, 0.5, own=0.1) < 0.5 * whole
    assert paid(2, 0.1, 0.5, "thumb_near") > paid(0, 0.1, 0.5, "thumb_near")
    env.tip_force.fill_(0.5 * env.f_max)
    env.torque.zero_()
    env.torque[:, env.roots[2]] = 0.5 * (env.tau_max * env.root_closes)[2]
    pays = []
    for command in (0.1, 0.5):
        env.command.fill_(command)
        pays.append(float(env.rewards()["torque"][0]))
    assert pays[0] == pytest.approx(pays[1])  # its torque, alike


@pytest.mark.parametrize("pads", [True, False])
def test_the_live_view_shows_any_hand(hands, pads):
    pytest.importorskip("viser")
    from dexsim.view.live import LiveView

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    env = make_env(config(hands[pads], "grasp", "tactile=raw"), 4, "cpu", 1, "mujoco")
    env.reset_all()
    still = lambda obs: torch.zeros(4, 9)  # noqa: E731
    view = LiveView(env, still, "still", ["still"], lambda name: still, "127.0.0.1", port)
    try:
        view.wishes.pause, view.wishes.steps = True, 2
        until = time.monotonic() + 60.0  # two steps, however busy the machine is
        while view.steps < 2 and time.monotonic() < until:
            view.run(seconds=0.5)
        command = env.commanded_force()[0].numpy()
        assert np.isnan(command).tolist() == [False, False, True] and view.steps == 2
        env.thumb_command.fill_(0.3)  # one of its own
        share = env.commanded_force() / env.f_max
        assert torch.allclose(share[:, 2], torch.tensor(0.3)) and torch.allclose(share[:, 0], env.command)
    finally:
        view.stop()


def test_held_poses_hold(hands):
    """What the search kept stays where it is under action zero."""
    env = make_env(config(hands[True], "rotate"), 6, "cpu", 3, "mujoco")
    env.in_order = True
    env.reset_all()
    was = env.object_pose.clone()
    for _ in range(20):
        env.step(torch.zeros(6, 9))
    assert ((env.object_pose - was)[:, :3].norm(dim=1) < 0.01).float().mean() >= 0.8
    assert ((env.tip_force > 0.01).sum(1) >= 1).float().mean() >= 0.8


def test_held_poses_are_looked_for_where_there_are_none(tmp_path, monkeypatch):
    folder, wanted = made_hand(tmp_path / "made", pads=False), []
    from dexsim.tasks import make_grasps
    from dexsim.tasks.stable_grasps import GraspSet

    def instead(cfg, count, worlds, seed, sizes, report=print):
        wanted.append((count, sizes))
        row = torch.zeros(count, 9)
        pose = torch.tensor([0.03, 0.0, 0.08, 1.0, 0, 0, 0]).repeat(count, 1)
        return GraspSet(torch.full((count,), 0.04), row, row, pose)

    monkeypatch.setattr(make_grasps, "generate", instead)
    for _ in range(2):
        make_env(config(folder, "rotate"), 4, "cpu", 1, "mujoco")
    assert len(wanted) == 1 and wanted[0][1] == pytest.approx((0.036, 0.048)) and (folder / "held_cubes.npz").is_file()


@pytest.mark.slow
@pytest.mark.parametrize("task, pads", [("rotate", True), ("grasp", False)])
def test_the_whole_chain(hands, moment, tmp_path, task, pads, capsys):
    """Trained, played, exported, checked, and run in real time's loop on the simulated hand."""
    out = tmp_path / "run"
    assert train([f"task={task}", f"hand={hands[pads]}", *FEW, "iterations=2", "final_episodes=0", f"out={out}"]) == 0
    policy = out / "policy.pt"
    (tmp_path / "path.csv").write_text("t,x,y,z\n0,0,0,0\n0.1,0,0,0.02\n0.2,0.02,0,0.03\n0.3,0,0,0.03\n")
    carried = [f"task.evaluation.base={tmp_path}/path.csv"]
    evaluation = ["task.evaluation.cap_s=0.5"] if task == "rotate" else carried
    played = ["episodes=2", "worlds=2", "device=cpu", "video=false", f"out={tmp_path}/played", *evaluation]
    assert play([f"checkpoint={policy}", *played]) == 0
    if task == "grasp":  # its hand carried along, as well as lifted and shaken
        lifted = [*played[:4], f"out={tmp_path}/lifted", "task.evaluation.base=lift"]
        assert play([f"checkpoint={policy}", *lifted]) == 0
        for folder, said in (("played", "hold_rate_path"), ("lifted", "hold_rate_shaken")):
            assert json.loads((tmp_path / folder / "metrics.json").read_text())[said] is not None, said
    made = export.export(str(policy), tmp_path / "bundle", steps=8)
    assert export.check(made)
    b = bundle.load(made)
    assert b.hand.joints == load_hand(hands[pads]).joints and b.hand.folder == made / "hand"
    assert len(b.manifest["joints"]) == 9 and b.manifest["fingers"] == ["a", "b", "t"]
    calibration, clock = Calibration.from_dict(b.manifest["calibration"], "bundle", None, b.hand), VirtualClock()
    driver = SimulatedXHand(b.config, calibration, clock, seed=1, grip=b.manifest.get("grip"))
    given = 0.5 if task == "grasp" else None
    settings = LoopSettings(seconds=0.5, home_speed=5.0, wait=0.2, grip=0.3, command=given)
    loop = Loop(b, driver, driver, calibration, settings, clock, keep=True)
    report = loop.run()
    assert report.ended == "done" and report.acts >= 10, report.ended
    assert np.isfinite(report.actions).all() and report.targets[0].shape == (9,)
    assert report.forces[0].shape == (3 if pads else 0,)


def test_a_hand_that_a_policy_was_not_trained_for_is_refused(hands, tmp_path):
    out = tmp_path / "run"
    train(["task=grasp", f"hand={hands[False]}", *FEW, "iterations=1", "final_episodes=0", f"out={out}"])
    with pytest.raises(UserError, match="joint|observation|layout|action"):
        play([f"checkpoint={out}/policy.pt", "hand=xhand", "episodes=1", "device=cpu", "video=false"])


@pytest.mark.slow
def test_a_play_of_another_hand_is_replayed_with_its_object(hands, moment, tmp_path):
    """Recorded in the task, replayed by the commands alone: the object is led, and each fingertip's force is there."""
    out, folder = tmp_path / "run", hands[True]
    train(["task=grasp", f"hand={folder}", *FEW, "iterations=1", "final_episodes=0", f"out={out}"])
    record = tmp_path / "play.mcap"
    assert play([f"checkpoint={out}/policy.pt", "episodes=2", "worlds=2", "device=cpu", "video=false",
                 f"record={record}", f"out={tmp_path}/played", *moment]) == 0  # fmt: skip
    r = read(record)
    m = mechanism.for_recording(r, folder)
    assert led_object.add_object(m, r) == "led" and m.hand.name == "made"
    run = mechanism.replay(r, m, 0.007, led_object.pairs(m.hand), led_object.JOINT)
    c = compare(r, run, m, forces=True)
    assert c.fingers == ("a", "b", "t") and c.finger_force_simulated[1].shape[1] == 3
    assert np.median(c.position_rmse()) < 0.05
