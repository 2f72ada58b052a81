"""What the real-time loop needs of a hand: `HandDriver`, in the vendor SDK's fields, units and signs.

Writing another driver: four calls that return at once. A bus that blocks (RS485: about 9.6 ms a round trip) is served
by a thread of the driver's own, which keeps the newest state for `read`.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from dexsim.assets import xhand

PASSIVE, POSITION = 0, 3
"""The SDK's control modes that are used: 0 passive (relaxed; the hardware still damps), 3 position."""
TAXELS = (len(xhand.FINGERS), xhand.TAXELS_PER_FINGER, 3)


@dataclass
class HandState:
    """One reading, as the SDK gives it; joints in SDK order, fingers from the thumb.

    time: host clock [s] at which it arrived (the SDK has no hardware stamp); sequence: counts readings.
    position [12] rad; current [12] mA, + opening, - closing; temperature [12] degC; error [12] codes (0 ok).
    tactile [5, 120, 3] counts: fx, fy int8, fz uint8; taxel k = column * 12 + row. velocity [12] rad/s, None where the
    firmware does not say.
    """

    time: float
    sequence: int
    position: np.ndarray
    current: np.ndarray
    temperature: np.ndarray = field(default_factory=lambda: np.zeros(12))
    error: np.ndarray = field(default_factory=lambda: np.zeros(12, np.int64))
    tactile: np.ndarray = field(default_factory=lambda: np.zeros(TAXELS, np.int16))
    velocity: np.ndarray | None = None


@dataclass
class HandCommand:
    """Targets for every joint. position [12] rad; kp, ki, kd: the firmware's integer gains; tor_max [12] mA; mode."""

    position: np.ndarray
    tor_max: np.ndarray
    kp: int = 100
    ki: int = 0
    kd: int = 0
    mode: int = POSITION


class HandDriver(Protocol):
    """A hand. None of the calls waits for the bus. Two more may be absent, and tell what a person beside the hand does:
    `present()`, an object is held out and the fingers are about to close on it; `started()`, the policy begins and it
    is let go."""

    name: str

    def open(self) -> dict[str, str]:
        """Connect; returns what to log once (serial number, firmware, protocol). Raises UserError; nothing moves."""

    def read(self) -> HandState | None:
        """The newest reading (the same one again until there is a newer), None before the first."""

    def send(self, command: HandCommand) -> None:
        """Hand over targets for the next bus cycle."""

    def relax(self) -> None:
        """Mode 0 at every joint, as soon as possible; may be called from another thread, and twice."""

    def close(self) -> None:
        """Relax and disconnect."""


class Clock:
    """Host time."""

    def now(self) -> float:
        """Monotonic time [s], the same in every process of this machine."""
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
