"""What a person corrected in a hand.yaml that a program wrote: told apart from guesses, and kept.

The importer notes beside the file what it wrote. What differs from that now is a person's, and stays; so does what a
person took out of `guessed` without changing it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dexsim import files
from dexsim.errors import UserError

NOTE = ".import.json"
ORDER = "joint order"
"""Of the places, the one that is no field: names of the joints in a person's order on the wire."""
OPTIONAL = ("places",)  # mappings that are left out where nothing is said of them


@dataclass
class Corrections:
    """values: place -> what a person says there ("palm.normal", "poses.open.j1", "fingers.thumb.tip.position")."""

    values: dict[str, Any] = field(default_factory=dict)
    used: set[str] = field(default_factory=set)

    def pick(self, place: str, guess: Any) -> Any:
        """Return a person's value of a place, or the guess."""
        if place in self.values:
            self.used.add(place)
            return self.values[place]
        return guess

    def has(self, place: str) -> bool:
        """Return whether a person has said it."""
        return place in self.values


def flat(data: Any, place: str = "") -> dict[str, Any]:
    """Leaves of a hand.yaml by place; fingers and joints by their names, lists of numbers or words whole."""
    out: dict[str, Any] = {}
    if isinstance(data, dict):
        for key, value in data.items():
            if place == "" and key in ("guessed", "source", "skin"):
                continue
            out |= flat(value, f"{place}.{key}" if place else str(key))
    elif isinstance(data, list) and data and all(isinstance(x, dict) and "name" in x for x in data):
        for x in data:
            out |= flat({k: v for k, v in x.items() if k != "name"}, f"{place}.{x['name']}")
    else:
        out[place] = data
    return out


def read(now: dict[str, Any], written: dict[str, Any], said: Iterable[str] = ()) -> Corrections:
    """Return what a person corrected. now: the file's content; written: what the importer wrote there (its content
    too); said: places that were a person's already then (back in `guessed` they are guesses again)."""
    before, here = flat(written), flat(now)
    guessed = set(map(str, now.get("guessed") or []))
    confirmed = (set(map(str, written.get("guessed") or [])) | set(said)) - guessed
    values = {}
    for place, value in here.items():
        changed = place not in before or not _same(before[place], value)
        if changed or any(place == c or place.startswith(c + ".") for c in confirmed):
            values[place] = value
    return Corrections(values)


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, (int, float)) and isinstance(b, (int, float)) and not isinstance(a, bool):
        return abs(a - b) <= 1e-9 * max(abs(a), abs(b), 1.0)
    if isinstance(a, list) and isinstance(b, list):
        return len(a) == len(b) and all(_same(x, y) for x, y in zip(a, b))
    return a == b


def lay_over(hand: dict[str, Any], fixes: Corrections) -> None:
    """Write what a person said and no step asked for (a rotor's inertia, `places`, a file of held poses) into the
    content of hand.yaml, in place. Whether it fits is for the hand's own checks."""
    for place, value in fixes.values.items():
        if place not in fixes.used and place != ORDER and _laid(hand, place, value):
            fixes.used.add(place)


def _laid(node: Any, place: str, value: Any) -> bool:
    """Return whether `place` was found below `node`, and given the value; names have dots of their own."""
    if isinstance(node, list):
        named = [x for x in node if isinstance(x, dict) and place.startswith(f"{x.get('name')}.")]
        named.sort(key=lambda x: -len(str(x["name"])))
        return any(_laid(x, place[len(str(x["name"])) + 1 :], value) for x in named)
    if not isinstance(node, dict):
        return False
    for key in sorted((k for k in node if place.startswith(f"{k}.")), key=lambda k: -len(k)):
        if node[key] is None:
            node[key] = {}
        if _laid(node[key], place[len(key) + 1 :], value):
            return True
    if place.partition(".")[0] in OPTIONAL:
        key, _, rest = place.partition(".")
        return _laid(node.setdefault(key, {}), rest, value)
    if "." in place and place not in node:
        return False
    node[place] = value
    return True


def written(folder: Path) -> dict[str, Any] | None:
    """Return what the importer noted in a folder: {"hand": content of hand.yaml, "files": SHA-256 by name}, None: no
    note."""
    try:
        data = files.mapping(folder / NOTE, "note")
    except UserError:
        return None
    return data if isinstance(data.get("hand"), dict) and isinstance(data.get("files"), dict) else None
