"""A loop that rings by itself, faster than its recordings resolve: what makes it ring is named by how much it shakes,
nobody is said to push it, and its readings are not called stale."""

from __future__ import annotations

import copy
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from test_gap import model, plant_run
from test_gap_torque_route import arm, run

from dexsim.gap.finding import Finding
from dexsim.gap.judge import conclude, confidence
from dexsim.gap.judge.held_out import Split
from dexsim.gap.judge.joint_answer import JointAnswer, rms
from dexsim.gap.plant.case import build
from dexsim.gap.read import conditions
from dexsim.gap.rules import SEARCH
from dexsim.gap.search import logged_torque, ringing
from dexsim.gap.search.search import JointSearch, without_search
from dexsim.recording.audit_values import repeats

SERVO = {"kp": 4.0, "kd": 0.2, "torque_limit": 2.0}
SOFT = {"softness": 0.1, "rebound": 0.16}


@pytest.fixture(scope="module")
def soft() -> JointSearch:
    """Return three recordings of a drive whose transmission gives, so that its loop rings once a step has begun it;
    the last is held out."""
    runs = [plant_run(f"run{k}", k, 4.0, SOFT, seed=k, servo=SERVO) for k in (1, 3, 2)]
    for r in runs:
        r.smooth()
    return JointSearch(
        build(model(), runs)[0], [0, 1], None, conditions(runs), allowed={"compliance", "coulomb_friction"}
    )


@pytest.mark.slow
def test_what_makes_a_loop_ring_is_named_by_how_much_it_shakes(soft):
    nothing = without_search(soft)
    rung = ringing.Ringing(soft, nothing.none)
    assert 0.2 < rung.loud.mean() < 0.9  # before the step that begins it the loop is quiet
    found = ringing.answered(soft, nothing)
    assert found.best.ids == ("compliance",) and found.none is nothing.none
    at = {p.key: x for p, x in zip(found.best.fit.params, found.best.fit.x, strict=True)}
    assert at["compliance.softness"] == pytest.approx(SOFT["softness"], rel=0.3)
    assert rung.of(found.best).sum() < 0.5 * rung.of(nothing.none).sum()
    assert ringing.shown(soft, found, [2], None) and not ringing.shown(soft, nothing, [2], None)


def test_nothing_makes_a_joint_ring_that_has_no_loop(soft):
    """What is fed back makes a joint ring: of one whose loop gives hardly any torque nothing is asked."""
    nothing = without_search(soft)
    s = soft.case.scales
    for share, has_loop in ((0.5, False), (2.0, True)):
        bare = copy.copy(soft)
        bare.case = replace(soft.case, scales=replace(s, stiffness=share * SEARCH.doubt * s.tau / s.span))
        assert ringing.without_loop(bare.case) != has_loop
        if not has_loop:
            assert ringing.answered(bare, nothing) is nothing
    assert not ringing.without_loop(soft.case)


@pytest.mark.slow
def test_play_rings_on_where_it_was_struck():
    """A joint with play that sticks is at rest in one state and rattles in another, at the same command: windows that
    begin rattling are begun so."""
    play = {"backlash": 0.03, "rebound": 0.05, "coulomb_friction": 0.05}
    servo = SERVO | {"coulomb_friction": 0.05}
    runs = [plant_run(f"run{k}", k, 4.0, play, seed=k, servo=servo) for k in (1, 3, 2)]
    for r in runs:
        r.smooth()
    search = JointSearch(build(model(), runs)[0], [0, 1], None, conditions(runs), allowed={"backlash"})
    nothing = without_search(search)
    found = ringing.answered(search, nothing)
    at = {p.key: x for p, x in zip(found.best.fit.params, found.best.fit.x, strict=True)}
    assert found.best.ids == ("backlash",) and at["backlash.gap"] == pytest.approx(0.03, rel=0.25)
    rattles = ringing.Ringing(search, nothing.none)
    assert rattles.rung.sum() >= 4 and 0.3 < rattles.speed < 3.0
    begun_ringing = rattles.of(found.best)
    assert begun_ringing.sum() < 0.05 * rattles.of(nothing.none).sum()
    rattles.speed = 0.0
    assert rattles.of(found.best).max() > 3 * begun_ringing.max()


def test_a_name_that_makes_a_joint_ring_as_it_does_is_as_sure_as_that():
    """What no free run keeps step with is judged by how it rings; a doubted name at most."""
    for rings, share, sure in ((0.95, 1.0, 0.7), (0.8, 0.6, 0.4), (0.4, 0.9, 0.45), (0.95, 0.3, 0.275)):
        e = confidence.Evidence("backlash", "elbow", share, 0.0, 1.0, 1.0, [], 1, ["not borne out"], 0.0)
        other = confidence.Evidence("backlash", "wrist", 1.0, 0.0, 1.0, 1.0, [], 1, ["not borne out"], 0.0)
        conclude._judged_by_ringing(SimpleNamespace(evidence=[e, other]), {"elbow": rings})
        assert e.confidence == pytest.approx(sure, abs=0.01) and len(e.reasons) == 1, (rings, share)
        assert other.confidence == 0.0 and other.reasons == ["not borne out"]


def answer_of(soft: JointSearch, found) -> JointAnswer:
    return JointAnswer(soft.case, soft, found, Split([None] * 3, [0, 1], [2]))


@pytest.mark.slow
def test_a_joint_that_rings_is_exempt_only_where_its_error_does_not_surely_rise(soft, monkeypatch):
    """No free run keeps step with a true name either: its error neither falls nor surely rises. A name with which it
    does is a hint, and is not handed on."""
    answer = answer_of(soft, ringing.answered(soft, without_search(soft)))
    assert rms(answer.after) > rms(answer.before)
    plain = SimpleNamespace(joint="joint", error_before=1.0, error=1e-9)  # it does not ring, and follows no better

    def written():
        given, refused = conclude.candidates([answer], [plain], {}, ("joint",))
        return [c.name for c in given["joint"]], refused

    assert written() == (["found", "found, as fitted"], {})
    monkeypatch.setattr(conclude, "_rings", lambda a: 0.0)
    assert written()[0][0] == "believed" and written()[0][-1] == "plain"
    monkeypatch.setattr(conclude, "_rings", lambda a: 1.0)
    answer.after = 3.6 * answer.before
    names, worse = written()
    assert "by more with it" in worse["joint"] and not any(n.startswith("found") for n in names)
    e = confidence.Evidence("compliance", "joint", 1.0, 0.0, 1.0, 1.0, [], 1, [], 0.0)
    d = SimpleNamespace(evidence=[e], notes=[])
    conclude._judged_by_ringing(d, {"joint": 0.95})
    conclude._not_better(d, worse)
    assert e.confidence < 0.5 and "is not handed on" in d.notes[0]


def test_a_joint_that_does_not_ring_is_left_as_it_was_found():
    runs = [plant_run(f"run{k}", 1, 3.0, {"coulomb_friction": 0.06}, seed=k, servo=SERVO) for k in (0, 1)]
    for r in runs:
        r.smooth()
    search = JointSearch(build(model(), runs)[0], [0], None, conditions(runs), allowed={"compliance"})
    nothing = without_search(search)
    assert nothing.none.fit.loss > 2 and not ringing.Ringing(search, nothing.none).loud.any()
    assert ringing.answered(search, nothing) is nothing
    assert not ringing.shown(search, nothing, [1], None)


def swinging(t: np.ndarray) -> np.ndarray:
    """Return rad: swings of 83 Hz in two stretches."""
    on = ((t > 3.0) & (t < 6.0)) | ((t > 11.0) & (t < 15.0))
    return np.where(on, 0.02 * np.sin(2 * np.pi * 83.0 * t), 0.0)


def test_nobody_pushes_a_joint_that_rings():
    """A loop that rings answers with torque that no motion below the samples' rate explains."""
    model, runs = arm(), []
    for seed, rings in ((0, True), (1, False)):
        r = run(model, seed)
        if rings:
            swing = swinging(r.t)
            r.q[:, 1] += swing
            r.torque[:, 1] -= np.where(swing != 0, 5.0 * np.sign(np.sin(2 * np.pi * 0.7 * r.t)), 0.0)
        runs.append(r)
    assert logged_torque.find_pushes(model, runs, [0, 1]) == []
    runs[0].q[:, 0] += swinging(runs[0].t)  # the shoulder, which carries the elbow, rings in its place
    runs[0].q[:, 1] -= swinging(runs[0].t)
    assert logged_torque.find_pushes(model, runs, [0, 1]) == []
    runs[0].q[:, 0] -= swinging(runs[0].t)  # the same torque where nothing rings
    assert [p.joint for p in logged_torque.find_pushes(model, runs, [0, 1])] == ["elbow"]


def test_what_is_followed_to_the_noise_is_not_pushed():
    push = logged_torque.Push("elbow", 1.0, (0.9, 1.1), 0.5, False, False)
    finding = Finding("torque_ripple", 0.9, "", ["elbow"], held_out={"before": 0.02, "after": 0.001})

    def claimed(after: float, loss: float, ringing: frozenset[str] = frozenset()) -> list[str]:
        data = {
            "verdict": "explained",
            "noise_floor": {"position_rad": 0.001},
            "held_out": {"before": 0.02, "after": after, "error": "position_rmse_rad"},
            "unexplained": {"depends_on": []},
        }
        outcome = SimpleNamespace(joint="elbow", best=SimpleNamespace(fit=SimpleNamespace(loss=loss)))
        joints = {"elbow": {"after": after, "sigma": 0.001}}
        d = SimpleNamespace(data=data, notes=[], sentence="", mechanism=None, joints=joints, outcomes=[outcome])
        d.ringing, d.findings = ringing, [finding]
        conclude.claim_push(d, [push])
        assert len(d.notes) == 1
        return [f.effect for f in d.findings]

    assert claimed(0.0011, 1.1) == ["torque_ripple"]
    assert claimed(0.005, 1.1) == ["external_force"]  # what was held out is not followed
    assert claimed(0.0011, 9.0) == ["external_force"]  # nor what was fitted
    # nothing keeps step with a joint that rings by itself: what was found rings as it does
    assert claimed(0.005, 9.0, frozenset(("elbow",))) == ["torque_ripple"]


def test_a_reading_that_shakes_and_stands_by_chance_is_not_repeated():
    t, quantum, rng = np.arange(0.0, 20.0, 0.01), 1.5e-3, np.random.default_rng(0)
    slow = 0.3 * np.sin(0.7 * t)
    read = lambda x: np.round((x + 5e-4 * rng.standard_normal(len(t))) / quantum) * quantum  # noqa: E731
    assert not repeats(t, read(slow + 0.02 * np.sin(2 * np.pi * 71.3 * t))).any()
    steady = read(1.5 * np.sin(0.7 * t))
    steady[50::40] = steady[49:-1:40]  # old readings, sent again
    assert repeats(t, steady).sum() > 20
