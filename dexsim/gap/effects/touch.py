"""Touch and contact: gains of taxels, their delay, rubber, neighbours and drift, what is pressed."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from dexsim.gap.effects import Fit, PadFacts, PadSettings, TouchEffect, absent, fitted, ranged, times, wide
from dexsim.gap.finding import Finding
from dexsim.gap.rules import TOUCH
from dexsim.gap.touch.plant import THICKNESS, readings, shear
from dexsim.tactile.pads import PAD_COLUMNS

if TYPE_CHECKING:
    from dexsim.gap.touch.read import PadRun
    from dexsim.gap.touch.search import PadSearch, TouchTrial


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

    def hand_on(self, finding: Finding, pad: PadSettings, doubt: bool) -> str:
        lost = gains(finding, pad, doubt)
        fact = pad.fact
        # without a load cell gain and stiffness are one factor
        if set(finding.indistinguishable) - {self.id} and fact.common is not None:
            pad.shared["contact.stiffness"] = absent(times((fact.stiffness,) * 3, fact.common), fact.stiffness)
        return lost


def gains(finding: Finding, pad: PadSettings, doubt: bool) -> str:
    """Return gains into a pad's settings; returns what is left out, in words."""
    p, taxels, fact = finding.parameters["gain"], finding.parameters.get("taxels", {}), pad.fact
    whole = fact.common or fact.rest
    if whole is not None:
        pad.values["gain"] = times(pad.values.get("gain"), wide(whole, 1.0 if doubt else None))
    numbers = [int(t.split(":")[1]) for t in finding.taxels]
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


class TactileStiffening(TouchEffect):
    """A rubber that stiffens as it is pressed in: a Mooney-Rivlin foundation under every taxel."""

    id = "tactile_stiffening"
    words = "has a rubber that stiffens as it is pressed in"
    shows = "at high force"
    experiment = "presses to several depths against a load cell"
    fits = rubber = ("c10", "c01")
    starts = ((4e4, 1e4), (1.2e5, 1e4), (2e4, 5e4))
    stage = "cell"
    report = (("c10", "c10"), ("c01", "c01"))
    excludes = frozenset(("contact_stiffness",))

    def hand_on(self, finding: Finding, pad: PadSettings, doubt: bool) -> str:
        p, fact = finding.parameters, pad.fact
        if not doubt:
            rubber = {k: ranged(fitted(p[k], None), *PAD_COLUMNS["c10"][1:3]) for k in self.fits}
            if rubber["c10"]["low"] + rubber["c01"]["low"] <= 0.0:  # a rubber has to press back
                rubber["c10"]["low"] = rubber["c10"]["value"] * 0.1 or 1.0
            pad.values["rubber"] = rubber | {"thickness": THICKNESS}
        if fact.chord is not None:
            pad.shared["contact.stiffness"] = wide(fact.chord, fact.stiffness if doubt else None)
        return "; its rubber is left out" if doubt else ""


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

    def hand_on(self, finding: Finding, pad: PadSettings, doubt: bool) -> str:
        p = finding.parameters
        pad.values["hysteresis"] = fitted(p["fraction"], 0.0 if doubt else None)
        pad.values["hysteresis_time"] = fitted(p["time_constant"], None)
        return ""


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

    def doubt(self, finding: Finding) -> str:
        if finding.parameters.get("fraction", {"low": 1.0})["low"] < TOUCH.spread:
            return "a contact's force may spread over the taxels as much wider than its law says"
        return ""

    def hand_on(self, finding: Finding, pad: PadSettings, doubt: bool) -> str:
        pad.values["crosstalk"] = fitted(finding.parameters["fraction"], 0.0 if doubt else None)
        return ""


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

    def hand_on(self, finding: Finding, pad: PadSettings, doubt: bool) -> str:
        pad.values["delay"] = fitted(finding.parameters["delay"], 0.0 if doubt else None)
        return ""


class TactileDrift(TouchEffect):
    """Taxels whose gain drifts with the temperature, or with time where none is recorded."""

    id = "thermal"
    words = "has taxels whose gain drifts as they warm up"
    shows = "with temperature"
    experiment = "the same presses cold and warm, in random order"
    fits = ("drift",)
    starts = ((0.004,), (-0.004,))
    report = (("drift", "per_degree"),)
    classes = ("how touch changes with time",)
    words_beside = {"of": "taxels"}

    def possible(self, search: PadSearch) -> bool:
        return search.thermometer or len(search.runs) >= 2

    def begin(self, search: PadSearch) -> list[dict[str, float]]:
        return [{"drift": x / search.warm} for x in (0.15, -0.15)]

    def drift(self, finding: Finding, fact: PadFacts) -> Fit | None:
        ends = [1.0 + finding.parameters["per_degree"][k] * fact.warmest for k in ("value", "low", "high")]
        return 0.5 * (1.0 + ends[0]), min(1.0, *ends[1:]), max(1.0, *ends[1:])


class ContactFriction(TouchEffect):
    """An object that slips at another friction than believed."""

    id = "contact_friction"
    words = "lets the object slip at another friction than believed"
    shows = "at the onset of slip"
    experiment = "slow sliding under several normal forces"
    fits = ("mu",)
    starts = ((0.6,), (1.5,))
    stage = "shear"
    report = (("mu", "mu"),)

    def changes(self, run: PadRun, t: TouchTrial, base: dict[str, float]) -> np.ndarray:
        return np.linalg.norm(shear(run, t.values) - shear(run, t.values | {"mu": 1.0}), axis=1)

    def hand_on(self, finding: Finding, pad: PadSettings, doubt: bool) -> str:
        pad.shared["object.friction"] = fitted(finding.parameters["mu"], pad.fact.friction if doubt else None)
        return ""


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

    def hand_on(self, finding: Finding, pad: PadSettings, doubt: bool) -> str:
        p, believed = finding.parameters["stiffness"], pad.fact.stiffness
        pad.shared["contact.stiffness"] = fitted(p, believed if doubt else None)
        if set(finding.indistinguishable) - {self.id}:  # a gain would do as well
            pad.values["gain"] = times(pad.values.get("gain"), absent(fitted(p, None, 1.0 / believed), 1.0))
        return ""
