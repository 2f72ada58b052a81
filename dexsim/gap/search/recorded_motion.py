"""What recorded motions say against a friction: a joint that sets itself in motion has less of it than what drives it.

A stretch that begins at rest and moves the joint on needs, at its best moment, more driving torque than dry friction.
The drive's part is known where the drive is off (0) or its torque was recorded, and is otherwise at most its limit;
gravity and the other joints' pull are the model's.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dexsim.actuator.columns import INDEX as SERVO
from dexsim.gap.plant.case import Case
from dexsim.gap.plant.columns import SERIES_INDEX

MOVING = 0.05  # of the joint's large speed
TRAVEL, LASTS = 0.02, 0.1  # of the joint's span, and s: shorter stretches may be noise
BELIEVED = 1.1  # x the driving torque: gravity and limits are off by a few percent


def room_for_friction(case: Case, runs: Sequence[int]) -> dict[int, float]:
    """By direction (1, -1): the largest dry friction [N.m] with which every motion of these runs that began at rest
    could begin; infinite where none did."""
    out = {1: np.inf, -1: np.inf}
    plant, speed = case.plant, case.regimes["_speed"]
    for r in runs:
        rows = plant.rows(r)
        t, q, v = plant.t[rows], plant.q[rows], speed[rows]
        if len(t) < 3:
            continue
        drive, pull = _drive(case, r), _series(case, r, "gravity_cos") + _series(case, r, "rest")
        for way in (1, -1):
            on = way * v > MOVING * case.scales.speed
            edge = np.flatnonzero(np.diff(np.r_[0, on.astype(int), 0]))
            for a, b in zip(edge[::2], edge[1::2], strict=True):
                if (
                    a == 0
                    or t[b - 1] - t[a] < LASTS
                    or abs(q[b - 1] - q[a]) < max(TRAVEL * case.scales.span, 20 * case.sigma)
                ):
                    continue
                a = max(a - 2, 0)  # the torque that set it off is from just before
                out[way] = min(out[way], max(BELIEVED * float(np.max(drive[way][a:b] - way * pull[a:b])), 0.0))
    return out


def forbids(case: Case, runs: Sequence[int], friction: float, asymmetry: float = 0.0) -> str:
    """Why a dry friction [N.m] (its asymmetry as in servo.yaml) cannot be: a motion was recorded that it forbids. Empty
    where none is."""
    for way, room in room_for_friction(case, runs).items():
        level = friction * (1 + 0.5 * way * asymmetry) + case.constants.friction
        if level > room:
            unit = "N" if case.scales.slide else "N.m"
            return (
                f"a dry friction of {level:.3g} {unit} would hold the joint, but it was recorded setting itself in "
                "motion "
                f"{'forwards' if way > 0 else 'backwards'} with at most {room:.3g} {unit} to drive it"
            )
    return ""


def _series(case: Case, run: int, name: str) -> np.ndarray:
    """A prescribed column at the samples of a run."""
    plant = case.plant
    rows = plant.rows(run)
    part = plant.series[plant._grid[run] : plant._grid[run + 1], SERIES_INDEX[name]]
    return np.interp(plant.t[rows] - plant.t[rows][0], plant.dt * np.arange(len(part)), part)


def _drive(case: Case, run: int) -> dict[int, np.ndarray]:
    """By direction: the most torque [S] that the drive may give that way."""
    plant = case.plant
    rows = plant.rows(run)
    shown, on = plant.torque[rows], _series(case, run, "enabled") > 0.5
    limit = float(plant.nominal[run][SERVO["torque_limit"]])
    limit = max(limit, case.ranges.get("torque_limit", (0.0, limit))[1])
    if "torque_limit" in case.unknown:
        limit = np.inf
    return {way: np.where(~on, 0.0, np.where(np.isfinite(shown), way * np.nan_to_num(shown), limit)) for way in (1, -1)}
