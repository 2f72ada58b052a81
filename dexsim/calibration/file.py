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

from dexsim import files, typed, yaml_text
from dexsim.errors import UserError
from dexsim.hand import Hand, load_hand
from dexsim.tactile.layout import touch_shape

KEYS = ("schema", "normalization", "current_sign", "joints", "touch", "source", "notes", "robot", "report", "servo")
TOUCH_KEYS = ("lsb", "axis_sign", "threshold", "gain", "bias", "dead", "swapped", "rubber", "hysteresis", "stiffness")
Normalization = Literal["matched", "paper"]
ASSUMED_CURRENT_PER_TORQUE = 2.7
"""A per N.m until measured; see `dexsim.recording.realistic.CURRENT_PER_TORQUE`, where the figure is explained."""
ASSUMED_LSB = 0.1
"""N a count: what users of the hand assume; the vendor publishes no unit."""


Sign = Literal[-1, 1]
Taxel = Annotated[int, msgspec.Meta(ge=0, le=100_000)]
Taxels = Annotated[list[typed.Real], msgspec.Meta(max_length=100_000)]
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
    """N a count, signs, N; by finger: gains [T], counts [T], taxels, pairs of taxels."""

    lsb: typed.Positive | Literal["unknown"] | None = None
    axis_sign: tuple[Sign, Sign, Sign] = (-1, -1, 1)
    threshold: Force | Newtons = 0.0
    gain: dict[str, Taxels] | None = None
    bias: dict[str, Taxels] | None = None
    dead: dict[str, list[Taxel]] | None = None
    swapped: dict[str, list[tuple[Taxel, Taxel]]] | None = None


class Content(msgspec.Struct):
    """`calibration.yaml` as far as it is read."""

    schema: Literal[1] = 1
    normalization: Normalization = "matched"
    current_sign: Sign | dict[str, Sign] = -1
    joints: dict[str, Joint | None] | None = None
    touch: Touch | None = None


@dataclass
class Calibration:
    """By joint in the hand's order [J]: current_per_torque A per N.m, current_max A, torque_max N.m (what training
    normalised by), current_sign; by taxel: lsb N a count, axis_sign [3], threshold N, gain and bias [P, T] (counts; P
    pads of up to T taxels), swapped: pairs of taxels to exchange by finger. assumed: what was not measured, in words.
    raw: the file's content. hand: whose it is."""

    current_per_torque: np.ndarray
    current_max: np.ndarray
    torque_max: np.ndarray
    current_sign: np.ndarray
    normalization: str = "matched"
    lsb: float = ASSUMED_LSB
    axis_sign: np.ndarray = field(default_factory=lambda: np.array([-1.0, -1.0, 1.0]))
    threshold: float = 0.0
    gain: np.ndarray = field(kw_only=True)
    bias: np.ndarray = field(kw_only=True)
    hand: Hand = field(kw_only=True)
    swapped: dict[str, list[list[int]]] = field(default_factory=dict)
    assumed: list[str] = field(default_factory=list)
    raw: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        order = np.tile(np.arange(self.gain.shape[1]), (len(self.gain), 1))
        for finger, pairs in self.swapped.items():
            f = [p.name for p in self.hand.pads].index(finger)
            for a, b in pairs:
                order[f, [a, b]] = order[f, [b, a]]
        self._order = order

    def torque_norm(self, current: np.ndarray) -> np.ndarray:
        """Return tau/tau_max [J] from the current as the SDK gives it, in A [J]: what the policy's torque field was in
        training. `matched`: the torque whose fingertip force this current was measured to give; `paper`: I / I_max."""
        signed = self.current_sign * np.asarray(current, float)
        scale = self.current_per_torque * self.torque_max if self.normalization == "matched" else self.current_max
        return signed / scale

    def current(self, torque: np.ndarray) -> np.ndarray:
        """Return the SDK's current [J] A at a motor torque [J] N.m: the inverse, for the simulated hand."""
        return self.current_sign * np.asarray(torque, float) * self.current_per_torque

    def normal_force(self, counts: np.ndarray) -> np.ndarray:
        """Return the normal forces [P, T] N of taxel readings [P, T, 3] counts (empty: nothing is felt): bias off,
        exchanged back, gain, threshold."""
        if not np.size(counts):
            return np.zeros_like(self.gain)
        z = np.asarray(counts, float)[..., 2] - self.bias
        z = np.take_along_axis(z, self._order, 1) * (self.gain * self.lsb * self.axis_sign[2])
        return np.where(z > max(self.threshold, 0.0), z, 0.0)

    @classmethod
    def default(cls, torque_max: np.ndarray | None = None, hand: Hand | None = None) -> Calibration:
        """Return nothing measured: the community's and our assumptions, said in `assumed`."""
        return cls.from_dict({"schema": 1}, "no calibration", torque_max, hand)

    @classmethod
    def load(
        cls, path: str | Path, torque_max: np.ndarray | None = None, hand: Hand | None = None
    ) -> Calibration:
        """Raises UserError for a file that is missing, not YAML or impossible."""
        path = Path(path).expanduser()
        if not path.exists():
            raise UserError(f"calibration {path}: no such file (dexsim calibrate writes one)")
        raw = yaml_text.load(path, "calibration")
        return cls.from_dict(raw, str(path), torque_max, hand)

    @classmethod
    def from_dict(
        cls, raw: Any, where: str = "calibration", torque_max: np.ndarray | None = None, hand: Hand | None = None
    ) -> Calibration:
        """Return torque_max [J] N.m: what training normalised by; the file may state its own. hand: whose (the
        xHand)."""
        hand = hand or load_hand("xhand")
        J = len(hand.joints)
        content = _content(raw, where, hand)
        how = content.normalization
        base = hand.efforts if torque_max is None else np.asarray(torque_max, float)
        out = {"current_per_torque": np.full(J, np.nan), "current_max": np.full(J, np.nan), "torque_max": base.copy()}
        for joint, entry in (content.joints or {}).items():
            for key, column in out.items():
                value = getattr(entry, key) if entry is not None else None
                value = value.value if isinstance(value, Fitted) else value
                if value not in (None, "unknown"):
                    column[hand.joints.index(joint)] = value
        assumed = []
        unknown = [j for j, v in zip(hand.joints, out["current_per_torque"], strict=True) if not np.isfinite(v)]
        if unknown and how == "matched":
            names = "every joint" if len(unknown) == J else ", ".join(unknown)
            assumed.append(
                f"current_per_torque of {names} is not measured: {ASSUMED_CURRENT_PER_TORQUE} A per N.m assumed"
            )
        unknown = [j for j, e in (content.joints or {}).items() if e is not None and e.torque_max == "unknown"]
        if unknown and how == "matched":
            assumed.append(f"torque_max of {', '.join(unknown)} is unknown: what training normalised by is taken")
        missing = ~np.isfinite(out["current_per_torque"])
        out["current_per_torque"][missing] = ASSUMED_CURRENT_PER_TORQUE
        unmeasured = ~np.isfinite(out["current_max"])
        unknown = [j for j, e in (content.joints or {}).items() if e is not None and e.current_max == "unknown"]
        unknown = [j for j, x in zip(hand.joints, unmeasured, strict=True) if x] if how == "paper" else unknown
        if unknown:
            names = "every joint" if len(unknown) == J else ", ".join(unknown)
            assumed.append(f"current_max of {names} is not measured: current_per_torque times torque_max taken")
        out["current_max"] = np.where(unmeasured, out["current_per_torque"] * out["torque_max"], out["current_max"])
        sign = content.current_sign
        signs = [sign.get(j, -1) for j in hand.joints] if isinstance(sign, dict) else [sign] * J
        return cls(
            current_per_torque=out["current_per_torque"], current_max=out["current_max"], torque_max=out["torque_max"],
            current_sign=np.array(signs, float), normalization=how,
            **_touch(content.touch or Touch(), assumed, where, hand), hand=hand, assumed=assumed, raw=raw,
        )  # fmt: skip

    def to_dict(self) -> dict[str, Any]:
        """Return the file's content with every value that deployment uses stated."""
        out = dict(self.raw) | {"schema": 1, "normalization": self.normalization}
        out["current_sign"] = {j: int(s) for j, s in zip(self.hand.joints, self.current_sign, strict=True)}
        joints = {j: dict((self.raw.get("joints") or {}).get(j) or {}) for j in self.hand.joints}
        for k, joint in enumerate(self.hand.joints):
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


def save(path: str | Path, content: dict[str, Any], hand: Hand | None = None) -> None:
    """Write a calibration file, replacing the old one only once the new one is whole; it must load. hand: whose (the
    xHand)."""
    Calibration.from_dict(content, str(path), hand=hand)
    files.write(Path(path), yaml.safe_dump(content, sort_keys=False, width=120), "calibration")


def _content(raw: Any, where: str, hand: Hand) -> Content:
    """Return what the deployed policy reads of the file, checked; notes for people are not. Raises UserError."""
    if isinstance(raw, dict):
        keys = {"": (raw, KEYS), "touch": (raw.get("touch"), TOUCH_KEYS), "joints": (raw.get("joints"), hand.joints),
                "current_sign": (raw.get("current_sign"), hand.joints)}
        for part, (there, known) in keys.items():
            for key in there if isinstance(there, dict) else ():
                if key not in known:
                    raise UserError(
                        f"{where}: {part}{'.' if part else ''}{key}: no such "
                        f"{'key' if part in ('', 'touch') else 'joint'}; there are: {', '.join(known)}"
                    )
    return typed.convert(raw, Content, where, "correct the file, or fit it anew with dexsim calibrate")


def _touch(touch: Touch, assumed: list[str], where: str, hand: Hand) -> dict[str, Any]:
    pads, taxels = touch_shape(hand)
    names = [p.name for p in hand.pads]
    for key in ("gain", "bias", "dead", "swapped"):
        for finger, values in (getattr(touch, key) or {}).items():
            at = f"{where}: touch.{key}.{finger}"
            if finger not in names:
                raise UserError(f"{at}: no such pad of {hand.name}; there are: {', '.join(names) or 'none'}")
            if key in ("gain", "bias") and len(values) != taxels:
                raise UserError(f"{at}: {len(values)} numbers, must be {taxels}, one a taxel")
            if key in ("dead", "swapped") and np.max(values, initial=0) >= taxels:
                raise UserError(f"{at}: no taxel {np.max(values)}; a pad has {taxels}, counted from 0")
    out: dict[str, Any] = {}
    if touch.lsb in (None, "unknown"):
        assumed.append(f"touch.lsb is not measured: {ASSUMED_LSB} N a count assumed")
    else:
        out["lsb"] = float(touch.lsb)
    out["axis_sign"] = np.array(touch.axis_sign, float)
    out["threshold"] = float(touch.threshold.value if isinstance(touch.threshold, Force) else touch.threshold)
    for key, neutral in (("gain", 1.0), ("bias", 0.0)):
        out[key] = np.full((pads, taxels), neutral)
        for finger, values in (getattr(touch, key) or {}).items():
            out[key][names.index(finger)] = values
    for finger, lost in (touch.dead or {}).items():
        out["gain"][names.index(finger), list(lost)] = 0.0
    out["swapped"] = {finger: [list(pair) for pair in pairs] for finger, pairs in (touch.swapped or {}).items()}
    return out
