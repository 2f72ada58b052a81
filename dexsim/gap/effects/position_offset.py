"""An encoder's zero error."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from dexsim.gap.effects.effect import Effect, FittedEffect, Variant, param
from dexsim.gap.plant.scales import Scales

if TYPE_CHECKING:
    from dexsim.gap.plant.case import Case


class PositionOffset(Effect):
    """An encoder's zero error."""

    id = "position_offset"
    words = "has an encoder zero error"
    shows = "with the pose"
    experiment = "static poses over the whole range"
    classes = ("zero or gravity",)
    motions = ("holds",)
    misreads = True

    def variants(self, s: Scales) -> list[Variant]:
        if s.gravity < 0.02 * s.tau:
            return []
        p = param("offset", "position_offset", "add", -0.6, 0.6, 0.0, "m" if s.slide else "rad")
        return [Variant((p,), ((-0.2,), (-0.07,), (-0.02,), (0.02,), (0.07,), (0.2,)))]

    def unseen(self, s: Scales) -> str:
        return "" if self.variants(s) else "gravity hardly acts on the joint, so its zero leaves no trace"

    def parameters(self, fit: FittedEffect) -> dict[str, Any]:
        return {"offset": fit.entry("offset", fit.length)}

    def of_pose(self, values: dict[str, float], case: Case) -> bool:
        return True
