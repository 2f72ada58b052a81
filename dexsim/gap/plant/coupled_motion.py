"""Motions sharper than their samples: what joints that hang on each other do to each other, from the simulation's own
accelerations.

Differentiating samples smears out every start and stop, and the neighbours of a joint feel its acceleration. Here each
joint is simulated along the recording with what is believed, and only the small difference from what was measured is
smoothed. Once something was fitted, `refine_motion_by_fits` does the same with that: what is left to be smoothed is
smaller, and so is its error.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from dexsim.gap import parallel
from dexsim.gap.plant.batch import JointPlant, Windows
from dexsim.gap.plant.case import Case, build, moved
from dexsim.gap.plant.columns import INDEX, SERIES_INDEX, expand
from dexsim.gap.read.runs import Run, local_polynomial

WIDTH = 0.06  # s: of the smoothing of the difference
EVERY = 2e-3  # s between the samples of the refined motion
PASSES = 2  # of building the cases along the motion that they show
# of a joint's typical torque: what reaches it from the motion of others before it matters how well that is known
COUPLED = 0.03


def refined_cases(
    model: mujoco.MjModel, runs: list[Run], device: str, dt: float, only: set[str] | None = None
) -> list[Case]:
    """A case a joint (of `only`), built along refined motions (`Run.fine`) where there are several joints."""
    if len(runs[0].joints) < 2:
        return build(model, runs, device, dt)
    for _ in range(PASSES):
        by_joint = moved(model, runs, lambda j, plant: _motions(runs, j, plant), device, dt, added=False).used
        _refine(runs, [by_joint[j] for j in range(len(by_joint))])
    return build(model, runs, device, dt, only)


def _motions(
    runs: Sequence[Run], j: int, plant: JointPlant, at: np.ndarray | None = None
) -> list[tuple[np.ndarray, ...]]:
    """By run what `_one` makes of joint j."""
    return [_one(plant, i, run.t, run.q[:, j], at) for i, run in enumerate(runs)]


def _refine(runs: Sequence[Run], motions: Sequence[Sequence[tuple[np.ndarray, ...]]]) -> None:
    """Writes `Run.fine`, of what each joint does in each run."""
    for i, run in enumerate(runs):
        columns = [by_run[i] for by_run in motions]
        run.fine = (columns[0][0], *(np.stack([c[k] for c in columns], 1) for k in (1, 2, 3)))


def coupled(cases: Sequence[Case]) -> bool:
    """Whether the joints' motions reach each other through the mechanism."""
    return any(float(np.std(c.plant.series[:, SERIES_INDEX["rest"]])) > COUPLED * c.scales.tau for c in cases)


def refine_motion_by_fits(
    model: mujoco.MjModel, runs: list[Run], cases: Sequence[Case], fitted: Sequence[Any], device: str, dt: float
) -> list[Case]:
    """The cases of all joints built anew along motions refined with what was fitted to each (trials, in the order of
    the cases). Where a joint's encoder was found not to show its position, the others are moved by where it is."""
    at = []
    for case, trial in zip(cases, fitted, strict=True):
        with_fixed = expand(case.plant, trial.fit.params, trial.fit.x[None])
        for name, value in (f for m in trial.members for f in m.variant.fixed):
            with_fixed[:, :, INDEX[name]] = value
        at.append(with_fixed)
    motion = parallel.each(len(cases), lambda j: _motions(runs, j, cases[j].plant, at[j]))
    misread = [j for j, trial in enumerate(fitted) if any(m.effect.misreads for m in trial.members)]

    def built(own: int | None) -> list[Case]:
        shown = lambda j, i: _true(motion[j][i], at[j][0, i]) if j in misread and j != own else motion[j][i]  # noqa: E731
        _refine(runs, [[shown(j, i) for i in range(len(runs))] for j in range(len(cases))])
        return build(model, runs, device=device, dt=dt)

    out = built(None)
    for j in misread:  # what a case holds of its own joint is what was measured
        out[j] = built(j)[j]
    for new, old in zip(out, cases, strict=True):
        new.ranges, new.unknown, new.factors, new.told = old.ranges, old.unknown, old.factors, old.told
        new.plant.nominal = old.plant.nominal  # with what the recorded torque told
        new.scales.nominal.update(old.scales.nominal)
    return out


def _true(shown: tuple[np.ndarray, ...], row: np.ndarray) -> tuple[np.ndarray, ...]:
    """Motion (times, q, v, a) as an encoder shows it -> as it is, by plant parameters [C]."""
    t, q, v, a = shown
    scale, offset, es, ec = (
        row[INDEX[k]] for k in ("position_scale", "position_offset", "eccentric_sin", "eccentric_cos")
    )
    x = (q - offset) / scale
    for _ in range(3):
        x = (q - offset - es * np.sin(x) - ec * (np.cos(x) - 1)) / scale
    rate = scale + es * np.cos(x) - ec * np.sin(x)
    speed = v / rate
    return t, x, speed, (a + (es * np.sin(x) + ec * np.cos(x)) * speed**2) / rate


def _one(
    plant: JointPlant, run: int, t: np.ndarray, q: np.ndarray, at: np.ndarray | None = None
) -> tuple[np.ndarray, ...]:
    """Times [n] s, and position, speed and acceleration [n] of one joint in one run; at [1, R, C]: plant parameters
    (None: believed)."""
    every = max(int(round(EVERY / plant.dt)), 1)
    times, windows = fine_windows(plant, run, every)
    x = plant.simulate(plant.base()[None] if at is None else at, windows)[0][0]
    step = every * plant.dt
    if not np.isfinite(x).all() or np.abs(x - np.interp(times, t, q)).max() > 1.0:  # the belief does not follow at all
        x = np.interp(times, t, local_polynomial(t, q[:, None])[0][:, 0])
    v = np.gradient(x, step)
    v = np.convolve(np.pad(v, 1, mode="edge"), [0.25, 0.5, 0.25], mode="valid")
    a = np.gradient(v, step)
    miss, dv, da = (c[:, 0] for c in local_polynomial(t, (q - np.interp(t, times, x))[:, None], WIDTH))
    fine = lambda y: np.interp(times, t, y)  # noqa: E731
    return times, x + fine(miss), v + fine(dv), a + fine(da)


def fine_windows(plant: JointPlant, run: int, every: int) -> tuple[np.ndarray, Windows]:
    """Times [n] s and the window of a whole run, free from its first sample, seen at every `every`-th step."""
    whole = plant.windows(None, [run], every_run=True)
    window = whole.window[:1].copy()
    steps = np.arange(0, window[0, 1], every, dtype=np.int32)
    window[0, 3], window[0, 4] = 0, len(steps)
    n = len(steps)
    times = whole.window_t[0] + plant.dt * steps
    return times, Windows(
        window, whole.window_t[:1], steps, np.zeros(n), np.zeros(n, int), np.zeros(n, int), whole.run[:1]
    )
