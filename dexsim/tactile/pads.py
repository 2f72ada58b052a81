"""Settings of single pads (`tactile.pads`): what a diagnosis finds of one fingertip's sensor and no other's.

    pads:
      index:                             # a pad of the layout
        gain: {value: 0.6, low: 0.57, high: 0.63}   # of all its taxels
        taxels: {17: [0.4, 0.5]}         # gain of single ones, instead
        dead: [3]                        # taxels that never answer
        stuck: {33: 0.4}                 # N that a taxel reads for ever
        swapped: [[14, 15]]              # taxels whose wires are exchanged
        crosstalk: [0.2, 0.3]            # share of its force that a taxel loses to those beside it
        hysteresis: 0.3                  # these three instead of the settings of the same name
        hysteresis_time: [0.3, 0.5]      # s
        delay: [0.018, 0.022]            # s; of all pads once one has it: interpolated between readings
        rubber: {c10: [9e4, 1.1e5], c01: 2e4, thickness: 2.0e-3}   # Pa, Pa, m: how force spreads over the taxels

A value is a number, [low, high], or {value, low, high}; what has a range is drawn anew in each world at each episode.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np

from dexsim import typed
from dexsim.errors import UserError

Range = tuple[float, float]
Number = float | str
"""YAML reads 1e-3 as text: that is accepted (`typed.real`)."""


class Interval(msgspec.Struct, forbid_unknown_fields=True):
    """A fitted value and where it may lie."""

    value: Number
    low: Number | msgspec.UnsetType = msgspec.UNSET
    high: Number | msgspec.UnsetType = msgspec.UNSET


Value = Number | list[Number] | Interval
"""A number, [low, high] or {value, low, high}; `value_range` has the limits."""


class Rubber(msgspec.Struct, forbid_unknown_fields=True):
    """Pa, Pa, m."""

    c10: Value = 0.0
    c01: Value = 0.0
    thickness: Value = 2.0e-3


class Pad(msgspec.Struct, forbid_unknown_fields=True):
    """One pad's settings, as a file has them; see above."""

    gain: Value | None = None
    taxels: dict[int | str, Value] = {}
    dead: list[Number] = []
    stuck: dict[int | str, Value] = {}
    swapped: list[tuple[Number, Number]] = []
    crosstalk: Value | None = None
    hysteresis: Value | None = None
    hysteresis_time: Value | None = None
    delay: Value | None = None
    rubber: Rubber | None = None


# What is drawn by world and pad: name -> (unit, lowest, highest allowed, value at which it is absent).
PAD_COLUMNS: dict[str, tuple[str, float, float, float]] = {
    "gain": ("1", 0.0, 20.0, 1.0),
    "crosstalk": ("1", 0.0, 1.0, 0.0),
    "hysteresis": ("1", 0.0, 3.0, 0.0),
    "hysteresis_time": ("s", 1e-3, 100.0, 0.1),
    "delay": ("s", 0.0, 1.0, 0.0),
    "c10": ("Pa", 0.0, 1e12, 0.0),
    "c01": ("Pa", 0.0, 1e12, 0.0),
}
GAIN = PAD_COLUMNS["gain"]
STUCK = ("N", 0.0, 1e3, 0.0)
THICKNESS = 2.0e-3  # m, where a pad's rubber states none


@dataclass(frozen=True)
class PadConfig:
    """One pad. params: ranges by `PAD_COLUMNS`, of what is set. taxels: ranges of single gains (a dead one (0, 0));
    stuck: readings in N; swapped: pairs; thickness [m] of its rubber."""

    params: Mapping[str, Range] = field(default_factory=dict)
    taxels: Mapping[int, Range] = field(default_factory=dict)
    stuck: Mapping[int, float] = field(default_factory=dict)
    swapped: tuple[tuple[int, int], ...] = ()
    thickness: float = THICKNESS

    @property
    def rubber(self) -> bool:
        return "c10" in self.params


def pad_configs(value: Mapping[str, Any]) -> dict[str, PadConfig]:
    """Check `tactile.pads`; return a PadConfig by name of pad. Raises UserError naming the setting, its value and what
    is allowed."""
    typed.convert({"tactile": {"pads": plain(value)}}, dict[str, dict[str, dict[str, Pad]]], "settings")
    return {str(name): _pad(f"tactile.pads.{name}", entry) for name, entry in value.items()}


def check(pads: Mapping[str, PadConfig], names: Sequence[str], count: Sequence[int] | np.ndarray) -> None:
    """Raise UserError for a pad that is none of `names`, and for a taxel beyond its `count`."""
    for name, pad in pads.items():
        if name not in names:
            raise UserError(f"tactile.pads.{name}: no such pad; pads: {', '.join(names)}")
        taxels = int(count[list(names).index(name)])
        for k in (*pad.taxels, *pad.stuck, *(k for pair in pad.swapped for k in pair)):
            if k >= taxels:
                raise UserError(f"tactile.pads.{name}: no taxel {k}; this pad has {taxels}, counted from 0")


def plain(node: object) -> object:
    """Return other mappings and sequences (a config's) as dicts and lists; names as text."""
    if isinstance(node, Mapping):
        return {k if isinstance(k, int) else str(k): plain(v) for k, v in node.items()}
    return [plain(v) for v in node] if isinstance(node, Sequence) and not isinstance(node, str) else node


def _pad(where: str, entry: Mapping) -> PadConfig:
    """Check an entry against `Pad`."""
    entry = {k: v for k, v in entry.items() if v is not None}
    params = {k: value_range(f"{where}.{k}", entry[k], *PAD_COLUMNS[k][:3]) for k in PAD_COLUMNS if k in entry}
    thickness = THICKNESS
    if "rubber" in entry:
        rubber = entry["rubber"]
        params |= {
            k: value_range(f"{where}.rubber.{k}", rubber.get(k, 0.0), *PAD_COLUMNS[k][:3]) for k in ("c10", "c01")
        }
        if params["c10"][0] + params["c01"][0] <= 0.0:
            raise UserError(f"{where}.rubber: the lowest c10 + c01 must be positive [Pa]")
        thickness = value_range(f"{where}.rubber.thickness", rubber.get("thickness", THICKNESS), "m", 1e-5, 0.1)[0]
    taxels = {_index(f"{where}.taxels", k): value_range(f"{where}.taxels.{k}", v, *GAIN[:3])
              for k, v in entry.get("taxels", {}).items()}  # fmt: skip
    taxels |= {_index(f"{where}.dead", k): (0.0, 0.0) for k in entry.get("dead", [])}
    stuck = {_index(f"{where}.stuck", k): value_range(f"{where}.stuck.{k}", v, *STUCK[:3])[0]
             for k, v in entry.get("stuck", {}).items()}  # fmt: skip
    return PadConfig(params, taxels, stuck, _swaps(f"{where}.swapped", entry.get("swapped", [])), thickness)


def value_range(where: str, value: object, unit: str, low: float, high: float) -> Range:
    """Return the range (low, high) of a number, [low, high] or {value, low, high}; UserError starting with `where`."""
    ends = typed.interval(where, value, unit, low, high)
    return ends[0], ends[2]


def _index(where: str, k: object) -> int:
    """Return a taxel's number; keys of a checkpoint's config are text."""
    number = typed.real(k)
    if not 0 <= number < 2**31 or number != int(number):
        raise UserError(f"{where}: '{k}' is no taxel; taxels are counted from 0")
    return int(number)


def _swaps(where: str, value: Sequence) -> tuple[tuple[int, int], ...]:
    out: list[tuple[int, int]] = []
    used: set[int] = set()
    for pair in value:
        a, b = (_index(where, k) for k in pair)
        if a == b or {a, b} & used:
            raise UserError(f"{where}: taxel {a if a == b or a in used else b} is exchanged twice, or with itself")
        used |= {a, b}
        out.append((a, b))
    return tuple(out)
