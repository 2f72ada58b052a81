"""What a diagnosis does at the same time: searches that take turns at the interpreter, hypotheses in threads of
their own, joints judged before the last is searched. Each gives what one after the other gives, to the last bit."""

from __future__ import annotations

import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from test_gap import plant_run
from test_gap_search import searched

from dexsim.gap import compute
from dexsim.gap.compute import TimeLimit, away, map_joints, side_by_side
from dexsim.gap.diagnosis import Drives
from dexsim.gap.plant.case import build
from dexsim.gap.read import conditions
from dexsim.gap.rules import SEARCH
from dexsim.gap.search.search import JointSearch, Outcome
from tests.test_gap import model


def test_searches_take_turns_at_the_interpreter_and_hand_them_over_while_they_wait():
    inside, most, met = [0], [0], threading.Barrier(6, timeout=20)
    lock = threading.Lock()

    def count(by: int) -> None:
        with lock:
            inside[0] += by
            most[0] = max(most[0], inside[0])

    def work(k: int, tell) -> int:
        for _ in range(3):
            count(1)
            time.sleep(0.002)
            count(-1)
            with away():
                met.wait()  # passes only where all six wait at once: none keeps its turn
        return k

    assert map_joints([str(k) for k in range(6)], work, "cuda") == list(range(6))
    assert most[0] == compute.TURNS
    with pytest.raises(ZeroDivisionError):  # a fault gives its turn back
        map_joints([str(k) for k in range(6)], lambda k, tell: 1 // 0, "cuda")
    assert map_joints(["a", "b", "c"], lambda k, tell: k, "cuda") == [0, 1, 2]
    with away():  # of a thread that has none
        pass
    assert map_joints(["a", "b", "c"], lambda k, tell: k, "cuda") == [0, 1, 2]


def test_the_turn_goes_to_the_one_of_whom_most_is_left():
    turns, order = compute.Turns(1), []
    turns.take(0.0)

    def wait(rank: float) -> None:
        turns.take(rank)
        order.append(rank)
        turns.give()

    threads = [threading.Thread(target=wait, args=(rank,)) for rank in (-1.0, -5.0, 0.0, -3.0)]
    for asked, thread in enumerate(threads, 1):
        thread.start()
        while len(turns._waiting) < asked:
            time.sleep(1e-3)
    turns.give()
    for thread in threads:
        thread.join(20)
    assert order == [-5.0, -3.0, -1.0, 0.0]
    turns.take(9.0)  # it is free again


def test_a_joints_hypotheses_have_their_joints_rank(monkeypatch):
    ranks, turns = [], compute.Turns(compute.TURNS)
    monkeypatch.setattr(compute, "_TURNS", turns)
    monkeypatch.setattr(turns, "take", lambda rank, take=turns.take: ranks.append(rank) or take(rank))

    def joint(k: int, tell) -> list[int]:
        return list(side_by_side([lambda: 0, lambda: 1], "cuda"))

    assert map_joints(["a", "b"], joint, "cuda", left=[2.0, 7.0]) == [[0, 1], [0, 1]]
    assert ranks.count(-2.0) == ranks.count(-7.0) and set(ranks) == {-2.0, -7.0}


def test_on_a_gpu_all_are_begun_at_once_on_a_cpu_each_when_it_is_asked_for():
    met, seen = threading.Barrier(3, timeout=20), []

    def meets(k: int) -> int:
        with away():
            met.wait()
        return k

    def joint(k: int, tell) -> list[int]:
        return list(side_by_side([lambda i=i: meets(i) for i in range(3)], "cuda"))

    assert map_joints(["a", "b"], joint, "cuda") == [[0, 1, 2], [0, 1, 2]]

    def told(k: int) -> int:
        seen.append(k)
        return k

    for k in side_by_side([lambda i=i: told(i) for i in range(3)], "cpu"):
        assert seen == list(range(k + 1))
    with pytest.raises(ZeroDivisionError):
        list(side_by_side([lambda: 1, lambda: 1 // 0], "cuda"))


def numbers(found: Outcome) -> list:
    return [
        [m.id for m in found.best.members],
        found.none.fit.x.tolist(),
        found.best.fit.x.tolist(),
        found.rivals,
        found.confidence,
        found.gains,
        found.price,
        found.scanned,
    ]


@pytest.mark.slow
def test_hypotheses_side_by_side_are_those_one_after_the_other(monkeypatch):
    """Two effects that write constants to the plant among them: each hypothesis has a plant of its own."""
    changes, allowed = {"backlash": 0.03}, {"backlash", "compliance", "deadband", "coulomb_friction", "lag"}
    runs = [plant_run(f"run{k}", k, 4.0, changes, seed=k) for k in (0, 1, 3)]
    for r in runs:
        r.smooth()

    def search() -> JointSearch:
        return JointSearch(build(model(), runs)[0], [0, 1, 2], None, conditions(runs), allowed=allowed)

    expected = numbers(search().run())
    assert expected[0]
    begun: list[int] = []

    def at_once(work, device):
        begun.append(len(work))
        return side_by_side(work, "cuda")

    monkeypatch.setattr(compute, "side_by_side", at_once)
    assert numbers(search().run()) == expected
    assert max(begun) > 1


@pytest.mark.slow
def test_of_hypotheses_that_are_out_of_time_the_first_is_fitted(monkeypatch):
    s = searched({"torque_limit": 0.12})
    none = s.start()
    s.fitted = {}
    listed = s.scan(none)[:4]
    s.deadline = SimpleNamespace(over=lambda: True)
    drafts = s._drafts(listed, none, {}, {})
    assert len(drafts) == 1 and drafts[0][0][0].id == listed[0][2].id
    assert len(s._finished(drafts * 2, none)) == 1


@pytest.mark.parametrize("seconds, stopped, settled, ahead", [
    (None, False, True, True), (60.0, False, True, False), (None, True, True, False), (None, False, False, False),
])  # fmt: skip
def test_a_joint_that_is_not_searched_again_is_judged_ahead(seconds, stopped, settled, ahead, monkeypatch):
    """Not where time is limited, nor one that may be searched again; what is judged ahead is not judged twice."""
    judged: list[str] = []
    monkeypatch.setattr(
        "dexsim.gap.diagnosis.JointAnswer.of", lambda *x: judged.append("answer") or SimpleNamespace(of=x[1])
    )
    monkeypatch.setattr("dexsim.gap.diagnosis.baseline.judged", lambda *x: judged.append("plain") or x[0])
    drives = object.__new__(Drives)
    limit = TimeLimit(seconds)
    if stopped:
        limit.stop()
    drives.w, drives.ahead = SimpleNamespace(limit=limit, runs=[]), {}
    drives.parts = SimpleNamespace(train=[0], test=[1], span_train=None, span_test=None, apart={}, proven=True)
    case = SimpleNamespace(moved=True)
    search = SimpleNamespace(case=case, plain=lambda: ([], np.zeros(0)), whole=None)
    loss = 0.5 * SEARCH.unsettled if settled else 2 * SEARCH.unsettled
    found = SimpleNamespace(best=SimpleNamespace(members=(), fit=SimpleNamespace(loss=loss)))
    drives._judged_ahead(search, found)
    assert judged == (["answer", "plain"] if ahead else [])
    assert drives._answer(search, found).of is search and drives._plain(search) is case
    assert judged == ["answer", "plain"]
