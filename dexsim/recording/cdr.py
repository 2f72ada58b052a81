"""The few ROS 2 messages of a recording as little-endian CDR, written from NumPy arrays.

The message definitions are in `schema.py`. `mcap-ros2-support` can write them too, one Python call a number: a touch
message of 1800 numbers then takes milliseconds, too long for a real-time loop. The bytes are the same (tested).
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from functools import lru_cache

import numpy as np

_ENCAPSULATION = b"\x00\x01\x00\x00"  # CDR, little endian; alignment counts from behind it


class Cdr:
    """A message being written: fields in order, each aligned to its size."""

    def __init__(self, begun: bytes = _ENCAPSULATION) -> None:
        self._b = bytearray(begun)

    def _align(self, size: int) -> None:
        self._b += b"\0" * (-(len(self._b) - 4) % size)

    def pack(self, code: str, value: float) -> None:
        """Append one number; `code` as in `struct`."""
        self._align(struct.calcsize(code))
        self._b += struct.pack("<" + code, value)

    def string(self, text: str) -> None:
        """Append a string with its length and a closing zero."""
        data = text.encode()
        self.pack("I", len(data) + 1)
        self._b += data + b"\0"

    def strings(self, texts: Sequence[str]) -> None:
        """Append a sequence of strings."""
        self.pack("I", len(texts))
        for text in texts:
            self.string(text)

    def sequence(self, values: np.ndarray | Sequence[float] | None, dtype: str) -> None:
        """Append a sequence of numbers ("<f8" or "<f4"); None is empty."""
        array = np.asarray([] if values is None else values, dtype=dtype).ravel()
        self.pack("I", array.size)
        self.array(array)

    def array(self, array: np.ndarray) -> None:
        """Numbers without a length."""
        if array.size:
            self._align(array.itemsize)
            self._b += array.tobytes()

    def header(self, stamp_ns: int, frame: str = "") -> None:
        """Append a std_msgs/Header."""
        self.pack("i", stamp_ns // 1_000_000_000)
        self.pack("I", stamp_ns % 1_000_000_000)
        self.string(frame)

    def stamp(self, stamp_ns: int) -> None:
        """Set another time in the header of a message that begins with one."""
        struct.pack_into("<iI", self._b, len(_ENCAPSULATION), *divmod(stamp_ns, 1_000_000_000))

    def bytes(self) -> bytes:
        """Return the message."""
        return bytes(self._b)


@lru_cache(maxsize=16)
def _named(names: tuple[str, ...]) -> bytes:
    """Return header and names of a joint state: of the thousands in a recording they differ in the stamp alone."""
    c = Cdr()
    c.header(0)
    c.strings(names)
    return c.bytes()


def joint_state(
    stamp_ns: int,
    names: Sequence[str],
    position: np.ndarray | None,
    velocity: np.ndarray | None = None,
    effort: np.ndarray | None = None,
) -> bytes:
    """Return sensor_msgs/JointState: names [J] and up to three arrays [J] (None: left empty)."""
    c = Cdr(_named(tuple(names)))
    c.stamp(stamp_ns)
    for values in (position, velocity, effort):
        c.sequence(values, "<f8")
    return c.bytes()


def multi_array(values: np.ndarray, labels: Sequence[str] = ()) -> bytes:
    """Return std_msgs/Float32MultiArray of any shape; one dimension label an axis (none: layout left empty)."""
    array = np.asarray(values, dtype="<f4")
    c = Cdr()
    c.pack("I", len(labels))
    stride = array.size
    for label, size in zip(labels, array.shape, strict=False):
        c.string(label)
        c.pack("I", size)
        c.pack("I", stride)
        stride //= max(size, 1)
    c.pack("I", 0)  # data_offset
    c.sequence(array, "<f4")
    return c.bytes()


def wrench(stamp_ns: int, frame: str, values: np.ndarray) -> bytes:
    """Return geometry_msgs/WrenchStamped: force and torque [6]."""
    c = Cdr()
    c.header(stamp_ns, frame)
    c.array(np.asarray(values, dtype="<f8"))
    return c.bytes()


def pose(stamp_ns: int, frame: str, values: np.ndarray) -> bytes:
    """Return geometry_msgs/PoseStamped from [7] x y z, w x y z."""
    x, y, z, qw, qx, qy, qz = np.asarray(values, dtype="<f8")
    c = Cdr()
    c.header(stamp_ns, frame)
    c.array(np.array([x, y, z, qx, qy, qz, qw], dtype="<f8"))
    return c.bytes()


def imu(stamp_ns: int, frame: str, values: np.ndarray) -> bytes:
    """Return sensor_msgs/Imu from [10] orientation w x y z, angular velocity, linear acceleration; covariances unknown
    (0). A part that is not a number is not measured, which the message says by -1 as the first entry of its
    covariance."""
    v = np.asarray(values, dtype="<f8")
    c = Cdr()
    c.header(stamp_ns, frame)
    for part in (v[[1, 2, 3, 0]], v[4:7], v[7:10]):
        missing = not np.isfinite(part).all()
        c.array(np.zeros_like(part) if missing else part)
        covariance = np.zeros(9, dtype="<f8")
        covariance[0] = -1.0 if missing else 0.0
        c.array(covariance)
    return c.bytes()
