"""A spring at the joint that the model lacks: a return spring, a cable or a cover that pulls it home."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from dexsim.gap.effects.effect import Effect, FittedEffect, Variant, entry, param
from dexsim.gap.plant.columns import Scales

if TYPE_CHECKING:
    import mujoco

    from dexsim.gap.plant.case import Case

STIFFEST = 12.0  # x the joint's large torque over its range of motion: stiffer, it would hardly have moved


class JointSpring(Effect):
    """A spring at the joint that the model lacks: torque -(stiffness * q + preload), as MuJoCo's joint stiffness with
    springref = -preload / stiffness."""

    id = "joint_spring"
    words = "is pulled towards a position by a spring that the model lacks"
    shows = "with the position, also at rest"
    experiment = "static poses over the whole range, and the drive off at each"
    classes = ("static load",)
    motions = ("holds",)
    from_poses = True
    model_columns = ("spring", "spring_preload")

    def variants(self, s: Scales) -> list[Variant]:
        unit = s.tau / s.span
        if s.stiffness > unit:
            return []
        stiffness = param("stiffness", "spring", "set", 0.0, STIFFEST * unit, 0.0, "N/m" if s.slide else "N.m/rad")
        preload = param("preload", "spring_preload", "set", -2.0 * s.tau, 2.0 * s.tau, 0.0, "N" if s.slide else "N.m")
        starts = ((0.1, 0.0), (0.3, 0.0), (0.3, 0.2), (0.3, -0.2), (0.8, 0.0), (0.8, 0.4), (0.8, -0.4), (1.6, 0.0))
        return [Variant((stiffness, preload), tuple((k * unit, p * s.tau) for k, p in starts))]

    def unseen(self, s: Scales) -> str:
        return "" if self.variants(s) else (
            "its loop holds the joint stiffer than a spring that it can work against, and gains and gravity within "
            "their tolerance do what a spring would"
        )

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        return np.abs(values["stiffness"] * case.regimes["position"] + values["preload"])

    def parameters(self, fit: FittedEffect) -> dict[str, Any]:
        out = {
            "stiffness": fit.entry("stiffness", f"{fit.force}/{fit.length}"),
            "preload": fit.entry("preload", fit.force),
        }
        k, at = fit.value["stiffness"], fit.value["preload"]
        if fit.interval["stiffness"][0] > 0:
            ends = [-p / c for c in fit.interval["stiffness"] for p in fit.interval["preload"]]
            out["rest"] = entry(-at / k, min(ends), max(ends), fit.length)
        return out

    def of_pose(self, values: dict[str, float], case: Case) -> bool:
        return True

    def to_model(self, spec: mujoco.MjSpec, case: Case, values: dict[str, float], note: dict) -> list[str]:
        joint, k = spec.joint(case.joint), values["stiffness"]
        if k <= 0:
            return []
        had = float(np.ravel(joint.stiffness)[0])
        # angles of the file may be in degrees
        unit = 180 / np.pi if spec.compiler.degree and not case.scales.slide else 1.0
        rest = (had * float(joint.springref) / unit - values["preload"]) / (had + k)
        joint.springref = rest * unit
        # the first of a polynomial's coefficients where MuJoCo has several
        joint.stiffness = [had + k, *np.ravel(joint.stiffness)[1:]] if np.size(joint.stiffness) > 1 else had + k
        return [f"model.xml: stiffness of {case.joint} is {had + k:.3g}, its springref {rest:.3g}"]
