"""What removes hardly anything of the error on what was left out is not named, not offered, or a hint only."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from dexsim.gap.judge import confidence, joint, kept_out
from dexsim.gap.judge.joint import JointAnswer
from dexsim.gap.rules import JUDGE

ROWS = 400


class Judged(JointAnswer):
    """One joint with one effect, which is found sure by all but what it removes: errors are given, not simulated."""

    def __init__(self, before: float, after: float):
        """before, after: errors of a free run without and with the effect, rad."""
        effect = SimpleNamespace(
            effort_only=False, jitters=False, shows="", parameters=lambda fitted: {}, signal=lambda *_: np.ones(ROWS)
        )
        self.member = SimpleNamespace(id="lag", effect=effect, variant=SimpleNamespace(fixed=(), note=""))
        self.best, self.none = (
            SimpleNamespace(members=(self.member,), fit=None),
            SimpleNamespace(fit=SimpleNamespace(params=[], x=[])),
        )
        self.case = SimpleNamespace(joint="j")
        self.kept = SimpleNamespace(runs=[], train=[], test=[])
        self.outcome = SimpleNamespace(rivals={})
        self.search = self.whole = self.windows = self.bounds = self.widest = None
        self.measured, self.t = np.zeros(ROWS), 0.01 * np.arange(ROWS)
        self.without, self.after = np.full(ROWS, before), np.full(ROWS, after**2)
        self.effort_after, self.raw, self.spans, self.evidence = None, {}, {}, []

    def _fitted(self, mm, bounds):
        return {}, {}

    def _weighed(self, *_):
        return confidence.Evidence("lag", "j", 0.95, 1.0, 0.0, 0.0, [], 1, 0, confidence=0.95)

    def _harmed(self, without_it):
        return ""


def judged(answer: Judged) -> dict:
    """The finding of an answer."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kept_out, "free_run", lambda *_: (answer.without, None))
        patch.setattr(kept_out, "intervals_of", lambda *_: [])
        answer.judge(SimpleNamespace(table=None))
    return answer.found[0]


@pytest.mark.parametrize(("share", "hint"), [(0.02, True), (0.1, True), (0.19, True), (0.21, False), (0.6, False)])
def test_an_effect_must_remove_a_part_of_what_was_kept_out(share, hint):
    """share: of the squared error on what was kept out."""
    answer = Judged(1.0, np.sqrt(1 - share))
    assert (judged(answer)["confidence"] <= JUDGE.hinted) is hint
    reasons = answer.evidence[0].reasons
    assert (len(reasons) > 0) is hint and all(f"less than {100 * JUDGE.part:.0f} %" in r for r in reasons)


@pytest.mark.parametrize(("narrow", "wide", "doubted"), [(False, False, 0), (False, True, 1), (True, True, 1)])
def test_a_name_is_doubted_by_the_interval_that_is_reported(monkeypatch, narrow, wide, doubted):
    """Which of the two intervals, the fit's and the reported one, holds the size at which nothing is missing."""
    answer = Judged(1.0, 0.1)
    answer.widest, answer.bounds = narrow, wide
    answer._fitted = lambda mm, bounds: ({}, bounds)
    answer.case = SimpleNamespace(joint="j", sigma=1e-3, quantum=0.0)
    answer.before = answer.after
    answer.outcome = SimpleNamespace(confidence={"lag": 0.5}, folds={})
    answer.search = SimpleNamespace(unasked=set(), r=SimpleNamespace(sigma_torque=1.0))
    answer.member.variant.params = []
    answer.member.effect.doubts, answer.member.effect.of_pose = lambda *_: [], lambda *_: False
    monkeypatch.setattr(confidence, "holds_nothing", lambda params, spread, case: spread)
    for name in ("too_small", "unresolved"):
        monkeypatch.setattr(confidence, name, lambda *_: "")
    monkeypatch.setattr(joint, "at_bound", lambda *_: "")
    monkeypatch.setattr(confidence, "beyond", lambda *_: "")
    evidence = JointAnswer._weighed(answer, answer.member, {}, narrow, 1.0, 0.1, False)
    assert len(evidence.reasons) == doubted and all("nothing is missing" in r for r in evidence.reasons)
    assert evidence.confidence < 0.8 or not doubted
