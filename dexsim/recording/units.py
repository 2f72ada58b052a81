"""Units of what is recorded, in one place: `units.QUANTITY=UNIT` or `units.QUANTITY.JOINT=UNIT`.

`position` also holds for commands and, by its scale, for velocities, where those have no unit of their own. Beside
plain units there are two that a drive's own numbers need: `ticks:4096` (of an encoder, so many a turn;
`ticks:4096@2048` where 2048 is zero, and the encoder's turn half on either side of it) and positions along a range, of
which both ends are known: `percent` (0 to 100), `signed_percent` (-100 to 100), `normalized` (-1 to 1), `fraction` (0
to 1), `registers` (0 to 1000) or `range:A..B`. Such a range is the joint's in the model, or follows:
`registers=1.47..0` says that 0 is 1.47 rad and 1000 is 0 rad. Where nothing is stated and rad is not possible, the unit
is guessed (`Units.guess`), and a warning says so.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from dexsim.actuator.columns import did_you_mean
from dexsim.errors import UserError

TURN = 2 * np.pi
LENGTHS = {"rad": 1.0, "deg": np.pi / 180, "m": 1.0, "mm": 1e-3, "cm": 1e-2, "turn": TURN, "rev": TURN,
           "°": np.pi / 180}  # fmt: skip
SPEEDS = {
    "rad/s": 1.0, "rads": 1.0, "rad_s": 1.0, "deg/s": np.pi / 180, "degs": np.pi / 180, "deg_s": np.pi / 180,
    "rpm": TURN / 60, "m/s": 1.0, "mm/s": 1e-3, "°/s": np.pi / 180,
}  # fmt: skip
UNITS: dict[str, dict[str, float]] = {
    "time": {"s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}, "command": LENGTHS,
    "position": LENGTHS, "velocity": SPEEDS,
    "effort": {"a": 1.0, "ma": 1e-3, "nm": 1.0, "n.m": 1.0, "n": 1.0, "mnm": 1e-3, "mn.m": 1e-3, "ncm": 1e-2},
    "temperature": {"degc": 1.0, "c": 1.0, "°c": 1.0}, "duty": {"1": 1.0, "%": 0.01, "percent": 0.01, "permille": 1e-3},
    "enabled": {}, "supply_voltage": {"v": 1.0, "mv": 1e-3},
}  # fmt: skip
"""Plain units of each quantity, in SI."""
RANGES = {"percent": (0.0, 100.0), "signed_percent": (-100.0, 100.0), "normalized": (-1.0, 1.0),
          "fraction": (0.0, 1.0), "registers": (0.0, 1000.0)}  # fmt: skip
"""What both ends of a joint's range are in units along it."""
ALONG = {"%": "percent", "percent": "percent", "pct": "percent", "normalized": "normalized"}
"""How the name of a column says that its positions are along a range."""
HELP = (
    "ticks:4096, ticks:4096@2048 (zero), percent, signed_percent, normalized, fraction, registers, range:A..B; "
    "=LOW..HIGH in rad"
)
_NUMBER = r"[-+]?[0-9.]+(?:e[-+]?[0-9]+)?"
TURNS = 4 * np.pi
"""rad that a joint without known limits hardly reaches."""
BEYOND, SHARE = 0.5, 0.25
"""By how much values in rad may be beyond a joint's limits [rad]; of values within [-1, 1], by what part of its
range."""
SIDES = 5.0
"""How much farther from zero positions may go than commands, or these than positions, in one unit."""


@dataclass(frozen=True)
class Unit:
    """A straight line to SI: `scale` x value + `offset`. text: as it was stated; turn: values of a turn, for an encoder
    of one turn, which goes from the largest to 0 within a motion: it is taken half a turn to both sides of its zero.
    why: what a guess rests on, and what else it may be; fraction: of a travel whose ends are not known, not in SI."""

    scale: float
    offset: float = 0.0
    text: str = ""
    turn: float = 0.0
    why: str = ""
    fraction: bool = False

    def __call__(self, x: np.ndarray, rate: bool = False) -> np.ndarray:
        """Return values x in SI; rate: by second, where an offset is none."""
        out = np.asarray(self.scale * x + (0.0 if rate else self.offset))
        known = x[np.isfinite(x)]
        if not rate and self.turn and len(known) and 0 <= known.min() and known.max() <= self.turn:
            whole = self.turn * self.scale
            out = np.asarray((out + whole / 2) % whole - whole / 2)
        return out


def parse(text: str, quantity: str, where: str, limits: tuple[float, float] | None = None) -> Unit:
    """Return the unit that `text` states. limits: of the joint [rad or m], for units along its range. Raises UserError,
    which `where` begins (file and setting)."""
    plain = UNITS[quantity].get(text.lower())
    if plain is not None:
        return Unit(plain, 0.0, text)
    name, _, ends = text.partition("=")
    word, _, argument = name.partition(":")
    if quantity in ("position", "command", "velocity"):
        if word == "ticks" and (found := re.fullmatch(rf"({_NUMBER})(?:@({_NUMBER}))?", argument)):
            count, zero = float(found[1]), float(found[2] or 0.0)
            if count > 0:
                return Unit(TURN / count, -zero * TURN / count, text, turn=count if found[2] else 0.0)
        low_high = RANGES.get(word) if not argument else _pair(argument) if word == "range" else None
        if low_high is not None and low_high[0] != low_high[1]:
            to = _pair(ends) if ends else limits
            if to is None:
                what = "its range is not known here" if not ends else f"'{ends}' is no range"
                raise UserError(f"{where}={text}: {what}; say it: {name}=LOW..HIGH [rad], or give model=")
            scale = (to[1] - to[0]) / (low_high[1] - low_high[0])
            return Unit(scale, to[0] - scale * low_high[0], text)
    length = UNITS[quantity] is LENGTHS
    meant = did_you_mean(text, [*UNITS[quantity], *(("ticks:4096", *RANGES) if length else ())])
    names = f"{', '.join(UNITS[quantity])}{f'; or {HELP}' if length else ''}"
    raise UserError(f"{where}={text}: is not read.{meant} Units of {quantity}: {names}")


def _pair(text: str) -> tuple[float, float] | None:
    found = re.fullmatch(rf"({_NUMBER})\.\.({_NUMBER})", text.replace(" ", ""))
    return None if found is None else (float(found[1]), float(found[2]))


class Units:
    """Units that are stated of a recording. stated: "position", "position.elbow" ... -> unit; limits: range of each
    joint, where it is known; where: names the recording in errors; modelled: the limits are of its own model."""

    def __init__(
        self, stated: Mapping[str, str], limits: Mapping[str, tuple[float, float]] | None, where: str,
        modelled: bool = False,
    ):  # fmt: skip
        self.stated, self.limits, self.where, self.modelled = dict(stated), dict(limits or {}), where, modelled
        for key in self.stated:
            quantity = key.partition(".")[0]
            if quantity not in UNITS:
                raise UserError(f"{where}: units.{key}: no such quantity.{did_you_mean(quantity, list(UNITS))}")

    def of(self, quantity: str, joint: str) -> Unit | None:
        """Return the unit that is stated; None where none is."""
        keys = [f"{quantity}.{joint}", quantity]
        if quantity in ("command", "velocity"):
            keys += [f"position.{joint}", "position"]
        for key in keys:
            if key not in self.stated:
                continue
            kind = quantity if key.startswith(quantity) else "position"
            return parse(self.stated[key], kind, f"{self.where}: units.{key}", self.limits.get(joint))
        return None

    def guess(
        self, values: Mapping[str, tuple[np.ndarray, np.ndarray]], named: Mapping[str, str] = MappingProxyType({})
    ) -> dict[str, Unit]:
        """Return the unit of joints of no stated one, by their commands [K] and positions [S] together: of those whose
        values are all whole numbers, as a drive's registers are, and of the rest. named: "percent" ... by joint, where
        the file's own columns say so. Joints are left out whose values may be rad, or of which nothing tells."""
        known = {j: [x[np.isfinite(x)] for x in both] for j, both in values.items()}
        known = {j: both for j, both in known.items() if all(len(x) >= 5 for x in both)}
        whole = {j: x for j, x in known.items() if all((v == np.round(v)).all() for v in x)}
        moving = {j: x for j, x in whole.items() if np.ptp(x[1]) >= 20}
        whole = moving if len(whole) < len(known) or not moving else whole  # one that rests is like the others
        out: dict[str, Unit] = {}
        for group in (whole, {j: x for j, x in known.items() if j not in whole}):
            sides = [max((float(np.abs(x[k]).max()) for x in group.values()), default=0.0) for k in (0, 1)]
            if group and max(sides) <= SIDES * min(sides):  # else one side is in another unit: a fault
                ends = {j: (min(x.min() for x in both), max(x.max() for x in both)) for j, both in group.items()}
                turn = max(_turned(x[1]) for x in group.values()) if group is whole else 0
                text, why = self._guess(ends, group is whole, turn)
                for joint, (low, _) in ends.items():
                    own = "percent" if text == "signed_percent" and low >= 0 and "gripper" in joint else text
                    unit = self._guessed(joint, own, why) if text and joint not in named else None
                    out |= {} if unit is None else {joint: unit}
        for joint, text in named.items():
            unit = self._guessed(joint, text, "by the name of its column")
            out |= {} if unit is None else {joint: unit}
        return out

    def _guess(self, ends: Mapping[str, tuple[float, float]], whole: bool, turn: int) -> tuple[str, str]:
        """Return (the unit of values between these ends by joint, what says so); "" where there is none. turn: after
        how many they begin again at 0; 0 where they never do."""
        low, high = min(a for a, _ in ends.values()), max(b for _, b in ends.values())
        top, ranged = max(-low, high), any(j in self.limits for j in ends)
        seen = f"{'whole numbers' if whole else 'values'} from {low:.4g} to {high:.4g}"
        degrees = self._fits(ends, np.pi / 180, 0.1, 0.1)
        if whole and low >= 0 and high > 180 and not (high <= 360 and ranged and degrees):
            if turn:
                return f"ticks:{turn}@0", f"by its {seen}, which begin again at 0"
            if 250 <= high <= 255:
                return "range:0..255", f"by its {seen}, as one byte has"
            if high <= 1000:
                return "registers", f"by its {seen} (or ticks:1024, or range:0..{high:.0f}?)"
            if high <= 1023:
                return "range:0..1023=-2.618..2.618", f"by its {seen}: 10 bits over 300 degrees"
            count = next((n for n in (4096, 16384, 65536) if high < n), 0)
            also = "" if count == 4096 else " (or ticks:4096, of several turns?)"
            return (f"ticks:{count}@{count // 2}", f"by its {seen}{also}") if count else ("", "")
        if self._fits(ends, 1.0, *((0.0, SHARE) if top <= 1.02 else (BEYOND, 0.0))):
            ends_of_one = not ranged and abs(low + 1) < 0.02 and abs(high - 1) < 0.02
            return ("rad", f"by its {seen} (or normalized?)") if ends_of_one else ("", "")
        beyond = "its limits in the model" if ranged else "what a joint turns"
        if top <= 1.02 and low < -0.2 and high > 0.2:
            return "normalized", f"by its {seen}, which in rad are beyond {beyond}"
        signed = "percent" if low >= -0.5 else "signed_percent"
        if TURNS < top <= 101 and (top >= 99 or not degrees):
            return signed, f"by its {seen}" + (" (or deg?)" if degrees else ", beyond its limits in deg")
        if TURNS < top <= 400 and degrees:
            also = f" (or {signed}?)" if top <= 101 else ""
            return "deg", f"by its {seen}, which in rad are beyond {beyond}{also}"
        return "", ""

    def _fits(self, ends: Mapping[str, tuple[float, float]], scale: float, slack: float, share: float) -> bool:
        """Return whether all joints are within their limits, or without a model within two turns, where values are
        times `scale` in rad; slack [rad], share of the range: by how much they may be beyond."""
        for joint, (low, high) in ends.items():
            a, b = self.limits.get(joint, (-np.inf, np.inf) if self.modelled else (-TURNS, TURNS))
            more = slack + (share * (b - a) if joint in self.limits else 0.0)
            if low * scale < a - more or high * scale > b + more:
                return False
        return True

    def _guessed(self, joint: str, text: str, why: str) -> Unit | None:
        """Return the unit of a guess; None where its range must be the model's and that has none."""
        needs = text.partition(":")[0] in (*RANGES, "range") and "=" not in text
        if not needs or joint in self.limits:
            return replace(parse(text, "position", "", self.limits.get(joint)), why=why)
        return None if self.modelled else replace(parse(text, "position", "", (0.0, 1.0)), why=why, fraction=True)


def _turned(x: np.ndarray) -> int:
    """Return after how many values of a turn of an encoder positions begin again at 0; 0 where they never do."""
    top = float(x.max())
    count = 2 ** int(np.ceil(np.log2(top + 1)))
    return count if 1024 <= count <= 65536 and top > 0.985 * count and np.abs(np.diff(x)).max() > 0.75 * count else 0


def split(meta: Mapping[str, object]) -> tuple[dict[str, object], dict[str, str]]:
    """Return (metadata without units, what is stated of units): keys "units.position" or a mapping under "units"."""
    rest: dict[str, object] = {}
    found: dict[str, str] = {}
    for key, value in meta.items():
        if key == "units" and isinstance(value, Mapping):
            found |= {str(k): str(v) for k, v in value.items()}
        elif key.startswith("units."):
            found[key.removeprefix("units.")] = str(value)
        else:
            rest[key] = value
    return rest, found
