"""A firmware that ignores small position errors."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from dexsim.gap.effects.effect import Effect, FittedEffect, Variant, param
from dexsim.gap.plant.columns import Scales

if TYPE_CHECKING:
    from dexsim.gap.plant.case import Case


class Deadband(Effect):
    """A firmware that ignores small position errors."""

    id = "deadband"
    words = "ignores small position errors"
    shows = "at small errors"
    experiment = "small steps of increasing size"
    demo = {"deadband": 0.03}

    def variants(self, s: Scales) -> list[Variant]:
        top = max(2.5 * s.error, 6 * s.sigma)
        p = param("width", "deadband", "set", 0.0, top, 0.0, "m" if s.slide else "rad")
        starts = tuple((f * top,) for f in (0.01, 0.02, 0.04, 0.07, 0.12, 0.2, 0.3, 0.45, 0.65))
        kinds = (("no torque inside", 0.0), ("damped inside", 1.0), ("counted from its edge", 2.0))
        return [
            Variant((p,), starts, label, (("deadband_kind", k),))
            for label, k in kinds
            if k != 1.0 or s.nominal["kd"] > 0
        ]

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        return (case.regimes["position error"] < values.get("width", 0.0)).astype(float)

    def parameters(self, fit: FittedEffect) -> dict[str, Any]:
        return {"width": fit.entry("width", fit.length)}
