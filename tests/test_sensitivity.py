"""`benchmarks.sensitivity` moves the figures that are asked for, where they are first read."""

from __future__ import annotations

import os

import pytest

from benchmarks import sensitivity
from dexsim.errors import UserError
from dexsim.gap.rules import RULES


def test_figures_alone_are_moved(tmp_path, monkeypatch):
    s = sensitivity.settings(["figures=search.price,torque.fit", "factors=0.5"])
    monkeypatch.setattr(os, "fork", lambda: 1)  # as in the parent, whose children all end badly
    monkeypatch.setattr(os, "waitpid", lambda *_: (1, 1))
    with sensitivity.Forks(set(s["figures"]), s["factors"], set(), tmp_path / "rows.jsonl") as forks:
        _ = RULES.search.price, RULES.search.least, RULES.torque.fit, RULES.torque.fit, RULES.judge.firm
    assert [(r["figure"], r["factor"]) for r in sensitivity._rows(forks.path)] == [
        ("search.price", 0.5),
        ("torque.fit", 0.5),
    ]
    assert forks.seen == {"search.price", "search.least", "torque.fit", "judge.firm"}


def test_all_figures_of_the_rooms_are_moved_by_default():
    figures = sensitivity.settings(["rooms=touch,belief"])["figures"]
    assert {x.split(".")[0] for x in figures} == {"touch", "belief"} and "belief.tolerance" in figures


def test_a_figure_that_is_none_is_said():
    with pytest.raises(UserError, match="figures=search.none: search.none is none; valid: search.least, "):
        sensitivity.settings(["figures=search.none"])
