"""Neighbours that respond: part of a taxel's force shows on those beside it."""

from __future__ import annotations

from typing import Any

from dexsim.gap.effects.effect import TouchEffect
from dexsim.gap.touch.result import PadSettings, fitted

SPREAD = 0.15  # share that may pass because pressure spreads by another law (foundation or half-space) than the plant's


class TactileCrosstalk(TouchEffect):
    """Neighbours that respond: part of a taxel's force shows on those beside it."""

    id = "tactile_crosstalk"
    words = "passes part of a taxel's force to the taxels beside it"
    shows = "next to the contact"
    experiment = "presses with a ball smaller than the taxels' pitch"
    fits = ("neighbours",)
    starts = ((0.1,), (0.35,))
    report = (("neighbours", "fraction"),)
    widens = True

    def doubt(self, finding: dict[str, Any]) -> str:
        if finding.get("parameters", {}).get("fraction", {"low": 1.0})["low"] < SPREAD:
            return "a contact's force may spread over the taxels as much wider than its law says"
        return ""

    def hand_on(self, finding: dict[str, Any], pad: PadSettings, doubt: bool) -> str:
        pad.values["crosstalk"] = fitted(finding["parameters"]["fraction"], 0.0 if doubt else None)
        return ""
