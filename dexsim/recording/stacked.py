"""Messages of one topic that differ in nothing but their numbers, decoded all at once.

Nearly every topic is such: the same names, the same frame, as many numbers in each message. Where the first message
keeps its numbers, all others do, so they are one view of the messages laid on top of each other, in place of one call
of a decoder each. A topic whose messages differ in any other byte is not read here, but one message after another
(`decode.py`): what a damaged message leads to is the decoder's to say.

A layout is read off the first message, which is also decoded the standard way: where the two differ, the layout is
not used.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import repeat

import numpy as np

from dexsim.recording.samples import Array, JointRows, JointSample, Vector
from dexsim.recording.schema import IMU_TYPE, POSE, WRENCH

Span = tuple[int, int, str]
"""Numbers within a message: offset of the first byte, how many, type ("<f8")."""

BLOCK = 16 << 20
"""Bytes of messages laid on top of each other at a time."""
STAMP: tuple[Span, Span] = ((4, 1, "<i4"), (8, 1, "<u4"))
"""Seconds and nanoseconds of a message that begins with a header."""
LITTLE, HEAD = b"\x00\x01", 12
"""How plain CDR of little endian begins; bytes before whatever comes behind the encoding and a stamp, or a layout."""


class _Cursor:
    """Where one is in a message (CDR, little endian): fields in order, each aligned to its size, counted from behind
    the four bytes that say how it is encoded."""

    def __init__(self, data: bytes, at: int):
        self.data, self.at = data, at

    def align(self, size: int) -> int:
        self.at += -(self.at - 4) % size
        return self.at

    def count(self) -> int:
        (value,) = struct.unpack_from("<I", self.data, self.align(4))
        self.at += 4
        return int(value)

    def string(self) -> None:
        size = self.count()  # moves on by itself
        self.at += size

    def numbers(self, count: int, kind: str) -> Span:
        size = int(kind[-1])
        span = (self.align(size) if count else self.at, count, kind)
        self.at += count * size
        return span


def joint_state(data: bytes) -> list[Span] | None:
    """Stamp (two), position, velocity, effort of a sensor_msgs/JointState; None where it is none."""
    c = _Cursor(data, HEAD)
    c.string()
    for _ in range(c.count()):
        c.string()
    found = [*STAMP, *(c.numbers(c.count(), "<f8") for _ in range(3))]
    return found if data[:2] == LITTLE and c.at <= len(data) else None


def at_the_end(data: bytes, count: int, kind: str, *before: Span) -> list[Span] | None:
    """Return the spans `before` and that of the `count` numbers with which a message ends."""
    at = len(data) - count * int(kind[-1])
    return [*before, (at, count, kind)] if data[:2] == LITTLE and at >= HEAD else None


def take(messages: Sequence[bytes], layout: Callable[[bytes], list[Span] | None]) -> list[np.ndarray] | None:
    """Return the numbers [T, n] of each span of T messages; None where they have no such layout, differ in length, or
    in any byte that is not of these numbers."""
    size = len(messages[0])
    try:
        spans = layout(messages[0])
    except struct.error:  # it ends before its numbers do
        return None
    if spans is None or not size or any(len(m) != size for m in messages):
        return None
    # what lies between the numbers must be what the first message has there
    edges = [0, *(x for at, count, kind in sorted(spans) for x in (at, at + count * int(kind[-1]))), size]
    rest = [slice(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b > a]
    first = np.frombuffer(messages[0], np.uint8)
    out = [np.empty((len(messages), count), kind) for _, count, kind in spans]
    step = max(BLOCK // size, 1)
    for start in range(0, len(messages), step):
        block = messages[start : start + step]
        raw = np.frombuffer(b"".join(block), np.uint8).reshape(len(block), size)
        if not all((raw[:, part] == first[part]).all() for part in rest):
            return None
        for x, (at, count, kind) in zip(out, spans, strict=True):
            if count:
                x[start : start + len(block)] = np.ascontiguousarray(raw[:, at : at + x.itemsize * count]).view(kind)
    return out


def nanoseconds(seconds: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """Return [T] int64 ns of stamps [T, 1] s and [T, 1] ns; 0 where unset."""
    return (seconds.astype(np.int64) * 1_000_000_000 + rest.astype(np.int64))[:, 0]


# -- by type of message -----------------------------------------------------------------------------------------------


def _equal(a: np.ndarray, b: np.ndarray) -> bool:
    """Return whether two arrays are the same to the last bit."""
    return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()


def joint_rows(messages: Sequence[bytes], one: JointSample) -> JointRows | None:
    """Return joint states of one layout; None where they are not. one: the first, as the standard decoder reads it."""
    found = take(messages, joint_state)
    if found is None:
        return None
    seconds, rest, position, velocity, effort = found
    rows = JointRows(one.names, position, velocity, effort, nanoseconds(seconds, rest))
    first_row = rows[0]
    same = first_row.stamp == one.stamp and all(
        _equal(getattr(first_row, k), getattr(one, k)) for k in ("position", "velocity", "effort")
    )
    return rows if same else None


def array_rows(messages: Sequence[bytes], one: Array) -> list[Array] | None:
    """Return arrays of one layout; None where they are not. one: the first, as the standard decoder reads it."""
    found = take(messages, partial(at_the_end, count=len(one[1]), kind="<f4"))
    if found is None:
        return None
    return list(zip(repeat(one[0]), found[0], strict=False)) if _equal(found[0][0], one[1]) else None


@dataclass(frozen=True)
class Plain:
    """A message of a header and `count` float64. order: which of them are read; missing: number of a first entry of a
    covariance, and which of the values read are not measured where that is -1."""

    type: str
    count: int
    order: tuple[int, ...]
    missing: tuple[tuple[int, slice], ...] = ()

    def rows(self, messages: Sequence[bytes], one: Vector) -> list[Vector] | None:
        """Return vectors of one layout; None where they are not. one: the first, as it is read by itself."""
        found = take(messages, lambda data: at_the_end(data, self.count, "<f8", *STAMP))
        if found is None:
            return None
        seconds, rest, numbers = found
        values = numbers[:, self.order]
        for first, part in self.missing:
            values[numbers[:, first] == -1, part] = np.nan
        stamps = [ns or None for ns in nanoseconds(seconds, rest).tolist()]
        same = _equal(values[0], one[0]) and stamps[0] == one[1]
        return list(zip(values, stamps, repeat(one[2]), strict=False)) if same else None


VECTORS = {
    "wrench": Plain(WRENCH, 6, (0, 1, 2, 3, 4, 5)),
    "pose": Plain(POSE, 7, (0, 1, 2, 6, 3, 4, 5)),
    "imu": Plain(
        IMU_TYPE, 37, (3, 0, 1, 2, 13, 14, 15, 25, 26, 27), ((4, slice(0, 4)), (16, slice(4, 7)), (28, slice(7, 10))),
    ),
}
"""What `decode.vector_reader` reads by kind; quaternions w first."""
