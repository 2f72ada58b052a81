"""A rubber that relaxes under a held force: a standard linear solid."""

from __future__ import annotations

from typing import Any

from dexsim.gap.effects.effect import TouchEffect
from dexsim.gap.touch.result import PadSettings, fitted


class TactileHysteresis(TouchEffect):
    """A rubber that relaxes under a held force: a standard linear solid."""

    id = "tactile_hysteresis"
    words = "has a rubber that relaxes under a held force"
    shows = "while force falls, and in holds over 2 s"
    experiment = "holds of 5 s and fast releases, cold and warm in random order"
    fits = ("fraction", "time_constant")
    starts = ((0.3, 0.1), (0.3, 0.5), (0.3, 2.5))
    report = (("fraction", "fraction"), ("time_constant", "time_constant"))
    classes = ("how touch changes with time",)

    def hand_on(self, finding: dict[str, Any], pad: PadSettings, doubt: bool) -> str:
        p = finding["parameters"]
        pad.values["hysteresis"] = fitted(p["fraction"], 0.0 if doubt else None)
        pad.values["hysteresis_time"] = fitted(p["time_constant"], None)
        return ""
