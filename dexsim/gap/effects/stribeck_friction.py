"""Breakaway friction above the sliding level: peak exp(-|v / v_s|^n) sign(v), n 2 or 1."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from dexsim.gap.effects.effect import SLOW, Effect, FittedEffect, Variant, param
from dexsim.gap.plant.columns import Scales

if TYPE_CHECKING:
    from dexsim.gap.plant.case import Case


class StribeckFriction(Effect):
    """Breakaway friction above the sliding level: peak exp(-|v / v_s|^n) sign(v), n 2 or 1."""

    id = "stribeck_friction"
    words = "needs a breakaway torque above its sliding friction"
    shows = "at speeds between zero and v_s"
    experiment = "very slow ramps from rest, and the same faster"
    classes = ("friction or play",)
    motions = ("triangles", "ladder")
    demo = {"stribeck_peak": 0.06, "stribeck_speed": 0.25}

    def variants(self, s: Scales) -> list[Variant]:
        peak = param("peak", "stribeck_peak", "set", 0.0, 1.2 * s.demand, 0.0, "N.m")
        v_s = param("v_s", "stribeck_speed", "set", 0.003 * s.speed, 0.35 * s.speed, 0.1 * s.speed, "rad/s")
        starts = tuple((a * s.tau, b * s.speed) for a in (0.03, 0.08, 0.2, 0.45) for b in (0.02, 0.08, 0.25))
        return [Variant((peak, v_s), starts, laws=(("exponential in speed", (("stribeck_exponent", 1.0),)),))]

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        m, s = case.regimes, case.scales
        v = m["speed"]
        near = np.exp(-((v / max(values.get("v_s", 0.1 * s.speed), 1e-6)) ** 2))
        return near * ((v > 0.2 * (SLOW * s.speed)) | (np.abs(m["_torque"]) > 0))

    def parameters(self, fit: FittedEffect) -> dict[str, Any]:
        return {"peak": fit.entry("peak", fit.force), "v_s": fit.entry("v_s", f"{fit.length}/s")}
