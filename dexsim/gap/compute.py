"""What a diagnosis may spend: the cores of a machine, and a limit of time."""

from __future__ import annotations

import heapq
import mmap
import os
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import cache
from multiprocessing import connection
from typing import Any, TypeVar

import numpy as np

from dexsim import guard, system
from dexsim.errors import UserError

# -- cores ------------------------------------------------------------------------------------------------------------
# The cores of a machine: joints searched side by side, each a problem of its own in a thread of its own, and on a CPU
# each launch of one in parts side by side. (Launches release the interpreter.)

T = TypeVar("T")
MOST_CPU, MOST_GPU = 8, 12  # searches at a time: each takes some hundred MB
# s that a lane may keep the interpreter while another waits for it after a launch (Python: 5 ms, as long as a launch of
# few guesses)
SWITCH = 2e-4
WORTH = 20_000  # steps of guesses that a part has at least: about 2 ms, beside the tenth of one that a launch takes

LONG = 4.0  # s between two words on work that is watched; what takes less goes by without one
KNOWN, SOON = 0.05, 2.0  # share done before which its rate is not known, and s left of which nothing is said

ENDLESS = 1 << 36  # bytes of the file that a reader with a fork's limits would read: days, a TiB

_busy = 0  # parts under way
_lock = threading.Lock()


def cores() -> int:
    """Return cores that this process may use (OMP_NUM_THREADS, where it is set, counts as the cores)."""
    given = os.environ.get("OMP_NUM_THREADS", "")
    if given.isdigit() and int(given) > 0:
        return int(given)
    return system.cores()


def parts(steps: np.ndarray, guesses: int) -> list[tuple[slice, slice]]:
    """Return what of windows of `steps` [W], and which of the guesses, each thread of a launch simulates: as many parts
    as cores are free, cut between windows, or between guesses where that is more even."""
    total = int(steps.sum()) * guesses
    count = max(min(cores() - _busy, total // WORTH), 1)
    every, everyone = slice(0, len(steps)), slice(0, guesses)
    if count == 1:
        return [(every, everyone)]
    middles, whole = np.cumsum(steps) - 0.5 * steps, float(steps.sum())
    cut = np.unique(np.r_[0, np.searchsorted(middles, whole * np.arange(1, count) / count), len(steps)])
    longest = max(int(steps[a:b].sum()) for a, b in zip(cut[:-1], cut[1:], strict=True)) * guesses
    if longest <= -(-guesses // count) * whole:
        return [(slice(int(a), int(b)), everyone) for a, b in zip(cut[:-1], cut[1:], strict=True)]
    cut = np.unique(np.round(np.linspace(0, guesses, count + 1)).astype(int))
    return [(every, slice(int(a), int(b))) for a, b in zip(cut[:-1], cut[1:], strict=True)]


def run(work: Callable[[slice, slice], None], split: Sequence[tuple[slice, slice]]) -> None:
    """work(windows, guesses) of each part, side by side."""
    global _busy
    with _lock:
        _busy += len(split)
    others = [_pool().submit(work, *part) for part in split[1:]]
    try:
        work(*split[0])
    finally:
        wait(others)  # they write to memory of the caller's
        with _lock:
            _busy -= len(split)
    for done in others:
        done.result()


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(cores(), thread_name_prefix="plant")


system.after_fork(_pool.cache_clear)  # a child process has none of its parent's threads


def workers(device: str, jobs: int) -> int:
    """Return how many searches run at a time. On a GPU all of them: what one thread computes on the CPU, another's
    launch hides. On a CPU as many as it has cores: what one computes in Python, another's launch hides, in parts on all
    cores that are free."""
    return max(1, min(jobs, MOST_GPU if device != "cpu" else min(MOST_CPU, cores())))


def each(count: int, work: Callable[[int], T]) -> list[T]:
    """work(k) for k below `count`, in order: side by side on the cores, for what numpy does without the interpreter."""
    at_once = min(MOST_CPU, cores(), count)
    if at_once <= 1:
        return [work(k) for k in range(count)]
    with ThreadPoolExecutor(at_once) as pool:
        return list(pool.map(work, range(count)))


def forked(count: int, prepared: Callable[[int], Callable[[], T]], at_once: int) -> list[T]:
    """Return prepared(k)() for k below `count`, in order: side by side in forks of this process, for what is Python
    itself; without such a fork here, one after the other. Nothing of it may touch a GPU."""
    works = [prepared(k) for k in range(count)]
    if min(at_once, count) <= 1 or system.start_method() != "fork":
        return [work() for work in works]
    out, running, rest = dict[int, T](), dict[int, Generator[Any, None, T]](), list(range(count))[::-1]
    while rest or running:
        while rest and len(running) < at_once:
            k = rest.pop()
            running[k] = guard.turns(works[k], what="a fork", size=ENDLESS)
        awaited = []
        for k, turns in [*running.items()]:  # by this thread: of forks that threads begin at once some crash, with CUDA
            try:
                awaited.append(next(turns))
                continue
            except StopIteration as end:
                out[k] = end.value
            except (UserError, OSError):  # its own, or the system has no process or memory for it
                pass
            del running[k]
        if awaited and (len(awaited) == at_once or not rest):
            connection.wait(awaited, guard.TURN)
    return [out[k] if k in out else work() for k, work in enumerate(works)]


@contextmanager
def watched(
    sizes: Sequence[float], lanes: int, what: str, progress: Callable[..., None] | None
) -> Iterator[Callable[[int, float], None]]:
    """Yield tell(k, part), by which work k, in whatever fork of this process, says how much of it is done, 0 to 1.
    progress is told every `LONG` s how far all of it is, `lanes` at a time in their order, and the time left. sizes:
    how long each takes beside the others; what: is replayed, in words."""
    size, seen = np.array(sizes), np.frombuffer(mmap.mmap(-1, 24 * max(len(sizes), 1))).reshape(-1, 3)
    over = threading.Event()

    def tell(k: int, part: float) -> None:
        now = time.monotonic()
        seen[k] = (seen[k, 0] or now), now, max(part, 1e-9)

    def watch(say: Callable[..., None]) -> None:
        said = False
        while not over.wait(LONG):
            share, left = so_far(size, seen[: len(size)], lanes)
            if left is not None and left > SOON and share > KNOWN:
                say(share, 1, what, "", left, "replay")
                said = True
        if said:
            say(1, 1, what, "", None, "replay")

    thread = threading.Thread(target=watch, args=(progress,)) if progress else None
    if thread:
        thread.start()
    try:
        yield tell
    finally:
        over.set()
        if thread:
            thread.join()


def so_far(size: np.ndarray, seen: np.ndarray, lanes: int) -> tuple[float, float | None]:
    """Return (share that is done, s that are left; None before anything is) of works of sizes [n]. seen [n, 3]: when
    each began, when it was looked at [s], and how much of it was done then."""
    begun, at, part = seen.T
    on, share = at > begun, float(size @ part / size.sum())
    if not on.any():
        return share, None
    each = (at - begun)[on].sum() / (size * part)[on].sum()
    rest = each * size * (1 - part)
    return share, last(rest[on & (part < 1)].tolist(), rest[~on].tolist(), lanes)


def last(begun: Sequence[float], waiting: Sequence[float], lanes: int) -> float:
    """Return s until the last ends of what takes so long from now on [s]: begun, and waiting for one of `lanes`."""
    ends = [*begun, *[0.0] * (lanes - len(begun))]
    heapq.heapify(ends)
    for x in waiting:  # each goes where a lane is free first
        heapq.heapreplace(ends, ends[0] + x)
    return max(ends)


def map_joints(names: Sequence[str], work: Callable[[int, Callable[[str], None]], T], device: str,
               progress: Callable[..., None] | None = None) -> list[T]:
    """work(k, tell) for each name, in their order; tell(stage) says in words what it is at; progress(how many are done,
    of how many, which is worked on, its stage)."""
    lock, at_once, done = threading.Lock(), workers(device, len(names)), [0]

    def one(k: int) -> T:
        def tell(stage: str) -> None:
            with lock:
                if progress and done[0] < len(names):  # a search is asked again when what it found is judged
                    progress(done[0], len(names), names[k], stage)

        tell("")
        out = work(k, tell)
        with lock:
            done[0] += 1
        return out

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


# -- a limit of time --------------------------------------------------------------------------------------------------
# A limit of time, and a wish to end, that every search asks between its steps: what is best by then is the answer.

JUDGING = 0.2  # of the limit: what is left for judging, the replay and the page
PAGE = 0.04  # of the limit: what is left for the page
GRACE = 0.04  # of the limit: by which a step of a search may be late; then its fits end where they are
LONGER = 2.0  # times what it had: what a search that ended early must have more for it to begin anew


class TimeLimit:
    """seconds: for the whole diagnosis from now on; None for no limit. `stop()` (Ctrl-C) ends searches at their next
    step."""

    def __init__(self, seconds: float | None = None):
        self.seconds, self._start, self._stop = seconds, time.monotonic(), threading.Event()
        self.cut: set[str] = set()  # joints whose search ended early
        self.left_out: list[str] = []  # what there was no time for, in sentences

    def stop(self) -> None:
        """Ends what is under way at its next step."""
        self._stop.set()

    @property
    def stopped(self) -> bool:
        """Whether `stop` was called."""
        return self._stop.is_set()

    def left(self) -> float:
        """Return s that searches have left; infinite without a limit."""
        return 0.0 if self.stopped else self.until(1 - JUDGING)

    def rest(self) -> float:
        """Return s until all but the page is to be done; infinite without a limit."""
        return self.until(1 - PAGE)

    def until(self, share: float) -> float:
        """Return s until this share (0..1) of the limit is over; infinite without one."""
        return float("inf") if self.seconds is None else share * self.seconds - (time.monotonic() - self._start)

    def spent(self, share: float) -> bool:
        """Return whether this share (0..1) of the limit is over."""
        return self.until(share) < 0

    def leave_out(self, what: str) -> None:
        """Notes for the page what there was no time for, a sentence's begin."""
        self.left_out.append(f"{what} (the limit of {self.seconds:g} s)")

    def share(self, joint: str, of: float) -> Deadline:
        """Return the deadline of one joint's search that gets `of` (0..1) of what is left."""
        return Deadline(self, joint, time.monotonic() + self.left() * of)


class Deadline:
    """When one joint's search is to end; `seconds`: how long it has from its beginning."""

    def __init__(self, limit: TimeLimit | None = None, joint: str = "", until: float = float("inf")):
        self.limit, self.joint, self.until, self.seconds = limit, joint, until, until - time.monotonic()

    def over(self) -> bool:
        """Return whether it is time to end with what there is; noted for the page."""
        if time.monotonic() < self.until and not (self.limit is not None and self.limit.stopped):
            return False
        if self.limit is not None:
            self.limit.cut.add(self.joint)
        return True

    def passed(self) -> bool:
        """Return whether what is over by more than `GRACE` is to end within a step, too."""
        if self.limit is None or self.limit.seconds is None:
            return False
        return time.monotonic() > self.until + GRACE * self.limit.seconds
