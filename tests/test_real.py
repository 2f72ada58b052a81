"""Benchmarks on real recordings: what they read off data without a model."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.real import bam_saturation, common, finger_spring, sage_clock, sage_speed
from dexsim.errors import UserError


def test_lag_friction_and_sag_are_read_off_steady_motion(tmp_path):
    t = np.arange(0, 30, 0.02)
    for k, peak in enumerate((0.5, 0.9)):
        target = np.repeat((peak * np.abs((t / 4) % 2 - 1))[:, None], 6, 1)  # triangles: constant speed both ways
        speed = np.gradient(target, t, axis=0)
        position = target - 0.08 * speed - 0.01 * np.sign(speed) - np.r_[0, -0.03, 0, 0, 0, 0]
        np.savez(tmp_path / f"m{k}.npz", t=t, pos=position, t_cmd=t, cmd=target)
    found = sage_speed.lags(tmp_path)
    assert found["Rotation"]["lag_s"] == pytest.approx(0.08, abs=2e-3) and found["Rotation"][
        "friction_rad"
    ] == pytest.approx(0.01, abs=1e-3)
    assert found["Pitch"]["sag_rad"] == pytest.approx(-0.03, abs=1e-3) and found["Rotation"][
        "sag_rad"
    ] == pytest.approx(0, abs=1e-3)


def test_an_empty_folder_is_said(tmp_path):
    with pytest.raises(UserError, match="no motions"):
        sage_speed.lags(tmp_path)


def test_motions_whose_commands_were_logged_a_period_late_are_told_by_the_current(tmp_path):
    rng, t = np.random.default_rng(0), np.arange(0, 20, 0.02)
    for name, late, friction in (
        ("a", 0, 0.01),
        ("b", 1, 0.01),
        ("c", 0, 0.03),
        ("d", 1, 0.03),
        ("e", 0, 0.02),
        ("f", 0, 0.01),
        ("still", 1, 0.01),
    ):
        acted = 0.3 * np.sin(np.outer(t, rng.uniform(0.8, 2.0, 6))) * (name != "still")
        speed = np.gradient(acted, t, axis=0)
        position = np.round((acted - 0.07 * speed - friction * np.sign(speed)) / 0.0015) * 0.0015
        duty = 2.3 * (0.5 * (acted + np.vstack([acted[:1], acted[:-1]])) - position) - 0.12 * np.gradient(
            position, t, axis=0
        )
        logged = np.vstack([acted[:1]] * late + [acted])[: len(t)]  # what acts at t is written down a period later
        scale = np.r_[np.ones(5), sage_clock.JAW]
        np.savez(
            tmp_path / f"{name}.npz",
            t=t,
            pos=position / scale,
            t_cmd=t,
            cmd=logged / scale,
            tau_abs=np.round(np.abs(duty) / 0.0065) * 0.0065,
        )
    found = sage_clock.late(tmp_path)
    assert {n for n, evidence in found.items() if evidence > sage_clock.SURE} == {"b", "d"}
    assert found["a"] < -sage_clock.SURE and found["c"] < -sage_clock.SURE and found["still"] == 0


def test_a_pendulum_that_hangs_stays_and_one_that_falls_swings_through():
    n = 1000  # 2 s
    row = lambda x: np.full((2, n), x)  # noqa: E731
    given = bam_saturation.Recorded(row(0.0), row(1.0), row(0.0), row(0.0), np.ones(2), np.array([100, 200]),
                                    np.array([0.0, 0.3]), np.zeros(2))  # fmt: skip
    free = np.array([[0.7, 25.0, 1e-3, 0.0, 0.0, 0.0, 0.0, 0.0]])
    still, swings = bam_saturation.errors(free, given)[0]
    assert still == 0.0 and swings == pytest.approx(0.3 * 2 / np.pi, rel=0.06)  # mean of |cos|


def test_torque_that_saturates_holds_a_pendulum_lower():
    n = 2500
    row = lambda x: np.full((1, n), x)  # noqa: E731
    given = bam_saturation.Recorded(row(1.5), row(1.0), row(1.0), row(0.0), np.ones(1), np.array([100]),
                                    np.zeros(1), np.zeros(1))  # fmt: skip
    x = np.array([[1.0, 25.0, 1e-3, 0.0, 0.02, 0.0, 0.0, r] for r in (0.0, 1.0)])
    plain, soft = bam_saturation.errors(x, given)[:, 0]
    assert 0.7 < plain and soft < 0.85 * plain


def clips(x, seconds=3.0):
    """A finger of these parameters, as its readings show it."""
    n, before = int(seconds / finger_spring.STEP), round(finger_spring.OLDEST / finger_spring.STEP)
    duty = np.where(np.arange(n + before) // 200 % 2, -0.5, 0.5)[None]
    step = np.arange(0, n, 25)
    given = finger_spring.Clips(duty, np.zeros(1), np.zeros(1), np.zeros(len(step), int), step, np.zeros(len(step)))
    return given, step


def test_a_fingers_spring_and_the_age_of_its_readings_are_told_from_friction():
    true = np.array([2.0, 1.3, 0.5, 1.5, 1.0, 0.1])
    given, step = clips(true)
    # its path, off one reading at a time
    for k in range(len(step)):
        one = finger_spring.Clips(given.duty, given.q0, given.v0, np.zeros(1, int), step[k : k + 1], np.zeros(1))
        given.q[k] = finger_spring.errors(true[None], one)[0]
    assert np.ptp(given.q) > 0.1 and finger_spring.errors(true[None], given)[0] < 1e-12
    without = true.copy()
    without[3:] = -9.0, -9.0, 0.0
    assert finger_spring.errors(without[None], given)[0] > 0.05


def test_the_fit_of_the_checks_finds_what_they_hold_free():
    far = lambda x: ((x - np.array([0.3, -2.0, 1.0])) ** 2).sum(1)  # noqa: E731
    x = common.fitted(far, [(-1.0, 1.0), (-5.0, 5.0), (0.5, 0.5)], 60)
    assert x == pytest.approx([0.3, -2.0, 0.5], abs=0.05) and x[2] == 0.5
