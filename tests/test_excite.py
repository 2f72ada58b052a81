"""Excitation: inside every limit, free of self-contact, shuffled, repeatable, and written for a robot to send."""

from __future__ import annotations

import csv

import mujoco
import numpy as np
import pytest
import torch
import yaml
from rig import pendulum_spec

from dexsim import excite
from dexsim.actuator.table import ServoTable
from dexsim.cli.main import main
from dexsim.errors import UserError
from dexsim.recording import excitation, read, safety
from dexsim.recording.excitation import Limits
from dexsim.recording.mechanism import Mechanism, drive, mechanism
from dexsim.recording.schema import Series
from dexsim.recording.waveforms import KINDS, through

torch.set_num_threads(1)
SERVO = {"joints": {"*": {"kp": 2.0, "kd": 0.05, "torque_limit": 0.5, "no_load_speed": 10.0}}}


def rig(low=-1.0, high=1.0):
    spec = pendulum_spec()
    spec.compiler.degree = False
    spec.joint("joint").limited = mujoco.mjtLimited.mjLIMITED_TRUE
    spec.joint("joint").range = [low, high]
    return Mechanism(spec, ("joint",), ServoTable.from_dict(SERVO), "rig")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("a, v", [(0.8, 4.0), (0.05, 0.3), (0.3, 8.0)])
def test_waveforms_keep_amplitude_and_speed_and_rest_at_the_ends(kind, a, v):
    dt = 0.01
    x = KINDS[kind](a, v, dt, np.random.default_rng(0))
    assert abs(x[0]) < 1e-12 and abs(x[-1]) < 1e-9 and np.abs(x).max() <= a * (1 + 1e-9)
    assert np.abs(x).max() > 0.3 * a or kind in ("ladder", "chirp")
    if kind != "steps":
        assert np.abs(np.diff(x)).max() / dt <= 1.02 * v


def test_triangles_run_at_one_speed():
    x = through((0.4, -0.4), 0.2, 0.01)
    moving = np.abs(np.diff(x))[np.abs(np.diff(x)) > 1e-9] / 0.01
    assert moving.min() > 0.19 and moving.max() <= 0.2 + 1e-9 and len(x) == pytest.approx(800, abs=6)


@pytest.fixture(scope="module")
def plan():
    return excitation.plan(rig(), seed=1)


@pytest.fixture(scope="module")
def short():
    return excitation.plan(rig(), seed=2, kinds=("steps", "chirp"), repeats=0)


@pytest.fixture(scope="module")
def wide():
    return excitation.plan(rig(), kinds=("ladder", "steps"), repeats=0)


@pytest.mark.slow
def test_a_plan_keeps_its_limits(plan):
    m = plan.mechanism
    low, high = m.limits.T
    margin = 0.05 * (high - low)
    assert (plan.value >= low + margin - 1e-9).all() and (plan.value <= high - margin + 1e-9).all()
    assert plan.peaks.speed.max() <= 0.6 and plan.peaks.torque.max() <= 0.8 and not plan.peaks.contacts
    smooth = [s for s in plan.segments if s.kind != "steps"]
    for s in smooth:
        assert np.abs(np.diff(s.command, axis=0)).max() * 100 <= 0.6 * 10.0 * 1.02
    # and at a finer step than the one it was checked at
    run = drive(m, Series(plan.t, plan.value), m.joints, float(plan.t[-1]), plan.home, 0.0025)
    assert np.abs(run.velocity).max() <= 0.62 * 10.0 and np.abs(run.torque).max() <= 0.82 * 0.5
    assert (run.position > low).all() and (run.position < high).all()


@pytest.mark.slow
def test_every_kind_comes_and_one_repeats(plan):
    kinds = [s.kind for s in plan.segments]
    assert set(kinds) == set(KINDS) and len(kinds) == len(KINDS) + 1
    (again,) = [s for s in plan.segments if s.repeats is not None]
    first = plan.segments[again.repeats]
    np.testing.assert_array_equal(
        plan.value[round(again.start * 100) : round(again.end * 100)],
        plan.value[round(first.start * 100) : round(first.end * 100)],
    )


@pytest.mark.slow
def test_the_seed_decides_the_order(short):
    again = excitation.plan(rig(), seed=2, kinds=("steps", "chirp"), repeats=0)
    np.testing.assert_array_equal(short.value, again.value)
    orders = {tuple(s.kind for s in short.segments)}
    for k in (3, 4):
        other = excitation.plan(rig(), seed=k, kinds=("steps", "chirp"), repeats=0)
        orders.add(tuple(s.kind for s in other.segments))
    assert len(orders) > 1


def test_tighter_limits_make_smaller_motions(wide):
    tight = excitation.plan(rig(), kinds=("ladder", "steps"), repeats=0, limits=Limits(speed=0.2, torque=0.3))
    assert tight.peaks.speed.max() <= 0.2 and tight.peaks.torque.max() <= 0.3

    def step(p):
        (s,) = [s for s in p.segments if s.kind == "steps"]
        return np.abs(np.diff(s.command[:, 0])).max()

    def rate(p):
        (s,) = [s for s in p.segments if s.kind == "ladder"]
        return np.abs(np.diff(s.command[:, 0])).max()

    assert step(tight) < 0.5 * step(wide) and rate(tight) < 0.5 * rate(wide)


def two_links(gap):
    """Return two parallel fingers that meet when the first swings more than `gap` rad toward the second."""
    x = 0.1 * np.sin(gap) + 0.02
    joint = 'axis="0 1 0" range="-1 1" limited="true"'
    geom = 'type="capsule" size="0.01" mass="0.02" contype="4" conaffinity="8"'
    xml = f"""<mujoco><compiler angle="radian"/><worldbody>
      <body name="one"><joint name="a" {joint}/><geom {geom} fromto="0 0 0.02 0 0 -0.1"/></body>
      <body name="two" pos="{x} 0 0"><joint name="b" {joint}/><geom {geom} fromto="0 0 -0.08 0 0 -0.12"/></body>
    </worldbody></mujoco>"""
    return Mechanism(mujoco.MjSpec.from_string(xml), ("a", "b"), ServoTable.from_dict(SERVO), "two")


def test_no_motor_draws_more_than_the_current_that_is_allowed(wide):
    m = wide.mechanism
    per = excitation.current_per_torque(m)
    stall = m.column("torque_limit")
    drawn = wide.peaks.torque * stall * per
    allowed = 0.6 * float(drawn.max())
    held = excitation.plan(rig(), kinds=("ladder", "steps"), repeats=0, limits=Limits(current=allowed))
    assert (held.peaks.torque * stall * per).max() <= allowed + 1e-6 < drawn.max()
    with pytest.raises(UserError, match="current=0.0"):
        excitation.plan(rig(), limits=Limits(current=0.0))


@pytest.mark.slow
def test_bodies_that_would_meet_are_kept_apart():
    # the model's own filter would let them pass through each other: the check must not
    m = two_links(0.3)
    check = safety.ContactCheck(m, np.zeros(2), 0.002)
    assert check.near(np.zeros(2)) == []
    side = -1 if check.near(np.array([-0.6, 0.0])) else 1
    assert check.near(np.array([side * 0.6, 0.0])) == [("one", "two")]
    p = excitation.plan(m, kinds=("triangles", "random"), seed=3, repeats=0)
    assert not p.peaks.contacts and np.ptp(p.value, axis=0).min() > 0.1
    independent = safety.ContactCheck(m, np.zeros(2), 0.0)
    assert not any(independent.near(q) for q in p.value)
    assert np.abs(side * p.value[:, 0]).max() > 0.1 and (side * p.value[:, 0]).max() < 0.6


def test_joints_of_one_finger_take_turns():
    m = mechanism()
    found = excitation.groups(m, m.joints)
    assert found == [
        ("thumb_bend_joint", "index_bend_joint", "mid_joint1", "ring_joint1", "pinky_joint1"),
        ("thumb_rota_joint1", "index_joint1", "mid_joint2", "ring_joint2", "pinky_joint2"),
        ("thumb_rota_joint2", "index_joint2"),
    ]


@pytest.mark.slow
def test_the_hand_is_moved_without_self_contact(tmp_path, capsys):
    argv = [
        f"out={tmp_path}",
        "joints=index_bend_joint,thumb_bend_joint",
        "kinds=steps,random",
        "seed=4",
        "rate=50",
        "repeats=0",
    ]
    assert excite.main(argv) == 0
    assert "no contact" in capsys.readouterr().out
    m = mechanism()
    commands = read(tmp_path / "excite.mcap")
    assert (
        commands.joints == m.joints
        and len(commands.states.position) == 0
        and "not a measurement" in commands.meta["notes"]
    )
    with open(tmp_path / "excite.csv", newline="") as file:
        rows = list(csv.reader(file))
    assert rows[0] == ["time", *m.joints]
    table = np.array(rows[1:], float)
    np.testing.assert_allclose(table[:, 1:], commands.commands.value, atol=1e-6)
    np.testing.assert_allclose(table[:, 0], commands.commands.t, atol=1e-4)
    still = [k for k, j in enumerate(m.joints) if j not in argv[1]]
    assert np.ptp(commands.commands.value[:, still], axis=0).max() < 1e-12
    about = yaml.safe_load((tmp_path / "excite.yaml").read_text())
    assert {s["kind"] for s in about["segments"]} == {"steps", "random"}
    run = drive(m, Series(table[:, 0], table[:, 1:]), m.joints, table[-1, 0], table[0, 1:], 0.003, frame_s=0.009)
    strict = safety.ContactCheck(m, table[0, 1:], 0.001)
    assert not strict.along(run)
    assert (run.position >= m.limits[:, 0] - 1e-3).all() and (run.position <= m.limits[:, 1] + 1e-3).all()
    simulated = read(tmp_path / "excite_simulated.mcap")
    assert not [f for f in simulated.findings if f.severity == "error"]


def test_the_recording_that_a_diagnosis_asks_for(tmp_path):
    excitation.next_recording(tmp_path / "next_recording.mcap", rig(), ("joint",), ("holds",), seed=5)
    r = read(tmp_path / "next_recording.mcap")
    assert r.joints == ("joint",) and r.commands.t[-1] > 15


@pytest.mark.parametrize("argv, text", [
    (["joints=index_joint1"], "out=DIR"),
    (["out=x", "joint=3"], "expected key=value with one of"),
    (["out=x", "joints=elbow"], "not a driven joint; those are thumb_bend_joint"),
    (["out=x", "kinds=waltz"], "must be among triangles"),
    (["out=x", "speed=2"], "speed=2.0: must be a number from 0.01 to 1"),
    (["out=x", "seed=a"], "seed=a: must be a whole number"),
    *((["out=x", f"seed={v}"], f"seed={v}: must be a whole number from 0") for v in ("nan", "inf", "-1", "1.5")),
    *((["out=x", f"repeats={v}"], f"repeats={v}: must be a whole number from 0 to 20") for v in ("nan", "1e9")),
    *((["out=x", f"rate={v}"], f"rate={v}: must be a number from 20 to 5000") for v in ("nan", "inf", "0", "-1")),
    (["out=x", "model=nowhere.xml"], "nowhere.xml does not exist"),
    (["out=x", "hand_mirror=left"], "hand_mirror=left: must be true or false"),
    (["out=x", "model=a.xml", "hand=xhand"], "model=a.xml: is not moved beside hand="),
])  # fmt: skip
def test_bad_settings(argv, text, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match=text):
        excite.main(argv)


@pytest.mark.slow
def test_a_left_hand_is_moved_and_its_recording_replayed(tmp_path, capsys):
    """hand_mirror: the left xHand's commands, simulated by the left one, and compared with it again."""
    from dexsim.cli import recorded
    from dexsim.paths import CONFIGS

    out = tmp_path / "out"
    argv = ["hand_mirror=true", "joints=index_joint1", "kinds=steps", "repeats=0", f"out={out}"]
    assert excite.main(argv) == 0
    made = read(out / "excite_simulated.mcap")
    assert made.meta["robot"] == "xhand_left" and "index_joint1" in made.joints
    replay = [f"replay={out}/excite_simulated.mcap", "hand_mirror=true", "video=false", f"out={tmp_path}/again"]
    assert recorded.run(recorded.settings(replay, CONFIGS)) == 0
    assert "of xhand_left" in capsys.readouterr().out


def test_a_joint_without_limits_is_refused():
    with pytest.raises(UserError, match="'joint' has no position limits"):
        excitation.plan(Mechanism(pendulum_spec(), ("joint",), ServoTable.from_dict(SERVO), "rig"))


@pytest.mark.slow
def test_a_servo_that_cannot_move_safely_is_refused():
    m = rig()
    m.table = ServoTable.from_dict({"joints": {"*": {"kp": 2.0, "torque_limit": 1e-4, "no_load_speed": 10.0}}})
    with pytest.raises(UserError, match="no motion of joint is safe"):
        excitation.plan(m, kinds=("holds",))


def test_motions_begin_higher_where_a_soft_drive_lets_a_link_sink_onto_a_limit():
    m = rig(-1.0, 0.0)
    m.spec.option.gravity = [-9.81, 0, 0]
    made = excitation.plan(m, kinds=("triangles",))
    sinks = 9.81 * 0.1 * 0.1 / 2.0  # rad: weight over gain
    assert made.home[0] < -0.05 - 0.9 * sinks and made.peaks.excess < excitation.PASSED and not made.left_out


def test_links_that_no_drive_carries_are_said_at_once(monkeypatch):
    m = rig()
    m.spec.option.gravity = [9.81, 0, 0]
    m.table = ServoTable.from_dict({"joints": {"*": {"kp": 2.0, "torque_limit": 1e-3, "no_load_speed": 10.0}}})
    monkeypatch.setattr(excitation, "_motion", None)  # none is tried
    with pytest.raises(UserError, match="rig is not held at rest.*torque of joint reaches"):
        excitation.plan(m)


def test_help(capsys):
    assert main(["excite", "--help"]) == 0
    text = capsys.readouterr().out
    for key in excite.KEYS:
        assert f"{key}=" in text
