"""Benchmarks on real recordings: what they read off data without a model."""

from __future__ import annotations

import numpy as np

from benchmarks.real import sage_clock


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
