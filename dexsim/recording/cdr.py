"""The few ROS 2 messages of a recording as little-endian CDR, and definitions of standard messages, by `rosbags`."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from functools import cache
from math import prod
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from dexsim.recording.schema import EXTERNAL_FORCE, IMU, IMU_TYPE, JOINT_STATE, MULTI_ARRAY, OBJECT_POSE, POSE, WRENCH


@cache
def standard() -> Typestore:
    """Return the message types that come with ROS 2."""
    return get_typestore(Stores.ROS2_HUMBLE)


@cache
def definition(kind: str) -> str:
    """Return the definition of a standard message type, as rosbag2 stores it. Raises KeyError for another type."""
    return standard().generate_msgdef(kind, ros_version=2)[0]


def joint_state(
    stamp_ns: int, names: Sequence[str], position: np.ndarray | None, velocity: np.ndarray | None = None,
    effort: np.ndarray | None = None,
) -> bytes:  # fmt: skip
    """Return sensor_msgs/JointState: names [J] and up to three arrays [J] (None: left empty)."""
    data = bytearray(_named(tuple(names)))
    struct.pack_into("<iI", data, 4, *divmod(stamp_ns, 1_000_000_000))
    for x in (position, velocity, effort):
        array = np.asarray([] if x is None else x, "<f8")
        data += struct.pack("<I", array.size)
        data += b"\0" * (-(len(data) - 4) % 8 * bool(array.size)) + array.tobytes()
    return bytes(data)


@cache
def _named(names: tuple[str, ...]) -> bytes:
    """Return a joint state up to its numbers: of the thousands in a recording it differs in the stamp alone."""
    none = np.zeros(0)
    return _bytes(JOINT_STATE, _header(0), list(names), none, none, none)[:-12]


def multi_array(values: np.ndarray, labels: Sequence[str] = ()) -> bytes:
    """Return std_msgs/Float32MultiArray of any shape; one dimension label an axis (none: layout left empty)."""
    array = np.asarray(values, "<f4")
    return _bytes(MULTI_ARRAY, _layout(array.shape, tuple(labels)), array.ravel())


@cache
def _layout(shape: tuple[int, ...], labels: tuple[str, ...]) -> Any:
    strides = [prod(shape[k:]) for k in range(len(labels))]
    dims = [_of("std_msgs/msg/MultiArrayDimension", *x) for x in zip(labels, shape, strides, strict=False)]
    return _of("std_msgs/msg/MultiArrayLayout", dims, 0)


def wrench(stamp_ns: int, frame: str, values: np.ndarray) -> bytes:
    """Return geometry_msgs/WrenchStamped: force and torque [6]."""
    force, torque = (_vector(x) for x in np.asarray(values, float).reshape(2, 3))
    return _bytes(WRENCH, _header(stamp_ns, frame), _of("geometry_msgs/msg/Wrench", force, torque))


def pose(stamp_ns: int, frame: str, values: np.ndarray) -> bytes:
    """Return geometry_msgs/PoseStamped from [7] x y z, w x y z."""
    x = np.asarray(values, float).tolist()
    at = _of("geometry_msgs/msg/Pose", _of("geometry_msgs/msg/Point", *x[:3]), _quaternion(x[3:]))
    return _bytes(POSE, _header(stamp_ns, frame), at)


def imu(stamp_ns: int, frame: str, values: np.ndarray) -> bytes:
    """Return sensor_msgs/Imu from [10] orientation w x y z, angular velocity, linear acceleration; covariances unknown
    (0). A part that is not a number is not measured, which the message says by -1 as the first entry of its
    covariance."""
    v, parts = np.asarray(values, float), []
    for part, make in ((v[:4], _quaternion), (v[4:7], _vector), (v[7:], _vector)):
        missing = not np.isfinite(part).all()
        parts += [make(np.zeros_like(part) if missing else part), np.r_[-1.0 if missing else 0.0, np.zeros(8)]]
    return _bytes(IMU_TYPE, _header(stamp_ns, frame), *parts)


VECTORS = {EXTERNAL_FORCE: wrench, OBJECT_POSE: pose, IMU: imu}


def _bytes(kind: str, *fields: Any) -> bytes:
    return bytes(standard().serialize_cdr(_of(kind, *fields), kind))


def _of(kind: str, *fields: Any) -> Any:
    return standard().types[kind](*fields)


def _header(stamp_ns: int, frame: str = "") -> Any:
    return _of("std_msgs/msg/Header", _of("builtin_interfaces/msg/Time", *divmod(stamp_ns, 1_000_000_000)), frame)


def _vector(x: np.ndarray) -> Any:
    return _of("geometry_msgs/msg/Vector3", *map(float, x))


def _quaternion(x: Sequence[float] | np.ndarray) -> Any:
    w, *rest = map(float, x)
    return _of("geometry_msgs/msg/Quaternion", *rest, w)
