"""Dry friction: tau_f sign(v), which may differ by direction."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from dexsim.gap.effects.effect import SLOW, Effect, FittedEffect, Variant, param
from dexsim.gap.plant.columns import Scales

if TYPE_CHECKING:
    from dexsim.gap.plant.case import Case


class CoulombFriction(Effect):
    """Dry friction: tau_f sign(v), which may differ by direction."""

    id = "coulomb_friction"
    words = "has more (or less) dry friction than believed"
    shows = "at reversals and low speed"
    experiment = "slow triangles in both directions at constant load"
    plain = ("coulomb_friction",)
    classes = ("friction or play", "friction and load")
    motions = ("triangles", "steps")
    fitted_anyway = {"coulomb_friction": "torque"}
    demo = {"coulomb_friction": 0.06}

    def variants(self, s: Scales) -> list[Variant]:
        nominal = s.nominal["coulomb_friction"]
        top = max(1.2 * s.demand, 3 * nominal, 1e-9)
        torque = param("torque", "coulomb_friction", "set", 0.0, top, nominal, "N.m")
        asymmetry = param("asymmetry", "friction_asymmetry", "set", -1.5, 1.5)
        starts = [(nominal + f * s.tau, 0.0) for f in (0.015, 0.03, 0.06, 0.12, 0.22, 0.4)]
        if nominal > 0.02 * s.tau:
            starts.append((0.5 * nominal, 0.0))
        starts += [(nominal + 0.1 * s.tau, 0.8), (nominal + 0.1 * s.tau, -0.8)]
        return [Variant((torque, asymmetry), tuple(starts))]

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        return (case.regimes["speed"] > SLOW * case.scales.speed).astype(float)

    def parameters(self, fit: FittedEffect) -> dict[str, Any]:
        out = {"torque": fit.entry("torque", fit.force, add=fit.case.scales.base_friction)}
        return out | {"asymmetry": fit.entry("asymmetry", "1")}

    def said(self, finding: dict[str, Any], believed: dict[str, float]) -> str:
        more = finding["parameters"]["torque"]["value"] > believed["coulomb_friction"] if believed else None
        return self.words if more is None else self.words.replace("more (or less)", "more" if more else "less")
