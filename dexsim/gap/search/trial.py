"""A hypothesis: its effects, its fit, and what a search ends with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from dexsim.gap.effects.catalogue import compatible
from dexsim.gap.effects.effect import Effect, Variant
from dexsim.gap.plant.batch import JointPlant
from dexsim.gap.plant.columns import INDEX, Param
from dexsim.gap.search.fit import Fitted


@dataclass(frozen=True)
class Member:
    """One effect in a hypothesis: the effect, its variant."""

    effect: Effect
    variant: Variant

    @property
    def id(self) -> str:
        return self.effect.id


@dataclass
class Trial:
    """A hypothesis that was fitted: its members, the fit on all training windows, losses on left-out blocks [B]."""

    members: tuple[Member, ...]
    fit: Fitted
    left_out: np.ndarray | None = None
    folds: list[np.ndarray] = field(default_factory=list)
    refitted: bool = False  # whether `left_out` is of fits of their own without each condition

    @property
    def ids(self) -> tuple[str, ...]:
        return tuple(m.id for m in self.members)


@dataclass
class Outcome:
    """What the search of one joint ends with."""

    joint: str
    none: Trial
    best: Trial
    rivals: dict[str, list[tuple[str, float]]]  # by effect: what else would do, with its share of bootstraps
    confidence: dict[str, float]
    gains: dict[str, float]  # by effect: share of the squared left-out error that it removes
    price: dict[str, float]
    scanned: list[tuple[str, float, float]]  # (effect, share of squared error in the scan, its price)
    folds: dict[str, list[float]] = field(
        default_factory=dict
    )  # by effect: relative cost of dropping it, by condition left out
    note: str = ""


class Fixed:
    """Constants set on a plant's nominal inside a `with`."""

    def __init__(self, plant: JointPlant, pairs: Sequence[tuple[str, float]]):
        self.plant, self.pairs = plant, pairs

    def __enter__(self) -> None:
        self.saved = self.plant.nominal
        if self.pairs:
            self.plant.nominal = [row.copy() for row in self.saved]
            for name, value in self.pairs:
                for row in self.plant.nominal:
                    row[INDEX[name]] = value

    def __exit__(self, *exc: object) -> None:
        self.plant.nominal = self.saved


def named(member: Member) -> list[Param]:
    """The member's parameters with keys unique in a hypothesis."""
    return [replace(p, key=f"{member.id}.{p.key}") for p in member.variant.params]


def dear_of(trial: Trial) -> float:
    """Factor on the losses of a hypothesis that can imitate simpler ones."""
    return float(np.prod([1 + m.variant.dear for m in trial.members]))


def fits_beside(a: Member, b: Member) -> bool:
    return compatible(a.effect, a.variant, b.effect, b.variant)
