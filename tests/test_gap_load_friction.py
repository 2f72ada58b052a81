"""Friction that grows with the torque that a gear hands to its joint: the plant's law, when it is tried, what training
is given of it."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from test_gap import model, plant_run
from test_gap_confirm import replayed

from dexsim.actuator.columns import INDEX as SERVO_INDEX
from dexsim.actuator.table import ServoTable
from dexsim.gap.effects.catalogue import EFFECTS
from dexsim.gap.judge.handed_on import columns_beside
from dexsim.gap.plant.case import build
from dexsim.gap.plant.columns import INDEX
from dexsim.gap.read import Run, conditions
from dexsim.gap.search.search import JointSearch, search_joint

ARM = """<mujoco><worldbody><body><joint name="a" axis="0 1 0" armature="1e-4"/>
<geom type="sphere" size="1e-3" mass="0.2" pos="0.1 0 0"/></body></worldbody></mujoco>"""
LOAD = 0.2 * 9.81 * 0.1  # N.m of the level arm


def arm(torque: np.ndarray, **columns) -> np.ndarray:
    """Return angle [n] of a level arm whose drive gives `torque` [n] N.m every 10 ms: a weak loop with far targets."""
    t = np.arange(len(torque)) * 0.01
    servo = ServoTable.from_dict({"joints": {"*": {"kp": 1e-3, "kd": 0.0, "torque_limit": 5.0}}})
    q = np.zeros((len(t), 1))
    run = Run("x", ("a",), t, 1e3 * torque[:, None], t, q, servo, np.array([0, 0, -9.81]))
    p = build(mujoco.MjModel.from_xml_string(ARM), [run])[0].plant
    params = p.base()[None].copy()
    for name, value in columns.items():
        params[..., INDEX[name]] = value
    return p.simulate(params, p.windows(None))[0][0]


def gear(friction: float, **more) -> dict[str, float]:
    return {"gear_load_friction": friction, "gear_load_friction_backdriven": friction} | more


def test_a_gear_that_loses_more_than_its_load_holds_it_unpowered():
    off = np.zeros(60)
    assert abs(arm(off)[-1]) > 0.5 and abs(arm(off, **gear(0.5))[-1]) > 0.2
    assert abs(arm(off, **gear(1.3))[-1]) < 0.01


def test_the_motor_moves_the_load_from_its_friction_on_and_lowers_it_by_the_rest():
    """With friction f |load| the load rises from (1 + f) of it on, and for f > 1 it sinks pushed by (f - 1) of it."""
    for share, moves in ((1.1, False), (1.9, True)):  # of the load, upwards
        assert bool(abs(arm(np.full(60, -share * LOAD), **gear(0.5))[-1]) > 0.1) is moves
    for share, moves in ((0.1, False), (0.7, True)):  # downwards
        assert bool(abs(arm(np.full(60, share * LOAD), **gear(1.3))[-1]) > 0.1) is moves


def test_a_power_is_of_the_load_over_its_unit():
    """At (load / unit) = 8 Hertz's 2/3 makes a friction of 4 units where the line makes 8."""
    unit = LOAD / 8
    for power, share, moves in ((2 / 3, 0.3, False), (2 / 3, 0.7, True), (1.0, 0.7, False)):
        q = arm(np.full(60, -(1 + share) * LOAD), **gear(1.0, gear_load_unit=unit, gear_load_power=power))
        assert bool(abs(q[-1]) > 0.05) is moves, (power, share)


@pytest.fixture(scope="module")
def searched():
    """Return a search of friction on runs of a gear that loses more than its load."""
    off = {"*kp": 1.03, "*inertia_scale": 0.97}
    runs = [plant_run(f"run{k}", k, 5.0, off | gear(1.3, gear_load_unit=0.05), seed=k) for k in (0, 1, 3)]
    for r in runs:
        r.smooth()
    allowed = {"coulomb_friction", "load_friction"}
    search = JointSearch(build(model(), runs)[0], [0, 1, 2], None, conditions(runs), allowed=allowed)
    return search, search_joint(search)


@pytest.mark.slow
def test_it_is_named_where_dry_friction_and_a_share_of_the_motors_torque_leave_much(searched):
    _, found = searched
    assert [m.id for m in found.best.members] == ["load_friction"]
    size = next(x for p, x in zip(found.best.fit.params, found.best.fit.x, strict=True) if p.key.endswith(".fraction"))
    assert size == pytest.approx(1.3, rel=0.2)


@pytest.mark.slow
def test_training_is_given_a_share_of_the_torque_from_outside(searched):
    search, found = searched
    given = columns_beside(search.case, found.best, ["joint"])
    assert given["load_friction_external"] == pytest.approx(1.3, rel=0.2)
    assert "coulomb_friction" not in given and "gear_load_friction" not in SERVO_INDEX


@pytest.mark.slow
def test_the_engine_that_trains_comes_near():
    """It has no part of the joint's own inertia in that friction."""
    c = replayed("load_friction", "of the torque on the joint", gear(1.3, gear_load_unit=0.05), [1.3, 1.3])
    assert c.errors["joint"]["found"] < 0.5 * c.errors["joint"]["refitted"], c.errors


def test_the_law_is_tried_in_the_place_of_others_only():
    run = plant_run("a", 0, 2.0, {})
    run.smooth()
    case = build(model(), [run])[0]
    by_motor, by_gear = EFFECTS["load_friction"].variants(case.scales)
    assert by_gear.approximate and not by_motor.approximate
    assert {p.key for p in by_motor.params} == {p.key for p in by_gear.params}
