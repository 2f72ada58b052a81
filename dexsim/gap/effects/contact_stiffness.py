"""A contact that is softer or harder than believed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from dexsim.gap.effects.effect import TouchEffect
from dexsim.gap.touch.result import PadSettings, fitted, instead, times

if TYPE_CHECKING:
    from dexsim.gap.touch.search import TouchTrial


class ContactStiffness(TouchEffect):
    """A contact that is softer or harder than believed."""

    id = "contact_stiffness"
    words = "has a contact that is softer or harder than believed"
    shows = "with the depth of touch"
    experiment = "presses to several depths against a load cell"
    fits = ("stiffness",)
    starts = ((0.6,), (1.6,))
    stage = "cell"
    report = (("stiffness", "stiffness"),)
    classes = ("how hard it is touched",)

    def in_place(self, values: dict[str, float], base: TouchTrial, current: TouchTrial) -> dict[str, float]:
        return base.values | {"stiffness": current.values["gain"]}

    def hand_on(self, finding: dict[str, Any], pad: PadSettings, doubt: bool) -> str:
        p, believed = finding["parameters"]["stiffness"], pad.fact.stiffness
        pad.shared["contact.stiffness"] = fitted(p, believed if doubt else None)
        if set(finding["indistinguishable"]) - {self.id}:  # a gain would do as well
            pad.values["gain"] = times(pad.values.get("gain"), instead(fitted(p, None, 1.0 / believed), 1.0))
        return ""
