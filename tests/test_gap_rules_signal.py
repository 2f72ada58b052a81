"""Signals that are not what they say, and ends of a motion: figures of `rules.SIGNAL`."""

from __future__ import annotations

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from dexsim.actuator.table import ServoTable
from dexsim.gap.read import Run, channels, inputs

STEP = 0.01
SERVO = {"drive": "torque", "joints": {"*": {"kp": 1.0, "torque_limit": 100.0, "no_load_speed": 10.0}}}


def model(span: float = 1.0, mass: float = 1.0) -> mujoco.MjModel:
    """Return a joint of the range -span .. span whose load of `mass` kg lies 0.1 m beside its axis."""
    return mujoco.MjModel.from_xml_string(f"""<mujoco><compiler angle="radian"/><worldbody><body>
      <joint name="j" axis="0 1 0" limited="true" range="{-span} {span}"/>
      <geom size="0.01" pos="0.1 0 0" mass="{mass}"/></body></worldbody></mujoco>""")


def run(q: np.ndarray, target: np.ndarray, step: float = STEP) -> Run:
    """Return the positions and targets of one joint, every `step` s."""
    t = step * np.arange(len(q))
    return Run("a", ("j",), t, np.asarray(target, float)[:, None], t.copy(), np.asarray(q, float)[:, None],
               ServoTable.from_dict(SERVO), np.array([0.0, 0.0, -9.81]))  # fmt: skip


def wrong(r: Run, span: float = 1.0, lead: float = 0.0, sign: float = 0.0) -> str:
    """Return the kind of what is wrong with a run's joint, empty for nothing; lead [s], sign: of its position beside
    its target."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(channels, "_lead", lambda *_: lead)
        patch.setattr(channels, "_ways", lambda *_: (0.0, -sign))
        found = channels._wrong([r], r, 0, model(span))
    return "" if found is None else found.kind


def test_a_position_far_outside_its_range_is_not_that_joints():
    for beyond, kind in ((10.0, ""), (14.0, "unit")):  # the range spans 4 rad
        q = (2.0 + beyond) * np.sin(np.arange(400.0))
        q *= (2.0 + beyond) / np.abs(q).max()
        assert wrong(run(q, np.zeros(400)), span=2.0) == kind, beyond


def test_a_joint_that_follows_the_negative_of_its_target_is_named():
    r = run(np.sin(0.1 * np.arange(400)), np.sin(0.1 * np.arange(400)))
    assert wrong(r, 9.0, sign=-0.6) == "" and wrong(r, 9.0, sign=-0.8) == "sign"


@pytest.mark.parametrize("sign", [1, -1])
def test_a_sweep_beyond_the_resonance_is_no_other_sign(sign):
    """A joint on a weak spring, swept from 0.2 to 8 Hz in six recordings, 60 ms late: from 1 Hz on it lags by more than
    half a period, and follows the negative of its target more closely than its target of the last 0.2 s."""
    t = np.arange(0, 60, 0.005)
    target = np.sin(2 * np.pi * (0.2 * t + 0.5 * (7.8 / 60) * t**2))
    q, v, way = 0.0, 0.0, []
    for x in np.r_[np.zeros(12), target][: len(t)]:
        v += 0.005 * ((2 * np.pi) ** 2 * (sign * x - q) - 2 * 0.3 * 2 * np.pi * v)
        q += 0.005 * v
        way.append(q)
    parts = [slice(k, k + 2000) for k in range(0, 12000, 2000)]
    runs = [run(np.array(way)[p], target[p], 0.005) for p in parts]
    ways = channels.directions(runs, [channels.Targets(r) for r in runs], "j")
    assert ways == [sign] * 6  # of the slow ones, and so of all
    alone = [channels.directions([r], [channels.Targets(r)], "j")[0] for r in runs]
    assert alone[0] == sign and all(w > -1 for w in alone[1:])


def test_a_joint_that_hardly_moves_has_no_direction():
    wave = np.sin(0.1 * np.arange(400))
    assert wrong(run(0.15 * wave, wave), 9.0, sign=-1.0) == "" and wrong(run(0.25 * wave, wave), 9.0, sign=-1.0)


def test_a_joint_that_moves_before_its_target_is_on_another_clock():
    r = run(np.sin(0.1 * np.arange(400)), np.sin(0.1 * np.arange(400)))
    assert wrong(r, 9.0, lead=0.012) == "" and wrong(r, 9.0, lead=0.02) == "clock_skew"


def stopped(at: float, moved: float, further: float) -> bool:
    """Return whether a position is said to have stopped for good that moves by `moved` until the share `at` of a
    recording, its target by `further` of it more then."""
    k = int(400 * at)
    way = np.r_[np.linspace(0, moved, k), np.full(400 - k, moved)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(channels, "_holds", lambda *_: 0.0)
        return wrong(run(way, way + np.r_[np.zeros(k), np.linspace(0, further * moved, 400 - k)]), 9.0) == "stuck"


def test_a_position_stops_for_good_early_and_after_moving():
    assert stopped(0.7, 1.0, 0.5) and not stopped(0.8, 1.0, 0.5)
    assert stopped(0.5, 1.5e-3, 0.5) and not stopped(0.5, 0.8e-3, 0.5)
    assert stopped(0.5, 1.0, 0.35) and not stopped(0.5, 1.0, 0.25)


def smooth(rng: np.random.Generator, n: int) -> np.ndarray:
    """Return a motion [n] of no period, in steps of 5 ms."""
    window = np.hanning(61)
    return np.convolve(rng.normal(size=n), window / window.sum(), "same")


def test_a_lead_is_told_by_a_clear_correlation():
    """For a joint that is 0.1 s ahead of its target: with as much, or twice as much, of another motion beside it; or
    swinging, where a lag of almost a period fits nearly as well as the lead does."""
    rng = np.random.default_rng(0)
    target, other = smooth(rng, 4020), smooth(rng, 4000)
    for beside, lead in ((1.0, 0.1), (2.0, 0.0)):
        assert np.isclose(channels._lead(run(target[20:] + beside * other, target[:4000], 0.005), 0), lead), beside
    t = 0.005 * np.arange(4000)
    for period, lead in ((1.0, True), (1.3, False)):
        ahead, now = (np.sin(2 * np.pi * (t + x) / period) for x in (0.1, 0.0))
        assert (channels._lead(run(ahead, now, 0.005), 0) > 0.0) is lead, period


def test_a_joint_that_never_moves_must_have_been_asked_to():
    for way, kind in ((0.08, ""), (0.12, "stuck")):
        assert wrong(run(np.zeros(400), way * np.linspace(0, 1, 400)), 9.0) == kind, way


def frozen(stands: int = 8, jump: float = 4.0, before: float = 1.0) -> bool:
    """Return whether old readings are seen where a joint that moves by a step a sample stands for so many samples,
    twice, and then jumps by so many steps; before: its steps just before."""
    steps = np.ones(200)
    for a in (60, 120):
        steps[a - 5 : a] = before
        steps[a : a + stands] = 0.0
        steps[a + stands] = jump
    q = np.cumsum(steps)
    return bool(channels._held(STEP * np.arange(len(q)), q, np.zeros((2, len(q)))).any())


def test_readings_that_stand_while_a_joint_moves_are_old_ones():
    assert not frozen(stands=5) and frozen(stands=8)
    assert not frozen(jump=2.0) and frozen(jump=3.0)
    assert not frozen(before=0.07) and frozen(before=0.15)


def stretches(stands: float = 0.3, jump: float = 0.0, held: float = 0.0, span: float = 1.0) -> bool:
    """Return whether a joint's encoder is seen to freeze that stands for so many s while its target goes 1 rad, and
    then jumps there; jump [rad]: another, without a rest; held [rad]: what its target goes while it rests and moves
    on slowly;
    span [rad]: of the target in all."""
    n = round(stands / STEP)
    target = np.concatenate([np.zeros(100), np.linspace(0, 1, n), np.ones(100)])
    q = np.concatenate([np.zeros(100), np.zeros(n), np.ones(100)])
    q[:100] = 1e-3 * np.arange(-99, 1)
    q[100 + n :] += 1e-3 * np.arange(100)
    level = q[-1]
    # at rest while the target goes on, then slowly after it
    target = np.concatenate([target, np.linspace(1, 1 + held, 50), np.full(100, 1 + held)])
    q = np.concatenate([q, np.full(50, level), level + 1e-3 * np.arange(1, 101)])
    # a jump from motion, then to the far end of all
    q = np.concatenate([q, q[-1] + jump + 1e-3 * np.arange(1, 101)])
    target = np.concatenate([target, np.full(50, 0.0), np.full(50, span)])
    return bool(channels.repeated_stretches([run(q, target)], "j")[0])


def test_a_frozen_encoder_is_told_by_what_the_joint_does_elsewhere():
    assert not stretches(stands=0.08) and stretches(stands=0.13)
    assert stretches(jump=0.4) and not stretches(jump=0.6)
    assert stretches(held=0.4) and not stretches(held=0.6)
    assert stretches(span=8.0) and not stretches(span=12.0)


def test_a_few_repeated_samples_say_nothing():
    for samples, repeated, said in ((1000, 16, False), (1000, 24, True), (100, 6, False), (100, 10, True)):
        again = np.arange(samples) < repeated
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(channels, "repeats", lambda *_, again=again: again)
            assert bool(channels.repeated_samples(np.arange(samples), np.zeros(samples)).any()) is said, repeated


def seldom(sizes: np.ndarray, period: int = 100, late: int = 0, early: float = 0.0) -> float:
    """Return the period [samples] of an encoder's readings, of changes of these sizes every `period` samples, two of
    four later by `late`; early: share of changes that come between, small ones."""
    at = period * np.arange(1, len(sizes) + 1) + late * np.array([1, 1, -1, -1])[np.arange(len(sizes)) % 4]
    step = np.zeros(period * (len(sizes) + 2))
    step[at] = sizes
    if early:
        step[at[: round(early * len(sizes) / (1 - early))] - period // 2] = 1.0
    return channels.rhythm(np.arange(float(len(step))), np.cumsum(step))


def alike(count: int, size: float, small: int = 1) -> np.ndarray:
    """Changes of one size, `small` of them of 1, spread evenly."""
    sizes = np.full(count, size)
    sizes[np.linspace(0, count - 1, small).astype(int)] = 1.0
    return sizes


def test_an_encoder_that_is_read_seldom_leaps_in_a_rhythm():
    assert seldom(alike(60, 2.5)) == 0.0 and seldom(alike(60, 4.0)) == pytest.approx(100, rel=0.01)
    assert seldom(alike(100, 5.0, small=80)) == 0.0 and seldom(alike(100, 5.0, small=70)) > 0
    assert seldom(alike(60, 5.0), period=2) == 0.0 and seldom(alike(60, 5.0), period=3) > 0
    assert seldom(alike(100, 5.0), early=0.035) > 0 and seldom(alike(100, 5.0), early=0.075) == 0.0
    assert seldom(alike(60, 5.0), late=12) == 0.0 and seldom(alike(60, 5.0), late=5) > 0
    assert np.isnan(seldom(alike(8, 5.0))) and seldom(alike(14, 5.0)) > 0


def end(error: float, usual: float = 0.05, meeting: int = 30, times: int = 3, hard: bool = True) -> bool:
    """Return whether an end is seen where a joint of 1 rad of motion meets it so often, each time for so many
    samples, its target that far beyond it; usual: its error at rest elsewhere."""
    q, target = [np.full(200, 0.0)], [np.full(200, usual)]
    for _ in range(times):
        q += [np.linspace(0, 1, 100), np.full(meeting, 1.0), np.linspace(1, 0, 100), np.zeros(100)]
        target += [np.linspace(0, 1, 100), 1 + error * np.linspace(0.9, 1, meeting), np.linspace(1, 0, 100),
                   np.full(100, usual)]  # fmt: skip
    r = run(np.concatenate(q), np.concatenate(target))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(inputs, "_hard", lambda *_: hard)
        return inputs._end(SimpleNamespace(), SimpleNamespace(), [r], 0, 1) is not None


def test_an_end_is_met_hard_long_and_again():
    assert not end(0.2) and end(0.35)
    assert not end(0.03, usual=0.0) and end(0.05, usual=0.0)
    assert not end(1.0, meeting=8) and end(1.0, meeting=13)
    assert not end(1.0, times=1) and end(1.0, times=3)
