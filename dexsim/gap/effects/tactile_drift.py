"""Taxels whose gain drifts with the temperature, or with time where none is recorded."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from dexsim.gap.effects.effect import TouchEffect
from dexsim.gap.touch.result import Fit, PadFacts

if TYPE_CHECKING:
    from dexsim.gap.touch.search import PadSearch


ONE_RUN = 20.0  # s: in one shorter recording without a temperature a drift is anything that changes


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
        return search.thermometer or len(search.runs) >= 2 or search.warm >= ONE_RUN

    def begin(self, search: PadSearch) -> list[dict[str, float]]:
        return [{"drift": x / search.warm} for x in (0.15, -0.15)]

    def drift(self, finding: dict[str, Any], fact: PadFacts) -> Fit | None:
        ends = [1.0 + finding["parameters"]["per_degree"][k] * fact.warmest for k in ("value", "low", "high")]
        return 0.5 * (1.0 + ends[0]), min(1.0, *ends[1:]), max(1.0, *ends[1:])
