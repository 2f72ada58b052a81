"""Intervals: Wilson's by hand, the bootstrap's by theory and as often right as they say."""

from __future__ import annotations

import math

import numpy as np
import pytest

from benchmarks.concealed.score import of_rows
from dexsim import intervals


def test_a_share_is_wilsons_and_never_of_no_width():
    assert intervals.share(5, 10) == pytest.approx((0.2366, 0.7634), abs=1e-4)
    assert intervals.share(0, 100) == pytest.approx((0.0, 0.0370), abs=1e-4)
    assert intervals.share(100, 100) == pytest.approx((0.9630, 1.0), abs=1e-4)
    assert intervals.share(0, 0) == (0.0, 1.0)
    with pytest.raises(ValueError):
        intervals.share(3, 2)


def test_the_bootstrap_of_an_average_is_its_standard_error():
    x = np.random.default_rng(0).normal(3.0, 2.0, 400)
    low, high = intervals.bootstrap((x,), np.mean, 0, 4000)
    half = 1.96 * x.std() / math.sqrt(400)
    assert (low, high) == pytest.approx((x.mean() - half, x.mean() + half), abs=0.1 * half)
    assert intervals.bootstrap((x,), np.mean, 0, 4000).tolist() == [low, high], "the same seed, the same interval"


def test_units_are_drawn_together_and_several_values_at_once():
    """A ratio of two that go together has no spread at all; drawn apart it would have."""
    x = np.random.default_rng(1).uniform(1, 2, 30)

    def both(a, b, axis=-1):
        return np.stack([b.sum(axis) / a.sum(axis), a.mean(axis)])

    drawn = intervals.draws((x, 3 * x), both, 0, 500)
    assert drawn.shape == (2, 500)
    np.testing.assert_allclose(drawn[0], 3.0)
    assert drawn[1].std() > 0.01


def test_any_statistic_of_rows():
    rows = np.random.default_rng(2).integers(0, 5, (50, 3))
    seen = intervals.draws(*of_rows(rows, lambda r: float(np.median(r[:, 0] - r[:, 2]))), 0, 200)
    assert seen.shape == (200,) and set(np.unique(seen)) <= set(np.arange(-5, 5.5, 0.5)) and seen.std() > 0


def test_one_unit_and_what_is_no_number():
    assert intervals.bootstrap((np.array([2.0]),), np.mean, 0).tolist() == [2.0, 2.0]

    def broken(x, axis=-1):
        mean = x.mean(axis)
        return np.where(mean > 0.5, mean, np.nan)

    low, high = intervals.bootstrap((np.array([0.0, 1.0, 1.0, 1.0]),), broken, 0)
    assert 0.5 < low < high == 1.0


def test_weights_count_the_units_that_the_same_seed_draws():
    x = np.random.default_rng(3).normal(size=13)
    times = intervals.weights(13, 5, 200)
    assert times.shape == (200, 13) and (times.sum(1) == 13).all() and times.max() > 1
    np.testing.assert_allclose(times @ x, intervals.draws((x,), np.sum, 5, 200))
    assert intervals.weights(1, 0, 3).tolist() == [[1.0]] * 3


def test_a_generator_is_drawn_from_on_as_by_hand():
    """Results that were published with resamples drawn by hand stay what they were."""
    x, (ours, hand) = np.arange(9.0) ** 2, (np.random.default_rng(4) for _ in range(2))
    for _ in range(2):
        assert (intervals.draws((x,), np.sum, ours, 50) == x[hand.integers(0, 9, (50, 9))].sum(1)).all()


def test_singles_are_what_a_generator_draws():
    by_hand = np.random.default_rng(4).integers(0, 7, (20, 7))
    np.testing.assert_array_equal(intervals.singles(7, 4, 20), by_hand)


def test_stretches_are_neighbours_in_a_circle():
    index = intervals.stretches(10, 4, 0, 500)
    assert index.shape == (500, 12) and set(np.unique(index)) == set(range(10))
    assert (np.diff(index.reshape(500, 3, 4)) % 10 == 1).all()
    assert intervals.stretches(3, 4, 0, 2).shape == (2, 3), "fewer units than a stretch has: one of all of them"


def test_stretches_see_that_neighbours_are_alike():
    """The standard error of the average of an autoregression: by theory 1 / (1 - a) of the innovations'."""
    rng, n, a = np.random.default_rng(5), 4000, 0.8
    x = rng.normal(size=n)
    for i in range(1, n):
        x[i] += a * x[i - 1]
    by_stretch = x[intervals.stretches(n, 60, 0, 1000)].mean(1).std()
    by_unit = intervals.draws((x,), np.mean, 0, 1000).std()
    assert by_stretch == pytest.approx(1 / (1 - a) / math.sqrt(n), rel=0.15) and by_unit < 0.5 * by_stretch


def test_who_loses_least_wins_and_who_is_near_shares():
    losses = np.array([np.ones(12), np.full(12, 1.02), np.full(12, 9.0)])
    won = intervals.wins(losses, intervals.stretches(12, 4, 0, 100), 0.02)
    assert won == pytest.approx(np.array([1, np.exp(-1), 0]) / (1 + np.exp(-1)))
    distance = np.where(np.arange(12) < 6, [[0.0], [2.0]], [[2.0], [0.0]]) + 1.0  # each better in its half
    assert intervals.wins(distance, intervals.stretches(12, 4, 0, 4000), 1e-6) == pytest.approx([0.5, 0.5], abs=0.03)
