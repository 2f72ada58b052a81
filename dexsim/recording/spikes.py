"""Single samples far from their neighbours: a disturbed bus, a torn message, a bit that fell over.

What a sample is compared with is the median of its neighbours, and how far it may be off is read from the better nine
tenths of all samples: up to a tenth of them may be spikes, two of them beside each other, without hiding one another.
"""

from __future__ import annotations

import numpy as np

from dexsim.recording.schema import Recording

WIDTH = 3
"""Neighbours on each side: two spikes beside each other are still the fewer of seven."""
FAR = 8.0
"""x the ninth decile of all misfits."""
SPAN = {"position": 0.05, "command": 0.05, "effort": 0.25}
"""Least size, of the span that nineteen in twenty values keep to."""
LEAST = {"position": 0.03, "command": 0.03, "effort": 0.0}
"""Least size: rad (m); less does no harm."""
MOST = 0.12
"""More of all samples are no spikes but the signal."""
NEARBY, JUMP = 10, 2.0
"""A spike is reached and left by more than so many times what the samples so near it (on each side) change by: the
crest of a fast chirp is as far from the median of its neighbours, and is reached in steps like any other."""
ROW = 2
"""Spikes beside each other; a longer row is the crest of a fast reversal, where a message may be missing too."""
LEVELS = 5
"""Plateaus at one value from which on it is a level that a command (a pulse train, a pseudo-random binary sequence)
goes to on purpose."""
AFTER = 0.06
"""s after a jump of its target in which a drive's effort may well be a single high sample."""


def spiked(x: np.ndarray, quantity: str) -> np.ndarray:
    """Return [T] bool: samples of x [T] that are single spikes (at most two in a row); none where x is not finite
    nearly everywhere."""
    out = np.zeros(len(x), bool)
    ok = np.flatnonzero(np.isfinite(x))
    if len(ok) < 20:
        return out
    v = x[ok]
    # continued beyond both ends by its odd reflection
    padded = np.concatenate([2 * v[0] - v[WIDTH:0:-1], v, 2 * v[-1] - v[-2 : -2 - WIDTH : -1]])
    around = np.lib.stride_tricks.sliding_window_view(padded, 2 * WIDTH + 1)
    off = v - np.partition(around, WIDTH, axis=1)[:, WIDTH]
    size = np.abs(off)
    # by one reason after another, the dearest last: most signals have no sample that is far by the first
    far = size > max(LEAST[quantity], 1e-12)
    if far.any():
        far &= size > FAR * float(np.quantile(size, 0.9))
    if far.any():
        low, high = np.quantile(v, [0.025, 0.975])
        far &= ~(size <= SPAN[quantity] * (high - low))  # huge values may have no span: not a number
    if not far.any():
        return out
    # what comes back: the samples beside it, but for others of its kind, lie close together
    near = np.where(far, np.nan, v)
    for _ in range(2):
        near = np.where(np.isnan(near), np.r_[np.nan, near[:-1]], near)
    prior = np.r_[np.nan, near[:-1]]
    near = np.where(far, np.nan, v)
    for _ in range(2):
        near = np.where(np.isnan(near), np.r_[near[1:], np.nan], near)
    following = np.r_[near[1:], np.nan]
    change = np.abs(following - prior)
    back = np.isnan(change) | (
        change
        < 0.5
        * np.minimum(
            np.abs(v - np.where(np.isnan(prior), v - off, prior)),
            np.abs(v - np.where(np.isnan(following), v - off, following)),
        )
    )
    far &= back
    far &= _jumps(v, far)
    if quantity == "command" and far.any():
        far &= ~_on_purpose(v)
    if far.mean() > MOST:
        return out
    out[ok[far]] = True
    return out


def _jumps(v: np.ndarray, far: np.ndarray) -> np.ndarray:
    """Return [n] bool: of samples `far`, those of a stretch of at most `ROW` that begins and ends with a jump (`JUMP`);
    False elsewhere."""
    out = np.zeros(len(v), bool)
    step = np.abs(np.diff(v))
    usual = np.where(far[1:] | far[:-1], np.nan, step)
    edge = np.flatnonzero(np.diff(np.r_[0, far.astype(int), 0]))
    for a, b in zip(edge[::2], edge[1::2], strict=True):
        if b - a > ROW:
            continue
        ordinary = usual[max(a - NEARBY, 0) : b + NEARBY]
        ordinary = ordinary[np.isfinite(ordinary)]
        most = float(np.quantile(ordinary, 0.8)) if len(ordinary) else 0.0
        sides = [step[k] for k in (a - 1, b - 1) if 0 <= k < len(step)]
        out[a:b] = all(x > JUMP * most for x in sides)
    return out


def _on_purpose(v: np.ndarray) -> np.ndarray:
    """Return [n] bool: samples at a value that is held for three samples and more at least `LEVELS` times, between
    others that are."""
    same = np.r_[False, np.abs(np.diff(v)) <= 1e-6 * max(float(np.ptp(v)), 1e-12)]
    start = np.flatnonzero(~same)
    length = np.diff(np.r_[start, len(v)])
    level = np.round(v / max(1e-5 * float(np.ptp(v)), 1e-12)).astype(np.int64)
    held, count = np.unique(level[start[length >= 3]], return_counts=True)
    on = np.isin(level, held[count >= LEVELS])
    return on & np.r_[True, on[:-1]] & np.r_[on[1:], True]


def of_effort(r: Recording, j: int) -> np.ndarray:
    """Return [T] bool: spikes of a joint's effort, but for those that a jump of its target may have caused."""
    effort = r.states.effort
    assert effort is not None  # asked for where there is effort
    out = spiked(effort.value[:, j], "effort")
    if not out.any() or not len(r.commands):
        return out
    c = r.commands.value[:, j]
    ok = np.isfinite(c)
    t, steps = r.commands.t[ok][1:], np.abs(np.diff(np.where(spiked(c, "command"), np.nan, c)[ok]))
    usual = float(np.nanmedian(steps)) if len(steps) else 0.0
    jumps = t[np.nan_to_num(steps) > max(5 * usual, 0.01)]
    if len(jumps):
        k = np.searchsorted(jumps, effort.t, side="right") - 1
        since = np.where(k >= 0, effort.t - jumps[np.maximum(k, 0)], np.inf)
        out &= since > AFTER
    return out
