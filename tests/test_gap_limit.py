"""A limit of time is a promise: each stage looks at the clock, and says what it left out. Stages and clock are made."""

from types import SimpleNamespace

import numpy as np
import pytest

from dexsim.gap import diagnosis, inquiry
from dexsim.gap.compute import GRACE, JUDGING, PAGE, TimeLimit
from dexsim.gap.diagnosis import PLANNING, Drives
from dexsim.gap.inquiry import Inquiry, Settings
from dexsim.gap.judge import full_model
from dexsim.gap.judge.conclude import Noise
from dexsim.gap.plant.case import build
from dexsim.gap.search import baseline
from dexsim.gap.search.search import JointSearch
from dexsim.gap.touch.diagnosis import SEARCHING, Touch
from tests.test_gap import model, plant_run


@pytest.fixture
def clock(monkeypatch):
    """[s]: what every stage takes for the time."""
    now = [0.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    return now


def test_what_is_left_of_a_limit(clock):
    limit, none = TimeLimit(100.0), TimeLimit(None)
    assert limit.left() == pytest.approx(100 * (1 - JUDGING)) and limit.rest() == pytest.approx(100 * (1 - PAGE))
    deadline = limit.share("a", 0.5)
    clock[0] = 41.0
    assert limit.spent(0.4) and not limit.spent(0.42)
    assert deadline.over() and not deadline.passed()  # a step that is under way may end
    clock[0] = 41.0 + 100 * GRACE
    assert deadline.passed()
    assert none.rest() == np.inf and not none.spent(0.0) and not none.share("a", 1.0).passed()
    limit.leave_out("the replay")
    assert limit.left_out == ["the replay (the limit of 100 s)"]


def test_a_fit_ends_where_it_is_when_time_is_up():
    run = plant_run("a", 0, 3.0, {"*kp": 0.9}, 1)
    s = JointSearch(build(model(), [run])[0], [0], None, [0])
    params = [p for p in s.all_nuisances if p.key in ("kp", "inertia")]
    steps = s.fitter.fit(params, iterations=6).iterations
    s.fitter.passed = lambda: True
    cut = s.fitter.fit(params, iterations=6)
    assert steps > 0 == cut.iterations and cut.x == pytest.approx([p.start for p in params])
    assert np.isfinite(cut.jacobian).all() and cut.jacobian.shape == (len(cut.residual), 2)
    assert s.fitter.perturbed_restarts(params, cut, np.random.default_rng(0)) is cut
    assert s.fitter.toward_prior(params, cut) is cut


def test_the_plain_model_looks_at_the_clock(monkeypatch):
    run = plant_run("a", 0, 3.0, {}, 1)
    case = build(model(), [run])[0]
    batches = []
    simulate = baseline.Fitter.residuals

    def counted(self, params, x, inits=None):
        batches.append(len(x))
        return simulate(self, params, x, inits)

    monkeypatch.setattr(baseline.Fitter, "residuals", counted)
    params, x = baseline.fitted(case, [0])
    whole = sum(batches)
    batches.clear()
    hurried = baseline.fitted(case, [0], passed=lambda: True)
    assert batches[0] == baseline.AT_ONCE and sum(batches) < whole / 2
    assert len(hurried[1]) == len(x) and [p.key for p in hurried[0]] == [p.key for p in params]


@pytest.mark.parametrize("limit, read", [(None, 12), (100.0, 6), (1e-3, 2)])
def test_reading_has_its_share_and_names_what_it_left(limit, read, clock, monkeypatch):
    """5 s a recording: within a quarter of 100 s five are, and the one under way. There is one of both kinds."""
    from dexsim import recording
    from dexsim.recording import mechanism

    def slow(path, *_, **__):
        clock[0] += 5.0
        return SimpleNamespace(path=path, duration=1.0, states=SimpleNamespace(position=None))

    machine = SimpleNamespace(joints=("a",), hand=None, ranges={})
    monkeypatch.setattr(mechanism, "mechanism", lambda *_, **__: machine)
    monkeypatch.setattr(mechanism, "stated_hand", lambda *_: None)
    monkeypatch.setattr(recording, "read", slow)
    from pathlib import Path

    names = [Path(f"{k}.mcap") for k in range(12)]
    w = Inquiry(Settings(names[:8], Path("out"), names[8:]), print, None, TimeLimit(limit))
    inquiry.read_files(w)
    there = [k for k, r in enumerate(w.recordings) if r is not None]
    assert len(w.recordings) == 12 and len(there) == read
    assert any(k < 8 for k in there) and any(k >= 8 for k in there)
    assert [str(w.recordings[k].path) for k in there] == [f"{k}.mcap" for k in there]
    if read < 12:
        (said,) = w.limit.left_out
        assert said.startswith(f"{12 - read} of 12 recordings are not read: ")
        assert all(f"{k}.mcap" in said for k in range(12) if k not in there)


@pytest.mark.parametrize("limit, modelled", [(None, 10), (1000.0, 10), (190.0, 7), (100.0, 2)])
def test_recordings_whose_model_would_take_too_long_are_left_out_evenly(limit, modelled, clock, monkeypatch):
    """0.4 s of modelling for each second of a recording, 10 s each: 40 s in all, and a fifth of 100 s is 20, of 190 38,
    8 of it for a look. Of 1,000 s it would be 200, and nothing is tried: `clock` stands still."""

    def refined(model, runs, device, dt, only):
        clock[0] += 0.4 * sum(r.duration for r in runs)
        return []

    monkeypatch.setattr(diagnosis, "refined_cases", refined)
    monkeypatch.setattr(diagnosis, "_step", lambda runs: 1e-3)
    runs = [SimpleNamespace(duration=10.0, name=str(k), joints=range(40)) for k in range(10)]
    drives = object.__new__(Drives)
    drives.mj_model = None
    settings = SimpleNamespace(device="cpu", joints=None)
    drives.w = SimpleNamespace(runs=list(runs), held=[6, 7, 8, 9], settings=settings, limit=TimeLimit(limit))
    drives._within_the_limit()
    assert len(drives.w.runs) == modelled and (clock[0] == 0.0) == (modelled == 10)
    assert len(drives.w.held) == {10: 4, 7: 3, 2: 1}[modelled]
    if modelled < 10:
        assert [r.name for r in drives.w.runs] == {7: list("0135679"), 2: list("06")}[modelled]
        assert f"{10 - modelled} of 10 recordings are left out" in drives.w.limit.left_out[0]


@pytest.mark.parametrize("spent, seconds", [(0.5, 200.0), (1 - PLANNING + 0.01, 2000.0), (0.5, 100.0)])
def test_no_replay_and_no_plan_in_the_last_moment(spent, seconds, clock, monkeypatch):
    """A plan is one call that nothing ends: it is begun where a minute is left."""
    calls = []
    given = {"j": [full_model.Candidate("believed", 1.0, None)]}
    monkeypatch.setattr(diagnosis.conclude, "candidates", lambda *_: (given, {}))
    monkeypatch.setattr(full_model, "write_best", lambda *given: calls.append(given[9]))
    monkeypatch.setattr(diagnosis.logged_torque, "told", lambda *_: {})
    monkeypatch.setattr(diagnosis, "plan_next", lambda *_: calls.append("plan"))
    drives = object.__new__(Drives)
    settings = SimpleNamespace(replay="mujoco", device="cpu", next_recording=True)
    limit = TimeLimit(seconds)
    w = drives.w = SimpleNamespace(
        limit=limit,
        runs=[],
        settings=settings,
        m=SimpleNamespace(joints=("j",)),
        readable=[],
        by_name={},
        progress=None,
        notes=[],
        clock=SimpleNamespace(lap=lambda _: None),
    )
    drives.parts = SimpleNamespace(test=[1], span_test=None)
    drives.searched, drives.noise = [], Noise(1.0, "split", {"j": 1.0})
    drives.by_torque, drives.stages, drives.answers, drives.plains = [], [], [], []
    clock[0] = seconds * spent
    drives.write()
    diagnosis._next(SimpleNamespace(), w, [])
    replayed, planned = spent < 1 - PLANNING, limit.rest() > diagnosis.PLAN
    assert planned == (seconds == 200.0)
    assert calls == ["mujoco" if replayed else "none"] + ["plan"] * planned
    said = ["not replayed in the engine that trains"] * (not replayed)
    said += ["no next recording is planned"] * (not planned)
    assert [x.split(" (")[0] for x in limit.left_out] == said


def test_pads_wait_no_longer_than_half_of_the_limit(clock):
    def run():
        clock[0] += 100 * SEARCHING + 1
        return "found"

    touch = object.__new__(Touch)
    touch.limit, touch.progress = TimeLimit(100.0), None
    touch.pads = [SimpleNamespace(search=SimpleNamespace(run=run), outcome=None, name=n) for n in ("thumb", "index")]
    touch.search()
    assert touch.pads[0].outcome == "found" and touch.pads[1].search is None and touch.pads[1].outcome is None
    assert touch.limit.left_out == ["the index's pad is not searched (the limit of 100 s)"]
