"""What a recording holds: topics, message types, metadata, and the classes that the reader returns.

One format for simulated and real hands: MCAP with ROS 2 messages. SI units: rad, rad/s, N.m, A, N (m, m/s, N for slide
joints). Times are host times, seconds since the recording's start.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from dexsim.errors import UserError
from dexsim.hand import Hand
from dexsim.recording import smooth

COMMANDS, STATES = "/joint_commands", "/joint_states"
TEMPERATURES, DUTY, ENABLED = "/joint_temperatures", "/joint_duty", "/joint_enabled"
SUPPLY, TACTILE = "/supply_voltage", "/tactile"
EXTERNAL_FORCE, OBJECT_POSE, IMU = "/external_force", "/object_pose", "/imu"

JOINT_STATE, MULTI_ARRAY = "sensor_msgs/msg/JointState", "std_msgs/msg/Float32MultiArray"
WRENCH, POSE, IMU_TYPE = "geometry_msgs/msg/WrenchStamped", "geometry_msgs/msg/PoseStamped", "sensor_msgs/msg/Imu"
TOPICS: dict[str, str] = {
    COMMANDS: JOINT_STATE, STATES: JOINT_STATE, TEMPERATURES: MULTI_ARRAY, DUTY: MULTI_ARRAY, ENABLED: MULTI_ARRAY,
    SUPPLY: MULTI_ARRAY, TACTILE: MULTI_ARRAY, EXTERNAL_FORCE: WRENCH, OBJECT_POSE: POSE, IMU: IMU_TYPE,
}  # fmt: skip
"""Default topic -> ROS 2 type."""
ARRAYS: dict[str, tuple[str, tuple[str, ...]]] = {
    "temperature": (TEMPERATURES, ("joint",)), "duty": (DUTY, ("joint",)), "enabled": (ENABLED, ("joint",)),
    "supply_voltage": (SUPPLY, ("supply",)), "tactile": (TACTILE, ("finger", "taxel", "axis")),
}  # fmt: skip
"""What of a `Recording` is an array a message: its topic, and a word for each axis."""

METADATA = "dexsim"  # name of the MCAP metadata record
ATTACHMENT = "config.yaml"  # name of the attachment with the resolved config
EFFORT_IS, TACTILE_UNIT = ("current_A", "torque_Nm", "none"), ("N", "count")
KEYS: dict[str, str] = {
    "schema": "version of this format: 1", "source": "real or sim", "robot": "e.g. xhand_right",
    "joint_names": "comma-separated: the order of unnamed arrays", "effort_is": "current_A, torque_Nm or none",
    "effort_sign": "per joint: +1 where positive effort drives to positive position, -1, or 0 where the sign is lost",
    "tactile_unit": "N or count", "tactile_lsb": "newtons a count, or unknown",
    "tactile_axis_sign": "three signs that bring the vendor's taxel axes to ours",
    "tactile_layout": "name of the taxel layout, e.g. xhand_right",
    "gravity": "in the model's world frame, e.g. 0 0 -9.81", "servo": "YAML over servo.yaml for this recording",
    "notes": "free text", "rate": "Hz: of the samples of a file without times",
}  # fmt: skip
"""Metadata keys and what each means; all values are text."""
DEFAULTS: dict[str, str] = {
    "schema": "1", "source": "real", "robot": "unknown", "effort_sign": "+1", "tactile_unit": "count",
    "tactile_lsb": "unknown", "tactile_axis_sign": "+1,+1,+1", "tactile_layout": "xhand_right", "gravity": "0 0 -9.81",
    "servo": "", "notes": "",
}  # fmt: skip
"""What holds where nothing is stated; joint_names and effort_is follow from the messages."""
UNIT_KEYS: dict[str, tuple[str, ...]] = {
    "position_unit": ("rad", "deg", "m", "mm", "fraction"),
    "effort_unit": ("A", "mA", "N.m", "N", "mN.m"),
    "time_unit": ("s", "ms", "us", "ns"),
}
"""Optional keys, the same as `units.QUANTITY` (`recording/units.py`), which knows more."""

ALLOWED: dict[str, tuple[float, float]] = {
    "gravity": (-100.0, 100.0), "tactile_axis_sign": (-1.0, 1.0), "tactile_lsb": (1e-9, 1e3), "rate": (1e-3, 1e6),
}  # fmt: skip
"""What the numbers of a key may be: m/s2, sign, N a count. Gravity may be zero: of a joint that it does not load."""
SEVERITIES = ("info", "warning", "error")


@dataclass(frozen=True)
class Finding:
    """Something the reader or the audit saw. kind: short id, e.g. "gap"; topic: "" for the whole file.

    time: of the first occurrence [s since start], NaN where it has none; end: of the last; count: samples (or keys)
    concerned; severity: "info" (stated for completeness), "warning" (look at it), "error" (a channel cannot be used as
    it is); joint: "" where it is not of one joint.
    """

    kind: str
    topic: str
    time: float
    count: int
    text: str
    severity: str = "warning"
    joint: str = ""
    end: float = float("nan")


def note(kind: str, text: str, severity: str = "warning", topic: str = "", count: int = 1) -> Finding:
    """Return a finding of no time of its own."""
    return Finding(kind, topic, float("nan"), count, text, severity)


COMMANDS_FIX = (
    f"log what each joint is asked for in {COMMANDS} (in a CSV: a column command.JOINT); where it has another name say "
    f"remap.{COMMANDS}=TOPIC (in a CSV: remap.command.JOINT=COLUMN)"
)
"""What to do about a recording without commands."""


@dataclass
class Series:
    """Samples of one quantity. t [T] host time [s since start], never decreasing; value [T, ...] with NaN for absent.

    stamp [T]: `header.stamp` on the same axis as t, NaN where unset (None: the message has no header). carried [T, J]:
    which joints each message tells of (None: all of them). lines: between its samples the value goes along straight
    lines, as between the points of a trajectory.
    """

    t: np.ndarray
    value: np.ndarray
    topic: str = ""
    stamp: np.ndarray | None = None
    frame: str = ""  # header.frame_id of the first message
    carried: np.ndarray | None = None
    lines: bool = False

    def __len__(self) -> int:
        return len(self.t)

    def between(self, start: float, end: float) -> Series:
        """Return the samples with start <= t < end [s]."""
        return self.take((self.t >= start) & (self.t < end))

    def take(self, which: np.ndarray) -> Series:
        """Return these samples: [T] bool, or their numbers."""
        part = lambda x: None if x is None else x[which]  # noqa: E731
        return replace(
            self, t=self.t[which], value=self.value[which], stamp=part(self.stamp), carried=part(self.carried)
        )

    def at(self, t: np.ndarray, held: bool = False) -> np.ndarray:
        """Return the values [n, J] at times t [n] s: see `smooth.at`."""
        return np.stack([smooth.at(t, self.t, x, held) for x in self.value.T], 1)

    def latest(self, t: np.ndarray) -> Series:
        """Return the last sample, whatever it holds, at each of the times t [n] s."""
        last = self.value[np.clip(np.searchsorted(self.t, t, side="right") - 1, 0, None)]
        return Series(t, last, self.topic, t.copy(), self.frame)

    def finding(
        self, kind: str, text: str, severity: str = "warning", joint: str = "", at: Any = None, count: int | None = None
    ) -> Finding:
        """Return a finding about samples `at` (indices, in order; None: all). count: where not each of them is one."""
        first, last = (0, -1) if at is None else (at[0], at[-1])
        count = count if count is not None else len(self if at is None else at)
        return Finding(kind, self.topic, float(self.t[first]), count, text, severity, joint, float(self.t[last]))

    @classmethod
    def empty(cls, topic: str, *shape: int) -> Series:
        """Return no samples of values of this shape."""
        return cls(np.zeros(0), np.zeros((0, *shape)), topic)


@dataclass
class States:
    """/joint_states: position [T, J] rad; velocity [T, J] rad/s and effort [T, J] (`Recording.effort_is`) or None."""

    position: Series
    velocity: Series | None = None
    effort: Series | None = None


@dataclass
class Recording:
    """One recording: what was commanded and measured, and what is known about it. J joints in the order of `joints`.

    commands.value [T, J] target [rad]; states see `States`; temperature [T, J] degC; duty [T, J] -1..1; enabled [T, J]
    1 driven, 0 free (None: always driven); supply_voltage [T] V; tactile [T, fingers, taxels, 3] as sent
    (`tactile_unit`, vendor axes); external_force [T, 6] N and N.m in `external_force.frame`; object_pose [T, 7] x y z,
    w x y z, palm frame; imu [T, 10] orientation w x y z, angular velocity, linear acceleration.
    Effort is as recorded: `effort_sign` is not applied (`signed_effort` does).
    breaks: stretches [s] over which host time cannot be trusted: what came after is of another time.
    meta: every key of `KEYS`, defaults filled in. start_ns: host time of t = 0. findings: of reading and audit. hand:
    the one whose joints these are, where that is known. guessed: by joint whose unit of position is not stated, what it
    was taken for (`Units.guess`).
    """

    path: Path
    meta: dict[str, str]
    joints: tuple[str, ...]
    commands: Series
    states: States
    temperature: Series | None = None
    duty: Series | None = None
    enabled: Series | None = None
    supply_voltage: Series | None = None
    tactile: Series | None = None
    external_force: Series | None = None
    object_pose: Series | None = None
    imu: Series | None = None
    start_ns: int = 0
    findings: list[Finding] = field(default_factory=list)
    config: str | None = None  # the resolved config attached to it, YAML
    breaks: list[tuple[float, float]] = field(default_factory=list)
    hand: Hand | None = None
    guessed: dict[str, str] = field(default_factory=dict)

    def series(self) -> dict[str, Series]:
        """Return what was recorded, by name."""
        s = self.states
        found = {"command": self.commands, "position": s.position, "velocity": s.velocity, "effort": s.effort,
                 "temperature": self.temperature, "duty": self.duty, "enabled": self.enabled,
                 "supply voltage": self.supply_voltage, "tactile": self.tactile, "external force": self.external_force,
                 "object pose": self.object_pose, "imu": self.imu}  # fmt: skip
        return {name: x for name, x in found.items() if x is not None and len(x)}

    @property
    def duration(self) -> float:
        """Time of the last command or state [s]."""
        return max([0.0, *(s.t[-1] for s in (self.commands, self.states.position) if len(s))])

    def targets(self, step: float = 0.005) -> Series:
        """Return the commands as the servos are sent them: the points of trajectories joined, with a sample every
        `step` s."""
        c = self.commands
        if not c.lines or len(c) < 2:
            return c
        counts = np.maximum(np.ceil(np.diff(c.t) / step - 1e-6).astype(int), 1)
        t = np.r_[np.concatenate([np.linspace(a, b, n, endpoint=False) for a, b, n in zip(c.t, c.t[1:], counts,
                                                                                          strict=False)]), c.t[-1]]
        first = c.t[np.isfinite(c.value).argmax(0)]
        return Series(t, np.where(t[:, None] >= first - 1e-9, c.at(t), np.nan), c.topic)

    def parts(self) -> list[Recording]:
        """Return the recording as one for each group of joints that are told of in the same messages, without the
        messages of others; itself where each message tells of all."""
        groups: dict[tuple[bytes, ...], list[int]] = {}
        masks = [s.carried for s in (self.commands, self.states.position)]
        for j in range(len(self.joints)):
            groups.setdefault(tuple(b"" if c is None else c[:, j].tobytes() for c in masks), []).append(j)
        if len(groups) < 2 and all(c is None or c.all() for c in masks):
            return [self]
        return [self._of(columns) for columns in groups.values()]

    def without(self, joints: Collection[str]) -> Recording:
        """Return the recording of all joints but these; itself where it tells of none of them."""
        remaining = [k for k, j in enumerate(self.joints) if j not in joints]
        return self if len(remaining) == len(self.joints) else self._of(remaining)

    def with_followers(self, joints: Sequence[str], angles: np.ndarray) -> Recording:
        """Return the recording with undriven joints: their angles [T, S] rad at the times of the positions."""
        if not joints:
            return self

        def more(series: Any, x: np.ndarray) -> Any:
            return None if series is None else replace(series, value=np.concatenate([series.value, x], 1))

        none = np.full_like(angles, np.nan)
        states, names = self.states, (*self.joints, *joints)
        return replace(
            self, joints=names, meta=self.meta | {"joint_names": ",".join(names)},
            commands=more(self.commands, np.full((len(self.commands), len(joints)), np.nan)),
            states=States(more(states.position, angles), more(states.velocity, none), more(states.effort, none)),
        )  # fmt: skip

    def _of(self, columns: list[int]) -> Recording:
        """Return these joints, and the messages that tell of them."""

        def own(s: Series | None) -> Series | None:
            if s is None or s.value.ndim != 2 or s.value.shape[1] != len(self.joints):
                return s
            s = s if s.carried is None else s.take(s.carried[:, columns[0]])
            return replace(s, value=s.value[:, columns], carried=None)

        s = self.states
        commands, position = own(self.commands), own(s.position)
        assert commands is not None and position is not None
        out = replace(
            self, joints=tuple(self.joints[j] for j in columns), commands=commands,
            states=States(position, own(s.velocity), own(s.effort)),
            meta=self.meta | {"effort_sign": ",".join(f"{int(self.effort_sign[j]):+d}" for j in columns)}, findings=[],
        )  # fmt: skip
        for name in ("temperature", "duty", "enabled"):
            setattr(out, name, own(getattr(self, name)))
        return out

    @property
    def effort_is(self) -> str:
        """ "current_A", "torque_Nm" or "none"."""
        return self.meta["effort_is"]

    @property
    def effort_sign(self) -> np.ndarray:
        """[J]: +1, -1, or 0 where the sign is lost."""
        return per_joint_sign(self.meta["effort_sign"], self.joints, str(self.path))

    @property
    def gravity(self) -> np.ndarray:
        """[3] m/s2 in the model's world frame."""
        return numbers(self.meta["gravity"], 3, "gravity", str(self.path))

    @property
    def tactile_axis_sign(self) -> np.ndarray:
        """[3] signs that bring the taxels' axes to ours."""
        return numbers(self.meta["tactile_axis_sign"], 3, "tactile_axis_sign", str(self.path))

    @property
    def tactile_lsb(self) -> float | None:
        """Newtons a count: 1 where the unit is N, None where unknown."""
        if self.meta["tactile_unit"] == "N":
            return 1.0
        text = self.meta["tactile_lsb"]
        return None if text == "unknown" else float(numbers(text, 1, "tactile_lsb", str(self.path))[0])

    def signed_effort(self) -> Series | None:
        """Return effort, positive along positive joint position; NaN where the sign is lost."""
        effort = self.states.effort
        if effort is None:
            return None
        sign = self.effort_sign
        return replace(effort, value=effort.value * np.where(sign == 0, np.nan, sign))

    def tactile_newtons(self) -> Series | None:
        """Touch in N and our axes, [T, fingers, taxels, 3]. Raises UserError where the scale is unknown."""
        if self.tactile is None:
            return None
        if self.tactile_lsb is None:
            raise UserError(
                f"{self.path}: tactile_unit is count and tactile_lsb is unknown; state meta.tactile_lsb=<N a count>"
            )
        return replace(self.tactile, value=self.tactile.value * (self.tactile_lsb * self.tactile_axis_sign))


def brief(text: str) -> str:
    """Return a value as a message names it: one line, not long."""
    text = " ".join(text.split())
    return text if len(text) <= 80 else text[:77] + "..."


def numbers(text: str, count: int, key: str, where: str) -> np.ndarray:
    """`count` numbers separated by commas or spaces. Raises UserError naming file and key."""
    try:
        values = np.array([float(x) for x in text.replace(",", " ").split()])
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not np.isfinite(values).all():
        raise UserError(
            f"{where}: metadata {key}='{brief(text)}' must be {count} finite number{'s' * (count > 1)};"
            f" correct it with meta.{key}=..."
        )
    low, high = ALLOWED.get(key, (-np.inf, np.inf))
    if ((values < low) | (values > high)).any():
        raise UserError(
            f"{where}: metadata {key}='{brief(text)}' must lie in {low:g} .. {high:g}; correct it with meta.{key}=..."
        )
    return values


def per_joint_sign(text: str, joints: tuple[str, ...], where: str) -> np.ndarray:
    """Return effort_sign [J]: one value for all, or one a joint; each -1, 0 or 1."""
    count = len(text.replace(",", " ").split())
    values = numbers(text, 1 if count == 1 else len(joints), "effort_sign", where)
    if not np.isin(values, (-1, 0, 1)).all():
        raise UserError(
            f"{where}: metadata effort_sign='{brief(text)}' must hold +1, -1 or 0; correct it with meta.effort_sign=..."
        )
    return np.broadcast_to(values, len(joints)).copy()


def joint_names(text: str) -> tuple[str, ...]:
    """Return the comma-separated list of `joint_names`, with or without the brackets of other lists."""
    text = text.strip()
    return tuple((text[1:-1] if text[:1] + text[-1:] == "[]" else text).replace(",", " ").split())
