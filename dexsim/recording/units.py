"""Units of what is recorded, in one place: `units.QUANTITY=UNIT` or `units.QUANTITY.JOINT=UNIT`.

`position` also holds for commands and, by its scale, for velocities, where those have no unit of their own. Beside
plain units there are two that a drive's own numbers need: `ticks:4096` (of an encoder, so many a turn;
`ticks:4096@2048` where 2048 is zero, and the encoder's turn half on either side of it) and positions along a range, of
which both ends are known: `percent` (0 to 100), `signed_percent` (-100 to 100), `normalized` (-1 to 1), `registers` (0
to 1000) or `range:A..B`. Such a range is the joint's in the model, or follows: `registers=1.47..0` says that 0 is 1.47
rad and 1000 is 0 rad.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

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
    "time": {"s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "command": LENGTHS,
    "position": LENGTHS,
    "velocity": SPEEDS,
    "effort": {"a": 1.0, "ma": 1e-3, "nm": 1.0, "n.m": 1.0, "n": 1.0, "mnm": 1e-3, "mn.m": 1e-3, "ncm": 1e-2},
    "temperature": {"degc": 1.0, "c": 1.0, "°c": 1.0},
    "duty": {"1": 1.0, "%": 0.01, "percent": 0.01, "permille": 1e-3},
    "enabled": {},
    "supply_voltage": {"v": 1.0, "mv": 1e-3},
}
"""Plain units of each quantity, in SI."""
RANGES = {"percent": (0.0, 100.0), "signed_percent": (-100.0, 100.0), "normalized": (-1.0, 1.0),
          "registers": (0.0, 1000.0)}  # fmt: skip
"""What both ends of a joint's range are in units along it."""
HELP = (
    "ticks:4096, ticks:4096@2048 (zero), percent, signed_percent, normalized, registers, range:A..B; =LOW..HIGH in rad"
)
_NUMBER = r"[-+]?[0-9.]+(?:e[-+]?[0-9]+)?"


@dataclass(frozen=True)
class Unit:
    """A straight line to SI: `scale` x value + `offset`. text: as it was stated; sure: not a guess; turn: values of a
    turn, for an encoder of one turn, which goes from the largest to 0 within a motion: it is taken half a turn to both
    sides of its zero."""

    scale: float
    offset: float = 0.0
    text: str = ""
    sure: bool = True
    turn: float = 0.0

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
    joint, where it is known; where: names the recording in errors."""

    def __init__(self, stated: Mapping[str, str], limits: Mapping[str, tuple[float, float]] | None, where: str):
        self.stated, self.limits, self.where = dict(stated), dict(limits or {}), where
        for key in self.stated:
            quantity = key.partition(".")[0]
            if quantity not in UNITS:
                raise UserError(f"{where}: units.{key}: no such quantity.{did_you_mean(quantity, list(UNITS))}")

    def of(self, quantity: str, joint: str) -> Unit | None:
        """Return the unit that is stated; None where none is."""
        asked = [f"{quantity}.{joint}", quantity]
        if quantity in ("command", "velocity"):
            asked += [f"position.{joint}", "position"]
        for key in asked:
            if key not in self.stated:
                continue
            kind = quantity if key.startswith(quantity) else "position"
            return parse(self.stated[key], kind, f"{self.where}: units.{key}", self.limits.get(joint))
        return None

    def guess(self, joint: str, command: np.ndarray, position: np.ndarray) -> Unit | None:
        """Return what command [K] and position [S] of a joint, of no stated unit, must be in; None where rad is
        possible, or several units are: both whole numbers, as a drive's registers have them."""
        both = [x[np.isfinite(x)] for x in (command, position)]
        if any(len(x) < 5 or (x != np.round(x)).any() for x in both) or np.ptp(both[1]) < 20:
            return None
        low, high = min(x.min() for x in both), max(x.max() for x in both)
        if low < 0 or high <= 180 or high > 65535:
            return None
        if high <= 1000:
            return parse("registers", "position", "", self.limits[joint]) if joint in self.limits else None
        count = 4096 if high <= 4095 else 65536
        return parse(f"ticks:{count}@{count // 2}", "position", "")


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
