"""The search's judgement of what lasts: fits of their own without each condition, the verdict's word, temperature's
reference."""

from __future__ import annotations

import re
import time
from types import SimpleNamespace

import numpy as np
import pytest

from dexsim import guard
from dexsim.gap import compute
from dexsim.gap.command import Progress
from dexsim.gap.finding import Finding
from dexsim.gap.judge import conclude, held_out
from dexsim.gap.judge.joint_answer import stretched
from dexsim.gap.plant.case import REFERENCE, build
from dexsim.gap.plant.columns import Param
from dexsim.gap.plant.free_run import free_run
from dexsim.gap.rules import JUDGE
from dexsim.gap.search.fit import Box, Fitted, Fitter
from dexsim.gap.search.scan import cross_validated, free_run_errors, refolded, scan_catalogue
from dexsim.gap.search.search import JointSearch, Member, search_joint, settle_found, subset
from tests.test_gap import model, plant_run


def searched(changes: dict[str, float]) -> JointSearch:
    runs = [plant_run(name, kind, 5.0, changes, seed) for name, kind, seed in (("a", 0, 1), ("b", 1, 2), ("c", 2, 3))]
    return JointSearch(build(model(), runs)[0], [0, 1, 2], None, [0, 1, 2])


@pytest.mark.slow
def test_refold_fits_each_condition_left_out_better_than_one_step_does():
    s = searched({"torque_limit": 0.12})
    none = s.start()
    listed = scan_catalogue(s, none)
    member, start = next((Member(m.effect, m.variant), x) for _, _, m, x in listed if m.id == "torque_limit")
    step = s.fit((member,), start, none)
    cross_validated(s, step)
    own = refolded(s, step)
    assert own.left_out is not step.left_out and own.fit is step.fit
    for number, x, y in zip(np.unique(s.fold_of), step.folds, own.folds, strict=True):
        fitter = Fitter(s.case.plant, subset(s.long, s.fold_of != number), s.r)
        loss = [fitter.loss(fitter.evaluate(step.fit.params, g)[None])[0] for g in (x, y)]
        assert loss[1] <= 1.02 * loss[0]
    assert own.left_out.sum() <= 1.25 * step.left_out.sum()  # what is free to fit noise does, a little


@pytest.mark.slow
def test_conditions_left_out_are_run_free_with_fits_of_their_own():
    s = searched({"torque_limit": 0.12})
    assert s.fold_by == "conditions"
    none = s.start()
    listed = scan_catalogue(s, none)
    member, start = next((Member(m.effect, m.variant), x) for _, _, m, x in listed if m.id == "torque_limit")
    trial = s.fit((member,), start, none)
    before, after = free_run_errors(s, none), free_run_errors(s, trial)
    assert before.shape == after.shape == (3,) and free_run_errors(s, trial) is after
    # what limits the torque is the same in each condition, whichever is left out
    assert after.mean() < 0.5 * before.mean() and after.mean() < 3.0


def test_what_only_the_recording_held_out_shows_is_said():
    def alone(before: float, fitted: float, *found: Finding) -> list[str]:
        return conclude._shown_there_alone({"a": {"before": before, "fitted": fitted, "sigma": 1.0}}, list(found))

    assert alone(16.0, 1.0) == ["a"]
    assert not alone(16.0, 9.0) and not alone(3.0, 1.0)  # the others show it too; next to nothing
    assert not alone(16.0, 1.0, Finding("lag", 0.9, "", ["a"]))


@pytest.mark.parametrize(
    ("confidence", "group", "word"),
    [(0.9, [], "explained"), (0.5, [], "partly_explained"), (0.5, ["lag", "command_delay"], "explained")],
)
def test_an_error_that_is_gone_under_doubtful_names_is_not_explained(confidence, group, word):
    held = {"before": 0.01, "after": 0.001}
    finding = Finding("lag", confidence, "", held_out=held, indistinguishable=group)
    assert held_out.verdict([finding], 1e-3, 1e-2, 9e-3, 1.1e-3, False) == word


def test_temperature_counts_from_that_of_a_data_sheet():
    runs = [plant_run(name, 0, 3.0, {}, seed) for name, seed in (("a", 1), ("b", 2))]
    for run, heat in zip(runs, (40.0, 55.0), strict=True):
        run.temperature = np.full((len(run.t), 1), heat)
    case = build(model(), runs)[0]
    from dexsim.gap.plant.columns import SERIES_INDEX

    warmth = case.plant.series[:, SERIES_INDEX["warmth"]]
    assert warmth.min() == pytest.approx(40 - REFERENCE) and warmth.max() == pytest.approx(55 - REFERENCE)
    assert case.scales.warm == pytest.approx(55 - REFERENCE)
    runs[1].temperature[:] = 40.5  # hardly any spread: nothing can be said of temperature
    assert build(model(), runs)[0].scales.warm == 0.0


def valley(n: int = 400) -> tuple[Fitter, list[Param]]:
    """Return a fitter whose residual knows a belief and an effect by their sum alone."""
    rng = np.random.default_rng(0)
    a, c, noise = rng.standard_normal(n), rng.standard_normal(n), 0.02 * rng.standard_normal(n)
    fitter = Fitter.__new__(Fitter)
    fitter.passed = lambda: False  # there is time
    fitter.r, fitter.eliminate, fitter.window, fitter.count = (
        SimpleNamespace(huber=0.0, sigma_q0=0.0, sigma_v0=0.0),
        False,
        np.zeros(n, int),
        1,
    )
    fitter.residuals = lambda params, x, inits=None: (
        a * 10 * (2.3 - x[:, :1] - x[:, 1:2]) + c * 5 * (x[:, 2:] - 1.0) + noise
    )
    params = [
        Param("effect", ("kp",), "set", 0.1, 5.0, 1.0),
        Param("belief", ("kd",), "factor", 0.5, 2.0, 1.0, nuisance=True, sd=0.1),
        Param("other", ("lag",), "factor", 0.9, 1.1, 1.0, nuisance=True, sd=0.05),
    ]
    return fitter, params


def test_a_belief_that_was_moved_along_a_valley_goes_back_home():
    fitter, params = valley()
    astray = fitter.fit(params, x0=np.array([0.7, 1.6, 1.0]), iterations=0)
    home = fitter.toward_prior(params, astray)
    starts = np.array([p.start for p in params])
    score = lambda f: f.loss + Box(params).prior @ (f.x - starts) ** 2 / len(f.residual)  # noqa: E731
    assert abs(home.x[1] - 1.0) < 0.02 and abs(home.x[0] - 1.3) < 0.03 and score(home) < 0.1 * score(astray)
    assert fitter.toward_prior(params, home) is home  # there is nothing to gain


def test_intervals_follow_how_well_what_was_held_out_is_followed():
    params = [Param("a", ("kp",), "set", 0.0, 3.0, 0.0), Param("b", ("kd",), "set", 0.0, 100.0, 0.0)]
    f = Fitted(params, np.array([2.0, 50.0]), np.zeros(4), np.zeros((4, 2)), np.zeros(4, int), 1.0)
    bounds = np.array([[1.0, 2.5], [40.0, 60.0]])
    width = lambda left: np.diff(stretched(bounds, f, left))[:, 0]  # noqa: E731
    assert np.allclose(width(1.0), JUDGE.stretch_least * np.array([1.5, 20.0])) and np.allclose(width(2.0)[1], 40.0)
    # no farther than is physical, and than was seen to be needed
    assert np.allclose(stretched(bounds, f, 50.0), [[0.0, 3.0], [10.0, 90.0]])
    assert stretched(bounds, f, 0.0) is bounds  # nothing was held out


def test_progress_of_a_search_is_told_in_counts(capsys, monkeypatch):
    now = [100.0]  # what was before the search does not count
    monkeypatch.setattr("dexsim.gap.command.time.perf_counter", lambda: now[0])

    def work(k, tell):
        for at, stage in ((107.0, "effect 1"), (108.0, "too soon"), (123.0, "effect 1, candidate 2 of 6")):
            now[0] = at
            tell(stage)
        now[0] = 143.0
        return k

    now[0] = 103.0
    assert compute.map_joints(["knuckle"], work, "cpu", Progress()) == [0]
    lines = capsys.readouterr().out.splitlines()
    assert [line.strip() for line in lines] == [
        "searching knuckle (1/1)",
        "searching knuckle (1/1): effect 1, 4 s so far",
        "searching knuckle (1/1): effect 1, candidate 2 of 6, 20 s so far",
        "searched 1 in 40 s",
    ]
    Progress(compute.TimeLimit(50.0))(2, 5, "wrist", "effect 1")
    assert capsys.readouterr().out.strip() == "searching wrist (3/5): effect 1, 0 s so far, at most 50 s left of all"


@pytest.mark.limits
def test_replays_tell_the_time_left(capsys, monkeypatch):
    """Three works, two at a time: what is told is right within a third.

    Of works of 20, 10 and 10 the first is half done after 10 s, the second done, the third not begun."""
    size, seen = np.array([20.0, 10.0, 10.0]), np.array([[5.0, 15.0, 0.5], [5.0, 15.0, 1.0], [0.0, 0.0, 0.0]])
    assert compute.so_far(size, seen, 2) == (0.5, pytest.approx(10.0))
    assert compute.so_far(size, seen, 1)[1] == pytest.approx(20.0) and compute.so_far(size, 0 * seen, 2) == (0.0, None)
    monkeypatch.setattr(compute, "LONG", 0.1)
    monkeypatch.setattr(guard, "WAITING_S", 10.0)  # the works sleep
    monkeypatch.setattr(Progress, "EVERY", 0.0)

    def work(k):
        def of_it():
            for part in np.linspace(0, 1, 11):
                tell(k, part)
                time.sleep(0.3)

        return of_it

    numbers, say = [], Progress()

    def heard(share, *rest):
        numbers.append((time.monotonic(), rest[3]))
        say(share, *rest)

    with compute.watched([1.0, 1.0, 1.0], 2, "the files", heard) as tell:
        compute.forked(3, work, 2)
    *said, end = [line.strip() for line in capsys.readouterr().out.splitlines()]
    assert end == "replayed the files" and len(said) > 2
    assert all(re.fullmatch(r"replaying the files, \d+ % done, about \d\.\d s left to replay", line) for line in said)
    right = [abs(numbers[-1][0] - at - left) < max(left / 3, 0.5) for at, left in numbers[:-1]]
    assert np.mean(right) > 0.8


def test_a_search_tells_how_far_it_is():
    stages = []
    s = searched({"torque_limit": 0.12})
    s.tell, s.allowed = stages.append, {"torque_limit", "lag"}
    settle_found(s, search_joint(s))
    counts = [tuple(map(int, x)) for x in re.findall(r"(?:candidate|rival) (\d+) of (\d+)", "; ".join(stages))]
    assert stages[0] == "effect 1, all of the catalogue" and stages[-1] == "on whole recordings"
    assert counts and all(1 <= k <= of for k, of in counts)


def test_a_recording_that_begins_in_motion_is_followed_from_where_it_did():
    """Half a second is cut off in the middle of a fast motion: one side of samples tells a speed badly."""
    run = plant_run("a", 2, 4.0, {}, 1, noisy=False)
    cut = int(np.argmax(np.abs(np.gradient(np.gradient(run.q[50:150, 0]))))) + 50
    for r in (run,):
        r.t, r.q = r.t[cut:], r.q[cut:]
        r.torque = None if r.torque is None else r.torque[cut:]
        r.smooth()
    case = build(model(), [run])[0]
    windows = case.plant.windows(None)
    error = lambda underway: np.sqrt(  # noqa: E731
        np.mean(
            (case.plant.q[windows.sample_row] - free_run(case, [], np.zeros(0), windows, underway=underway)[0])
            ** 2
        )
    )
    case.regimes["_speed"] = case.regimes["_speed"].copy()
    case.regimes["_speed"][0] = case.scales.speed
    assert error(True) < 0.7 * error(False)
    case.regimes["_speed"][0] = 0.0  # at rest nothing is fitted
    assert error(True) == error(False)
