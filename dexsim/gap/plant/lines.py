"""Series on straight lines between their samples: `np.interp` of many columns at once."""

from __future__ import annotations

import numpy as np


def on_lines(at: np.ndarray, known: np.ndarray, x: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
    """Return [n, E] columns x [m, E], finite and known at times [m] that grow, at other times [n]: on straight lines
    between, held at the ends: the numbers of `np.interp` of each column; out [n, E]: where to."""
    out = np.empty((len(at), x.shape[1])) if out is None else out
    with np.errstate(divide="ignore", invalid="ignore"):  # between equal times, which no time lies between
        slope = np.vstack([np.diff(x, axis=0) / np.diff(known)[:, None], np.zeros((1, x.shape[1]))])
    k = np.clip(np.searchsorted(known, at, side="right") - 1, 0, len(known) - 1)
    np.multiply(slope[k], np.maximum(at - known[k], 0.0)[:, None], out=out)
    out += x[k]
    return out
