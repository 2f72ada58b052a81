"""Cogging and gear eccentricity: a torque that repeats with the position."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from dexsim.gap.effects.effect import Effect, FittedEffect, Variant, param
from dexsim.gap.plant.columns import Scales

if TYPE_CHECKING:
    from dexsim.gap.plant.case import Case

SAWTOOTH = (("rising sawtooth", (("ripple_shape", 1.0),)), ("falling sawtooth", (("ripple_shape", -1.0),)))


class TorqueRipple(Effect):
    """Cogging and gear eccentricity: a torque that repeats with the position."""

    id = "torque_ripple"
    words = "has a torque ripple that repeats with position"
    shows = "periodically in position"
    experiment = "slow constant speed over the whole range"
    kinds = 2

    def variants(self, s: Scales) -> list[Variant]:
        out = []
        for turns in (1, 2, 3, 4, 5, 6, 7, 8, 10, 12, 14, 16, 18, 20, 24, 28, 32, 36, 42, 48, 56, 64, 80, 100):
            period = 2 * np.pi / turns
            if not s.slide and 1.2 * s.span > period > 6 * s.sigma:
                params = (
                    param("amplitude", "torque_ripple", "set", 0.0, 1.2 * s.tau, 0.0, "N.m"),
                    # a gear's own periods are whole numbers a turn of the joint; those of a motor before it are many,
                    # and ranges overlap
                    param(
                        "per_turn",
                        "ripple_per_turn",
                        "set",
                        turns * (0.98 if turns < 8 else 0.85),
                        turns * (1.02 if turns < 8 else 1.17),
                        turns,
                    ),
                    param("phase", "ripple_phase", "set", -6.3, 6.3, 0.0, "rad"),
                )
                a = 0.1 * s.tau
                starts = tuple((a, float(turns), ph) for ph in (0.0, np.pi / 2, np.pi, -np.pi / 2))
                out.append(Variant(params, starts, f"{turns} a turn", laws=SAWTOOTH))
        return out

    def unseen(self, s: Scales) -> str:
        if self.variants(s):
            return ""
        return (
            "it slides and has no turn"
            if s.slide
            else f"it moves over {s.span:.2g} rad, less than a period of any gear"
        )

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        return np.abs(np.sin(values.get("per_turn", 1) * case.regimes["position"] + values.get("phase", 0.0)))

    def parameters(self, fit: FittedEffect) -> dict[str, Any]:
        return {"amplitude": fit.entry("amplitude", fit.force), "per_turn": fit.entry("per_turn", "1")}

    def of_pose(self, values: dict[str, float], case: Case) -> bool:
        return 2 * np.pi / max(values["per_turn"], 1e-9) > 0.5 * case.scales.span  # less than two periods show
