"""A transport delay of the commands beyond what is believed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from dexsim.gap.effects.effect import Effect, FittedEffect, Variant, param
from dexsim.gap.plant.columns import Scales

if TYPE_CHECKING:
    from dexsim.gap.plant.case import Case


class CommandDelay(Effect):
    """A transport delay of the commands beyond what is believed."""

    id = "command_delay"
    words = "acts on its commands later than believed"
    shows = "in proportion to speed"
    experiment = "steps and a fast chirp"
    plain = ("delay",)
    classes = ("late",)
    motions = ("steps", "chirp")
    slows = True
    jitters = True
    demo = {"delay": 0.02}

    def variants(self, s: Scales) -> list[Variant]:
        delay = param("delay", "delay", "add", -s.nominal["delay"], 0.2, 0.0, "s")
        return [Variant((delay,), ((0.003,), (0.006,), (0.012,), (0.02,), (0.035,), (0.08,)))]

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        return np.abs(case.regimes["_command_rate"])

    def parameters(self, fit: FittedEffect) -> dict[str, Any]:
        return {"delay": fit.entry("delay", "s")}
