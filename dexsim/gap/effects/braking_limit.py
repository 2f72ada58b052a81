"""A torque limit that falls otherwise with speed while the drive brakes than while it drives."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from dexsim.gap.effects.effect import Effect, FittedEffect, Variant, param
from dexsim.gap.plant.columns import Scales

if TYPE_CHECKING:
    from dexsim.gap.plant.case import Case


class BrakingLimit(Effect):
    """A torque limit that falls otherwise with speed while the drive brakes than while it drives.

    Where torque and speed differ in sign it is tau0 max(0, 1 - slope |v| / no-load speed). Nameable where the servo's
    file states a slope; where it states none, nothing is believed of braking and the slope is refitted with every
    hypothesis.
    """

    id = "braking_limit"
    words = "brakes with another torque at speed than believed"
    shows = "at saturation while it slows down"
    experiment = "large steps to full speed that end in a stop, and the same with a smaller torque limit"
    classes = ("limits at speed",)
    motions = ("steps",)

    def variants(self, s: Scales) -> list[Variant]:
        believed = s.nominal["braking_slope"]
        if s.voltage or s.nominal["no_load_speed"] >= 1e8:
            return []
        slope = param("slope", "braking_slope", "set", -1.0, 1.0, believed)
        starts = tuple((x,) for x in (0.0, -0.9, 0.5, 0.9) if abs(x - believed) > 0.2)
        return [Variant((slope,), starts)]

    def unseen(self, s: Scales) -> str:
        if s.voltage:
            return "a drive by voltage brakes along the line that it drives along"
        return super().unseen(s) if s.nominal["no_load_speed"] < 1e8 else "no no-load speed is believed"

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        m, s = case.regimes, case.scales
        asked, v = m["_asked"], np.abs(m["_speed"]) / s.nominal["no_load_speed"]
        limits = (
            s.nominal["torque_limit"] * np.maximum(1 - x * v, 0) for x in (s.nominal["braking_slope"], values["slope"])
        )
        a, b = (np.clip(asked, -x, x) for x in limits)
        return np.where(asked * m["_speed"] < 0, np.abs(a - b), 0.0)

    def parameters(self, fit: FittedEffect) -> dict[str, Any]:
        return {"slope": fit.entry("slope", "1")}
