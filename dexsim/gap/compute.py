"""What a diagnosis may spend: the cores of a machine, and a limit of time."""

from __future__ import annotations

import heapq
import os
import sys
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache
from typing import TypeVar

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

LONG = 3.0  # s: steps that take less go by without a word

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


def forked(
    count: int,
    prepared: Callable[[int], Callable[[], T]],
    at_once: int,
    tell: Callable[[int, float], None] = lambda k, part: None,
) -> list[T]:
    """Return prepared(k)() for k below `count`, in order: side by side in forks of this process, for what is Python
    itself; without such a fork here, one after the other. Nothing of it may touch a GPU. tell(k, part): k begins (part
    0) or has ended (1)."""
    forks = min(at_once, count) > 1 and system.start_method() == "fork"

    def one(k: int, work: Callable[[], T]) -> T:
        tell(k, 0.0)
        try:
            out = guard.call(work, what="a fork", size=ENDLESS) if forks else work()
        except UserError:  # its own, or the system has no process or memory for it
            out = work()
        tell(k, 1.0)
        return out

    if not forks:
        return [one(k, prepared(k)) for k in range(count)]
    with ThreadPoolExecutor(at_once) as pool:
        return list(pool.map(one, range(count), [prepared(k) for k in range(count)]))


class Steps:
    """How long steps of known sizes will take, `lanes` at a time in their order: one that has ended tells it."""

    def __init__(self, sizes: Sequence[float], lanes: int):
        self._sizes, self._lanes = sizes, lanes
        self._begun, self._took = dict[int, float](), dict[int, float]()

    def tell(self, k: int, part: float) -> None:
        """Step k has begun, is under way, or has ended (part 1)."""
        now = time.monotonic()
        begun = self._begun.setdefault(k, now)
        if part >= 1.0:
            self._took[k] = now - begun

    def done(self) -> float:
        """Return the share that is done, 0 to 1."""
        return 1.0 - sum(x for k, x in enumerate(self._sizes) if k not in self._took) / sum(self._sizes)

    def left(self) -> float | None:
        """Return s that are left; None before the first has ended."""
        if not self._took:
            return None
        now, each = time.monotonic(), sum(self._took.values()) / sum(self._sizes[k] for k in self._took)
        begun = [max(each * self._sizes[k] - now + t, 0.0) for k, t in self._begun.items() if k not in self._took]
        return self._last(begun, [each * x for x in self._sizes[len(self._begun) :]])

    def _last(self, begun: Sequence[float], waiting: Sequence[float]) -> float:
        """Return s until the last ends; begun, waiting: what each takes from now on [s]."""
        lanes = [*begun, *[0.0] * (self._lanes - len(begun))]
        heapq.heapify(lanes)
        for x in waiting:  # each goes where a lane is free first
            heapq.heapreplace(lanes, lanes[0] + x)
        return max(lanes)


class Pace(Steps):
    """How long searches of `count` joints will take, `lanes` at a time. How much is hidden in a joint is known when it
    is searched: the time is told from those that have ended, once they say it within `KNOWN`."""

    KNOWN = 0.3  # of the time left: a standard deviation by which it may be off
    SPREAD, PRIOR = 0.7, 3  # of their mean, by which searches differ as a rule, and how many it counts for

    def __init__(self, count: int, lanes: int):
        super().__init__([1.0] * count, lanes)

    def left(self) -> float | None:
        """Return s that are left; None where they are not known."""
        took, rest, now = np.array([*self._took.values()]), len(self._sizes) - len(self._took), time.monotonic()
        if len(took) < 3 or rest < 2 * self._lanes or took.mean() <= 0:
            return None  # when the last of those side by side ends nobody knows
        under_way = [now - t for k, t in self._begun.items() if k not in self._took]
        late = [1.5 * t for t in under_way if t > took.mean()]  # those that ended first are not like the others
        known = np.array([*took, *late])
        mean, n = float(known.mean()), len(known)
        spread = ((self.PRIOR * self.SPREAD**2 + n * float(known.var()) / mean**2) / (self.PRIOR + n)) ** 0.5
        if spread * (1 / rest + 1 / len(took)) ** 0.5 > self.KNOWN:
            return None
        # of one that takes longer than others half of that is to come
        begun = [max(mean - t, 0.5 * mean) for t in under_way]
        return self._last(begun, [mean] * (len(self._sizes) - len(self._begun)))


def told(
    sizes: Sequence[float], lanes: int, what: str, progress: Callable[..., None] | None
) -> Callable[[int, float], None]:
    """Return what tells `progress` of steps (`Steps`; what: they do, in words) that take longer than `LONG`: k has
    begun or ended."""
    steps, lock, said = Steps(sizes, lanes), threading.Lock(), [False]

    def tell(k: int, part: float) -> None:
        with lock:
            steps.tell(k, part)
            left, done = steps.left(), steps.done()
            if progress and left is not None and (said[0] or left > LONG):
                said[0] = True
                progress(done, 1, what, left, "replay")

    return tell


def map_joints(names: Sequence[str], work: Callable[[int, Callable[[float], None]], T], device: str,
             progress: Callable[..., None] | None = None) -> list[T]:
    """work(k, tell) for each name, in their order; tell(part) says how much of it is done; progress(done, of, which is
    worked on, s that are left or None)."""
    parts, lock, at_once = [0.0] * len(names), threading.Lock(), workers(device, len(names))
    pace = Pace(len(names), at_once)

    def one(k: int) -> T:
        def tell(part: float) -> None:
            with lock:
                parts[k] = part
                pace.tell(k, part)
                if progress and part < 1.0:
                    progress(sum(parts), len(names), names[k], pace.left())

        tell(0.0)
        out = work(k, tell)
        tell(1.0)
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
