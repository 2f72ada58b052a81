"""Something outside that pushes: a contact, a person, a cable."""

from __future__ import annotations

from typing import Any

from dexsim.gap.effects.effect import Effect, FittedEffect, Variant
from dexsim.gap.plant.columns import Scales


class ExternalForce(Effect):
    """Something outside that pushes: a contact, a person, a cable.

    It is no state of the joint, so no law of the plant has it: it is named where the recorded motor torque does not fit
    the body at all, in stretches of time.
    """

    id = "external_force"
    words = "is pushed by something outside: a contact, a person, a cable"
    shows = "in stretches of time, whatever the joint does"
    experiment = "the same commands again with nothing in reach and no cable pulled"
    classes = ("weight or push",)
    motions = ("holds",)
    simulated = False

    def variants(self, s: Scales) -> list[Variant]:
        return []

    def unseen(self, s: Scales) -> str:
        return "" if s.effort else "no motor torque is recorded, without which a push is not told from a missing law"

    def parameters(self, fit: FittedEffect) -> dict[str, Any]:
        return {"torque": fit.entry("torque", fit.force)}
