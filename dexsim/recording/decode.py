"""One message of a recording as plain values, whatever its encoding: ROS 2 CDR, JSON or protobuf."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import numpy as np
from mcap.records import Channel, Schema

from dexsim.recording import cdr, ros2, stacked
from dexsim.recording.samples import Array, JointSample, Reader, Trajectory, Vector
from dexsim.recording.schema import JOINT_STATE, MULTI_ARRAY, TOPICS


class Unreadable(Exception):
    """No way to read this channel; the text says why and what to do."""


def decoder(channel: Channel, schema: Schema | None) -> Callable[[bytes], Any]:
    """Return a function from bytes to a message (object or dict). Raises Unreadable."""
    encoding = channel.message_encoding
    if encoding == "cdr":
        return _ros2(schema)
    if encoding == "json":
        return _json
    if encoding == "protobuf":
        return _protobuf(schema)
    raise Unreadable(f"its messages are encoded as '{encoding}', which is not read; cdr (ROS 2), json and protobuf are")


def _json(data: bytes) -> Any:
    out = json.loads(data)
    if b"\\ud" in data.lower():  # half a character is no name
        json.dumps(out, ensure_ascii=False).encode()
    return out


def _usual(channel: Channel, schema: Schema | None, kind: str) -> bool:
    """Return whether the messages are of the standard definition, whose fields need not be looked for."""
    if channel.message_encoding != "cdr" or schema is None or schema.name != kind:
        return False
    text = schema.data.decode("utf-8", "replace")
    return schema.encoding != "ros2msg" or not text.strip() or ros2.is_standard(kind, text)


def joint_reader(channel: Channel, schema: Schema | None, part: str) -> Reader[Any]:
    """Reads joint states, or trajectories of them. part: dotted path of the sub-message that holds them ("" the
    message itself)."""
    decode = decoder(channel, schema)
    if not part and _usual(channel, schema, JOINT_STATE):

        def standard(data: bytes) -> JointSample:
            m = decode(data)
            stamp = m.header.stamp
            return JointSample(
                m.name, m.position, m.velocity, m.effort, stamp.sec * 1_000_000_000 + stamp.nanosec or None
            )

        return Reader(standard, stacked.joint_rows)

    def read(data: bytes) -> JointSample | Trajectory:
        whole = decode(data)
        m = walk(whole, part)
        stamp = stamp_of(whole) or stamp_of(m)
        if isinstance(m, (list, tuple, np.ndarray)):  # the path leads straight to the positions
            return JointSample([], floats(m), np.zeros(0), np.zeros(0), stamp)
        points = get(m, "points")
        if points is not None:  # trajectory_msgs/JointTrajectory
            each = [
                (_seconds(get(p, "time_from_start")), floats(get(p, "positions")), floats(get(p, "velocities")))
                for p in points
            ]
            return Trajectory(list(get(m, "joint_names") or []), [p for p in each if len(p[1])], stamp)
        names = first(m, "name", "names", "joint_names") or first(whole, "name", "names", "joint_names") or []
        position = first(m, "position", "positions", "data")
        if position is None:
            raise ValueError("no field 'position'")
        return JointSample(
            list(names), floats(position), floats(first(m, "velocity", "velocities")),
            floats(first(m, "effort", "efforts", "current")), stamp,
        )  # fmt: skip

    return Reader(read)


def array_reader(channel: Channel, schema: Schema | None, part: str) -> Reader[Array]:
    """Reads arrays: (dimensions or (), flat values)."""
    decode = decoder(channel, schema)
    if not part and _usual(channel, schema, MULTI_ARRAY):

        def standard(data: bytes) -> Array:
            m = decode(data)
            return tuple([d.size for d in m.layout.dim]), m.data

        return Reader(standard, stacked.array_rows)

    def read(data: bytes) -> Array:
        m = walk(decode(data), part)
        if isinstance(m, (int, float, list, tuple, bytes, np.ndarray)):
            array = floats(m)
            return array.shape, array.ravel()
        values = first(m, "data", "values", "value", "voltage", "temperature")
        if values is None:
            raise ValueError("no field 'data'")
        layout = get(m, "layout")
        dims = tuple(int(get(d, "size")) for d in (get(layout, "dim") or [])) if layout is not None else ()
        array = floats(values)
        return dims or (array.shape if array.ndim > 1 else ()), array.ravel()

    return Reader(read)


def vector_reader(channel: Channel, schema: Schema | None, part: str, kind: str) -> Reader[Vector]:
    """Reads a wrench [6], a pose [7] or an IMU [10] (see `schema.Recording`): (values, stamp, frame)."""
    decode = decoder(channel, schema)
    pick = {"wrench": _wrench, "pose": _pose, "imu": _imu}[kind]

    def read(data: bytes) -> Vector:
        whole = decode(data)
        header = get(whole, "header")
        return (
            pick(walk(whole, part)),
            stamp_of(whole),
            str((get(header, "frame_id") if header is not None else "") or ""),
        )

    usual = not part and _usual(channel, schema, stacked.VECTORS[kind].type)
    return Reader(read, stacked.VECTORS[kind].rows if usual else None)


def get(m: Any, name: str) -> Any:
    """Return a field of a message or dict; None where there is none."""
    return m.get(name) if isinstance(m, dict) else getattr(m, name, None)


def first(m: Any, *names: str) -> Any:
    """Return the first of these fields that there is."""
    return next((v for v in (get(m, n) for n in names) if v is not None), None)


def walk(m: Any, path: str) -> Any:
    """Follow a dotted path of field names and list indices; of names with | between them, the first that is filled."""
    for step in filter(None, path.split(".")):
        if "|" in step:
            there = [x for x in (get(m, n) for n in step.split("|")) if x is not None]
            m = next((x for x in there if len(floats(get(x, "positions")))), there[0] if there else None)
        else:
            m = m[int(step)] if step.removeprefix("-").isdecimal() else get(m, step)
        if m is None:
            raise ValueError(f"no field '{step}' of '{path}'")
    return m


def floats(values: Any) -> np.ndarray:
    """Return float64 array; None within it (JSON's null) is NaN, None itself is empty."""
    if values is None:
        return np.zeros(0)
    if isinstance(values, (bytes, bytearray)):
        return np.frombuffer(values, np.uint8).astype(float)
    if isinstance(values, list):
        values = [np.nan if v is None else v for v in values]
    elif not isinstance(values, (np.ndarray, int, float)):
        values = list(values)
    return np.asarray(values, dtype=float)


def stamp_of(m: Any) -> int | None:
    """Return header.stamp (or `timestamp`) [ns]; None where unset or zero."""
    header = get(m, "header")
    stamp = get(header, "stamp") if header is not None else first(m, "timestamp", "stamp")
    if stamp is None:
        return None
    if isinstance(stamp, (int, float)):
        return None if not stamp else int(stamp if stamp > 1e14 else stamp * 1e9)
    seconds, nanos = first(stamp, "sec", "seconds", "secs"), first(stamp, "nanosec", "nsec", "nanos", "nsecs")
    if seconds is None:
        return None
    return (int(seconds) * 1_000_000_000 + int(nanos or 0)) or None


def _seconds(duration: Any) -> float:
    """Return a duration [s]: a message, a dict or a number; 0 for None."""
    if duration is None or isinstance(duration, (int, float)):
        return float(duration or 0.0)
    sec, nano = first(duration, "sec", "secs", "seconds"), first(duration, "nanosec", "nsec", "nsecs", "nanos")
    return float(sec or 0) + 1e-9 * float(nano or 0)


def _wrench(m: Any) -> np.ndarray:
    m = get(m, "wrench") or m
    return np.array([_number(get(get(m, part), axis)) for part in ("force", "torque") for axis in "xyz"])


def _pose(m: Any) -> np.ndarray:
    m = get(m, "pose") or m
    p, q = get(m, "position"), get(m, "orientation")
    return np.array([_number(get(p, a)) for a in "xyz"] + [_number(get(q, a)) for a in "wxyz"])


def _imu(m: Any) -> np.ndarray:
    """Return a part whose covariance begins with -1 is not measured (sensor_msgs/Imu): NaN."""
    out = []
    for name, axes in (("orientation", "wxyz"), ("angular_velocity", "xyz"), ("linear_acceleration", "xyz")):
        part, covariance = get(m, name), get(m, f"{name}_covariance")
        missing = covariance is not None and len(covariance) and covariance[0] == -1
        out += [np.nan if missing else _number(get(part, k)) for k in axes]
    return np.array(out)


def _number(value: Any) -> float:
    return np.nan if value is None else float(value)


def _ros2(schema: Schema | None) -> Callable[[bytes], Any]:
    if schema is None:
        raise Unreadable("its message definition is lost")
    text, encoding = schema.data.decode("utf-8", "replace"), schema.encoding
    if schema.name in TOPICS.values() and (encoding != "ros2msg" or not text.strip()):
        text, encoding = cdr.definition(schema.name), "ros2msg"  # the standard messages are known anyway
    if encoding not in ("ros2msg", "ros2idl") or not text.strip():
        raise Unreadable(
            f"its type {schema.name} is described in '{encoding or 'nothing'}', which is not read;"
            " record it with message definitions (ros2msg or ros2idl)"
        )
    try:
        return ros2.decoder(schema.name, encoding, text)
    except ros2.BadDefinition as error:
        raise Unreadable(
            f"the {'IDL ' if encoding == 'ros2idl' else ''}definition of {schema.name} is not read: {error}"
        ) from None


def _protobuf(schema: Schema | None) -> Callable[[bytes], Any]:
    try:
        from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
    except ImportError:
        raise Unreadable("its messages are encoded as protobuf; `pip install protobuf` to read them") from None
    if schema is None:
        raise Unreadable("its message definition is lost")
    try:
        pool = descriptor_pool.DescriptorPool()
        files = {f.name: f for f in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file}

        def add(name: str) -> None:
            file = files.pop(name, None)
            if file is not None:
                for dependency in file.dependency:
                    add(dependency)
                pool.Add(file)

        for name in list(files):
            add(name)
        return message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name)).FromString
    except Exception as error:
        raise Unreadable(f"the protobuf definition of {schema.name} cannot be read: {error}") from None
