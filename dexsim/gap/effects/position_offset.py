"""An encoder's zero error."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from dexsim.gap.effects.effect import Effect, FittedEffect, Variant, param
from dexsim.gap.plant.columns import Scales

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
        if s.gravity < 0.02 * s.tau and not s.apart:  # a loop's own encoder alone turns all, and gravity alone tells
            return []
        p = param("offset", "position_offset", "add", -0.6, 0.6, 0.0, "m" if s.slide else "rad")
        starts = ((-0.2,), (-0.07,), (-0.02,), (0.02,), (0.07,), (0.2,))
        if s.apart:  # of the encoder that reports, or of the loop's own as well
            read = param("offset", "readout_offset", "add", -0.6, 0.6, 0.0, "m" if s.slide else "rad")
            return [Variant((read,), starts, "readout"), Variant((p,), starts, "both encoders")]
        return [Variant((p,), starts)]

    def unseen(self, s: Scales) -> str:
        return "" if self.variants(s) else "gravity hardly acts on the joint, so its zero leaves no trace"

    def parameters(self, fit: FittedEffect) -> dict[str, Any]:
        return {"offset": fit.entry("offset", fit.length)}

    def of_pose(self, values: dict[str, float], case: Case) -> bool:
        return True
