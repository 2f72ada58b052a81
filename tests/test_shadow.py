"""The posterior beside today's answer: how the benchmark reads and scores both."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import shadow


def row(number, hidden, scores, findings=(), verdict="unknown"):
    """Return a case of one joint; scores: total [nats] by effects, () for none."""
    tried = [{"effects": list(e), "label": "", "size": len(e), "score": [x / 2, x / 2], "drift": 0.0}
             for e, x in scores.items()]  # fmt: skip
    return {"set": "concealed", "number": number, "kind": "effect" if hidden else "none", "hidden": list(hidden),
            "today": {"verdict": verdict, "findings": [list(f) for f in findings]},
            "hypotheses": {"elbow": tried}}  # fmt: skip


def test_names_of_both_answers():
    case = row(0, ["lag"], {(): 0.0, ("lag",): 90.0, ("backlash",): 20.0}, [("backlash", ["elbow"], 0.9, [])])
    by, first, unknown = shadow.today(case)
    assert by == {"backlash": pytest.approx(0.9)} and first["effect"] == "backlash" and unknown
    by, first, unknown = shadow.shadow(case, 10.0, 1.0)
    assert by["lag"] > 0.99 and first == {"effect": "lag", "indistinguishable": []} and not unknown
    assert shadow.right(case, shadow.shadow(case, 10.0, 1.0)) and not shadow.right(case, shadow.today(case))
    twins = row(0, ["lag"], {(): 0.0, ("command_delay",): 90.0, ("lag",): 88.0})  # one class, and nearly alike
    first = shadow.shadow(twins, 10.0, 1.0)[1]
    assert set(first["indistinguishable"]) == {"command_delay", "lag"} and shadow.right(twins, ({}, first, False))


def test_nothing_is_named_where_no_effect_earns_its_odds():
    case = row(0, [], {(): 0.0, ("lag",): 2.0})
    assert shadow.right(case, shadow.shadow(case, 1.0, 4.0)) and not shadow.right(case, shadow.shadow(case, 1.0, 0.0))
    assert shadow.right(case, shadow.today(case))


def test_temperature_and_odds_are_those_that_score_best():
    """Scores that are off by tens of nats: a temperature of 1 would be sure and wrong."""
    rng, rows = np.random.default_rng(0), []
    for k in range(60):
        there = k % 2 == 0
        rows.append(row(k, ["lag"] if there else [], {(): 0.0, ("lag",): (60.0 if there else 0.0) + 40 * rng.normal()}))
    temperature, odds = shadow.fitted(rows)
    assert temperature >= 10.0
    at = lambda t, o: shadow.log_score(rows, lambda r: shadow.shadow(r, t, o))  # noqa: E731
    assert at(temperature, odds) >= max(at(1.0, odds), at(640.0, odds), at(temperature, 6.0))
    text = shadow.text_of(rows)
    assert "posterior" in text and "today" in text and "nats" in text
