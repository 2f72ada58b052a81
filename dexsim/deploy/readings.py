"""Which readings the loop takes: a hand's state or an object's pose that cannot be true is left out, and said why."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from dexsim.deploy.driver import HandState
from dexsim.hand import Hand

AHEAD = 0.05
"""s that a stamp may lie ahead of the loop's clock: a driver's thread stamps while a turn is under way."""
BEYOND = 0.5
"""rad that a joint may be read beyond its range: an encoder's zero is never quite right."""
FASTEST = 100.0
"""rad/s that a joint may be read to turn; the fastest of the hand's turns at about a tenth."""


_JOINT = (("current", "mA", -32768.0, 32767.0), ("temperature", "degC", -60.0, 250.0))
_TOUCH = 1e5  # counts; the wire's are at most 255, a replay's are not rounded or cut


def implausible(
    state: HandState, now: float, hand: Hand, taxels: tuple[int, int], has_touch: bool = False
) -> str | None:
    """Return why a reading [driver.HandState] cannot be true at time now [s], or None: a stamp that is no time or lies
    ahead, an array of another shape, a value that is not finite or beyond what the hand can show. How old it is, is not
    judged here. hand: whose; taxels: pads and taxels of each (`tactile.layout.touch_shape`); has_touch: readings before
    had taxels, which a hand does not lose."""
    J, (low, high) = len(hand.joints), hand.limits.T
    if (wrong := bad_stamp(state.time, now)) is not None:
        return wrong
    for name, unit, least, most in (("position", "rad", low - BEYOND, high + BEYOND), *_JOINT):
        x = _array(getattr(state, name))
        if x is None or x.shape != (J,):
            return f"{name} is not {J} numbers"
        bad = ~((x >= least) & (x <= most))  # NaN too
        if bad.any():
            j = int(np.argmax(bad))
            return f"{name} of {hand.joints[j]} is {x[j]:.4g} {unit}"
    error = _array(state.error)
    if error is None or error.shape != (J,):
        return f"error is not {J} codes"
    touch = _array(state.tactile)
    if touch is None or ((touch.size or has_touch) and touch.shape != (*taxels, 3)):
        return f"tactile is not {' x '.join(map(str, (*taxels, 3)))} numbers"
    top = float(np.abs(touch).max(initial=0.0))
    if not top <= _TOUCH:
        return f"a taxel reads {top:.4g} counts"
    if state.velocity is not None:
        speed = _array(state.velocity)
        if speed is None or speed.shape != (J,):
            return f"velocity is not {J} numbers"
        if (np.abs(speed) > FASTEST).any():  # NaN: not said, as of older firmware
            j = int(np.nanargmax(np.abs(speed)))
            return f"velocity of {hand.joints[j]} is {speed[j]:.4g} rad/s"
    return None


def bad_stamp(stamp: Any, now: float) -> str | None:
    """Return why a stamp [s] cannot be a time of the loop's clock, or None."""
    if not isinstance(stamp, (int, float, np.integer, np.floating)) or not np.isfinite(stamp):
        return f"its stamp is {stamp}, no time"
    if stamp > now + AHEAD:
        return f"its stamp lies {stamp - now:.3g} s ahead"
    return None


def bad_sequence(number: Any, before: Any) -> str | None:
    """Return why the count of a reading cannot be one after `before` (None: the first), or None."""
    if not isinstance(number, (int, float, np.integer, np.floating)) or not np.isfinite(number):
        return f"the count of its readings is {number}, no number"
    back = before is not None and number < before
    return f"the count of its readings went back from {before} to {number}" if back else None


_ARRAYS = ("position", "current", "temperature", "error", "tactile", "velocity", "silent")


def copied(state: HandState) -> HandState:
    """Return a reading whose arrays nobody else writes."""
    own: dict[str, Any] = {n: x.copy() for n in _ARRAYS if isinstance(x := getattr(state, n), np.ndarray)}
    return dataclasses.replace(state, **own)


def overwritten(given: HandState, mine: HandState) -> str | None:
    """Return the array of a reading that has been changed since `mine` was copied of it, or None."""
    for name in _ARRAYS:
        theirs, ours = getattr(given, name), getattr(mine, name)
        if isinstance(theirs, np.ndarray) and isinstance(ours, np.ndarray) and theirs.tobytes() != ours.tobytes():
            return name
    return None


def refused(answer: Any) -> str:
    """Return what a driver's `send` said of a command that the hand did not take; empty where it took it."""
    code = getattr(answer, "error_code", 0)
    if code:
        return f"{getattr(answer, 'error_message', '') or 'an error'} (code {code})"
    return answer if isinstance(answer, str) else "no reason given" if answer is False else ""


class Lasting:
    """Since when something is so [s], None: it is not. Two in a row that are not so end it, one between does not."""

    def __init__(self) -> None:
        self.since: float | None = None
        self.what, self._not = "", 0

    def note(self, so: bool, now: float, what: str = "") -> None:
        """Note whether it is so at time now [s]."""
        self._not = 0 if so else self._not + 1
        if so:
            self.since, self.what = now if self.since is None else self.since, what
        elif self._not > 1:
            self.since = None


class Frozen:
    """Readings that count on and say the same to the last bit, while a hand could not stand still."""

    LONG, MOVED, LOAD = 0.3, 0.05, 0.3
    """s; rad that a joint's target has moved since; share of its current limit, below which it is under no load."""

    def __init__(self) -> None:
        self._bits, self._since, self._target = b"", 0.0, np.zeros(0)

    def note(self, now: float, state: HandState, target: np.ndarray | None) -> None:
        """Note a new reading, and the targets [J] rad that stand."""
        parts = (state.position, state.current, state.temperature, state.tactile, state.velocity)
        bits = b"".join(np.asarray(x).tobytes() for x in parts if x is not None)
        if bits != self._bits or target is None:
            self._bits, self._since = bits, now
            self._target = np.zeros(0) if target is None else np.array(target, float)

    def problem(
        self, now: float, target: np.ndarray | None, state: HandState, limit: np.ndarray
    ) -> tuple[int, float] | None:
        """Return the joint that should have moved, and for how long [s] nothing has; None. limit [J] mA."""
        if target is None or len(self._target) != len(target) or now - self._since < self.LONG:
            return None
        idle = np.abs(np.asarray(state.current, float)) < self.LOAD * limit
        moved = np.where(idle, np.abs(target - self._target), 0.0)
        j = int(np.argmax(moved))
        return (j, now - self._since) if moved[j] > self.MOVED else None


def bad_seen(what: str, value: Any) -> str | None:
    """Return why what is seen of an object cannot be true, or None. what: `place` [3] m, palm frame, `orientation` [4]
    or `pose` [7], which is both."""
    form = {"place": "x y z", "orientation": "w x y z", "pose": "x y z w x y z"}[what]
    x = _array(value)
    if x is None or x.shape != (len(form.split()),):
        return f"its {what} is not {form}"
    if what != "orientation" and not np.abs(x[:3]).max() < 2.0:  # NaN too
        return f"its place is {np.round(x[:3], 3).tolist()} m"
    if what != "place" and not 0.5 < float(np.linalg.norm(x[-4:])) < 2.0:
        return f"its orientation is {np.round(x[-4:], 3).tolist()}"
    return None


def _array(x: Any) -> np.ndarray | None:
    """Return float64, None where it is not (real) numbers."""
    try:
        return None if np.iscomplexobj(x) else np.asarray(x, float)
    except (TypeError, ValueError):
        return None
