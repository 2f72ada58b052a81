"""What removes hardly anything of the error on what was left out is not named, not offered, or a hint only."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from dexsim.gap.finding import Finding
from dexsim.gap.judge import confidence, joint_answer
from dexsim.gap.judge.joint_answer import JointAnswer
from dexsim.gap.rules import JUDGE

ROWS = 400


class Judged(JointAnswer):
    """One joint with one effect, which is found sure by all but what it removes: errors are given, not simulated."""

    def __init__(self, before: float, after: float):
        """Take the errors of a free run without and with the effect, rad."""
        effect = SimpleNamespace(
            effort_only=False, shows="", parameters=lambda fitted: {}, signal=lambda *_: np.ones(ROWS)
        )
        self.member = SimpleNamespace(id="lag", effect=effect, variant=SimpleNamespace(fixed=(), note=""))
        self.best, self.none = (
            SimpleNamespace(members=(self.member,), fit=None),
            SimpleNamespace(fit=SimpleNamespace(params=[], x=[]), fixed=()),
        )
        self.case = SimpleNamespace(joint="j", sigma=1.0)
        self.kept = SimpleNamespace(runs=[], train=[], test=[], proven=True)
        self.outcome = SimpleNamespace(rivals={})
        self.search = self.whole = self.windows = self.bounds = self.widest = None
        self.measured, self.t = np.zeros(ROWS), 0.01 * np.arange(ROWS)
        self.without, self.after = np.full(ROWS, before), np.full(ROWS, after**2)
        self.before = self.without**2
        self.effort_after, self.spans, self.evidence, self._trials = None, {}, [], {}
        self.earlier = None

    def _fitted(self, mm, bounds):
        return {}, {}

    def _weighed(self, *_):
        return confidence.Evidence("lag", "j", 0.95, 1.0, 0.0, 0.0, 0.0, 1, confidence=0.95)

    def _score(self, without_it):
        return 99.0


def judged(answer: Judged) -> Finding:
    """Return the finding of an answer."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(joint_answer, "free_run", lambda *_: (answer.without, None))
        patch.setattr(joint_answer, "intervals_of", lambda *_: [])
        answer.judge(SimpleNamespace(table=None))
    return answer.found[0]


@pytest.mark.parametrize(("share", "hint"), [(0.02, True), (0.1, True), (0.19, True), (0.21, False), (0.6, False)])
def test_an_effect_must_remove_a_part_of_what_was_held_out(share, hint):
    """share: of the squared error on what was held out."""
    answer = Judged(1.0, np.sqrt(1 - share))
    assert (judged(answer).confidence <= JUDGE.hinted) is hint
    reasons = answer.evidence[0].reasons
    assert (len(reasons) > 0) is hint and all(f"less than {100 * JUDGE.part:.0f} %" in r for r in reasons)


def weighed(monkeypatch, fitted=False, reported=False, blurred="") -> confidence.Evidence:
    """Return the evidence of a name against which nothing else speaks. fitted, reported: which of the two intervals,
    the fit's and the reported one, holds the size at which nothing is missing; blurred: why the encoder does not
    resolve it."""
    answer = Judged(1.0, 0.1)
    answer.widest, answer.bounds = fitted, reported
    answer._fitted = lambda mm, bounds: ({}, bounds)
    answer.case = SimpleNamespace(joint="j", sigma=0.1, quantum=0.0)
    answer.before = answer.after
    answer.outcome = SimpleNamespace(confidence={"lag": 1.0}, best=SimpleNamespace(folds=[]))
    answer.search = SimpleNamespace(unasked=set(), r=SimpleNamespace(sigma_torque=1.0))
    answer.member.variant.params = []
    answer.member.effect.doubts = lambda *_: []
    monkeypatch.setattr(confidence, "holds_nothing", lambda params, spread, case: spread)
    monkeypatch.setattr(confidence, "too_small", lambda *_: "")
    monkeypatch.setattr(confidence, "unresolved", lambda *_: blurred)
    monkeypatch.setattr(joint_answer, "at_bound", lambda *_: "")
    monkeypatch.setattr(confidence, "beyond", lambda *_: "")
    return JointAnswer._weighed(answer, answer.member, {}, 1.0, 0.1)


@pytest.mark.parametrize(
    ("fitted", "reported", "least", "most"),
    [
        (False, False, JUDGE.sure, 1.0),
        (False, True, JUDGE.firm, JUDGE.doubted),
        (True, False, JUDGE.firm, JUDGE.doubted),
        (True, True, 0.0, JUDGE.hinted),
    ],
)
def test_a_name_is_doubted_by_either_interval_and_a_hint_by_both(monkeypatch, fitted, reported, least, most):
    """An interval holds the size at which nothing is missing."""
    evidence = weighed(monkeypatch, fitted, reported)
    assert least <= evidence.confidence <= most
    assert len(evidence.reasons) == (fitted or reported) and all("nothing is missing" in r for r in evidence.reasons)


def test_what_the_encoder_does_not_resolve_is_a_hint(monkeypatch):
    """An effect of less than half a count is a size and no verdict, whatever it removes."""
    hint = weighed(monkeypatch, blurred="it is small")
    assert hint.confidence <= JUDGE.hinted and hint.reasons == ["it is small"]
