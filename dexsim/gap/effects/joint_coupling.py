"""A joint that is dragged along by another: a tendon or a linkage."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from dexsim.gap.effects.effect import Effect, FittedEffect, Variant, param, word
from dexsim.gap.plant.columns import Scales

if TYPE_CHECKING:
    from dexsim.gap.plant.case import Case


class JointCoupling(Effect):
    """A joint that is dragged along by another: a tendon or a linkage."""

    id = "joint_coupling"
    words = "is dragged along by another joint"
    shows = "while that joint moves"
    experiment = "one joint at a time, the others held"
    kinds = 2
    from_poses = True
    couples = True

    def variants(self, s: Scales) -> list[Variant]:
        out = []
        for k, other in enumerate(s.others[:4]):
            fixed, note = (("coupling_from", float(k)),), {"from_joint": other}
            # its target is dragged along; a linkage between motor, joint and the other; the pull at its other end
            for column, label, starts in (
                ("coupling", other, (0.02, 0.15)),
                ("linkage", f"linkage with {other}", (0.05, 0.4)),
                ("reaction", f"pull of {other}", (0.1,)),
            ):
                p = param("ratio", column, "set", -1.0, 1.0)
                out.append(Variant((p,), tuple((sign * x,) for x in starts for sign in (-1, 1)), label, fixed, note))
        return out

    def unseen(self, s: Scales) -> str:
        return super().unseen(s) if s.others else "no other joint moves"

    def signal(self, case: Case, values: dict[str, float], note: dict) -> np.ndarray:
        others = list(case.scales.others)
        k = others.index(note["from_joint"]) if note.get("from_joint") in others else 0
        return np.abs(case.regimes.get(f"_drag{k}", case.regimes["speed"]))

    def parameters(self, fit: FittedEffect) -> dict[str, Any]:
        return {"ratio": fit.entry("ratio", "1"), "from_joint": word(fit.variant.note["from_joint"])}
