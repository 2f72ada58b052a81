"""Nominal values of a mechanism's drives: the `servo.yaml` format, read, checked, resolved per joint, written back.

    drive: torque                  # or voltage
    joints:
      "*": {kp: 1.5, kd: 0.03}     # every joint; a joint's own entry wins, column by column
      index_bend_joint: {kp: 0.8, delay: [0.0, 0.02], kd: {value: 0.02, low: 0.01, high: 0.03}, lag: unknown}
    current_per_torque: 0.9        # A per N.m; this and the encoder keys may also be mappings by joint name
    control_rate: 100              # Hz at which targets reach the servo; absent: they act when stamped
    loop_rate: 1000                # Hz of the servo's own loop (carried along: the simulated loop is continuous)
    loop_encoder: joint            # joint or motor
    position_encoder: joint        # joint or motor
    supply_voltage: 24.0           # V
    loop: position                 # or velocity: kd acts on the error of the speed (kp 0 where it is not stated)
    fitted: {index_bend_joint: {}} # joints that `diagnose` fitted: see below

A value is a number, a range [low, high], a number with its range, or `unknown`; an absent column is ideal (neutral).
`fitted`: what the file says of such a joint goes before what a recording says of its own drive; of columns in which the
recordings differed, the factor on what each says. A replay holds the other joints at their recorded motion.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

import msgspec
import numpy as np
import yaml

from dexsim import files, typed, yaml_text
from dexsim.actuator.columns import COLUMNS, INDEX, NAMES, Column, did_you_mean
from dexsim.errors import UserError

Drive = Literal["torque", "voltage"]
Side = Literal["joint", "motor"]
Loop = Literal["position", "velocity"]
SIDES = get_args(Side)
KEYS = (
    "drive", "joints", "current_per_torque", "control_rate", "loop_rate", "loop_encoder", "position_encoder",
    "supply_voltage", "fitted", "loop",
)  # fmt: skip
ALL = "*"


class Content(msgspec.Struct):
    """`servo.yaml` around its columns, whose values `parse_value` reads. A per N.m, Hz, V."""

    drive: Drive = "torque"
    joints: dict[str, dict[str, Any] | None] | None = None
    current_per_torque: (
        typed.Positive | Literal["unknown"] | dict[str, typed.Positive | Literal["unknown"] | None] | None
    ) = None
    control_rate: typed.Positive | None = None
    loop_rate: typed.Positive | None = None
    loop_encoder: Side | dict[str, Side] | None = None
    position_encoder: Side | dict[str, Side] | None = None
    supply_voltage: typed.Positive | None = None
    fitted: dict[str, dict[str, float]] | None = None
    loop: Loop | None = None


@dataclass(frozen=True)
class Value:
    """One entry: `value` (None where unknown) in the range it is believed in (a bare number: low == value == high)."""

    value: float | None
    low: float
    high: float

    @property
    def unknown(self) -> bool:
        return self.value is None


def parse_value(raw: Any, column: Column, where: str) -> Value:
    """Return a `servo.yaml` value as a Value inside the column's allowed range; UserError starting with `where`."""
    if isinstance(raw, str) and raw == "unknown":
        return Value(None, column.low, column.high)
    low, value, high = typed.interval(where, raw, column.unit, column.low, column.high, " or 'unknown'")
    if math.isinf(value) and math.isfinite(low):
        raise UserError(f"{where}={raw}: has no middle; give {{value: .., low: .., high: ..}}")
    return Value(value, low, high)


@dataclass
class ServoTable:
    """The drives of a mechanism as `servo.yaml` states them; `entries[joint or "*"][column]` is what it says."""

    drive: str = "torque"
    entries: dict[str, dict[str, Value]] = field(default_factory=dict)
    current_per_torque: float | str | dict | None = None  # A per N.m, "unknown", or by joint name
    control_rate: float | None = None  # Hz
    loop_rate: float | None = None  # Hz
    loop_encoder: str | dict = "joint"
    position_encoder: str | dict = "joint"
    supply_voltage: float | None = None  # V
    fitted: dict[str, dict[str, float]] | None = None  # joints that were fitted to recordings; None: nothing was
    loop: str | None = None
    source: str = "servo"  # named in errors

    # -- reading and writing ------------------------------------------------------------

    @classmethod
    def load(cls, path: str | Path) -> ServoTable:
        """Return the table in a YAML file; UserError if it is missing, not YAML, or states something impossible."""
        path = Path(path)
        if not path.exists():
            raise UserError(f"servo file '{path}' does not exist; servo_file=PATH must name a servo.yaml.")
        return cls.from_dict(yaml_text.load(path, "servo file"), source=str(path))

    @classmethod
    def from_dict(cls, raw: Any, source: str = "servo") -> ServoTable:
        """Return the table in a plain mapping of the file's content (of a resolved Hydra config, say)."""
        if not isinstance(raw, dict):
            raise UserError(f"{source}: expected a mapping with the keys {', '.join(KEYS)}; got {type(raw).__name__}.")
        for key in raw:
            if key not in KEYS:
                hint = did_you_mean(key, KEYS)
                raise UserError(f"{source}: key '{key}' does not exist.{hint} Valid keys: {', '.join(KEYS)}")
        top = typed.convert(
            {k: v if k in ("drive", "joints", "fitted") else _numbers(v) for k, v in raw.items()}, Content, source
        )
        joints = top.joints or {}
        entries: dict[str, dict[str, Value]] = {}
        for joint, columns in joints.items():
            if columns is None:
                columns = {}
            entries[str(joint)] = {}
            for name, value in columns.items():
                where = f"{source}: joints.{joint}.{name}"
                if name not in INDEX:
                    hint = did_you_mean(name, NAMES)
                    raise UserError(
                        f"{where}: no such servo column (of a law of your own: install its package).{hint} Valid"
                        f" columns: {', '.join(NAMES)}"
                    )
                entries[str(joint)][name] = parse_value(value, COLUMNS[INDEX[name]], where)
            if top.loop == "velocity" and "kd" in columns:
                entries[str(joint)].setdefault("speed_feedforward", entries[str(joint)]["kd"])
        return cls(
            top.drive, entries, top.current_per_torque, top.control_rate, top.loop_rate, top.loop_encoder or "joint",
            top.position_encoder or "joint", top.supply_voltage, top.fitted, top.loop, source,
        )  # fmt: skip

    def to_dict(self) -> dict:
        """Return the file's content again: `from_dict(table.to_dict())` is the same table."""
        out: dict[str, Any] = {"drive": self.drive, "joints": {}}
        for joint, columns in self.entries.items():
            out["joints"][joint] = {name: _plain(value) for name, value in columns.items()}
        for key in KEYS[2:]:
            value = getattr(self, key)
            if value is not None:
                out[key] = copy.deepcopy(value)
        return out

    def save(self, path: str | Path) -> None:
        """Writes the table as a `servo.yaml`, replacing the file only once the new one is complete."""
        files.write(Path(path), yaml.safe_dump(self.to_dict(), sort_keys=False, width=120), "servo file")

    # -- what holds for a joint ------------------------------------------------------------

    def check_joints(self, known: Iterable[str]) -> None:
        """Raise UserError if the table names a joint that is not among `known`."""
        known = list(known)
        for given in (self.entries, self.current_per_torque, self.loop_encoder, self.position_encoder, self.fitted):
            for joint in given if isinstance(given, dict) else ():
                if joint != ALL and joint not in known:
                    hint = did_you_mean(joint, known)
                    raise UserError(
                        f"{self.source}: joint '{joint}' does not exist.{hint} Valid joints: {', '.join(known)}"
                    )

    def value(self, joint: str, column: str) -> Value:
        """Return what the table says of one joint and column; the neutral value where it says nothing."""
        for key in (joint, ALL):
            if column in self.entries.get(key, {}):
                return self.entries[key][column]
        neutral = COLUMNS[INDEX[column]].neutral
        return Value(neutral, neutral, neutral)

    def set(
        self, joint: str, column: str, value: float | None, low: float | None = None, high: float | None = None
    ) -> None:
        """States one joint's column (a fit, say); checked like a file's entry. value None: unknown."""
        if column not in INDEX:
            hint = did_you_mean(column, NAMES)
            raise UserError(f"{self.source}: no such servo column '{column}'.{hint} Valid: {', '.join(NAMES)}")
        raw: Any = "unknown"
        if value is not None:
            raw = {"value": value, "low": value if low is None else low, "high": value if high is None else high}
        parsed = parse_value(raw, COLUMNS[INDEX[column]], f"{self.source}: joints.{joint}.{column}")
        self.entries.setdefault(joint, {})[column] = parsed

    def nominal(self, joints: Sequence[str]) -> np.ndarray:
        """Return [J, C] float64: values in the order of `COLUMNS`; unknown ones neutral, except kp, which must be
        known."""
        out = np.empty((len(joints), len(COLUMNS)))
        for j, joint in enumerate(joints):
            for c, column in enumerate(COLUMNS):
                value = self.value(joint, column.name)
                if value.unknown and column.name == "kp":
                    raise UserError(
                        f"{self.source}: joints.{joint}.kp is unknown; state a number, or fit it to a recording."
                    )
                out[j, c] = column.neutral if value.unknown else value.value
        if self.drive == "voltage":
            for j, joint in enumerate(joints):
                if math.isinf(out[j, INDEX["torque_limit"]]):
                    raise UserError(
                        f"{self.source}: drive: voltage needs joints.{joint}.torque_limit, the stall torque [N.m]."
                    )
        return out

    def bounds(self, joints: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
        """Return low, high [J, C] float64: the range each value is believed in (the column's whole range where
        unknown)."""
        values = [[self.value(joint, name) for name in NAMES] for joint in joints]
        return np.array([[v.low for v in row] for row in values]), np.array([[v.high for v in row] for row in values])

    def unknown(self, joints: Sequence[str]) -> np.ndarray:
        """Return [J, C] bool: where the file says `unknown`."""
        return np.array([[self.value(joint, name).unknown for name in NAMES] for joint in joints])

    def current(self, joints: Sequence[str]) -> np.ndarray:
        """Return [J] float64: A per N.m of motor torque; nan where unknown or not stated."""
        out = np.full(len(joints), np.nan)
        for j, joint in enumerate(joints):
            value = _lookup(self.current_per_torque, joint)
            if isinstance(value, (int, float)):
                out[j] = value
        return out

    def encoder(self, which: str, joints: Sequence[str]) -> list[str]:
        """Return 'joint' or 'motor' for each joint; which: 'loop' or 'position'."""
        return [_lookup(getattr(self, f"{which}_encoder"), joint) or "joint" for joint in joints]


def _lookup(value: Any, joint: str) -> Any:
    """Return a plain value, or its entry by joint name, or by "*"."""
    if isinstance(value, dict):
        return value.get(joint, value.get(ALL))
    return value


def _plain(value: Value) -> Any:
    if value.unknown:
        return "unknown"
    if value.low == value.high == value.value:
        return value.value
    return {"value": value.value, "low": value.low, "high": value.high}


def _numbers(value: Any) -> Any:
    """Numbers that YAML reads as text (1e-3) as such, by joint where it is a mapping; whatever else there is as it
    is."""
    if isinstance(value, dict):
        return {joint: _numbers(v) for joint, v in value.items()}
    number = typed.real(value)
    return value if math.isnan(number) else number
