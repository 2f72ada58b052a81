"""Memory and handles of a process, seen from outside, and whether they grow."""

from __future__ import annotations

import math
import os
import subprocess
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy import stats

COLUMNS = ("seconds", "heap_mib", "rss_mib", "files", "threads", "gpu_mib", "kept_mib", "done")
"""kept_mib: anonymous memory between two pieces of its work, as the process told it last (NaN where it has none); done:
how much of its work the process has done, in the work's own unit."""
GPU_EVERY = 5.0
"""s between two looks at the GPU's memory, each a program of its own."""
WARM_UP = 0.25
"""Share of the run that is left out: compiling, caches, pools that fill."""
BLOCKS = 20
LEAST = 120
"""Samples to judge by, at least."""
GROWTH_MIB, GROWTH_SHARE = 16.0, 0.03
"""Memory may grow by the larger of the two over what is judged; files and threads by HANDLES."""
HANDLES = 2


def look(pid: int) -> tuple[float, float, int, int] | None:
    """Return (anonymous, resident memory in MiB, open files, threads) of a process; None when it is gone."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
        status = dict(line.split(":", 1) for line in lines)
        heap, rss = (float(status[k].split()[0]) / 1024 for k in ("RssAnon", "VmRSS"))  # kB
        return heap, rss, len(os.listdir(f"/proc/{pid}/fd")), len(os.listdir(f"/proc/{pid}/task"))
    except (OSError, KeyError):
        return None


def gpu_mib() -> float:
    """Return the memory in use on the first GPU that programs may use, MiB; NaN without one."""
    first = os.environ.get("CUDA_VISIBLE_DEVICES", "0").split(",")[0] or "0"
    ask = ["nvidia-smi", "--query-gpu=memory.used", "--format=csv,noheader,nounits", f"--id={first}"]
    try:
        return float(subprocess.run(ask, capture_output=True, text=True, timeout=10).stdout.split()[0])
    except (OSError, subprocess.TimeoutExpired, IndexError, ValueError):
        return float("nan")


class Watch(threading.Thread):
    """Looks at a child every `every` s until it ends, from the moment that `done` is no longer None: (how much of its
    work it has done, what it keeps between two pieces, MiB). `rows` are of COLUMNS, and written to `path` as they
    come. gpu: at the first GPU's memory too."""

    def __init__(
        self,
        child: subprocess.Popen,
        gpu: bool = False,
        every: float = 0.5,
        done: Callable[[], tuple[float, float] | None] = lambda: (math.nan, math.nan),
        path: Path | None = None,
    ):
        super().__init__(daemon=True)
        self.child, self.gpu, self.every, self.done, self.rows = child, gpu, every, done, []
        self.path = Path(os.devnull) if path is None else path
        self.begun = time.monotonic()
        self.start()

    def run(self) -> None:
        while self.done() is None and self.child.poll() is None:
            time.sleep(self.every)  # it is still being started
        self.begun, requested, gpu = time.monotonic(), -math.inf, math.nan
        with open(self.path, "w", buffering=1) as file:
            file.write(",".join(COLUMNS) + "\n")
            while self.child.poll() is None:
                if self.gpu and time.monotonic() > requested + GPU_EVERY:
                    gpu, requested = gpu_mib(), time.monotonic()
                seen, done = look(self.child.pid), self.done()
                if seen is not None and seen[0] > 0:  # one that has ended, and was not waited for, has no memory
                    worked, saved = (math.nan, math.nan) if done is None else done
                    row = (time.monotonic() - self.begun, *seen, gpu, saved, worked)
                    self.rows.append(row)
                    file.write(",".join(f"{x:.6g}" for x in row) + "\n")
                time.sleep(self.every)


def judge(rows: list[tuple[float, ...]]) -> dict[str, dict[str, float]]:
    """Judge each column: mean, and growth over the judged part of the run with its 95 % interval, from a line through
    the means of BLOCKS blocks (neighbouring samples are alike); the same per hour of wall time (`per_hour`,
    `per_hour_low`, `per_hour_high`) and, where it is known how much was done, per unit of work (`per_unit`). Empty
    where there are too few samples."""
    table = np.array(rows[:], float).reshape(-1, len(COLUMNS))
    t = table[:, 0]
    saved = table[t >= WARM_UP * t[-1]] if len(t) else table
    if len(saved) < LEAST:
        return {}
    blocks = np.array_split(saved, BLOCKS)
    x = np.array([b[:, 0].mean() for b in blocks])
    worked = blocks[-1][:, -1].mean() - blocks[0][:, -1].mean()
    out = {}
    for k, name in enumerate(COLUMNS[1:-1], 1):
        if not np.isfinite(saved[:, k]).all():
            continue
        y = np.array([b[:, k].mean() for b in blocks])
        line = stats.linregress(x, y)
        half = float(stats.t.ppf(0.975, BLOCKS - 2) * line.stderr) if np.ptp(y) else 0.0
        span = x[-1] - x[0]
        slopes = {"": line.slope, "low": line.slope - half, "high": line.slope + half}
        out[name] = {"mean": float(saved[:, k].mean()), "most": float(saved[:, k].max())}
        out[name] |= {end or "growth": float(x * span) for end, x in slopes.items()}
        out[name] |= {"_".join(filter(None, ("per_hour", end))): float(3600 * x) for end, x in slopes.items()}
        if worked > 0:
            out[name]["per_unit"] = float(line.slope * span / worked)
    return out


def grows(found: dict[str, dict[str, float]]) -> list[str]:
    """Return the columns that grew by more than is allowed, beyond doubt."""
    out = []
    for name, f in found.items():
        allowed = max(GROWTH_MIB, GROWTH_SHARE * f["mean"]) if name.endswith("_mib") else HANDLES
        if name != "rss_mib" and f["low"] > 0 and f["growth"] > allowed:  # pages of files come and go in the resident
            out.append(name)
    return out
