"""What the steps of touch find out, for the next ones, the page and the files; and the settings of one pad as training
takes them."""

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


@dataclass
class PadCurve:
    """A held-out stretch of one pad: sums over its taxels [N] against t [s]; load: of the cell, or None."""

    pad: str
    recording: str
    t: np.ndarray
    measured: np.ndarray
    before: np.ndarray
    after: np.ndarray
    load: np.ndarray | None


@dataclass
class TouchResult:
    """findings as `diagnosis.json` has them; before, after: [N] held-out rms of the taxels' readings (of all judged
    pads) with 90 % intervals (value, low, high), None where no force could be predicted; floor [N]; error [F, K] N rms
    of each taxel before; structured: whether something is left that no effect explains; pads: by name (before, after,
    noise); names: of all pads [F]."""

    findings: list[dict[str, Any]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    before: tuple[float, float, float] | None = None
    after: tuple[float, float, float] | None = None
    floor: float | None = None
    error: np.ndarray | None = None
    structured: bool = False
    names: tuple[str, ...] = ()
    pads: dict[str, dict[str, float]] = field(default_factory=dict)
    curves: list[PadCurve] = field(default_factory=list)
    nuisance: dict[str, float] = field(default_factory=dict)
    recordings: list[str] = field(default_factory=list)
    depends_on: list[str] = field(default_factory=list)
    contact: dict[str, list[tuple[float, float]]] = field(default_factory=dict)  # by recording: stretches in touch, s
    tactile: bool = False  # whether taxels were recorded at all
    facts: dict[str, PadFacts] = field(
        default_factory=dict
    )  # by name of pad: what `handed_on` needs beside the findings


def wide(fit: Fit, believed: float | None) -> Fit:
    """A fit whose range also holds what was believed."""
    return fit if believed is None else (fit[0], min(fit[1], believed), max(fit[2], believed))


def instead(fit: Fit, believed: float) -> Fit:
    """What the other effect of a set would be in the place of the one named: best guess that it is not there, in a
    range that holds it."""
    return believed, min(fit[1], believed), max(fit[2], believed)


def fitted(p: dict[str, Any], believed: float | None, factor: float = 1.0) -> Fit:
    """(value, low, high) of a parameter, widened to what was believed (in the parameter's unit), times a factor."""
    value, low, high = (float(p[k]) for k in ("value", "low", "high"))
    return times((factor, factor, factor), wide((value, low, high), believed))


def times(a: Fit | None, b: Fit) -> Fit:
    """Products of values and of ends."""
    return b if a is None else (a[0] * b[0], a[1] * b[1], a[2] * b[2])


def ranged(fit: Fit, lowest: float, highest: float) -> dict[str, float]:
    """A fit as the file holds it, inside what is physical."""
    value, low, high = (float(f"{np.clip(x, lowest, highest):.6g}") for x in fit)
    return {"value": value, "low": min(low, value), "high": max(high, value)}
