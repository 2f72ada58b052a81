"""Progress of a countable job on the console."""

from __future__ import annotations

import sys
import time

from dexsim.console.tables import duration


class Ticker:
    """Progress of one countable job: on a terminal one line rewritten in place, else a line now and then."""

    def __init__(self, what: str, every_s: float = 10.0) -> None:
        self._what, self._live = what, sys.stdout.isatty()
        self._every = 0.2 if self._live else every_s
        self._start = self._last = time.perf_counter()

    def __call__(self, done: int, total: int, note: str = "") -> None:
        """Say that ``done`` of ``total`` are finished."""
        now = time.perf_counter()
        if now - self._last < self._every and not (done >= total and self._live):
            return
        self._last = now
        remaining = (now - self._start) * (total - done) / max(done, 1)
        text = f"  {self._what} {done}/{total}  {note}  {duration(remaining)} left"
        print(f"\r{text:<70}" if self._live else text, end="\n" if done >= total or not self._live else "", flush=True)
