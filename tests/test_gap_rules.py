"""The figures that decide: each rule is held from both sides, by made-up losses."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from test_gap_least import Judged, judged

from dexsim.gap import locate
from dexsim.gap.effects import Variant, param
from dexsim.gap.effects.catalogue import EFFECTS
from dexsim.gap.effects.drive import temperature_follows
from dexsim.gap.finding import Finding
from dexsim.gap.judge import conclude, confidence, handed_on, held_out
from dexsim.gap.judge.joint_answer import stretched
from dexsim.gap.plant.batch import Windows
from dexsim.gap.plant.case import coupled
from dexsim.gap.plant.columns import INDEX as PLANT_INDEX
from dexsim.gap.plant.columns import SERIES_INDEX
from dexsim.gap.report import files, next_recording
from dexsim.gap.search import ringing, scan, search
from dexsim.gap.search.fit import Fitted
from dexsim.gap.search.hypotheses import JointSearch, Member, complexity_price, thin
from dexsim.gap.touch import judge as pad_judge
from dexsim.gap.touch.diagnosis import doubted


def made(**more):
    """Return a search whose trials say themselves what they lose (`losses_given`)."""
    mean = lambda t: float(t.loss.mean())  # noqa: E731
    return SimpleNamespace(blocks=np.arange(40), rng=np.random.default_rng(0), none_loss=np.ones(40), by_law={},
                           fold_by="time", objective=mean, shrunk=lambda t: False, **more)  # fmt: skip


@pytest.fixture
def losses_given(monkeypatch):
    for module in (scan, search):
        monkeypatch.setattr(module, "cv_loss", lambda search, trial: trial.loss)


def trial(loss, members=()):
    return SimpleNamespace(loss=np.broadcast_to(np.asarray(loss, float), (40,)), members=members, ids=("lag",))


def test_an_effect_must_remove_a_least_share(losses_given):
    old = trial(10.0)
    assert not scan.earns(made(), trial(9.0), old) and scan.earns(made(), trial(8.6), old)


def test_what_can_imitate_another_effect_must_do_better():
    scales = SimpleNamespace(apart=False, slide=False, span=2.0)
    one, other = EFFECTS["position_scale"].variants(scales)[-2:]  # an eccentricity, and one whose zero is elsewhere
    price = lambda variant: complexity_price(SimpleNamespace(members=[SimpleNamespace(variant=variant)]))  # noqa: E731
    for better, chosen in ((0.05, False), (0.10, True)):
        assert ((1 - better) * price(other) < price(one)) is chosen, better


def row(share, price, effect="lag"):
    p = param("time_constant", effect, "set", 0.0, 1.0)
    return share, price, Member(EFFECTS[effect], Variant((p,), ((0.1,),))), np.array([0.1])


def test_the_short_list_asks_a_price():
    for price, loss, tried in ((0.15, 1.5, True), (0.25, 1.5, False), (0.25, 1.9, True)):
        assert bool(scan.shortlisted([row(0.5, price)], 6, loss, ())) is tried, (price, loss)


def test_every_kind_of_a_dead_zone_is_tried():
    """Slopes at one say little of another; of other effects a short list holds one or two."""
    rows = [row(0.9, 0.0), *(row(0.8 - 0.1 * k, 0.0, "deadband") for k in range(3)), row(0.2, 0.0)]
    ids = [x[2].id for x in scan.shortlisted(rows, 2, 20.0, ())]
    assert ids == ["lag", "deadband", "deadband", "deadband"] + ["lag"] * (EFFECTS["lag"].kinds - 1)


def test_intervals_hold_the_laws_that_do_as_well(losses_given):
    p = param("peak", "stribeck_peak", "set", 0.0, 1.0)
    fitted = lambda x, loss: SimpleNamespace(  # noqa: E731
        fit=SimpleNamespace(params=[p], x=np.array([x])), loss=np.full(40, loss), ids=("s",)
    )
    best = fitted(0.06, 1.0)
    given = made()
    given.by_law = {"s": [best, fitted(0.08, 1.04), fitted(0.2, 1.09)]}
    assert search.law_spread(given, best).tolist() == [[0.06, 0.08]]


def test_intervals_hold_what_no_residual_shows():
    """1.5 % of the size itself; and 2.5 % of a belief, where the size answers one to one."""
    size = param("peak", "stribeck_peak", "set", 0.0, 10.0)
    belief = replace(param("kp", "kp", "factor", 0.9, 10.9, 1.0), nuisance=True)
    fit = SimpleNamespace(params=[size], x=np.array([2.0]), jacobian=np.ones((5, 1)))
    of = SimpleNamespace(fit=fit, folds=[], ids=("s",))
    low, high = search.widened(made(), of, np.array([[2.0, 2.0]]))[0]
    assert (high - low) / 2 == pytest.approx(1.645 * 0.015 * 2.0, rel=1e-6)
    fit = SimpleNamespace(params=[size, belief], x=np.array([2.0, 1.0]), jacobian=np.ones((5, 2)))
    of = SimpleNamespace(fit=fit, folds=[], ids=("s",))
    low, high = search.widened(made(), of, np.array([[2.0, 2.0], [1.0, 1.0]]))[0]
    assert (high - low) / 2 == pytest.approx(1.645 * np.hypot(0.015 * 2.0, 0.025), rel=1e-3)


class Started(JointSearch):
    """The beginning of a search, the residuals without any effect being given."""

    def __init__(self, q, torque):
        n = len(q)
        windows = SimpleNamespace(n=n, sample_window=np.zeros(n, int))
        residual = np.concatenate([q, torque])
        fitter = SimpleNamespace(use_torque=True, w=windows, tau_on=np.ones(n, bool))
        fitter.toward_prior = lambda params, fit: fit
        fitter.fit = lambda params, x0, **_: SimpleNamespace(
            params=params, x=x0, residual=residual, loss=1.0, jacobian=None
        )
        self.scan_fitter = self.fitter = fitter
        self.all_nuisances = self.nuisances = []
        self.r = SimpleNamespace(sigma_q=1.0, sigma_torque=1.0, huber=3.0)
        self.start()


def test_neither_signal_drowns_the_other():
    r = Started(np.full(100, 200.0), np.full(100, 100.0)).r
    assert (r.sigma_q, r.sigma_torque) == (pytest.approx(6.0), pytest.approx(3.0))


def test_what_a_torque_changes_by_from_sample_to_sample_is_noise():
    r = Started(np.zeros(100), np.tile([30.0, -30.0], 50)).r
    assert r.sigma_torque == pytest.approx(30.0 * np.sqrt(16 / 6))


# -- the judgement of the drives


def named(**changes):
    return replace(Finding("lag", 0.9, "", ["j"], held_out={"before": 1.0, "after": 0.5}), **changes)


def test_an_error_within_the_noise_asks_for_nothing():
    word = lambda before: held_out.verdict([], 1.0, before, before, before, True)  # noqa: E731
    assert word(1.25) == "none" and word(1.35) == "unknown"
    assert confidence.too_small(1.25, 1.25, 1.0, 1.0, True) and not confidence.too_small(1.35, 1.35, 1.0, 1.0, True)


def test_a_large_error_is_never_nothing():
    word = lambda before: held_out.verdict([], 1.0, before, 1.0, before, True)  # noqa: E731
    assert word(4.9) == "none" and word(5.1) == "unknown"


def test_what_counts_as_a_part_of_the_answer():
    word = lambda after: held_out.verdict([named()], 1.0, 11.0, 10.0, after, True)  # noqa: E731
    assert word(8.1) == "unknown" and word(7.9) == "partly_explained"


def test_names_below_firm_are_hints():
    found = [named(confidence=0.51), named(confidence=0.49)]
    assert [f.hint for f in held_out.settle(found)] == [False, True]


def test_what_is_not_borne_out_keeps_little():
    (found,) = held_out.settle([held_out.unneeded(named(), {"j"})])
    assert 0.4 < found.confidence < 0.5 and found.hint


def doubtful(**changes):
    given = {
        "effect": "lag",
        "joint": "j",
        "share": 1.0,
        "earned": 1.0,
        "left": 0.0,
        "left_of_rest": 0.0,
        "score": 99.0,
        "members": 1,
    }
    return confidence.Evidence(**(given | {"confidence": 0.99} | changes))


def test_one_reason_against_a_name_makes_it_doubted():
    assert 0.6 < confidence.weigh(doubtful(reasons=["x"])) < 0.8


def test_nothing_is_explained_by_doubtful_names_alone():
    word = lambda sure: held_out.verdict([named(confidence=sure)], 1.0, 5.0, 4.0, 1.0, True)  # noqa: E731
    assert word(0.74) == "partly_explained" and word(0.76) == "explained"


def test_what_is_not_sure_is_handed_on_with_what_was_believed():
    assert doubted(named(confidence=0.79, indistinguishable=[])) and not doubted(
        named(confidence=0.81, indistinguishable=[])
    )


def test_what_removes_nothing_keeps_nothing():
    weighed = [confidence.weigh(doubtful(earned=x)) for x in (0.0, 0.5)]
    assert weighed[0] == 0.0 and weighed[1] == pytest.approx(0.5, abs=0.01)


def test_a_name_earns_its_confidence_by_what_it_removes():
    less = lambda after: handed_on.earned(named(held_out={"before": 1.0, "after": after}))  # noqa: E731
    assert less(0.89) == 1.0 and 0.85 < less(0.91) < 0.95


def test_what_is_small_beside_another_effect_is_doubted():
    said = lambda share: confidence.too_small(10.0, 9.0, np.sqrt(81 - 100 * share), 1.0, False)  # noqa: E731
    assert "small beside" in said(0.035) and not said(0.045)


def test_what_stays_unexplained_costs_confidence():
    keeps = lambda share: confidence.kept_of(confidence.left_over(np.sqrt(share), 1.0, 0.0))  # noqa: E731
    assert keeps(0.0) == 1.0 and keeps(0.15) == pytest.approx(0.75) and keeps(0.25) > 0.5 and keeps(0.35) == 0.5


def test_a_rival_of_the_same_class_makes_a_set():
    for share, together in ((0.045, False), (0.055, True)):
        answer = Judged(1.0, 0.1)
        answer.outcome.rivals = {"lag": [("command_delay", share)]}
        assert (len(judged(answer).indistinguishable) == 2) is together, share


def test_an_effect_must_remove_a_part_of_what_was_held_out():
    for share, hint in ((0.19, True), (0.21, False)):
        assert (judged(Judged(1.0, np.sqrt(1 - share))).confidence < 0.5) is hint


def test_an_effect_may_lose_little_where_it_does_not_act():
    """Half of the blocks gain much, the others lose a little: what a bootstrap over blocks may lose as a whole
    decides."""
    for lost, hint in ((0.015, False), (0.025, True)):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(held_out, "gain_interval", lambda *_, lost=lost: (-lost, 0.9))
            assert (judged(Judged(1.0, 0.1)).confidence < 0.5) is hint, lost


def test_a_size_that_fits_without_a_condition_do_not_repeat_is_a_hint():
    p = param("coefficient", "viscous_friction", "set", 0.0, 9.0)
    case = SimpleNamespace(scales=SimpleNamespace(nominal={"viscous_friction": 0.0}))
    said = lambda *sizes: confidence.not_repeated([p], np.array(sizes)[:, None], case)  # noqa: E731
    assert said(1.0, 0.21) == "" != said(1.0, 0.19) and said(1.0) == ""
    both = param("mass", "payload", "add", -9.0, 9.0)
    assert "do not agree on its mass: -0.5 to 1" in confidence.not_repeated([both], np.array([[1.0], [-0.5]]), case)


def test_intervals_grow_with_what_is_left():
    p = param("time_constant", "lag", "set", -1e3, 1e3)
    fit = Fitted([p], np.array([0.0]), np.zeros(4), np.zeros((4, 1)), np.zeros(4, int), 1.0)
    factor = lambda ratio: float(stretched(np.array([[-1.0, 1.0]]), fit, ratio)[0, 1])  # noqa: E731
    assert (
        factor(0.1) == pytest.approx(0.5) and factor(2.0) == pytest.approx(2.0) and factor(100.0) == pytest.approx(4.0)
    )


class Shook(ringing.Ringing):
    """Windows of a second in which a joint swings from sample to sample by the sizes given, and not at all as it is
    simulated."""

    def __init__(self, sizes: tuple[float, ...]):
        n, count = 100, len(sizes)
        window = np.repeat(np.arange(count), n)
        q = np.repeat(np.asarray(sizes, float), n) * (-1.0) ** np.arange(n * count)
        w = SimpleNamespace(n=n * count, window=np.arange(count), sample_window=window, sample_row=np.arange(n * count))
        plant = SimpleNamespace(t=0.01 * np.arange(n * count), q=q)
        case = SimpleNamespace(plant=plant, quantum=1e-6, sigma=np.inf)
        none = SimpleNamespace(members=(), fit=SimpleNamespace(params=[], x=np.zeros(0)))
        self.simulated = np.full((1, 3, count), 1e-9), np.zeros((1, count))
        super().__init__(SimpleNamespace(short=w, case=case), none)

    def _simulated(self, *_):
        return self.simulated


def test_a_joint_shakes_that_is_far_louder_than_at_its_quietest():
    assert Shook((1.0, 2.4, 3.6, 9.0)).loud.tolist() == [False, False, True, True]


def test_a_joint_must_shake_in_some_windows():
    made, rings = ringing.Ringing, SimpleNamespace(effect=SimpleNamespace(rings=True))
    outcome = SimpleNamespace(none="none", best=SimpleNamespace(members=(rings,)))
    try:
        # in what was fitted, in what was held out, of which one must shake
        for fitted, held, expected in ((1, 1, False), (2, 1, True), (1, 2, True), (4, 0, False)):

            def counted(search, none, runs=None, *_, fitted=fitted, held=held):
                count = held if runs else fitted
                return SimpleNamespace(
                    quiet=1e-3,
                    loud=np.ones(count, bool),
                    rung=np.zeros(count, bool),
                    of=lambda t: np.full(count, 9.0 if t == "none" else 1.0),
                )

            ringing.Ringing = counted
            assert (ringing.shown(SimpleNamespace(), outcome, [1], None) > 0.5) is expected, (fitted, held)
    finally:
        ringing.Ringing = made


def test_joints_are_searched_again_that_feel_each_others_motion():
    def is_coupled(share: float) -> bool:
        series = np.zeros((100, len(SERIES_INDEX)))
        series[:, SERIES_INDEX["rest"]] = share * 2.0 * (-1.0) ** np.arange(100)
        return coupled([SimpleNamespace(plant=SimpleNamespace(series=series), scales=SimpleNamespace(tau=2.0))])

    assert is_coupled(0.04) and not is_coupled(0.02)


def test_how_much_a_joint_shakes_counts_before_where_it_rests():
    made = Shook((1.0, 1.0))
    made.levels, made.means, made.usual, made.quiet = np.ones((3, 1)), np.zeros(1), 1.0, 1e-3
    missed = []
    for times, away in ((np.exp(np.sqrt(0.7 / 3)), 0.0), (1.0, 3.0), (np.exp(np.sqrt(1.4 / 3)), 0.0)):
        made.simulated = np.full((1, 3, 1), times), np.full((1, 1), away)
        missed.append(float(made.missed((), [], np.zeros((1, 0)))[0, 0]))
    assert missed == sorted(missed) and missed[1] == pytest.approx(1.0)


def test_repeats_that_differ_by_what_was_found_are_no_floor():
    floor = conclude.Noise(3.0, "repeats", {"a": 3.0, "b": 3.0})
    for error, same in ((2.2, False), (2.5, True)):
        assert (floor.at_most({"a": error}) is floor) is same, error
    assert floor.at_most({"a": 1.2}).lowered == ("a",) and floor.at_most({"a": 1.2}).how in files.FLOORS
    assert floor.at_most({"a": 1.2}).joints == {"a": 1.2, "b": 3.0} and floor.at_most({"a": 1.2}).floor < 3.0


def test_a_motion_has_the_floor_of_its_own_repeats():
    """Ramps that repeat to 0.1 are not as good as anything within the 4 that all motions together differ by."""
    floor = conclude.Noise(4.0, "repeats", {"a": 4.0}, {0: {"a": 0.1}, 1: {"a": 8.0}})
    assert floor.of([0]) == pytest.approx({"a": 0.1}) and floor.of([2]) == floor.of([]) == {"a": 4.0}
    assert floor.of([0, 1])["a"] == pytest.approx(8.0 / np.sqrt(2), rel=1e-3)


def followed(loss: float, now: float = 1.0, members=()) -> SimpleNamespace:
    """Return what a search of a joint ended with, at `loss`; and now, with what is known of the others."""
    one = SimpleNamespace(members=members, fit=SimpleNamespace(loss=loss, params=[], x=np.zeros(0)))
    return SimpleNamespace(none=one, best=one)


def test_a_motion_that_settles_it_is_planned_alone():
    for score, motions in ((4.0, ["steps"]), (2.0, ["steps", "chirp"])):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(next_recording.excitation, "plan", lambda *_, **__: None)
            patch.setattr(next_recording, "disagreement", lambda *_, s=score: {"chirp": 1.0, "steps": s})
            search = SimpleNamespace(case=SimpleNamespace(joint="j"))
            assert next_recording.choose(None, search, None, None).chosen == motions, score


# -- what is looked for, and what counts as a rival


def test_the_short_list_asks_a_promise():
    for share, tried in ((0.035, True), (0.025, False)):
        assert bool(scan.shortlisted([row(share, 0.0)], 6, 1.5, ())) is tried, share


def test_a_small_change_of_temperature_tells_nothing():
    for warm, tells in ((2.2, True), (1.8, False)):
        s = SimpleNamespace(warm=warm, voltage=False, nominal={"coulomb_friction": 0.1}, unknown=())
        assert (EFFECTS["thermal"].variants(s) != []) is tells, warm


# -- how sure a name is


def test_no_name_is_certain():
    assert 0.97 < confidence.weigh(doubtful()) < 1.0


def test_a_size_that_reaches_its_end_is_doubted():
    p = param("size", "lag", "set", 0.0, 1.0)
    for nothing, said in ((0.01, "size"), (0.0, "")):
        case = SimpleNamespace(scales=SimpleNamespace(nominal={"lag": nothing}))
        assert confidence.beyond([p], {"size": (0.0, 0.5)}, case) == said, nothing


def test_less_than_half_a_count_is_doubted():
    assert confidence.unresolved(0.6, 0.0, 1.0) == "" and confidence.unresolved(0.4, 0.0, 1.0) != ""


def test_a_temperature_that_follows_the_clock_is_said():
    rng, n = np.random.default_rng(0), 2000
    t = np.arange(float(n))
    for scatter, said in ((0.1, "the clock"), (0.18, "")):  # correlations of 0.94 and 0.85
        heat = t / n + rng.normal(size=n) * scatter
        case = SimpleNamespace(regimes={"temperature": heat},
                               plant=SimpleNamespace(t=t, rows=lambda r: slice(None)))  # fmt: skip
        assert temperature_follows(case, [0]) == said, scatter


def test_when_an_effect_acts():
    t = 0.01 * np.arange(300)
    for level, acts in ((0.3, True), (0.2, False)):  # of its most, in the second of three seconds
        off = np.repeat([1.0, level, 0.0], 100)
        run = SimpleNamespace(t=t, recording="a")
        effect = SimpleNamespace(changes=lambda *_, off=off: off)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(pad_judge, "TOUCH_EFFECTS", {"lag": effect})
            (span,) = pad_judge.when("lag", SimpleNamespace(runs=[run], base={}), None)
        assert (span["end"] - span["start"] > 1.5) is acts, level


def test_what_the_rest_depends_on_stands_out():
    spot = lambda p, ratio: locate.Spot("j", "speed", 0.0, 1.0, ratio, 1.0, 2.0, 1.0, 0.3, p)  # noqa: E731
    said = lambda *given: len(locate.control([spot(*given)])) == 1  # noqa: E731
    assert said(0.04, 2.0) and not said(0.06, 2.0) and said(0.01, 1.35) and not said(0.01, 1.25)


def test_a_little_friction_stays_in_the_model():
    p, row_ = param("motor_share", "motor_share", "set", 0.0, 1.0), np.zeros((1, 1, len(PLANT_INDEX)))
    row_[..., PLANT_INDEX["backlash"]] = 0.1
    for share, moved in ((0.06, 0.06), (0.04, 0.0)):
        made = SimpleNamespace(fit=SimpleNamespace(params=[p], x=np.array([share])))
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(handed_on, "expand", lambda *_: row_)
            assert handed_on.on_motor(SimpleNamespace(plant=None), made) == moved


# -- what is held out


def test_the_end_of_a_recording_is_held_out():
    t = np.linspace(0, 10, 100)
    runs = [SimpleNamespace(name=n, duration=10.0, t=t, q=np.sin(t)[:, None]) for n in "ab"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(held_out, "visits", lambda *_: ([], np.zeros((0, 2))))
        parts = held_out.split(runs, [], [0, 1], [])
    assert all(7.0 < parts.span_train[i][1] < 8.0 and parts.span_test[i][1] == 10.0 for i in (0, 1))


def moving_case(**regimes):
    """Return a joint of which a regime's variable rises evenly."""
    n = 1000
    given = {k: np.linspace(0.0, 1.0, n) for k in ("_speed", "speed", "load", "acceleration", "position")}
    given |= {"saturation": np.full(n, 2.0), "_asked": np.full(n, -1.0)} | regimes
    return SimpleNamespace(joint="j", moved=True, regimes=given, scales=SimpleNamespace(peak_speed=1.0))


def test_regimes_of_a_motion():
    share = {k: float(x.mean()) for k, x in held_out.regimes([moving_case()]).items()}
    assert all(0.25 < share[f"large {k} of j"] < 0.35 for k in ("speed", "load", "acceleration"))
    assert all(0.12 < share[f"j at its {k} end"] < 0.18 for k in ("upper", "lower"))
    assert 0.87 < share["saturation of j while braking"] < 0.93


def test_regimes_of_heat():
    for span, there in ((5.5, True), (4.7, False)):  # 0.4 of it is more than 2 degC
        found = held_out.regimes([moving_case(temperature=np.linspace(20.0, 20.0 + span, 1000))])
        assert ("a warm j" in found) is there, span
    found = held_out.regimes([moving_case(temperature=np.linspace(20.0, 40.0, 1000))])
    assert all(0.25 < found[f"a {k} j"].mean() < 0.35 for k in ("warm", "cold"))


def test_a_belief_without_a_trace_is_not_refitted():
    beliefs = [replace(param(k, k, "set", 0.0, 1.0, 0.5), nuisance=True) for k in ("kp", "kd")]
    search = Started(np.zeros(100), np.zeros(100))
    residual, jacobian = np.zeros(200), np.tile([0.025, 0.015], (200, 1))  # sigmas over the whole range

    def fit(params, x0, **_):
        return SimpleNamespace(params=params, x=x0, residual=residual, loss=1.0, jacobian=jacobian)

    search.fitter.fit, search.case = fit, SimpleNamespace(unknown=(), scales=None)
    search.all_nuisances = beliefs
    search.start()
    assert [p.key for p in search.nuisances] == ["kp"]


def test_windows_are_thinned_without_losing_a_limit_or_following_one_sweep():
    """Among 40 windows of four runs: the one that saturates is kept, and of the run that is fastest all along three."""
    count, rows = 40, 10
    sample_window = np.repeat(np.arange(count), rows)
    run = np.arange(count) // 10
    window = np.zeros((count, 5), int)
    window[:, 1] = window[:, 4] = rows
    n = count * rows
    windows = Windows(window, np.zeros((count, rows)), np.arange(n), np.zeros(n), sample_window, np.arange(n), run)
    speed = np.where(run[sample_window] == 1, 10.0, 1.0) + 1e-3 * sample_window
    saturation = (sample_window == 27).astype(float)
    case = SimpleNamespace(plant=SimpleNamespace(dt=0.2), regimes={"saturation": saturation, "speed": speed})
    thinned = thin(windows, case, budget=24.0)
    first = thinned.sample_row[np.searchsorted(thinned.sample_window, np.arange(len(thinned.window)))] // rows
    assert len(first) == 12 and 27 in first
    assert np.bincount(run[first], minlength=4).max() <= 5, np.bincount(run[first])
