"""The figures that decide: each rule is held from both sides, by made-up losses."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from dexsim.gap import rules
from dexsim.gap.effects.catalogue import EFFECTS
from dexsim.gap.effects.effect import Variant, param
from dexsim.gap.search.search import JointSearch
from dexsim.gap.search.trial import Member


class Made(JointSearch):
    """A search whose trials say themselves what they lose."""

    def __init__(self):
        self.blocks, self.rng, self.none_loss, self.by_law = np.arange(40), np.random.default_rng(0), np.ones(40), {}
        self.saved, self.fitter = [], SimpleNamespace(shake=lambda params, fit, rng: "shaken")

    def _left(self, trial):
        return trial.loss

    def _here(self, trial):
        return float(trial.loss.mean())

    def _shrunk(self, trial):
        return False


def trial(loss, members=()):
    return SimpleNamespace(loss=np.broadcast_to(np.asarray(loss, float), (40,)), members=members, ids=("lag",))


def test_every_rule_says_what_it_is_and_its_test_exists():
    for name, value, means, source, test in rules.described():
        assert value > 0 and len(means) > 10 and source, name
        assert not test or callable(globals()[test]), name


@pytest.mark.parametrize("factor", [0.5, 2.0])
@pytest.mark.parametrize("name", [name for name, *_, test in rules.described() if test])
def test_a_rule_that_is_moved_fails_its_test(name, factor):
    test = {n: t for n, *_, t in rules.described()}[name]
    value = getattr(rules.SEARCH, name)
    try:
        object.__setattr__(rules.SEARCH, name, value**factor if name == "enough" else value * factor)
        with pytest.raises(AssertionError):
            globals()[test]()
    finally:
        object.__setattr__(rules.SEARCH, name, value)


def test_an_effect_must_remove_a_least_share():
    search, old = Made(), trial(10.0)
    assert not search._earns(trial(9.0), old) and search._earns(trial(8.6), old)


def test_an_effect_must_help_in_nearly_all_bootstraps():
    search, old = Made(), trial(10.0, ("another",))
    search.none_loss = old.loss
    for useless, earns in ((0.02, True), (0.045, False)):  # share of the draws in which it is of no use
        search._boot = lambda x, useless=useless: np.sort(np.linspace(0, 1, 1000)) - useless
        assert search._earns(trial(8.0), old) is earns, useless


def test_a_further_effect_must_matter_beside_the_first():
    search, old, new = Made(), trial(1.0, ("another",)), trial(0.5)
    search.none_loss = np.full(40, 100.0)
    assert search._earns(new, old)
    search.none_loss = np.full(40, 900.0)
    assert not search._earns(new, old)


def row(share, price, effect="lag"):
    p = param("time_constant", effect, "set", 0.0, 1.0)
    return share, price, Member(EFFECTS[effect], Variant((p,), ((0.1,),))), np.array([0.1])


def test_the_short_list_asks_a_price():
    for price, loss, tried in ((0.15, 1.5, True), (0.25, 1.5, False), (0.25, 2.5, False), (0.25, 4.0, True)):
        assert bool(Made()._shortlist([row(0.5, price)], 6, loss, ())) is tried, (price, loss)


def test_within_the_noise_nothing_is_looked_for_nearby():
    search = Made()
    assert search._shaken([], SimpleNamespace(loss=1.3)) == "shaken" and search._shaken([], SimpleNamespace(loss=1.1)) != "shaken"


def test_intervals_hold_the_laws_that_do_as_well():
    search, p = Made(), param("peak", "stribeck_peak", "set", 0.0, 1.0)
    fitted = lambda x, loss: SimpleNamespace(fit=SimpleNamespace(params=[p], x=np.array([x])), loss=np.full(40, loss), ids=("s",))  # noqa: E731
    best = fitted(0.06, 1.0)
    search.by_law = {"s": [best, fitted(0.08, 1.04), fitted(0.2, 1.09)]}
    assert search.law_spread(best).tolist() == [[0.06, 0.08]]


def test_intervals_hold_what_no_residual_shows():
    """1.5 % of the size itself; and 2.5 % of a belief, where the size answers one to one."""
    from dataclasses import replace

    size = param("peak", "stribeck_peak", "set", 0.0, 10.0)
    belief = replace(param("kp", "kp", "factor", 0.9, 10.9, 1.0), nuisance=True)
    fit = SimpleNamespace(params=[size], x=np.array([2.0]), jacobian=np.ones((5, 1)))
    made = SimpleNamespace(fit=fit, folds=[], ids=("s",))
    low, high = Made().widen(made, np.array([[2.0, 2.0]]))[0]
    assert (high - low) / 2 == pytest.approx(1.645 * 0.015 * 2.0, rel=1e-6)
    fit = SimpleNamespace(params=[size, belief], x=np.array([2.0, 1.0]), jacobian=np.ones((5, 2)))
    made = SimpleNamespace(fit=fit, folds=[], ids=("s",))
    low, high = Made().widen(made, np.array([[2.0, 2.0], [1.0, 1.0]]))[0]
    assert (high - low) / 2 == pytest.approx(1.645 * np.hypot(0.015 * 2.0, 0.025), rel=1e-3)
