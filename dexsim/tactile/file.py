"""`tactile.yaml`: what a diagnosis found of touch and contact, as training takes it (`train.py tactile_file=FILE`).

    tactile:                        # over the settings of dexsim/configs/tactile
      friction: [0.35, 0.45]
      pads:                         # by fingertip, see `dexsim.tactile.pads`
        index: {delay: {value: 0.02, low: 0.018, high: 0.022}}
    randomize:                      # over the task's ranges
      object.friction: [0.35, 0.45]
      contact.stiffness: {value: 4500, low: 4300, high: 4700}   # N/m

A value is a number, [low, high] or {value, low, high}; what has a range is drawn anew in each world at each episode.
"""

from __future__ import annotations

from collections.abc import Mapping, MutableMapping
from pathlib import Path
from typing import Any

import msgspec

from dexsim import typed, yaml_text
from dexsim.errors import UserError
from dexsim.hand import Hand, load_hand
from dexsim.tactile.config import COLUMNS
from dexsim.tactile.layout import hand_layout
from dexsim.tactile.pads import Pad, Value, check, pad_configs, value_range

RANGES: dict[str, tuple[str, float, float]] = {
    "object.friction": ("1", 0.05, 3.0),
    "contact.stiffness": ("N/m", 100.0, 1e5),
}
"""Ranges of `randomize` that the file may set: unit, lowest, highest (what the tasks allow)."""
_Once = Value | msgspec.UnsetType
_columns = [(name, _Once, msgspec.UNSET) for name in COLUMNS]
Touch = msgspec.defstruct("Touch", [("pads", dict[str, Pad], {}), *_columns], forbid_unknown_fields=True)
_names = {name.replace(".", "_"): name for name in RANGES}
_ranges = [(name, _Once, msgspec.UNSET) for name in _names]
Drawn = msgspec.defstruct("Drawn", _ranges, rename=_names, forbid_unknown_fields=True)
_parts = [("tactile", Touch | None, None), ("randomize", Drawn | None, None)]
File = msgspec.defstruct("File", _parts, forbid_unknown_fields=True)
"""What may stand in the file; limits: `COLUMNS`, `RANGES`, `dexsim.tactile.pads`."""


def load(path: str | Path, hand: Hand | None = None) -> dict[str, dict[str, Any]]:
    """Return the file as {"tactile": settings, "randomize": {name: [low, high]}}, checked for a hand's fingertips (the
    xHand's).

    Raises UserError in one line naming the file, the field, its value and what is allowed."""
    path = Path(path).expanduser()
    where = f"tactile file '{path}'"
    if not path.exists():
        raise UserError(
            f"{where} does not exist; tactile_file=PATH must name a tactile.yaml (dexsim diagnose writes one)"
        )
    raw = yaml_text.load(path, "tactile file")
    typed.convert(raw, File, where, "it must map tactile and randomize to what was found")
    try:
        return _checked(raw, hand or load_hand())
    except UserError as error:
        raise UserError(f"{where}: {error}") from None


def lay_over(cfg: MutableMapping[str, Any], path: str | Path, hand: Hand | None = None) -> None:
    """Puts the file's content into a config with `tactile` and `randomize`, so that a checkpoint carries it. Raises
    UserError as `load` does, and where the task has no such range."""
    found = load(path, hand)
    for key, value in found["tactile"].items():
        cfg["tactile"][key] = value
    for name, value in found["randomize"].items():
        part, _, last = name.partition(".")
        if part not in cfg["randomize"] or last not in cfg["randomize"][part]:
            raise UserError(
                f"tactile file '{path}': randomize.{name}: this task draws no {name}; take it out of the file"
            )
        cfg["randomize"][part][last] = value


def _checked(raw: Mapping[str, Any], hand: Hand) -> dict[str, dict[str, Any]]:
    out: dict[str, dict[str, Any]] = {"tactile": {}, "randomize": {}}
    for key, value in (raw.get("tactile") or {}).items():
        if key == "pads":
            out["tactile"]["pads"] = _pads(value, hand)
        else:
            out["tactile"][key] = list(value_range(f"tactile.{key}", value, *COLUMNS[key][:3]))
    for name, value in (raw.get("randomize") or {}).items():
        out["randomize"][name] = list(value_range(f"randomize.{name}", value, *RANGES[name]))
    return out


def _pads(value: Any, hand: Hand) -> dict[str, Any]:
    """Return pads as given, once every pad and taxel is one of the hand's."""
    layout = hand_layout(hand)
    if layout is None:
        if not value:
            return dict(value)
        raise UserError(f"tactile.pads: hand={hand.name} has no touch pads; take it out of the file")
    check(pad_configs(value), layout.names, layout.count)
    return dict(value)
