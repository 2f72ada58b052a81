"""Where a firmware's setpoint is in the middle of a recording: its law alone, over the commands sent until then."""

# No `from __future__ import annotations`: Warp resolves these annotations from the closure.

from functools import cache
from typing import Any

import numpy as np
import warp as wp

from dexsim.actuator.columns import DELAYS, INDEX
from dexsim.actuator.laws import arrived, profiled

f64 = wp.float64
FREE = 1e8  # rad/s, rad/s2: a limit from here on is none (`laws.lost_error`)
PROFILE = ("profile_speed", "profile_acceleration")


@cache
def _kernel() -> wp.Kernel:
    @wp.kernel(module="unique", enable_backward=False)
    def follow(
        dt: f64, t0: f64, limits: wp.array2d(dtype=f64), begun: wp.array2d(dtype=f64), stamps: wp.array(dtype=f64),
        targets: wp.array2d(dtype=f64), steps: wp.array(dtype=int), out: wp.array3d(dtype=f64),
    ):  # fmt: skip
        n = wp.tid()
        column = wp.min(n, targets.shape[1] - 1)
        at = begun[n, 0]
        speed = begun[n, 1]
        k = int(-1)  # no command yet: it rests
        i = int(0)
        for w in range(steps.shape[0]):
            while i < steps[w]:
                end = t0 + f64(i + 1) * dt - limits[n, 2]
                while k + 1 < stamps.shape[0] and stamps[k + 1] <= end - dt:
                    k += 1
                target = begun[n, 0]
                if k >= 0:
                    target = targets[k, column]
                before = target
                kk = k + 1
                while kk < stamps.shape[0] and stamps[kk] < end:
                    target += arrived(end, stamps[kk], dt) * (targets[kk, column] - before)
                    before = targets[kk, column]
                    kk += 1
                if i > 0:  # the first step says where the joint is
                    now = profiled(at, speed, target, limits[n, 0], limits[n, 1], dt)
                    at = now[0]
                    speed = now[1]
                i += 1
            out[n, w, 0] = at
            out[n, w, 1] = speed

    return follow


def setpoints(
    rows: np.ndarray, begun: np.ndarray, stamps: np.ndarray, targets: np.ndarray, start: float, times: np.ndarray,
    dt: float,
) -> np.ndarray:  # fmt: skip
    """Return the setpoint [rad] and its speed [rad/s] at `times` [W] s, [N, W, 2]: by the law of `laws.profiled` in
    steps of dt s, from position and speed `begun` [N, 2] at `start` s.

    rows [N, C]: servo columns; stamps [K] s, targets [K, 1 or N] rad: commands. NaN where no profile limits it, another
    joint drags the target, or no time has passed: there the joint tells."""
    out = np.full((len(rows), len(times), 2), np.nan)
    steps = np.rint((np.asarray(times) - start) / dt).astype(np.int32)
    limits = np.c_[rows[:, [INDEX[name] for name in PROFILE]], rows[:, [INDEX[name] for name in DELAYS]].sum(1)]
    mine = np.flatnonzero((limits[:, :2] < FREE).any(1) & (rows[:, INDEX["coupling"]] == 0))
    later = np.flatnonzero(steps > 0)
    later = later[np.argsort(steps[later], kind="stable")]
    if not len(mine) or not len(later) or not len(stamps):
        return out
    shared = targets.shape[1] == 1
    given = np.c_[limits, begun][mine]  # guesses of a search differ in other columns, mostly
    once, each = np.unique(given, axis=0, return_inverse=True) if shared else (given, np.arange(len(mine)))
    made = np.empty((len(once), len(later), 2))
    arrays = (once[:, :3], once[:, 3:], np.asarray(stamps, float), targets if shared else targets[:, mine])
    up: list[Any] = [wp.array(np.ascontiguousarray(x), dtype=f64, device="cpu") for x in arrays]
    there: Any = wp.array(made, dtype=f64, device="cpu", copy=False)
    inputs = [dt, start, *up, wp.array(steps[later], dtype=int, device="cpu"), there]
    wp.launch(_kernel(), dim=len(once), inputs=inputs, device="cpu")
    out[np.ix_(mine, later)] = made[each.ravel()]
    return out
