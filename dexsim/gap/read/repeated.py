"""Readings that repeat old ones for a while: a bus that sends again what it read last, an encoder that is not read.

Quantised readings of a joint at rest repeat honestly, and so do those of one that sticks while its target creeps. Two
things give a frozen one away, both by what the same joint does elsewhere in its recordings. It ends in a jump: between
two samples the reading goes faster than just before and just after, by more than a mass can (noise, quantum and
stick-slip make such pulses too, but not one of this size). And its target went a way in the meantime that the joint has
never let pass before.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dexsim.gap.read.runs import Run
from dexsim.recording.audit_values import repeats

LONG = 0.1  # s: what stays the same for as long is looked at
PULSE = 2.0  # x the largest pulse that does not end a rest
PASSED = 2.0  # x the way that a target has gone during another rest
WAY = 0.1  # of all the way that the target spans: less tells nothing
OFTEN = 0.02  # of a recording's samples (and `FEW` at least): repeated ones of a moving joint are named from there on
FEW = 8


def rests(q: np.ndarray) -> list[tuple[int, int]]:
    """(first, last) sample of each stretch of readings that are all the same."""
    edge = np.flatnonzero(np.diff(np.r_[0, (np.diff(q) == 0).astype(int), 0]))
    return list(zip(edge[::2].tolist(), edge[1::2].tolist(), strict=True))


def pulses(t: np.ndarray, q: np.ndarray) -> np.ndarray:
    """[S - 1] how far the step after each sample goes beyond what the faster of the steps beside it would give in its
    time; 0 where one beside it goes the other way just as far (a reading that comes back is a spike, not a jump)."""
    dt, dq = np.maximum(np.diff(t), 1e-6), np.diff(q)
    speed = dq / dt
    before, after = np.r_[0.0, speed[:-1]], np.r_[speed[1:], 0.0]
    sign = np.sign(dq)
    beside = np.maximum(np.maximum(before * sign, after * sign), 0.0)
    back = np.minimum(np.r_[0.0, dq[:-1]] * sign, np.r_[dq[1:], 0.0] * sign) < -0.5 * np.abs(dq)
    return np.where(back, 0.0, np.maximum(np.abs(speed) - beside, 0.0) * np.minimum(dt, 2 * np.median(dt)))


def stretches(runs: Sequence[Run], joint: str) -> list[list[tuple[int, int]]]:
    """Of each run, (first, last) sample of the stretches in which the joint's readings are old ones; `last` is the last
    old one. Runs without the joint have none."""
    seen: list[tuple[int, int, int, float, float]] = []  # run, first, last, pulse at its end, way of the target
    pulse, spans = [], []
    for k, run in enumerate(runs):
        if joint not in run.joints or len(run.t) < 20:
            continue
        j = run.joints.index(joint)
        q, cmd = run.q[:, j], run.command_at(run.t)[:, j]
        size = pulses(run.t, q)
        spans.append(float(np.ptp(cmd)))
        for a, b in rests(q):
            if b + 1 < len(q) and run.t[b] - run.t[a] >= LONG:
                seen.append((k, a, b, float(size[b]), float(np.ptp(cmd[a : b + 1]))))
                size[b] = 0.0
        pulse.append(size)
    out: list[list[tuple[int, int]]] = [[] for _ in runs]
    if not seen:
        return out
    usual = float(max(x.max() for x in pulse))
    jump = [s for s in seen if s[3] > PULSE * usual]
    passed = max((s[4] for s in seen if s not in jump), default=0.0)
    for k, a, b, _, way in jump:
        if way > max(PASSED * passed, WAY * max(spans)):
            out[k].append((a, b))
    return out


def duplicates(t: np.ndarray, q: np.ndarray) -> np.ndarray:
    """[S] bool: single readings that repeat the one before in a steady motion and are made up for by the next; none
    where there are few."""
    again = repeats(t, q)
    return again if again.sum() >= max(FEW, OFTEN * len(t)) else np.zeros(len(t), bool)
