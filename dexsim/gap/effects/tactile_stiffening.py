"""A rubber that stiffens as it is pressed in: a Mooney-Rivlin foundation under every taxel."""

from __future__ import annotations

from typing import Any

from dexsim.gap.effects.effect import TouchEffect
from dexsim.gap.touch.plant import THICKNESS
from dexsim.gap.touch.result import PadSettings, fitted, ranged, wide
from dexsim.tactile.pads import PAD_COLUMNS


class TactileStiffening(TouchEffect):
    """A rubber that stiffens as it is pressed in: a Mooney-Rivlin foundation under every taxel."""

    id = "tactile_stiffening"
    words = "has a rubber that stiffens as it is pressed in"
    shows = "at high force"
    experiment = "presses to several depths against a load cell"
    fits = ("c10", "c01")
    starts = ((4e4, 1e4), (1.2e5, 1e4), (2e4, 5e4))
    stage = "cell"
    report = (("c10", "c10"), ("c01", "c01"))
    excludes = frozenset(("contact_stiffness",))

    def hand_on(self, finding: dict[str, Any], pad: PadSettings, doubt: bool) -> str:
        p, fact = finding["parameters"], pad.fact
        if not doubt:
            rubber = {k: ranged(fitted(p[k], None), *PAD_COLUMNS["c10"][1:3]) for k in self.fits}
            if rubber["c10"]["low"] + rubber["c01"]["low"] <= 0.0:  # a rubber has to press back
                rubber["c10"]["low"] = rubber["c10"]["value"] * 0.1 or 1.0
            pad.values["rubber"] = rubber | {"thickness": THICKNESS}
        if fact.chord is not None:
            pad.shared["contact.stiffness"] = wide(fact.chord, fact.stiffness if doubt else None)
        return "; its rubber is left out" if doubt else ""
