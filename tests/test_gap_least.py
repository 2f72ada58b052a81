"""What removes hardly anything of the error on what was left out is not named, not offered, or a hint only."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from dexsim.gap.judge import confidence, errors, residual_fit
from dexsim.gap.judge.joint import PART, JointAnswer
from dexsim.gap.judge.verdict import HINTED
from dexsim.gap.touch.search import PadSearch

ROWS = 400


class Judged(JointAnswer):
    """One joint with one effect, which is found sure by all but what it removes: errors are given, not simulated."""

    def __init__(self, before: float, after: float):
        """before, after: errors of a free run without and with the effect, rad."""
        effect = SimpleNamespace(
            effort_only=False, jitters=False, shows="", parameters=lambda fitted: {}, signal=lambda *_: np.ones(ROWS)
        )
        self.member = SimpleNamespace(id="lag", effect=effect, variant=SimpleNamespace(fixed=(), note=""))
        self.best, self.none = SimpleNamespace(members=(self.member,), fit=None), SimpleNamespace(fit=SimpleNamespace(params=[], x=[]))
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


@pytest.mark.parametrize(("share", "hint"), [(0.02, True), (0.1, True), (0.19, True), (0.21, False), (0.6, False)])
def test_an_effect_must_remove_a_part_of_what_was_kept_out(monkeypatch, share, hint):
    """share: of the squared error on what was kept out."""
    answer = Judged(1.0, np.sqrt(1 - share))
    monkeypatch.setattr(errors, "free_run", lambda *_: (answer.without, None))
    monkeypatch.setattr(errors, "intervals_of", lambda *_: [])
    answer.judge(SimpleNamespace(table=None))
    found = answer.found[0]
    assert (found["confidence"] <= HINTED) is hint
    reasons = answer.evidence[0].reasons
    assert (len(reasons) > 0) is hint and all(f"less than {100 * PART:.0f} %" in r for r in reasons)


class Felt(PadSearch):
    """A search of one pad whose trials say themselves what they lose on the presses left out."""

    def __init__(self):
        self.rng = np.random.default_rng(0)

    def cross(self, trial):
        return np.full(20, trial)


def test_a_touch_effect_must_remove_a_least_share():
    assert not Felt()._earns(0.9, 1.0) and Felt()._earns(0.86, 1.0)


@pytest.mark.parametrize(("after", "offered"), [(0.99, False), (0.91, False), (0.89, True)])
def test_a_fitted_residual_must_take_a_least_share_off(monkeypatch, after, offered):
    """after: rms on what was kept out with the torque that was fitted to what is left, over that without."""
    n = 200
    t = 0.01 * np.arange(n)
    run = SimpleNamespace(t=t, qs=np.sin(9 * t)[:, None], vs=np.cos(7 * t)[:, None])
    noise = np.random.default_rng(0).normal(size=n)
    monkeypatch.setattr(residual_fit, "residual_torque", lambda *_: (noise, np.ones(n, bool)))
    monkeypatch.setattr(residual_fit, "_held_out", lambda *_: (1.0, after))
    found = residual_fit.fit(SimpleNamespace(joint="j", index=0), [run], None, [0], [])
    assert (found is not None) is offered
