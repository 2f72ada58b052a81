"""Inverse dynamics against a carriage with known figures."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.real.convert_emps import stretch
from dexsim.actuator.columns import INDEX
from dexsim.gap.effects import ByTorque
from dexsim.gap.effects.catalogue import EFFECTS
from dexsim.gap.effects.friction import ViscousFriction
from dexsim.gap.search.inverse_dynamics import columns_of, highest, solve
from dexsim.gap.search.logged_torque import IdentifiedJoint, believe


def identify(given, test=None):
    """Return what is told of a carriage by what was recorded of it (`carriage`), judged by `test`."""

    def at(cutoff):
        made = [columns_of([stretch(*x, cutoff)], 0) for x in (given, test or given)]
        return made[0], made[-1]

    return solve(at, highest(given[0]))


def carriage(backward: float = 0.0, seed: int = 0, late: float = 0.0):
    """Times, noisy positions and forces of 95 kg, 200 N.s/m, 20 N, -3 N; backward: viscous friction more when it goes
    back; late: the force acts so much later than it is logged."""
    t = np.arange(0, 12, 2e-3)
    v = (
        0.1 * np.sin(2 * np.pi * 0.4 * t)
        + 0.04 * np.sin(2 * np.pi * 1.3 * t)
        + (0.01 * np.sin(2 * np.pi * 5.3 * t) if late else 0)
    )
    q = np.concatenate([[0.0], np.cumsum(0.5 * (v[1:] + v[:-1]) * 2e-3)])
    force = 95 * np.gradient(v, 2e-3) + (200 + backward * (v < 0)) * v + 20 * np.sign(v) - 3
    force = np.interp(t + late, t, force)
    rng = np.random.default_rng(seed)
    return t, q + 1e-7 * rng.standard_normal(len(t)), force + 0.5 * rng.standard_normal(len(t))


def test_known_figures_are_recovered_within_one_percent():
    found = identify(carriage())
    for name, value in {"inertia": 95, "viscous_friction": 200, "coulomb_friction": 20, "offset": -3}.items():
        assert found.value[name] == pytest.approx(value, rel=0.01)
    assert found.low["inertia"] < found.high["inertia"] and not found.named


def test_friction_that_differs_by_direction_is_told_on_other_data():
    found = identify(carriage(60.0), test=carriage(60.0, 1))
    first = found.named[0]
    assert first.text.startswith("viscous friction that differs") and first.after < 0.8 * first.before


def test_further_effects_are_named_one_after_another():
    found = identify(carriage(60.0, late=3e-3), test=carriage(60.0, 1, 3e-3))
    by = {n.effect: n for n in found.named}
    assert set(by) == {"viscous_friction", "lag"}
    assert by["viscous_friction"].value == pytest.approx(-30, rel=0.15)
    assert by["lag"].value / found.full["inertia"] == pytest.approx(3e-3, rel=0.15)
    assert by["lag"].low < by["lag"].value < by["lag"].high
    assert found.named[-1].after < 0.5 * found.named[0].before


def test_no_direction_has_a_negative_friction():
    """200 N.s/m forwards and 200 + backward backwards, of which there is none below 0: the mean is 200 + backward / 2,
    and what differs by direction no larger than that."""
    wide = identify(carriage(180.0), test=carriage(180.0, 1))
    (named,) = wide.named
    assert abs(named.value) <= wide.full["viscous_friction"] and not wide.refused
    beyond = identify(carriage(-280.0), test=carriage(-280.0, 1))  # pushes along backwards: no friction does
    assert "viscous_friction" not in {n.effect for n in beyond.named}
    assert "neither direction's can be negative" in beyond.refused[ViscousFriction.by_torque]
    effect, joint = EFFECTS["viscous_friction"], {"viscous_friction": 60.0}
    assert effect.refused_by_torque(-59.0, joint, 5.0) is None and effect.refused_by_torque(61.0, joint, 5.0)
    assert effect.refused_by_torque(1.0, {}, 5.0)  # beside none on the whole
    asymmetry = effect.parameters_by_torque(ByTorque(-58.0, -66.0, -50.0, 0.0, joint, "N", "m"))["asymmetry"]
    assert asymmetry["low"] == -2.0 <= asymmetry["value"] < asymmetry["high"]


def test_nothing_further_is_named_where_nothing_is_missing():
    assert identify(carriage(), test=carriage(seed=1)).named == []


def test_unknown_friction_is_believed_as_the_torque_tells_it():
    def case(*unknown: str) -> SimpleNamespace:
        scales = SimpleNamespace(nominal={"friction_asymmetry": 0.0}, inertia=94.0)
        return SimpleNamespace(
            joint="carriage",
            unknown=unknown,
            scales=scales,
            plant=SimpleNamespace(nominal=np.zeros((2, len(INDEX)))),
            ranges={},
            factors={},
            told=False,
        )

    x = identify(carriage())
    open_, known = case("viscous_friction", "coulomb_friction", "kd"), case("kd")
    assert len(believe([IdentifiedJoint(open_, x, []), IdentifiedJoint(known, x, [])])) == 1
    assert open_.told and open_.unknown == ("kd",) and not known.told and not known.ranges
    for name, true in (("viscous_friction", 200), ("coulomb_friction", 20), ("friction_asymmetry", -0.3)):
        assert open_.plant.nominal[:, INDEX[name]] == pytest.approx([true, true], rel=0.02)
        low, high = open_.ranges[name]
        assert low < open_.scales.nominal[name] < high
    low, high = open_.factors["inertia"]
    assert low < 95 / 94 < high
