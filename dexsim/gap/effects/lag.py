"""A first-order lag of the drive's torque, or of the speed that its loop measures."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from dexsim.gap.effects.effect import Effect, FittedEffect, Variant, param
from dexsim.gap.plant.columns import Scales

if TYPE_CHECKING:
    from dexsim.gap.plant.case import Case


class Lag(Effect):
    """A first-order lag of the drive's torque, or of the speed that its loop measures."""

    id = "lag"
    words = "builds its torque up with a lag"
    shows = "at high acceleration"
    experiment = "steps and a fast chirp"
    classes = ("late",)
    motions = ("steps", "chirp")
    slows = True

    def variants(self, s: Scales) -> list[Variant]:
        out = [
            Variant(
                (param("time_constant", "lag", "set", 0.0, 0.3, s.nominal["lag"], "s"),),
                ((0.003,), (0.006,), (0.012,), (0.025,), (0.06,)),
                "drive",
            )
        ]
        if s.nominal["kd"] > 0:
            out.append(
                Variant(
                    (param("time_constant", "speed_lag", "set", 0.0, 0.3, 0.0, "s"),),
                    ((0.006,), (0.012,), (0.03,), (0.08,)),
                    "velocity filter",
                    note={"of": "speed"},
                )
            )
        return out

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        m = case.regimes
        return np.abs(m["_torque_rate"]) if note.get("of", "drive") == "drive" else m["acceleration"]

    def parameters(self, fit: FittedEffect) -> dict[str, Any]:
        return {"time_constant": fit.entry("time_constant", "s")}
