"""Errors on what was kept out of the fit, the floor, when an effect acts, the verdict."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dexsim import intervals
from dexsim.gap.plant.batch import Windows
from dexsim.gap.plant.case import Case
from dexsim.gap.plant.columns import INDEX, Param, expand
from dexsim.gap.read.runs import BLOCK, Run, same_commands, spans

UNDERWAY = 0.1  # of a joint's speed: a recording that begins with as much begins in motion, and its
FIRST = 0.1  # s tell where and how fast: within
START_NOISE, START_SPEED = 10.0, 0.2  # x the noise, and of a joint's speed, of what the samples about its first say
DRAWS = 400  # of a bootstrap


def floor(runs: list[Run], cases: list[Case]) -> tuple[float, str]:
    """(noise floor of the position error, how): from repeats of the same commands, else from split samples, else from
    the encoder's quantum. Root mean square over joints."""
    each, how = floors(runs, cases)
    if how == "repeats":
        return float(np.sqrt(np.mean([each[c.joint] ** 2 for c in cases]))), how
    split = float(np.sqrt(np.mean([c.sigma**2 for c in cases])))
    quantum = float(np.sqrt(np.mean([c.quantum**2 for c in cases]))) / np.sqrt(12)
    return split, "quantum" if split <= 1.02 * quantum else "split"


def floors(runs: list[Run], cases: list[Case]) -> tuple[dict[str, float], str]:
    """(noise floor of each joint's position error, how): from repeats where there are any, never below the noise of its
    samples.

    Repeats hold what differs from run to run (friction, temperature, how it is mounted), which no effect can
    explain."""
    pairs = repeats(runs)
    if not any(len(_common(a, b)) for a, b in pairs):
        return {c.joint: c.sigma for c in cases}, "split"
    apart = {c.joint: _apart([((a, a.t, a.q[:, c.index]), (b, b.t, b.q[:, c.index])) for a, b in pairs]) for c in cases}
    return {c.joint: max(apart[c.joint], c.sigma) for c in cases}, "repeats"


def repeats(runs: list[Run]) -> list[tuple[Run, Run]]:
    """Pairs of runs of the same commands; pieces of one recording are aligned only by where they were cut."""
    return [(a, b) for i, a in enumerate(runs) for b in runs[i + 1 :] if a.name != b.name and same_commands(a, b)]


def floor_beyond(
    case: Case, runs: list[Run], params: list[Param], x: np.ndarray, fixed: Sequence[tuple[str, float]] = ()
) -> float:
    """Noise floor of a joint's position error [rad or m] from what repeats differ by beyond what a fit says that they
    do (a drive that was warmer in one of them moves otherwise, and that is no noise); never below the noise of its
    samples, inf without repeats."""
    number = {id(run): k for k, run in enumerate(runs)}
    pairs = [p for p in repeats(runs) if not {number[id(r)] for r in p} & case.plant.left_out]
    if not any(len(_common(a, b)) for a, b in pairs):
        return float("inf")
    windows = case.plant.windows(None, sorted({number[id(r)] for p in pairs for r in p}))
    rows = windows.sample_row
    left = case.plant.q[rows] - free_run(case, params, x, windows, fixed, True)[0]

    def of(run: Run) -> tuple[Run, np.ndarray, np.ndarray]:
        mine = case.plant.run_of[rows] == number[id(run)]
        return run, case.plant.t[rows][mine], left[mine]

    return max(_apart([(of(a), of(b)) for a, b in pairs]), case.sigma)


def _common(a: Run, b: Run) -> np.ndarray:
    """Times since their starts [s] at which repeats are compared: they are aligned by their commands, which were sent
    at the same times from the start."""
    return np.arange(0.2, min(a.duration, b.duration) - 0.05, 0.01)


def _apart(pairs) -> float:
    """Standard deviation by which what (run, times [S] s, values [S]) have in pairs of repeats scatters."""
    d = []
    for (a, ta, xa), (b, tb, xb) in pairs:
        t = _common(a, b)
        d.append(np.interp(a.t[0] + t, ta, xa) - np.interp(b.t[0] + t, tb, xb))
    return float(np.sqrt(np.mean(np.concatenate(d) ** 2) / 2.0))


def free_run(
    case: Case,
    params: list[Param],
    x: np.ndarray,
    windows: Windows,
    fixed: Sequence[tuple[str, float]] = (),
    underway: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Simulated position and motor torque [n] at the windows' samples, from their first sample on without correction.

    underway: the position at which a window begins in motion, and its speed there, are fitted to its first `FIRST`
    seconds: what a few samples on one side say of a speed is off by far where a target has just jumped."""
    plants = expand(case.plant, params, x[None])
    for name, value in fixed:
        plants[:, :, INDEX[name]] = value
    q, tau = _begun(case, plants, windows) if underway else case.plant.simulate(plants, windows)
    return q[0], plants[0, 0, INDEX["effort_gain"]] * tau[0] + plants[0, 0, INDEX["effort_offset"]]


def _begun(case: Case, plants: np.ndarray, windows: Windows) -> tuple[np.ndarray, np.ndarray]:
    """Position and torque [1, n] of one guess [1, R, C], windows that begin in motion from where their first samples
    say they did."""
    sigma, window, t = case.sigma, windows.sample_window, case.plant.t[windows.sample_row]
    first = np.flatnonzero(np.r_[True, np.diff(window) != 0]) if len(window) else np.zeros(0, int)
    moving = np.abs(case.regimes["_speed"][windows.sample_row[first]]) > UNDERWAY * case.scales.speed
    if not moving.any():
        return case.plant.simulate(plants, windows)
    size = np.array([START_NOISE * sigma, START_SPEED * case.scales.speed])
    q, tau = case.plant.simulate(
        np.repeat(plants, 3, 0), windows, np.array([[0.0, 0.0], [size[0], 0.0], [0.0, size[1]]])
    )
    slope, measured, which = q[1:] - q[0], case.plant.q[windows.sample_row], np.flatnonzero(moving)
    starts = []
    for k in which:
        early = (window == window[first[k]]) & (t < t[first[k]] + FIRST)
        A = np.concatenate([slope[:, early].T / sigma, np.eye(2)])
        starts.append(size * np.linalg.lstsq(A, np.r_[(measured - q[0])[early] / sigma, 0.0, 0.0], rcond=None)[0])
    again = case.plant.simulate(np.repeat(plants, len(which), 0), windows, np.array(starts))
    for i, k in enumerate(which):
        mine = window == window[first[k]]
        q[0, mine], tau[0, mine] = again[0][i, mine], again[1][i, mine]
    return q[:1], tau[:1]


def rms_interval(
    squares: list[np.ndarray], times: list[np.ndarray], seed: int = 0, block: float = BLOCK
) -> tuple[float, float, float]:
    """(rms, low, high): 90 % by a bootstrap over half-second blocks of squared errors, drawn alike for all joints."""
    sums, counts = [], []
    for s, t in zip(squares, times, strict=True):
        b = ((t - t[0]) / block).astype(int) if len(t) else np.zeros(0, int)
        if len(b):
            sums.append(np.bincount(b, s))
            counts.append(np.bincount(b))
    if not sums:
        return 0.0, 0.0, 0.0
    sums, counts = np.concatenate(sums), np.concatenate(counts)
    sums, counts = sums[counts > 0], counts[counts > 0]
    mean = lambda s, n, axis=-1: np.sqrt(s.sum(axis) / n.sum(axis))  # noqa: E731
    values = intervals.draws((sums, counts), mean, seed, DRAWS)
    return float(np.sqrt(sums.sum() / counts.sum())), float(np.quantile(values, 0.05)), float(np.quantile(values, 0.95))


def intervals_of(active: np.ndarray, case: Case, runs: list[Run], use: list[int], join: float = 0.03) -> list[dict]:
    """Stretches of time in which `active` [n] bool holds, by recording, short gaps joined; the longest 400."""
    out = []
    for r in use:
        rows = case.plant.rows(r)
        t, on = case.plant.t[rows], active[rows]
        merged = spans(t, on, join)
        out += [{"recording": runs[r].name, "start": round(float(a), 4), "end": round(float(b), 4)} for a, b in merged]
    out.sort(key=lambda w: w["start"] - w["end"])
    out = out[:400]
    return sorted(out, key=lambda w: (w["recording"], w["start"]))
