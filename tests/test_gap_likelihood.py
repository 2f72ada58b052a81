"""The density of residuals with a drift, against a dense Gaussian; masses of hypotheses."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from dexsim.gap.likelihood import Density, Noise, held_out, noises
from dexsim.gap.posterior import Hypothesis, credible, marginals, masses

T = np.concatenate([0.01 * np.arange(30) + 1e-3 * np.sin(np.arange(30.0)), 5 + 0.02 * np.arange(12)])
WINDOW = np.repeat([0, 1], [30, 12])


@pytest.mark.parametrize("noise", [Noise(0.7), Noise(0.7, 2.0, 0.1), Noise(0.1, 0.5, 0.02), Noise(1.0, 30.0, 3.0)])
def test_the_density_is_that_of_a_dense_gaussian(noise):
    y = np.random.default_rng(0).normal(size=(2, len(T)))
    log = Density(WINDOW, T, [Noise(0.3), noise]).of(y)[:, 1]
    for h in range(2):
        for w in range(2):
            on = WINDOW == w
            apart = np.abs(T[on][:, None] - T[on])
            C = noise.white**2 * np.eye(on.sum()) + noise.drift**2 * np.exp(-apart / noise.time)
            assert log[h, w] == pytest.approx(multivariate_normal(np.zeros(on.sum()), C).logpdf(y[h, on]), rel=1e-9)


def test_samples_that_are_not_there_say_nothing():
    y, use = np.random.default_rng(1).normal(size=(1, len(T))), np.arange(len(T)) % 3 > 0
    some = Density(WINDOW, T, [Noise(0.5, 1.0, 0.2)], use).of(np.where(use, y, 1e9))
    assert some == pytest.approx(Density(WINDOW[use], T[use], [Noise(0.5, 1.0, 0.2)]).of(y[:, use]), rel=1e-12)


def test_the_noise_is_told_by_what_is_not_left_out():
    rng, t = np.random.default_rng(2), np.tile(0.01 * np.arange(200), 6)
    window = np.repeat(np.arange(6), 200)
    drift = np.zeros((6, 200))
    for i in range(1, 200):
        drift[:, i] = np.exp(-0.1) * drift[:, i - 1] + 4.0 * np.sqrt(1 - np.exp(-0.2)) * rng.normal(size=6)
    given = noises(1.0)
    log = Density(window, t, given).of((drift.ravel() + rng.normal(size=1200))[None])
    _, chosen = held_out(np.repeat(log, 3, 0), np.arange(6) // 2)
    assert all(given[k].time == 0.1 and given[k].drift in (2.0, 4.0, 8.0) for k in chosen)
    white = Density(window, t, given).of(rng.normal(size=(1, 1200)))
    assert all(given[k].drift <= 0.5 for k in held_out(np.repeat(white, 3, 0), np.arange(6) // 2)[1])


def test_siblings_share_a_prior_and_marginals_add_up():
    of = lambda *effects, score, label="": Hypothesis(effects, label, len(effects), (score, 0.0), 1.0)  # noqa: E731
    given = [of(score=0.0), of("lag", score=30.0), of("lag", score=30.0, label="b"), of("lag", "backlash", score=30.0)]
    mass = masses(given, temperature=10.0, odds=1.0)
    assert mass.sum() == pytest.approx(1.0)
    assert mass[1] + mass[2] == pytest.approx(mass[3] * np.e) and mass[3] == pytest.approx(mass[0] * np.exp(1.0))
    by = marginals(given, mass)
    assert by["lag"] == pytest.approx(1 - by["none"]) and by["backlash"] == pytest.approx(mass[3])
    assert credible(given, mass) == [("lag",), ("backlash", "lag")]
