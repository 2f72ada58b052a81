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
AFTER = 0.06
"""s after a jump of its target in which a drive's effort may well be a single high sample."""


def spiked(x: np.ndarray, quantity: str) -> np.ndarray:
    """[T] bool: samples of x [T] that are single spikes (at most two in a row); none where x is not finite nearly
    everywhere."""
    out = np.zeros(len(x), bool)
    ok = np.flatnonzero(np.isfinite(x))
    if len(ok) < 20:
        return out
    v = x[ok]
    padded = np.pad(v, WIDTH, mode="reflect", reflect_type="odd")
    around = np.lib.stride_tricks.sliding_window_view(padded, 2 * WIDTH + 1)
    off = v - np.median(around, axis=1)
    size = np.abs(off)
    low, high = np.quantile(v, [0.025, 0.975])
    least = max(FAR * float(np.quantile(size, 0.9)), SPAN[quantity] * (high - low), LEAST[quantity], 1e-12)
    far = size > least
    # what comes back: the samples beside it, but for others of its kind, lie close together
    near = np.where(far, np.nan, v)
    for _ in range(2):
        near = np.where(np.isnan(near), np.r_[np.nan, near[:-1]], near)
    left = np.r_[np.nan, near[:-1]]
    near = np.where(far, np.nan, v)
    for _ in range(2):
        near = np.where(np.isnan(near), np.r_[near[1:], np.nan], near)
    right = np.r_[near[1:], np.nan]
    apart = np.abs(right - left)
    back = np.isnan(apart) | (
        apart
        < 0.5
        * np.minimum(
            np.abs(v - np.where(np.isnan(left), v - off, left)), np.abs(v - np.where(np.isnan(right), v - off, right))
        )
    )
    far &= back
    if far.mean() > MOST:
        return out
    out[ok[far]] = True
    return out


def of_effort(r: Recording, j: int) -> np.ndarray:
    """[T] bool: spikes of a joint's effort, but for those that a jump of its target may have caused."""
    effort = r.states.effort
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
