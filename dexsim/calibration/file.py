"""`calibration.yaml`: what `dexsim calibrate` writes and the deployed policy reads.

    schema: 1
    normalization: matched          # matched: tau/tau_max from tau = alpha I / beta; paper: I / I_max
    current_sign: -1                # sign of the current that drives toward positive joint position (one, or by joint)
    joints:
      index_joint1: {current_per_torque: 2.7, current_max: 1.2, torque_max: 1.1}   # A per N.m, A, N.m
    touch: {lsb: 0.1, axis_sign: [-1, -1, 1], threshold: 0.1}   # N a count, signs to our axes, N
                                    # also gain, bias: {thumb: [120]}, dead: {thumb: [k]}, swapped: {thumb: [[a, b]]}

Other keys (intervals, R2, reasons) are for people and are kept.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from dexsim import yaml_text
from dexsim.assets import xhand
from dexsim.errors import UserError

KEYS = ("schema", "normalization", "current_sign", "joints", "touch", "source", "notes", "robot", "report", "servo")
TOUCH_KEYS = ("lsb", "axis_sign", "threshold", "gain", "bias", "dead", "swapped", "rubber", "hysteresis", "stiffness")
NORMALIZATIONS = ("matched", "paper")
ASSUMED_CURRENT_PER_TORQUE = 2.7
"""A per N.m until measured; see `dexsim.recording.realistic.CURRENT_PER_TORQUE`, where the figure is explained."""
ASSUMED_LSB = 0.1
"""N a count: what users of the hand assume; the vendor publishes no unit."""


@dataclass
class Calibration:
    """By joint in the SDK's order [12]: current_per_torque A per N.m, current_max A, torque_max N.m (what training
    normalised by), current_sign; by taxel: lsb N a count, axis_sign [3], threshold N, gain and bias [5, 120] (counts),
    swapped: pairs of taxels to exchange by finger. assumed: what was not measured, in words. raw: the file's content."""

    current_per_torque: np.ndarray
    current_max: np.ndarray
    torque_max: np.ndarray
    current_sign: np.ndarray
    normalization: str = "matched"
    lsb: float = ASSUMED_LSB
    axis_sign: np.ndarray = field(default_factory=lambda: np.array([-1.0, -1.0, 1.0]))
    threshold: float = 0.0
    gain: np.ndarray = field(default_factory=lambda: np.ones((5, xhand.TAXELS_PER_FINGER)))
    bias: np.ndarray = field(default_factory=lambda: np.zeros((5, xhand.TAXELS_PER_FINGER)))
    swapped: dict[str, list[list[int]]] = field(default_factory=dict)
    assumed: list[str] = field(default_factory=list)
    raw: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        order = np.tile(np.arange(xhand.TAXELS_PER_FINGER), (5, 1))
        for finger, pairs in self.swapped.items():
            f = xhand.FINGERS.index(finger)
            for a, b in pairs:
                order[f, [a, b]] = order[f, [b, a]]
        self._order = order

    def torque_norm(self, current: np.ndarray) -> np.ndarray:
        """tau/tau_max [12] from the current as the SDK gives it, in A [12]: what the policy's torque field was in
        training. `matched`: the torque whose fingertip force this current was measured to give; `paper`: I / I_max."""
        signed = self.current_sign * np.asarray(current, float)
        scale = self.current_per_torque * self.torque_max if self.normalization == "matched" else self.current_max
        return signed / scale

    def current(self, torque: np.ndarray) -> np.ndarray:
        """The SDK's current [12] A at a motor torque [12] N.m: the inverse, for the simulated hand."""
        return self.current_sign * np.asarray(torque, float) * self.current_per_torque

    def normal_force(self, counts: np.ndarray) -> np.ndarray:
        """Normal forces [5, 120] N of taxel readings [5, 120, 3] counts: bias off, exchanged back, gain, threshold."""
        z = np.asarray(counts, float)[..., 2] - self.bias
        z = np.take_along_axis(z, self._order, 1) * (self.gain * self.lsb * self.axis_sign[2])
        return np.where(z > max(self.threshold, 0.0), z, 0.0)

    @classmethod
    def default(cls, torque_max: np.ndarray | None = None) -> Calibration:
        """Nothing measured: the community's and our assumptions, said in `assumed`."""
        return cls.from_dict({"schema": 1}, "no calibration", torque_max)

    @classmethod
    def load(cls, path: str | Path, torque_max: np.ndarray | None = None) -> Calibration:
        """Raises UserError for a file that is missing, not YAML or impossible."""
        path = Path(path).expanduser()
        if not path.exists():
            raise UserError(f"calibration {path}: no such file (dexsim calibrate writes one)")
        raw = yaml_text.load(path, "calibration")
        return cls.from_dict(raw, str(path), torque_max)

    @classmethod
    def from_dict(cls, raw: Any, where: str = "calibration", torque_max: np.ndarray | None = None) -> Calibration:
        """torque_max [12] N.m: what training normalised by; the file may state its own."""
        if not isinstance(raw, dict):
            raise UserError(f"{where}: must map keys to values; keys: {', '.join(KEYS)}")
        _known(raw, KEYS, where)
        if raw.get("schema", 1) != 1:
            raise UserError(f"{where}: schema={raw['schema']}: this dexsim reads 1")
        how = raw.get("normalization", "matched")
        if how not in NORMALIZATIONS:
            raise UserError(f"{where}: normalization={how}: must be one of {', '.join(NORMALIZATIONS)}")
        base = xhand.efforts() if torque_max is None else np.asarray(torque_max, float)
        out = {"current_per_torque": np.full(12, np.nan), "current_max": np.full(12, np.nan), "torque_max": base.copy()}
        joints = raw.get("joints") or {}
        for joint, entry in joints.items():
            if joint not in xhand.JOINTS:
                raise UserError(f"{where}: joints.{joint}: no such joint; joints: {', '.join(xhand.JOINTS)}")
            for key, column in out.items():
                value = (entry or {}).get(key)
                value = value.get("value") if isinstance(value, dict) else value
                if value not in (None, "unknown"):
                    column[xhand.JOINTS.index(joint)] = _positive(value, f"{where}: joints.{joint}.{key}")
        assumed = []
        unknown = [j for j, v in zip(xhand.JOINTS, out["current_per_torque"], strict=True) if not np.isfinite(v)]
        if unknown and how == "matched":
            names = "every joint" if len(unknown) == 12 else ", ".join(unknown)
            assumed.append(f"current_per_torque of {names} is not measured: {ASSUMED_CURRENT_PER_TORQUE} A per N.m assumed")
        missing = ~np.isfinite(out["current_per_torque"])
        out["current_per_torque"][missing] = ASSUMED_CURRENT_PER_TORQUE
        unmeasured = ~np.isfinite(out["current_max"])
        if unmeasured.any() and how == "paper":
            assumed.append("current_max of some joints is not measured: current_per_torque times torque_max taken")
        out["current_max"] = np.where(unmeasured, out["current_per_torque"] * out["torque_max"], out["current_max"])
        sign = raw.get("current_sign", -1)
        sign = [sign.get(j, -1) for j in xhand.JOINTS] if isinstance(sign, dict) else [sign] * 12
        if not all(s in (-1, 1) for s in sign):
            raise UserError(f"{where}: current_sign={raw['current_sign']}: must be -1 or 1, or map joints to these")
        return cls(**out, current_sign=np.array(sign, float), normalization=how, **_touch(raw.get("touch") or {}, where, assumed),
                   assumed=assumed, raw=raw)  # fmt: skip

    def to_dict(self) -> dict[str, Any]:
        """The file's content with every value that deployment uses stated."""
        out = dict(self.raw) | {"schema": 1, "normalization": self.normalization}
        out["current_sign"] = {j: int(s) for j, s in zip(xhand.JOINTS, self.current_sign, strict=True)}
        joints = {j: dict((self.raw.get("joints") or {}).get(j) or {}) for j in xhand.JOINTS}
        for k, joint in enumerate(xhand.JOINTS):
            for key in ("current_per_torque", "current_max", "torque_max"):
                given = joints[joint].get(key)
                if given in (None, "unknown"):
                    joints[joint][key] = float(getattr(self, key)[k])
        out["joints"] = joints
        touch = dict(self.raw.get("touch") or {})
        touch.setdefault("lsb", self.lsb)
        touch.setdefault("axis_sign", [int(s) for s in self.axis_sign])
        touch.setdefault("threshold", self.threshold)
        return out | {"touch": touch}


def save(path: str | Path, content: dict[str, Any]) -> None:
    """Write a calibration file, replacing the old one only once the new one is whole; it must load."""
    Calibration.from_dict(content, str(path))
    path = Path(path)
    part = path.with_name(f".{path.name}.tmp")
    try:
        part.write_text(yaml.safe_dump(content, sort_keys=False, width=120), encoding="utf-8")
        part.replace(path)
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror}") from None


def _touch(raw: Any, where: str, assumed: list[str]) -> dict[str, Any]:
    if not isinstance(raw, dict):
        raise UserError(f"{where}: touch must map keys to values; keys: {', '.join(TOUCH_KEYS)}")
    _known(raw, TOUCH_KEYS, f"{where}: touch")
    out: dict[str, Any] = {}
    if raw.get("lsb") in (None, "unknown"):
        assumed.append(f"touch.lsb is not measured: {ASSUMED_LSB} N a count assumed")
    else:
        out["lsb"] = _positive(raw["lsb"], f"{where}: touch.lsb")
    sign = raw.get("axis_sign", [-1, -1, 1])
    if not (isinstance(sign, (list, tuple)) and len(sign) == 3 and all(s in (-1, 1) for s in sign)):
        raise UserError(f"{where}: touch.axis_sign={sign}: must be three of -1 and 1")
    out["axis_sign"] = np.array(sign, float)
    threshold = raw.get("threshold", 0.0)
    threshold = threshold.get("value") if isinstance(threshold, dict) else threshold
    if not isinstance(threshold, (int, float)) or not 0 <= threshold <= 100:
        raise UserError(f"{where}: touch.threshold={threshold}: must be a number from 0 to 100 N")
    out["threshold"] = float(threshold)
    T = xhand.TAXELS_PER_FINGER
    for key, neutral in (("gain", 1.0), ("bias", 0.0)):
        table = np.full((5, T), neutral)
        for finger, values in (raw.get(key) or {}).items():
            values = np.asarray(values, float)
            if values.shape != (T,) or not np.isfinite(values).all():
                raise UserError(f"{where}: touch.{key}.{_finger(finger, where)}: must be {T} finite numbers")
            table[xhand.FINGERS.index(_finger(finger, where))] = values
        out[key] = table
    for finger, taxels in (raw.get("dead") or {}).items():
        out["gain"][xhand.FINGERS.index(_finger(finger, where)), [_taxel(k, where) for k in taxels]] = 0.0
    out["swapped"] = {_finger(f, where): [[_taxel(a, where), _taxel(b, where)] for a, b in pairs]
                      for f, pairs in (raw.get("swapped") or {}).items()}  # fmt: skip
    return out


def _known(raw: dict, keys: tuple[str, ...], where: str) -> None:
    for key in raw:
        if key not in keys:
            raise UserError(f"{where}: key '{key}' does not exist; keys: {', '.join(keys)}")


def _positive(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < math.inf:
        raise UserError(f"{where}={value!r}: must be a number > 0")
    return float(value)


def _finger(name: Any, where: str) -> str:
    if name not in xhand.FINGERS:
        raise UserError(f"{where}: touch: no finger '{name}'; fingers: {', '.join(xhand.FINGERS)}")
    return name


def _taxel(k: Any, where: str) -> int:
    if isinstance(k, bool) or not isinstance(k, int) or not 0 <= k < xhand.TAXELS_PER_FINGER:
        raise UserError(f"{where}: touch: taxel {k!r} must be a whole number from 0 to {xhand.TAXELS_PER_FINGER - 1}")
    return k
