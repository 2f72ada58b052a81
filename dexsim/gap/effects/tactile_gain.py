"""Gains of a pad: one number for all its taxels, or one for each; dead, stuck and exchanged taxels."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from dexsim.gap.effects.effect import TouchEffect
from dexsim.gap.touch.plant import readings
from dexsim.gap.touch.result import Fit, PadSettings, fitted, instead, times, wide

if TYPE_CHECKING:
    from dexsim.gap.touch.read import PadRun
    from dexsim.gap.touch.search import TouchTrial


class TactileGain(TouchEffect):
    """Gains of a pad: one number for all its taxels, or one for each; dead, stuck and exchanged taxels."""

    id = "tactile_gain"
    words = "shows its force with a wrong gain"
    shows = "wherever it is touched"
    experiment = "the same presses with a load cell under the object"
    fits = ("gain",)
    starts = ((0.7,), (1.4,))
    report = (("gain", "gain"),)
    classes = ("how hard it is touched",)
    by_taxel = True
    widens = True
    words_beside = {"taxels": "all of the pad"}

    def changes(self, run: PadRun, t: TouchTrial, base: dict[str, float]) -> np.ndarray:
        if t.gains is None:
            return super().changes(run, t, base)
        return np.abs(readings(run, t.values, t.gains, t.order) - readings(run, t.values)).max(1)

    def hand_on(self, finding: dict[str, Any], pad: PadSettings, doubt: bool) -> str:
        lost = gains(finding, pad, doubt)
        fact = pad.fact
        # without a load cell gain and stiffness are one factor
        if set(finding["indistinguishable"]) - {self.id} and fact.common is not None:
            pad.shared["contact.stiffness"] = instead(times((fact.stiffness,) * 3, fact.common), fact.stiffness)
        return lost


def gains(finding: dict[str, Any], pad: PadSettings, doubt: bool) -> str:
    """Gains into a pad's settings; returns what is left out, in words."""
    p, taxels, fact = finding["parameters"]["gain"], finding["parameters"].get("taxels", {}), pad.fact
    whole = fact.common or fact.rest
    if whole is not None:
        pad.values["gain"] = times(pad.values.get("gain"), wide(whole, 1.0 if doubt else None))
    numbers = [int(t.split(":")[1]) for t in finding["where"]["taxels"]]
    lists = {k: np.broadcast_to(np.atleast_1d(p[k]), len(numbers)) for k in ("value", "low", "high")}
    single: dict[int, Fit] = {}
    for k, v, low, high in zip(numbers, *lists.values(), strict=True):
        if fact.common is not None and k not in fact.silent:
            continue  # the pad's
        if k in fact.silent and not doubt:
            if fact.silent[k] == 0.0:
                pad.values.setdefault("dead", []).append(k)
            else:
                pad.values.setdefault("stuck", {})[k] = round(fact.silent[k], 6)
            continue
        single[k] = fitted({"value": v, "low": low, "high": high}, 1.0 if doubt else None)
    if single:
        pad.values["taxels"] = single
    swapped = [[int(t.split(":")[1]) for t in pair] for pair in taxels.get("swapped", [])]
    if swapped and not doubt:
        pad.values["swapped"] = swapped
    return "; exchanged taxels are left out" if swapped and doubt else ""
