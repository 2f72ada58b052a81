"""Dry friction that gives way elastically before it slides."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from dexsim.gap.effects.effect import Effect, FittedEffect, Variant, param
from dexsim.gap.plant.columns import Scales

if TYPE_CHECKING:
    from dexsim.gap.plant.case import Case

GIVE, GIVE_SLIDE = 2e-3, 5e-5  # rad, m: by which any dry friction gives way; more is the effect


def give(s: Scales) -> float:
    """How far any dry friction may give way before it slides [rad or m]."""
    return GIVE_SLIDE if s.slide else GIVE


class Presliding(Effect):
    """Dry friction that gives way elastically before it slides.

    The share z of the friction that is taken up grows along the way: dz = (1 - z sign(dq)) dq / distance (P. Dahl
    1968).
    """

    id = "presliding"
    words = "gives way elastically before its dry friction slides"
    shows = "after reversals and in small motions"
    experiment = "slow reversals about a pose, from far below a degree up, without and with a load"
    classes = ("about a reversal",)
    motions = ("triangles",)

    def variants(self, s: Scales) -> list[Variant]:
        low = give(s)
        distance = param("distance", "presliding", "set", low, 50 * low, low, "m" if s.slide else "rad")
        return [Variant((distance,), tuple((f * low,) for f in (2.5, 6.0, 15.0, 35.0)))]

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        q, v, run = case.regimes["position"], case.regimes["_speed"], case.plant.run_of
        way = np.r_[0.0, np.abs(np.diff(q))]
        turned = np.r_[True, (np.sign(v[1:]) != np.sign(v[:-1])) | (run[1:] != run[:-1])]
        gone = np.cumsum(way)
        since = gone - np.maximum.accumulate(np.where(turned, gone, 0.0))
        return np.exp(-since / max(values.get("distance", give(case.scales)), 1e-12))

    def parameters(self, fit: FittedEffect) -> dict[str, Any]:
        return {"distance": fit.entry("distance", fit.length)}
