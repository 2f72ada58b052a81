"""A column of the servo table, and a law of one's own: what an installed package adds to every drive, in training and
in the diagnosis (entry points of the group `dexsim.laws`, or law=MODULE:NAME; docs/howto/own_effect.md)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

from dexsim import door
from dexsim.errors import UserError

KINDS = ("dry_friction", "parasitic_torque")


@dataclass(frozen=True)
class Column:
    """One column: `neutral` is the value at which the effect is absent, `low`..`high` the values that are allowed,
    `usual` how far a strong one on a joint of a hand lies from neutral (where that is infinite: from 0), to each side
    that the limits leave: tests draw it so.

    feature: the part of the servo's kernel that has its law and is compiled in only where a drive asks for it; empty:
    all servos have it. asks: whether a value other than the neutral one asks for that part; False where the column says
    nothing without another one of it. encoder: it is part of what the encoder is off by (`ENCODER`). delays: it is part
    of a command's delay [s], at most what it says (`DELAYS`). remembers: the numbers that its law keeps from one step
    to the next (`MEMORY`), in units of its own; it needs a feature."""

    name: str
    unit: str
    neutral: float
    low: float
    high: float
    usual: float
    text: str
    feature: str = ""
    asks: bool = True
    encoder: bool = False
    delays: bool = False
    remembers: tuple[str, ...] = ()


@dataclass(frozen=True)
class Law:
    """A law of drives that a package brings.

    columns: the first is its size. kind: the sum that it is a term of, `dry_friction` (a level, N.m) or
    `parasitic_torque` (torque [N.m] and its slopes in position and speed). warp: a Warp function of (of, at, q, v) for
    float32 and float64: `of[at]` is its first column, `of[at + 1]` the next; q [rad], v [rad/s] of joint and motor.
    numpy: the same of (columns by name, q, v)."""

    kind: str
    columns: tuple[Column, ...]
    warp: Any
    numpy: Callable[..., Any]


@cache
def brought() -> dict[str, Law]:
    """Return the laws of installed packages by the names of their entry points, which are their features too. Raises
    UserError for one that is no law."""
    out: dict[str, Law] = {}
    for name, point in sorted(door.installed("dexsim.laws").items()):
        law = door.load(point.value, f"law {name} (entry point of dexsim.laws)")
        if not isinstance(law, Law) or law.kind not in KINDS or not law.columns:
            raise UserError(f"law {name}: {point.value} is no dexsim.actuator.law.Law of kind {' or '.join(KINDS)}")
        out[name] = replace(law, columns=tuple(replace(c, feature=name, asks=not k) for k, c in enumerate(law.columns)))
    return out


def of_kind(kind: str, features: Any) -> list[Law]:
    """Return those of a kind that these features ask for."""
    return [law for name, law in brought().items() if law.kind == kind and name in features]
