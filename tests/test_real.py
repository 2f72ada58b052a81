"""Benchmarks on real recordings: what they read off data without a model."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.real import sage_clock, sage_speed
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
