"""Benchmarks on real recordings: what they read off data without a model."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.real import sage_speed
from dexsim.errors import UserError


def test_lag_friction_and_sag_are_read_off_steady_motion(tmp_path):
    t = np.arange(0, 30, 0.02)
    for k, peak in enumerate((0.5, 0.9)):
        target = np.repeat((peak * np.abs((t / 4) % 2 - 1))[:, None], 6, 1)  # triangles: constant speed both ways
        speed = np.gradient(target, t, axis=0)
        position = target - 0.08 * speed - 0.01 * np.sign(speed) - np.r_[0, -0.03, 0, 0, 0, 0]
        np.savez(tmp_path / f"m{k}.npz", t=t, pos=position, t_cmd=t, cmd=target)
    found = sage_speed.lags(tmp_path)
    assert found["Rotation"]["lag_s"] == pytest.approx(0.08, abs=2e-3) and found["Rotation"]["friction_rad"] == pytest.approx(0.01, abs=1e-3)
    assert found["Pitch"]["sag_rad"] == pytest.approx(-0.03, abs=1e-3) and found["Rotation"]["sag_rad"] == pytest.approx(0, abs=1e-3)


def test_an_empty_folder_is_said(tmp_path):
    with pytest.raises(UserError, match="no motions"):
        sage_speed.lags(tmp_path)
