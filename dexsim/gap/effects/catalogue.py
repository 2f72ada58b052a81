"""The catalogue: every effect in the order of the files, and the classes of effects that some
recordings cannot tell apart, each with the experiment that does.

An effect names the classes that it belongs to; only members of one class may be reported as a set.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import ModuleType
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from dexsim import door
from dexsim.errors import UserError
from dexsim.gap.effects import Effect, TouchEffect, Variant, body, drive, friction, signals, touch, transmission
from dexsim.gap.rules import JUDGE

if TYPE_CHECKING:
    from dexsim.gap.finding import Finding
    from dexsim.gap.plant.case import Case

Entry = TypeVar("Entry", Effect, TouchEffect)


def gathered(kind: type[Entry], *families: ModuleType) -> tuple[Entry, ...]:
    """Return an entry of each class of a kind that stands in the files of these families, in their order: to write it
    there is to add it."""
    found: list[Entry] = [
        c()
        for family in families
        for c in vars(family).values()
        if isinstance(c, type) and issubclass(c, kind) and c.__module__ == family.__name__
    ]
    return tuple(found + _brought(kind))


def _brought(kind: type[Entry]) -> list[Entry]:
    """Return those of installed packages: entry points of the group `dexsim.effects`. Raises UserError for one that is
    no effect."""
    out: list[Entry] = []
    for name, point in door.installed("dexsim.effects").items():
        made = door.load(point.value, f"effect {name} (entry point of dexsim.effects)")
        if not (isinstance(made, type) and issubclass(made, Effect | TouchEffect)):
            raise UserError(f"effect {name}: {point.value} is no effect: derive it from Effect or TouchEffect")
        if issubclass(made, kind):
            out.append(made())
    return out


CATALOGUE = gathered(Effect, friction, transmission, signals, drive, body)
"""Effects of a joint and its drive."""
EFFECTS: dict[str, Effect] = {e.id: e for e in CATALOGUE}
BY_TORQUE = tuple(e for e in CATALOGUE if e.by_torque)
"""Those that inverse dynamics have a column of."""
TOUCH_CATALOGUE = gathered(TouchEffect, touch)
"""Effects of touch and contact."""
TOUCH_EFFECTS: dict[str, TouchEffect] = {e.id: e for e in TOUCH_CATALOGUE}

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
    "friction or pull": "static poses over the whole range with the drive off at each: friction holds the joint where "
    "a pull moves it",
    "friction or dead zone": "small steps of increasing size from one place, each way, and the joint pushed a little "
    "by hand while it is held: friction resists from the first, inside a dead zone the drive does not",
    "weight or push": "static poses over the whole range, twice, with nothing in reach",
}
TOUCH_CLASSES = ("how hard it is touched", "how touch changes with time")
"""Of touch: the first one's own experiment tells its members apart."""


def at_one_load(case: Case, runs: Sequence[int]) -> bool:
    """Return whether the load on the gear of a joint hardly changes while it slides, so that a friction that grows with
    it and one that does not are the same torque: the standard deviation of its size is less than `JUDGE.one_load` of
    its mean."""
    slides = case.regimes["speed"] > JUDGE.slides * case.scales.speed
    load = np.abs(case.regimes["_load"][slides & np.isin(case.plant.run_of, runs)])
    return bool(len(load)) and float(load.std()) < JUDGE.one_load * float(load.mean())


BLIND: dict[str, Callable[[Case, Sequence[int]], bool]] = {"friction and load": at_one_load}
"""Of classes: whether recordings cannot separate their members, however one of them may fit a little better than the
others."""


def members(name: str) -> frozenset[str]:
    """Return the effects of one class of `CLASSES`."""
    return frozenset(e for e, x in EFFECTS.items() if name in x.classes)


def separating(effects: Sequence[str]) -> str:
    """Return the experiment that tells effects of one class apart; the first one's own where they are of none."""
    for name, experiment in CLASSES.items():
        if set(effects) <= members(name):
            return experiment
    return EFFECTS[effects[0]].experiment


def confusable(a: str, b: str) -> bool:
    """Return whether two effects of joints are of one class that some recordings cannot separate."""
    return bool({*EFFECTS[a].classes} & {*EFFECTS[b].classes}) if a in EFFECTS and b in EFFECTS else False


def inseparable(effect: str, case: Case, runs: Sequence[int]) -> list[str]:
    """Return effects of a class of this one that the recordings `runs` of a joint cannot tell from it (`BLIND`)."""
    blind = [c for c in EFFECTS[effect].classes if c in BLIND and BLIND[c](case, runs)]
    return [e for e in EFFECTS if e != effect and {*EFFECTS[e].classes} & {*blind}]


def touch_confusable(a: str, b: str) -> bool:
    """Return whether two effects of touch are of one class that some recordings cannot separate."""
    return bool({*TOUCH_EFFECTS[a].classes} & {*TOUCH_EFFECTS[b].classes})


def touch_compatible(effect: TouchEffect, ids: Sequence[str]) -> bool:
    """Return whether an effect of touch may be there beside others: none replaces another."""
    return not any(e in effect.excludes or effect.id in TOUCH_EFFECTS[e].excludes for e in ids)


def compatible(a: Effect, mine: Variant, b: Effect, theirs: Variant) -> bool:
    """Return whether two effects may be there at once: they act on columns of their own, and neither replaces the
    other."""
    if a.excludes(mine, b, theirs) or b.excludes(theirs, a, mine):
        return False
    return not ({c for p in mine.params for c in p.columns} & {c for p in theirs.params for c in p.columns})


def model_columns() -> frozenset[str]:
    """Return columns of the plant that are fields of the model."""
    return frozenset(c for e in CATALOGUE for c in e.model_columns)


def modelled(finding: Finding) -> bool:
    """Return whether a finding is of an effect that the plant has a law of: not a bad channel, nor a push from
    outside."""
    e = entry(finding)
    return e is not None and e.simulated


def entry(finding: Finding) -> Effect | TouchEffect | None:
    """Return the catalogue's entry of a finding, of a joint or of touch; None for a bad channel."""
    if finding.joints:
        return EFFECTS.get(finding.effect)
    return TOUCH_EFFECTS.get(finding.effect)
