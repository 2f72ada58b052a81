"""Another inertia of the rotor or the link than the model's."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from dexsim.gap.effects.effect import Effect, FittedEffect, Variant, param
from dexsim.gap.plant.columns import Scales

if TYPE_CHECKING:
    import mujoco

    from dexsim.gap.plant.case import Case


class Inertia(Effect):
    """Another inertia of the rotor or the link than the model's."""

    id = "inertia"
    words = "has more (or less) inertia than the model"
    shows = "at high acceleration"
    experiment = "steps and a fast chirp"
    motions = ("chirp",)
    from_poses = True
    slows = True
    model_columns = ("armature",)

    def variants(self, s: Scales) -> list[Variant]:
        p = param("armature", "armature", "add", -0.7 * s.inertia, 6.0 * s.inertia, 0.0, "kg" if s.slide else "kg.m2")
        return [Variant((p,), tuple((f * s.inertia,) for f in (0.08, 0.2, 0.5, 1.2, 3.0, -0.1, -0.3)))]

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        return case.regimes["acceleration"]

    def parameters(self, fit: FittedEffect) -> dict[str, Any]:
        return {"armature": fit.entry("armature", "kg" if fit.case.scales.slide else "kg.m2")}

    def said(self, finding: dict[str, Any], believed: dict[str, float]) -> str:
        return self.words.replace(
            "more (or less)", "more" if finding["parameters"]["armature"]["value"] > 0 else "less"
        )

    def to_model(self, spec: mujoco.MjSpec, case: Case, values: dict[str, float], note: dict) -> list[str]:
        joint = spec.joint(case.joint)
        armature = float(np.ravel(joint.armature)[0]) + values["armature"]
        if armature >= 0:
            joint.armature = armature
            return [f"model.xml: armature of {case.joint} is {armature:.3g}"]
        return [
            f"{case.joint} has {-values['armature']:.3g} kg.m2 less inertia than the model's links and armature "
            "together; change its links' inertia"
        ]
