"""Readings that repeat old ones: told from those of a joint that rests, creeps, sticks and slips, or is hit."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from dexsim.gap.read import Run, channels

T = np.arange(0, 7, 0.01)
QUANTUM = 2 * np.pi / 4096


def goal(kind: int) -> np.ndarray:
    """Steps with rests, or a chirp."""
    if kind:
        return 0.3 * np.sin(2 * np.pi * (0.2 + 0.15 * T) * T)
    knots = np.arange(0, 8, 0.7)
    return np.interp(
        T,
        np.sort(np.r_[knots[1:], knots[1:] + 0.2]),
        np.repeat(np.random.default_rng(3).uniform(-0.8, 0.8, len(knots) - 1), 2),
    )


def follow(target: np.ndarray, stiction: float = 0.0) -> np.ndarray:
    """Return a joint of second order behind its target; it stays where it is until the target is `stiction` away,
    then it goes all the way."""
    q, v, out, stuck = target[0], 0.0, [], False
    for c in np.repeat(target, 10):
        stuck = abs(c - q) < stiction if stuck else stiction > 0 and abs(v) < 0.02 and abs(c - q) < stiction
        v = 0.0 if stuck else v + 1e-3 * (900.0 * (c - q) - 42.0 * v)
        q += 1e-3 * v
        out.append(q)
    return np.array(out[::10])


def run(name: str, target: np.ndarray, q: np.ndarray, noise: float = 0.0, quantum: float = QUANTUM) -> Run:
    read = q + noise * np.random.default_rng(len(name)).normal(size=len(q))
    return Run(
        name,
        ("joint",),
        T,
        target[:, None],
        T,
        (np.round(read / quantum) * quantum)[:, None],
        None,
        np.array([0, 0, -9.81]),
    )


def clean(noise: float, quantum: float = QUANTUM, stiction: float = 0.0) -> list[Run]:
    return [run(f"{k}", goal(k), follow(goal(k), stiction), noise, quantum) for k in (0, 1)]


@pytest.mark.parametrize("noise", [0.0, 2e-4, 1e-3])
@pytest.mark.parametrize(("first", "last"), [(100, 280), (205, 384), (333, 350), (430, 520)])
def test_a_frozen_stretch_is_found_in_every_noise(noise, first, last):
    runs = clean(noise)
    q = runs[1].q
    q[first : last + 1] = q[first]
    none, found = channels.repeated_stretches(runs, "joint")
    assert none == [] and len(found) == 1
    a, b = found[0]
    assert first - 3 <= a <= first and last <= b <= last + 3


@pytest.mark.parametrize("quantum", [QUANTUM, 2 * np.pi / 1024, 0.02])
@pytest.mark.parametrize("stiction", [0.0, 0.02, 0.1, 0.3])
def test_rests_of_a_coarse_encoder_and_of_a_joint_that_sticks_are_honest(quantum, stiction):
    runs = clean(0.0, quantum, stiction)
    longest = max(T[b] - T[a] for a, b in channels.rests(runs[0].q[:, 0]))
    assert longest > 0.3  # it does rest: readings repeat for as long as a frozen one's would
    assert channels.repeated_stretches(runs, "joint") == [[], []]
    assert not any(channels.repeated_samples(r.t, r.q[:, 0]).any() for r in runs)


def test_a_spike_at_rest_and_a_joint_that_is_held_are_no_old_readings():
    runs = clean(0.0)
    a, b = max(channels.rests(runs[0].q[:, 0]), key=lambda x: x[1] - x[0])
    runs[0].q[b] += 0.3  # one sample, and back
    assert channels.repeated_stretches(runs, "joint") == [[], []]
    target = goal(1)
    held = follow(np.where((T > 2) & (T < 4), target[200], target))  # somebody holds it for two seconds, then lets go
    assert channels.repeated_stretches([clean(0.0)[0], run("1", target, held)], "joint") == [[], []]


def test_single_readings_sent_twice():
    once = clean(2e-4)[1]
    assert not channels.repeated_samples(once.t, once.q[:, 0]).any()
    twice = once.q[:, 0].copy()
    twice[1::4] = twice[0::4]
    found = channels.repeated_samples(once.t, twice)
    assert found[1::4].sum() > 0.2 * len(twice) / 4 and not found[0::4].any()


def test_a_run_without_the_joint_and_two_joints():
    runs = clean(0.0)
    two = Run(
        "2",
        ("other", "joint"),
        T,
        np.stack([goal(0), goal(1)], 1),
        T,
        np.concatenate([runs[0].q, runs[1].q], 1),
        None,
        np.zeros(3),
    )
    two.q[200:330, 1] = two.q[200, 1]
    assert channels.repeated_stretches([*runs, two], "other") == [[], [], []]
    assert [len(x) for x in channels.repeated_stretches([*runs, two], "joint")] == [0, 0, 1]


def test_a_reading_that_is_knocked_away_at_rest_is_no_old_one():
    """Another motor's current pulls at an encoder: the joint stands at its target, one reading twitches, and after a
    while the readings leap away and come back. Where the joint was under way when they stood, they are old ones."""
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><joint name="joint"/><geom size="0.1" mass="0.1"/></body></worldbody></mujoco>'
    )
    target = np.repeat([0.3, -0.3, 0.2, 0.5, -0.2, 0.1, 0.4], 100)
    knocked = run("knocked", target, follow(target))
    q = knocked.q[:, 0]
    for a in range(60, len(T), 100):  # it has come to rest
        q[a : a + 40] = q[a]
        q[a + 2] -= 0.012
        q[a + 14 : a + 26] += 0.4 * np.exp(-np.arange(12) / 3)
    assert channels.inspect([knocked], model, {})[0] == []
    old = run("old", goal(1), follow(goal(1)))
    for a in (400, 450, 500):
        old.q[a : a + 9, 0] = old.q[a, 0]
    assert [f.regime.split(":")[0] for f in channels.inspect([old], model, {})[0]] == ["stale"]


def test_a_joint_that_rests_until_its_target_steps_is_not_frozen():
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><joint name="joint" range="-2 2" limited="true"/><geom size="0.1" mass="0.1"/></body>'
        "</worldbody></mujoco>"
    )
    rng = np.random.default_rng(0)
    sizes = np.where(np.arange(17) % 4 == 3, 0.1, 0.012) * rng.choice([-1, 1], 17)
    target = np.repeat(np.cumsum(sizes), 42)[: len(T)]
    target = np.r_[target, np.full(len(T) - len(target), target[-1])]
    there = np.r_[np.full(2, target[0]), target[:-2]]  # it starts at once, and dry friction stops it at once
    quick = 0.6 * there + 0.3 * np.r_[there[:1], there[:-1]] + 0.1 * np.r_[there[:2], there[:-2]]
    found, _, _ = channels.inspect([run("steps", target, quick)], model, {})
    assert [f for f in found if f.regime.startswith("stale")] == []
    held, sticks = 0.0, []
    target = np.where(T < 3.5, 0.3 * np.sin(4 * T), 0.2 * (T // 0.8 % 2) + 0.015 * (T // 0.4 % 2))
    for c in target:  # dry friction holds it through the small steps, as where it turns
        held = min(max(held, c - 0.02), c + 0.02)
        sticks.append(held)
    sticks = np.convolve(sticks, (0.5, 0.3, 0.2))[: len(T)]
    found, _, _ = channels.inspect([run("sticks", target, sticks)], model, {})
    assert [f for f in found if f.regime.startswith("stale")] == []
    chirp = 0.4 * np.sin(2 * np.pi * 0.5 * T)
    old = chirp.copy()
    for at in (100, 205, 310, 415):
        old[at : at + 12] = old[at]
    found, _, _ = channels.inspect([run("chirp", chirp, old)], model, {})
    assert [f.joints for f in found if f.regime.startswith("stale")] == [["joint"]]
