"""Pushes from outside, drives whose torque or duty was logged, and the plain model: figures of `rules.TORQUE`."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from dexsim.actuator.columns import INDEX
from dexsim.gap.effects.friction import LoadFriction, ViscousFriction
from dexsim.gap.finding import Finding
from dexsim.gap.inquiry import Judged, empty
from dexsim.gap.judge import conclude
from dexsim.gap.read import inputs
from dexsim.gap.read.stage_tests import Stage
from dexsim.gap.rules import JUDGE
from dexsim.gap.search import baseline, inverse_dynamics, logged_torque
from dexsim.gap.search.inverse_dynamics import Columns, least
from dexsim.gap.search.logged_torque import IdentifiedJoint

NAMES = ("inertia", "viscous_friction", "coulomb_friction", "offset")
STEP, BLOCKS, A_BLOCK = 0.01, 80, 50
T = STEP * np.arange(BLOCKS * A_BLOCK)


def recorded(push: np.ndarray, noise: float, own: float = 1.0, standing: int = 0) -> Columns:
    """Return a joint that swings under friction of rms `own`, with uniform noise of rms `noise` and a push [m] on
    its torque; in its last `standing` samples it stands and its torque is the push alone."""
    rng = np.random.default_rng(4)
    v = np.sin(2 * np.pi * 0.31 * T)
    v[len(T) - standing :] = 0.0
    X = np.stack([np.gradient(v, STEP), v, np.sign(v), np.ones(len(T))], 1)
    torque = X @ np.array([0.02, 0.6, 0.4, 0.0])
    torque *= own / np.std(torque[: len(T) - standing])
    torque += push + noise * np.where(v == 0, 0.0, rng.uniform(-np.sqrt(3), np.sqrt(3), len(T)))
    piece = SimpleNamespace(motion=SimpleNamespace(t=T), keep=np.ones(len(T), bool))
    block = np.repeat(np.arange(BLOCKS), A_BLOCK)
    return Columns([piece], NAMES, X, torque, v, np.zeros(len(T)), torque, block, 0.1, 2.0, False, float(T[-1]))


def pushed(of: Columns):
    """(samples that are pushed, the answer) of one recording; None where nothing is told."""
    said = logged_torque._of_joint([of], [True], np.random.default_rng(0))
    return said and (said[0][0][1], said)


def stretches(share: float) -> np.ndarray:
    """Return [m] 1 in `share` of the blocks, spread over the recording, else 0."""
    on = np.zeros(BLOCKS)
    on[np.random.default_rng(2).permutation(BLOCKS)[: round(share * BLOCKS)]] = 1.0
    return np.repeat(on, A_BLOCK)


def left_by_a_plain_fit(of: Columns) -> float:
    return float(np.var(of.u - of.X @ least(of.X, of.u)) / np.var(of.torque))


def test_a_plain_fit_must_leave_much_for_a_push():
    for share, expected in ((0.4, True), (0.22, False)):
        tried = [recorded(h * stretches(0.3), 0.01) for h in np.geomspace(0.5, 5.0, 60)]
        one = min(tried, key=lambda of: abs(left_by_a_plain_fit(of) - share))
        assert left_by_a_plain_fit(one) == pytest.approx(share, abs=0.02)
        assert (pushed(one) is not None) is expected, share


def test_pushes_are_clear_where_the_quiet_torque_fits():
    for noise, clear in ((0.5, True), (0.9, False)):  # of the quiet torque's variance: 0.2 and 0.45
        assert pushed(recorded(30.0 * stretches(0.3), noise))[1][-1] is clear, noise


def test_a_push_stands_far_out_of_the_quiet_residual():
    noise = 1 / np.sqrt(5)
    assert pushed(recorded(2.8 * noise * stretches(0.4), noise)) is None
    found = pushed(recorded(7.5 * noise * stretches(0.4), noise))
    assert found is not None and (found[0] == (stretches(0.4) > 0)).mean() > 0.99


def test_a_push_is_no_small_part_of_the_torque():
    large, small = stretches(0.3), np.zeros(len(T))
    free = [k for k in range(BLOCKS) if large[k * A_BLOCK] == 0]
    spots = {share: slice(free[n] * A_BLOCK, (free[n] + 1) * A_BLOCK) for n, share in ((5, 0.15), (9, 0.32))}
    rms = float(np.sqrt(np.mean(recorded(4.0 * large, 0.01).torque ** 2)))
    for share, spot in spots.items():
        small[spot] = share * rms
    on, _ = pushed(recorded(4.0 * large + small, 0.01))
    assert on[large > 0].all() and on[spots[0.32]].mean() > 0.8 and on[spots[0.15]].mean() < 0.1


def test_what_pushes_most_of_the_time_is_no_stretch():
    half = len(T) // 2
    for share, clear in ((0.45, True), (0.75, False)):  # of all samples; at rest mostly
        on = np.zeros(len(T))
        on[half : half + round((share - 0.1) * len(T))] = 8.0 if share < 0.5 else 0.0
        if share > 0.5:
            on[len(T) - round((share - 0.1) * len(T)) :] = 8.0
        standing = half if share < 0.5 else round((share - 0.1) * len(T))
        moving = len(T) - standing
        on[:moving] = 0.0
        on[: moving // 3 if share > 0.5 else moving // 5] = 8.0
        answer = pushed(recorded(on, 0.01, standing=standing))
        assert answer is not None and answer[1][-1] is clear, share


def test_a_joint_is_judged_without_pushes_where_enough_is_left():
    run = SimpleNamespace(name="a", duration=10.0)
    push = logged_torque.Push("j", 1.0, (0.9, 1.1), 0.5, True, False, {"a": [(0.0, 1.0)]})
    for seconds, cut in ((5.0, True), (3.0, False)):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(inputs, "merged_spans", lambda *_: {})
            patch.setattr(inputs, "free_air", lambda *_, s=seconds: ([SimpleNamespace(name="a", duration=s)], []))
            rest, _ = logged_torque.without_pushes([push], [run], [], [])
        assert (rest[0].duration == seconds) is cut, seconds


def push(clear: bool) -> float:
    return logged_torque.Push("j", 1.0, (0.9, 1.1), 0.5, clear, False, {"a": [(0.0, 1.0)]}).finding().confidence


def test_a_push_is_named_surely_where_the_rest_fits():
    assert JUDGE.sure <= push(True) <= 1.0


def test_a_push_is_a_hint_where_the_rest_does_not_fit():
    assert 0.5 * JUDGE.hinted < push(False) < JUDGE.firm


def test_a_loop_tells_of_the_joint_where_its_law_is_right_in_the_main():
    given = [IdentifiedJoint(SimpleNamespace(joint="j", told={"inertia": 1.0}), None, [])]
    for fit, tells in ((0.75, True), (0.65, False)):
        unknown = logged_torque.unknown_controllers(given, [SimpleNamespace(joint="j", fit=fit, slope_high=1.1)], [])
        assert (unknown == set()) is tells, fit


def test_a_drive_is_sound_by_its_logged_duty():
    def sound(fit=0.99, slope=1.0, delay=0.0):
        return Stage("j", "duty", slope, 0.9, 1.1, delay, fit, late=0.0075).sound

    assert sound() and sound(fit=0.96) and not sound(fit=0.9)
    assert sound(slope=1.04) and not sound(slope=1.08) and not sound(slope=0.92)
    assert sound(delay=0.006) and not sound(delay=0.012) and not sound(delay=-0.012)


def named(u: np.ndarray, column: np.ndarray, block: np.ndarray, seed: int = 0) -> bool:
    """Return whether friction that differs by direction is named, of this column, beside a constant torque."""
    own = SimpleNamespace(X=np.ones((len(u), 1)), u=u, blocks=block, pack=lambda x: {"viscous_friction": 10.0})
    name = ViscousFriction.by_torque
    found, *_ = inverse_dynamics._name(own, own, {name: column}, {name: column}, np.random.default_rng(seed))
    return [n.text for n in found] == [name]


def test_a_further_effect_of_the_torque_must_remove_a_least_share():
    rng = np.random.default_rng(3)
    column, noise = (rng.choice([-1.0, 1.0], len(T)) for _ in range(2))
    for share, expected in ((0.17, True), (0.08, False)):
        u = np.sqrt(share) * column + np.sqrt(1 - share) * noise
        assert named(u, column, np.repeat(np.arange(BLOCKS), A_BLOCK)) is expected, share


def test_a_further_effect_of_the_torque_must_help_in_nearly_all_bootstraps():
    # it helps in three stretches and harms a little in all others: draws without any of the three, of 8 and of 40
    # stretches, are (5/8)^8 = 2.3 % and (37/40)^40 = 4.4 % of all
    for stretches_, expected in ((8, True), (40, False)):
        block = np.repeat(np.arange(stretches_), 200)
        where = np.isin(block, [0, stretches_ // 2, stretches_ - 1])
        way = np.tile([1.0, -1.0], 100 * stretches_)
        assert named(np.where(where, way, 0.0), np.where(where, way, 0.01 * way), block) is expected, stretches_


def test_a_torque_that_fits_nothing_is_no_witness():
    value = {n: 1.0 for n in NAMES}
    for share, expected in ((0.5, True), (0.6, False)):
        scales = SimpleNamespace(nominal={"friction_asymmetry": 0.0}, inertia=1.0)
        case = SimpleNamespace(joint="j", unknown=("coulomb_friction",), scales=scales, ranges={}, factors={},
                               told=False, plant=SimpleNamespace(nominal=np.zeros((1, len(INDEX)))))  # fmt: skip
        logged_torque.believe([IdentifiedJoint(case, inverse_dynamics.Inverse(value, value, value, share, []), [])])
        assert case.told is expected, share


def confidence_at(after: float) -> float:
    """Return the confidence of a friction by load that the torque names, and that leaves `after` of 1 on what was held
    out."""
    n = SimpleNamespace(effect=LoadFriction.id, value=0.2, low=0.1, high=0.3, speed=0.0, share=1.0, before=1.0,
                        after=after, rival=None, text="friction that grows with the load",
                        removed=(0.1, 0.2))  # fmt: skip
    case = SimpleNamespace(joint="j", scales=SimpleNamespace(slide=False, speed=1.0),
                           regimes={"_load": np.ones(50), "speed": np.ones(50)})  # fmt: skip
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(logged_torque, "intervals_of", lambda *_: [])
        given = [IdentifiedJoint(case, SimpleNamespace(named=[n], full={}), ["a"])]
        (finding,) = logged_torque.findings(given, ["j"], [], [])
    return finding.confidence


def test_what_the_torque_names_is_never_certain():
    assert 0.8 < confidence_at(0.5) < 1.0


def test_what_the_torque_names_must_help_in_what_was_held_out():
    assert 0.4 < confidence_at(0.99) < JUDGE.firm


def test_what_the_torque_names_is_a_part_of_the_answer():
    for after, word in ((0.65, "partly_explained"), (0.75, "unknown")):
        named_ = [SimpleNamespace(effect="load_friction", before=1.0, after=after)]
        held = {"before": 1.0, "after": after, "removed_low": 0.1, "error": "effort_rmse_Nm"}
        finding = Finding("load_friction", 0.9, "", ["j"], held_out=held)
        d = SimpleNamespace(data=empty(), touch=None, judged=Judged({}), findings=[])
        by_torque = [IdentifiedJoint(SimpleNamespace(joint="j"), SimpleNamespace(named=named_), ["a"])]
        conclude.add_behind(d, [finding], by_torque)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(conclude, "sentence", lambda *_: "")
            conclude.decide(d)
        assert d.data["verdict"] == word, after


def fitted_from_torque(samples=1000, seconds=10.0) -> bool:
    """Return whether a joint's logged torque of 100 Hz is fitted."""
    case = SimpleNamespace(joint="j", index=0, moved=True, scales=SimpleNamespace(nominal={}))
    run = SimpleNamespace(name="a", t=0.01 * np.arange(samples))
    of = SimpleNamespace(u=np.zeros(samples), seconds=seconds, loaded=False)
    with pytest.MonkeyPatch.context() as patch:
        stretch = inverse_dynamics.Stretch("motion", "body")
        for name, answer in (("readable", True), ("moved", stretch), ("columns_of", of), ("solve", "fit")):
            patch.setattr(logged_torque, name, lambda *_, answer=answer: answer)
        patch.setattr(inverse_dynamics, "highest", lambda t: 10.0)
        return logged_torque.identify_joints([case], [run], [0], [], None) != []


def test_gravity_that_matters_is_fitted():
    for share, fitted in ((0.04, False), (0.06, True)):  # of the joint's torque
        wave = np.sin(0.1 * np.arange(400))[:, None]
        m = inverse_dynamics.motion(0.01 * np.arange(400), wave, wave, 10.0)
        one = np.ones_like(m.u)
        m.u[:] = one
        b = inverse_dynamics.Body(share * one, share * one, 0 * one, one)
        assert inverse_dynamics.columns_of([inverse_dynamics.Stretch(m, b)], 0).loaded is fitted, share


def test_a_torque_is_fitted_where_enough_was_logged():
    assert fitted_from_torque(samples=550) and not fitted_from_torque(samples=450)
    assert fitted_from_torque(seconds=5.5) and not fitted_from_torque(seconds=4.6)


def forbidden(friction: float, speed: float = 0.5, way: float = 0.5, slide: bool = False) -> bool:
    """Return whether a dry friction [N.m] is forbidden by a motion that 1 N.m began, of a joint whose large speed is
    1."""
    t = 0.01 * np.arange(300)
    on = (t >= 1.0) & (t < 2.0)
    q = way * np.clip((t - 1.0) / 0.99, 0.0, 1.0)
    plant = SimpleNamespace(t=t, q=q, rows=lambda r: slice(None))
    scales = SimpleNamespace(speed=1.0, slide=slide)
    case = SimpleNamespace(plant=plant, regimes={"_speed": speed * on}, scales=scales, sigma=0.0,
                           constants=SimpleNamespace(friction=0.0))  # fmt: skip
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(baseline, "_drive", lambda *_: {1: np.ones(300), -1: np.ones(300)})
        patch.setattr(baseline, "_series", lambda *_: np.zeros(300))
        return baseline.forbids(case, [0], friction) != ""


def test_friction_must_let_a_recorded_motion_begin():
    assert not forbidden(1.05) and forbidden(1.15)


def test_a_motion_begins_with_speed_and_goes_somewhere():
    assert forbidden(5.0, speed=0.03) and not forbidden(5.0, speed=0.015)
    assert forbidden(5.0, way=3e-3) and not forbidden(5.0, way=1.5e-3)  # it slides, or what holds it gives
    assert forbidden(5.0, way=7e-5, slide=True) and not forbidden(5.0, way=4e-5, slide=True)
