"""Spikes, backward and jumped stamps: found, left out of the fit, and said; clean signals have none."""

from __future__ import annotations

import numpy as np
import pytest
import recordings

from dexsim.recording import Writer, audit_values, read, timeline
from dexsim.recording.spikes import spiked

T = np.arange(0, 10, 0.01)


def signals():
    """Clean motions that must not be taken for spikes."""
    rng = np.random.default_rng(0)
    steps = np.repeat(rng.uniform(-1, 1, 20), 50)
    servo = np.zeros_like(T)
    for i in range(1, len(T)):
        servo[i] = servo[i - 1] + 0.2 * (steps[i] - servo[i - 1])
    stick = np.round(0.5 * np.sin(2 * T) / 0.05) * 0.05
    return {
        "steps": steps,
        "servo": servo,
        "sine": 0.6 * np.sin(9 * T) + 1e-3 * rng.standard_normal(len(T)),
        "chirp": np.sin(2 * np.pi * (0.2 + 0.14 * T) * T),
        "stick": stick,
        "prbs": np.repeat(rng.choice([-1.0, 1.0], 500), 2),
        "alternating": np.where(np.arange(len(T)) % 2, 1.0, -1.0),
        "noise": rng.standard_normal(len(T)),
        "triangle": np.abs((T % 1.0) - 0.5),
        "rest": np.zeros_like(T),
        "ramp": T,
    }


@pytest.mark.parametrize("name", list(signals()))
@pytest.mark.parametrize("quantity", ["position", "command", "effort"])
def test_a_clean_signal_has_no_spike(name, quantity):
    assert not spiked(signals()[name], quantity).any()


def test_the_fast_end_of_a_slow_chirp_has_no_spike():
    """Most of it is slow, so that the crests of its last seconds lie far from the median of their neighbours."""
    t = np.arange(0, 120, 0.02)
    x = 0.15 * np.sin(2 * np.pi * np.cumsum(0.05 * 80.0 ** (t / 120)) * 0.02)
    x[t < 60] *= 0.3
    for quantity in ("position", "command", "effort"):
        assert not spiked(x, quantity).any(), quantity
    x[[1000, 3000, 5900]] += 1.5
    assert spiked(x, "command").nonzero()[0].tolist() == [1000, 3000, 5900]


def test_a_command_that_goes_to_a_level_for_one_sample_means_it():
    """A pseudo-random binary sequence of long pulses, but for a few of one sample: the level is one that it holds."""
    rng = np.random.default_rng(3)
    x = np.repeat(rng.choice([-0.12, 0.12], 400), 15)
    for k in (1007, 2515, 4003):
        x[k] = -x[k]
    assert not spiked(x, "command").any()
    x[[300, 777]] = 0.9
    assert spiked(x, "command").nonzero()[0].tolist() == [300, 777]


@pytest.mark.parametrize("name", ["steps", "servo", "sine", "chirp", "stick", "rest"])
@pytest.mark.parametrize("share", [0.002, 0.02, 0.05])
def test_planted_spikes_are_found(name, share):
    rng = np.random.default_rng(7)
    x = signals()[name].copy()
    at = rng.choice(len(x), int(share * len(x)), replace=False)
    x[at] += 1.5 * rng.choice([-1, 1], len(at))
    on = spiked(x, "position")
    assert on[at].mean() > 0.93 and np.delete(on, at).sum() <= 2


def test_effort_that_follows_a_jump_of_its_target_is_none():
    r = recordings.signal()
    r.commands.value[:, 0] = np.repeat(np.random.default_rng(1).uniform(-0.5, 0.5, 16), 50)
    r.states.effort.value[:, 0] *= 0.01
    r.states.effort.value[50::50, 0] = 2.0  # a current peak of one sample at each step
    from dexsim.recording.spikes import of_effort

    assert not of_effort(r, 0).any()
    r.states.effort.value[30::100, 0] = 2.0
    assert of_effort(r, 0)[30::100].all()


def test_a_clock_set_back_for_good_loses_only_what_overlaps():
    t = np.r_[T, T - 3.0 + 10.0]
    on = timeline.possible(t)
    assert (np.diff(t[on]) >= 0).all() and on.sum() >= len(t) - 300
    (gap,) = timeline.gaps(t, on)
    assert gap == pytest.approx((7.0, 10.0), abs=0.05)


@pytest.mark.parametrize("jump", [-3.0, 3.0, 600.0, 3600.0, -1e9, 1e18])
@pytest.mark.parametrize("share", [0.005, 0.05])
def test_stamps_that_jump_for_a_sample_are_left_out(jump, share):
    rng = np.random.default_rng(2)
    t = T.copy()
    at = rng.choice(len(t), int(share * len(t)), replace=False)
    t[at] += jump
    on = timeline.possible(t)
    assert not on[at].any() and on.sum() >= len(t) - len(at) - 2
    assert not timeline.gaps(t, on)


def test_a_recording_of_jumped_stamps_is_read_on_its_true_clock(tmp_path):
    made = recordings.signal(4.0)
    rng = np.random.default_rng(3)
    late = rng.choice(len(made.commands.t), 12, replace=False)
    with Writer(tmp_path / "a.mcap", made.joints, made.meta, 1_700_000_000_000_000_000) as w:
        for i, t in enumerate(made.commands.t):
            t = t + (3600.0 if i in late else 0.0)
            w.add_command(t, made.commands.value[i])
            w.add_state(t, made.states.position.value[i])
    r = read(tmp_path / "a.mcap")
    assert r.duration < 4.1 and len(r.states.position) == 388
    assert {
        f.topic for f in r.findings if f.kind == "time_not_monotonic" and f.count == 12 and "left out" in f.text
    } == {"/joint_states", "/joint_commands"}


@pytest.mark.parametrize("quantity", ["position", "command"])
def test_values_that_no_joint_has_are_said_where_they_are_too_many_for_spikes(quantity):
    r = recordings.signal()
    series = r.commands if quantity == "command" else r.states.position
    at = np.random.default_rng(4).random(len(series.t)) < 0.3
    series.value = series.value.copy()
    series.value[at, 0] = -1e300
    said = [f for f in audit_values.units(r) if "farther than any joint" in f.text]
    assert [(f.joint, f.topic, f.severity) for f in said] == [(r.joints[0], series.topic, "error")]
    series.value[:, 0] = np.where(np.arange(len(series.t)) % 50 == 25, 1e300, T[: len(series.t)])
    assert not [f for f in audit_values.units(r) if "farther than any joint" in f.text], "single ones are spikes"


def test_the_crest_of_a_fast_reversal_with_a_message_missing_has_no_spike():
    """Three samples are far from the median of their neighbours, and were reached in two large steps: one over the gap,
    one behind the crest. They are where the joint was."""
    before = -0.28 + 0.0 * np.arange(60)
    before[-6:] = [-0.2807, -0.2730, -0.2592, -0.2393, -0.2163, -0.1948]
    crest = [-0.1381, -0.1227, -0.1488]
    after = np.r_[-0.1994, -0.2608, -0.3068, -0.3436, -0.3636, -0.3774, -0.3804, -0.3774, np.full(60, -0.375)]
    x = np.r_[before, crest, after]
    assert not spiked(x, "position").any()
    x[[30, 31]] = 0.5  # two that are
    assert np.flatnonzero(spiked(x, "position")).tolist() == [30, 31]
