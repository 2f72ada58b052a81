"""Friction that grows with the torque that a gear transmits, more or less where the load drives it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from dexsim.gap.effects.effect import SLOW, Effect, FittedEffect, Variant, param
from dexsim.gap.plant.columns import Scales

if TYPE_CHECKING:
    from dexsim.gap.plant.case import Case


class LoadFriction(Effect):
    """Friction that grows with the torque that a gear transmits, more or less where the load drives it."""

    id = "load_friction"
    words = "has friction that grows with the load on its gear"
    shows = "at high load"
    experiment = "the same slow motion under two or more loads"
    classes = ("friction and load",)
    motions = ("triangles", "holds")
    demo = {"load_friction": 0.25, "load_friction_backdriven": 0.25}

    def variants(self, s: Scales) -> list[Variant]:
        drive = param("fraction", "load_friction", "set", 0.0, 0.95, s.nominal["load_friction"])
        back = param(
            "fraction_backdriven", "load_friction_backdriven", "set", 0.0, 3.0, s.nominal["load_friction_backdriven"]
        )
        return [Variant((drive, back), ((0.04, 0.05), (0.1, 0.12), (0.2, 0.25), (0.35, 0.35), (0.3, 0.8)))]

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        return np.abs(case.regimes["_load"]) * (case.regimes["speed"] > SLOW * case.scales.speed).astype(float)

    def parameters(self, fit: FittedEffect) -> dict[str, Any]:
        return {k: fit.entry(k, "1") for k in ("fraction", "fraction_backdriven")}
