"""The text of a hand.yaml for a person to correct: every field with a word on what it is, every guess marked."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import yaml

from dexsim import files
from dexsim.hand.schema import FILE

HEAD = """\
# {name}: a hand as dexsim reads it, written by `dexsim import-hand`. Lengths in m, angles in rad.
# What is marked "guess" was not in the model's file: look at picture.png, correct it here, and run the import again:
# what you changed stays. A place taken out of `guessed` (at the end) counts as confirmed.
"""
ABOUT = {
    "joints": "every driven joint, in the order of commands and readings on the wire; effort N m, speed rad/s",
    "palm": "the palm's frame, in the frame of `body`: x forward along the fingers, z = normal out of the palm",
    "fingers": "joints root to tip; flexion: those that close it, closes: the sign of the motion that does",
    "opposing": "fingers that press against the others",
    "poses": "open: ready to catch; cupped: closed around an object in the palm",
    "skin": "touch pads beyond the fingertips, as `source: skin` says them; taxels: in the frame of `body`",
    "places": "palm frame; catch: on the palm, objects are let fall over it (searched for: most were held there)",
    "span": "how wide a thing it can grasp: the reach of its fingers, at most the gap of the open hand",
    "force": "N a fingertip can press with; null: from the motors' torques and the levers",
}


def write(hand: dict[str, Any], folder: Path) -> None:
    """Write a hand.yaml whole or not at all. hand: plain data as `dexsim.hand.schema.HandFile` has it."""
    guessed = set(hand.get("guessed") or [])
    out = [HEAD.format(name=hand["name"])]
    for key, value in hand.items():
        if key in ABOUT:
            out.append(f"\n# {ABOUT[key]}\n")
        out.append(_entry(key, value, key, 0, guessed))
    with files.beside(folder / FILE) as part:
        part.write_text("".join(out), encoding="utf-8")


def _entry(key: str, value: Any, place: str, depth: int, guessed: set[str]) -> str:
    pad = "  " * depth
    key = _flow(key)
    mark = "  # guess" if place in guessed else ""
    if isinstance(value, dict) and not _small(value):
        return f"{pad}{key}:{mark}\n" + "".join(
            _entry(k, v, f"{place}.{k}", depth + 1, guessed) for k, v in value.items()
        )
    if isinstance(value, dict):
        inside = [k for k in value if f"{place}.{k}" in guessed]
        mark = mark or (f"  # guess: {', '.join(inside)}" if inside else "")
        return f"{pad}{key}: {_flow(value)}{mark}\n"
    if isinstance(value, list) and value and all(isinstance(x, dict) for x in value):
        lines = [f"{pad}{key}:{mark}\n"]
        for x in value:
            here = f"{place}.{x['name']}" if "name" in x else place
            if _small(x):
                inside = [k for k in x if f"{here}.{k}" in guessed]
                lines.append(f"{pad}  - {_flow(x)}{'  # guess: ' + ', '.join(inside) if inside else ''}\n")
                continue
            body = "".join(_entry(k, v, f"{here}.{k}", depth + 2, guessed) for k, v in x.items())
            lines.append(f"{pad}  - {body.lstrip()}")
        return "".join(lines)
    if isinstance(value, list) and depth == 0 and sum(len(_flow(x)) for x in value) > 90:
        return f"{pad}{key}:\n" + "".join(f"{pad}  - {_flow(x)}\n" for x in value)
    return f"{pad}{key}: {_flow(value)}{mark}\n"


def _small(value: dict[str, Any]) -> bool:
    plain = all(not isinstance(v, (dict, list)) for v in value.values())
    return plain and len(value) <= 4


def _flow(value: Any) -> str:
    """Return a value on one line."""
    text = yaml.dump(
        value, Dumper=_Short, default_flow_style=True, width=math.inf, sort_keys=False, allow_unicode=True
    )
    return text.removesuffix("\n").removesuffix("\n...")


class _Short(yaml.SafeDumper):
    """Floats with six digits, nothing by reference."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


_Short.add_representer(float, lambda dumper, x: dumper.represent_float(float(f"{x + 0.0:.6g}")))
