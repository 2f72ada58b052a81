"""A setpoint that a firmware moves at a limited speed and acceleration: its law, and that it is found and named."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import test_gap
import torch
import yaml

from dexsim.actuator.columns import COLUMNS, INDEX
from dexsim.actuator.reference import Step, setpoint
from dexsim.actuator.setpoint import setpoints
from dexsim.actuator.table import ServoTable
from dexsim.cli import start
from dexsim.gap.diagnosis import Settings, diagnose, save
from dexsim.gap.judge.full_model import free_runs, worlds_of
from dexsim.gap.plant.case import build
from dexsim.gap.read import Run
from dexsim.paths import CONFIGS
from dexsim.recording import write
from dexsim.recording.mechanism import STEP, drive, mechanism, recorded, replay
from dexsim.recording.realistic import Hardware, realistic
from dexsim.recording.schema import COMMANDS, Series
from dexsim.tasks import make_env


def path(targets, dt, speed=np.inf, acceleration=np.inf, start=0.0):
    """Return setpoints [n] after each step towards targets [n], from rest at `start`."""
    p = {c.name: c.neutral for c in COLUMNS} | {"profile_speed": speed, "profile_acceleration": acceleration}
    step, out = Step(), []
    step.dt = dt
    for k, target in enumerate(targets):
        step.fresh = k == 0
        out.append(float(setpoint(p, np.array(float(target)), np.array(start), step)))
    return np.array(out)


@pytest.mark.parametrize("dt", [0.0005, 0.002])
@pytest.mark.parametrize(("speed", "acceleration"), [(2.0, np.inf), (2.0, 10.0), (np.inf, 10.0), (0.5, 40.0)])
def test_a_step_takes_as_long_as_a_trapezoid(dt, speed, acceleration):
    """T = D / v + v / a, or 2 sqrt(D / a) where the speed is not reached (Lynch and Park, Modern Robotics, 9.2.2.2);
    nothing overshoots, and both limits hold."""
    size = 0.9
    x = path(np.full(round(3 / dt), size), dt, speed, acceleration)
    reached = speed**2 / acceleration <= size
    takes = size / speed + (speed / acceleration if np.isfinite(acceleration) else 0.0) if reached else (
        2 * np.sqrt(size / acceleration))  # fmt: skip
    arrived = np.flatnonzero(x > size - 1e-6)[0] * dt
    assert arrived == pytest.approx(takes, abs=8 * dt) and x.max() <= size + 1e-4
    v = np.diff(x) / dt
    assert np.abs(v).max() <= min(speed, np.sqrt(size * acceleration)) * 1.001
    assert np.abs(np.diff(v)).max() <= acceleration * dt * 1.001 or not np.isfinite(acceleration)


def test_a_slow_motion_is_followed_as_far_behind_as_it_could_stop():
    """A setpoint that is ready to stop at its target goes v^2 / 2a behind one that moves at v."""
    t = np.arange(0, 4, 0.002)
    target = 0.4 * np.sin(2 * t)
    x = path(target, 0.002, 2.0, 50.0)
    assert np.abs(x - target)[500:].max() == pytest.approx(0.8**2 / (2 * 50.0), rel=0.15)
    assert np.array_equal(path(target, 0.002), target)


def test_a_target_that_turns_back_is_followed_within_the_limits():
    target = np.r_[np.full(150, 1.0), np.full(850, -1.0)]
    x = path(target, 0.002, 3.0, 20.0)
    v = np.diff(x) / 0.002
    assert np.abs(np.diff(v)).max() <= 20.0 * 0.002 * 1.001 and x[-1] == pytest.approx(-1.0) and x.min() >= -1 - 1e-3


BOTH = {"profile_speed": 2.2, "profile_acceleration": 14.0}


def test_a_setpoint_is_known_at_any_time_and_goes_on_from_there():
    """The law alone over the commands is the reference's, step by step, and the reference goes on from what it says."""
    dt, way, limits = 0.002, 0.4 * np.sign(np.sin(5 * np.arange(0, 3, 0.002))) + 0.5, (2.0, 12.0)
    whole, p = path(way, dt, *limits), {c.name: c.neutral for c in COLUMNS}
    p |= {"profile_speed": limits[0], "profile_acceleration": limits[1]}
    rows = np.array([list(p.values()), [c.neutral for c in COLUMNS]])
    times = np.array([0.9, 0.0, 2.2])
    x, free = setpoints(rows, np.zeros((2, 2)), dt * np.arange(len(way)), way[:, None], 0.0, times, dt)
    assert np.isnan(free).all() and np.isnan(x[1]).all()  # no profile, or nothing was sent before
    for (at, speed), time in zip(x[[0, 2]], times[[0, 2]], strict=True):
        k = round(time / dt)
        assert at == pytest.approx(whole[k - 1], abs=2e-3) and abs(at - way[k]) > 0.02
        step = Step(dt, True, {"setpoint": at, "setpoint_speed": speed, "setpoint_new": -1.0})
        on = []
        for target in way[k:]:
            on.append(float(setpoint(p, np.array(target), np.array(9.0), step)))
            step.fresh = False
        assert np.abs(np.array(on) - whole[k:]).max() < 2e-3


@pytest.mark.parametrize("profile", [pytest.param({"profile_speed": 1.2}, marks=pytest.mark.slow), BOTH])
def test_what_begins_in_the_middle_of_a_motion_goes_on_as_it_did(profile):
    """A replay, a world of a batch and a search's window from any time on move as what began with the recording: their
    setpoint is where the commands until then have brought it, by each guess's own profile."""
    believed = ServoTable.from_dict({"joints": {"*": test_gap.SERVO | {"delay": 0.02} | profile}})
    m, t = test_gap.mechanism_of(believed), np.arange(0, 4, 0.01)
    way = np.repeat([0.2, 1.3, -0.6, 0.9, -0.9, 0.8, 0.1, 0.9], 50)
    sent = Series(t, way[:, None], COMMANDS, t.copy())
    whole = drive(m, sent, ["joint"], 4.0, way[:1], timestep=5e-4)
    made = recorded(whole, m, sent, ["joint"])
    for begin in (0.8, 1.8, 3.3):  # joint and setpoint are on their way
        again = replay(made, m, start=begin)
        q = np.interp(again.t, whole.t, whole.position[:, 0])
        assert np.abs(again.position[:, 0] - q).max() < 1e-3, begin
    run = Run("a", ("joint",), t, way[:, None], whole.t[::10], whole.position[::10], believed, np.array([0, 0, -9.81]))
    run.smooth()
    case = build(test_gap.model(), [run])[0]
    part = case.plant.windows(None, span={0: (1.8, 2.7)})
    worlds = worlds_of(m, [run], {"a": made}, [case], believed, part)
    q = free_runs(m.spec, ["joint"], worlds)[0][:1600, 0]
    assert np.abs(q - np.interp(1.8 + STEP * np.arange(1600), whole.t, whole.position[:, 0])).max() < 1e-3
    windows, guess = case.plant.windows(0.4), np.repeat(case.plant.base()[None], 2, 0)
    guess[1, :, INDEX["profile_speed"]] = 0.5
    right, slow = case.plant.simulate(guess, windows)[0] - case.plant.q[windows.sample_row]
    assert np.sqrt(np.mean(right**2)) < 2e-3 and np.sqrt(np.mean(slow**2)) > 0.1


def test_a_step_that_a_recording_begins_with_acts_after_its_delay():
    """What was sent before is not known: a search's plant holds the joint where it rests until the step acts, as a
    replay does; it is not in force from the begin on."""
    believed = ServoTable.from_dict({"joints": {"*": test_gap.SERVO | {"delay": 0.05, "profile_speed": 3.0}}})
    m, t = test_gap.mechanism_of(believed), np.arange(0, 1.5, 0.01)
    sent = Series(t, np.full((len(t), 1), 0.7), COMMANDS, t.copy())
    whole = drive(m, sent, ["joint"], 1.5, np.zeros(1), timestep=5e-4)
    made = recorded(whole, m, sent, ["joint"])
    q = whole.position[::10]
    run = Run("a", ("joint",), t, sent.value, whole.t[::10], q, believed, np.array([0, 0, -9.81]))
    run.smooth()
    case = build(test_gap.model(), [run])[0]
    windows = case.plant.windows(None)
    plant, seen = case.plant.simulate(case.plant.base()[None], windows)[0][0], case.plant.q[windows.sample_row]
    assert np.abs(q[whole.t[::10] < 0.05]).max() < 1e-3 and q[-1] > 0.6
    assert np.abs(plant - seen).max() < 2e-3
    again = replay(made, m)
    assert np.abs(again.position[:, 0] - np.interp(again.t, whole.t, whole.position[:, 0])).max() < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize(("changes", "seed"), [({"profile_speed": 1.6}, 0), (BOTH, 1)])
def test_a_planted_profile_is_named_and_sized(changes, seed):
    outcome = test_gap.search(changes, kinds=(1 + seed, 3), seconds=3.0)
    assert outcome.best.ids[0] == "setpoint_profile", (outcome.best.ids, outcome.scanned[:4])
    for column, value in changes.items():
        key = column.removeprefix("profile_")
        assert outcome.best.fit.value(f"setpoint_profile.{key}") == pytest.approx(value, rel=0.15)


FINGER = """<mujoco><compiler angle="radian"/><worldbody><body><joint name="index" axis="0 1 0" range="0 1.47"
armature="2e-4"/><geom type="capsule" fromto="0 0 0 0 0 .08" size=".007" mass=".02" contype="0" conaffinity="0"/></body>
</worldbody></mujoco>"""
REAL = Path(__file__).resolve().parents[2] / "shared" / "realdata" / "rh56" / "index_step.csv"


@pytest.mark.slow
@pytest.mark.skipif(not REAL.exists(), reason="the recording of an RH56 finger is not here")
def test_the_speed_of_a_real_finger_is_its_firmwares(tmp_path):
    """An Inspire RH56's finger goes 492 counts at a steady 2070 a second, 44 ms after its command: 3.04 rad/s.
    Its position is new every 20 ms, and of its one motion nothing can be held out: the name is doubted, and so said."""
    (tmp_path / "finger.xml").write_text(FINGER)
    (tmp_path / "finger.yaml").write_text("joints: {'*': {kp: 3.0, kd: 0.05, torque_limit: 0.6}}")
    d = diagnose(Settings([REAL], tmp_path / "out", model=str(tmp_path / "finger.xml"), next_recording=False,
                          servo=str(tmp_path / "finger.yaml"), meta={"units.position": "registers=1.47..0"},
                          allowed={"setpoint_profile", "command_delay", "lag"}),
                 say=lambda _: None)  # fmt: skip
    stale, found = d.data["findings"][:2]
    assert stale["effect"] == "bad_channel" and "every 20.1 ms" in stale["regime"]
    assert found["effect"] == "setpoint_profile" and 0.5 <= found["confidence"] <= 0.7
    assert found["parameters"]["speed"]["value"] == pytest.approx(3.04, rel=0.1)
    assert d.data["verdict"] == "partly_explained" and "nothing that moves could be held out" in d.sentence
    assert d.data["held_out"]["after"] < 0.1 * d.data["held_out"]["before"]
    # its dead time is beside its speed, and the files replayed miss what is reported
    late = next(f for f in d.data["findings"] if f["effect"] == "command_delay")
    assert late["parameters"]["delay"]["value"] == pytest.approx(0.0445, abs=0.005)
    assert d.data["held_out"]["replayed"]["error"] == pytest.approx(d.data["held_out"]["after"], rel=0.1)


def drive_in_training(servo):
    """Return the speeds [6, 4] rad/s of a joint of a hand in training whose target moves at 3.3 rad/s."""
    cfg = start.for_train(["task=grasp", "device=cpu", f"servo_file={servo}"], CONFIGS).cfg
    env = make_env(cfg, 4, "cpu", 0, "mujoco")
    j, q, action = env.hand.joints.index(JOINT), [], torch.zeros(4, 12)
    action[:, j] = 1.0
    for _ in range(7):
        env.step(action)
        q.append(env.q[:, j].clone())
    return torch.stack(q).diff(dim=0) / (env.decimation * env.engine.mjm.opt.timestep)


JOINT, TIMES = "index_joint1", np.arange(0, 6, 0.01)


def servo_with(profile, path):
    """Return a path to the believed servo of the hand with a profile of one joint."""
    table = yaml.safe_load((CONFIGS / "servo" / "xhand.yaml").read_text())
    table["joints"].setdefault(JOINT, {}).update(profile)
    path.write_text(yaml.safe_dump(table))
    return path


@pytest.mark.slow
def test_a_fitted_profile_is_what_the_drive_in_training_has(tmp_path):
    """A servo.yaml with `profile_speed` as a diagnosis writes it, with its interval, given to training: no joint goes
    faster than its profile, each world by one within the interval; without it the joint follows."""

    def speeds(profile):
        return drive_in_training(servo_with(profile, tmp_path / "servo.yaml"))

    slow = speeds({"profile_speed": {"value": 0.6, "low": 0.5, "high": 0.7}})
    assert speeds({})[-1].min() > 2.5 and slow.max() < 0.75
    assert slow[-1].median() > 0.4 and slow[-1].std() > 0.02  # it moves, each world at a speed of its own
    assert speeds({"profile_speed": {"value": 0.6, "low": 0.6, "high": 0.6}})[-1].max() < 0.62


@pytest.mark.slow
def test_a_profile_in_recordings_of_a_hand_reaches_its_training(tmp_path):
    """Recordings of a hand whose firmware moves one joint's setpoint at 1.4 rad/s: `diagnose` names that, and training
    with the servo.yaml that it writes drives the joint at that speed. Where it is believed, nothing is missing."""
    true, t, paths = mechanism(None, str(servo_with({"profile_speed": 1.4}, tmp_path / "true.yaml"))), TIMES, []
    steps = np.repeat([0.2, 1.3, 0.5, 1.5, 0.1, 0.9], 100)
    for k, way in enumerate((steps, 0.8 + 0.6 * np.sin(4 * t), np.roll(steps, 250) * 0.9, 0.7 + 0.5 * np.sin(6 * t))):
        way = np.where(t < 0.2, 0.0, way)  # at rest where it is recorded first
        sent = Series(t, way[:, None], COMMANDS, t.copy())
        made = realistic(recorded(drive(true, sent, [JOINT], 6.0, timestep=0.001), true, sent, [JOINT]), seed=k,
                         hardware=Hardware())  # fmt: skip
        made.meta["servo"] = ""  # what is hidden is not told
        paths.append(tmp_path / f"m{k}.mcap")
        write(paths[-1], made)
    settings = Settings(paths, tmp_path / "out", joints={JOINT}, next_recording=False)
    d = diagnose(settings, say=lambda _: None)
    save(d, tmp_path / "out")
    believed = diagnose(dataclasses.replace(settings, servo=str(tmp_path / "true.yaml")), say=lambda _: None)
    assert believed.data["verdict"] == "none", believed.sentence
    first = d.data["findings"][0]
    assert first["effect"] == "setpoint_profile" and first["where"]["joints"] == [JOINT], d.sentence
    assert first["parameters"]["speed"]["value"] == pytest.approx(1.4, rel=0.05)
    files = (CONFIGS / "servo" / "xhand.yaml", tmp_path / "out" / "servo.yaml")
    before, found = (drive_in_training(x)[-1] for x in files)
    assert before.min() > 2.5 and 1.1 < found.median() < 1.5 and found.max() < 1.7
