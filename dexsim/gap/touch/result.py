"""What the steps of touch find out, for the next ones, the page and the files."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dexsim.gap.touch.settings import PadFacts


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
    noise)."""

    findings: list[dict[str, Any]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    before: tuple[float, float, float] | None = None
    after: tuple[float, float, float] | None = None
    floor: float | None = None
    error: np.ndarray | None = None
    structured: bool = False
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
