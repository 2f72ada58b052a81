"""A hypothesis of several effects in which another one stands for a member that it beats."""

from __future__ import annotations

from types import SimpleNamespace as Plain

import pytest

from dexsim.gap.search.search import overtaken


def hypothesis(*ids):
    return Plain(members=[Plain(id=x) for x in ids], ids=ids)


def search(*known):
    out = Plain(fitted={frozenset(t.ids): t for t in known}, shrunk=lambda t: "backlash" in t.ids)
    return lambda current, final: overtaken(out, current, final)


def test_a_rival_takes_the_place_of_the_member_that_it_beats():
    now, better = hypothesis("payload", "torque_ripple"), hypothesis("position_scale", "torque_ripple")
    final = {
        "payload": ([("position_scale", 0.93)], 0.06),
        "torque_ripple": ([("position_scale", 0.01)], 0.98),
    }
    assert search(now, better)(now, final) is better
    assert search(now)(now, final) is None  # never fitted beside the rest


@pytest.mark.parametrize(("share", "rival"), [(0.5, "position_scale"), (0.06, "backlash")])
def test_it_stays_where_it_holds_its_own_or_the_rival_is_fitted_away(share, rival):
    now, other = hypothesis("payload", "torque_ripple"), hypothesis(rival, "torque_ripple")
    final = {"payload": ([(rival, 0.55)], share), "torque_ripple": ([], 0.98)}
    assert search(now, other)(now, final) is None


def test_one_alone_is_overtaken_as_well():
    now, better = hypothesis("payload"), hypothesis("position_scale")
    assert search(now, better)(now, {"payload": ([("position_scale", 0.7)], 0.3)}) is better


def test_draws_that_an_effects_like_wins_are_not_lost_to_a_rival():
    now, better = hypothesis("payload"), hypothesis("coulomb_friction")
    shares = lambda like: {"payload": ([("coulomb_friction", 0.48), (like, 0.26)], 0.26)}  # noqa: E731
    # a tilt of gravity and an encoder's zero: half of the draws together
    assert search(now, better)(now, shares("position_offset")) is None
    assert search(now, better)(now, shares("torque_ripple")) is better
