"""What the real-time loop needs of a hand: `HandDriver`, in the vendor SDK's fields, units and signs.

Writing another driver: four calls that return at once. A bus that blocks (RS485: about 9.6 ms a round trip) is served
by a thread of the driver's own, which keeps the newest state for `read`.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

PASSIVE, POSITION = 0, 3
"""The SDK's control modes that are used: 0 passive (relaxed; the hardware still damps), 3 position."""


@dataclass
class HandState:
    """One reading, as the SDK gives it; J joints and P pads of up to T taxels in the order of the hand's hand.yaml: no
    names pass between a driver and the loop.

    time: host clock [s] at which it arrived (the SDK has no hardware stamp); sequence: counts readings.
    position [J] rad; current [J] mA, + opening, - closing; temperature [J] degC; error [J] codes (0 ok), None for
    either: not measured. tactile [P, T, 3] counts: fx, fy int8, fz uint8; taxels as in the pad's file; None: nothing is
    felt. velocity [J] rad/s, None where the firmware does not say. silent [P]: pads that give nothing for now, whose
    counts are zeros; None: all answer. follower [S] rad: joints without a drive that the hand.yaml calls sensed; None:
    not measured.
    """

    time: float
    sequence: int
    position: np.ndarray
    current: np.ndarray
    temperature: np.ndarray = None  # type: ignore[assignment]  # None becomes an array below, so nobody reads one
    error: np.ndarray = None  # type: ignore[assignment]
    tactile: np.ndarray = None  # type: ignore[assignment]
    velocity: np.ndarray | None = None
    silent: np.ndarray | None = None
    follower: np.ndarray | None = None

    def __post_init__(self) -> None:
        joints = np.shape(self.position)
        self.temperature = np.zeros(joints) if self.temperature is None else self.temperature
        self.error = np.zeros(joints, np.int64) if self.error is None else self.error
        self.tactile = np.zeros((0, 0, 3), np.int16) if self.tactile is None else self.tactile


@dataclass
class HandCommand:
    """Targets for every joint. position [J] rad; kp, ki, kd: the firmware's integer gains; tor_max [J] mA; mode."""

    position: np.ndarray
    tor_max: np.ndarray
    kp: int = 100
    ki: int = 0
    kd: int = 0
    mode: int = POSITION


class HandDriver(Protocol):
    """A hand. None of the calls waits for the bus. Four more may be absent. Two tell what a person beside it does:
    `present()`, an object is held out and the fingers are about to close on it; `started()`, the policy begins and it
    is let go. `problem()` says why the hand cannot be driven any longer (empty: it can); `released()`, after `relax`,
    whether the hand is limp and by what that is known (None: not known yet)."""

    name: str

    def open(self) -> dict[str, str]:
        """Connect; returns what to log once (serial number, firmware, protocol). Raises UserError; nothing moves."""

    def read(self) -> HandState | None:
        """Return the newest reading (the same one again until there is a newer), None before the first."""

    def send(self, command: HandCommand) -> Any:
        """Hand over targets for the next bus cycle. What is returned says that they were not taken, if anything: a
        text, False, or an object with an `error_code` that is not 0."""

    def relax(self) -> None:
        """Set mode 0 at every joint, as soon as possible; may be called from another thread, and twice."""

    def close(self) -> None:
        """Relax and disconnect."""


class Clock:
    """Host time."""

    def now(self) -> float:
        """Return monotonic time [s], the same in every process of this machine."""
        return time.monotonic()

    def sleep_until(self, t: float) -> None:
        """Return at time t [s] or a little later."""
        wait = t - time.monotonic()
        if wait > 0:
            time.sleep(wait)


class VirtualClock(Clock):
    """Time that passes only while somebody sleeps: for replays and tests."""

    def __init__(self, start: float = 0.0):
        self._now = start

    def now(self) -> float:
        return self._now

    def sleep_until(self, t: float) -> None:
        self._now = max(self._now, t)

    def go(self, t: float) -> None:
        """Make it time t [s], an earlier one too."""
        self._now = t
