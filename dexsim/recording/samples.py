"""What the messages of a topic hold, one by one or as rows, and what reads them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Generic, TypeVar, overload

import numpy as np

T = TypeVar("T")
Array = tuple[tuple[int, ...], np.ndarray]
"""Dimensions (or ()) and flat values."""
Vector = tuple[np.ndarray, "int | None", str]
"""Values, stamp [ns], frame."""


class JointSample:
    """names (or []), position, velocity, effort (each an array, empty where not given), stamp [ns] or None."""

    __slots__ = ("names", "position", "velocity", "effort", "stamp")

    def __init__(self, names: Sequence[str], position: Any, velocity: Any, effort: Any, stamp: int | None):
        self.names, self.position, self.velocity, self.effort, self.stamp = names, position, velocity, effort, stamp


class Trajectory:
    """A message of several targets: names, points (s after its start, position [n], velocity [n] or empty), stamp [ns]
    or None."""

    __slots__ = ("names", "points", "stamp")

    def __init__(self, names: Sequence[str], points: Sequence[tuple[float, Any, Any]], stamp: int | None):
        self.names, self.points, self.stamp = names, points, stamp


class JointRows(Sequence[JointSample]):
    """Joint samples of the same names and numbers of values: position, velocity, effort [T, n], each with n = 0 where
    not given, stamp [T] int64 ns, 0 for None; carried [T, n]: of which joints each sample tells (None: of all)."""

    def __init__(
        self, names: Sequence[str], position: np.ndarray, velocity: np.ndarray, effort: np.ndarray, stamp: np.ndarray,
        carried: np.ndarray | None = None,
    ):  # fmt: skip
        self.names, self.position, self.velocity, self.effort, self.stamp = names, position, velocity, effort, stamp
        self.carried = carried

    def __len__(self) -> int:
        return len(self.stamp)

    @overload
    def __getitem__(self, i: int) -> JointSample: ...
    @overload
    def __getitem__(self, i: slice) -> JointRows: ...
    def __getitem__(self, i: int | slice) -> JointSample | JointRows:
        if isinstance(i, slice):
            return self.take(i)
        stamp = int(self.stamp[i]) or None
        return JointSample(self.names, self.position[i], self.velocity[i], self.effort[i], stamp)

    def __iter__(self) -> Iterator[JointSample]:
        rows = zip(self.position, self.velocity, self.effort, self.stamp.tolist(), strict=True)
        return (JointSample(self.names, q, v, e, stamp or None) for q, v, e, stamp in rows)

    def take(self, which: np.ndarray | slice) -> JointRows:
        """Return these samples, in this order."""
        carried = None if self.carried is None else self.carried[which]
        position, velocity, effort, stamp = (x[which] for x in (self.position, self.velocity, self.effort, self.stamp))
        return JointRows(self.names, position, velocity, effort, stamp, carried)


class Reader(Generic[T]):
    """Reads the messages of a channel: one (called with its bytes), or all at once (`together`)."""

    def __init__(
        self, one: Callable[[bytes], T], stack: Callable[[Sequence[bytes], T], Sequence[T] | None] | None = None
    ):
        self._one, self._stack = one, stack

    def __call__(self, data: bytes) -> T:
        """Return one message; raises what a damaged one leads to."""
        return self._one(data)

    def together(self, messages: Sequence[bytes]) -> Sequence[T] | None:
        """Return all messages, as one after another would be read; None where they are not of one layout."""
        if self._stack is None or len(messages) < 2:
            return None
        try:
            first = self._one(messages[0])
        except Exception:  # read one after another, which says what is wrong
            return None
        return self._stack(messages, first)
