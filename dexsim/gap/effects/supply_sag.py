"""A shared supply that drops while other joints load it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from dexsim.gap.effects.effect import Effect, FittedEffect, Variant, param
from dexsim.gap.plant.scales import Scales

if TYPE_CHECKING:
    from dexsim.gap.plant.case import Case


class SupplySag(Effect):
    """A shared supply that drops while other joints load it."""

    id = "supply_sag"
    words = "loses supply while other joints load it"
    shows = "while other joints work"
    experiment = "this joint moving alone, then with the others loaded"
    classes = ("drive weakens",)

    def variants(self, s: Scales) -> list[Variant]:
        if not s.others or s.others_torque <= 0:
            return []
        top = 0.9 / s.others_torque
        sag = param(
            "sag", "sag", "set", 0.0, 1.5 * top, 0.0, "1/N.m"
        )  # at the others' peaks nothing of the supply may be left
        return [Variant((sag,), tuple((f * top,) for f in (0.02, 0.05, 0.1, 0.2, 0.4, 0.7)))]

    def unseen(self, s: Scales) -> str:
        if not s.others:
            return "no other joint moves, so none can load the supply"
        if s.others_torque <= 0:
            return "the other joints give no torque"
        return super().unseen(s)

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        return case.regimes.get("_others", case.regimes["speed"])

    def parameters(self, fit: FittedEffect) -> dict[str, Any]:
        return {"sag": fit.entry("sag", f"1/({fit.force})")}
