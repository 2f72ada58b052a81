"""An encoder's scale error, or its eccentricity."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from dexsim.gap.effects.effect import Effect, FittedEffect, Variant, entry, param
from dexsim.gap.plant.columns import Scales

if TYPE_CHECKING:
    from dexsim.gap.plant.case import Case


class PositionScale(Effect):
    """An encoder's scale error, or its eccentricity."""

    id = "position_scale"
    words = "has an encoder that is not linear in the position"
    shows = "with the pose"
    experiment = "the full range against a protractor or the stops"
    misreads = True
    parts_motor = True

    def variants(self, s: Scales) -> list[Variant]:
        out = [
            Variant(
                (param("scale", "position_scale", "set", 0.7, 1.4, 1.0),),
                ((0.85,), (0.94,), (0.98,), (1.02,), (1.06,), (1.15,)),
                "scale",
            )
        ]
        if s.apart:  # of the encoder that reports alone: the loop does not know
            read = param("scale", "readout_scale", "set", 0.7, 1.4, 1.0)
            out.insert(0, Variant((read,), out[0].starts, "scale of the readout"))
        if not s.slide and s.span > 0.5:
            e = min(0.2, 0.3 * s.span)
            params = (
                param("ecc_sin", "eccentric_sin", "set", -e, e, 0.0, "rad"),
                param("ecc_cos", "eccentric_cos", "set", -e, e, 0.0, "rad"),
            )
            out.append(
                Variant(params, ((0.2 * e, 0.0), (-0.2 * e, 0.0), (0.0, 0.2 * e), (0.0, -0.2 * e)), "eccentricity")
            )
            # its zero may have been set anywhere along the turn, and not where the model has it
            params = (params[0], param("ecc_cos", ("eccentric_cos", "position_offset"), "add", -e, e, 0.0, "rad"))
            out.append(
                Variant(
                    params,
                    ((0.05 * e, 0.2 * e), (-0.05 * e, -0.2 * e), (0.2 * e, 0.2 * e), (-0.2 * e, 0.2 * e)),
                    "eccentricity, its zero elsewhere",
                    dear=0.08,
                )
            )
        return out

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        q = case.regimes["position"]
        if "scale" in values:
            return np.abs(q)
        return np.abs(values.get("ecc_sin", 0.0) * np.sin(q) + values.get("ecc_cos", 0.0) * (np.cos(q) - 1))

    def parameters(self, fit: FittedEffect) -> dict[str, Any]:
        if "scale" in fit.value:
            return {"scale": fit.entry("scale", "1")}
        size = np.hypot(fit.value["ecc_sin"], fit.value["ecc_cos"])
        half = 0.5 * max(np.ptp(fit.interval["ecc_sin"]), np.ptp(fit.interval["ecc_cos"]))
        return {"eccentricity": entry(size, max(size - half, 0.0), size + half, "rad")}

    def of_pose(self, values: dict[str, float], case: Case) -> bool:
        return True
