"""A no-load speed below the believed one."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from dexsim.gap.effects.effect import Effect, FittedEffect, Variant, param
from dexsim.gap.effects.torque_limit import lost
from dexsim.gap.plant.columns import Scales

if TYPE_CHECKING:
    from dexsim.gap.plant.case import Case


class TorqueSpeedLimit(Effect):
    """A no-load speed below the believed one."""

    id = "torque_speed_limit"
    words = "runs out of torque at a lower speed than believed"
    shows = "at high speed and torque"
    experiment = "large steps at full speed"
    classes = ("with speed", "drive weakens", "limits at speed")
    motions = ("ladder", "steps")

    def variants(self, s: Scales) -> list[Variant]:
        believed = s.nominal["no_load_speed"]
        top = min(believed, 30 * s.peak_speed)
        low = min(0.3 * s.peak_speed, 0.8 * top)
        speed = param("no_load_speed", "no_load_speed", "set", low, top, top, "rad/s")
        starts = [
            x
            for x in (
                0.7 * s.peak_speed,
                0.9 * s.peak_speed,
                1.1 * s.peak_speed,
                1.6 * s.peak_speed,
                2.3 * s.peak_speed,
                3.5 * s.peak_speed,
                0.9 * believed,
                0.8 * believed,
                0.65 * believed,
            )
            if low < x < top
        ]
        return [Variant((speed,), tuple((x,) for x in starts))] if starts else []

    def unseen(self, s: Scales) -> str:
        return "" if self.variants(s) else "it moves far too slowly for its no-load speed"

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        s = case.scales
        return lost(s, case.regimes, s.nominal["torque_limit"], values.get("no_load_speed", s.peak_speed))

    def parameters(self, fit: FittedEffect) -> dict[str, Any]:
        return {"no_load_speed": fit.entry("no_load_speed", f"{fit.length}/s")}
