"""What any machine may be off by: figures of `rules.BELIEF`."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from dexsim.gap.effects import param
from dexsim.gap.effects.friction import give
from dexsim.gap.judge import confidence
from dexsim.gap.plant.case import quiet_noise, usual_noise
from dexsim.gap.read.noise import misfit
from dexsim.gap.search import hypotheses
from dexsim.gap.search.fit import disbelief


def test_a_figure_within_its_tolerance_is_no_finding():
    p = param("kp_factor", "kp", "factor", 0.2, 5.0, 1.0)
    nothing = lambda low: confidence.holds_nothing([p], {"kp_factor": (low, 1.2)}, SimpleNamespace())  # noqa: E731
    assert nothing(1.04) and not nothing(1.06)


def timing(kd: float = 0.0):
    """Return what is refitted of when a drive with a loop of 1 kHz acts and reads, by key."""
    case = SimpleNamespace(
        loop_rate=1000.0, scales=SimpleNamespace(nominal={"delay": 0.01, "kd": kd, "speed_lag": 0.0})
    )
    return {p.key: p for p in hypotheses._timing(case, set())}


def test_any_drive_may_be_a_little_late():
    late = timing()["delay"]
    assert 0.6e-3 < late.high < 0.9e-3 and late.low == -late.high and late.start == 0.0


def test_any_drive_may_filter_its_speed():
    assert 2.5e-3 < timing(kd=1.0)["speed_lag"].high < 4e-3 and "speed_lag" not in timing()


def test_what_holds_a_joint_gives_a_little():
    assert 1.5e-3 < give(SimpleNamespace(slide=False)) < 3e-3 and 4e-5 < give(SimpleNamespace(slide=True)) < 8e-5


def _noise_of(t: np.ndarray, q: np.ndarray) -> float | None:
    """Return what `quiet_noise` says of one recording q [S] rad of an encoder without counts."""
    return quiet_noise([(t, q, misfit(t, q[:, None])[:, 0])], 0.0)


def restless(loud: float, share: float, speed: float = 0.0) -> float | None:
    """Return what `quiet_noise` says of 100 half seconds of a joint that swings slowly, with noise of 1 mrad: in a
    share of them, here and there, `loud` times as much, and while moving faster by `speed` rad/s."""
    t, noise = np.arange(5000) * 0.01, 1e-3 * np.random.default_rng(5).normal(size=5000)
    on = (np.arange(5000) // 50 * 37) % 100 < 100 * share
    way = 0.3 * np.sin(0.4 * t) + np.cumsum(0.01 * speed * on)
    return _noise_of(t, way + noise * np.where(on, loud, 1.0))


def test_a_joint_that_rings_is_not_noisy():
    quiet = restless(8.0, 0.15)
    assert quiet is not None and np.allclose([quiet, restless(50.0, 0.7) or 0.0], 1e-3, rtol=0.1)
    assert restless(3.5, 0.15) is None and restless(8.0, 0.07) is None
    assert restless(8.0, 0.15, speed=1.0) is None  # readings whose times vary are noisier where it moves faster


def with_quiet_parts(count: int) -> float | None:
    """Return what `quiet_noise` says of 100 half seconds with noise of 1 mrad, of which a few, the fastest, have a
    tenth."""
    t, noise = np.arange(5000) * 0.01, 1e-3 * np.random.default_rng(5).normal(size=5000)
    on = np.arange(5000) // 50 >= 100 - count
    return _noise_of(t, np.cumsum(0.01 * on) + noise * np.where(on, 0.1, 1.0))


def test_a_few_quiet_moments_are_no_accident_only_from_three_on():
    assert with_quiet_parts(2) is None and with_quiet_parts(3) is not None


def test_what_noise_is_usual_is_told_by_several_joints():
    def is_usual(others: int) -> bool:
        rng, t = np.random.default_rng(3), np.arange(2000) * 0.01
        q = 0.3 * np.sin(0.4 * t)[:, None] + 1e-3 * rng.normal(size=(2000, others + 1))
        q[:, -1] += 4e-3 * np.sqrt(2) * np.sin(2 * np.pi * 31.0 * t + 0.2)
        run = SimpleNamespace(name="a", noises=None, t=t, q=q, torque=None, read=None, readings=lambda j: (t, q[:, j]))
        return usual_noise([run], others, 4e-3, np.ones(others + 1)) is not None

    assert [is_usual(n) for n in (2, 3)] == [False, True]


def rattling(loud: float, swings: float, others: float = 0.3, torque: float | None = None,
             steady: bool = False) -> float | None:  # fmt: skip
    """Return what `usual_noise` says of the last of four joints with noise of 1 mrad, which scatters by `loud` times
    as much: a share `swings` of its square by swings of 31 Hz, the rest as white noise does. others: rad that they
    move; torque: by how much its motor's torque scatters, x what theirs do, its limit being a half of theirs; None:
    not logged;
    steady: the rest is of swings of one size, each sample at another time of one."""
    rng, t = np.random.default_rng(3), np.arange(2000) * 0.01
    q = np.outer(np.sin(0.4 * t), [others, others, others, 0.3]) + 1e-3 * rng.normal(size=(2000, 4))
    more = np.sqrt(loud**2 - 1) * 1e-3
    rest = np.sqrt(2) * np.sin(rng.uniform(0, 2 * np.pi, 2000)) if steady else rng.normal(size=2000)
    q[:, 3] += more * np.sqrt(1 - swings) * rest
    q[:, 3] += more * np.sqrt(2 * swings) * np.sin(2 * np.pi * 31.0 * t + 0.2)
    scatter = None if torque is None else rng.normal(size=(2000, 4)) * [2e-3, 2e-3, 2e-3, 1e-3 * torque]
    run = SimpleNamespace(name="a", noises=None, t=t, q=q, torque=scatter, read=None, readings=lambda j: (t, q[:, j]))
    return usual_noise([run], 3, loud * 1e-3, np.array([1.0, 1.0, 1.0, 0.5]))


def test_a_joint_that_rings_all_the_time_has_the_others_noise():
    rings = rattling(4.0, 1.0)
    assert rings is not None and np.isclose(rings, 1e-3, rtol=0.1)
    assert rattling(2.0, 1.0) is None  # not so much noisier
    assert rattling(4.0, 1.0, others=0.1) is None  # a joint that hardly moves tells nothing of one that does
    assert rattling(4.0, 0.0) is None  # a worse sensor: its noise is white
    assert rattling(4.0, 0.15) is None and rattling(4.0, 0.3) is not None
    # too fast for its samples: the motor shakes by far more than a noisy reading makes it shake
    assert rattling(4.0, 0.0, torque=12.0) is not None and rattling(4.0, 0.0, torque=8.0) is None
    assert rattling(2.0, 0.0, torque=12.0) is None
    assert rattling(8.0, 0.0, steady=True) is not None and rattling(2.0, 0.0, steady=True) is None


def test_a_belief_weighs_some_samples():
    p = replace(param("kp", "kp", "factor", 0.9, 1.1, 1.0), nuisance=True, sd=0.025)
    assert 20.0 < disbelief([p], np.array([1.025])) < 45.0
