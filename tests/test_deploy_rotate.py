"""The rotation outside the simulator: bundles of both perceptions, the same observations and actions, goals, IMU,
closing the hand."""

from __future__ import annotations

import socket

import numpy as np
import pytest
import torch
import yaml
from bundles import QUIET_TURN, make_checkpoint
from replay_hand import ReplayHand
from test_deploy import FakeHand

from dexsim import export, rotation
from dexsim.calibration.file import Calibration
from dexsim.cli.deploy import main as command
from dexsim.deploy import bundle
from dexsim.deploy import loop as deploy_loop
from dexsim.deploy.driver import PASSIVE, HandState, VirtualClock
from dexsim.deploy.imu import UdpImu
from dexsim.deploy.loop import Loop, LoopSettings
from dexsim.deploy.measure import for_bundle
from dexsim.deploy.of_rotate import Measured
from dexsim.deploy.recorder import GOAL, TURNED
from dexsim.deploy.simulated_hand import SimulatedXHand
from dexsim.errors import UserError
from dexsim.recording.reader import read
from dexsim.tasks import observations_rotate as observations

torch.set_num_threads(1)
SETTINGS = {
    "imu": ("task.perception=imu",),
    "proprioception": ("task.perception=proprioception", "task.history=3"),
    "plain": (
        "task.perception=imu",
        "task.observe.orientation=quaternion",
        "task.observe.force_weighted=false",
        "task.observe.last_action=step",
        "agent=ppo_lstm",  # a network with memory, which must carry on as it does in play
        "agent.actor.rnn_hidden_dim=16",
    ),
}


@pytest.fixture(scope="module", params=list(SETTINGS))
def made(request, tmp_path_factory):
    """(bundle folder, checkpoint, name) of quiet sensors."""
    folder = tmp_path_factory.mktemp(request.param)
    source = make_checkpoint(
        folder / "policy.pt", *QUIET_TURN, "tactile.raw=true", *SETTINGS[request.param], task="rotate"
    )
    return export.export(str(source), folder / "out", steps=6), source, request.param


def test_golden_rows_and_manifest(made, capsys):
    out, _, name = made
    assert export.check(out) and capsys.readouterr().out.count("ok") == 4
    m = bundle.load(out).manifest
    edges = [(r["start"], r["stop"]) for r in m["observation"]]
    size = {"imu": 65, "proprioception": 3 * 56, "plain": 63}[name]
    assert edges[0][0] == 0 and edges[-1][1] == size == m["policy"]["observation_size"] and m["task"] == "rotate"
    assert all(a[1] == b[0] for a, b in zip(edges[:-1], edges[1:], strict=True))
    assert all(r["unit"] and r["frame"] and r["scaling"] and r["order"] and r["source"] for r in m["observation"])
    low, high, g = np.array(m["action"]["low"]), np.array(m["action"]["high"]), m["grip"]
    for pose in (g["hand"], g["target"]):
        assert (np.array(pose) >= low - 1e-6).all() and (np.array(pose) <= high + 1e-6).all()
    assert (
        m["initial_pose"] == g["hand"] and 0.04 < g["object_edge_m"] < 0.07 and "force_max_N" not in m["normalization"]
    )


def test_check_notices_a_changed_orientation_or_history(made, tmp_path):
    import shutil

    copy = shutil.copytree(made[0], tmp_path / "copy")
    rows = dict(np.load(copy / "golden.npz"))
    rows["signal_past" if made[2] == "proprioception" else "signal_goal"][3] += 0.01
    np.savez_compressed(copy / "golden.npz", **rows)
    assert not export.check(copy)


@pytest.fixture(scope="module")
def episode(made, tmp_path_factory):
    """Return (recording of the second of two worlds, its observations [K, D], actions, targets before and after)."""
    from dexsim.learning import checkpoint
    from dexsim.learning.ppo import load_policy
    from dexsim.recording.tap import PlayRecorder
    from dexsim.tasks import make_env

    data = checkpoint.load(made[1])
    env = make_env(data["config"] | {"worlds": 2}, 2, "cpu", 5, "mujoco")
    policy = load_policy(data, env, "policy.pt")
    tap = PlayRecorder(env, [1], data["config"], least=0.5)
    env.reset_all()
    rows = []
    with torch.no_grad():
        for _ in range(40):
            obs, before = env.get_observations(), env.target[1].numpy().copy()
            seen, action = obs["actor"][1].numpy().copy(), policy(obs).clone()
            env.step(0.5 * action)  # gently: the cube stays for a while
            if bool(env.done[1]):
                break
            rows.append((seen, action[1].numpy(), before, env.target[1].numpy().copy()))
    path = tap.save(tmp_path_factory.mktemp("mcap") / "episode.mcap")[0]
    return read(path, audit=False), *(np.stack(x) for x in zip(*rows, strict=True))


def test_a_recorded_episode_gives_the_same_observations_and_actions(made, episode):
    recording, observed, actions, before, after = episode
    out, _, name = made
    assert len(observed) > 15 and (recording.imu is not None) == (name != "proprioception")
    b, c, clock = bundle.load(out), Calibration.default(), VirtualClock()
    touch = [r for r in b.manifest["observation"] if r["name"] == "contact_force"][0]
    assert observed[:, touch["start"]:touch["stop"]].max() > 0.05, "an episode without touch would not test touch"
    hand = ReplayHand(recording, c, clock)
    settings = LoopSettings(seconds=len(observed) * 0.021 - 1e-3, home=False, speed=100.0, tor_max=32767)

    class Taught(Loop):
        """The recorded targets stand for the sent ones, and half the policy's action for its own, as in the
        recording."""

        def _begin_run(self, now):
            super()._begin_run(now)
            self.target = before[0]

        def _policy(self, now):
            super()._policy(now)
            self._action = 0.5 * self._action

        def _send(self, now, target, share):
            super()._send(now, target, share)
            self.target = after[self.report.acts]

    loop = Taught(b, hand, hand, c, settings, clock, keep=True)
    report = loop.run()
    assert report.acts == len(observed) and report.ended == "done"
    np.testing.assert_allclose(np.stack(report.observations), observed, atol=1e-5)
    np.testing.assert_allclose(np.stack(report.actions), actions, atol=1e-4)
    assert np.abs(np.diff(observed, axis=0)).max() > 1e-3, "an episode in which nothing happens would pass"


def turner(made) -> Measured:
    return for_bundle(bundle.load(made[0]), Calibration.default())


def state(t: float, q=0.3, velocity=None) -> HandState:
    return HandState(t, int(t * 100), np.full(12, q, np.float32), np.zeros(12), velocity=velocity)


def test_goals_move_on_as_the_object_turns(made):
    """The cube turned by hand: a goal a quarter turn on each time, whatever the IMU's heading."""
    m = turner(made)
    if m.needs is None:
        assert m.observe(state(0.0), None, [], np.zeros(12), np.zeros(12))[0].shape == (1, m.frame * 3)
        return
    heading = 2.1
    for k in range(200):
        q = np.array([np.cos((heading + 0.02 * k) / 2), 0, 0, np.sin((heading + 0.02 * k) / 2)])
        m.observe(state(k * 0.021), q, [], np.zeros(12), np.zeros(12))
    remaining = np.radians(90) - m.task["reward"]["delta_rot"]
    assert m.goals == int(0.02 * 199 / remaining) and m.goals >= 2
    assert float(rotation.error(m.goal, torch.tensor(q, dtype=torch.float32)[None])) < np.radians(90) + 1e-4
    m.reset()
    assert m.goal is None and m.goals == 0


def test_relative_orientation_does_not_know_the_heading():
    gen = torch.Generator().manual_seed(0)
    q = rotation.normalize(torch.randn(20, 4, generator=gen))
    axis, turn = torch.tensor([0.0, 0.0, 1.0]), rotation.about(torch.tensor([0.0, 0.0, 1.0]), torch.tensor(1.57))
    other = rotation.multiply(rotation.about(axis.expand(20, 3), torch.full((20,), 0.9)), q)
    a, b = (observations.relative(x, observations.next_goal(x, axis, turn, False), "6d") for x in (q, other))
    assert torch.allclose(a, b, atol=1e-5) and a.std(0).max() > 0.1


def test_speed_is_the_firmwares_or_the_difference_of_readings(made):
    m = turner(made)
    assert np.allclose(m.hand.velocity(state(0.0, 0.3, np.full(12, 0.7))), 0.7)
    m.reset()
    assert np.allclose(m.hand.velocity(state(0.0, 0.3)), 0)
    assert np.allclose(m.hand.velocity(state(0.02, 0.32)), 1.0, atol=1e-5)
    assert np.allclose(m.hand.velocity(state(0.02, 0.32)), 1.0, atol=1e-5), "the same reading again tells nothing new"


@pytest.mark.slow
def test_the_whole_loop_on_the_simulated_hand(made, tmp_path):
    """The cube is held out, the fingers close on it, it is let go and stays; everything is recorded."""
    from dexsim.deploy.recorder import Recorder
    from dexsim.recording.container import open_container

    clock, b, c, said = VirtualClock(), bundle.load(made[0]), Calibration.default(), []
    hand = SimulatedXHand(b.config, c, clock, seed=2, grip=b.manifest["grip"])
    rec = Recorder(
        tmp_path / "run.mcap",
        b.manifest["joints"],
        {"source": "sim", "effort_is": "current_A", "tactile_unit": "count"},
        None,
        0.0,
        most=10**6,
    )
    loop = Loop(
        b,
        hand,
        hand,
        c,
        LoopSettings(seconds=1.0, home_speed=2.0, wait=0.5, grip=0.5),
        clock,
        rec,
        keep=True,
        say=said.append,
    )
    loop.bundle.act = lambda observation: np.zeros((1, 12), np.float32)  # hold still
    report = loop.run()
    assert report.ended == "done" and report.acts == 47 and np.isfinite(np.stack(report.observations)).all()
    assert said[0].startswith("hand     ") and len(said) == 2 and "close on it in 0.5 s" in said[1]
    assert np.stack(report.forces)[10:].sum(1).min() > 0.02, "fingertips hold the cube"
    place = hand.hand.env.object_pose[0, :3].numpy()
    assert np.linalg.norm(place - np.array(b.manifest["grip"]["object_pose"][:3])) < 0.02, "it has not fallen"
    container = open_container(tmp_path / "run.mcap")
    seen = {ch.topic: sum(x.channel_id == i for x in container.messages) for i, ch in container.channels.items()}
    assert (seen.get(TURNED), seen.get(GOAL)) == ((47, 47) if made[2] != "proprioception" else (None, None))
    assert len(read(tmp_path / "run.mcap", audit=False).states.velocity) > 100


NAN = float("nan")
IMU = {
    "an hour old": lambda now, since: (UPRIGHT, now - 3600),
    "never": lambda now, since: None,
    "a stamp of NaN": lambda now, since: (UPRIGHT, NAN),
    "an hour ahead": lambda now, since: (UPRIGHT, now + 3600),
    "NaN": lambda now, since: (UPRIGHT * NAN, now),
    "of no length": lambda now, since: (UPRIGHT * 0.0, now),
    "of 1e9": lambda now, since: (UPRIGHT * 1e9, now),
    "three numbers": lambda now, since: (UPRIGHT[:3], now),
    "frozen": lambda now, since: (UPRIGHT, since),
}
UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])


class Imu:
    """An IMU whose answers are `fault(now, since)` from `at` s after the policy's begin on."""

    def __init__(self, hand, fault, at):
        self.hand, self.fault, self.at, self.since = hand, fault, at, None

    def orientation(self, now):
        if self.hand.begun and now >= self.hand.begun + self.at:
            self.since = now if self.since is None else self.since
            return self.fault(now, self.since)
        return UPRIGHT, now


@pytest.mark.parametrize("fault", IMU)
def test_an_imu_that_is_not_read_relaxes_the_hand(made, fault, monkeypatch):
    """Within 0.15 s, with the settings as they are, from the first moment or later; a policy without an IMU asks for
    none."""
    at = 0.3 if made[2] == "plain" else 0.0
    monkeypatch.setattr(deploy_loop.gc, "collect", lambda: 0)  # of torch's whole heap, before each run
    hand = FakeHand(VirtualClock(100.0), start=0.05)
    imu = Imu(hand, IMU[fault], at)
    loop = Loop(bundle.load(made[0]), hand, imu, Calibration.default(), LoopSettings(seconds=0.6, home_speed=3.0,
                wait=0.1, grip=0.1), hand.clock)  # fmt: skip
    report = loop.run()
    if made[2] == "proprioception":
        assert report.ended == "done" and imu.since is None
    else:
        assert "object" in report.ended, report.ended
        assert hand.relaxed_at[0] - imu.since < 0.15, (hand.relaxed_at[0] - imu.since, report.ended)
        driven = np.stack([q for _, q, _, mode in hand.sent if mode != PASSIVE])
        assert np.isfinite(driven).all() and not [1 for t, *_ in hand.sent if t > hand.relaxed_at[0]]


def test_the_loop_says_what_it_lacks(made):
    b = bundle.load(made[0])
    if made[2] == "proprioception":
        assert Loop(b, object(), None, Calibration.default()).measure.needs is None
    else:
        with pytest.raises(UserError, match="needs the object's orientation"):
            Loop(b, object(), None, Calibration.default())


def test_command_line(made):
    wrong = [
        (["command=0.5"], "takes no command"),
        (["vision=camera"], "vision=camera"),
        (["shape=box"], "shape=box"),
    ]
    if made[2] == "imu":
        wrong += [
            (["driver=xhand", "port=x"], "imu=udp:PORT"),
            (["driver=xhand", "port=x", "imu=udp:x"], "imu=udp:x"),
            (["imu=udp:1"], "imu="),
        ]
    for arguments, says in wrong:
        with pytest.raises(UserError, match=says) as caught:
            command([f"bundle={made[0]}", *arguments])
        assert "\n" not in str(caught.value)


def test_a_bundle_without_its_goal_is_named(made, tmp_path):
    import shutil

    copy = shutil.copytree(made[0], tmp_path / "copy")
    m = yaml.safe_load((copy / "manifest.yaml").read_text())
    del m["task_settings"]
    (copy / "manifest.yaml").write_text(yaml.safe_dump(m))
    with pytest.raises(UserError, match="task_settings"):
        bundle.load(copy)


def test_orientations_over_udp():
    imu = UdpImu(0)
    try:
        assert imu.orientation(0.0) is None
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
            for text in (b"1 0 0 0", b"nonsense", b"0 0 0 0", b"0.6, 0, 0, 0.8"):
                s.sendto(text, ("127.0.0.1", imu.port))
        assert imu.wait(2.0)
        q, at = imu.orientation(5.0)
        assert q.tolist() == [0.6, 0.0, 0.0, 0.8] and imu.bad == 2
        with pytest.raises(UserError, match=f"udp:{imu.port}"):
            UdpImu(imu.port)
    finally:
        imu.close()
