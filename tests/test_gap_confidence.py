"""What lowers a finding's confidence: each rule by itself."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from dexsim.gap.effects.drive import temperature_follows
from dexsim.gap.finding import Finding
from dexsim.gap.judge import confidence, held_out
from dexsim.gap.judge.confidence import Evidence
from dexsim.gap.plant.columns import INDEX, Param, at_bound
from dexsim.gap.rules import JUDGE

DOUBTED = JUDGE.doubted
CASE = SimpleNamespace(
    scales=SimpleNamespace(nominal={"viscous_friction": 0.002, "kp": 2.0, "torque_limit": 1.0, "coulomb_friction": 0.0})
)


def evidence(**changes) -> Evidence:
    given = (
        dict(effect="lag", joint="j", share=1.0, earned=1.0, left=0.0, left_of_rest=0.0, score=99.0, members=1)
        | changes
    )
    return Evidence(**given)


def viscous(low=0.0, high=0.1):
    return Param("coefficient", ("viscous_friction",), "set", low, high, 0.002)


def test_the_best_of_many_hypotheses_must_be_told_the_better():
    """The same evidence speaks for one of ten hypotheses and not for one of a thousand; what is plain is not asked how
    many there were."""
    for score, tried, most in ((4.0, 10, 0.9), (4.0, 1000, 0.1), (30.0, 1000, 1.0)):
        e = evidence(score=score, confidence=0.9)
        confidence.share_odds([e], tried)
        assert 0.5 * 0.9 * most < e.confidence < 0.9 * most + 1e-9
        assert bool(e.reasons) is (e.odds < 0.5)


@pytest.mark.parametrize(
    ("low", "high", "nothing"), [(0.0, 0.004, True), (0.00207, 0.004, True), (0.003, 0.006, False), (0.0, 0.001, False)]
)
def test_an_interval_that_holds_what_is_believed_holds_nothing(low, high, nothing):
    assert confidence.holds_nothing([viscous()], {"coefficient": (low, high)}, CASE) is nothing


def test_all_sizes_must_hold_nothing_and_shapes_do_not_count():
    gains = [
        Param("kp_factor", ("kp",), "factor", 0.25, 4.0, 1.0),
        Param("kd_factor", ("kd",), "factor", 0.1, 6.0, 1.0),
    ]
    assert confidence.holds_nothing(gains, {"kp_factor": (0.9, 1.2), "kd_factor": (0.8, 1.3)}, CASE)
    assert not confidence.holds_nothing(gains, {"kp_factor": (0.9, 1.2), "kd_factor": (1.4, 2.0)}, CASE)
    peak = [
        Param("peak", ("stribeck_peak",), "set", 0.0, 1.0, 0.0),
        Param("v_s", ("stribeck_speed",), "set", 0.01, 1.0, 0.1),
    ]
    case = SimpleNamespace(scales=SimpleNamespace(nominal={"stribeck_peak": 0.0, "stribeck_speed": 0.1}))
    assert not confidence.holds_nothing(peak, {"peak": (0.1, 0.3), "v_s": (0.05, 0.2)}, case)


def test_a_size_at_its_bound_is_told_from_one_at_nothing():
    # less than none cannot be, and some is believed
    assert at_bound([viscous()], {"coefficient": 0.0}, CASE) == "coefficient"
    assert at_bound([viscous()], {"coefficient": 0.01}, CASE) == ""
    turns = Param("per_turn", ("ripple_per_turn",), "set", 3.92, 4.08, 4.0)
    case = SimpleNamespace(scales=SimpleNamespace(nominal={"ripple_per_turn": 0.0}))
    assert at_bound([turns], {"per_turn": 4.08}, case) == "per_turn"
    coulomb = Param("torque", ("coulomb_friction",), "set", 0.0, 1.0, 0.0)
    assert at_bound([coulomb], {"torque": 0.0}, CASE) == ""
    scale = Param("scale", ("position_scale",), "set", 0.7, 1.4, 1.0)
    case = SimpleNamespace(scales=SimpleNamespace(nominal={"position_scale": 1.0}))
    assert [at_bound([scale], {"scale": x}, case) for x in (1.3986, 1.37, 1.0, 0.701)] == [
        "scale",
        "",
        "",
        "scale",
    ]
    gap = Param("gap", ("backlash",), "set", 0.0015, 0.4, 0.0015)  # begins near nothing: a small one is not at a bound
    case = SimpleNamespace(scales=SimpleNamespace(nominal={"backlash": 0.0}))
    assert at_bound([gap], {"gap": 0.004}, case) == ""


def test_what_the_error_held_out_does_not_ask_for_is_not_sure():
    assert "hardly above the noise" in confidence.too_small(1.2, 1.2, 1.0, 1.0, True)
    assert confidence.too_small(3.0, 3.0, 1.0, 1.0, True) == ""
    assert "small beside" in confidence.too_small(10.0, 2.0, 1.2, 1.0, False)
    assert confidence.too_small(10.0, 4.0, 1.2, 1.0, False) == ""


def test_what_the_encoder_does_not_resolve_is_doubted():
    """An error of 1.0 that the effect brings down by 0.3 in squares has been moved by 0.55 of a count, or by 0.27 of
    one."""
    after = np.sqrt(0.7)
    assert confidence.unresolved(1.0, after, 1.0) == ""
    assert "count of the encoder" in confidence.unresolved(1.0, after, 2.0)
    assert "count of the encoder" in confidence.unresolved(1.0, 1.1, 1.0), (
        "what makes it worse moves nothing for the better"
    )


def test_touch_is_doubted_alike():
    names = (("tactile_hysteresis", 0.99, 215.0), ("tactile_crosstalk", 0.99, 54.5))
    given = [Finding(e, sure, "", held_out={"before": before, "after": 40.0}) for e, sure, before in names]
    findings, said = confidence.of_touch([*given, Finding("tactile_gain", 0.95, "")], 215.0, 35.0)
    assert [f.confidence for f in findings] == [0.99, DOUBTED, 0.95] and len(said) == 1


def test_weigh_takes_every_doubt_into_account():
    weighed = lambda **changes: confidence.weigh(evidence(**changes))  # noqa: E731
    assert weighed() == 0.99 and weighed(reasons=["x"]) == DOUBTED and weighed(earned=0.3) == pytest.approx(0.3)
    assert weighed(left=confidence.left_over(7.0, 10.0, 1.0)) == pytest.approx(0.5)  # half of the square stays
    # next to nothing of what the first one left
    rest = {of: confidence.left_over(4.0, before, 1.0) for of, before in (("left", 20.0), ("left_of_rest", 4.5))}
    assert weighed(members=2, **rest) < 0.6


def test_a_joint_that_drags_another_or_has_a_bad_signal_is_doubted():
    drags, dragged, other = (evidence(effect="payload", joint=j, confidence=0.99) for j in ("a", "b", "c"))
    dragged.effect = "joint_coupling"
    confidence.of_the_whole([drags, dragged, other], {"b": "a"}, {"c"})
    assert drags.confidence == DOUBTED and dragged.confidence == 0.99 and other.confidence == DOUBTED


def test_what_hangs_on_a_misread_pose_is_doubted():
    scale, load, friction = (
        evidence(effect=e, joint=j, confidence=0.99)
        for e, j in (("position_scale", "b"), ("payload", "a"), ("coulomb_friction", "a"))
    )
    confidence.of_the_whole([load, scale, friction], {}, set())
    assert load.confidence == DOUBTED and "b" in load.reasons[0] and scale.confidence == friction.confidence == 0.99
    own = evidence(effect="payload", joint="b", confidence=0.99)
    confidence.of_the_whole([scale, own], {}, set())
    assert own.confidence == 0.99


@pytest.mark.parametrize(
    ("starts", "gains", "what"),
    [
        ((25, 35, 45, 55), (1, 1, 1, 1), "the clock"),
        ((45, 25, 55, 35), (1, 1, 1, 1), ""),
        ((55, 45, 35, 25), (1, 1, 1, 1), "the order of the recordings"),
        ((25, 45, 35, 55), (1, 1, 1, 1), ""),
        ((25, 45, 35, 55), (8, 32, 16, 64), "the gain"),
    ],
)
def test_temperature_that_follows_something_else(starts, gains, what):
    n = 50
    rows = lambda r: slice(n * r, n * (r + 1))  # noqa: E731
    warm = np.concatenate([s + np.linspace(0, 1.0, n) for s in starts])
    nominal = [np.where(np.arange(len(INDEX)) == INDEX["kp"], g, 0.0) for g in gains]
    case = SimpleNamespace(
        regimes={"temperature": warm},
        plant=SimpleNamespace(rows=rows, t=np.tile(np.linspace(0, 7, n), 4), nominal=nominal),
    )
    assert temperature_follows(case, range(4)) == what


@pytest.mark.parametrize(
    ("before", "low", "structured", "word"),
    [
        (1.2, 1.1, True, "none"),
        (4.0, 1.1, True, "none"),
        (4.0, 3.0, False, "none"),
        (4.0, 3.0, True, "unknown"),
        (12.0, 1.1, True, "unknown"),
        (12.0, 9.0, False, "unknown"),
    ],
)
def test_an_error_far_beyond_the_floor_is_not_nothing(before, low, structured, word):
    """In floors: the error before, the low end of its interval, whether the windows show structure."""
    assert held_out.verdict([], 1.0, before, low, before, structured) == word


def test_what_is_neutral_is_not_believed_to_a_few_percent():
    """An encoder's scale of 0.97 +- 0.01 is not nothing, a gain of 0.97 +- 0.01 is within what is believed of gains."""
    case = SimpleNamespace(scales=SimpleNamespace(nominal={"position_scale": 1.0, "torque_limit": 2.0}))
    scale = Param("scale", ("position_scale",), "set", 0.7, 1.4, 1.0)
    limit = Param("torque", ("torque_limit",), "set", 0.1, 3.0, 2.0)
    assert not confidence.holds_nothing([scale], {"scale": (0.96, 0.98)}, case)
    assert confidence.holds_nothing([scale], {"scale": (0.96, 1.01)}, case)
    assert confidence.holds_nothing([limit], {"torque": (1.92, 1.96)}, case)


def test_a_size_that_may_lie_beyond_what_is_looked_for_is_doubted():
    """An interval that ends at the far bound is only as long as the search; one that ends at the bound beside nothing
    is not cut."""
    p = Param("scale", ("position_scale",), "factor", 0.7, 1.3, 1.0)
    case = SimpleNamespace(scales=SimpleNamespace(nominal={}))
    assert confidence.beyond([p], {"scale": (0.7, 0.98)}, case) == "scale"
    assert confidence.beyond([p], {"scale": (0.72, 0.98)}, case) == ""
    one_sided = Param("delay", ("delay",), "add", 0.0, 0.1, 0.0)
    assert confidence.beyond([one_sided], {"delay": (0.0, 0.01)}, case) == ""
    assert confidence.beyond([one_sided], {"delay": (0.02, 0.1)}, case) == "delay"


def test_a_sensor_of_the_wrong_sign_is_not_doubted_for_its_sign():
    """That the effort's sign is not what it says is the effect itself; a fault of the position is not."""
    for bad, signs, expected in (({"a"}, {"a"}, 0.95), ({"a"}, set(), DOUBTED)):
        sensor = evidence(effect="current_sensor", joint="a", confidence=0.95)
        confidence.of_the_whole([sensor], {}, bad, signs)
        assert sensor.confidence == expected
