"""Series on straight lines between their samples: `np.interp` of many columns at once."""

from __future__ import annotations

import numpy as np


def on_lines(at: np.ndarray, known: np.ndarray, x: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
    """Return [n, E] columns x [m, E], known at times [m] that grow, at other times [n] that grow: on straight lines
    between, held at the ends: the numbers of `np.interp` of each column; out [n, E], zeros: where to. What is zero
    throughout is not written: memory that nothing was written to takes no time."""
    out = np.zeros((len(at), x.shape[1])) if out is None else out
    k = np.searchsorted(known, at, side="right") - 1
    past, span, near = np.maximum(at - known[k], 0.0), np.diff(known), np.empty(len(at))
    with np.errstate(divide="ignore", invalid="ignore"):  # between equal times, which no time lies between
        for column in np.flatnonzero(x.any(0)):
            y, line = np.ascontiguousarray(x[:, column]), out[:, column]
            np.take(np.r_[np.diff(y) / span, 0.0], k, out=line, mode="clip")  # flat after the last
            line *= past
            line += np.take(y, k, out=near, mode="clip")
    return out
