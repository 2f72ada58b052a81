"""A firmware that runs on other gains than believed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from dexsim.gap.effects.effect import Effect, FittedEffect, Variant, param
from dexsim.gap.plant.columns import Scales

if TYPE_CHECKING:
    from dexsim.gap.plant.case import Case


class GainMismatch(Effect):
    """A firmware that runs on other gains than believed."""

    id = "gain_mismatch"
    words = "runs on other gains than believed"
    shows = "with the size of the error"
    experiment = "steps of several sizes against a known load"
    plain = ("kp", "kd")
    classes = ("with speed", "static load", "loop")
    motions = ("steps", "holds")

    def variants(self, s: Scales) -> list[Variant]:
        params = [param("kp_factor", "kp", "factor", 0.25, 4.0, 1.0)]
        starts: list[tuple[float, ...]] = [(0.6,), (0.8,), (0.91,), (1.1,), (1.3,), (1.7,)]
        if s.nominal["kd"] > 0:
            params.append(param("kd_factor", "kd", "factor", 0.1, 6.0, 1.0))
            starts = [*((x[0], 1.0) for x in starts), (1.0, 0.5), (1.0, 0.8), (1.0, 1.25), (1.0, 1.8), (1.0, 3.0)]
        return [Variant(tuple(params), tuple(starts))]

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        m, believed = case.regimes, case.scales.nominal  # the torque that the other gains make more or less
        more = (values.get("kp_factor", 1.0) - 1) * believed["kp"] * m["_error"]
        return np.abs(more - (values.get("kd_factor", 1.0) - 1) * believed["kd"] * m["_speed"])

    def parameters(self, fit: FittedEffect) -> dict[str, Any]:
        return {k: fit.entry(k, "1") for k in fit.value}
