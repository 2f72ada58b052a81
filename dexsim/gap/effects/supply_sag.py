"""A shared supply that drops while other joints load it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from dexsim.gap.effects.effect import Effect, FittedEffect, Variant, param
from dexsim.gap.plant.columns import Scales

if TYPE_CHECKING:
    from dexsim.gap.plant.case import Case


class SupplySag(Effect):
    """A shared supply that drops while other joints load it."""

    id = "supply_sag"
    words = "loses supply while other joints load it"
    shows = "while other joints work"
    experiment = "this joint moving alone, then with the others loaded"
    classes = ("drive weakens",)
    kinds = 2
    every_kind = True  # where limits are reached it takes slopes far beyond what they hold for

    def variants(self, s: Scales) -> list[Variant]:
        if not s.others or s.others_torque <= 0:
            return []
        top = 0.9 / s.others_torque
        sag = param(
            "sag", "sag", "set", 0.0, 1.5 * top, 0.0, "1/N.m"
        )  # at the others' peaks nothing of the supply may be left
        out = [Variant((sag,), tuple((f * top,) for f in (0.02, 0.05, 0.1, 0.2, 0.4, 0.7)))]
        if not s.voltage:
            # a drive that is described by torques but sets a voltage loses all of them with its supply, to itself too
            weak = param("sag", "sag_torque", "set", 0.0, 1.5 * top, 0.0, "1/N.m")
            most = 0.7 / max(s.tau, 1e-9)
            own = param("own", "sag_own", "set", 0.0, most, 0.0, "1/N.m")
            starts = tuple((f * top, min(f * top, 0.9 * most)) for f in (0.01, 0.03, 0.08, 0.2, 0.4))
            out.append(Variant((weak, own), starts, "gains and limits alike"))
        return out

    def unseen(self, s: Scales) -> str:
        if not s.others:
            return "no other joint moves, so none can load the supply"
        if s.others_torque <= 0:
            return "the other joints give no torque"
        return super().unseen(s)

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        return case.regimes.get("_others", case.regimes["speed"])

    def parameters(self, fit: FittedEffect) -> dict[str, Any]:
        keys = ["sag", *(["own"] if "own" in fit.value else [])]
        return {k: fit.entry(k, f"1/({fit.force})") for k in keys}
