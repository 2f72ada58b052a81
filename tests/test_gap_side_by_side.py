"""What a diagnosis does side by side is what it does one after the other."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from test_gap_linkage import MODEL

from dexsim.actuator.table import ServoTable
from dexsim.gap import compute
from dexsim.gap.plant.case import _since_reversal, moved, refined_cases
from dexsim.gap.plant.columns import SERIES
from dexsim.gap.plant.lines import on_lines
from dexsim.gap.plant.mechanics import cross
from dexsim.gap.read import Run

SERVO = {"drive": "torque", "joints": {"*": {"kp": 4.0, "kd": 0.1, "torque_limit": 2.0}}}


def two_runs() -> list[Run]:
    """Return two recordings of the linkage's two joints."""
    out = []
    for k in range(2):
        t = np.arange(0.0, 2.0, 0.01)
        cmd = 0.4 * np.stack([np.sin((3 + k) * t), np.cos(4 * t + k) - np.cos(k)], 1)
        q = 0.4 * np.stack([np.sin((3 + k) * (t - 0.03)), np.cos(4 * (t - 0.02) + k) - np.cos(k)], 1)
        out.append(Run(f"r{k}", ("a", "b"), t, q, t, cmd, ServoTable.from_dict(SERVO), np.array([0.0, 0.0, -9.81])))
    return out


def refined(monkeypatch, cores: int):
    monkeypatch.setenv("OMP_NUM_THREADS", str(cores))
    return refined_cases(mujoco.MjModel.from_xml_string(MODEL), two_runs(), "cpu", 1e-3)


def test_cases_do_not_depend_on_the_number_of_cores(monkeypatch):
    one, four = (refined(monkeypatch, n) for n in (1, 4))
    assert [c.joint for c in one] == [c.joint for c in four] == ["a", "b"]
    for a, b in zip(one, four, strict=True):
        assert a.plant.series.tobytes() == b.plant.series.tobytes()
        assert a.scales == b.scales and a.sigma == b.sigma
        assert all(np.array_equal(x, b.regimes[k], equal_nan=True) for k, x in a.regimes.items())


def test_a_motion_without_what_may_be_added_is_the_same_motion():
    """Refining simulates with no mass added and no tilt: those columns alone are left out."""
    model, runs = mujoco.MjModel.from_xml_string(MODEL), two_runs()
    unchanged = lambda j, plant: plant  # noqa: E731
    whole, bare = moved(model, runs, unchanged).used, moved(model, runs, unchanged, added=False).used
    for j, plant in whole.items():
        windows = plant.windows(None)
        expected, got = (p.simulate(p.base()[None], p.windows(None)) for p in (plant, bare[j]))
        assert len(windows.window) and all(a.tobytes() == b.tobytes() for a, b in zip(expected, got, strict=True))
        assert (plant.series != bare[j].series).any(), "nothing was left out"


def test_each_keeps_the_order_and_hands_errors_on(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    assert compute.each(20, lambda k: k * k) == [k * k for k in range(20)]
    assert compute.each(0, lambda k: k) == []

    def bad(k: int) -> int:
        if k == 7:
            raise ValueError("seven")
        return k

    with pytest.raises(ValueError, match="seven"):
        compute.each(9, bad)


@pytest.mark.parametrize("columns", [7, len(SERIES)])
def test_lines_between_rows_are_those_of_interp(columns):
    rng = np.random.default_rng(0)
    known = np.sort(np.r_[rng.uniform(0, 5, 700), 1.0, 2.0])
    x = rng.normal(size=(len(known), columns))
    x[:, 2] = 0.0
    at = np.sort(np.r_[rng.uniform(-1, 6, 3000), known])  # before, after and exactly on what is known
    expected = np.stack([np.interp(at, known, c) for c in x.T], 1)
    np.testing.assert_array_equal(on_lines(at, known, x), expected)
    room = np.full((len(at) + 2, 2 * columns), -1.0)  # into some rows and every other column, and no farther
    room[1:-1, ::2] = 0.0
    on_lines(at, known, x, room[1:-1, ::2])
    np.testing.assert_array_equal(room[1:-1, ::2], expected)
    assert (room[[0, -1]] == -1.0).all() and (room[:, 1::2] == -1.0).all()


def test_cross_products_are_numpys():
    a, b = np.random.default_rng(1).normal(size=(2, 50, 3))
    np.testing.assert_allclose(cross(a, b), np.cross(a, b), rtol=1e-15)
    np.testing.assert_allclose(cross(a, b[0]), np.cross(a, b[0]), rtol=1e-15)


def test_time_since_a_reversal():
    t = 0.5 * np.arange(12)
    v = np.array([0.0, 1.0, 1.0, 0.001, 1.0, -1.0, 0.0, -1.0, 1.0, 1.0, 1.0, 1.0])
    np.testing.assert_allclose(_since_reversal(t, v, 0.01), [9, 9, 9, 9, 9, 0, 0.5, 1, 0, 0.5, 1, 1.5])
