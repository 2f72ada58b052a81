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

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
import yaml

from dexsim import typed, yaml_text
from dexsim.assets import xhand
from dexsim.errors import UserError

KEYS = ("schema", "normalization", "current_sign", "joints", "touch", "source", "notes", "robot", "report", "servo")
TOUCH_KEYS = ("lsb", "axis_sign", "threshold", "gain", "bias", "dead", "swapped", "rubber", "hysteresis", "stiffness")
NORMALIZATIONS = ("matched", "paper")
ASSUMED_CURRENT_PER_TORQUE = 2.7
"""A per N.m until measured; see `dexsim.recording.realistic.CURRENT_PER_TORQUE`, where the figure is explained."""
ASSUMED_LSB = 0.1
"""N a count: what users of the hand assume; the vendor publishes no unit."""


T = xhand.TAXELS_PER_FINGER
Sign = Literal[-1, 1]
Finger = Literal[xhand.FINGERS]
Taxel = Annotated[int, msgspec.Meta(ge=0, lt=T)]
Taxels = Annotated[list[typed.Real], msgspec.Meta(min_length=T, max_length=T)]
Newtons = Annotated[float, msgspec.Meta(ge=0, le=100)]


class Fitted(msgspec.Struct):
    """A fitted figure; what stands beside `value` (interval, R2) is for people."""

    value: typed.Positive | Literal["unknown"] | None


class Force(msgspec.Struct):
    """N, as `Fitted`."""

    value: Newtons


class Joint(msgspec.Struct):
    """A per N.m, A, N.m."""

    current_per_torque: Fitted | typed.Positive | Literal["unknown"] | None = None
    current_max: Fitted | typed.Positive | Literal["unknown"] | None = None
    torque_max: Fitted | typed.Positive | Literal["unknown"] | None = None


class Touch(msgspec.Struct):
    """N a count, signs, N; by finger: gains [120], counts [120], taxels, pairs of taxels."""

    lsb: typed.Positive | Literal["unknown"] | None = None
    axis_sign: tuple[Sign, Sign, Sign] = (-1, -1, 1)
    threshold: Force | Newtons = 0.0
    gain: dict[Finger, Taxels] | None = None
    bias: dict[Finger, Taxels] | None = None
    dead: dict[Finger, list[Taxel]] | None = None
    swapped: dict[Finger, list[tuple[Taxel, Taxel]]] | None = None


class Content(msgspec.Struct):
    """`calibration.yaml` as far as it is read."""

    schema: Literal[1] = 1
    normalization: Literal[NORMALIZATIONS] = "matched"
    current_sign: Sign | dict[Literal[xhand.JOINTS], Sign] = -1
    joints: dict[Literal[xhand.JOINTS], Joint | None] | None = None
    touch: Touch | None = None


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
        content = _content(raw, where)
        how = content.normalization
        base = xhand.efforts() if torque_max is None else np.asarray(torque_max, float)
        out = {"current_per_torque": np.full(12, np.nan), "current_max": np.full(12, np.nan), "torque_max": base.copy()}
        for joint, entry in (content.joints or {}).items():
            for key, column in out.items():
                value = getattr(entry, key) if entry is not None else None
                value = value.value if isinstance(value, Fitted) else value
                if value not in (None, "unknown"):
                    column[xhand.JOINTS.index(joint)] = value
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
        sign = content.current_sign
        sign = [sign.get(j, -1) for j in xhand.JOINTS] if isinstance(sign, dict) else [sign] * 12
        return cls(**out, current_sign=np.array(sign, float), normalization=how, **_touch(content.touch or Touch(), assumed),
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


def _content(raw: Any, where: str) -> Content:
    """What the deployed policy reads of the file, checked; notes for people are not. Raises UserError."""
    if isinstance(raw, dict):
        keys = {"": (raw, KEYS), "touch": (raw.get("touch"), TOUCH_KEYS), "joints": (raw.get("joints"), xhand.JOINTS)}
        for part, (there, known) in keys.items():
            for key in there if isinstance(there, dict) else ():
                if key not in known:
                    raise UserError(f"{where}: {part}{'.' if part else ''}{key}: no such {'joint' if part == 'joints' else 'key'};"
                                    f" there are: {', '.join(known)}")  # fmt: skip
        raw = {k: raw[k] for k in Content.__struct_fields__ if k in raw}
        if isinstance(raw.get("joints"), dict):
            raw["joints"] = {j: {k: e[k] for k in Joint.__struct_fields__ if k in e} if isinstance(e, dict) else e for j, e in raw["joints"].items()}
        if isinstance(raw.get("touch"), dict):
            raw["touch"] = {k: raw["touch"][k] for k in Touch.__struct_fields__ if k in raw["touch"]}
    return typed.convert(raw, Content, where, "correct the file, or fit it anew with dexsim calibrate")


def _touch(touch: Touch, assumed: list[str]) -> dict[str, Any]:
    out: dict[str, Any] = {}
    if touch.lsb in (None, "unknown"):
        assumed.append(f"touch.lsb is not measured: {ASSUMED_LSB} N a count assumed")
    else:
        out["lsb"] = float(touch.lsb)
    out["axis_sign"] = np.array(touch.axis_sign, float)
    out["threshold"] = float(touch.threshold.value if isinstance(touch.threshold, Force) else touch.threshold)
    for key, neutral in (("gain", 1.0), ("bias", 0.0)):
        out[key] = np.full((5, xhand.TAXELS_PER_FINGER), neutral)
        for finger, values in (getattr(touch, key) or {}).items():
            out[key][xhand.FINGERS.index(finger)] = values
    for finger, taxels in (touch.dead or {}).items():
        out["gain"][xhand.FINGERS.index(finger), list(taxels)] = 0.0
    out["swapped"] = {finger: [list(pair) for pair in pairs] for finger, pairs in (touch.swapped or {}).items()}
    return out
