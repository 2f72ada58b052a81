"""Read a recording: dexsim's own, or a ROS 2 bag with other topics and names; whole, truncated or damaged."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Channel, Message
from mcap.records import Schema as McapSchema

from dexsim import files, guard
from dexsim.errors import UserError
from dexsim.hand import Hand, load_hand
from dexsim.recording import attached, columns, decode, metadata, names, readers, schema, timeline
from dexsim.recording.audit import audit as find_faults
from dexsim.recording.container import BAGS, Container, open_container
from dexsim.recording.samples import JointRows, JointSample, Reader, Trajectory
from dexsim.recording.schema import Finding, Recording, Series, States
from dexsim.recording.smooth import at
from dexsim.recording.units import Unit, Units, split

NAN = float("nan")
MAX_JOINTS = 1000
STARTED, PLANNED = 0.5, 60.0
"""s before and after its receipt in which the header.stamp of a trajectory says when it begins."""
MOST_CURRENT = 100.0
"""A: what no joint takes."""
LINE = 0.1
"""s: points of a trajectory that lie further apart get targets between them (cubic where speeds are given)."""
MAX_START = 1 << 62
"""ns: a start up to which a stamp less it fits 64 bits."""
CONTROLLER = "JointTrajectoryControllerState"
PARTS = {schema.COMMANDS: "reference|desired", schema.STATES: "feedback|actual"}
"""What a controller's state (`control_msgs/JointTrajectoryControllerState`, new and old) says of each topic."""
SENT = {"a trajectory": "trajectory_msgs/msg/JointTrajectory", "values": "std_msgs/msg/Float64MultiArray"}
"""Types of topics that are the commands where no other can be, by what they hold."""
_VECTORS = {schema.EXTERNAL_FORCE: ("wrench", 6), schema.OBJECT_POSE: ("pose", 7), schema.IMU: ("imu", 10)}


def read(
    path: str | Path, remap: Mapping[str, str] | None = None, meta: Mapping[str, Any] | None = None,
    joints: Sequence[str] | None = None, audit: bool = True, hand: Hand | None = None,
    limits: Mapping[str, tuple[float, float]] | None = None,
) -> Recording:  # fmt: skip
    """Return the recording in an MCAP file, in a folder that `ros2 bag record` wrote, in a CSV or NPZ file with named
    columns (`columns.py`), or in an episode of a data set (`readers.py`): "DATASET#3".

    Arguments:
        remap: our topic -> theirs ("/joint_states": "/xhand/state"), "#a.b" behind it for a sub-message; our joint name
            -> theirs ("index_joint1": "finger2_mcp"). A topic that differs only by a namespace, and joint names that
            differ only by a prefix, are found without. Of a CSV or NPZ file: "position.elbow" (or "time") -> the
            column.
        meta: metadata values that win over what the recording says; units as "units.position" (`units.py`).
        joints: names of the model's joints: their order, and others are left out. None: the hand's where the names
            fit, else those of the recording.
        audit: also look for faults of the signals (`audit.py`).
        hand: whose joints, limits and pads it is likely to hold. None: the xHand.
        limits: range of each joint [rad or m], for units along it. None: the hand's.

    Everything readable is returned; what is lost, assumed or suspicious is in `findings`. Nothing is repaired but what
    a finding says. Raises UserError where there is no recording in the file, or the request does not fit it.
    """
    path = Path(path).expanduser()
    base, _ = readers.address(path)
    dataset = readers.reader_of(base) if base.exists() else None
    if dataset is not None:
        size = readers.ready(dataset, base)
    else:
        size = sum(files.check(p, "recording", 64 << 30) for p in _files(path))
    _ = hand or load_hand()  # here, so that not every reader's process does it again
    given = path, dict(remap or {}), dict(meta or {}), joints, audit, hand, limits
    return guard.call(_read, *given, what=f"recording {path}", size=size)


def _read(
    path: Path, remap: dict[str, str], given: dict[str, Any], joints: Sequence[str] | None, audit: bool,
    hand: Hand | None, limits: Mapping[str, tuple[float, float]] | None,
) -> Recording:  # fmt: skip
    meta, units = split(given)
    base, part = readers.address(path)
    dataset = readers.reader_of(base) if base.exists() else None
    if dataset is not None or path.suffix.lower() in columns.SUFFIXES:
        stated, units, findings = metadata.collect(base, {}, meta, units)
        about, clock = stated, units.get("time", "")
        if dataset is None:
            found = columns.read_table(path, remap, about, clock)
        else:
            episode = readers.read_episode(base, dataset, part)
            stated = episode.meta | stated
            found = columns.of_columns(path, episode.columns, episode.findings, remap, about, clock)
            found.arrays = episode.arrays
        table = _TableReading(path, found, remap, hand)
        reading: _Reading = table
        stated = table.table.meta | stated
    else:
        containers = [open_container(p) for p in _files(path)]
        reading = _Reading(path, containers, remap, hand)
        own = metadata.own_record([m for c in containers for m in c.metadata])
        reading.stated = bool(own)
        stated, units, findings = metadata.collect(path, own, meta, units)
    reading.findings += findings
    modelled = hand is not None or limits is not None
    if hand is not None or limits is None:
        known = hand or load_hand()
        limits = dict(zip(known.joints, known.limits.tolist(), strict=True)) | dict(limits or {})
    recording = reading.build(stated, joints, Units(units, limits, str(path), modelled))
    if audit:
        recording.findings += find_faults(recording)
    return recording


def _files(path: Path) -> list[Path]:
    if not path.is_dir():
        return [path]
    found = sorted((p for kind in BAGS for p in path.glob(kind)), key=lambda p: (len(p.name), p.name))  # _2 before _10
    if not found:
        raise UserError(f"recording {path}: the folder holds no .mcap or .db3 file (as `ros2 bag record` writes them)")
    return found


@dataclass
class _Stream:
    """The messages of one channel of one file."""

    channel: Channel
    schema: McapSchema | None
    messages: list[Message]


class _Reading:
    """One file (or bag folder) being turned into a Recording."""

    def __init__(self, path: Path, containers: list[Container], remap: dict[str, str], hand: Hand | None = None):
        self.path, self.hand = path, hand or load_hand()
        self.findings: list[Finding] = []
        self.arrays: dict[str, np.ndarray] = {}
        self.si: set[tuple[str, str]] = set()  # (quantity, their joint) whose values are in SI already
        self.stated = False  # the format of recordings that dexsim writes is in SI: other units there are a fault
        self.ranges: dict[str, str] = {}  # their joint -> the unit along its range that its columns name
        self.breaks: list[tuple[float, float]] = []
        self.streams: dict[str, list[_Stream]] = {}
        for c in containers:
            self._damage(c)
            by_channel: dict[int, list[Message]] = {}
            for m in c.messages:
                by_channel.setdefault(m.channel_id, []).append(m)
            for channel_id, channel in c.channels.items():
                stream = _Stream(channel, c.schemas.get(channel.schema_id), by_channel.get(channel_id, []))
                self.streams.setdefault(channel.topic, []).append(stream)
        attached = [c.attachments[schema.ATTACHMENT] for c in containers if schema.ATTACHMENT in c.attachments]
        self.config = attached[0].decode("utf-8", "replace") if attached else None
        self.sources = self._topics({_slash(k): v for k, v in remap.items() if _is_topic(k)})
        self.joint_remap = {k: v for k, v in remap.items() if not _is_topic(k)}
        if not any(s.messages for theirs, _ in self.sources.values() for s in self.streams[theirs]):
            raise UserError(
                f"recording {path}: no message that can be read; topics: {self._describe_topics()}" + self._losses()
            )
        self.start_ns = min(
            self._first(s.messages) for theirs, _ in self.sources.values() for s in self.streams[theirs] if s.messages
        )

    def _note(self, *about: Any, **more: Any) -> None:
        """Add a `schema.note`."""
        self.findings.append(schema.note(*about, **more))

    def _damage(self, c: Container) -> None:
        where = f"{c.path.name}: " if c.path != self.path else ""
        for ns, count, text in c.damage:
            self._note("damage", where + text + _at(ns), "error", count=max(count, 1))
        orphans: dict[int, int] = {}
        for m in c.messages:
            if m.channel_id not in c.channels:
                orphans[m.channel_id] = orphans.get(m.channel_id, 0) + 1
        for channel_id, count in orphans.items():
            text = f"{where}{count} messages of channel {channel_id}, whose record (topic and type) is lost"
            self._note("damage", text, "error", count=count)

    def _first(self, messages: list[Message]) -> int:
        """Return the earliest host time [ns] of those that can be true."""
        base = sorted(m.log_time for m in messages)[len(messages) // 2]
        keep = timeline.possible(np.array([(m.log_time - base) * 1e-9 for m in messages]))
        return min((m.log_time for m, on in zip(messages, keep, strict=True) if on), default=base)

    def _losses(self) -> str:
        return "".join(f"; {f.text}" for f in self.findings[:3] if f.kind == "damage")

    # -- topics -------------------------------------------------------------------
    def _topics(self, remap: dict[str, str]) -> dict[str, tuple[str, str]]:
        """Return our topic -> (theirs, part): as stated, else of the same name, else of the same name in a namespace,
        else (for joint states) the only one of the type."""
        for ours in remap:
            if ours not in schema.TOPICS:
                raise UserError(f"remap.{ours}: no such topic; topics are {', '.join(schema.TOPICS)}")
        out: dict[str, tuple[str, str]] = {}
        for ours, target in remap.items():
            theirs, _, part = target.partition("#")
            if theirs not in self.streams:
                raise UserError(
                    f"recording {self.path} has no topic '{theirs}' (remap.{ours}); it has: {self._describe_topics()}"
                )
            out[ours] = (theirs, part)
        for ours in schema.TOPICS:
            if ours not in out and ours in self.streams:
                out[ours] = (ours, "")
        for ours, kind in schema.TOPICS.items():
            taken = {theirs for theirs, _ in out.values()}
            if ours in out:
                continue
            fits = [t for t in self.streams if t not in taken and t.endswith(ours) and self._is_a(t, kind)]
            if ours == schema.STATES and not fits:
                fits = [t for t in self.streams if t not in taken and self._is_a(t, kind, strict=True)]
            self._choose(out, ours, [(t, "") for t in fits])
        self._of_controllers(out)
        if schema.STATES not in out and schema.COMMANDS not in out:
            raise UserError(
                f"recording {self.path} has neither {schema.STATES} nor {schema.COMMANDS} (say which they are with"
                f" remap.{schema.STATES}=TOPIC); its topics: {self._describe_topics()}" + self._losses()
            )
        if schema.STATES not in out:  # without commands: the audit says so, of CSV and NPZ files too
            self._note("missing_topic", "not in the recording", "warning", schema.STATES, 0)
        return out

    def _of_controllers(self, out: dict[str, tuple[str, str]]) -> None:
        """Adds what ros2_control's controllers say of themselves or are sent, where commands or states are not found
        yet; a part of a controller's state for those that are."""
        named = [t for t in self.streams if (s := self.streams[t][0].schema) and s.name.endswith(CONTROLLER)]
        for ours, part in PARTS.items():
            if ours in out:
                theirs, own = out[ours]
                out[ours] = (theirs, own or part) if theirs in named else (theirs, own)
                continue
            if any(f.topic == ours and f.kind == "topic" for f in self.findings):
                continue  # several are of its name
            fits, what = [(t, part) for t in named], f"a controller's {part.split('|')[0]}"
            for kind in SENT if ours == schema.COMMANDS and not fits else ():
                taken = {theirs for theirs, _ in out.values()}
                of_kind = [t for t in self.streams if t not in taken and self._is_a(t, SENT[kind], strict=True)]
                if fits := [(t, "") for t in of_kind if kind == "a trajectory" or t.endswith("/commands")]:
                    what = kind
                    break
            self._choose(out, ours, fits, f"{what}; ")

    def _choose(
        self, out: dict[str, tuple[str, str]], ours: str, fits: Sequence[tuple[str, str]], what: str = ""
    ) -> None:
        """Take the only (topic, part) that fits one of ours; of several none, and say so."""
        if len(fits) == 1:
            out[ours] = fits[0]
            text = f"read from {fits[0][0]} ({what}say otherwise with remap.{ours}=TOPIC)"
            self._note("topic", text, "info", ours)
        elif fits:
            text = f"could be any of {', '.join(t for t, _ in fits)}; none is used (say which with remap.{ours}=TOPIC)"
            self._note("topic", text, "warning", ours, len(fits))

    def _is_a(self, topic: str, kind: str, strict: bool = False) -> bool:
        s = self.streams[topic][0]
        name = s.schema.name if s.schema is not None else ""
        return name.replace("/msg/", "/").endswith(kind.replace("/msg/", "/")) or (
            not strict and s.channel.message_encoding != "cdr"
        )

    def _describe_topics(self) -> str:
        name = lambda s: s.schema.name if s.schema else "?"  # noqa: E731
        rows = (f"{t} ({name(s)}, {s.channel.message_encoding})" for t, (s, *_) in sorted(self.streams.items()))
        return ", ".join(rows) or "none"

    def _decode(
        self, ours: str, make: Callable[[Channel, McapSchema | None, str], Reader[Any]]
    ) -> tuple[np.ndarray, Sequence[Any]]:
        """Return host times [T] s and decoded messages of one of our topics, in order of time."""
        if ours not in self.sources:
            return np.zeros(0), []
        theirs, part = self.sources[ours]
        times: list[float] = []
        out: Sequence[Any] = []
        parts: list[Sequence[Any]] = []
        bad, why, when, written = 0, "", NAN, []
        for stream in self.streams[theirs]:
            try:
                reader = make(stream.channel, stream.schema, part)
            except decode.Unreadable as error:
                if ours in (schema.COMMANDS, schema.STATES):
                    raise UserError(f"recording {self.path}: topic {theirs} cannot be read: {error}") from None
                self._note("unreadable", f"{theirs}: {error}", "error", ours, len(stream.messages))
                continue
            first = len(times)
            rows = reader.together([m.data for m in stream.messages])
            if rows is not None:
                times += [(m.log_time - self.start_ns) * 1e-9 for m in stream.messages]
                parts.append(rows)
                written.append(slice(first, len(times)))
                continue
            values: list[Any] = []
            for m in stream.messages:
                t = (m.log_time - self.start_ns) * 1e-9
                try:
                    value = reader(m.data)
                except Exception as error:  # a damaged message may fail anywhere in a decoder
                    when, bad = min(when, t) if bad else t, bad + 1
                    why = why or " ".join(str(error).split())[:200] or type(error).__name__
                    continue
                times.append(t)
                values.append(value)
            parts.append(values)
            written.append(slice(first, len(times)))
        parts = [p for p in parts if len(p)]
        out = parts[0] if len(parts) == 1 else [x for p in parts for x in p]
        if bad:
            text = f"{bad} messages cannot be decoded: {why}"
            self.findings.append(Finding("unreadable", ours, when, bad, text, "error"))
            if not out and ours == schema.STATES:
                raise UserError(f"recording {self.path}: none of the {bad} messages of {theirs} can be decoded: {why}")
        return self._in_order(ours, np.array(times), out, written)

    def _in_order(
        self, ours: str, t: np.ndarray, out: Sequence[Any], written: Sequence[slice] | None = None
    ) -> tuple[np.ndarray, Sequence[Any]]:
        """Samples in order of time, without those whose time cannot be theirs; `written`: which were written one after
        another."""
        keep = np.zeros(len(t), bool)
        for part in written if written is not None else [slice(0, len(t))]:
            keep[part] = timeline.possible(t[part])
            self.breaks += timeline.gaps(t[part], keep[part])
        lost = np.flatnonzero(~keep)
        if len(lost):
            back = np.diff(t[np.isfinite(t)]).min() if np.isfinite(t).sum() > 1 else 0.0
            what = f"goes back by up to {-back:.3g} s" if back < -timeline.REORDERED else "jumps"
            around = t[keep] if keep.any() else np.zeros(1)
            near = np.clip(np.searchsorted(np.flatnonzero(keep), lost[[0, -1]]), 0, len(around) - 1)
            text = f"host time {what}: {len(lost)} of {len(t)} samples, whose time cannot be theirs, are left out"
            there = Series(around, around, ours)
            self.findings.append(there.finding("time_not_monotonic", text, "error", at=near, count=len(lost)))
            t, out = t[keep], _taken(out, np.flatnonzero(keep))
        back = np.flatnonzero(np.diff(t) < 0)
        if len(back):
            if not len(lost) and (written is None or len(written) == 1):
                text = (f"host time goes backwards {len(back)} times, by up to {-np.diff(t).min() * 1e3:.3g} ms;"
                        " samples are returned in order of time")  # fmt: skip
                self.findings.append(Series(t, t, ours).finding("time_not_monotonic", text, "error", at=back + 1))
            order = np.argsort(t, kind="stable")
            t, out = t[order], _taken(out, order)
        return t, out

    # -- values -------------------------------------------------------------------
    def build(self, stated: dict[str, str], joints: Sequence[str] | None, units: Units) -> Recording:
        """Return the recording, with metadata complete, in SI."""
        t_command, commands, lines = self._points(*self._decode(schema.COMMANDS, decode.joint_reader))
        t_state, states = self._decode(schema.STATES, decode.joint_reader)
        given = set(stated)
        theirs = self._their_joints(stated, commands, states, joints)
        if len(theirs) > MAX_JOINTS:
            raise UserError(f"recording {self.path}: names {len(theirs)} joints; at most {MAX_JOINTS} are read")
        mapping = self._match(theirs, joints)
        ours = tuple(dict.fromkeys(mapping[n] for n in theirs if n in mapping))
        order = joints if joints is not None else self.hand.joints if set(ours) <= set(self.hand.joints) else ours
        there = set(ours)
        ours = tuple(j for j in order if j in there)
        # where each of their unnamed columns goes
        place_of = {j: k for k, j in enumerate(ours)}
        column = np.array([place_of[mapping[n]] if n in mapping else -1 for n in theirs])
        has_effort = any(len(s.effort) for s in _unlike(states))
        has_tactile = schema.TACTILE in self.sources or schema.TACTILE in self.arrays
        self.findings += metadata.complete(stated, has_effort, has_tactile)
        if "joint_names" not in stated:
            text = f"joint_names is not stated; the messages' own is used: {', '.join(theirs)}"
            self._note("missing_metadata", text, "info")
        sign = schema.per_joint_sign(stated["effort_sign"], tuple(theirs), str(self.path))
        source = {int(c): i for i, c in reversed(list(enumerate(column)))}
        stated["effort_sign"] = ",".join(f"{int(sign[source[k]]):+d}" for k in range(len(ours)))
        listed = len(schema.joint_names(stated.get("joint_names", "")))
        stated["joint_names"] = ",".join(ours)

        self._unnamed(theirs, commands, states, "joint_names" in given)
        place = _Placer(theirs, column, len(ours), listed)
        command = self._joint_series(schema.COMMANDS, t_command, commands, "position", place)
        if command is not None:
            command.lines = lines
        out = Recording(
            path=self.path,
            meta=stated,
            joints=ours,
            commands=command if command is not None else Series.empty(schema.COMMANDS, len(ours)),
            states=States(
                self._joint_series(schema.STATES, t_state, states, "position", place)
                or Series.empty(schema.STATES, len(ours)),
                self._joint_series(schema.STATES, t_state, states, "velocity", place),
                self._joint_series(schema.STATES, t_state, states, "effort", place),
            ),
            start_ns=self.start_ns,
            config=self.config,
            hand=self.hand if ours and set(ours) <= set(self.hand.joints) else None,
        )
        for name in ("temperature", "duty", "enabled"):
            setattr(out, name, self._joint_array(schema.ARRAYS[name][0], place))
        self._convert(out, units, {ours[c]: theirs[i] for i, c in enumerate(column) if c >= 0})
        out.supply_voltage = self._array(schema.SUPPLY, lambda dims, v: v[0] if len(v) == 1 else None)
        out.tactile = self._array(schema.TACTILE, self._tactile_shape)
        out.external_force, out.object_pose, out.imu = (self._vectors(topic) for topic in _VECTORS)
        try:
            attached.config(self.config, schema.ATTACHMENT)
        except UserError as error:
            out.config = None
            self._note("damage", f"{error}; it is not used", "error")
        out.findings = self.findings
        out.breaks = sorted(self.breaks)
        return out

    def _tactile_shape(self, dims: tuple[int, ...], values: np.ndarray) -> np.ndarray | None:
        """Return [fingers, taxels, 3]: as the message says, else the hand's."""
        if len(dims) == 3 and int(np.prod(dims)) == len(values):
            return values.reshape(dims)
        fingers = len(self.hand.fingers)
        return values.reshape(fingers, -1, 3) if len(values) % (3 * fingers) == 0 else None

    def _their_joints(
        self, stated: dict[str, str], commands: Sequence, states: Sequence, joints: Sequence[str] | None
    ) -> list[str]:
        """Return the recording's own joint names: `joint_names` first, then as they appear in messages."""
        listed = list(schema.joint_names(stated.get("joint_names", "")))
        seen: dict[str, None] = dict.fromkeys(listed)
        unnamed = 0
        for group in (states, commands):
            last = None
            for s in _unlike(group):
                if s.names != last:
                    last = s.names
                    seen.update(dict.fromkeys(s.names))
                unnamed = max(unnamed, len(s.position) if not s.names else 0)
        if seen:
            if unnamed > len(listed or seen):
                raise UserError(
                    f"recording {self.path}: {unnamed} values a message without names, but joint_names lists "
                    f"{len(listed or seen)}; state them all with meta.joint_names=a,b,..."
                )
            return list(seen)
        known = self.hand.joints if joints is None else joints
        names_ = list(known) if unnamed == len(known) else [f"joint{i}" for i in range(unnamed)]
        self._note("missing_metadata", "neither the messages nor joint_names name the joints; assumed:"
                                       f" {', '.join(names_)} (state meta.joint_names=...)", "warning")  # fmt: skip
        return names_

    def _match(self, theirs: list[str], joints: Sequence[str] | None) -> dict[str, str]:
        where = str(self.path)
        if joints is not None:
            mapping = names.match(theirs, joints, self.joint_remap, where)
            if not mapping:
                raise UserError(
                    f"recording {where}: none of its joints ({', '.join(theirs)}) is one of the model's"
                    f" ({', '.join(joints)});"
                    f" say which is which with remap.OURS=THEIRS, such as remap.{joints[0]}={theirs[0]}"
                )
        elif self.joint_remap and not set(self.joint_remap) <= set(self.hand.joints):
            mapping = {their: their for their in theirs}
            for our, their in self.joint_remap.items():
                names.match(theirs, [our], {our: their}, where)
                mapping[their] = our
        else:
            mapping = names.match(theirs, self.hand.joints, self.joint_remap, where, shorter=False)
            if len(mapping) < len(theirs) and 3 * len(mapping) < 2 * len(self.hand.joints):  # not that hand
                mapping = {their: their for their in theirs}
        renamed = [f"{a} is {b}" for a, b in mapping.items() if a != b]
        foreign = [n for n in theirs if n not in mapping]
        if renamed:
            self._note("joint_names", "; ".join(renamed), "info", count=len(renamed))
        if foreign:
            text = f"not joints of the model, left out: {', '.join(foreign)}"
            self._note("joint_names", text, "info", count=len(foreign))
        return mapping

    def _convert(self, r: Recording, units: Units, theirs: Mapping[str, str]) -> None:
        """Return the values of each joint in SI: by the unit that is stated, else by a guess, with a warning. theirs:
        their name of each joint."""
        s, said = r.states, dict[tuple[str, str, bool], dict[str, dict[str, None]]]()
        parts = {"command": r.commands, "position": s.position, "velocity": s.velocity, "effort": s.effort,
                 "temperature": r.temperature, "duty": r.duty}  # fmt: skip

        def stated(quantity: str, joint: str) -> Unit | None:
            return units.of(quantity, joint) or units.of(quantity, theirs[joint])

        def free(quantity: str, joint: str) -> bool:
            return (quantity, theirs[joint]) not in self.si and stated(quantity, joint) is None

        both = {
            j: (r.commands.value[:, k], s.position.value[:, k])
            for k, j in enumerate(r.joints)
            if not self.stated and free("command", j) and free("position", j)
        }
        own = {j: self.ranges[n] for j, n in theirs.items() if n in self.ranges and free("position", j)}
        guessed = units.guess(both, own)
        r.guessed = {j: guessed[j].text if j in guessed else "rad" for j in both}
        for k, joint in enumerate(r.joints):
            for quantity, series in parts.items():
                if series is None or not len(series) or (quantity, theirs[joint]) in self.si:
                    continue
                unit = stated(quantity, joint)
                if unit is None and quantity in ("command", "position", "velocity"):
                    unit = guessed.get(joint)
                elif unit is None and quantity == "effort" and self.milliamperes(r, series.value[:, k]):
                    unit = Unit(1e-3, 0.0, "mA", why=f"as no joint takes {MOST_CURRENT:g} A")
                if unit is None:
                    continue
                series.value[:, k] = unit(series.value[:, k], quantity == "velocity")
                if unit.why or unit.text.lower() not in ("rad", "m", "a", "nm", "n.m", "n", "rad/s"):
                    said.setdefault((unit.text, unit.why, unit.fraction), {}).setdefault(quantity, {})[joint] = None
        for (text, why, fraction), quantities in said.items():
            joints = dict.fromkeys(j for x in quantities.values() for j in x)
            what = " and ".join(quantities) + ("" if len(joints) == len(r.joints) else f" of {', '.join(joints)}")
            setting = f"units.{'effort' if 'effort' in quantities else 'position'}={text}"
            if fraction:
                r.meta["position_unit"] = "fraction"
                then = "whose range is not known here: values are a fraction of the travel, 0 to 1, not rad. Give "
                then += f"model=, or {setting}=LOW..HIGH [rad]"
            else:
                then = f"and converted: say {setting}, or what it is"
            line = f"{what} in {text}: converted to SI"
            if why:
                line = f"{what}: no unit is stated; taken for {text} {why}, {then}"
            self._note("unit", line, "warning" if why else "info", count=len(joints))

    def milliamperes(self, r: Recording, effort: np.ndarray) -> bool:
        """Return whether a current of no stated unit [S] can only be in mA; never of messages, whose effort is in
        SI."""
        return False

    def _joint_series(
        self, topic: str, t: np.ndarray, samples: Sequence, name: str, place: _Placer
    ) -> Series | None:
        if not len(samples) or (name != "position" and not any(len(getattr(s, name)) for s in _unlike(samples))):
            return None
        value = np.full((len(t), place.count), np.nan)
        carried = np.zeros(value.shape, bool)
        bad = _placed(value, carried, samples, name, place)
        if bad:
            text = (f"{name}: as many values as names are expected (of messages without names, as joints are known: "
                    "meta.joint_names=a,b,... states whose they are); samples left out")  # fmt: skip
            self.findings.append(Series(t, value, topic).finding("malformed", text, "error", at=bad))
        stamp = self._stamps(samples)
        partly = not carried[:, carried.any(0)].all()
        return Series(t, value, topic, None if np.isnan(stamp).all() else stamp,
                      carried=carried if partly else None)  # fmt: skip

    def _points(self, t: np.ndarray, samples: Sequence[Any]) -> tuple[np.ndarray, Sequence[Any], bool]:
        """(times [T] s, targets, whether they are joined by lines): each point of a trajectory is a target of its own
        time, until another trajectory begins. t [N], samples: as messages have them."""
        if isinstance(samples, JointRows) or not any(isinstance(s, Trajectory) for s in samples):
            return t, samples, False
        none, out, late, most = np.zeros(0), [], 0, 0
        for receipt, s in zip(t.tolist(), samples, strict=True):
            if not isinstance(s, Trajectory):
                out.append((receipt, s))
                continue
            if not s.points:
                continue
            stamp = NAN if s.stamp is None else (s.stamp - self.start_ns) * 1e-9
            begin = stamp if -STARTED < stamp - receipt < PLANNED else receipt
            late, most = late + any(p[0] > 0 for p in s.points), max(most, len(s.points))
            first = begin + s.points[0][0]
            while out and out[-1][0] > first:  # what the new one replaces
                out.pop()
            if out and out[-1][0] < begin - LINE and first > begin:  # it held its last target until then
                out.append((begin, out[-1][1]))
            before: tuple[float, Any, Any] | None = None
            for after, q, v in s.points:
                if before is not None and after - before[0] > LINE:
                    for u in np.arange(1, np.ceil((after - before[0]) / LINE)) / np.ceil((after - before[0]) / LINE):
                        at = before[0] + u * (after - before[0])
                        out.append((begin + at, JointSample(s.names, _between(before, (after, q, v), at), none, none,
                                                            None)))  # fmt: skip
                out.append((begin + after, JointSample(s.names, q, none, none, None)))
                before = (after, q, v)
        text = f"trajectories of up to {most} points: each is a target at its message's header.stamp (or receipt)" + (
            " + time_from_start" if late else "") + ", joined by lines"  # fmt: skip
        self._note("trajectory", text, "info", schema.COMMANDS, len(samples))
        out.sort(key=lambda x: x[0])
        return np.array([x for x, _ in out]), [s for _, s in out], True

    def _unnamed(self, theirs: list[str], commands: Sequence, states: Sequence, stated: bool) -> None:
        """Says in which order values without names are taken, where nothing states it."""
        for topic, group in ((schema.COMMANDS, commands), (schema.STATES, states)):
            if len(theirs) > 1 and not stated and any(not len(s.names) for s in _unlike(group)):
                order = f"taken in the order {', '.join(theirs)}; state theirs with meta.joint_names=a,b,..."
                text = f"{len(group)} messages carry no joint names: {order}"
                self._note("joint_names", text, "warning", topic, len(group))

    def _stamps(self, samples: Sequence[JointSample]) -> np.ndarray:
        """Return [T] `header.stamp` in s from the recording's start, NaN where there is none."""
        if isinstance(samples, JointRows) and 0 <= self.start_ns < MAX_START:
            return np.where(samples.stamp == 0, np.nan, (samples.stamp - self.start_ns) * 1e-9)
        return np.array([np.nan if s.stamp is None else (s.stamp - self.start_ns) * 1e-9 for s in samples])

    def _joint_array(self, topic: str, place: _Placer) -> Series | None:
        def fit(dims: tuple[int, ...], values: np.ndarray) -> np.ndarray | None:
            to = place([], len(values))
            if to is None:
                return None
            row = np.full(place.count, np.nan)
            row[to[1]] = values[to[0]]
            return row

        return self._array(topic, fit)

    def _array(self, topic: str, fit: Callable[[tuple[int, ...], np.ndarray], Any]) -> Series | None:
        t, messages = self._decode(topic, decode.array_reader)
        rows, keep, shape = [], [], None
        for i, (dims, values) in enumerate(messages):
            row = fit(dims, values) if len(values) else None
            if row is not None and (shape is None or np.shape(row) == shape):
                shape = np.shape(row)
                rows.append(row)
                keep.append(i)
        if len(keep) < len(messages):
            first = next((k for k, i in enumerate(keep) if k != i), len(keep))
            text = f"values of an unexpected number ({len(messages[first][1])}); samples left out"
            self.findings.append(Finding("malformed", topic, float(t[first]), len(messages) - len(keep), text, "error"))
        return Series(t[keep], np.array(rows, dtype=float), topic) if rows else None

    def _vectors(self, topic: str) -> Series | None:
        kind, size = _VECTORS[topic]
        t, messages = self._decode(topic, lambda c, s, part: decode.vector_reader(c, s, part, kind))
        if not messages:
            return None
        stamp = np.array([np.nan if s is None else (s - self.start_ns) * 1e-9 for _, s, _ in messages])
        return Series(
            t, np.array([v for v, _, _ in messages]).reshape(len(t), size), topic,
            None if np.isnan(stamp).all() else stamp, messages[0][2],
        )  # fmt: skip


class _TableReading(_Reading):
    """A file with named columns being turned into a Recording: its columns stand for the messages of a topic."""

    def __init__(self, path: Path, table: columns.Table, remap: dict[str, str], hand: Hand | None = None):
        self.path, self.table, self.findings, self.breaks = path, table, list(table.findings), []
        self.hand = hand or load_hand()
        topics = [k for k in remap if _is_topic(k)]
        if topics:
            raise UserError(
                f"recording {path}: has columns, no topics (remap.{topics[0]}); say remap.QUANTITY.JOINT=COLUMN, "
                f"quantities: {', '.join(columns.QUANTITIES)}"
            )
        self.joint_remap = {k: v for k, v in remap.items() if k.split(".")[0] not in columns.QUANTITIES}
        self.start_ns, self.config, self.sources, self.si = table.start_ns, None, {}, table.si
        self.stated = False
        self.ranges = table.ranges
        self.arrays = table.arrays

    def milliamperes(self, r: Recording, effort: np.ndarray) -> bool:
        size = np.abs(effort[np.isfinite(effort)])
        return r.effort_is == "current_A" and len(size) > 5 and float(np.quantile(size, 0.9)) > MOST_CURRENT

    def _decode(self, ours: str, make: Any) -> tuple[np.ndarray, Sequence[Any]]:
        table, empty = self.table, np.zeros(0)
        if ours in table.arrays:
            x = table.arrays[ours]
            t = table.time.get("position", table.time.get("command", empty))[: len(x)]
            return self._in_order(ours, t, [(v.shape, v.ravel()) for v in x[: len(t)]])
        if ours == schema.STATES:
            have = [q for q in ("position", "velocity", "effort") if q in table.value]
            if "position" not in have:
                return empty, []
            t, rows = table.samples("position")
            rest, absent = {}, np.zeros((len(rows), 0))
            for q in have[1:]:
                own, value = table.samples(q)
                same = len(own) == len(t) and np.array_equal(own, t)
                rest[q] = value if same else np.stack([at(t, own, x) for x in value.T], 1)
            out: Sequence[Any] = JointRows(
                table.joints, rows, rest.get("velocity", absent), rest.get("effort", absent),
                np.zeros(len(t), np.int64), table.carried("position"),
            )  # fmt: skip
        elif ours == schema.COMMANDS:
            if "command" not in table.value:
                return empty, []
            t, rows = table.samples("command")
            absent = np.zeros((len(rows), 0))
            out = JointRows(table.joints, rows, absent, absent, np.zeros(len(t), np.int64), table.carried("command"))
        else:
            quantity = next((name for name, (topic, _) in schema.ARRAYS.items() if topic == ours), "")
            if quantity not in table.value:
                return empty, []
            if quantity == "supply_voltage":
                t, value = table.time[quantity], table.value[quantity][""]
                rows = value[:, None]
            else:
                t, rows = table.samples(quantity)
            out = [((len(x),), x) for x in rows]
        return self._in_order(ours, t, out)

    def _their_joints(
        self, stated: dict[str, str], commands: Sequence, states: Sequence, joints: Sequence[str] | None
    ) -> list[str]:
        return list(self.table.joints)

    def _match(self, theirs: list[str], joints: Sequence[str] | None) -> dict[str, str]:
        if self.table.unnamed and joints is not None and len(joints) == 1 and not self.joint_remap:
            text = f"the columns name no joint: they are taken for the model's one, {joints[0]}"
            self._note("joint_names", text, "info")
            return {theirs[0]: joints[0]}
        return super()._match(theirs, joints)


def _between(a: tuple[float, Any, Any], b: tuple[float, Any, Any], t: float) -> np.ndarray:
    """Return position [n] at t between points (s, position [n], velocity [n] or empty): a cubic by both speeds, else a
    line."""
    size = b[0] - a[0]
    u = (t - a[0]) / size
    if len(a[2]) != len(a[1]) or len(b[2]) != len(b[1]):
        return np.asarray(a[1] + u * (b[1] - a[1]))
    slope = (u**3 - 2 * u**2 + u) * size * a[2] + (u**3 - u**2) * size * b[2]
    return np.asarray((2 * u**3 - 3 * u**2 + 1) * a[1] + (3 * u**2 - 2 * u**3) * b[1] + slope)


def _taken(samples: Sequence[Any], which: np.ndarray) -> Sequence[Any]:
    return samples.take(which) if isinstance(samples, JointRows) else [samples[i] for i in which]


def _unlike(samples: Sequence[JointSample]) -> Sequence[JointSample]:
    """Return those of the samples whose names or numbers of values differ: of rows, the first tells of all."""
    return samples[:1] if isinstance(samples, JointRows) else samples


def _placed(
    value: np.ndarray, carried: np.ndarray, samples: Sequence[JointSample], name: str, place: _Placer
) -> list[int]:
    """Fills value [T, J] with a quantity of T samples, and carried with what each of them tells of; returns those whose
    names and values do not fit."""
    if isinstance(samples, JointRows):
        rows = getattr(samples, name)
        to = place(samples.names, rows.shape[1]) if rows.shape[1] else (np.zeros(0, int),) * 2
        if to is None:
            return list(range(len(samples)))
        for source, column in zip(*to, strict=True):  # in order: of a name that comes twice, the last counts
            value[:, column] = rows[:, source]
            carried[:, column] = True if samples.carried is None else samples.carried[:, source]
        return []
    bad = []
    for i, s in enumerate(samples):
        values = getattr(s, name)
        if not len(values):
            continue
        to = place(s.names, len(values))
        if to is None:
            bad.append(i)
        else:
            keep, columns = to
            value[i, columns] = values[keep]
            carried[i, columns] = True
    return bad


class _Placer:
    """Where the values of a message go: by its names, or where it has none by the recording's order: of all joints, or
    of the first `stated`, which `joint_names` lists."""

    def __init__(self, theirs: Sequence[str], column: np.ndarray, count: int, stated: int):
        self.theirs, self.column, self.count, self.stated = list(theirs), column, count, stated
        self._at = {name: i for i, name in reversed(list(enumerate(self.theirs)))}
        self._known: dict[tuple[str, ...], tuple[np.ndarray, np.ndarray]] = {}

    def __call__(self, names_: Sequence[str], size: int) -> tuple[np.ndarray, np.ndarray] | None:
        """Return (which values to take, their columns), or None where names and values do not fit."""
        key = tuple(names_) or tuple(self.theirs[: self.stated] if size == self.stated else self.theirs)
        if key not in self._known:
            columns = self.column[np.array([self._at[n] for n in key], int)]
            keep = np.flatnonzero(columns >= 0)
            self._known[key] = keep, columns[keep]
        return self._known[key] if size == len(key) else None


def _is_topic(name: str) -> bool:
    return name.startswith("/") or "/" + name in schema.TOPICS


def _slash(name: str) -> str:
    return name if name.startswith("/") else "/" + name


def _at(ns: int | None) -> str:
    return "" if ns is None else f" (from host time {ns} ns)"
