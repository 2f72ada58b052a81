"""Free play between motor and joint."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from dexsim.gap.effects.effect import Effect, FittedEffect, Variant, param
from dexsim.gap.plant.columns import Param, Scales

if TYPE_CHECKING:
    from dexsim.gap.plant.case import Case

RINGS = (0.1, 0.3)  # damping ratios of a transmission that are tried: whether a loop rattles with it hangs on them


class Backlash(Effect):
    """Free play between motor and joint."""

    id = "backlash"
    words = "has free play between motor and joint"
    shows = "when the load changes sign"
    experiment = "small steps about a pose without load, both encoders logged if there are two"
    classes = ("friction or play", "about a reversal")
    motions = ("triangles", "chirp")
    parts_motor = True
    demo = {"backlash": 0.06}
    demo_on_motor = True

    def variants(self, s: Scales) -> list[Variant]:
        top = min(0.5 * s.span, 60 * s.error + 30 * s.sigma)
        low = min(3.0 * s.sigma, 0.1 * top)  # less cannot be told from the plant's own inaccuracy
        gap = param("gap", "backlash", "set", low, top, low, "m" if s.slide else "rad")
        starts = sorted({min(f * s.sigma, 0.8 * top) for f in (4.0, 7.0, 12.0, 20.0, 40.0, 70.0, 120.0)})
        rebound = param("rebound", "rebound", "set", 0.02, 0.7, 0.1)
        params: tuple[Param, ...] = (gap, rebound)
        extra: tuple[float, ...] = ()
        if s.armature <= 0:  # how much of the inertia is the rotor's is not known
            params, extra = (
                (*params, param("rotor", "rotor", "set", 0.05 * s.inertia, 0.95 * s.inertia, 0.3 * s.inertia)),
                (0.3 * s.inertia,),
            )
        return [Variant(params, tuple((x, ring, *extra) for x in starts for ring in RINGS))]

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        return near_sign_change(case, case.regimes["_load"] + case.regimes["_friction"], 0.04)

    def parameters(self, fit: FittedEffect) -> dict[str, Any]:
        return {"gap": fit.entry("gap", fit.length)}


def near_sign_change(case: Case, x: np.ndarray, seconds: float) -> np.ndarray:
    """[n] 1 about where x [n] changes sign within a run: a quarter of `seconds` before, the rest after."""
    t, run = case.plant.t, case.plant.run_of
    out = np.zeros(len(t))
    change = np.flatnonzero((np.sign(x[1:]) != np.sign(x[:-1])) & (run[1:] == run[:-1]))
    for i in change:
        j = (
            np.searchsorted(t[case.plant.rows(int(run[i]))], [t[i] - 0.25 * seconds, t[i] + 0.75 * seconds])
            + case.plant.rows(int(run[i])).start
        )
        out[j[0] : j[1] + 1] = 1.0
    return out
