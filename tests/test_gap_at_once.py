"""What of a diagnosis is done while other joints are still searched, and what where time is out."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from test_gap_search import searched

from dexsim.gap.compute import TimeLimit
from dexsim.gap.diagnosis import Drives
from dexsim.gap.rules import SEARCH
from dexsim.gap.search.scan import scan_catalogue
from dexsim.gap.search.search import drafts_of, finished_drafts


@pytest.mark.slow
def test_of_hypotheses_that_are_out_of_time_the_first_is_fitted(monkeypatch):
    s = searched({"torque_limit": 0.12})
    none = s.start()
    s.fitted = {}
    listed = scan_catalogue(s, none)[:4]
    s.deadline = SimpleNamespace(over=lambda: True)
    drafts = drafts_of(s, listed, none, {})
    assert len(drafts) == 1 and drafts[0][0][0].id == listed[0][2].id
    assert len(finished_drafts(s, drafts * 2, none)) == 1


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
    search = SimpleNamespace(case=case, plain=[([], np.zeros(0))], whole=None)
    loss = 0.5 * SEARCH.unsettled if settled else 2 * SEARCH.unsettled
    found = SimpleNamespace(best=SimpleNamespace(members=(), fit=SimpleNamespace(loss=loss)))
    drives._judged_ahead(search, found)
    assert judged == (["answer", "plain"] if ahead else [])
    assert drives._answer(search, found).of is search and drives._plain(search) is case
    assert judged == ["answer", "plain"]
