"""The audit: silent on a clean recording, and every planted fault found with its topic, time and count."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import recordings

from dexsim.errors import UserError
from dexsim.gap.audit import main
from dexsim.gap.read import inputs
from dexsim.recording import Series, audit_time, mechanism, read, write
from dexsim.recording.audit import KINDS, audit, table
from dexsim.recording.schema import COMMANDS, DUTY


def found(recording, kind):
    return [f for f in audit(recording) if f.kind == kind]


@pytest.mark.parametrize("seed", range(4))
def test_silent_on_a_clean_recording(seed, tmp_path):
    made = recordings.signal(8.0, seed=seed, tactile=True, joints=recordings.HAND if seed % 2 else ("a", "b"))
    if seed % 2:  # inside the hand's narrowest limits
        for s in (made.commands, made.states.position, made.states.velocity):
            s.value *= 0.8
    assert audit(made) == [], table(audit(made))
    write(tmp_path / "a.mcap", made)
    assert read(tmp_path / "a.mcap").findings == []


@pytest.mark.parametrize("quantum", [0.001534, 0.006])
def test_silent_on_a_quantised_recording_that_moves_slowly(quantum):
    made = recordings.signal(20.0)
    made.states.velocity = None
    for s in (made.states.position, made.commands):  # some rest, too
        s.value[700:1200] = s.value[700]
    made.states.position.value = np.round(made.states.position.value / quantum) * quantum
    assert audit(made) == [], table(audit(made))


# Each plants one fault and says what must be found: (kind, topic, joint or "", time or None, count or None).
def gap(r):
    keep = (r.states.position.t < 3.0) | (r.states.position.t > 3.2)
    for s in (r.states.position, r.states.velocity, r.states.effort):
        s.t, s.value, s.stamp = s.t[keep], s.value[keep], s.stamp[keep]
    return "gap", "/joint_states", "", 2.991, 1


def dropped(r):
    keep = np.ones(len(r.states.position), bool)
    keep[100:600:20] = False
    for s in (r.states.position, r.states.velocity, r.states.effort):
        s.t, s.value, s.stamp = s.t[keep], s.value[keep], s.stamp[keep]
    return "dropped", "/joint_states", "", 0.99, 25


def held(r):
    for s in (r.states.position, r.states.velocity, r.states.effort):
        for k in (130, 210, 395, 402, 520):
            s.value[k : k + 3] = s.value[k - 1]
    return "held", "/joint_states", "", None, None


def slow_sensor(r):
    for s in (r.states.position, r.states.velocity, r.states.effort):
        s.value[1::2] = s.value[:-1:2]
    return "held", "/joint_states", "", None, None


def repeated_stamp(r):
    s = r.states.position
    s.stamp[300:310] = s.stamp[299]
    return "held", "/joint_states", "", 3.0, 10


def stuck(r):
    r.states.position.value[:, 1] = 0.05
    return "stuck", "/joint_states", "b", 0.0, 800


def stuck_effort(r):
    r.states.position.value[:, 0] *= 0.3  # far from its target, without a current
    r.states.effort.value[:, 0] = 0.0
    return "stuck", "/joint_states", "a", 0.001, 800


def wrap16(r):
    e = r.states.effort
    e.value[:, 0] = np.mod(np.round(1000 * e.value[:, 0]), 65536)
    return "wrap", "/joint_states", "a", None, int((e.value[:, 0] > 32768).sum())


def wrap16_in_amperes(r):
    e = r.states.effort
    e.value[:, 0] = 1e-3 * np.mod(np.round(1000 * e.value[:, 0]), 65536)
    return "wrap", "/joint_states", "a", None, int((e.value[:, 0] > 32.768).sum())


def wrapped_duty(r):
    t = r.commands.t
    r.duty = Series(t, np.mod(np.round(885 * 0.4 * np.sin(3 * t)), 65536)[:, None] / 885 * np.ones(2), DUTY)
    return "wrap", "/joint_duty", "b", None, int((r.duty.value[:, 1] > 1).sum())


def wrapped_angle(r):
    p = r.states.position
    p.value[:, 0] = np.mod(p.value[:, 0] + np.pi + 3.1, 2 * np.pi) - np.pi
    return "wrap", "/joint_states", "a", None, None


def wrapped_taxels(r):
    x = r.tactile.value
    x[..., 0] = np.mod(np.round(20 * np.sin(r.tactile.t))[:, None, None], 256)
    return "wrap", "/tactile", "", None, int((x[..., 0] > 128).sum())


def saturated_taxels(r):
    r.tactile.value[100:150, 2, 7, 2] = 255
    return "saturation", "/tactile", "", 1.0, 50


def saturated_effort(r):
    e = r.states.effort
    limit = 0.4 * e.value[:, 0].max()
    e.value[:, 0] = np.minimum(e.value[:, 0], limit)
    return "saturation", "/joint_states", "a", None, int((e.value[:, 0] == limit).sum())


def lost_sign(r):
    r.states.effort.value[:, 1] = np.abs(r.states.effort.value[:, 1])
    return "lost_sign", "/joint_states", "b", 0.001, 800


def wrong_sign(r):
    r.states.effort.value[:, 1] *= -1
    return "sign_mismatch", "/joint_states", "b", None, None


def degrees(r):
    r.states.position.value *= 180 / np.pi
    r.states.velocity = None
    return "unit", "/joint_states", "a", None, 800


def degrees_of_a_weak_drive(r):
    r.commands.value *= 4.0
    r.states.position.value *= 4.0 * 0.8 * 180 / np.pi  # it goes four fifths of the way that it is asked
    r.states.velocity = None
    return "unit", "/joint_states", "a", None, 800


def degrees_commanded(r):
    r.commands.value *= 180 / np.pi
    return "unit", "/joint_commands", "a", None, 800


def counts(r):
    r.states.position.value = np.round(r.states.position.value * 4096 / (2 * np.pi)) + 2048
    r.states.velocity = None
    return "unit", "/joint_states", "a", None, 800


def degrees_a_second(r):
    r.states.velocity.value *= 180 / np.pi
    return "unit", "/joint_states", "b", None, 800


def milliamperes(r):
    r.states.effort.value = np.round(1000 * r.states.effort.value)
    return "unit", "/joint_states", "a", None, 800


def percent(r):
    r.duty = Series(r.commands.t, 40 * np.sin(3 * r.commands.t)[:, None] * np.ones(2), DUTY)
    return "unit", "/joint_duty", "", None, None


def millivolts(r):
    r.supply_voltage.value *= 1000
    return "unit", "/supply_voltage", "", 0.0, 80


def kelvin(r):
    r.temperature.value += 273.15
    return "unit", "/joint_temperatures", "", 0.0, 160


def millimetres(r):
    r.object_pose.value[:, :3] *= 1000
    return "unit", "/object_pose", "", 0.0, 800


def in_g(r):
    r.imu.value[:, 7:] /= 9.81
    return "unit", "/imu", "", 0.0, 800


def nan(r):
    r.states.position.value[50:60, 0] = np.nan
    return "nan", "/joint_states", "a", 0.501, 10


def late_clock(r):
    for s in (r.states.position, r.states.velocity, r.states.effort):
        s.stamp = s.stamp - 0.25
    return "clock_skew", "/joint_states", "", None, None


def drifting_clock(r):
    for s in (r.states.position, r.states.velocity, r.states.effort):
        s.stamp = s.stamp * 1.002
    return "clock_skew", "/joint_states", "", 0.001, 800


def state_before_command(r):
    for s in (r.states.position, r.states.velocity, r.states.effort):
        s.t, s.stamp = s.t - 0.1, None
    r.commands.stamp = None
    return "clock_skew", "/joint_states", "", None, None


def shifted_topic(r):
    r.tactile.t = r.tactile.t + 1.5
    return "clock_skew", "/tactile", "", 1.5, 800


def repeated_time(r):
    s = r.states.position
    s.t[400:405] = s.t[399]
    return "time_repeated", "/joint_states", "", 3.991, 5


def buffered(r):
    s = r.states.position
    s.t = s.t[(np.arange(len(s)) // 4) * 4] + 1e-5 * (np.arange(len(s)) % 4)
    s.stamp = None
    return "burst", "/joint_states", "", None, None


def spike(r):
    r.states.position.value[333, 1] += 2.0
    return "spike", "/joint_states", "b", 3.331, 1


FAULTS = (
    gap,
    dropped,
    held,
    slow_sensor,
    repeated_stamp,
    stuck,
    stuck_effort,
    wrap16,
    wrap16_in_amperes,
    wrapped_duty,
    wrapped_angle,
    wrapped_taxels,
    saturated_taxels,
    saturated_effort,
    lost_sign,
    wrong_sign,
    degrees,
    degrees_of_a_weak_drive,
    degrees_commanded,
    counts,
    degrees_a_second,
    milliamperes,
    percent,
    millivolts,
    kelvin,
    millimetres,
    in_g,
    nan,
    late_clock,
    drifting_clock,
    state_before_command,
    shifted_topic,
    repeated_time,
    buffered,
    spike,
)


@pytest.mark.parametrize("plant", FAULTS, ids=lambda f: f.__name__)
def test_a_planted_fault_is_found(plant):
    r = recordings.signal(8.0, tactile=True)
    kind, topic, joint, when, count = plant(r)
    findings = audit(r)
    hits = [f for f in findings if f.kind == kind and f.topic == topic and (not joint or f.joint == joint)]
    assert hits, f"{kind} not among:\n{table(findings)}"
    if when is not None:
        assert hits[0].time == pytest.approx(when, abs=2e-3)
    if count is not None:
        assert hits[0].count == count
    assert all(f.kind in KINDS for f in findings)


def test_a_recording_with_positions_only_is_told_at_once(tmp_path, capsys):
    """In a CSV and in an MCAP, and where the column of the commands is empty; the fix stands in each message."""
    t = np.arange(0.0, 6.0, 0.01)
    rows = [f"{x:.2f},{0.3 * np.sin(2 * x):.5f}" for x in t]
    (tmp_path / "a.csv").write_text("time,position.elbow\n" + "\n".join(rows) + "\n")
    (tmp_path / "b.csv").write_text("time,position.elbow,command.elbow\n" + "\n".join(f"{x}," for x in rows) + "\n")
    made = recordings.signal(6.0)
    made.commands = Series.empty(COMMANDS, 2)
    write(tmp_path / "c.mcap", made)
    for name in ("a.csv", "b.csv", "c.mcap"):
        assert main([str(tmp_path / name)]) == 1
        out = capsys.readouterr().out
        assert "no commands: diagnose and replay cannot use this recording" in out and "a column command.JOINT" in out
        assert out.count("missing_topic") == 1, out
    (tmp_path / "d.csv").write_text("time,position.elbow,command.elbow\n" + "\n".join(f"{x},0.1" for x in rows) + "\n")
    assert found(read(tmp_path / "d.csv"), "missing_topic") == []


def test_touch_without_commands_is_no_error(tmp_path, capsys):
    """`calibrate touch` reads it: the audit says what it can not be used for, and ends with status 0."""
    made = recordings.signal(6.0, tactile=True)
    made.commands = Series.empty(COMMANDS, 2)
    write(tmp_path / "touch.mcap", made)
    assert main([str(tmp_path / "touch.mcap")]) == 0
    out = capsys.readouterr().out
    assert "no commands: calibrate touch can use this recording, diagnose and replay cannot" in out
    assert "a column command.JOINT" in out and [f.severity for f in read(tmp_path / "touch.mcap").findings
                                                if f.kind == "missing_topic"] == ["warning"]  # fmt: skip


def test_without_commands_diagnosis_and_replay_say_what_to_log(tmp_path):
    made = recordings.signal(6.0, joints=("knuckle",))
    made.commands = Series.empty(COMMANDS, 1)
    model = SimpleNamespace(joints=("knuckle",), hand=None)
    for use, error in ((lambda: inputs.to_run(made, model, []), inputs.Unusable),
                       (lambda: mechanism.replay(made, model), UserError)):  # fmt: skip
        with pytest.raises(error, match=r"\(in a CSV: a column command\.JOINT\)"):
            use()


def test_sixteen_bits_wrapped_at_high_gain(tmp_path):
    # as a chattering drive shows it: many wraps, few values near zero
    r = recordings.signal(8.0, joints=("a",))
    t = r.commands.t
    x = np.round(800 * np.sign(np.sin(40 * t)) * (0.3 + 0.7 * np.random.default_rng(0).random(len(t))))
    r.duty = Series(t, np.mod(x, 65536)[:, None] / 885, DUTY)
    (f,) = found(r, "wrap")
    assert f.count == int((x < 0).sum())


def test_stick_and_slip_is_not_a_stale_reading():
    r = recordings.signal(10.0, joints=("a",))
    q = r.states.position.value[:, 0]
    stuck_at = np.round(q / 0.05) * 0.05  # jumps, and rests exactly between them
    r.states.position.value[:, 0] = stuck_at
    assert not found(r, "held")


def test_a_drive_inside_its_deadband_is_not_stuck():
    r = recordings.signal(8.0)
    r.states.effort.value[:, 0] = 0.0
    r.states.position.value[:, 0] = r.commands.value[:, 0] + 1e-3
    assert not found(r, "stuck")


def test_time_that_goes_backwards_is_reported_and_ordered(tmp_path):
    made = recordings.signal(2.0)
    s = made.states.position
    s.t[[100, 101]] = s.t[[101, 100]]
    s.stamp = None
    made.states.velocity = made.states.effort = None
    write_unsorted(tmp_path / "a.mcap", made)
    r = read(tmp_path / "a.mcap")
    (f,) = [f for f in r.findings if f.kind == "time_not_monotonic"]
    assert f.count == 1 and f.topic == "/joint_states" and f.time == pytest.approx(1.001)
    assert (np.diff(r.states.position.t) > 0).all()


def write_unsorted(path, made):
    from dexsim.recording import Writer

    with Writer(path, made.joints, made.meta, made.start_ns) as w:
        for i, t in enumerate(made.commands.t):
            w.add_command(t, made.commands.value[i])
            w.add_state(made.states.position.t[i], made.states.position.value[i])


def test_the_command_line(tmp_path, capsys):
    made = recordings.signal(4.0)
    write(tmp_path / "good.mcap", made)
    assert main([str(tmp_path / "good.mcap")]) == 0
    assert "no findings" in capsys.readouterr().out
    lost_sign(made)
    write(tmp_path / "bad.mcap", made)
    assert main([str(tmp_path / "bad.mcap")]) == 1
    out = capsys.readouterr().out
    assert "lost_sign" in out and "/joint_states" in out
    assert main(["--help"]) == 0 and "wrap" in capsys.readouterr().out


@pytest.mark.parametrize("unit", [1e3, 1e-3, 1e6])
def test_times_of_two_units_are_said(unit):
    r = recordings.signal(3.0)
    assert not [f for f in audit_time.between_topics(r) if "another unit" in f.text]
    r.states.position.t = r.states.position.t * unit
    said = [f for f in audit_time.between_topics(r) if "another unit" in f.text]
    assert {(f.kind, f.severity) for f in said} == {("clock_skew", "error")}
    assert r.commands.topic in [f.topic for f in said]


def test_commands_after_the_last_state_are_said(tmp_path):
    """Of 4 s the states end after 3: so `dexsim audit` says, and `diagnose` in its notes."""
    from dexsim.gap import inquiry
    from dexsim.gap.audit import begin
    from dexsim.gap.compute import TimeLimit

    r = recordings.signal(4.0)
    assert not list(audit_time.between_topics(r))
    r.states.position = r.states.position.take(r.states.position.t <= 3.0)
    (f,) = audit_time.between_topics(r)
    assert (f.kind, f.topic, f.severity) == ("gap", COMMANDS, "warning") and 2.99 < f.time < f.end
    assert f.text.startswith("commands go on for 0.9") and f"{f.count} of {len(r.commands)} are left out" in f.text
    write(tmp_path / "a.mcap", r)
    begin(tmp_path / "rig", r.joints, own := {})
    s = inquiry.Settings([tmp_path / "a.mcap"], tmp_path / "out", None, own["model"], own["servo"])
    w = inquiry.Inquiry(s, print, None, TimeLimit(None))
    inquiry.read_files(w)
    inquiry.to_runs(w)
    assert f"a.mcap: {f.text}" in w.notes


@pytest.mark.parametrize(("sign", "lag"), [(1, 0.05), (1, 0.17), (-1, 0.05)])
def test_a_narrow_band_is_no_other_clock(sign, lag):
    """Of a sweep from 4 to 5 Hz three quarters of a period behind is a quarter before, and so is half of one with the
    sign lost; of a wide one what comes first does."""
    t, made = np.arange(0, 12, 0.01), recordings.signal(3.0)
    for turns, seen in ((4 * t + t**2 / 24, None), (0.1 * t + t**2 / 6, 0.06)):
        target = 0.3 * np.sin(2 * np.pi * turns)
        value = sign * np.interp(t - lag, t, target) if seen is None else np.interp(t + seen, t, target)
        made.commands, made.states.position = (Series(t, np.stack([x] * len(made.joints), 1), COMMANDS, None)
                                               for x in (target, value))  # fmt: skip
        lead = audit_time.command_lead(made)
        if seen is None:
            assert lead is None or lead < 0
        else:
            assert lead == pytest.approx(seen, abs=0.011)
