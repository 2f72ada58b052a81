"""Progress on the console, one line at a time."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence

from dexsim.cli.report import cell, count, duration


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
        left = (now - self._start) * (total - done) / max(done, 1)
        text = f"  {self._what} {done}/{total}  {note}  {duration(left)} left"
        print(f"\r{text:<70}" if self._live else text, end="\n" if done >= total or not self._live else "", flush=True)


class TrainingLines:
    """One line for each iteration, at most one a second, the first and last always."""

    def __init__(self, total: int, headline: Sequence[str]) -> None:
        self._total, self._headline = total, headline
        self._last = self._printed = self._each = 0.0
        self._first = 0
        self._seen: dict[str, float] = {}

    def start(self, iteration: int) -> None:
        """Begin to measure time at this iteration count."""
        self._last, self._first = time.perf_counter(), iteration

    def show(self, row: dict[str, float]) -> None:
        """Print the line of one iteration."""
        self._seen |= row
        now, it = time.perf_counter(), int(row["iteration"])
        taken, self._last = now - self._last, now
        # the first iteration warms up; from the second on, time left follows the recent ones
        self._each = taken if it <= self._first + 2 else 0.9 * self._each + 0.1 * taken
        if now - self._printed < 1.0 and it not in (self._first + 1, self._total):
            return
        self._printed = now
        parts = [f"{it:>{len(str(self._total))}}/{self._total}", f"{count(row['steps']):>5} steps",
                 f"{count(row['rate']):>5}/s", f"reward {cell(self._seen.get('reward')):>6}",
                 f"length {cell(self._seen.get('length')):>5}"]
        parts += [f"{name.rpartition('/')[2]} {cell(self._seen.get(name))}" for name in self._headline
                  if name in self._seen]
        print("  ".join([*parts, f"{duration(self._each * (self._total - it))} left"]), flush=True)
