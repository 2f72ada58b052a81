"""Write a recording: MCAP, ROS 2 profile, zstd chunks that are complete on disk at least once a second."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter

from dexsim import files
from dexsim.errors import UserError
from dexsim.recording import cdr, schema
from dexsim.recording.schema import Recording, Series


class Writer:
    """A recording being written; a context manager. A killed process leaves every finished chunk readable.

    Arguments:
        path: the file, replaced if it exists.
        joints: names [J], the order of every array given to add_*.
        meta: values by key of `schema.KEYS`; joint_names is filled in, the rest as given.
        start_ns: host time of t = 0 [ns since the epoch]; None: now.
        config: the resolved config as YAML, attached.
        chunk_s: a chunk is finished at least this often, in recorded time [s].
        sensed: names [S] of joints that are measured and not commanded: of `follower` in add_state.

    Every add_* takes t [s since start] and its values; `stamp` [s] is what header.stamp says (None: t itself).
    Not thread-safe: a real-time loop hands samples to the one thread that owns the writer.
    """

    def __init__(
        self, path: str | Path, joints: Sequence[str], meta: Mapping[str, Any] | None = None,
        start_ns: int | None = None, config: str | None = None, chunk_s: float = 1.0, chunk_bytes: int = 1 << 18,
        sensed: Sequence[str] = (),
    ):  # fmt: skip
        self.path, self.joints, self.sensed = Path(path).expanduser(), tuple(joints), tuple(sensed)
        self.start_ns = time.time_ns() if start_ns is None else int(start_ns)
        self.meta = {"schema": "1", "joint_names": ",".join([*joints, *sensed])}
        self.meta |= {k: str(v) for k, v in (meta or {}).items()}
        unknown = [k for k in self.meta if k not in schema.KEYS and k not in schema.UNIT_KEYS]
        if unknown:
            raise UserError(f"{self.path}: metadata key '{unknown[0]}' does not exist; valid: {', '.join(schema.KEYS)}")
        try:
            self._file = open(self.path, "wb")  # noqa: SIM115 (lives as long as the writer)
            self._mcap = McapWriter(self._file, chunk_size=chunk_bytes, compression=CompressionType.ZSTD)
            self._mcap.start(profile="ros2", library="dexsim")
            self._mcap.add_metadata(schema.METADATA, self.meta)
            if config is not None:
                at = self.start_ns, self.start_ns
                self._mcap.add_attachment(*at, schema.ATTACHMENT, "application/yaml", config.encode())
            self._file.flush()
        except OSError as error:
            with suppress(OSError, AttributeError):  # the latter where it was not opened
                self._file.close()
            raise UserError(f"cannot write recording {self.path}: {error.strerror}; choose another place") from None
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._count: dict[str, int] = {}
        self._chunk_ns = int(chunk_s * 1e9)
        self._last_flush: int | None = None
        self._open = True

    def add_about(self, name: str, values: Mapping[str, str]) -> None:
        """Add text by key as a further record of metadata, of that name."""
        self._mcap.add_metadata(name, dict(values))

    def add_command(self, t: float, position: np.ndarray, stamp: float | None = None) -> None:
        """Add targets [J] sent to the servos [rad]; NaN: none for this joint."""
        self._joints(schema.COMMANDS, t, position, None, None, stamp)

    def add_state(
        self, t: float, position: np.ndarray, velocity: np.ndarray | None = None, effort: np.ndarray | None = None,
        stamp: float | None = None, follower: np.ndarray | None = None,
    ) -> None:  # fmt: skip
        """Add measured position, velocity, effort [J] each; follower [S] rad: joints without a drive."""
        if follower is not None and self.sensed:
            none = np.full(len(self.sensed), np.nan)
            position = np.append(position, follower)
            velocity, effort = (None if x is None else np.append(x, none) for x in (velocity, effort))
        self._joints(schema.STATES, t, position, velocity, effort, stamp)

    def add(self, name: str, t: float, value: np.ndarray | float) -> None:
        """Add one of `schema.ARRAYS`: temperature [J] degC, duty [J] -1..1, enabled [J] (1 where the servo drives),
        supply_voltage [V], tactile [fingers, taxels, 3] in `tactile_unit`."""
        topic, labels = schema.ARRAYS[name]
        self.add_array(topic, t, np.atleast_1d(value), labels)

    def add_vector(
        self, topic: str, t: float, value: np.ndarray, frame: str = "palm", stamp: float | None = None
    ) -> None:
        """Add to one of `cdr.VECTORS`, in `frame`: force and torque [6] N, N.m; pose [7] x y z m, w x y z; of an IMU
        [10] orientation w x y z, angular velocity rad/s, linear acceleration m/s2."""
        self._message(topic, t, cdr.VECTORS[topic](self._ns(t if stamp is None else stamp), frame, value))

    def flush(self) -> None:
        """Finish the chunk in progress and hand it to the operating system."""
        self._mcap.flush()

    def close(self) -> None:
        """Write the index and close."""
        if self._open:
            self._open = False
            self._mcap.finish()
            self._file.close()

    def __enter__(self) -> Writer:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _ns(self, t: float) -> int:
        return self.start_ns + round(t * 1e9)

    def _joints(
        self, topic: str, t: float, position: np.ndarray, velocity: np.ndarray | None, effort: np.ndarray | None,
        stamp: float | None,
    ) -> None:  # fmt: skip
        names = self.joints if len(position) == len(self.joints) else (*self.joints, *self.sensed)
        self._message(
            topic, t, cdr.joint_state(self._ns(t if stamp is None else stamp), names, position, velocity, effort)
        )

    def add_array(self, topic: str, t: float, value: np.ndarray, labels: Sequence[str]) -> None:
        """Add an array of any topic; labels: a word for each axis."""
        self._message(topic, t, cdr.multi_array(value, labels))

    def _message(self, topic: str, t: float, data: bytes) -> None:
        if topic not in self._channels:
            kind = schema.TOPICS.get(topic, schema.MULTI_ARRAY)
            if kind not in self._schemas:
                self._schemas[kind] = self._mcap.register_schema(kind, "ros2msg", cdr.definition(kind).encode())
            self._channels[topic] = self._mcap.register_channel(topic, "cdr", self._schemas[kind])
        ns = self._ns(t)
        number = self._count[topic] = self._count.get(topic, 0) + 1
        self._mcap.add_message(self._channels[topic], log_time=ns, data=data, publish_time=ns, sequence=number)
        if self._last_flush is None:
            self._last_flush = ns
        elif ns - self._last_flush >= self._chunk_ns:
            self._last_flush = ns
            self._mcap.flush()


def write(path: str | Path, recording: Recording) -> None:
    """Write a whole `Recording`, all topics in order of time: beside its place, and renamed. Raises UserError."""
    r, path = recording, Path(path).expanduser()
    with (
        _placed(path) as part,
        Writer(part, r.joints, r.meta | {"joint_names": ",".join(r.joints)}, r.start_ns, r.config) as w,
    ):
        for _, _, add, args in sorted(_samples(r, w), key=lambda item: (item[0], item[1])):
            add(*args)


@contextmanager
def _placed(path: Path) -> Iterator[Path]:
    try:
        with files.beside(path) as part:
            yield part
    except UserError as error:
        raise UserError(str(error).replace(str(part), str(path))) from None
    except OSError as error:
        raise UserError(f"cannot write recording {path}: {error.strerror or error}; choose another place") from None


def _samples(r: Recording, w: Writer) -> Iterator[tuple[float, int, Any, tuple]]:
    """(time, order within a time, add function, its arguments) of every sample."""
    c, s = r.targets(), r.states
    for i, t in enumerate(c.t):
        yield t, 0, w.add_command, (t, c.value[i], _stamp(c, i))
    for i, t in enumerate(s.position.t):
        rest = [None if x is None else x.value[i] for x in (s.velocity, s.effort)]
        yield t, 1, w.add_state, (t, s.position.value[i], *rest, _stamp(s.position, i))
    for order, name in enumerate(schema.ARRAYS, start=2):
        if (series := getattr(r, name)) is not None:
            for i, t in enumerate(series.t):
                yield t, order, w.add, (name, t, series.value[i])
    vectors = {schema.OBJECT_POSE: r.object_pose, schema.EXTERNAL_FORCE: r.external_force, schema.IMU: r.imu}
    for order, (topic, series) in enumerate(vectors.items(), start=7):
        if series is not None:
            frame = "palm" if topic == schema.OBJECT_POSE else series.frame
            for i, t in enumerate(series.t):
                yield t, order, w.add_vector, (topic, t, series.value[i], frame, _stamp(series, i))


def _stamp(series: Series, i: int) -> float | None:
    if series.stamp is None or np.isnan(series.stamp[i]):
        return None
    return float(series.stamp[i])
