"""From a press recording to steady levels: for each joint that presses, effort and fingertip force while nothing
moves."""

from __future__ import annotations

import numpy as np

from dexsim.calibration.line import Levels
from dexsim.errors import UserError
from dexsim.hand import Hand
from dexsim.recording.schema import STATES, Recording, Series

HOLD_S, SETTLE = 0.2, 0.5
"""A level is a constant command for at least HOLD_S [s]; its last SETTLE share is averaged."""
MOVED = 5e-3  # rad between levels that tells a pressing joint from a holding one
CONTACT = 0.3  # N under which nothing is touched


def finger_force(recording: Recording) -> tuple[Series, np.ndarray]:
    """Return (normal force [T, F] N of each fingertip, whether a taxel stood at its largest count [T, F])."""
    if recording.tactile is None:
        raise UserError(f"{recording.path}: has no /tactile: force cannot be calibrated without the fingertips' force")
    newtons = recording.tactile_newtons()
    assert newtons is not None  # there is touch
    full = np.zeros(newtons.value.shape[:2], bool)
    if recording.meta["tactile_unit"] == "count":
        full = (np.abs(recording.tactile.value[..., 2]) >= 255).any(-1)
    return Series(newtons.t, newtons.value[..., 2].sum(-1)), full


def levels_of(recording: Recording, hand: Hand) -> dict[str, Levels]:
    """Return the steady presses by joint. A joint presses where its command steps from level to level; where no command
    moves (the fingertip is pressed from outside), every joint of the finger that is touched counts.

    Raises UserError for a recording without effort, its sign, or touch.
    """
    effort = recording.signed_effort()
    if effort is None:
        raise UserError(f"{recording.path}: has no effort in {STATES}: neither current nor torque to calibrate")
    force, full = finger_force(recording)
    if force.value.shape[1] != len(hand.fingers):
        raise UserError(
            f"{recording.path}: /tactile has {force.value.shape[1]} pads, hand={hand.name} has"
            f" {len(hand.fingers)} fingers"
        )
    finger = dict(zip(hand.joints, hand.finger_of_joint, strict=True))
    joints = [j for j in recording.joints if finger.get(j, -1) >= 0]  # a wrist presses with no fingertip
    column = {j: recording.joints.index(j) for j in joints}
    lost = [j for j in joints if np.isnan(effort.value[:, column[j]]).all()]
    if len(lost) == len(joints):
        raise UserError(f"{recording.path}: the effort's sign is not known; state meta.effort_sign=+1 or -1")
    holds = _holds(recording)
    windows = {j: _pressing(recording, column[j], holds) for j in joints if j not in lost}
    if all(len(w) < 3 for w in windows.values()):  # pressed from outside
        steady = [(a, b, float(force.t[a]), float(force.t[b - 1])) for a, b in _steady(force)]
        for j in windows:
            pressed = [w for w in steady if force.value[w[0] : w[1], finger[j]].mean() > CONTACT]
            windows[j] = [(begin, end, float("nan")) for *_, begin, end in pressed]
    found = {
        j: _collect(recording, effort, force, full, finger[j], column[j], w) for j, w in windows.items() if len(w) >= 3
    }
    return {j: levels for j, levels in found.items() if levels is not None}


def _holds(recording: Recording) -> list[tuple[float, float]]:
    """Times (start, end) during which no command changes, at least HOLD_S long."""
    c = recording.commands
    if len(c) < 2:
        return []
    value = np.nan_to_num(c.value)
    change = np.flatnonzero((np.abs(np.diff(value, axis=0)) > 1e-5).any(1)) + 1
    edges = [0.0 if not len(c) else float(c.t[0]), *c.t[change], float(max(c.t[-1], recording.duration))]
    return [(a, b) for a, b in zip(edges[:-1], edges[1:], strict=True) if b - a >= HOLD_S]


def _pressing(recording: Recording, column: int, holds: list[tuple[float, float]]) -> list[tuple[float, float, float]]:
    """(start, end, commanded level) of the holds between which this joint's command has moved."""
    c = recording.commands
    rows = [int(np.searchsorted(c.t, a + 1e-9, side="right")) - 1 for a, _ in holds]
    levels = np.nan_to_num(c.value[rows]) if rows else np.zeros((0, 1))
    out = []
    for k, (a, b) in enumerate(holds):
        beside = [m for m in (k - 1, k + 1) if 0 <= m < len(holds)]
        for m in beside:
            if abs(levels[k, column] - levels[m, column]) > MOVED:
                out.append((a, b, float(levels[k, column])))
                break
    return out


def _steady(force: Series, width: float = 0.25) -> list[tuple[int, int]]:
    """Return the windows [first, last) in which no fingertip's force changes by more than 4 % of its largest."""
    out: list[tuple[int, int]] = []
    t, k = force.t, 0
    if len(t) < 4:
        return out
    scale = np.maximum(force.value.max(0), 1.0)
    while k < len(t) - 3:
        end = int(np.searchsorted(t, t[k] + width))
        if end >= len(t):
            break
        if end - k >= 4 and (np.ptp(force.value[k:end], axis=0) < 0.04 * scale).all():
            out.append((k, end))
            k = end
        else:
            k += max(1, (end - k) // 4)
    return out


def _collect(
    recording: Recording, effort: Series, force: Series, full: np.ndarray, f: int, column: int,
    windows: list[tuple[float, float, float]],
) -> Levels | None:  # fmt: skip
    """Means of a joint (column) and its finger f over the settled part of each window; rows without contact are counted
    and left out."""
    position = recording.states.position
    rows, free, before = [], 0, None
    commanded = [w[2] for w in windows]
    known = np.isfinite(commanded).all()
    steps = {round(v / MOVED): i for i, v in enumerate(sorted(set(commanded)))} if known else {}
    for k, (a, b, level) in enumerate(windows):
        start = b - SETTLE * (b - a)
        e, p = (s.between(start, b).value[:, column] for s in (effort, position))
        window = (force.t >= start) & (force.t < b)
        e, touch = e[np.isfinite(e)], force.value[window, f]
        if not len(e) or not len(touch):
            continue
        if touch.mean() < CONTACT:
            free, before = free + 1, None
            continue
        up = (
            True
            if before is None
            else (level > before[0] if known and level != before[0] else touch.mean() > before[1])
        )
        before = level, float(touch.mean())
        number = steps[round(level / MOVED)] if known else k
        rows.append((e.mean(), touch.mean(), number, up, np.nanmean(p), full[window, f].any()))
    if not rows:
        return None
    c = [np.array(x) for x in zip(*rows, strict=True)]
    # closing is positive whichever way the joint's zero lies: force grows with effort in the pressing direction
    way = -1.0 if np.mean(c[0]) < 0 else 1.0
    return Levels(way * c[0], c[1], c[2], c[3].astype(bool), c[4], c[5].astype(bool), free)
