"""Series on straight lines between their samples: `np.interp` of many columns at once."""

from __future__ import annotations

import numpy as np


def on_lines(at: np.ndarray, known: np.ndarray, x: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
    """Return [n, E] columns x [m, E], known at times [m] that grow, at other times [n] that grow: on straight lines
    between, held at the ends: the numbers of `np.interp` of each column; out [n, E], zeros: where to. What is zero
    throughout is not written: memory that nothing was written to takes no time."""
    out = np.zeros((len(at), x.shape[1])) if out is None else out
    k = np.clip(np.searchsorted(known, at, side="right") - 1, 0, len(known) - 1)
    past, span = np.maximum(at - known[k], 0.0), np.diff(known)
    with np.errstate(divide="ignore", invalid="ignore"):  # between equal times, which no time lies between
        for column in np.flatnonzero(x.any(0)):
            y = np.ascontiguousarray(x[:, column])
            line = np.r_[np.diff(y) / span, 0.0][k]  # none after the last
            line *= past
            line += y[k]
            out[:, column] = line
    return out
