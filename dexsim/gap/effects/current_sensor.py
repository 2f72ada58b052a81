"""Gain, offset or lost sign of the reading of the current: the motion is unaffected."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from dexsim.gap.effects.effect import Effect, FittedEffect, Variant, param
from dexsim.gap.plant.columns import Scales

if TYPE_CHECKING:
    from dexsim.gap.plant.case import Case


class CurrentSensor(Effect):
    """Gain, offset or lost sign of the reading of the current: the motion is unaffected."""

    id = "current_sensor"
    words = "shows its effort with a wrong gain or offset"
    shows = "in the effort alone"
    experiment = "a hold under a known load"
    classes = ("static load",)
    effort_only = True

    def variants(self, s: Scales) -> list[Variant]:
        if not s.effort:
            return []
        gain = param("gain", "effort_gain", "set", -1.5, 3.0, 1.0)
        offset = param("offset", "effort_offset", "set", -s.tau, s.tau, 0.0, "N.m")
        return [Variant((gain, offset), ((0.7, 0.0), (1.3, 0.0), (1.0, 0.1 * s.tau), (1.0, -0.1 * s.tau), (-1.0, 0.0)))]

    def unseen(self, s: Scales) -> str:
        return super().unseen(s) if s.effort else "no effort is recorded (or current_per_torque is unknown)"

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        return np.abs((values.get("gain", 1.0) - 1) * case.regimes["_torque"] + values.get("offset", 0.0))

    def parameters(self, fit: FittedEffect) -> dict[str, Any]:
        out = {"gain": fit.entry("gain", "1")}
        per = fit.table.current([fit.case.joint])[0]
        known = bool(np.isfinite(per))
        return out | {"offset": fit.entry("offset", "A" if known else fit.force, times=per if known else 1.0)}
