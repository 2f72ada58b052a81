"""Limits that hold whatever a policy asks for, and the counts of when they did."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from dexsim.errors import UserError


@dataclass
class Guard:
    """Applied to targets after the policy, joint by joint.

    low, high [J] rad; speed [J] rad/s, of targets; current [J] mA; current_sign [J]: of the current that drives
    toward positive position. counts: how often each limit changed a target (joint-steps). Over its current for
    `sustained` s, or over `temperature` degC, a joint makes `must_relax` say why.
    """

    low: np.ndarray
    high: np.ndarray
    speed: np.ndarray
    current: np.ndarray
    current_sign: np.ndarray
    names: tuple[str, ...]
    sustained: float = 1.0
    temperature: float = 75.0
    counts: Counter = field(default_factory=Counter)

    def __post_init__(self) -> None:
        if not (np.isfinite(self.low).all() and np.isfinite(self.high).all() and (self.low < self.high).all()):
            j = int(np.argmax(~(self.low < self.high)))
            raise UserError(
                f"limits of {self.names[j]}: {self.low[j]:.4g} to {self.high[j]:.4g} rad leave nothing between them;"
                " use a smaller margin="
            )
        self._over = np.zeros(len(self.low))

    def apply(
        self, target: np.ndarray, before: np.ndarray, q: np.ndarray, current: np.ndarray, period: float
    ) -> np.ndarray:
        """Return safe targets [J] rad: finite and within the limits, whatever comes in. before: the last ones sent; q
        rad and current mA: measured; period s since the last."""
        t = np.asarray(target, float).copy()
        middle = 0.5 * (self.low + self.high)
        q = np.where(np.isfinite(q), q, middle)
        before = np.where(np.isfinite(before), before, q)
        current = np.nan_to_num(current, nan=0.0)
        bad = ~np.isfinite(t)
        self._count("not_finite", bad)
        t[bad] = before[bad]
        # where the motor draws too much, the target may lead the joint only by the share of its lead that draws the
        # limit: a position loop's current is proportional to it
        over = np.abs(current) > self.current
        if over.any():
            way = np.sign(self.current_sign * current)
            share = self.current / np.maximum(np.abs(current), 1e-9)
            room = np.maximum((before - q) * way, 0.0) * share
            limited = over & ((t - q) * way > room)
            t = np.where(limited, q + way * room, t)
            self._count("current", limited)
        step = self.speed * period
        fast = np.abs(t - before) > step * (1 + 1e-6)
        self._count("speed", fast)
        t = np.clip(t, before - step, before + step)
        out = (t < self.low - 1e-6) | (t > self.high + 1e-6)
        self._count("position", out)
        return np.clip(t, self.low, self.high)

    def must_relax(self, current: np.ndarray, temperature: np.ndarray, elapsed: float) -> str | None:
        """Return why the hand must be relaxed now, or None. elapsed: s since the last call."""
        over = np.abs(current) > self.current
        self._over = np.where(over, self._over + elapsed, 0.0)
        if (self._over > self.sustained).any():
            j = int(np.argmax(self._over))
            return (
                f"{self.names[j]} drew {abs(float(current[j])):.0f} mA, "
                f"over its {self.current[j]:.0f} mA for {self.sustained:g} s"
            )
        if (np.asarray(temperature) > self.temperature).any():
            j = int(np.argmax(temperature))
            return f"{self.names[j]} is at {temperature[j]:.0f} degC, over {self.temperature:g} degC"
        return None

    def _count(self, what: str, mask: np.ndarray) -> None:
        n = int(mask.sum())
        if n:
            self.counts[what] += n
