"""Friction that grows with speed: b v."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from dexsim.gap.effects.effect import Effect, FittedEffect, Variant, param
from dexsim.gap.plant.columns import Scales

if TYPE_CHECKING:
    from dexsim.gap.plant.case import Case


class ViscousFriction(Effect):
    """Friction that grows with speed: b v."""

    id = "viscous_friction"
    words = "has friction that grows with speed"
    shows = "at high speed"
    experiment = "constant speeds from slow to fast"
    plain = ("viscous_friction",)
    classes = ("with speed",)
    motions = ("ladder",)

    def variants(self, s: Scales) -> list[Variant]:
        nominal, unit = s.nominal["viscous_friction"], s.tau / s.speed
        starts = [(nominal + f * unit,) for f in (0.02, 0.05, 0.1, 0.2, 0.4, 0.8)]
        if nominal > 0.03 * unit:
            starts.append((0.5 * nominal,))
        top = max(3 * unit, 4 * nominal)
        return [
            Variant((param("coefficient", "viscous_friction", "set", 0.0, top, nominal, "N.m.s/rad"),), tuple(starts))
        ]

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        return case.regimes["speed"]

    def parameters(self, fit: FittedEffect) -> dict[str, Any]:
        unit = f"{fit.force}.s/{fit.length}"
        return {"coefficient": fit.entry("coefficient", unit, add=fit.case.scales.base_damping)}
