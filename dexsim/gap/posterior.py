"""How probable hypotheses are: prior odds, and the log density of what no fit of theirs has seen.

    P(h | y) ~ prior(h) exp(score(h) / temperature)

A shadow: written beside the answer (`hypotheses` of details.json), it decides nothing. `benchmarks.shadow` compares.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from dexsim.gap.likelihood import Density, held_out, noises

if TYPE_CHECKING:
    from dexsim.gap.search.fit import Fitter
    from dexsim.gap.search.hypotheses import Member

TEMPERATURE = 30.0  # of the scores, in nats: plants are no truer than that
ODDS = 3.0  # nats that each effect costs beforehand
HELD = 0.9  # of the mass that the smallest set holds
MOST = 400  # samples of a window that are looked at


@dataclass(frozen=True)
class Hypothesis:
    """Effects on one joint as they were fitted: label of their laws; size: number of their parameters; score: log
    density [nats] by fold of what was left out; drift: standard deviation, x the white noise, that it needs there."""

    effects: tuple[str, ...]
    label: str
    size: int
    score: tuple[float, ...]
    drift: float

    @property
    def total(self) -> float:
        """Sum of the scores [nats]."""
        return float(sum(self.score))


class Shadow:
    """Scores of the hypotheses that a search fits, as it goes: by residuals in its windows, which it holds already."""

    def __init__(self, fitter: Fitter, white: Sequence[float], fold: np.ndarray):
        """white: noise of the position and of the torque (0: not recorded) as measured; fold [W]: of each window."""
        self.fitter, self.white, self.fold = fitter, white, np.unique(fold, return_inverse=True)[1]
        self.tried: dict[tuple[tuple[str, ...], str], tuple[float, Hypothesis]] = {}

    @cached_property
    def signals(self) -> list[tuple[slice, Density]]:
        """Of the position, and of the torque where it is fitted: its part of the residuals, and their density."""
        f, r = self.fitter, self.fitter.r
        window, t = f.w.sample_window, f.plant.t[f.w.sample_row]
        step = max(len(t) // (MOST * max(f.count, 1)), 1)
        use = np.arange(len(t)) % step == 0
        out = [(slice(0, len(t)), Density(window, t, noises(self.white[0] / r.sigma_q), use))]
        if f.use_torque:
            given = noises(self.white[1] / r.sigma_torque)
            out.append((slice(len(t), 2 * len(t)), Density(window, t, given, use & f.tau_on)))
        return out

    def add(self, members: Sequence[Member], loss: float, residuals: np.ndarray) -> None:
        """Score a hypothesis by residuals [F, m] of its fits without each fold; loss: of its fit to all. Of several
        fits of one the closest counts."""
        label = "; ".join(m.variant.label for m in members)
        key, (score, drift) = (tuple(m.id for m in members), label), (np.zeros(len(residuals)), 0.0)
        known = self.tried.get(key)
        if known is not None and known[0] < loss:
            return
        for k, (part, density) in enumerate(self.signals):
            by_fold, chosen = held_out(density.of(residuals[:, part]), self.fold)
            score += by_fold
            needs = [density.given[n] for n in chosen]
            drift = max(n.drift / n.white for n in needs) if k == 0 else drift
        size = sum(len(m.variant.params) for m in members)
        self.tried[key] = loss, Hypothesis(key[0], label, size, tuple(round(float(s), 2) for s in score), drift)

    @property
    def hypotheses(self) -> list[Hypothesis]:
        """What was tried, in order."""
        return [h for _, h in self.tried.values()]


def masses(given: Sequence[Hypothesis], temperature: float = TEMPERATURE, odds: float = ODDS) -> np.ndarray:
    """Return the mass [N] of each hypothesis; those of the same effects are siblings, who share one prior."""
    if not given:
        return np.zeros(0)
    siblings = [sum(sorted(h.effects) == sorted(x.effects) for x in given) for h in given]
    log = np.array([h.total / temperature - odds * len(h.effects) - np.log(n) for h, n in zip(given, siblings)])
    mass = np.exp(log - log.max())
    return mass / mass.sum()


def marginals(given: Sequence[Hypothesis], mass: np.ndarray) -> dict[str, float]:
    """Return the probability of each effect, and of `none`, the most probable first."""
    out = {"none": float(sum(m for h, m in zip(given, mass, strict=True) if not h.effects))}
    for e in dict.fromkeys(e for h in given for e in h.effects):
        out[e] = float(sum(m for h, m in zip(given, mass, strict=True) if e in h.effects))
    return dict(sorted(out.items(), key=lambda x: -x[1]))


def credible(given: Sequence[Hypothesis], mass: np.ndarray) -> list[tuple[str, ...]]:
    """Return the smallest set of effects' sets that holds `HELD` of the mass."""
    by: dict[tuple[str, ...], float] = {}
    for h, m in zip(given, mass, strict=True):
        key = tuple(sorted(h.effects))
        by[key] = by.get(key, 0.0) + float(m)
    out, sum_ = [], 0.0
    for key, m in sorted(by.items(), key=lambda x: -x[1]):
        out.append(key)
        sum_ += m
        if sum_ >= HELD:
            break
    return out


def entry(given: Sequence[Hypothesis]) -> dict[str, Any]:
    """Return a joint's hypotheses with their masses, as details.json has them."""
    mass = masses(given)
    rows = [asdict(h) | {"mass": round(float(m), 4)} for h, m in zip(given, mass, strict=True)]
    return {
        "marginals": {k: round(v, 4) for k, v in marginals(given, mass).items()},
        "credible": [list(x) for x in credible(given, mass)],
        "tried": sorted(rows, key=lambda r: -r["mass"]),
    }
