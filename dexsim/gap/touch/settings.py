"""Settings of one pad as training takes them: what is written of a finding, and what is known beside the findings."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dexsim.gap.touch.read import FRICTION, STIFFNESS

Fit = tuple[float, float, float]  # value, low, high


@dataclass
class PadFacts:
    """Of a judged pad, beside its findings: silent: constant taxels and their reading [N] (0: dead); common: gain of
    all its taxels; rest: of those that a map of single gains does not name; chord: contact stiffness [N/m] that stands
    for a fitted rubber; warmest: where a drift ends (degC above the coldest, or s); stiffness [N/m], friction: what was
    believed; slid: whether friction could be judged."""

    silent: dict[int, float] = field(default_factory=dict)
    common: Fit | None = None
    rest: Fit | None = None
    chord: Fit | None = None
    warmest: float = 0.0
    stiffness: float = STIFFNESS
    friction: float = FRICTION
    slid: bool = False
    judged: bool = True


@dataclass
class PadSettings:
    """What is written of one pad: its facts; values: by key of `tactile.yaml`'s pads; shared: settings of the whole
    world (`object.friction`, `contact.stiffness`) by name, as this pad has them."""

    fact: PadFacts
    values: dict[str, Any] = field(default_factory=dict)
    shared: dict[str, Fit] = field(default_factory=dict)


def wide(fit: Fit, believed: float | None) -> Fit:
    """A fit whose range also holds what was believed."""
    return fit if believed is None else (fit[0], min(fit[1], believed), max(fit[2], believed))


def instead(fit: Fit, believed: float) -> Fit:
    """What the other effect of a set would be in the place of the one named: best guess that it is not there, in a
    range that holds it."""
    return believed, min(fit[1], believed), max(fit[2], believed)


def fitted(p: dict[str, Any], believed: float | None, factor: float = 1.0) -> Fit:
    """(value, low, high) of a parameter, widened to what was believed (in the parameter's unit), times a factor."""
    return times((factor,) * 3, wide(tuple(float(p[k]) for k in ("value", "low", "high")), believed))


def times(a: Fit | None, b: Fit) -> Fit:
    """Products of values and of ends."""
    return b if a is None else (a[0] * b[0], a[1] * b[1], a[2] * b[2])


def ranged(fit: Fit, lowest: float, highest: float) -> dict[str, float]:
    """A fit as the file holds it, inside what is physical."""
    value, low, high = (float(f"{np.clip(x, lowest, highest):.6g}") for x in fit)
    return {"value": value, "low": min(low, value), "high": max(high, value)}
