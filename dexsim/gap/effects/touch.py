"""The catalogue's entries of touch and contact: what each is in words, which numbers it fits, what it is confused with."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class TouchEffect:
    """id and words as in `catalogue.Effect`; fits: parameters of `touch_plant.PARAMS`; starts: values to begin from; stage:
    `cell` where a load cell judges it alone, `taxels`, `shear`; report: parameter -> key in `diagnosis.json`."""

    id: str
    words: str
    shows: str
    fits: tuple[str, ...]
    starts: tuple[tuple[float, ...], ...]
    experiment: str
    stage: str = "taxels"
    report: tuple[tuple[str, str], ...] = ()


TOUCH: tuple[TouchEffect, ...] = (
    TouchEffect("tactile_gain", "shows its force with a wrong gain", "wherever it is touched", ("gain",), ((0.7,), (1.4,)),
                "the same presses with a load cell under the object", report=(("gain", "gain"),)),
    TouchEffect("tactile_stiffening", "has a rubber that stiffens as it is pressed in", "at high force", ("c10", "c01"),
                ((4e4, 1e4), (1.2e5, 1e4), (2e4, 5e4)), "presses to several depths against a load cell", "cell", (("c10", "c10"), ("c01", "c01"))),
    TouchEffect("tactile_hysteresis", "has a rubber that relaxes under a held force", "while force falls, and in holds over 2 s",
                ("fraction", "time_constant"), ((0.3, 0.1), (0.3, 0.5), (0.3, 2.5)), "holds of 5 s and fast releases, cold and warm in random order",
                report=(("fraction", "fraction"), ("time_constant", "time_constant"))),
    TouchEffect("tactile_crosstalk", "passes part of a taxel's force to the taxels beside it", "next to the contact", ("neighbours",), ((0.1,), (0.35,)),
                "presses with a ball smaller than the taxels' pitch", report=(("neighbours", "fraction"),)),
    TouchEffect("tactile_delay", "reports touch later than the joints move", "at the onset of touch", ("delay",), ((0.02,), (0.06,)),
                "fast taps", report=(("delay", "delay"),)),
    TouchEffect("thermal", "has taxels whose gain drifts as they warm up", "with temperature", ("drift",), ((0.004,), (-0.004,)),
                "the same presses cold and warm, in random order", report=(("drift", "per_degree"),)),
    TouchEffect("contact_friction", "lets the object slip at another friction than believed", "at the onset of slip", ("mu",), ((0.6,), (1.5,)),
                "slow sliding under several normal forces", "shear", (("mu", "mu"),)),
    TouchEffect("contact_stiffness", "has a contact that is softer or harder than believed", "with the depth of touch", ("stiffness",), ((0.6,), (1.6,)),
                "presses to several depths against a load cell", "cell", (("stiffness", "stiffness"),)),
)  # fmt: skip
BY_ID: dict[str, TouchEffect] = {e.id: e for e in TOUCH}
EXCLUDES: tuple[frozenset[str], ...] = (frozenset(("contact_stiffness", "tactile_stiffening")),)
"""Effects that replace one another: both at once mean nothing."""
CONFUSED: tuple[frozenset[str], ...] = (
    frozenset(("tactile_gain", "contact_stiffness")),
    frozenset(("tactile_hysteresis", "thermal")),
)
"""Classes of touch effects that some recordings cannot tell apart."""


def confusable(a: str, b: str) -> bool:
    """Whether two touch effects are of one class that some recordings cannot separate."""
    return any(a in c and b in c for c in CONFUSED)


