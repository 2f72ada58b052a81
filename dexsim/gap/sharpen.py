"""Motions sharper than their samples: what joints that hang on each other do to each other, from the simulation's own accelerations.

Differentiating samples smears out every start and stop, and the neighbours of a joint feel its acceleration. Here each joint
is simulated along the recording with what is believed, and only the small difference from what was measured is smoothed.
"""

from __future__ import annotations

import mujoco
import numpy as np

from dexsim.gap.plant import JointPlant, Windows
from dexsim.gap.prepare import Case, build
from dexsim.gap.runs import Run, local_polynomial

WIDTH = 0.06  # s: of the smoothing of the difference
EVERY = 2e-3  # s between the samples of the sharpened motion
PASSES = 2


def sharpen(model: mujoco.MjModel, runs: list[Run], cases: list[Case], device: str, dt: float, progress=None, only: set[str] | None = None) -> list[Case]:
    """The cases (at last those of `only`) built again along sharpened motions (`Run.fine`); as they are where there is one joint only.

    Else the list `cases` is emptied: together, long recordings of many joints before and after would not fit into memory.
    """
    if len(cases) < 2:
        return cases
    for k in range(PASSES):
        for i, run in enumerate(runs):
            columns = [_one(case.plant, i, run.t, run.q[:, j]) for j, case in enumerate(cases)]
            run.fine = (columns[0][0], *(np.stack([c[k] for c in columns], 1) for k in (1, 2, 3)))
        cases.clear()
        cases = build(model, runs, device=device, dt=dt, progress=progress, only=only if k == PASSES - 1 else None)
    return cases


def _one(plant: JointPlant, run: int, t: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, ...]:
    """Times [n] s, and position, speed and acceleration [n] of one joint in one run."""
    every = max(int(round(EVERY / plant.dt)), 1)
    times, windows = fine_windows(plant, run, every)
    x = plant.simulate(plant.base()[None], windows)[0][0]
    step = every * plant.dt
    if not np.isfinite(x).all() or np.abs(x - np.interp(times, t, q)).max() > 1.0:  # the belief does not follow at all
        x = np.interp(times, t, local_polynomial(t, q[:, None])[0][:, 0])
    v = np.gradient(x, step)
    v = np.convolve(np.pad(v, 1, mode="edge"), [0.25, 0.5, 0.25], mode="valid")
    a = np.gradient(v, step)
    miss, dv, da = (c[:, 0] for c in local_polynomial(t, (q - np.interp(t, times, x))[:, None], WIDTH))
    at = lambda y: np.interp(times, t, y)  # noqa: E731
    return times, x + at(miss), v + at(dv), a + at(da)


def fine_windows(plant: JointPlant, run: int, every: int) -> tuple[np.ndarray, Windows]:
    """Times [n] s and the window of a whole run, free from its first sample, seen at every `every`-th step."""
    whole = plant.windows(None, [run])
    window = whole.window[:1].copy()
    steps = np.arange(0, window[0, 1], every, dtype=np.int32)
    window[0, 3], window[0, 4] = 0, len(steps)
    n = len(steps)
    times = whole.window_t[0] + plant.dt * steps
    return times, Windows(window, whole.window_t[:1], steps, np.zeros(n), np.zeros(n, int), np.zeros(n, int), whole.run[:1])
