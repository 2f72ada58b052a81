"""One console line for each learning iteration."""

from __future__ import annotations

import time
from collections.abc import Sequence

from dexsim.console.tables import cell, count, duration


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
        parts = [
            f"{it:>{len(str(self._total))}}/{self._total}",
            f"{count(row['steps']):>5} steps",
            f"{count(row['rate']):>5}/s",
            f"reward {cell(self._seen.get('reward')):>6}",
            f"length {cell(self._seen.get('length')):>5}",
        ]
        parts += [
            f"{name.rpartition('/')[2]} {cell(self._seen.get(name))}" for name in self._headline if name in self._seen
        ]
        print("  ".join([*parts, f"{duration(self._each * (self._total - it))} left"]), flush=True)
