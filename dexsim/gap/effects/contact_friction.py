"""An object that slips at another friction than believed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from dexsim.gap.effects.effect import TouchEffect
from dexsim.gap.touch.plant import shear
from dexsim.gap.touch.result import PadSettings, fitted

if TYPE_CHECKING:
    from dexsim.gap.touch.read import PadRun
    from dexsim.gap.touch.search import TouchTrial


class ContactFriction(TouchEffect):
    """An object that slips at another friction than believed."""

    id = "contact_friction"
    words = "lets the object slip at another friction than believed"
    shows = "at the onset of slip"
    experiment = "slow sliding under several normal forces"
    fits = ("mu",)
    starts = ((0.6,), (1.5,))
    stage = "shear"
    report = (("mu", "mu"),)

    def changes(self, run: PadRun, t: TouchTrial, base: dict[str, float]) -> np.ndarray:
        return np.linalg.norm(shear(run, t.values) - shear(run, t.values | {"mu": 1.0}), axis=1)

    def hand_on(self, finding: dict[str, Any], pad: PadSettings, doubt: bool) -> str:
        pad.shared["object.friction"] = fitted(finding["parameters"]["mu"], pad.fact.friction if doubt else None)
        return ""
