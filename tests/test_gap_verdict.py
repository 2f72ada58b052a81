"""The verdict follows the error on what was held out; what is held out leaves every regime to be fitted; limits of
time."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from dexsim.actuator.table import ServoTable
from dexsim.gap.compute import TimeLimit
from dexsim.gap.diagnosis import Drives
from dexsim.gap.finding import Finding
from dexsim.gap.inquiry import Judged, TouchResult, empty
from dexsim.gap.judge import conclude, held_out
from dexsim.gap.judge.joint_answer import JointAnswer
from dexsim.gap.read import Run
from dexsim.gap.rules import JUDGE
from dexsim.gap.search.hypotheses import Outcome
from dexsim.gap.search.search import SearchedJoint


def finding(confidence: float, joint: str = "a", effect: str = "backlash") -> Finding:
    return Finding(effect, confidence, "", [joint], held_out={"before": 2.0, "after": 1.0})


def test_names_on_joints_that_need_no_effect_are_hints():
    found = [finding(0.99, "a"), finding(0.9, "b"), finding(0.4, "b")]
    found = held_out.settle([held_out.unneeded(f, quiet={"a"}) for f in found])
    assert [f.hint for f in found] == [True, False, True]
    assert found[0].confidence < JUDGE.firm and found[1].confidence == 0.9
    assert held_out.firm(found) == [found[1]]


def finding_of(effect: str, confidence: float, joint: str = "a", **held) -> Finding:
    errors = {"before": 2.0, "after": 1.0, "removed_low": 0.5} | held
    return Finding(effect, confidence, "now and then", [joint], held_out=errors)


def decided(*found: Finding, before=4.0, after=1.0, floor=1.0, touch=None, **judged) -> SimpleNamespace:
    """Return a diagnosis of these findings, decided; errors in rad."""
    position = {"error": "position_rmse_rad", "before": before, "before_low": 0.9 * before, "after": after}
    d = SimpleNamespace(
        data=empty() | {"noise_floor": {"position_rad": floor}}, findings=list(found),
        judged=Judged(position, **judged), touch=touch, sentence="", mechanism=None, joints={},
    )  # fmt: skip
    conclude.decide(d)
    return d


PUSH = {"effect": "external_force", "held_out": None}
BAD = {"effect": "bad_channel", "held_out": None}
EFFORT = {"error": "effort_rmse_Nm", "before": 2.0, "before_low": 2.0, "after": 1.0}


@pytest.mark.parametrize("other", [{}, PUSH, BAD, {"effect": "current_sensor"}])
def test_whatever_is_named_below_a_half_is_a_hint_and_not_in_the_sentence(other):
    """A name of a joint, a push, a signal or an effort: after what is sure, unknown to the verdict."""
    d = decided(replace(finding_of("lag", 0.45), **other), finding_of("backlash", 0.9, "b"), effort=EFFORT)
    assert [f.get("hint", False) for f in d.data["findings"]] == [False, True]
    assert d.data["verdict"] == "explained" and "Joint b" in d.sentence and "Joint a" not in d.sentence
    alone = decided(replace(finding_of("lag", 0.45), **other), effort=EFFORT)
    assert alone.data["verdict"] == "unknown" and alone.sentence.startswith("Something is missing that no effect")
    assert decided(replace(finding_of("lag", 0.45), **other), before=1.1, effort=EFFORT).data["verdict"] == "none"


def test_what_the_torque_whispers_decides_nothing():
    """The torque route is added after the joints: its error is the verdict's only where it names surely."""
    behind = {"error": "effort_rmse_Nm", "before": 0.5, "before_low": None, "after": 0.2}
    d = SimpleNamespace(data={}, findings=[], judged=Judged({}))
    named = [SimpleNamespace(effect="stribeck_friction", before=0.5, after=0.2)]
    by_torque = [(SimpleNamespace(joint="a"), SimpleNamespace(named=named), ["r"])]
    conclude.add_behind(d, [finding_of("stribeck_friction", 0.45, error="effort_rmse_Nm")], by_torque)
    assert d.judged.torque is None and len(d.findings) == 1
    sure = finding_of("stribeck_friction", 0.9, error="effort_rmse_Nm")
    assert decided(sure, torque=behind).data["verdict"] == "partly_explained"
    whispered = decided(finding_of("stribeck_friction", 0.45, error="effort_rmse_Nm"))
    assert whispered.data["verdict"] == "unknown" and whispered.data["held_out"]["error"] == "position_rmse_rad"
    # beside a name that the motion bears out the torque's counts for nothing in the motion's verdict
    both = decided(sure, finding_of("backlash", 0.45), after=1.0, torque=behind)
    assert both.data["held_out"]["error"] == "effort_rmse_Nm" and both.data["findings"][1]["hint"]


@pytest.mark.parametrize(("low", "word"), [(0.01, "explained"), (-0.03, "unknown")])
def test_no_verdict_by_a_name_that_does_not_surely_lower_the_error(low, word):
    assert decided(finding_of("backlash", 0.9, removed_low=low)).data["verdict"] == word
    assert decided(finding_of("current_sensor", 0.9, removed_low=low), effort=EFFORT).data["verdict"] == word
    quiet = decided(finding_of("backlash", 0.9, removed_low=-0.03), before=1.2)
    assert quiet.data["verdict"] == "none" and quiet.data["findings"][0]["hint"]


@pytest.mark.parametrize(
    ("low", "after", "word"), [(-0.01, 1.0, "explained"), (-0.03, 1.0, "unknown"), (-0.01, 1.97, "unknown")]
)
def test_what_acts_in_a_few_moments_surely_lowers_the_error_where_draws_without_them_show_no_loss(low, after, word):
    """A limit that is reached for half a second takes most of the error away, and nothing in draws without it."""
    limit = finding_of("torque_limit", 0.9, before=2.0, after=after, removed_low=low, removed_high=2.8)
    assert decided(limit).data["verdict"] == word


def test_what_was_not_judged_is_kept_whatever_the_verdict_goes_by():
    d = decided(finding_of("current_sensor", 0.9), effort=EFFORT)
    assert d.data["held_out"]["error"] == "effort_rmse_Nm" and d.data["verdict"] == "explained"
    d.data["held_out"]["not_judged"] = ["saturation of a"]
    conclude.decide(d)
    assert d.data["held_out"]["not_judged"] == ["saturation of a"]


def test_touch_beside_joints_is_one_verdict():
    for confidence, alone, beside in ((0.9, "explained", "explained"), (0.3, "unknown", "partly_explained")):
        gain = replace(finding_of("tactile_gain", confidence), joints=(), taxels=["0:1"])
        touch = TouchResult([gain], before=(0.3, 0.2, 0.4), after=(0.03, 0.03, 0.03), floor=0.03)
        d = decided(before=1.1, touch=touch)
        assert d.data["verdict"] == alone and d.data["held_out"]["error"] == "tactile_rmse_N"
        d = decided(finding_of("backlash", 0.9), touch=touch)
        assert d.data["verdict"] == beside and d.data["held_out"]["error"] == "position_rmse_rad"
        assert touch.findings[0].hint is (confidence < 0.5)


def test_the_sentence_says_what_the_plain_model_leaves_where_that_is_handed_on():
    d = decided(after=3.0)
    assert "3,000 mrad are left where" in d.sentence
    joints = {"a": {}, "b": {}}
    by_plain = "2,500 mrad are left by the plain model, which is handed on, where"
    for handed, said in ((["a", "b"], by_plain), (["a"], "3,000 mrad are left where")):
        d.data["baseline"] = {"error": 2.5, "joints": joints, "handed_on": handed}
        conclude.decide(d)
        assert said in d.sentence


def test_what_is_wrong_with_an_effort_alone_is_a_hint_below_a_half():
    """The motion of such a joint needs no effect, and that says nothing of its sensor; a whisper stays one."""
    found = held_out.settle([finding(c, effect="current_sensor") for c in (0.9, 0.45)])
    assert [f.hint for f in found] == [False, True]
    assert held_out.verdict(found[1:], 1.0, 1.15, 1.1, 1.14, True) == "none"


@pytest.mark.parametrize(
    ("before", "after", "confidence", "word"),
    [
        (1.2, 0.9, 0.45, "none"),
        (1.2, 0.9, 0.9, "explained"),
        (4.0, 1.1, 0.9, "explained"),
        (4.0, 1.1, 0.6, "partly_explained"),
        (4.0, 2.5, 0.9, "partly_explained"),
        (4.0, 3.5, 0.9, "unknown"),
        (4.0, 1.0, 0.45, "unknown"),
    ],
)
def test_no_verdict_by_a_whisper(before, after, confidence, word):
    found = held_out.settle([finding(confidence)])
    assert held_out.verdict(found, 1.0, before, 0.9 * before, after, True) == word


@pytest.mark.parametrize(
    ("before", "step", "confidence", "word"),
    [(2.0, 1.7, 0.4, "unknown"), (2.0, 1.8, 0.4, "none"), (2.0, 1.8, 0.6, "unknown"), (5.1, 9.0, 0.4, "unknown")],
)
def test_what_is_left_within_a_step_of_the_encoder_is_no_verdict(before, step, confidence, word):
    """Unless it has a name, or is far beyond the floor."""
    found = held_out.settle([finding_of("backlash", confidence, after=1.9, removed_low=-0.5)])
    assert held_out.verdict(found, 1.0, before, 0.9 * before, before, True, step=step) == word


@pytest.mark.parametrize(
    ("before", "confidence", "word"), [(1.2, 0.9, "explained"), (1.2, 0.4, "none"), (4.0, 0.9, "unknown")]
)
def test_a_wrong_signal_is_an_answer_where_the_rest_is_followed(before, confidence, word):
    """`none` would say that nothing was amiss; where the rest is not followed either the signal does not explain it."""
    bad = Finding("bad_channel", confidence, "", ["a"])
    assert held_out.verdict([bad], 1.0, before, 0.9 * before, before, True) == word


def test_the_interval_of_a_gain_holds_it_and_knows_chance():
    rng = np.random.default_rng(1)
    t = np.arange(0, 20, 0.01)
    noise = rng.standard_normal(len(t)) ** 2
    low, high = held_out.gain_interval(4 * noise, noise, t)
    assert low < 0.75 < high and high - low < 0.15
    few = np.where(t > 18, 400.0, 1.0)  # what acts in a tenth of the time: draws without it show no loss
    low, high = held_out.gain_interval(few * noise, 1.02 * noise, t)
    assert -0.01 < low < 0.5 < high
    low, high = held_out.gain_interval(noise, rng.permutation(noise), t)
    assert low < 0 < high


class Held:
    """Regimes of runs, as `held_out.split` asks a case for them: T s of each at 100 Hz."""

    def __init__(self, saturated: list[tuple[float, float]], T: float = 10.0):
        n = int(100 * T)
        self.joint, self.moved = "a", True
        self.scales = type("S", (), {"peak_speed": 1.0})()
        slow = 0.1 * np.sin(np.linspace(0, 6, n))
        on = np.concatenate([(np.arange(n) / 100 >= a) & (np.arange(n) / 100 < b) for a, b in saturated])
        count = len(saturated) * n
        self.regimes = {
            "saturation": 2.0 * on,
            "_asked": np.ones(count),
            "_speed": np.tile(slow, len(saturated)),
            "speed": np.full(count, 1.0),
            "load": np.full(count, 1.0),
            "acceleration": np.full(count, 1.0),
            "position": np.tile(np.sin(np.linspace(0, 40, n)), len(saturated)),
        }
        times = {"t": np.tile(np.arange(n) / 100, len(saturated)), "run_of": np.repeat(np.arange(len(saturated)), n)}
        self.plant = type("P", (), times | {"rows": staticmethod(lambda i: slice(i * n, (i + 1) * n))})()
        self.runs = [
            type("R", (), {"t": np.arange(n) / 100, "q": slow[:, None], "duration": T, "name": f"r{i}"})()
            for i in range(len(saturated))
        ]


def test_what_alone_visits_a_regime_is_not_held_out_whole():
    # the last, which used to be held out, is the only one at its limit
    case = Held([(0, 0), (0, 0), (0, 0), (1.0, 9.0)])
    parts = held_out.split(case.runs, [], [0, 1, 2, 3], [case])
    assert parts.test == [2, 3] and parts.train == [0, 1, 3] and not parts.not_judged
    assert parts.span_train[3][1] == parts.span_test[3][0] == 7.5 and parts.span_test[2][0] == 0.0


def test_a_recording_whose_end_does_not_visit_a_regime_takes_no_others_place():
    """The last is held out and stays cold. Of two that are warm the first is at its begin alone: the second's end is
    held out, or nothing that drifts with temperature would show."""
    case = Held([(0, 0), (0, 0), (1.0, 9.0), (0, 0), (1.0, 9.0)])
    warm = Held([(0, 0), (1.0, 4.0), (0, 0), (0, 9.9), (0, 0)]).regimes["saturation"] > 0
    case.regimes["temperature"] = 20.0 + 20.0 * warm
    parts = held_out.split(case.runs, [], [0, 1, 2, 3, 4], [case])
    assert parts.test == [3, 4] and parts.span_test[3][0] == 7.5


def test_a_regime_that_was_only_held_out_is_said_to_be_unjudged():
    case = Held([(0, 0), (0, 0), (1.0, 9.0)])
    parts = held_out.split(case.runs, [2], [0, 1, 2], [case])
    assert parts.test == [2] and "saturation of a" in parts.not_judged
    inside = parts.apart["a"]
    # with the half second before and after it, in which a free run is on its way back
    assert np.flatnonzero(inside)[[0, -1]].tolist() == [2000 + 50, 2000 + 949] and inside.sum() == 900
    both = Held([(0, 0), (2.0, 4.0), (1.0, 9.0)])
    parts = held_out.split(both.runs, [2], [0, 1, 2], [both])
    assert not parts.not_judged and not parts.apart


@pytest.mark.parametrize(
    ("before", "after", "found", "word"),
    [
        (1.1, 1.1, [], "none"),
        (4.0, 1.1, [("backlash", 0.9)], "explained"),
        (4.0, 2.0, [("backlash", 0.9)], "partly_explained"),
        (4.0, 4.0, [], "unknown"),
    ],
)
def test_what_no_fitted_recording_shows_makes_no_verdict_unknown(before, after, found, word):
    """The error away from it decides then, and the sentence says what is not judged."""
    names = [finding_of(effect, confidence) for effect, confidence in found]
    near = {"error": "position_rmse_rad", "before": before, "before_low": 0.9 * before, "after": after, "how": "near"}
    given = empty()["held_out"] | {"not_judged": ["saturation of a"]}
    d = SimpleNamespace(
        data=empty() | {"noise_floor": {"position_rad": 1.0}, "held_out": given}, findings=names,
        judged=Judged({**near, "before": 90.0, "before_low": 80.0, "after": 88.0, "how": "all"}, shown=(near, False)),
        touch=None, sentence="", mechanism=None, joints={},
    )  # fmt: skip
    conclude.decide(d)
    assert d.data["verdict"] == word and "Not judged: saturation of a" in d.sentence
    assert d.data["held_out"]["before"] == (90.0 if word == "unknown" else before)


def test_ends_of_all_recordings_where_there_are_few():
    case = Held([(0, 0), (0, 0)])
    parts = held_out.split(case.runs, [], [0, 1], [case])
    assert parts.train == parts.test == [0, 1] and parts.span_train[0] == (0.0, 7.5)


def test_a_part_that_stands_still_proves_nothing():
    """One stroke at the start of a log: its last quarter cannot be held out, and what is found is doubted."""
    t = np.arange(0, 4, 0.01)
    for last, proven in ((0.5, False), (3.6, True)):
        q = np.clip((t - last + 0.3) / 0.3, 0, 1)[:, None] + (0.0 if last < 1 else 0.3 * np.sin(t)[:, None])
        run = Run("a", ("joint",), t, q, t, q, None, np.zeros(3))
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(held_out, "visits", lambda *_: ([], np.zeros((0, 1))))
            parts = held_out.split([run], [], [0], [])
        assert parts.proven is proven and parts.span_test[0][1] == run.duration
        assert parts.span_test[0][0] == (pytest.approx(0.75 * run.duration) if proven else 0.0)
        assert ("nothing" in parts.how) is not proven


def test_a_limit_ends_searches_and_says_which():
    limit = TimeLimit(1e6)
    first, second = limit.share("a", 0.5), limit.share("b", 1.0)
    assert not first.over() and not limit.cut
    limit.stop()
    assert second.over() and limit.cut == {"b"} and limit.left() == 0.0
    assert TimeLimit(1e-9).share("c", 1.0).over()


@pytest.mark.parametrize("spent, again", [(10.0, ["b"]), (700.0, [])])
def test_a_joint_whose_share_was_too_short_gets_what_the_others_left(spent, again, monkeypatch):
    """Out of 1,000 s, 800 for searches, each of eight joints has its share; b needed more. Where the others hardly used
    theirs b is searched again, in two thirds of what is left; where they did, a search anew would end where it did."""
    clock = [0.0]
    monkeypatch.setattr("dexsim.gap.compute.time.monotonic", lambda: clock[0])
    monkeypatch.setattr("dexsim.gap.diagnosis.workers", lambda device, jobs: 1)
    drives = object.__new__(Drives)
    limit = TimeLimit(1000.0)
    drives.w = SimpleNamespace(limit=limit, settings=SimpleNamespace(device="cpu"), progress=None)
    drives.cases, drives._left = [SimpleNamespace(joint=j) for j in "abcdefgh"], 8
    ends = {}

    def search_of(k, tell):
        case = drives.cases[k]
        deadline = limit.share(case.joint, min(1.0, 1 / drives._left))
        ends[case.joint] = deadline.seconds
        drives._left -= 1
        return SimpleNamespace(case=case, deadline=deadline), case.joint

    drives._search_of = search_of
    answers = [search_of(k, None) for k in range(8)]
    first = answers[1]
    clock[0] = first[0].deadline.until
    assert first[0].deadline.over() and limit.cut == {"b"} and first[0].deadline.seconds == pytest.approx(800 / 7)
    clock[0], before = spent, dict(ends)
    drives._search_longer(answers)
    assert (answers[1] is first) == (not again)
    assert limit.cut == (set() if again else {"b"})
    assert {j for j in ends if ends[j] != before[j]} == set(again)
    if again:
        assert ends["b"] == pytest.approx((800 - spent) * 2 / 3)


@pytest.mark.parametrize("limit, again", [(None, True), (1000.0, True), (150.0, False)])
def test_what_took_longer_than_is_left_is_not_begun_anew(limit, again, monkeypatch):
    """A joint that the others move otherwise is searched again only where that can end where the first search did: the
    second answer takes the first one's place, but where the first follows better all the same."""
    clock = [0.0]
    monkeypatch.setattr("dexsim.gap.compute.time.monotonic", lambda: clock[0])
    monkeypatch.setattr("dexsim.gap.diagnosis.workers", lambda device, jobs: 2)
    monkeypatch.setattr("dexsim.gap.diagnosis._unsettled", lambda found: True)
    monkeypatch.setattr("dexsim.gap.diagnosis._other", lambda search, found: True)
    monkeypatch.setattr("dexsim.gap.diagnosis._moved_by", lambda model, joints, found: [])
    monkeypatch.setattr("dexsim.gap.diagnosis._follows_better", lambda old, search, found: old == "first 3")
    drives = object.__new__(Drives)
    drives.w = SimpleNamespace(limit=TimeLimit(limit), settings=SimpleNamespace(device="cpu"), progress=None)
    drives.mj_model, drives.unknown_controllers = None, set()
    drives.cases = [SimpleNamespace(joint=j) for j in "abcd"]
    drives._coupled_by, drives._begun = lambda trials: None, lambda k, tell: None
    drives._search_of = lambda k, tell: (SimpleNamespace(case=drives.cases[k], took=0.0), f"second {k}")
    answers = [(SimpleNamespace(case=c, took=40.0), f"first {k}") for k, c in enumerate(drives.cases)]
    clock[0] = 60.0  # of 150 s, 120 for searches, 60 are left: 30 a joint, two at a time
    drives._search_again(answers)
    assert [x for _, x in answers] == [f"{'second' if again and k < 3 else 'first'} {k}" for k in range(4)]


def test_touch_with_nothing_but_hints_within_its_noise_is_none():
    error = (0.03, 0.03, 0.03)
    touch = TouchResult([Finding("tactile_gain", 0.3, "", taxels=["0:1"])], before=error, after=error, floor=0.03)
    d = decided(before=0.9, touch=touch)
    assert d.data["verdict"] == "none" and touch.findings[0].hint


@pytest.mark.parametrize(
    ("errors", "kinds", "dropped"),
    [
        ({"a": 3.0, "b": 0.7}, {}, "b"),  # what was held out is followed better without b
        ({"a": 3.0, "b": 1.2}, {}, None),  # each lowers the error
        ({"a": 0.8, "b": 0.7}, {}, "b"),  # the one that harms most
        ({"a": 3.0, "b": 0.7}, {"b": "rings"}, None),
        ({"a": 3.0, "b": 0.7}, {"b": "effort_only"}, None),
        ({"a": 0.5}, {}, None),  # a joint's only effect is judged with the joint
        ({"a": 3.0, "b": None}, {}, None),  # better on the whole by one moment: it may remove much elsewhere
    ],
)
def test_what_was_held_out_takes_one_of_several_effects_back(errors, kinds, dropped):
    """errors: rms error without an effect, with all 1; None: half of it, but for a moment in which it is 8 with all."""
    t = np.arange(0.0, 20.0, 0.01)
    answer = object.__new__(JointAnswer)
    answer.t, answer.measured = t, np.zeros(len(t))
    moment = (t > 3.0) & (t < 3.5)
    answer.after = np.where(moment & (None in errors.values()), 64.0, 1.0) * np.ones(len(t))
    members = []
    answer._trials = {}
    for name, error in errors.items():
        kind = {k: kinds.get(name) == k for k in ("rings", "effort_only")}
        members.append(SimpleNamespace(id=name, effect=SimpleNamespace(**kind)))
        q = np.where(moment, 0.5, 1.5) if error is None else np.full(len(t), error)
        answer._trials[name] = name, q, q
    answer.best = SimpleNamespace(members=members)
    assert answer._without_refuted() == dropped


@pytest.mark.parametrize(
    ("alone", "now", "before", "said"),
    [
        (1.0, 0.97, 0.48, 0.97),  # what went explains nothing by itself: it was in the way
        (1.0, 0.70, 0.99, 0.99),  # what is left was known with it, too
        (0.7, 0.82, 0.48, 0.48),  # by itself it explains half of the squared error: another explanation
    ],
)
def test_what_is_left_is_believed_as_with_or_without_what_was_taken_back(alone, now, before, said):
    """alone: rms error of what was held out with the other effect alone, of 1 without any; confidences of what is left,
    judged without the other and with it."""

    class Answer(JointAnswer):
        def __init__(self, confidence, earlier=None):
            self.earlier, self.evidence, self.before = earlier, [], np.ones(100)
            self.measured, self.sure = np.zeros(100), confidence
            self.best = SimpleNamespace(members=[SimpleNamespace(id="lag")])

        def _finding(self, mm, m):
            self.evidence.append(SimpleNamespace(effect=mm.id, confidence=self.sure))
            return Finding("lag", self.sure, "")

        def _without_id(self, effect):
            return np.full(100, alone)

    answer = Answer(now, Answer(before))
    answer.judge(None)
    assert answer.found[0].confidence == answer.evidence[0].confidence == said


def test_what_is_taken_back_does_not_reach_a_search():
    """Joints are judged while others are still searched by what was found of them: only what follows the searches goes
    on from what stands."""

    class Answer(JointAnswer):
        def __init__(self, case, search, outcome, kept):
            self.outcome, self.earlier = outcome, None

        def _without_refuted(self):
            return {"three": "two", "two": "one"}.get(self.outcome.best)

        def locate(self, rng, seed):
            pass

    found = Outcome("j", "none", "three", {}, {}, [])
    answer = Answer.of(None, None, found, None)
    assert (found.best, answer.outcome.best) == ("three", "one")
    assert [answer.earlier.outcome.best, answer.earlier.earlier.outcome.best] == ["two", "three"]
    drives = object.__new__(Drives)
    drives.searched, drives._answer = [SearchedJoint("case", "search", found)], lambda search, outcome: answer
    drives._take_back()
    assert drives.searched == [SearchedJoint("case", "search", answer.outcome)] and found.best == "three"


def test_each_motion_has_the_floor_of_its_own_repeats():
    """Ramps repeat to 2 mrad, steps to 190: pooled, a ramp that is missed by 20 would pass for noise."""
    t, rng, runs = np.arange(0.0, 4.0, 0.01), np.random.default_rng(0), []
    table = ServoTable.from_dict({"joints": {"*": {"kp": 1.0}}})
    for name, size in (("ramp", 2e-3), ("step", 0.19)):
        cmd = (t if name == "ramp" else np.sign(np.sin(t)))[:, None]
        for k in range(2):
            q = cmd + size * np.sqrt(2) * (k - 0.5) * np.ones_like(cmd) + 1e-5 * rng.normal(size=cmd.shape)
            runs.append(Run(f"{name}{k}", ("j",), t, cmd, t, q, table, np.zeros(3)))
    cases = [SimpleNamespace(joint="j", index=0, sigma=1e-4)]
    pooled, own = held_out.floor(runs, cases)[2]["j"], held_out.by_motion(runs, cases)
    assert pooled > 0.06 and [own[i]["j"] for i in range(4)] == pytest.approx([2e-3, 2e-3, 0.19, 0.19], rel=0.02)
    quiet = {"floor": pooled, "before": 0.02, "before_low": 0.02, "after": 0.02, "structured": True, "quiet": True}
    assert held_out.verdict([], **quiet) == "none" and held_out.verdict([], **quiet, loud=True) == "unknown"
