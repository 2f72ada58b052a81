"""Fits that do not stop short, and what of a size no recording tells: the plant's step, the fit without any effect
begun again, sizes traded with beliefs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from dexsim.gap.effects.catalogue import CATALOGUE
from dexsim.gap.judge.joint_answer import stretched, traded
from dexsim.gap.plant.case import build
from dexsim.gap.plant.columns import INDEX, Param
from dexsim.gap.search.fit import Fitted, bounded
from dexsim.gap.search.scan import scan_catalogue
from dexsim.gap.search.search import JointSearch, Member, Trial, begun_again
from tests.test_gap import model, plant_run

BRAKES = ("torque_limit", "viscous_friction", "braking_limit")


@pytest.mark.parametrize("changes", [{"lag": 0.005}, {"torque_limit": 0.25, "no_load_speed": 7.0, "limit_speed": 0.0}])
def test_a_millisecond_is_short_enough_for_a_lag_and_for_braking_at_the_limit(changes):
    run = plant_run("a", 0, 4.0, changes, noisy=False)
    run.smooth()
    plant = build(model(), [run])[0].plant
    params = plant.base()[None].copy()
    for name, value in changes.items():
        params[..., INDEX[name]] = value
    coarse, fine = (p.simulate(params, p.windows(None))[0][0] for p in (plant, plant.refined(20)))
    assert np.sqrt(np.mean((coarse - fine) ** 2)) < 1.5e-4  # of 0.5 rad


@pytest.mark.slow
def test_no_effect_is_begun_again_from_where_an_effect_ended():
    runs = [
        plant_run(name, kind, 5.0, {"delay": 6e-4, "*kp": 0.97}, seed)
        for name, kind, seed in (("a", 0, 1), ("b", 1, 2), ("c", 2, 3))
    ]
    s = JointSearch(build(model(), runs)[0], [0, 1, 2], None, [0, 1, 2])
    none = s.start()
    listed = scan_catalogue(s, none)
    member, start = next((Member(m.effect, m.variant), x) for _, _, m, x in listed if m.id == "command_delay")
    there = s.fit((member,), start, none)
    params = none.fit.params
    x = none.fit.x.copy()
    x[[p.key for p in params].index("kp")] = 1.04
    short = Trial((), s.fitter.fit(params, x0=x, iterations=0))  # a fit that has stopped on the way
    assert short.fit.loss > 1.2 * there.fit.loss
    again = begun_again(s, short, [there])
    assert again is not short and s.objective(again) < 1.05 * s.objective(none)
    assert begun_again(s, again, [there]) is again  # what follows as well is left alone
    worse = replace(there, fit=replace(there.fit, loss=2 * short.fit.loss))
    assert begun_again(s, short, [worse]) is short


@pytest.mark.parametrize("tilt", [0.0, 0.008, 0.1])
def test_gravitys_direction_is_let_go_where_a_fit_without_it_ends(tilt):
    """Where it is off it is found, by as much; else, or where far more is missing than it may be off by, the fit is
    that without it."""
    run = plant_run("a", 0, 5.0, {"tilt_y": tilt, "*kp": 0.97}, 1)
    s = JointSearch(build(model(), [run])[0], [0], None, [0])
    params = s.all_nuisances
    late = [p.key for p in params if p.late]
    assert late == ["tilt_y"]  # about the hinge: about another axis it gives the joint no torque
    sets = params, [p for p in params if not p.late]
    with_it, without = (Trial((), s.fitter.fit(p, iterations=8, lazy=True)) for p in sets)
    if tilt == 0.008:
        assert s.objective(with_it) < 0.8 * s.objective(without)
        assert with_it.fit.value("tilt_y") == pytest.approx(tilt, abs=2e-3)
    else:
        assert with_it.fit.params == without.fit.params
        np.testing.assert_allclose(with_it.fit.x, without.fit.x, rtol=1e-6, atol=1e-9)


def test_what_left_a_trace_beside_one_effect_begins_there_beside_a_further_one():
    """How a drive brakes shows only beside a limit: a second effect is fitted from what the first has told of it."""
    run = plant_run("a", 0, 3.0, {}, 1)
    s = JointSearch(build(model(), [run])[0], [0], None, [0])
    s.short_slopes = {}
    brake = next(p for p in s.all_nuisances if p.key == "braking_slope")
    s.nuisances = [p for p in s.all_nuisances if p.key in ("kp", "inertia")]
    of = {effect.id: Member(effect, effect.variants(s.case.scales)[0]) for effect in CATALOGUE if effect.id in BRAKES}
    params = s.params_of((of["torque_limit"],)) + [brake]
    x = np.array([p.start for p in params], float)
    x[-1] = -0.7
    like = Trial((of["torque_limit"],), s.fitter.fit(params, x0=x, iterations=0))
    two = (of["torque_limit"], of["viscous_friction"])
    starts = np.concatenate([like.fit.x[:1], of["viscous_friction"].variant.starts[0]])
    _, x0, draft = s.draft(two, starts, like)
    keys = [p.key for p in draft.params]
    assert keys.count("braking_slope") == 1 and x0[keys.index("braking_slope")] == pytest.approx(-0.7)
    _, _, alone = s.draft((of["braking_limit"],), np.array(of["braking_limit"].variant.starts[0]), like)
    columns = [c for p in alone.params for c in p.columns]
    assert len(set(columns)) == len(columns)  # what an effect writes is not fitted twice


def test_an_interval_holds_what_a_size_trades_with_a_belief():
    rng = np.random.default_rng(0)
    a, c = rng.standard_normal((2, 3000))
    # a rotor's inertia, of which a link's 0.002 known to 2.5 % takes the place; and a size of its own
    params = [
        Param("armature", ("armature",), "add", -1e-3, 1e-2, 0.0),
        Param("peak", ("stribeck_peak",), "set", 0.0, 1.0, 0.0),
        Param("inertia", ("inertia_scale",), "factor", 0.95, 1.05, 1.0, nuisance=True, sd=0.025),
    ]
    J = np.stack([1e5 * a, 500 * c, 1e5 * 2e-3 * a], 1)
    f = Fitted(params, np.array([4e-4, 0.3, 1.0]), np.zeros(3000), J, np.zeros(3000, int), 1.0)
    half = traded(f)
    assert half[0] == pytest.approx(1.645 * 0.025 * 2e-3, rel=0.05) and half[1] < 1e-4 and half[2] == 0.0
    tight = np.array([[3.9e-4, 4.1e-4], [0.25, 0.35], [0.99, 1.01]])
    out = stretched(tight, f, 1.0)
    assert out[0, 1] - 4e-4 == pytest.approx(half[0]) and 4e-4 - out[0, 0] == pytest.approx(half[0])
    assert np.allclose(out[1], [0.275, 0.325])  # halved, as ever


@pytest.mark.parametrize("lag, ago", [(0.1, 0.03), (0.03, 0.02), (0.0, 0.03)])
def test_a_recording_that_begins_after_a_change_of_command_begins_with_what_the_lag_still_holds(lag, ago):
    """The same motion from its begin, and from `ago` s after a step of its command on: the torque that the lag had not
    given yet is not there at once."""
    step, size = 0.5, 0.05
    weightless = replace(plant_run("a", 0, 1.5, {}, noisy=False), gravity=np.zeros(3))
    t_cmd, t = np.arange(0.0, 1.5, 0.01), np.arange(0.0, 1.4, 0.005)
    cmd = np.where(t_cmd < step - 1e-9, 0.0, size)[:, None]
    whole = replace(weightless, cmd_t=t_cmd, cmd=cmd, t=t, q=np.zeros((len(t), 1)), qs=None)

    def simulated(run):
        run.qs = None
        run.smooth()
        plant = build(model(), [run])[0].plant
        params = plant.base()[None].copy()
        params[..., INDEX["lag"]] = lag
        return plant.simulate(params, plant.windows(None))[0][0]

    for _ in range(3):  # the series are those of the motion itself
        whole.q = simulated(whole)[:, None].copy()
    on = t >= step + ago
    part = replace(whole, t=t[on], q=whole.q[on], qs=None)
    error = simulated(part) - part.q[:, 0]
    soon = part.t < step + ago + 0.2  # a loop with a lag may swing up what is left
    assert np.sqrt(np.mean(error[soon] ** 2)) < 0.05 * size


def test_a_bounded_least_squares_is_the_least_of_what_its_bounds_allow():
    """Whatever bounds hold: as low as by interior steps, which end a little before them, and inside to a rounding."""
    rng = np.random.default_rng(0)
    for _ in range(30):
        n = int(rng.integers(1, 9))
        J = rng.standard_normal((40, n)) * np.exp(rng.standard_normal(n))
        A, low, high = J.T @ J, -rng.random(n), rng.random(n)
        b = A @ (1.5 * rng.standard_normal(n))
        x = bounded(A, b, low, high)
        root = np.linalg.cholesky(A).T
        scipys = lsq_linear(root, np.linalg.solve(root.T, b), (low, high)).x
        mine, theirs = (0.5 * z @ A @ z - b @ z for z in (x, scipys))
        assert ((low - 1e-12 <= x) & (x <= high + 1e-12)).all() and mine <= theirs + 1e-9 * abs(theirs)


def test_windows_may_begin_each_from_its_own_place_and_end_early():
    """Each window from where it begins is what all of them from there give of it, and a begin is that of the whole."""
    plant = build(model(), [plant_run("a", 0, 6.0, {}, 1)])[0].plant
    windows = plant.windows(1.5)
    count = len(windows.window)
    starts = np.random.default_rng(1).normal(size=(count, 2)) * (0.02, 0.3)
    own = plant.simulate(plant.base()[None], windows, starts[None])
    for k, start in enumerate(starts):
        mine = windows.sample_window == k
        for got, expected in zip(own, plant.simulate(plant.base()[None], windows, start[None]), strict=True):
            np.testing.assert_array_equal(got[0, mine], expected[0, mine])
    counts = np.arange(5, 5 + 7 * count, 7)
    head = windows.heads(counts)
    assert np.bincount(head.sample_window).tolist() == counts.tolist()
    keep = np.concatenate([np.flatnonzero(windows.sample_window == k)[: counts[k]] for k in range(count)])
    for got, expected in zip(plant.simulate(plant.base()[None], head, starts[None]), own, strict=True):
        np.testing.assert_array_equal(got[0], expected[0, keep])


def test_finer_steps_lie_on_the_lines_between():
    plant = build(model(), [plant_run("a", 0, 2.0, {}, 1)])[0].plant
    fine = plant.refined(3)
    np.testing.assert_array_equal(fine.series[::3], plant.series)
    np.testing.assert_allclose(fine.series[1::3], plant.series[:-1] + np.diff(plant.series, axis=0) / 3, atol=1e-12)
