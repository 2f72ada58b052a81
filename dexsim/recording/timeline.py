"""Times that cannot be of the samples they stand at: clocks that were set back, stamps that jump for a moment, samples
far from all others."""

from __future__ import annotations

from bisect import bisect_right

import numpy as np

REORDERED = 0.1
"""s by which a time may go back because two messages changed places on their way; they are put in order of time."""
ALONE = 60.0
"""s without a sample; what lies beyond, and is less than FEW of all, does not belong to the recording."""
FEW = 0.05
LOST = 0.3
"""s: where samples are left out over at least as long, nothing is known of the time between those that stay."""


def possible(t: np.ndarray) -> np.ndarray:
    """Return [T] bool: the samples whose times t [T] s, in the order they were written, can be theirs.

    Where times only change places (by less than REORDERED), all can. Else the longest series of times that never goes
    back, of those that do not stand far from all others (ALONE, FEW). O(T log T)."""
    on = np.isfinite(t) & (np.abs(t) < 1e12)
    index = np.flatnonzero(on)
    if len(index) < 2:
        return on
    if (np.diff(t[index]) < -REORDERED).any() or _outliers(t[index]).any():
        index = index[~_outliers(t[index])]
        index = index[_longest(t[index])]
        index = index[~_outliers(t[index])]
    out = np.zeros(len(t), bool)
    out[index] = True
    return out


def _outliers(t: np.ndarray) -> np.ndarray:
    """Return [T] bool: times in groups of less than FEW of all, ALONE s from the next."""
    order = np.argsort(t, kind="stable")
    group = np.cumsum(np.r_[0, np.diff(t[order]) > ALONE])
    few = np.bincount(group) <= FEW * len(t)
    out = np.zeros(len(t), bool)
    out[order] = few[group]
    return out


def _longest(t: np.ndarray) -> np.ndarray:
    """Return indices of the longest series of times that never goes back (patience sorting)."""
    tails: list[float] = []
    at: list[int] = []
    before = np.full(len(t), -1)
    for i, x in enumerate(t.tolist()):
        k = bisect_right(tails, x)
        if k == len(tails):
            tails.append(x)
            at.append(i)
        else:
            tails[k], at[k] = x, i
        before[i] = at[k - 1] if k else -1
    out, i = [], at[-1] if at else -1
    while i >= 0:
        out.append(i)
        i = int(before[i])
    return np.array(out[::-1], int)


def gaps(t: np.ndarray, on: np.ndarray) -> list[tuple[float, float]]:
    """Stretches [s] in which times of samples that stay (on [T]) may be of either of two clocks: where at least LOST s
    and three samples in a row were left out, from the earliest to the latest of them. Another topic may have kept those
    that this one left out."""
    index = np.flatnonzero(on)
    if len(index) < 2:
        return []
    period, low, high = float(np.median(np.diff(t[index]))), t[index[0]], t[index[-1]]
    out = []
    for k in np.flatnonzero(np.diff(index) > 3):
        a, b = index[k], index[k + 1]
        if (b - a - 1) * period >= LOST:
            lost = t[a + 1 : b]
            around = np.r_[t[a], t[b], lost[(lost >= low) & (lost <= high)]]
            out.append((float(around.min()), float(around.max())))
    return out


def stretch(t: np.ndarray, pause: float = 1.0) -> tuple[float, float]:
    """Return (first, last) time [s] of the longest series of samples at times t [T] s, sorted, without a pause as long:
    what is laid on an even grid is laid over this, never over all that the stamps span."""
    edges = np.r_[0, np.flatnonzero(np.diff(t) > pause) + 1, len(t)]
    k = int(np.argmax(np.diff(edges)))
    return float(t[edges[k]]), float(t[edges[k + 1] - 1])
