"""The lag of a drive's torque: its second order in the search's plant against closed forms, the NumPy reference and an
independent integration; what makes a loop swing by itself is told by it, and training gets one of first order."""

from __future__ import annotations

import numpy as np
import pytest
from test_gap import model, plant_run

from dexsim.actuator.table import ServoTable
from dexsim.gap.effects.catalogue import EFFECTS
from dexsim.gap.judge.handed_on import missing_of, servo_changes
from dexsim.gap.plant.batch import JointPlant
from dexsim.gap.plant.case import JointConstants, build
from dexsim.gap.plant.columns import INDEX, NEUTRAL, SERIES, SERIES_INDEX
from dexsim.gap.read import conditions
from dexsim.gap.search import ringing
from dexsim.gap.search.hypotheses import Member, Outcome, Trial
from dexsim.gap.search.search import JointSearch, without_search

DT, TIME = 5e-4, 0.04  # s


def moved(inertia: float, columns: dict[str, float], targets: np.ndarray, dt: float = DT) -> np.ndarray:
    """[steps, 2] q, motor torque of a link in free air, with targets[k] in force from step k on."""
    steps = len(targets)
    t = dt * np.arange(steps)
    constants = JointConstants(0.0, 0.0, -1e6, 1e6, False, 0.0, inertia)
    plant = JointPlant("joint", constants, dt, False, "joint", "joint")
    series = np.zeros((2, len(SERIES)))
    for name, value in (("inertia", inertia), ("supply", 1.0), ("enabled", 1.0)):
        series[:, SERIES_INDEX[name]] = value
    row = NEUTRAL.copy()
    for name, value in columns.items():
        row[INDEX[name]] = value
    early = np.r_[-2.0, t], np.r_[0.0, targets]
    plant.add(row, np.array([0.0, steps * dt]), series, *early, t, np.zeros(steps), None, {})
    plant.finish()
    q, torque = plant.simulate(plant.base()[None], plant.windows(None))
    return np.stack([q[0], torque[0]], 1)


def closed(t: np.ndarray, stages: int) -> np.ndarray:
    """Step response: 1 - e^-t/T, and 1 - (1 + 2 t / T) e^-2t/T of two stages of T/2."""
    return 1 - np.exp(-t / TIME) if stages == 1 else 1 - (1 + 2 * t / TIME) * np.exp(-2 * t / TIME)


@pytest.mark.parametrize("stages", [1, 2])
def test_step_response_is_the_closed_form_with_one_mean_delay(stages):
    t = DT * np.arange(800)
    targets = np.where(t >= 0.05, 1.0, 0.0)
    torque = moved(1e6, {"kp": 1.0, "lag": TIME, "lag_stages": stages}, targets)[:, 1]
    after = np.maximum(t - 0.05, 0.0)
    assert np.abs(torque - closed(after, stages)).max() < 1.1 * DT / TIME  # a step either way
    assert np.sum(targets - torque) * DT == pytest.approx(TIME, abs=1.5 * DT)


@pytest.mark.parametrize("stages", [1, 2])
def test_a_moving_joint_follows_an_independent_integration(stages):
    """kp, kd and the torque limit in a loop, the lag on what they give: the plant's implicit steps against explicit
    ones a fiftieth as long."""
    inertia, kp, kd, time = 5e-4, 0.4, 0.02, 0.015
    t = DT * np.arange(600)
    targets = np.where(t >= 0.02, 0.5, 0.0) - np.where(t >= 0.15, 0.8, 0.0)
    columns = {"kp": kp, "kd": kd, "torque_limit": 0.12, "no_load_speed": 30.0, "limit_speed": 0.0}
    out = moved(inertia, columns | {"lag": time, "lag_stages": stages}, targets)
    fine, q, v = 50, 0.0, 0.0
    y, seen, h = [0.0] * stages, [], DT / 50
    for k in range(len(t)):
        seen.append((q, y[-1]))
        for _ in range(fine):
            limit = 0.12 * max(1 - abs(v) / 30.0, 0.0)
            x = float(np.clip(kp * (targets[k] - q) - kd * v, -limit, limit))
            for i in range(stages):
                y[i] += h * stages / time * (x - y[i])
                x = y[i]
            v += h * y[-1] / inertia
            q += h * v
    seen = np.array(seen)
    assert np.ptp(seen[:, 0]) > 0.5
    assert np.abs(out[:, 0] - seen[:, 0]).max() < 0.01 and np.abs(out[:, 1] - seen[:, 1]).max() < 0.008


SERVO = {"kp": 4.0, "kd": 0.2, "torque_limit": 2.0, "no_load_speed": 12.0}
LATE = {"lag": 0.06, "lag_stages": 2.0, "braking_slope": 1.0, "limit_speed": 1.0}


@pytest.fixture(scope="module")
def swinging() -> tuple[JointSearch, Outcome]:
    runs = [plant_run(f"run{k}", k, 4.0, LATE, seed=k, servo=SERVO) for k in (1, 3, 2)]
    for r in runs:
        r.smooth()
    search = JointSearch(build(model(), runs)[0], [0, 1], None, conditions(runs), allowed={"lag", "compliance"})
    return search, without_search(search)


@pytest.mark.slow
def test_a_loop_that_swings_between_its_limits_is_told_by_the_law_of_its_lag(swinging):
    search, nothing = swinging
    assert ringing.Ringing(search, nothing.none).loud.sum() > 2
    found = ringing.answered(search, nothing)
    (member,) = found.best.members
    at = {p.key: x for p, x in zip(found.best.fit.params, found.best.fit.x, strict=True)}
    assert member.id == "lag" and ("lag_stages", 2.0) in member.variant.fixed
    assert at["lag.time_constant"] == pytest.approx(LATE["lag"], rel=0.3)
    assert ringing.shown(search, found, [2], None)


def test_training_gets_the_first_order_with_the_same_mean_delay_and_is_told(swinging):
    search, _ = swinging
    first = EFFECTS["lag"].variants(search.case.scales)[0]
    for variant in (first, *first.by_law()):
        second = bool(variant.fixed)
        table = ServoTable.from_dict({"joints": {"joint": SERVO}})
        params = search.params_of((Member(EFFECTS["lag"], variant),))[:1]
        trial = Trial((Member(EFFECTS["lag"], variant),), search.fitter.fit(params, np.array([0.02]), iterations=0))
        servo_changes(table, search.case, trial, np.array([[0.01, 0.03]]), ["joint"])
        missing = missing_of(search.case, trial)
        assert table.value("joint", "lag").value == pytest.approx(0.02)
        assert [x.startswith("second order of lag@joint") for x in missing] == [True] * second
