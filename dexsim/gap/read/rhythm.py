"""An encoder that is read more seldom than it is logged: the rhythm of its readings, and the samples between them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dexsim.gap.read.runs import Run

LEAP = 3.0  # steps of the encoder: a reading that stood and changes by as many at once has been read anew
OFTEN = 0.25  # of all its changes: so many leaps
SELDOM = 4.0  # samples, at least, from one new reading to the next
RHYTHM = 0.85  # mean length of the times of new readings round their period: 1 all in step, 0 none
ANEW = 10  # new readings that make a rhythm


def common(runs: Sequence[Run], joint: str) -> float:
    """s between readings of a joint that is read more seldom than it is logged, in most of the runs that can tell; 0
    else."""
    told = [rhythm(r.t, r.q[:, r.joints.index(joint)]) for r in runs if joint in r.joints]
    told = [x for x in told if not np.isnan(x)]
    slow = [x for x in told if x > 0]
    return float(np.median(slow)) if slow and len(slow) > 0.5 * len(told) else 0.0


def rhythm(t: np.ndarray, q: np.ndarray) -> float:
    """s from one reading to the next of an encoder that is read at a slower rate than it is logged; 0 where each sample
    is a reading of its own, NaN where it moves too little to tell.

    Such a position leaps, by several of its smallest steps within one sample, at the beats of one rhythm. A joint that
    turns slowly past a coarse encoder's steps has a rhythm but no leaps, one that sticks and slips leaps but in no
    rhythm."""
    change = np.flatnonzero(np.diff(q) != 0) + 1
    if len(change) < ANEW:
        return float("nan")
    size, since = np.abs(q[change] - q[change - 1]), np.diff(t[change])
    leap, usual = t[change[size > LEAP * size.min()]], float(np.median(since))
    if len(leap) < OFTEN * len(change) or usual < SELDOM * float(np.median(np.diff(t))):
        return 0.0
    if np.mean(since < 0.7 * usual) > 0.1:  # it moves between its leaps
        return 0.0
    if len(leap) < ANEW:
        return float("nan")
    period, turn = _beat(leap, usual, 0.1)
    return period if np.abs(turn) > RHYTHM else 0.0


def between(t: np.ndarray, q: np.ndarray, period: float) -> np.ndarray:
    """[S] bool: samples that repeat the last reading of an encoder that is read every `period` s. New readings are
    those that differ from the one before and, at the beats without one, the sample next to it."""
    change = np.flatnonzero(np.diff(q) != 0) + 1
    old = np.ones(len(t), bool)
    old[change] = False
    first = float(t[0])
    if len(change):
        period, turn = _beat(t[change], period, 0.01)
        first = float(np.angle(turn)) / (2 * np.pi) * period
    beats = first + period * np.arange(np.ceil((t[0] - first) / period), np.floor((t[-1] - first) / period) + 1)
    if len(change):
        i = np.clip(np.searchsorted(t[change], beats), 1, max(len(change) - 1, 1))
        near = t[change[np.stack([i - 1, np.minimum(i, len(change) - 1)])]]
        beats = beats[np.abs(near - beats).min(0) > 0.4 * period]
    old[np.clip(np.searchsorted(t, beats), 0, len(t) - 1)] = False
    return old


def _beat(t: np.ndarray, period: float, within: float) -> tuple[float, complex]:
    """(period within a share of the given one with which times t are most in step, mean of their turns round it)."""
    # at neighbouring ones the first and the last time are a sixteenth of a turn apart
    n = int(32 * within * (t[-1] - t[0]) / period) + 3
    periods = period * np.linspace(1 - within, 1 + within, min(n, 4001))
    turns = np.exp(2j * np.pi * t[None] / periods[:, None]).mean(1)
    best = int(np.argmax(np.abs(turns)))
    return float(periods[best]), complex(turns[best])
