"""An elastic transmission, which may harden: torque = k x (1 + h x^2)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from dexsim.gap.effects.backlash import RINGS
from dexsim.gap.effects.effect import Effect, FittedEffect, Variant, entry, param
from dexsim.gap.plant.columns import Scales

if TYPE_CHECKING:
    from dexsim.gap.plant.case import Case


class Compliance(Effect):
    """An elastic transmission, which may harden: torque = k x (1 + h x^2)."""

    id = "compliance"
    words = "has an elastic transmission"
    shows = "at high load and at 5-30 Hz"
    experiment = "a chirp of 1-30 Hz"
    parts_motor = True
    demo = {"softness": 0.5}
    demo_on_motor = True

    def variants(self, s: Scales) -> list[Variant]:
        # not stiffer than a tenth of the loop's own spring is softness that leaves no trace
        top = 3.0 / s.stiffness
        soft = param("softness", "softness", "set", 0.04 / s.stiffness, top, 0.04 / s.stiffness, "rad/N.m")
        hard = param("hardening", "hardening", "set", 0.0, 8.0 / s.tau**2, 0.0, "1/(N.m)2")
        ring = param("rebound", "rebound", "set", 0.02, 0.7, 0.1)
        starts = tuple((0.4 / s.stiffness, 0.1, h / s.tau**2) for h in (0.1, 0.5, 2.5))
        sizes = tuple((f / s.stiffness, r) for f in (0.06, 0.1, 0.15, 0.25, 0.4, 0.65, 1.0, 1.7) for r in RINGS)
        return [Variant((soft, ring), sizes), Variant((soft, ring, hard), starts, "hardening", refines=True)]

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        return case.regimes["load"]

    def parameters(self, fit: FittedEffect) -> dict[str, Any]:
        value, (low, high) = fit.value["softness"], fit.interval["softness"]
        invert = lambda x: 1.0 / max(x, 1e-9)  # noqa: E731
        out = {"stiffness": entry(invert(value), invert(high), invert(low), f"{fit.force}/{fit.length}")}
        if "hardening" in fit.value:  # torque k x (1 + hardening x^2)
            out["hardening"] = fit.entry("hardening", f"1/{fit.length}2", times=invert(value) ** 2)
        return out
