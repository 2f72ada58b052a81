"""Taxels that lag the joints."""

from __future__ import annotations

from typing import Any

from dexsim.gap.effects.effect import TouchEffect
from dexsim.gap.touch.result import PadSettings, fitted


class TactileDelay(TouchEffect):
    """Taxels that lag the joints."""

    id = "tactile_delay"
    words = "reports touch later than the joints move"
    shows = "at the onset of touch"
    experiment = "fast taps"
    fits = ("delay",)
    starts = ((0.02,), (0.06,))
    report = (("delay", "delay"),)
    replaces = frozenset(("clock",))

    def hand_on(self, finding: dict[str, Any], pad: PadSettings, doubt: bool) -> str:
        pad.values["delay"] = fitted(finding["parameters"]["delay"], 0.0 if doubt else None)
        return ""
