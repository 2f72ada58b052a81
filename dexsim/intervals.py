"""Intervals of what was counted or averaged: Wilson's of a share, the bootstrap's percentiles of anything else.

SciPy's are `share`, `draws`, and what is made of them: `bootstrap`. Drawn here, by NumPy's generator, are index arrays:
`stretches`, since SciPy draws no blocks of neighbours; `singles`, which are stretches of one, since several samples are
looked up by the same index; and `weights`, of which SciPy would make intervals that nobody asked for."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence

import numpy as np
from scipy import stats

Seed = int | Sequence[int] | np.random.Generator
LEVEL = 0.95
AT_ONCE = 2_000_000
"""Numbers that the resamples of one batch hold, about."""


def share(hits: int, n: int, level: float = LEVEL) -> tuple[float, float]:
    """Return interval of a share of which `hits` in n were seen (Wilson, 1927). Unlike a bootstrap's it has a width at
    0 and at n of n; (0, 1) where n is 0. Raises ValueError unless 0 <= hits <= n."""
    if n == 0 and hits == 0:
        return 0.0, 1.0
    found = stats.binomtest(int(hits), int(n)).proportion_ci(level, method="wilson")
    return float(found.low), float(found.high)


def draws(samples: Sequence[np.ndarray], statistic: Callable, seed: Seed, count: int = 1000) -> np.ndarray:
    """[..., count] values of a statistic of E units drawn anew, with replacement.

    samples: arrays [E], drawn together. statistic(*samples, axis=axis) reduces that axis of arrays [..., E]; it may
    return several values stacked in front. seed: a number or a generator. One unit alone gives the same value each
    time."""
    samples = [np.asarray(s) for s in samples]
    units = len(samples[0])
    if units == 1:
        value = np.asarray(statistic(*samples, axis=-1))
        return np.repeat(value[..., None], count, -1)
    with warnings.catch_warnings(), np.errstate(invalid="ignore"):
        # the interval and standard error that SciPy adds are not used: only they mind a value that is not finite
        warnings.simplefilter("ignore", stats.DegenerateDataWarning)
        found = stats.bootstrap(
            tuple(samples), statistic, paired=len(samples) > 1, vectorized=True, n_resamples=count,
            batch=max(1, AT_ONCE // units), method="percentile", rng=np.random.default_rng(seed),
        )  # fmt: skip
    return np.asarray(found.bootstrap_distribution)


def bootstrap(
    samples: Sequence[np.ndarray], statistic: Callable, seed: Seed, count: int = 1000, level: float = LEVEL
) -> np.ndarray:
    """Return [2, ...] ends of the percentile interval of a statistic; see `draws`. Resamples in which it is not a
    number count for nothing."""
    ends = 50 * np.array([1 - level, 1 + level])
    return np.nanpercentile(draws(samples, statistic, seed, count), ends, axis=-1)


def weights(units: int, seed: Seed, count: int = 1000) -> np.ndarray:
    """[count, units] how often each unit is in each resample. Times sums by unit they give the sums of all resamples in
    one matrix product, for statistics of many sums over the same resamples."""

    index = singles(units, seed, count) if units > 1 else np.zeros((count, 1), int)
    at = (index + units * np.arange(count)[:, None]).ravel()  # each resample counted in bins of its own
    return np.bincount(at, minlength=units * count).reshape(count, units).astype(float)


def stretches(units: int, length: int, seed: Seed, count: int = 1000) -> np.ndarray:
    """[count, at least units] index of the units of each resample of a circular block bootstrap (Politis and Romano,
    1992): whole stretches of `length` neighbours (all units where they are fewer), as many as it takes, from the last
    unit on with the first. For units that are not independent of their neighbours.

    Not by SciPy, whose bootstrap draws single units only; `arch`, which has one, cuts the last stretch short, loops in
    Python and brings pandas and statsmodels along."""
    length = min(length, units)
    starts = np.random.default_rng(seed).integers(0, units, (count, -(-units // length)))
    return ((starts[..., None] + np.arange(length)) % units).reshape(count, -1)


def singles(units: int, seed: Seed, count: int = 1000) -> np.ndarray:
    """[count, units] index of the units of each resample, drawn singly: for a statistic that compares several samples
    over the same resamples."""
    return stretches(units, 1, seed, count)


def wins(losses: np.ndarray, index: np.ndarray, within: float) -> np.ndarray:
    """Return [H] share of the resamples `index` [count, m] in which the sum of each of H losses [H, E] is the least of
    all; those that are near it share a resample, one that is worse by `within` (relative) by 1 to e."""
    sums = losses[:, index].sum(-1)
    weight = np.exp(-np.clip((sums / sums.min(0) - 1) / within, 0, 50))
    return (weight / weight.sum(0)).mean(1)
