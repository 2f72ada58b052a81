"""A stand-in for what no effect explains: a small regression of the residual torque, which training may use.

    torque = constant + position * q + speed * v + drag * v |v|

It names nothing. Inverse dynamics along the measured motion with the best hypothesis leaves a torque; the four numbers
are fitted to it, judged on recordings kept out, and written to `servo_standin.yaml` as the servo's `standin_*` columns.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dexsim import intervals
from dexsim.actuator.reference import torque_along
from dexsim.actuator.table import ServoTable
from dexsim.gap.judge import errors
from dexsim.gap.plant.case import Case
from dexsim.gap.plant.columns import INDEX, SERIES_INDEX, expand
from dexsim.gap.read.runs import BLOCK, Run
from dexsim.gap.rules import JUDGE
from dexsim.gap.search.search import Trial

COLUMNS = ("standin_constant", "standin_position", "standin_speed", "standin_drag")
DRAWS = 200  # of the bootstrap


@dataclass
class StandIn:
    """Four numbers [4] (N.m, N.m/rad, N.m.s/rad, N.m.s2/rad2) with 90 % intervals; held-out rms before and after
    [rad]."""

    joint: str
    value: np.ndarray
    low: np.ndarray
    high: np.ndarray
    before: float
    after: float

    @property
    def text(self) -> str:
        """What it does, in words."""
        return (
            f"{self.joint}: a stand-in torque (constant, position, speed, drag) takes the held-out error from "
            f"{1e3 * self.before:.3g} to "
            f"{1e3 * self.after:.3g} mrad; it names nothing (servo_standin.yaml)"
        )


def residual_torque(case: Case, runs: list[Run], trial: Trial, run: int) -> tuple[np.ndarray, np.ndarray]:
    """(torque [S] N.m that the measured motion of a run needs beyond the hypothesis, whether it can be read there [S]).

    Where the joint hardly moves, dry friction hides any torque.
    """
    plant, j = case.plant, case.index
    row = expand(plant, trial.fit.params, trial.fit.x[None])[0, run]
    for member in trial.members:
        for name, value in member.variant.fixed:
            row[INDEX[name]] = value
    p = lambda name: row[INDEX[name]]  # noqa: E731
    r = runs[run]
    q, v, a, t = r.qs[:, j], r.vs[:, j], r.as_[:, j], r.t
    grid = t[0] + plant.dt * np.arange(plant._grid[run + 1] - plant._grid[run])
    series = plant.series[plant._grid[run] : plant._grid[run + 1]]
    s = lambda name: np.interp(t, grid, series[:, SERIES_INDEX[name]])  # noqa: E731
    cmd = r.command_at(t - p("delay"))[:, j]
    error = cmd - q
    asked = p("kp") * error - p("kd") * v
    asked = np.where(np.abs(error) < p("deadband"), 0.0, asked)
    supply = s("supply") if plant.voltage else 1.0
    motor = torque_along(asked, v, p("torque_limit"), p("no_load_speed"), plant.voltage, supply)
    if p("lag") > 0:
        motor = _lagged(t, motor, p("lag"))
    slope = 0.05 * max(case.scales.speed, 1e-9)
    level = p("coulomb_friction") + p("stribeck_peak") * np.exp(-((v / p("stribeck_speed")) ** 2))
    level = (
        level
        + np.where(motor * v < 0, p("load_friction_backdriven"), p("load_friction")) * np.abs(motor)
        + case.constants.friction
    )
    friction = (
        level * np.sign(v)
        + 0.5 * p("friction_asymmetry") * level
        + (p("viscous_friction") + case.constants.damping) * v
    )
    ripple = p("torque_ripple") * np.sin(p("ripple_per_turn") * q + p("ripple_phase"))
    inertia = s("inertia") * p("inertia_scale") + p("armature")
    needed = inertia * a + p("gravity_scale") * s("gravity_cos") + s("rest")
    needed += p("spring") * q + p("spring_preload")
    needed += p("payload") * (s("load_cos") + s("load_inertia") * a) + p("own_payload") * (
        s("own_cos") + s("own_inertia") * a
    )
    on = np.abs(v) > slope
    if r.enabled is not None:
        on &= r.enabled[:, j] > 0.5
    on[:3] = on[-3:] = False
    return needed + friction - p("efficiency") * motor - ripple, on


def _lagged(t: np.ndarray, x: np.ndarray, time_constant: float) -> np.ndarray:
    out, y = np.empty_like(x), x[0]
    for i in range(len(x)):
        dt = t[i] - t[i - 1] if i else 0.0
        y += (1 - np.exp(-dt / time_constant)) * (x[i] - y)
        out[i] = y
    return out


def basis(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """[S, 4] what the numbers multiply."""
    return np.stack([np.ones_like(q), q, v, v * np.abs(v)], 1)


def fit(
    case: Case,
    runs: list[Run],
    trial: Trial,
    train: list[int],
    test: list[int],
    span_train: dict[int, tuple[float, float]] | None = None,
    span_test: dict[int, tuple[float, float]] | None = None,
    seed: int = 0,
) -> StandIn | None:
    """The stand-in of one joint; None where it would not take JUDGE.standin off the held-out error."""
    x, y, block = [], [], []
    for r in train:
        torque, on = residual_torque(case, runs, trial, r)
        t = runs[r].t - runs[r].t[0]
        if span_train and r in span_train:
            on = on & (t >= span_train[r][0]) & (t <= span_train[r][1])
        x.append(basis(runs[r].qs[on, case.index], runs[r].vs[on, case.index]))
        y.append(torque[on])
        block.append(1000 * r + (t[on] / BLOCK).astype(int))
    x, y, block = np.concatenate(x), np.concatenate(y), np.concatenate(block)
    if len(y) < 60:
        return None
    scale = np.maximum(np.sqrt((x**2).mean(0)), 1e-12)
    _, block = np.unique(block, return_inverse=True)
    count = int(block.max()) + 1
    gram = np.zeros((count, 4, 4))
    right = np.zeros((count, 4))
    z = x / scale
    huber = 2.5 * float(np.median(np.abs(y - np.median(y)))) + 1e-12
    weight = np.minimum(1.0, huber / np.maximum(np.abs(y - np.median(y)), 1e-12))
    np.add.at(gram, block, weight[:, None, None] * z[:, :, None] * z[:, None, :])
    np.add.at(right, block, (weight * y)[:, None] * z)
    ridge = 1e-3 * len(y) * np.eye(4)
    solve = lambda k: np.linalg.solve(gram[k].sum(0) + ridge, right[k].sum(0)) / scale  # noqa: E731
    value = solve(np.arange(count))
    each = lambda index, axis=-1: np.moveaxis(np.apply_along_axis(solve, axis, index.astype(int)), axis, 0)  # noqa: E731
    low, high = np.quantile(intervals.draws((np.arange(count),), each, seed, DRAWS), [0.05, 0.95], axis=-1)
    before, after = _held_out(case, runs, trial, value, test, span_test)
    if not after < (1 - JUDGE.standin) * before:
        return None
    return StandIn(case.joint, value, np.minimum(low, value), np.maximum(high, value), before, after)


def _held_out(
    case: Case, runs: list[Run], trial: Trial, value: np.ndarray, test: list[int], span_test
) -> tuple[float, float]:
    """Held-out rms [rad] of free runs without and with the torque, which acts along the measured motion here."""
    plant = case.plant
    windows = plant.windows(None, test, span=span_test)
    fixed = [f for m in trial.members for f in m.variant.fixed]
    measured = plant.q[windows.sample_row]
    out = []
    kept = plant.series
    try:
        for k in (0.0, 1.0):
            series = kept.copy()
            q, v = series[:, SERIES_INDEX["q"]], series[:, SERIES_INDEX["v"]]
            series[:, SERIES_INDEX["rest"]] -= k * basis(q, v) @ value
            plant.set_series(series)
            simulated, _ = errors.free_run(case, trial.fit.params, trial.fit.x, windows, fixed)
            out.append(float(np.sqrt(np.mean((measured - simulated) ** 2))))
    finally:
        plant.set_series(kept)
    return out[0], out[1]


def write(table: ServoTable, found: list[StandIn], path: Path) -> None:
    """The fitted servo with the stand-ins' columns and their intervals, as a file that training loads."""
    import copy

    out = copy.deepcopy(table)
    for s in found:
        for name, value, low, high in zip(COLUMNS, s.value, s.low, s.high, strict=True):
            out.set(s.joint, name, round(float(value), 9), round(float(low), 9), round(float(high), 9))
    out.save(path)
