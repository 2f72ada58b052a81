"""Joints searched side by side: each is a problem of its own, in a thread of its own."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from dexsim.gap.plant import side_by_side

T = TypeVar("T")
MOST_CPU, MOST_GPU = 8, 12  # searches at a time: each takes some hundred MB
# s that a lane may keep the interpreter while another waits for it after a launch (Python: 5 ms, as long as a launch of
# few guesses)
SWITCH = 2e-4


def lanes(device: str, jobs: int) -> int:
    """How many searches run at a time. On a GPU all of them: what one thread computes on the CPU, another's launch
    hides. On a CPU as many as it has cores: what one computes in Python, another's launch hides, in parts on all cores
    that are free."""
    return max(1, min(jobs, MOST_GPU if device != "cpu" else min(MOST_CPU, side_by_side.cores())))


def together(names: Sequence[str], work: Callable[[int, Callable[[float], None]], T], device: str,
             progress: Callable[[float, int, str], None] | None = None) -> list[T]:
    """work(k, tell) for each name, in their order; tell(part) says how much of it is done; progress(done, of, which is
    worked on)."""
    parts = [0.0] * len(names)
    lock = threading.Lock()

    def one(k: int) -> T:
        def tell(part: float) -> None:
            with lock:
                parts[k] = part
                if progress and part < 1.0:
                    progress(sum(parts), len(names), names[k])

        tell(0.0)
        out = work(k, tell)
        tell(1.0)
        return out

    at_once = lanes(device, len(names))
    if at_once <= 1:
        out = [one(k) for k in range(len(names))]
    else:
        pool, switch = ThreadPoolExecutor(at_once), sys.getswitchinterval()
        sys.setswitchinterval(SWITCH)
        try:
            out = list(pool.map(one, range(len(names))))
        finally:
            pool.shutdown(cancel_futures=True)  # what has begun ends, nothing else begins
            sys.setswitchinterval(switch)
    if progress:
        progress(len(names), len(names), "")
    return out
