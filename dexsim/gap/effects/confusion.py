"""Classes of effects that some recordings cannot tell apart, each with the experiment that does.

An effect names the classes that it belongs to; only members of one class may be reported as a set.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from dexsim.gap.effects.effect import SLOW
from dexsim.gap.rules import JUDGE

if TYPE_CHECKING:
    from dexsim.gap.plant.case import Case

CLASSES: dict[str, str] = {
    "friction or play": "small reversals about a pose while a load holds the joint to one side, then without it, "
    "and very slow ramps (both encoders logged if there are two)",
    "late": "steps of two sizes and a fast chirp: a delay shifts the motion, a lag rounds it",
    "with speed": "constant speeds from slow to fast, and steps against a known load",
    "static load": "static poses while a known weight is held",
    "friction and load": "the same slow motion under two or more loads",
    "drive weakens": "this joint alone, then with the others loaded, cold and warm in random order",
    "zero or gravity": "static poses over the whole range, and the same with the mechanism turned over: "
    "what gravity does changes sign, an encoder's zero stays",
    "limits at speed": "large steps at full speed, and stops from it: one limit acts while driving, the other while "
                       "braking",
    "loop": "constant speeds from slow to fast, steps of several sizes and long holds against a known load",
    "about a reversal": "reversals of increasing size about a pose, without a load and with one that holds the joint "
                        "to a side",
    "weight or push": "static poses over the whole range, twice, with nothing in reach",
}
TOUCH_CLASSES = ("how hard it is touched", "how touch changes with time")
"""Of touch: the first one's own experiment tells its members apart."""


def at_one_load(case: Case, runs: Sequence[int]) -> bool:
    """Whether the load on the gear of a joint hardly changes while it slides, so that a friction that grows with it and
    one that does not are the same torque: the standard deviation of its size is less than `JUDGE.one_load` of its
    mean."""
    slides = case.regimes["speed"] > SLOW * case.scales.speed
    load = np.abs(case.regimes["_load"][slides & np.isin(case.plant.run_of, runs)])
    return bool(len(load)) and float(load.std()) < JUDGE.one_load * float(load.mean())


BLIND: dict[str, Callable[[Case, Sequence[int]], bool]] = {"friction and load": at_one_load}
"""Of classes: whether recordings cannot separate their members, however one of them may fit a little better than the
others."""
