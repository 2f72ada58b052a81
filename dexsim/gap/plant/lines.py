"""Series on straight lines between their samples: `np.interp` of many columns at once."""

# No `from __future__ import annotations`: Warp resolves these annotations from the closure.

import threading
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from dexsim.gap.plant.columns import SERIES

# rounded after each operation, as NumPy does: the same numbers on every machine
_ROUNDED = {"fuse_fp": False}
_LOADING = threading.Lock()  # several threads ask for the kernel at once: one of them has it compiled
_ROW = wp.types.vector(len(SERIES), wp.float64)


def on_lines(at: np.ndarray, known: np.ndarray, x: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
    """Return [n, E] columns x [m, E] known at times [m] that grow, at other times [n]: on straight lines between, held
    at the ends: `np.interp` of each column. All columns of a `SERIES` are taken row by row, which is how they lie in
    memory, and without the interpreter; out [n, E]: where to."""
    out = np.empty((len(at), x.shape[1])) if out is None else out
    in_a_row = out.flags.c_contiguous and out.dtype == np.float64  # the kernel is given no more than where they begin
    if x.shape[1] != len(SERIES) or min(len(known) - 1, len(at)) < 1 or not in_a_row or not np.isfinite(x).all():
        for e in range(x.shape[1]):
            out[:, e] = np.interp(at, known, x[:, e])
        return out
    with np.errstate(divide="ignore", invalid="ignore"):  # between equal times, which no time lies between
        slope = np.diff(x, axis=0) / np.diff(known)[:, None]
    after = np.searchsorted(known, at, side="right").astype(np.int32)
    with _LOADING:
        kernel = _kernel()
    there = {"device": "cpu", "copy": False}
    given: list[wp.array[Any]] = [wp.array(np.ascontiguousarray(t), **there) for t in (at, known, after)]
    given += [wp.array(np.ascontiguousarray(r), dtype=_ROW, **there) for r in (x, slope)]
    given.append(wp.array(ptr=out.ctypes.data, shape=(len(out),), dtype=_ROW, device="cpu"))  # never a copy
    wp.launch(kernel, dim=len(at), inputs=given, device="cpu")
    return out


@cache
def _kernel() -> wp.Kernel:
    """Return the kernel, loaded: one thread a time."""

    @wp.kernel(module="unique", module_options=_ROUNDED, enable_backward=False)
    def lines(
        at: wp.array(dtype=wp.float64),  # [n]
        known: wp.array(dtype=wp.float64),  # [m]
        after: wp.array(dtype=int),  # [n] how many of the known times are not after it
        x: wp.array(dtype=_ROW),  # [m]
        slope: wp.array(dtype=_ROW),  # [m - 1]
        # out
        out: wp.array(dtype=_ROW),  # [n]
    ):
        i = wp.tid()
        k = wp.max(after[i] - 1, 0)
        past = at[i] - known[k]
        if after[i] == 0 or after[i] == known.shape[0] or past == wp.float64(0.0):
            out[i] = x[k]
        else:
            out[i] = slope[k] * past + x[k]

    wp.init()
    lines.module.load("cpu")
    return lines
