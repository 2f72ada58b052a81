"""A stall torque, or a clamp of the current, below the believed one."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from dexsim.gap.effects.effect import Effect, FittedEffect, Variant, param
from dexsim.gap.plant.columns import Scales

if TYPE_CHECKING:
    from dexsim.gap.plant.case import Case


class TorqueLimit(Effect):
    """A stall torque, or a clamp of the current, below the believed one."""

    id = "torque_limit"
    words = "gives less torque than believed when it saturates"
    shows = "at saturation"
    experiment = "large steps against a load"
    plain = ("torque_limit",)

    def variants(self, s: Scales) -> list[Variant]:
        believed = s.nominal["torque_limit"]
        # one in a thousand moments asks for far more than the rest, and it is there that a limit shows
        top = min(believed, 8 * s.demand)
        low = 0.05 * s.demand
        if top <= low or s.voltage:
            top = believed * 1.0
        limit = param("torque", "torque_limit", "set", min(low, 0.5 * top), top, top, "N.m")
        sizes = [f * min(s.demand, believed) for f in (0.95, 0.88, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2)] + [
            f * top for f in (0.9, 0.78, 0.65, 0.5, 0.35)
        ]
        starts = sorted({round(max(x, 1.05 * low), 12) for x in sizes if x < top}, reverse=True)
        return [Variant((limit,), tuple((x,) for x in starts))] if starts else []

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        s = case.scales
        return lost(s, case.regimes, values.get("torque", s.demand), s.nominal["no_load_speed"])

    def parameters(self, fit: FittedEffect) -> dict[str, Any]:
        return {"torque": fit.entry("torque", fit.force)}


def lost(s: Scales, m: dict[str, np.ndarray], limit: float, no_load_speed: float) -> np.ndarray:
    """[n] torque that the drive would give by its believed limits and does not give by these."""
    asked, v = m["_asked"], m["_speed"]

    def give(most: float, fastest: float) -> np.ndarray:
        most = min(most, 1e9)
        if s.voltage:
            return most * (np.clip(asked, -1, 1) - v / fastest)
        edge = most * np.maximum(1 - np.abs(v) / fastest, 0)
        return np.clip(asked, -edge, edge)

    return np.abs(give(s.nominal["torque_limit"], s.nominal["no_load_speed"]) - give(limit, no_load_speed))
