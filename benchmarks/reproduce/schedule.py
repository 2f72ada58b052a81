"""Which training goes on next, and how far: every row to one level before any goes on to the next, so that an early end
leaves a table whose rows compare; and a last level that a sitting's time allows."""

from __future__ import annotations

import math
from collections.abc import Sequence

PIECES = 4
"""Parts of a training's last stage, where lanes would idle at the end if all were trained in one go."""


class Schedule:
    """Trainings that `lanes` GPUs share.

    Args:
        steps: environment steps that each training has learned already.
        levels: steps at which they wait for one another, ascending; the last is where they end.
        lanes: trainings at a time.
        cut: train some in pieces in the last stage, so that all lanes end it together where their number does not go
        into that of
            the trainings. These come first: what ends last is then no more than one training a lane.

    ``steps``, ``levels`` and ``busy`` (trainings that run) may be read; ``settle`` lowers the last level.
    """

    def __init__(self, steps: Sequence[float], levels: Sequence[float], lanes: int, cut: bool = False) -> None:
        self.steps, self.levels = list(steps), list(levels)
        left = len(self.steps) % lanes
        self._cut = set(range(len(self.steps))[: lanes + left]) if cut and left and lanes > 1 else set()
        self.busy: set[int] = set()
        self._given_up: set[int] = set()

    def stage(self, k: int) -> int:
        """Index of the level that training k has not reached yet; len(levels) when it is through."""
        return sum(self.steps[k] >= level for level in self.levels)

    def take(self) -> tuple[int, float] | None:
        """(training, steps to go on to) of the next piece, now taken; None while there is none to take."""
        k = self._next()
        if k is None:
            return None
        self.busy.add(k)
        target = self.levels[self.stage(k)]
        if k in self._cut and self.last(k):
            target = min(target, self.steps[k] + self._piece())
        return k, target

    def next_is_last(self) -> bool:
        """Whether the next piece to take is one of the last stage."""
        k = self._next()
        return k is not None and self.last(k)

    def give_back(self, k: int, steps: float, failed: bool = False) -> None:
        """Training k has come to `steps`; one that failed is not taken again."""
        self.steps[k] = steps
        self.busy.discard(k)
        if failed:
            self._given_up.add(k)

    def last(self, k: int) -> bool:
        """Whether training k is in its last stage."""
        return self.stage(k) == len(self.levels) - 1

    def settle(self, reached: Sequence[float], rate: float, seconds: float, per: int) -> float:
        """Lower the last level to what all can reach in `seconds` at `rate` steps a second of all lanes together, in
        whole iterations of `per` steps, not below the level before; `reached` is where the trainings are now. Returns
        it."""
        fair = (sum(reached) + rate * max(seconds, 0.0)) / len(reached)
        before = self.levels[-2] if len(self.levels) > 1 else 0.0
        self.levels[-1] = min(self.levels[-1], max(before, per * math.floor(fair / per)))
        return self.levels[-1]

    def _next(self) -> int | None:
        waiting = [
            k
            for k in range(len(self.steps))
            if k not in self.busy | self._given_up and self.stage(k) < len(self.levels)
        ]
        return min(waiting, key=self._order) if waiting else None

    def _piece(self) -> float:
        before = self.levels[-2] if len(self.levels) > 1 else 0.0
        return max((self.levels[-1] - before) / PIECES, 1.0)

    def _order(self, k: int) -> tuple:
        stage = self.stage(k)
        if not self.last(k):
            return (stage, 0, 0.0, k)
        return (stage, 0, self.steps[k], k) if k in self._cut else (stage, 1, 0.0, k)
