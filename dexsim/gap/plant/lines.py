"""Series on straight lines between their samples: `np.interp` of many columns at once."""

from __future__ import annotations

import numpy as np

AT_ONCE = 512  # rows that are made in one call: what is made in between stays in a core's cache


def on_lines(at: np.ndarray, known: np.ndarray, x: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
    """Return [n, E] columns x [m, E], finite and known at times [m] that grow, at other times [n] that grow: on
    straight lines between, held at the ends: the numbers of `np.interp` of each column; out [n, E]: where to."""
    out = np.empty((len(at), x.shape[1])) if out is None else out
    k = np.clip(np.searchsorted(known, at, side="right") - 1, 0, len(known) - 1)
    past, span = np.maximum(at - known[k], 0.0)[:, None], np.r_[np.diff(known), 1.0][:, None]
    with np.errstate(divide="ignore", invalid="ignore"):  # between equal times, which no time lies between
        for a in range(0, len(at), AT_ONCE):
            rows = slice(a, a + AT_ONCE)
            some = slice(k[rows][0], k[rows][-1] + 1)
            near = x[some.start : some.stop + 1]
            slope = np.zeros((some.stop - some.start, x.shape[1]))  # none after the last
            np.divide(near[1:] - near[:-1], span[some][: len(near) - 1], out=slope[: len(near) - 1])
            here = k[rows] - some.start
            np.multiply(slope[here], past[rows], out=out[rows])
            out[rows] += near[here]
    return out
