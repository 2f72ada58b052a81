"""Memory and handles of a process, seen from outside, and whether they grow."""

from __future__ import annotations

import os
import subprocess
import threading
import time
from pathlib import Path

import numpy as np
from scipy import stats

COLUMNS = ("seconds", "heap_mib", "rss_mib", "files", "threads", "gpu_mib")
WARM_UP = 0.25
"""Share of the run that is left out: compiling, caches, pools that fill."""
BLOCKS = 20
LEAST = 120
"""Samples to judge by, at least."""
GROWTH_MIB, GROWTH_SHARE = 16.0, 0.03
"""Memory may grow by the larger of the two over what is judged; files and threads by HANDLES."""
HANDLES = 2


def look(pid: int) -> tuple[float, float, int, int] | None:
    """(anonymous, resident memory in MiB, open files, threads) of a process; None when it is gone."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
        status = dict(line.split(":", 1) for line in lines)
        heap, rss = (float(status[k].split()[0]) / 1024 for k in ("RssAnon", "VmRSS"))  # kB
        return heap, rss, len(os.listdir(f"/proc/{pid}/fd")), len(os.listdir(f"/proc/{pid}/task"))
    except (OSError, KeyError):
        return None


def gpu_mib() -> float:
    """Memory in use on the first GPU, MiB; NaN without one."""
    ask = ["nvidia-smi", "--query-gpu=memory.used", "--format=csv,noheader,nounits", "--id=0"]
    try:
        return float(subprocess.run(ask, capture_output=True, text=True, timeout=10).stdout.split()[0])
    except (OSError, subprocess.TimeoutExpired, IndexError, ValueError):
        return float("nan")


class Watch(threading.Thread):
    """Looks at a child every `every` s until it ends; `rows` are of COLUMNS. gpu: at the first GPU's memory too."""

    def __init__(self, child: subprocess.Popen, gpu: bool = False, every: float = 0.5, ready: Path | None = None):
        super().__init__(daemon=True)
        self.child, self.gpu, self.every, self.rows = child, gpu, every, []
        self.begun, self.ready = time.monotonic(), ready
        self.start()

    def run(self) -> None:
        while self.ready is not None and not self.ready.exists() and self.child.poll() is None:
            time.sleep(self.every)  # it is still being started
        self.begun = time.monotonic()
        while self.child.poll() is None:
            seen = look(self.child.pid)
            if seen is not None and seen[0] > 0:  # a process that has ended, and was not waited for, has no memory
                self.rows.append((time.monotonic() - self.begun, *seen, gpu_mib() if self.gpu else float("nan")))
            time.sleep(self.every)


def judge(rows: list[tuple[float, ...]]) -> dict[str, dict[str, float]]:
    """By column: mean, and growth over the judged part of the run with its 95 % interval, from a line through the means
    of BLOCKS blocks (neighbouring samples are alike). Empty where there are too few samples."""
    table = np.array(rows, float).reshape(-1, len(COLUMNS))
    t = table[:, 0]
    kept = table[t >= WARM_UP * t[-1]] if len(t) else table
    if len(kept) < LEAST:
        return {}
    blocks = np.array_split(kept, BLOCKS)
    x = np.array([b[:, 0].mean() for b in blocks])
    out = {}
    for k, name in enumerate(COLUMNS[1:], 1):
        if not np.isfinite(kept[:, k]).all():
            continue
        y = np.array([b[:, k].mean() for b in blocks])
        line = stats.linregress(x, y)
        half = float(stats.t.ppf(0.975, BLOCKS - 2) * line.stderr) if np.ptp(y) else 0.0
        span = x[-1] - x[0]
        out[name] = {"mean": float(kept[:, k].mean()), "most": float(kept[:, k].max()),
                     "growth": float(line.slope * span), "low": float((line.slope - half) * span),
                     "high": float((line.slope + half) * span)}  # fmt: skip
    return out


def grows(found: dict[str, dict[str, float]]) -> list[str]:
    """Columns that grew by more than is allowed, beyond doubt."""
    out = []
    for name, f in found.items():
        allowed = max(GROWTH_MIB, GROWTH_SHARE * f["mean"]) if name.endswith("_mib") else HANDLES
        if name != "rss_mib" and f["low"] > 0 and f["growth"] > allowed:  # pages of files come and go in the resident
            out.append(name)
    return out
