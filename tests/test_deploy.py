"""The deployed loop: same observations and actions as the simulator, limits, watchdog, homing, recording, timing."""

from __future__ import annotations

import contextlib
import multiprocessing
import time

import numpy as np
import pytest
import torch
from bundles import QUIET, make_checkpoint
from replay_hand import ReplayHand

from dexsim import export, system
from dexsim.calibration.file import Calibration
from dexsim.cli.deploy import main as command
from dexsim.deploy import bundle
from dexsim.deploy.driver import Clock, HandCommand, HandState, VirtualClock
from dexsim.deploy.loop import Loop, LoopSettings
from dexsim.deploy.recorder import Recorder
from dexsim.deploy.safety import Guard
from dexsim.deploy.simulated_hand import SimulatedXHand
from dexsim.deploy.timing import Timing
from dexsim.deploy.vision import CameraPose, FixedPlace, Frame, centroid
from dexsim.errors import UserError
from dexsim.recording.reader import read
from tools.assets import xhand

torch.set_num_threads(1)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Return a bundle whose training had quiet sensors and kept every taxel."""
    folder = tmp_path_factory.mktemp("deploy")
    source = make_checkpoint(
        folder / "policy.pt", *QUIET, "tactile.raw=true", "task.command.low=0.6", "task.command.high=0.6",
        "task.action.lead=null",
    )  # fmt: skip
    return export.export(str(source), folder / "out", steps=4), source


@pytest.fixture(scope="module")
def episode(made, tmp_path_factory):
    """Return (recording of a simulated episode, its observations [K, 66], its actions, its targets)."""
    from dexsim.learning import checkpoint
    from dexsim.learning.ppo import load_policy
    from dexsim.recording.tap import PlayRecorder
    from dexsim.tasks import make_env

    data = checkpoint.load(made[1])
    for seed in range(5, 25):  # the first in which the closing fingers meet the object
        env = make_env(data["config"], 1, "cpu", seed, "mujoco")
        policy = load_policy(data, env, "policy.pt")
        tap = PlayRecorder(env, 1, data["config"])
        env.reset_all()
        rows = []
        with torch.no_grad():
            for k in range(80):
                obs = env.get_observations()
                # then close, to press
                action = policy(obs) if k < 40 else torch.where(torch.arange(12) > 3, 1.0, policy(obs))
                env.step(action)
                if bool(env.done[0]):
                    break
                rows.append((obs["actor"][0].numpy().copy(), action[0].numpy().copy(), env.target[0].numpy().copy()))
        if len(rows) > 60 and np.stack([r[0] for r in rows])[:, 30:35].max() > 0.02:
            break
    path = tap.save(tmp_path_factory.mktemp("mcap") / "episode.mcap")[0]
    return read(path, audit=False), *(np.stack(x) for x in zip(*rows, strict=True))


def test_a_recorded_episode_gives_the_same_observations_and_actions(made, episode):
    recording, observations, actions, targets = episode
    assert observations[:, 30:35].max() > 0.02, "an episode without touch would not test touch"
    b, c = bundle.load(made[0]), Calibration.default()
    clock = VirtualClock()
    hand = ReplayHand(recording, c, clock)
    settings = LoopSettings(
        seconds=len(observations) * 0.021 - 1e-3, command=0.6, home=False, speed=100.0, tor_max=32767
    )

    class Taught(Loop):
        """The recorded targets stand for the sent ones, so that one difference cannot grow into the next."""

        def _send(self, now, target, share):
            super()._send(now, target, share)
            self.sent = self.target.copy()
            self.target = targets[self.report.acts]

    loop = Taught(b, hand, hand, c, settings, clock, keep=True)
    report = loop.run()
    assert report.acts == len(observations) and report.ended == "done" and hand.relaxed
    np.testing.assert_allclose(np.stack(report.observations), observations, atol=1e-5)
    followed = slice(0, 40)  # where the recorded actions are the policy's
    np.testing.assert_allclose(np.stack(report.actions)[followed], actions[followed], atol=1e-4)
    sent = np.stack([x for _, x in hand.sent])
    np.testing.assert_allclose(sent[followed], targets[followed], atol=1e-5)
    assert np.abs(sent[45:] - targets[45:]).max() > 1e-2, "targets that were not the policy's are told apart"


def test_a_replay_with_wrong_calibration_is_seen(made, episode):
    """The same replay, with currents read by another calibration: observations differ where torque is, and only
    there."""
    recording, observations, *_ = episode
    other = Calibration.from_dict({"joints": {j: {"current_per_torque": 5.4} for j in xhand.JOINTS}})
    clock = VirtualClock()
    hand = ReplayHand(recording, Calibration.default(), clock)
    loop = Loop(
        bundle.load(made[0]), hand, hand, other, LoopSettings(seconds=0.4, command=0.6, home=False), clock, keep=True
    )
    got = np.stack(loop.run().observations)
    want = observations[: len(got)]
    np.testing.assert_allclose(got[:, 12:24], want[:, 12:24] / 2, atol=1e-5)
    np.testing.assert_allclose(np.delete(got, np.s_[12:24], 1), np.delete(want, np.s_[12:24], 1), atol=1e-5)


def test_a_bundle_has_the_lead_that_follows_from_the_torque(made):
    action = bundle.load(made[0]).manifest["action"]
    loosest = 1.05 / 0.75  # torque_limit over kp of the drive that is drawn farthest (randomize/default.yaml)
    np.testing.assert_allclose(action["lead"][4], 1.1 / 4.0 * loosest, atol=1e-6)
    np.testing.assert_allclose(action["lead"][3], 0.348, atol=1e-6)  # all that it moves, less than 0.4 / 1.5 * loosest


# -- limits
# ---------------------------------------------------------------------------------------------------------------------


def guard(**changes) -> Guard:
    base = dict(low=np.full(12, -0.5), high=np.full(12, 1.5), speed=np.full(12, 2.0), current=np.full(12, 300.0),
                current_sign=np.full(12, -1.0), names=xhand.JOINTS)  # fmt: skip
    return Guard(**base | changes)


def test_targets_keep_position_and_speed_limits():
    rng = np.random.default_rng(0)
    g, before, q = guard(), np.zeros(12), np.zeros(12)
    for _ in range(300):
        target = rng.normal(0, 3, 12)
        target[rng.integers(12)] = rng.choice([np.nan, np.inf, -np.inf])
        now = g.apply(target, before, q, np.zeros(12), 0.02)
        assert (
            np.isfinite(now).all()
            and (np.abs(now - before) <= 0.04 + 1e-9).all()
            and (now >= -0.5).all()
            and (now <= 1.5).all()
        )
        before = now
    assert g.counts["not_finite"] == 300 and g.counts["speed"] > 1000 and g.counts["position"] > 10
    quiet = guard()
    small = quiet.apply(np.full(12, 0.03), np.zeros(12), q, np.zeros(12), 0.02)
    assert np.array_equal(small, np.full(12, 0.03)) and not quiet.counts, "what keeps the limits is not touched"


def test_current_over_its_limit_takes_the_lead_back_in_its_direction_only():
    g = guard(speed=np.full(12, 50.0))
    before, q = np.full(12, 0.4), np.full(12, 0.2)  # leads the joint by 0.2 rad
    current = np.zeros(12)
    current[0], current[1], current[2] = -600.0, -600.0, 600.0  # closing, closing, opening, at twice the limit
    target = np.full(12, 0.45)
    target[1] = 0.1
    now = g.apply(target, before, q, current, 0.02)
    assert now[0] == pytest.approx(0.3), "half the lead, where it draws twice the limit"
    assert now[1] == pytest.approx(0.1), "letting go is always allowed"
    assert now[2] == pytest.approx(0.45), "moving against an opening current is not more of it"
    assert now[3] == pytest.approx(0.45) and g.counts["current"] == 1


def test_sustained_current_and_heat_name_the_joint():
    g = guard()
    hot = np.zeros(12)
    current = np.zeros(12)
    current[6] = -400
    assert all(g.must_relax(current, hot, 0.01) is None for _ in range(95))
    assert g.must_relax(np.zeros(12), hot, 0.01) is None, "the count begins anew"
    said = [g.must_relax(current, hot, 0.01) for _ in range(105)]
    assert said[95] is None and "mid_joint1 drew 400 mA" in said[-1]
    hot[9] = 90
    assert "ring_joint2 is at 90" in guard().must_relax(np.zeros(12), hot, 0.01)


# -- phases and watchdogs
# -----------------------------------------------------------------------------------------------------------


class FakeHand:
    """A hand that follows its targets with a lag; `fault(driver, t)` may change what it does."""

    name = "fake"

    def __init__(self, clock, fault=None, start=0.0):
        self.clock, self.fault = clock, fault
        self.q, self.target = np.full(12, start), np.full(12, start)
        self.sent, self.relaxed_at, self.begun, self.sequence, self.frozen, self.stuck = [], [], None, 0, None, False
        self.current = np.zeros(12)

    def open(self):
        self.last = self.clock.now()
        return {}

    def read(self):
        now = self.clock.now()
        if self.fault:
            self.fault(self, now)
        if self.frozen is not None:
            return self.frozen
        if not self.stuck:
            self.q = self.q + (self.target - self.q) * (1 - np.exp(-(now - self.last) / 0.03))
        self.last = now
        self.sequence += 1
        return HandState(
            now, self.sequence, self.q.astype(np.float32), self.current, tactile=np.zeros((5, 120, 3), np.int16)
        )

    def send(self, command):
        self.sent.append((self.clock.now(), command.position.copy(), command.tor_max.copy(), command.mode))
        self.target = command.position.copy()

    def relax(self):
        self.relaxed_at.append(self.clock.now())

    def started(self):
        self.begun = self.clock.now()

    def close(self):
        self.relax()


def play(made, fault=None, clock=None, start=0.05, recorder=None, **changes):
    clock = clock or VirtualClock(100.0)
    hand = FakeHand(clock, fault, start)
    settings = LoopSettings(**{"seconds": 1.0, "tor_max": 300.0} | changes)
    loop = Loop(
        bundle.load(made[0]), hand, FixedPlace([0.055, 0.0, 0.04]), Calibration.default(), settings, clock, recorder
    )
    return hand, loop


def test_homing_comes_first_slow_and_at_reduced_current(made):
    hand, loop = play(made, home_speed=0.5)
    report = loop.run()
    assert report.ended == "done" and report.acts == 48  # 1 s of 21 ms
    t, q, tor, _ = (np.array(x) for x in zip(*hand.sent, strict=True))
    np.testing.assert_allclose(q[0], 0.05, atol=1e-6)  # the first target is where the hand was
    homing = t < hand.begun - loop.settings.settle - 0.03
    speed = np.abs(np.diff(q[homing], axis=0)) / 0.021
    assert 0.4 < speed.max() <= 0.5 * 1.001 and (tor[homing] == 150).all() and (tor[t >= hand.begun] == 300).all()
    np.testing.assert_allclose(q[homing][-1], loop.home, atol=2e-3)
    assert np.isclose(np.diff(t[t >= hand.begun]), 0.021, atol=1e-9).all()
    assert hand.relaxed_at and hand.relaxed_at[0] >= t[-1]


def test_a_blocked_homing_ends_with_the_joints_name(made):
    def block(hand, now):
        hand.stuck, hand.current = True, np.full(12, -120.0)  # what is blocked draws current

    hand, loop = play(made, block)
    with pytest.raises(UserError, match="homing: thumb_bend_joint is 0.95 rad from its home"):
        loop.run()
    assert hand.relaxed_at and hand.begun is None


def test_a_stale_state_relaxes_and_nothing_is_sent_afterwards(made):
    def freeze(hand, now):
        if hand.begun and now > hand.begun + 0.3 and hand.frozen is None:
            hand.frozen = HandState(now, hand.sequence, hand.q, hand.current)

    hand, loop = play(made, freeze, stale=0.1)
    report = loop.run()
    assert "ms old, allowed 100" in report.ended and report.counts["relaxed"] == 1
    assert 0.085 < hand.relaxed_at[0] - hand.frozen.time < 0.111
    assert hand.sent[-1][0] < hand.relaxed_at[0] and report.counts["no_new_reading"] >= 9


def test_recover_homes_again(made):
    def freeze(hand, now):
        if hand.begun and hand.begun + 0.3 < now < hand.begun + 0.6:
            hand.frozen = hand.frozen or HandState(now, hand.sequence, hand.q, hand.current)
        else:
            hand.frozen = None

    hand, loop = play(made, freeze, recover=True, recover_s=0.5)
    first = []
    plain, hand.started = hand.started, lambda: (first.append(hand.clock.now()), plain() if len(first) == 1 else None)
    report = loop.run()
    assert report.ended == "done" and report.counts["relaxed"] == 2 and report.counts["recovered"] == 1
    quiet = np.diff([t for t, *_ in hand.sent])
    assert len(first) == 2 and quiet.max() > 0.5, "it lay relaxed in between"


def test_over_current_relaxes(made):
    def press(hand, now):
        hand.current = (
            np.where(np.arange(12) == 4, -500.0, 0.0) if hand.begun and now > hand.begun + 0.1 else np.zeros(12)
        )

    hand, loop = play(made, press, seconds=4.0)
    report = loop.run()
    assert "index_joint1 drew 500 mA" in report.ended
    assert hand.relaxed_at[0] - hand.begun == pytest.approx(1.1, abs=0.05)


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_interrupts_and_bugs_relax(made, error):
    def fail(hand, now):
        if hand.begun and now > hand.begun + 0.2:
            hand.fault = None
            raise error

    hand, loop = play(made, fail)
    if error is KeyboardInterrupt:
        assert loop.run().ended == "stopped by Ctrl-C"
    else:
        with pytest.raises(error):
            loop.run()
    assert hand.relaxed_at and hand.relaxed_at[0] >= hand.sent[-1][0]


@pytest.mark.slow
def test_a_hanging_driver_is_relaxed_by_the_watchdogs_thread(made):
    held = []

    def hang(hand, now):
        if hand.begun and now > hand.begun + 0.2 and not held:
            time.sleep(1.2)
            held.append((now, hand.clock.now()))

    hand, loop = play(
        made,
        hang,
        Clock(),
        start=0.45,
        hang=0.2,
        late=5.0,
        stale=5.0,
        settle=0.1,
        home_speed=5.0,
        home_error=2.0,
        seconds=3.0,
    )
    report = loop.run()
    assert report.counts["watchdog"] == 1 and "did not turn" in report.ended
    start, end = held[0]
    assert start + 0.2 <= hand.relaxed_at[0] < end - 0.3, "relaxed while the driver still hung"
    assert not [t for t, *_ in hand.sent if t > hand.relaxed_at[0]]


def test_turns_that_take_too_long_relax(made):
    def slow(hand, now):
        if hand.begun and now > hand.begun + 0.1:
            time.sleep(0.03)

    hand, loop = play(
        made, slow, Clock(), start=0.45, settle=0.1, home_speed=5.0, home_error=2.0, late=5.0, stale=5.0, overruns=8
    )
    report = loop.run()
    assert "8 turns in a row" in report.ended and report.timing.overruns >= 8


def test_a_nan_policy_holds_the_hand_and_lets_go(made):
    hand, loop = play(made)
    loop.bundle.act = lambda observation: np.full((1, 12), np.nan, np.float32)
    report = loop.run()
    last = np.stack([q for t, q, *_ in hand.sent if t >= hand.begun])
    assert "actions are not finite" in report.ended and np.ptp(last, axis=0).max() < 1e-6
    assert hand.relaxed_at[0] - hand.begun < 0.15


# -- recording
# --------------------------------------------------------------------------------------------------------------------


def recorder_at(path, **kw):
    return Recorder(
        path,
        xhand.JOINTS,
        {"source": "sim", "effort_is": "current_A", "effort_sign": "-1", "tactile_unit": "count"},
        None,
        100.0,
        **kw,
    )


def test_what_is_seen_and_sent_is_recorded(made, tmp_path):
    hand, loop = play(made, recorder=recorder_at(tmp_path / "run.mcap"))
    report = loop.run()
    r = read(tmp_path / "run.mcap", audit=False)
    t = np.array([t for t, *_ in hand.sent])
    assert len(r.commands) == len(hand.sent)
    np.testing.assert_allclose(r.commands.t - r.commands.t[0], t - t[0], atol=1e-6)
    np.testing.assert_allclose(r.commands.value, [q for _, q, *_ in hand.sent], atol=1e-6)
    assert len(r.states.position) == hand.sequence - 1 and len(r.tactile) == len(r.states.position)
    from dexsim.recording.container import open_container

    c = open_container(tmp_path / "run.mcap")
    seen = {ch.topic: sum(m.channel_id == i for m in c.messages) for i, ch in c.channels.items()}
    assert seen["/policy/observation"] == seen["/policy/action"] == seen["/object_seen"] == report.acts


def test_a_slow_disk_costs_samples_not_time(tmp_path, monkeypatch):
    from dexsim.recording.writer import Writer

    monkeypatch.setattr(Writer, "add", lambda *a: time.sleep(0.05))  # before the recorder's thread looks it up
    rec = recorder_at(tmp_path / "slow.mcap", most=10)
    start = time.perf_counter()
    for k in range(300):
        rec.put("tactile", 100.0 + k * 1e-3, np.zeros((5, 120, 3)))
    took = time.perf_counter() - start
    # waiting for the disk would take 15 s; what does not fit the queue of 10 meanwhile is dropped, and counted
    assert took < 5.0 and rec.dropped >= 290 - took / 0.05 - 20
    rec.close()


def record_for_ever(path):
    rec = recorder_at(path)
    rec.zero = time.monotonic()
    for k in range(100_000):
        rec.put("state", time.monotonic(), np.full(12, k * 1e-3), None, np.zeros(12), time.monotonic())
        rec.put("command", time.monotonic(), np.zeros(12))
        time.sleep(0.005)


def test_a_killed_loop_leaves_its_finished_chunks(tmp_path):
    path = tmp_path / "killed.mcap"
    p = multiprocessing.get_context("fork").Process(target=record_for_ever, args=(path,))
    p.start()
    limit, finished = time.monotonic() + 60, 0.0
    while finished < 0.4:  # s of whole chunks, however busy the machine is
        assert time.monotonic() < limit
        time.sleep(0.1)
        with contextlib.suppress(UserError):
            finished = read(path, audit=False).duration
    p.kill()
    p.join()
    r = read(path, audit=False)
    assert r.duration >= finished, "all but the last half second or so"
    q = r.states.position.value[:, 0]
    np.testing.assert_allclose(q, np.arange(len(q)) * 1e-3, atol=1e-9)
    assert any(f.kind == "damage" for f in r.findings), "and it says that the end is missing"


# -- the simulated hand, vision, the vendor's adapter
# ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def simulated(made):
    clock = VirtualClock()
    hand = SimulatedXHand(bundle.load(made[0]).config, Calibration.default(), clock, seed=1)
    hand.open()
    return hand


def drive(hand, position, tor_max=3000.0, seconds=0.6):
    for _ in range(round(seconds / 0.02)):
        hand.send(HandCommand(np.asarray(position, float), np.full(12, tor_max)))
        hand.clock.sleep_until(hand.clock.now() + 0.02)
        state = hand.read()
    return state


def test_simulated_hand_speaks_the_sdks_units(simulated):
    low, high = xhand.joint_limits().T
    goal = np.clip(np.full(12, 0.5), low, high)
    state = drive(simulated, goal)
    assert np.abs(state.position - goal).max() < 0.06
    counts = state.position / (2 * np.pi / 4096)
    np.testing.assert_allclose(counts, np.round(counts), atol=2e-3)
    assert state.current.dtype == np.int16 and state.tactile.dtype == np.int16 and state.tactile.shape == (5, 120, 3)
    assert (state.tactile[..., 2] >= 0).all()
    t = [drive(simulated, goal, seconds=0.02) for _ in range(4)]
    assert np.allclose(np.diff([s.time for s in t]), 0.02) and t[3].sequence - t[0].sequence == 6  # two readings each


def test_simulated_current_is_negative_while_closing_and_limited(simulated):
    """Fingers driven into their stops: the sign is the hand's (+ opening), the size at most tor_max."""
    low, high = xhand.joint_limits().T
    start = np.clip(np.full(12, 0.3), low, high)
    start[3] = 0.0
    drive(simulated, start)
    against = start.copy()
    against[6] = start[6] + 1.0  # closing: while it moves, the motor pulls
    simulated.send(HandCommand(against, np.full(12, 250.0)))
    simulated.clock.sleep_until(simulated.clock.now() + 0.045)
    state = simulated.read()
    assert -251 <= state.current[6] < -200
    against[6] = low[6] - 0.3
    simulated.send(HandCommand(against, np.full(12, 250.0)))
    simulated.clock.sleep_until(simulated.clock.now() + 0.045)
    assert 200 < simulated.read().current[6] <= 251


def test_simulated_hand_relaxes(simulated):
    drive(simulated, np.clip(np.full(12, 0.5), *xhand.joint_limits().T))
    simulated.relax()
    simulated.clock.sleep_until(simulated.clock.now() + 0.1)
    state = simulated.read()
    assert (state.current == 0).all()


def test_the_whole_loop_on_the_simulated_hand(made):
    clock = VirtualClock()
    b, c = bundle.load(made[0]), Calibration.default()
    hand = SimulatedXHand(b.config, c, clock, seed=2)
    loop = Loop(b, hand, hand, c, LoopSettings(seconds=1.0, home_speed=2.0), clock, keep=True)
    report = loop.run()
    assert report.ended == "done" and report.acts == 48 and np.isfinite(np.stack(report.observations)).all()
    seen = np.stack(report.observations)[:, 26]
    assert seen[0] > 0.05 and seen[-1] < seen[0] - 0.02, "the object fell once the policy began"


def test_centroid_of_a_ball_is_where_it_is():
    """Against a ball ray-traced here: from the side, the height of the mask's centroid is the ball's."""
    h, w, f = 120, 160, 150.0
    r = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # right = +y, up = +z, back = +x
    camera = CameraPose(np.array([0.5, 0.0, 0.05]), r, f, (w / 2, h / 2))
    ball, radius = np.array([0.05, 0.02, 0.09]), 0.03
    v, u = np.mgrid[0:h, 0:w]
    rays = np.stack([(u + 0.5 - w / 2) / f, -(v + 0.5 - h / 2) / f, -np.ones((h, w))], -1) @ r.T
    o = camera.position - ball
    a, half_b, cc = (rays**2).sum(-1), rays @ o, o @ o - radius**2
    d = half_b**2 - a * cc
    depth = np.where(d > 0, (-half_b - np.sqrt(np.maximum(d, 0))) / a, 2.0)
    place = centroid(Frame(depth, d > 0, 0.0), camera)
    assert np.abs(place - ball).max() < 2e-3
    assert centroid(Frame(depth, np.zeros((h, w), bool), 0.0), camera) is None


CAMERA = """
import sys
from dexsim.calibration.file import Calibration
from dexsim.deploy import bundle
from dexsim.deploy.simulated_hand import SimulatedHand
hand = SimulatedHand(bundle.load(sys.argv[1]).config, Calibration.default(), seed=4, camera=True, shape="sphere")
for dz in (0.0, 0.02, -0.03):
    hand._start[0][0, 2] += dz
    hand._hold()
    hand.env.engine.refresh()
    print(hand.camera.see(0.0)[2] - float(hand.env.engine.t.qpos[0, hand.env.object_q[2]]))
"""


@pytest.mark.slow
def test_simulated_camera_sees_the_objects_height(made, monkeypatch):
    """In a process of its own: a process keeps to the first OpenGL that it opens."""
    import subprocess
    import sys

    monkeypatch.setenv("MUJOCO_GL", "")
    monkeypatch.setenv("PYOPENGL_PLATFORM", "")
    if system.renderer() is None:
        pytest.skip(system.no_renderer())
    done = subprocess.run([sys.executable, "-c", CAMERA, str(made[0])], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    errors = [float(x) for x in done.stdout.split()[-3:]]
    assert np.abs(errors).max() < 0.012 and np.ptp(errors) < 0.006, errors


def test_timing_percentiles():
    t = Timing(2000)
    t._rows[:1000, 0] = 1e-3
    t._rows[1000:1002, 0] = 9e-3
    t.turns = 1002
    s = t.summary()
    assert (
        s["cpu_median_ms"] == pytest.approx(1)
        and s["cpu_p999_ms"] == pytest.approx(9, rel=0.01)
        and s["cpu_max_ms"] == pytest.approx(9)
    )


def test_command_line(made, capsys):
    for arguments, says in (
        (["bundle=nowhere"], "manifest"),
        ([f"bundle={made[0]}", "driver=xhand"], "place="),
        ([f"bundle={made[0]}", "driver=xhand", "port=fake:crx=1"], "crx"),
        ([f"bundle={made[0]}", "driver=xhand", "port=/dev/ttyACM0", "seed=1"], "seed=1: driver=xhand does not use it"),
        (["sedonds=3"], "sedonds"),
        ([f"bundle={made[0]}", "seconds=abc"], "seconds=abc"),
        ([f"bundle={made[0]}", "driver=x"], "driver=x"),
        ([f"bundle={made[0]}", "shape=blob"], "shape=blob"),
        ([f"bundle={made[0]}", "place=1,2"], "place=1,2: must be x y z"),
    ):
        with pytest.raises(UserError, match=says) as caught:
            command(arguments)
        assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_real_time_on_the_simulated_hand(made, tmp_path):
    """The command itself, in real time with the hand in its own process."""
    import subprocess
    import sys

    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "dexsim",
            "deploy",
            f"bundle={made[0]}",
            "seconds=2",
            "home_speed=2",
            "late=1",
            "stale=1",
            "hang=2",
            "overruns=200",
            f"record={tmp_path / 'run.mcap'}",
        ],
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    assert "99.9 %" in done.stdout and "overruns" in done.stdout and "relaxed" in done.stdout
    assert len(read(tmp_path / "run.mcap", audit=False).commands) > 100


@pytest.mark.slow
@pytest.mark.parametrize("how", ["SIGINT", "SIGKILL"])
def test_interrupting_the_command(made, tmp_path, how):
    """Ctrl-C relaxes and ends with 130; kill -9 leaves a readable recording and no process of the simulated hand."""
    import os
    import signal
    import subprocess
    import sys

    path = tmp_path / "run.mcap"
    p = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "dexsim",
            "deploy",
            f"bundle={made[0]}",
            "seconds=60",
            "home_speed=2",
            "late=2",
            "stale=2",
            "hang=3",
            "overruns=500",
            f"record={path}",
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    limit = time.monotonic() + 120
    while not (path.exists() and path.stat().st_size > 40_000) and time.monotonic() < limit:
        time.sleep(0.1)
    children = subprocess.run(["ps", "--ppid", str(p.pid), "-o", "pid="], capture_output=True, text=True).stdout.split()
    os.kill(p.pid, getattr(signal, how))
    out, err = p.communicate(timeout=60)
    if how == "SIGINT":
        assert p.returncode == 130 and "stopped by Ctrl-C" in out and "the hand is relaxed" in out, err
    r = read(path, audit=False)
    assert len(r.states.position) > 100 and len(r.commands) > 50
    assert any(f.kind == "damage" for f in r.findings) == (how == "SIGKILL")
    limit = time.monotonic() + 20
    alive = children
    while alive and time.monotonic() < limit:  # what is left of a process that nobody waited for does not count
        time.sleep(0.2)
        rows = subprocess.run(
            ["ps", "-o", "pid=,stat=", "-p", ",".join(children)], capture_output=True, text=True
        ).stdout.splitlines()
        alive = [row for row in rows if "Z" not in row.split()[1]]
    assert children and not alive


# -- what users of the real hand met: freezing policies, slow cameras
# --------------------------------------------------------------------------------------------------------------------
def test_the_noise_of_training_is_offered(made):
    b = bundle.load(made[0])
    spread = np.array(b.manifest["action"]["std"])
    assert spread.shape == (12,) and (spread > 0).all()
    actions = {}
    for noise in (0.0, 1.0):
        hand, loop = play(made, noise=noise, seconds=4.0)
        loop.keep, loop.bundle.act = True, lambda observation: np.zeros((1, 12), np.float32)
        loop.run()
        actions[noise] = np.stack(loop.report.actions)
    assert not actions[0.0].any()
    np.testing.assert_allclose(actions[1.0].std(0), spread, rtol=0.25)
    del b.manifest["action"]["std"]
    with pytest.raises(UserError, match="noise=1: .*does not say how much"):
        Loop(b, FakeHand(VirtualClock()), FixedPlace(np.zeros(3)), Calibration.default(), LoopSettings(noise=1.0))


class Moving:
    """An object that moves steadily, seen late by `delay` and thirty times a second."""

    def __init__(self, speed, delay):
        self.speed, self.delay = np.array(speed), delay

    def place(self, now):
        stamp = np.floor((now - self.delay) * 30) / 30
        return np.array([0.055, 0.0, 0.04]) + self.speed * (stamp - 100.0), stamp


@pytest.mark.parametrize("ahead", [0.0, 0.1])
def test_a_cameras_delay_is_made_up_for(made, ahead):
    hand, loop = play(made, ahead=ahead, seconds=0.6, seen=1.0)
    loop.eye, seen = Moving([0.0, 0.0, 0.05], 0.1), []
    observe = loop.measure.observe

    def watch(state, place, *rest):
        seen.append(place[2] - loop.eye.place(hand.clock.now())[0][2])
        return observe(state, place, *rest)

    loop.measure.observe = watch
    loop.run()
    np.testing.assert_allclose(seen[4:], 0.05 * ahead, atol=1e-6)
