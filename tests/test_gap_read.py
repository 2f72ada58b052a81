"""What is read of recordings for the gap: one that is bad spoils itself only."""

from __future__ import annotations

import json

import mujoco
import numpy as np
import pytest

from dexsim.actuator.table import ServoTable
from dexsim.gap import demo
from dexsim.gap.diagnosis import Settings, diagnose, save
from dexsim.gap.plant.case import build
from dexsim.gap.plant.columns import SERIES_INDEX
from dexsim.gap.read import Run, channels, inputs
from dexsim.gap.rules import JUDGE, SIGNAL
from dexsim.recording import read, write

TWO = """<mujoco><worldbody><body name="upper"><joint name="a" axis="0 1 0"/>
 <geom type="capsule" fromto="0 0 0 0 0 -.1" size=".01" mass=".1"/>
<body name="lower" pos="0 0 -.1"><joint name="b" axis="0 1 0"/>
 <geom type="capsule" fromto="0 0 0 0 0 -.1" size=".01" mass=".05"/></body></body>
</worldbody></mujoco>"""
SERVO = {"joints": {"*": {"kp": 2.0, "kd": 0.1, "torque_limit": 2.0}}}


def run_of(name: str, seed: int, seconds: float = 6.0, rate: float = 100.0) -> Run:
    """Return two joints that follow smooth targets with a lag of 30 ms."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, seconds, 1 / rate)
    f = rng.uniform(0.3, 0.9, 2)
    at = lambda x: 0.4 * np.sin(2 * np.pi * f * x[:, None] + seed)  # noqa: E731
    return Run(name, ("a", "b"), t, at(t), t + 1e-3, at(t - 0.03), ServoTable.from_dict(SERVO), np.array([0, 0, -9.81]))


def test_a_joint_that_stops_in_one_recording_is_judged_by_the_others():
    model = mujoco.MjModel.from_xml_string(TWO)
    runs = [run_of(f"{k}.mcap", k) for k in range(3)]
    runs[1].q[200:, 1] = runs[1].q[200, 1]
    found, out, _ = channels.inspect(runs, model, {})
    assert list(out) == [("1.mcap", "b")] and found[0].regime.startswith("stuck")
    notes: list[str] = []
    runs = channels.drop(runs, out, notes, model)
    assert (
        [sorted(r.left_out) for r in runs] == [[], ["b"], []]
        and all(r.joints == ("a", "b") for r in runs)
        and len(notes) == 1
    )
    assert np.abs(runs[1].q[:, 1] - runs[1].cmd[:, 1]).max() < 0.3, "it is taken to follow its target"
    runs = inputs.common_joints(runs, [])
    for r in runs:
        r.smooth()
    a, b = build(model, runs)
    assert set(a.plant.windows(1.0).run) == {0, 1, 2} and set(b.plant.windows(1.0).run) == {0, 2}
    assert set(b.plant.windows(1.0, every_run=True).run) == {0, 1, 2}


def test_a_joint_that_one_side_of_the_fit_does_not_tell_of_goes_altogether():
    model = mujoco.MjModel.from_xml_string(TWO)
    runs = [run_of(f"{k}.mcap", k) for k in range(2)]
    notes: list[str] = []
    runs = channels.drop(runs, {("1.mcap", "b"): "stuck: so"}, notes, model, held=[1])
    assert [r.joints for r in runs] == [("a",), ("a",)] and any("one side of the fit" in n for n in notes)


def test_a_joint_that_dry_friction_holds_is_not_called_stuck():
    model = mujoco.MjModel.from_xml_string(TWO)
    runs = [run_of(f"{k}.mcap", k) for k in range(2)]
    for r in runs:
        q, cmd = r.q[:, 0], r.command_at(r.t)[:, 0]
        for i in range(1, len(q)):  # it moves only once its target is 0.2 rad away
            q[i] = q[i - 1] if abs(cmd[i] - q[i - 1]) < 0.2 else cmd[i] - 0.05 * np.sign(cmd[i] - q[i - 1])
    late = runs[1].t > 2.0
    runs[1].cmd[late, 0] = runs[1].q[late, 0][0] + 0.15 * np.sin(5 * runs[1].t[late])
    runs[1].q[late, 0] = runs[1].q[late, 0][0]
    assert channels.inspect(runs, model, {})[1] == {}
    runs[1].cmd[late, 0] = runs[1].q[late, 0][0] + 0.6 * np.sin(5 * runs[1].t[late])
    assert list(channels.inspect(runs, model, {})[1]) == [("1.mcap", "a")]


def plain_lead(run: Run) -> float:
    """Return the lead by its definition, one shift after another."""
    grid = np.arange(run.t[0], run.t[-1], 0.005)
    dq = np.gradient(np.interp(grid, run.t, run.q[:, 0]))
    shifts = np.arange(-0.6, 0.401, 0.005)
    scores = []
    for s in shifts:
        dc = np.convolve(np.gradient(run.command_at(grid - s)[:, 0]), np.ones(9) / 9, "same")
        scores.append(float(dc @ dq) / (np.linalg.norm(dc) * np.linalg.norm(dq) + 1e-12))
    best = int(np.argmax(scores))
    causal = max(s for s, x in zip(scores, shifts, strict=True) if x >= 0)
    return float(-shifts[best]) if shifts[best] < 0 and scores[best] > 0.6 and scores[best] > causal + 0.15 else 0.0


@pytest.mark.parametrize("lead", [0.0, 0.05, 0.3])
def test_a_lead_is_that_of_the_plain_correlation(lead):
    run = run_of("r", 0, 20.0)
    steps = np.repeat(np.random.default_rng(3).uniform(-1, 1, 40), 50)[: len(run.t)]
    run.cmd[:, 0] = steps
    run.q[:, 0] = np.interp(
        run.t - 0.02 + lead, run.t, np.convolve(np.pad(steps, 8, mode="edge"), np.ones(9) / 9, "same")[8:-8]
    )
    assert channels._lead(run, 0) == pytest.approx(plain_lead(run), abs=0.0051)
    assert (channels._lead(run, 0) > SIGNAL.early) == (lead > 0)


@pytest.mark.slow
def test_enabled_acts_in_the_recording_that_has_it_and_a_second_is_enough(tmp_path):
    """Three clips of 1 s at 50 Hz, one of them with `enabled`: judged, and its switch kept."""
    paths, model, servo, _ = demo.make(tmp_path, "", seconds=4.0)
    clips = []
    for k, path in enumerate(paths[:3]):
        r = read(path, joints=["joint"], audit=False)
        for s in (r.commands, r.states.position, r.states.velocity, r.states.effort):
            if s is not None:
                keep = np.flatnonzero((s.t > 1.0) & (s.t < 1.995))
                keep = keep[np.r_[True, np.diff((50 * s.t[keep]).astype(int)) > 0]]
                s.t, s.value, s.stamp = s.t[keep], s.value[keep], None
        r.enabled = None
        if k == 1:
            r.enabled = type(r.commands)(r.commands.t, np.ones_like(r.commands.value), "/joint_enabled")
        clips.append(tmp_path / f"clip{k}.mcap")
        write(clips[-1], r)
    from dexsim.recording.mechanism import mechanism

    m = mechanism(str(model), str(servo))
    runs = inputs.common_joints([inputs.to_run(read(p, joints=m.joints), m, []) for p in clips], [])
    assert [r.enabled is not None for r in runs] == [False, True, False]
    s = Settings(
        clips,
        tmp_path / "out",
        None,
        str(model),
        str(servo),
        next_recording=False,
        allowed={"command_delay"},
        replay="none",
    )
    d = diagnose(s, say=lambda _: None)
    save(d, s.out)
    answer = json.loads((s.out / "diagnosis.json").read_text())
    assert answer["verdict"] != "unusable" and answer["held_out"]["before"] > 0 and set(d.joints) == {"joint"}


def chirp(t, low=0.1, high=10.0, span=10.0):
    """Return a sweep of constant size; t: s from its begin."""
    turns = low * span / np.log(high / low) * ((high / low) ** (np.clip(t, 0, span) / span) - 1)
    return 0.3 * np.sin(2 * np.pi * turns)


def swept(name, lag, sign, begin, end, droop=0.05):
    """Return a joint that follows a part of a sweep, `lag` s late, by ever less."""
    t = np.arange(begin, end, 0.005)
    q = sign * chirp(t - lag) / (1 + droop * t)
    table = ServoTable.from_dict({"joints": {"*": {"kp": 1.0, "kd": 0.0}}})
    return Run(name, ("j",), t, chirp(t)[:, None], t.copy(), q[:, None], table, np.array([0, 0, -9.81]))


FREE = mujoco.MjModel.from_xml_string(
    "<mujoco><worldbody><body><joint name='j' axis='0 1 0'/><geom size='.01'/></body></worldbody></mujoco>"
)


def signs(runs):
    found, out, _ = channels.inspect(runs, FREE, {})
    return [f.confidence for f in found if f.regime.startswith("sign")], sorted(n for n, _ in out)


def test_a_lag_beyond_a_quarter_period_is_no_other_sign():
    """The parts of a sweep: at its end the joint lags by more than half a period, and its begin tells the sign."""
    parts = [("a", 0.0, 4.0), ("b", 4.0, 8.0), ("c", 8.0, 9.2), ("d", 9.2, 10.0)]
    assert signs([swept(n, 0.06, 1, a, b) for n, a, b in parts]) == ([], [])
    confidence, out = signs([swept(n, 0.03, -1, a, b) for n, a, b in parts[:2]])
    assert confidence and min(confidence) >= JUDGE.firm and out == ["a", "b"]


def test_a_narrow_band_alone_is_doubted_and_stays():
    confidence, out = signs([swept("d", 0.01, -1, 9.0, 10.0, droop=0.0)])
    assert out == [] and confidence == [JUDGE.hinted]
    # what goes less far than its target may be beyond its resonance, and lag by more than half a period
    assert signs([swept("d", 0.01, -1, 9.0, 10.0)]) == ([], [])


def test_one_recording_of_another_sign_is_named_beside_what_contradicts_it():
    runs = [swept("a", 0.03, 1, 0, 8), swept("b", 0.03, -1, 0, 8)]
    found, out, _ = channels.inspect(runs, FREE, {})
    assert [n for n, _ in out] == ["b"] and "not so in a" in found[0].regime


def test_a_joint_of_another_sign_moves_the_others_as_it_was_read():
    """Its commands are negated in every recording: it is not judged, and what hangs from it feels it all the same."""
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><joint name='a' axis='0 1 0'/><geom size='.02' mass='.2' pos='.1 0 0'/><body "
        "pos='.2 0 0'><joint name='b' axis='0 1 0'/><geom size='.02' mass='.2' pos='.1 0 0'/></body></body>"
        "</worldbody></mujoco>"
    )

    def runs(way):
        out = []
        for name, where in (("r0", 0.0), ("r1", 4.0)):
            run, other = swept(name, 0.03, 1, where, where + 4.0), swept(name, 0.05, 1, where, where + 4.0)
            q, cmd = np.hstack([run.q, 0.5 * other.q]), np.hstack([way * run.cmd, 0.5 * other.cmd])
            out.append(Run(name, ("a", "b"), run.cmd_t, cmd, run.t, q, run.servo, run.gravity))
        return out

    def series_of(given):
        for r in given:
            r.smooth()
        (b,) = build(model, given, only={"b"})
        return np.delete(b.plant.series, SERIES_INDEX["others_torque"], 1)  # of which the commands tell

    wrong, notes = runs(-1), []
    _, out, _ = channels.inspect(wrong, model, {})
    assert set(out) == {("r0", "a"), ("r1", "a")}
    wrong = channels.drop(wrong, out, notes, model)
    assert all(r.joints == ("a", "b") and r.left_out == {"a"} for r in wrong) and "a is left out (sign" in notes[0]
    alone = [Run(r.name, ("b",), r.cmd_t, r.cmd[:, 1:], r.t, r.q[:, 1:], r.servo, r.gravity) for r in wrong]
    np.testing.assert_allclose(series_of(wrong), series_of(runs(1)), atol=1e-9)
    assert np.abs(series_of(wrong) - series_of(alone)).max() > 0.1


def stepped(late, others=0):
    """Steps of a target that are logged `late` s after they were sent."""
    t = np.arange(0, 12, 0.01)
    sent = np.floor(t)
    cmd = 0.4 * (sent % 2)
    ago = np.maximum(t[:, None] - 0.01 - np.linspace(0, 0.15, 9), 0.0)
    follow = 0.4 * (np.floor(ago) % 2).mean(1)
    table = ServoTable.from_dict({"joints": {"*": {"kp": 1.0, "kd": 0.0}}})
    return Run("a", ("j",), t + late, cmd[:, None], t, follow[:, None], table, np.array([0, 0, -9.81]))


@pytest.mark.parametrize(("late", "named"), [(0.0, False), (0.02, False), (0.08, True)])
def test_edges_that_are_logged_late_are_another_clock(late, named):
    found, _, _ = channels.inspect([stepped(late)], FREE, {})
    assert [f.regime.startswith("clock_skew") for f in found] == ([True] if named else [])
