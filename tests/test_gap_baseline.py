"""The plain model beside every diagnosis, and motions that were recorded against frictions that forbid them."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from dexsim.actuator.table import ServoTable
from dexsim.gap.effects.catalogue import EFFECTS
from dexsim.gap.plant.case import build
from dexsim.gap.plant.columns import INDEX, Param
from dexsim.gap.read import Run
from dexsim.gap.search import baseline
from dexsim.gap.search.baseline import forbids, room_for_friction

PENDULUM = """<mujoco><compiler angle="radian"/><worldbody><body><joint name="joint" axis="0 1 0" armature="0.001"/>
<geom type="sphere" size="0.01" pos="0 0 -0.1" mass="0.5"/></body></worldbody></mujoco>"""
HANGS = 0.5 * 9.81 * 0.1  # N.m at a right angle
BELIEVED = {"drive": "torque", "loop_rate": 1000, "joints": {"*": {"kp": 3.0, "kd": 0.1, "torque_limit": 2.0}}}


def run(name: str, t, q, cmd, enabled=None, torque=None) -> Run:
    column = lambda x: None if x is None else np.asarray(x, float)[:, None]  # noqa: E731
    return Run(
        name,
        ("joint",),
        t,
        column(cmd),
        t,
        column(q),
        ServoTable.from_dict(BELIEVED),
        np.array([0, 0, -9.81]),
        enabled=column(enabled),
        torque=column(torque),
    )


def case_of(*runs: Run):
    for r in runs:
        r.smooth()
    return build(mujoco.MjModel.from_xml_string(PENDULUM), list(runs))[0]


def falls(friction: float) -> tuple[np.ndarray, np.ndarray]:
    """Times and angles of the pendulum let go at 1.2 rad without power; it comes to rest by its dry friction [N.m]."""
    t, dt, inertia = np.arange(0, 3, 5e-3), 2.5e-4, 0.001 + 0.5 * 0.1**2
    q, v, out = 1.2, 0.0, []
    for i in range(len(t) * 20):
        if i % 20 == 0:
            out.append(q)
        free = v - dt * HANGS * np.sin(q) / inertia if t[i // 20] > 0.5 else 0.0  # held until then
        stop = dt * friction / inertia
        v = np.sign(free) * max(abs(free) - stop, 0.0)
        q += dt * v
    return t, np.array(out)


def test_a_friction_that_forbids_a_fall_that_was_recorded_is_refused_with_the_reason():
    t, q = falls(0.05)
    case = case_of(run("fall.mcap", t, q, np.full(len(t), 1.2), enabled=np.zeros(len(t))))
    room = room_for_friction(case, [0])
    assert 0.05 < room[-1] < 0.5 * HANGS  # it swings, and each swing begins with less of gravity
    assert forbids(case, [0], 0.05) == ""
    assert "would hold the joint, but it was recorded setting itself in motion" in forbids(case, [0], 1.4 * HANGS)
    assert "in motion backwards" in forbids(case, [0], 0.4 * HANGS, asymmetry=-1.9)  # of which more backwards
    powered = case_of(run("fall.mcap", t, q, np.full(len(t), 1.2), enabled=np.ones(len(t))))
    assert forbids(powered, [0], 1.4 * HANGS) == ""  # the drive may have pushed it


def moved(case, seconds: float = 6.0, seed: int = 0, **true: float) -> Run:
    """Return a recording of steps and a wave by the plant itself, with columns at their true values."""
    rng, t = np.random.default_rng(seed), np.arange(0, seconds, 5e-3)
    cmd = 0.4 * np.sin(2 * np.pi * (0.4 + 0.1 * seed) * t) + 0.3 * np.sign(np.sin(2 * np.pi * 0.55 * t + seed))
    blank = case_of(run(f"m{seed}.mcap", t, np.zeros(len(t)), cmd))
    params = blank.plant.base()[None].copy()
    for name, value in true.items():
        params[:, :, INDEX[name]] = value
    q = blank.plant.simulate(params, blank.plant.windows(None))[0][0]
    return run(f"m{seed}.mcap", t, q + 3e-4 * rng.standard_normal(len(t)), cmd)


@pytest.fixture(scope="module")
def fitted():
    true = {"kp": 3.9, "kd": 0.16, "coulomb_friction": 0.08, "viscous_friction": 0.0, "delay": 0.02}
    case = case_of(*(moved(None, seed=k, **true) for k in (0, 1)))
    return case, true, baseline.judged(case, baseline.fitted(case, [0]), [1])


def test_the_plain_model_follows_what_it_can_state(fitted):
    case, true, plain = fitted
    assert plain.error < 1e-3 < 0.05 * plain.error_before
    for name in ("kp", "coulomb_friction"):
        assert plain.value[name] == pytest.approx(true[name], rel=0.1), name
    late = plain.value["delay"] + plain.value["lag"]  # which steps and a slow wave do not tell apart
    assert late == pytest.approx(true["delay"], rel=0.1)
    entry = plain.entry()
    assert entry["parameters"]["delay"]["unit"] == "s" and entry["error"] == plain.error
    data = baseline.overall([plain])
    assert data["error"] == pytest.approx(plain.error) and data["joints"]["joint"] == entry
    assert "plain least squares" in baseline.text(data, "mrad") and baseline.text({}, "mrad") == ""


def test_figures_that_no_recording_tells_stay_as_they_are_believed(monkeypatch):
    """A motion that comes nowhere near a drive's limits says nothing of them: neither twice nor half is written."""
    strong = {"kp": 3.0, "kd": 0.1, "torque_limit": 20.0, "no_load_speed": 60.0}
    monkeypatch.setitem(globals(), "BELIEVED", BELIEVED | {"joints": {"*": strong}})
    case = case_of(*(moved(None, seed=k, kp=3.9, delay=0.02) for k in (0, 1)))
    plain = baseline.judged(case, baseline.fitted(case, [0]), [1])
    assert plain.value["kp"] == pytest.approx(3.9, rel=0.1) and plain.error < 0.1 * plain.error_before
    assert (plain.value["torque_limit"], plain.value["no_load_speed"]) == (20.0, 60.0)
    assert not {"torque_limit", "no_load_speed"} & set(plain.at_bound)


def test_a_gain_further_off_than_twice_ends_at_its_bound_and_a_stated_range_lets_it_go_further(monkeypatch):
    runs = [moved(None, seed=k, kp=10.0, kd=0.16) for k in (0, 1)]
    plain = baseline.judged(case_of(*runs), baseline.fitted(case_of(*runs), [0]), [1])
    assert plain.value["kp"] == pytest.approx(6.0, rel=1e-3) and plain.at_bound["kp"] == pytest.approx(2.0, rel=1e-3)
    (said,) = baseline.stopped(baseline.overall([plain]))
    assert "ends at its bound in kp (2 x what is believed)" in said and "a range in servo.yaml" in said
    stated = {"kp": {"value": 3.0, "low": 1.5, "high": 6.0}, "kd": 0.1, "torque_limit": 2.0}
    monkeypatch.setitem(globals(), "BELIEVED", BELIEVED | {"joints": {"*": stated}})
    case = case_of(*(replace(r, servo=ServoTable.from_dict(BELIEVED)) for r in runs))
    wide = baseline.judged(case, baseline.fitted(case, [0]), [1])
    assert wide.value["kp"] == pytest.approx(10.0, rel=0.1) and "kp" not in wide.at_bound
    assert wide.error < 0.5 * plain.error


def test_the_plain_model_is_written_as_it_was_fitted(fitted):
    _, _, plain = fitted
    servo, spec = ServoTable.from_dict(BELIEVED), mujoco.MjSpec.from_string(PENDULUM)
    before = float(np.ravel(spec.joint("joint").armature)[0])
    said = baseline.write(plain, servo, spec)
    for name in ("kp", "kd", "delay", "lag"):
        assert servo.value("joint", name).value == pytest.approx(plain.value[name], abs=1e-8)
    assert servo.value("joint", "standin_constant").value == pytest.approx(plain.value["offset"], abs=1e-8)
    assert float(np.ravel(spec.joint("joint").armature)[0]) == pytest.approx(before + plain.value["inertia"])
    assert "armature of joint" in said[0]


@pytest.mark.parametrize(
    ("columns", "held"),
    [
        ({"stribeck_peak": 1.4 * HANGS}, True),
        ({"stribeck_peak": 0.1}, False),
        ({"gear_load_friction_backdriven": 1.3}, True),  # holds whatever its load
        ({"gear_load_friction_backdriven": 0.8}, False),
        ({"gear_load_friction_backdriven": 0.8, "coulomb_friction": 0.4 * HANGS}, True),
        ({"coulomb_friction": 0.4 * HANGS}, False),
        ({"gear_load_friction": 1.3}, False),  # of a load that the gear drives, and here it is driven
        ({"load_friction_external": 1.3}, True),
        ({"load_friction_backdriven": 1.3}, False),  # per torque of the motor, which is off
    ],
)
def test_breakaway_and_friction_by_load_may_forbid_a_fall_too(columns, held):
    """An arm falls without power; a share of the load of more than one holds it by itself."""
    t, q = (x[:180] for x in falls(0.01))  # the first fall
    case = case_of(run("fall.mcap", t, q, np.full(180, 1.2), enabled=np.zeros(180)))
    fixed = {"gear_load_unit": HANGS} if any(n.startswith("gear") for n in columns) else {}
    params = [Param(n, (n,), "set", 0.0, 9.0, 0.0) for n in {**columns, **fixed}]
    x = np.array([*columns.values(), *fixed.values()])
    trial = SimpleNamespace(fit=SimpleNamespace(params=params, x=x))
    assert ("would hold the joint" in baseline.forbidden(case, trial, [0])) is held


def test_the_plain_model_is_handed_on_with_the_braking_that_it_was_judged_with(fitted):
    """The servo's file says nothing of braking: its default is another."""
    case, _, plain = fitted
    servo = ServoTable.from_dict(BELIEVED)
    assert servo.value("joint", "braking_slope").value == 1.0 != case.scales.nominal["braking_slope"]
    baseline.write(plain, servo, mujoco.MjSpec.from_string(PENDULUM))
    assert servo.value("joint", "braking_slope").value == case.scales.nominal["braking_slope"] == 0.0
    stated = replace(case, stated=frozenset({"braking_slope"}))
    assert baseline.judged(stated, ([], np.zeros(0)), [1]).beside == {}


def test_the_plain_model_fits_no_friction_that_a_fall_forbids():
    t, q = falls(0.05)
    case = case_of(
        run("fall.mcap", t, q, np.full(len(t), 1.2), enabled=np.zeros(len(t))),
        run("again.mcap", t, q, np.full(len(t), 1.2), enabled=np.zeros(len(t))),
    )
    friction = next(p for p in baseline.plain_model(case, [0]) if p.key == "coulomb_friction")
    assert friction.high <= room_for_friction(case, [0])[-1]
    trial = SimpleNamespace(fit=SimpleNamespace(params=[friction], x=np.array([2 * HANGS])))
    assert "would hold the joint" in baseline.forbidden(case, trial, [0])


def test_a_velocity_loop_is_a_setting(monkeypatch):
    """Its damping acts on the error of the speed, in the file, the fit and what is written."""
    loop = {"drive": "torque", "loop": "velocity", "loop_rate": 1000, "joints": {"*": {"kd": 0.2, "torque_limit": 2.0}}}
    table = ServoTable.from_dict(loop)
    assert table.value("joint", "speed_feedforward").value == 0.2 and table.nominal(["joint"])[0, INDEX["kp"]] == 0.0
    assert ServoTable.from_dict(table.to_dict()).to_dict() == table.to_dict()
    monkeypatch.setitem(globals(), "BELIEVED", loop)
    true = {"kd": 0.31, "speed_feedforward": 0.31}
    case = case_of(*(moved(None, seed=k, **true) for k in (0, 1)))
    (gains,) = EFFECTS["gain_mismatch"].variants(case.scales)
    assert [p.key for p in gains.params] == ["kd_factor"]  # of a kp that is 0 there is no factor
    plain = baseline.judged(case, baseline.fitted(case, [0]), [1])
    assert plain.value["kd"] == pytest.approx(0.31, rel=0.1) and plain.error < 0.2 * plain.error_before
    baseline.write(plain, table, mujoco.MjSpec.from_string(PENDULUM))
    assert table.value("joint", "speed_feedforward").value == table.value("joint", "kd").value
