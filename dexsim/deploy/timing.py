"""How long the loop's turns took: thread CPU time and wall time, kept in arrays made beforehand."""

from __future__ import annotations

import time

import numpy as np


class Timing:
    """One row a turn: CPU seconds of this thread, wall seconds, lateness at waking [s]. Beyond `most` rows it goes
    round."""

    def __init__(self, most: int = 400_000):
        self._rows = np.full((most, 3), 0.0)  # written now: its pages would come one by one in the run
        self.turns = 0
        self.overruns = 0

    def start(self, late: float) -> None:
        """Start a turn, `late` s after it should have begun."""
        self._late = late
        self._wall, self._cpu = time.perf_counter(), time.thread_time()

    def end(self) -> float:
        """End the turn; return its wall time [s]."""
        cpu, wall = time.thread_time() - self._cpu, time.perf_counter() - self._wall
        self._rows[self.turns % len(self._rows)] = cpu, wall, self._late
        self.turns += 1
        return wall

    def summary(self) -> dict[str, float]:
        """Return milliseconds: median, 99.9th percentile and largest of each; turns and overruns."""
        rows = 1e3 * self._rows[: min(self.turns, len(self._rows))]
        out: dict[str, float] = {"turns": self.turns, "overruns": self.overruns}
        for k, name in enumerate(("cpu", "wall", "late")):
            x = rows[:, k] if len(rows) else np.zeros(1)
            out |= {f"{name}_median_ms": float(np.median(x)), f"{name}_p999_ms": float(np.percentile(x, 99.9)),
                    f"{name}_max_ms": float(x.max())}  # fmt: skip
        return out

    def table(self) -> str:
        """Return lines to print."""
        s = self.summary()
        lines = [f"{'':<24}{'median':>10}{'99.9 %':>10}{'largest':>10}   ms"]
        for name, text in (("cpu", "thread CPU time"), ("wall", "wall time"), ("late", "woken late by")):
            lines.append(f"{text:<24}" + "".join(f"{s[f'{name}_{k}_ms']:>10.3f}" for k in ("median", "p999", "max")))
        return "\n".join([*lines, f"{s['turns']} turns, {s['overruns']} overruns"])
