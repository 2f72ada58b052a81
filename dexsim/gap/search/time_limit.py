"""A limit of time, and a wish to end, that every search asks between its steps: what is best by then is the answer."""

from __future__ import annotations

import threading
import time

JUDGING = 0.2  # of the limit: what is left for judging, the replay and the page


class TimeLimit:
    """seconds: for the whole diagnosis from now on; None for no limit. `stop()` (Ctrl-C) ends searches at their next
    step."""

    def __init__(self, seconds: float | None = None):
        self.seconds, self._start, self._stop = seconds, time.monotonic(), threading.Event()
        self.cut: set[str] = set()  # joints whose search ended early

    def stop(self) -> None:
        """Ends what is under way at its next step."""
        self._stop.set()

    @property
    def stopped(self) -> bool:
        """Whether `stop` was called."""
        return self._stop.is_set()

    def left(self) -> float:
        """s that searches have left; infinite without a limit."""
        if self.stopped:
            return 0.0
        return float("inf") if self.seconds is None else (1 - JUDGING) * self.seconds - (time.monotonic() - self._start)

    def share(self, joint: str, of: float) -> Deadline:
        """The deadline of one joint's search that gets `of` (0..1) of what is left."""
        return Deadline(self, joint, time.monotonic() + self.left() * of)


class Deadline:
    """When one joint's search is to end."""

    def __init__(self, limit: TimeLimit | None = None, joint: str = "", until: float = float("inf")):
        self.limit, self.joint, self.until = limit, joint, until

    def over(self) -> bool:
        """Whether it is time to end with what there is; noted for the page."""
        if time.monotonic() < self.until and not (self.limit is not None and self.limit.stopped):
            return False
        if self.limit is not None:
            self.limit.cut.add(self.joint)
        return True
