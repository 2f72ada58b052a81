"""Two versions of `diagnose` on the same cases: which names agree, which are right, and what is told of the time."""

from __future__ import annotations

import json

import pytest

from benchmarks import answers, same_names
from dexsim.console.jobs import Engine
from dexsim.errors import UserError


def said(*findings, verdict="explained", seconds=10.0, times=()):
    return {"verdict": verdict, "findings": [list(f) for f in findings], "seconds": seconds, "times": list(times)}


def row(before, after, hidden=("backlash",), kind="effect", which="concealed", number=0):
    return {"set": which, "number": number, "kind": kind, "hidden": list(hidden), "before": before, "after": after}


def wrong(row, version):
    return answers.sure_and_wrong(row[version], row["hidden"])


PLAY = ("backlash", ["elbow"], 0.9, [])


def test_a_name_is_the_same_where_effect_and_joint_are():
    assert same_names.first(said(PLAY)) == same_names.first(said((*PLAY[:2], 0.6, []))) == ("backlash", ("elbow",))
    assert same_names.first(said(("backlash", ["elbow"], 0.4, []))) == ("none", ())  # a hint is no name
    other = row(said(PLAY), said(("backlash", ["wrist"], 0.9, [])))
    text = same_names.text_of([other, row(said(PLAY), said(PLAY), number=1)])
    assert "concealed 0 (effect; hidden: backlash): explained: backlash@elbow 0.90 -> explained: backlash@wrist" in text
    assert "concealed 1" not in text


def test_right_and_sure():
    lag = ("lag", ["elbow"], 0.9, [])
    case = row(said(PLAY), said(lag))
    assert same_names.right(case, "before") and not same_names.right(case, "after")
    assert wrong(case, "after") and not wrong(case, "before")
    # a set of one class that holds it is right and not sure
    both = row(said(("coulomb_friction", ["elbow"], 0.9, ["coulomb_friction", "backlash"])), said())
    assert same_names.right(both, "before") and not wrong(both, "before")
    nothing = row(said(), said(lag), hidden=(), kind="none")
    assert same_names.right(nothing, "before") and not same_names.right(nothing, "after")
    # what is in no catalogue: named with doubt is no error, named confidently is one
    odd = row(said((*lag[:2], 0.6, [])), said(lag), hidden=("cable",), kind="outside")
    assert same_names.right(odd, "before") and not same_names.right(odd, "after")


def test_the_time_left_is_held_against_what_was_left():
    lines = [(2.0, "  searching elbow (1/1): effect 1, 2 s so far, at most 50 s left of all"),
             (12.0, "  searched 1 in 12 s"), (15.0, "  replaying what may be written, 40 % done, about 4.5 s left"),
             (17.0, "  replaying what may be written, 60 % done, about 2.5 s left"),
             (20.0, "  replayed what may be written")]  # fmt: skip
    times = answers.times_of(lines)
    assert times == [(15.0, 0.4, 4.5, 5.0), (17.0, 0.6, 2.5, 3.0)]
    assert same_names.told_right([row(said(times=[*times, (1.0, 0.1, 9.0, 5.0)]), said())], "before") == "2 of 3"
    assert answers.times_of(lines[:3]) == []  # nobody knows how long it would have taken


def test_each_case_is_a_job_of_its_own(tmp_path):
    ask = lambda *seeds: answers.at_once(answers.seed_of, dict(zip("ab", seeds)), tmp_path, Engine(at_once=2))  # noqa: E731
    assert list(ask("7", "8")) == [7, 8]
    got = []
    with pytest.raises(UserError, match="b ended with status 2: see .*b.txt"):
        for x in ask("9", "none"):  # asked again; what was done comes, whatever became of the others
            got.append(x)
    assert got == [9] and "error: seed=none: must be" in (tmp_path / "work" / "jobs" / "b.txt").read_text()


def test_what_both_have_answered_is_not_run_again(tmp_path, monkeypatch, capsys):
    (tmp_path / "diagnose.py").write_text("")
    with pytest.raises(UserError, match="before=nowhere: must be a folder of code"):
        same_names.main(["before=nowhere"])
    out = tmp_path / "out" / "seed_5"
    out.mkdir(parents=True)
    done = [row(said(PLAY), said(PLAY)), row(said(), said(), (), "none", "planted")]
    (out / "pairs.jsonl").write_text("".join(json.dumps(r) + "\n" for r in done))
    requested = ["concealed=1", "planted=1", "seed=5", f"out={tmp_path / 'out'}"]
    assert same_names.main([f"before={tmp_path}", *requested]) == 0
    assert [line.split()[:3] for line in capsys.readouterr().out.splitlines() if line.startswith("  ")][1:] == [
        ["concealed", "1", "1"], ["planted", "1", "1"]]  # fmt: skip
