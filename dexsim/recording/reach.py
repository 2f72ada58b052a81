"""Targets and positions that belong to no motion of the joint: out of all proportion to the other of the two."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from dexsim.recording.schema import Finding, Recording, Series
from dexsim.recording.spikes import spiked

TURN = 2 * np.pi
"""rad: a target may be a turn from where the joint is, on a wheel."""
TIMES = 20.0
"""x what the other of the two spans: a drive that follows a twentieth of its targets follows none."""
FEWEST = 20
"""Samples of each that are judged."""
TOGETHER = 0.1
"""s: over a longer pause a joint may have gone any way."""


def unreachable(r: Recording, known: set[tuple[str, str]]) -> Iterator[Finding]:
    """Samples, other than single spikes, at which a target lies farther than a turn and than `TIMES` what the joint
    moves through from where it moves; and positions as far from all targets that were jumped to, or never left (a joint
    that is carried there passes through what lies between). known: (topic, joint) of which more is said already."""
    for name, series, other in (
        ("command", r.commands, r.states.position),
        ("position", r.states.position, r.commands),
    ):
        if len(series) < FEWEST or len(other) < FEWEST:
            continue
        for j, joint in enumerate(r.joints):
            if (series.topic, joint) in known:
                continue
            if _near(series.value[:, j], other.value[:, j]):
                continue
            low, high = _spans(other, j, "position" if name == "command" else "command")
            room = max(TURN, TIMES * (high - low))
            x = series.value[:, j]
            far = (x > high + room) | (x < low - room)  # False where it is not finite, or nothing is known of the other
            if not far.any():
                continue
            far &= ~spiked(x, name)
            if not far.any():
                continue
            if name == "position" and not _jumped(series.t, x) and not far[np.isfinite(x)].all():
                continue
            at = np.flatnonzero(far)
            worst = x[at[np.argmax(np.abs(x[at]))]]
            moves = "it moves" if name == "command" else "its commands lie"
            text = (
                f"{name} of {joint} is up to {worst:.4g} rad in {len(at)} of {len(x)} samples, where {moves} between"
                f" {low:.3g} and {high:.3g} rad: of another unit, or none of this joint's"
            )
            yield series.finding("unit", text, "error", joint, at)


def _near(x: np.ndarray, other: np.ndarray) -> bool:
    """Return whether no value of x is as far as a turn (less a margin of rounding) from any of the other; cheaper to
    say than what `_spans` finds out, and true of nearly all signals."""
    turn = 0.99 * TURN
    return bool(np.fmax.reduce(x) < np.fmin.reduce(other) + turn and np.fmin.reduce(x) > np.fmax.reduce(other) - turn)


def _spans(series: Series, j: int, name: str) -> tuple[float, float]:
    """Return (lowest, highest) of a joint's values but for spikes and the outermost hundredth; NaN where there are too
    few."""
    x = series.value[:, j]
    x = x[np.isfinite(x) & ~spiked(x, name)]
    if len(x) < FEWEST:
        return np.nan, np.nan
    low, high = np.quantile(x, [0.01, 0.99])
    return float(low), float(high)


def _jumped(t: np.ndarray, x: np.ndarray) -> bool:
    ok = np.isfinite(x)
    return bool(((np.abs(np.diff(x[ok])) > TURN) & (np.abs(np.diff(t[ok])) < TOGETHER)).any())
