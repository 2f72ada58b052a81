"""A joint of the recordings simulated without correction, under one set of fitted figures."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dexsim.gap.plant.batch import Windows
from dexsim.gap.plant.case import Case
from dexsim.gap.plant.columns import INDEX, Param, expand
from dexsim.gap.rules import JUDGE

FIRST = 0.1  # s of a recording that begins in motion tell where and how fast: within
START_NOISE, START_SPEED = 10.0, 0.2  # x the noise, and of a joint's speed, of what the samples about its first say


def free_run(
    case: Case,
    params: list[Param],
    x: np.ndarray,
    windows: Windows,
    fixed: Sequence[tuple[str, float]] = (),
    underway: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Return simulated position and motor torque [n] at the windows' samples, from their first sample on without
    correction.

    underway: the position at which a window begins in motion, and its speed there, are fitted to its first `FIRST`
    seconds: what a few samples on one side say of a speed is off by far where a target has just jumped."""
    plants = expand(case.plant, params, x[None], fixed)
    q, tau = _begun(case, plants, windows) if underway else case.plant.simulate(plants, windows)
    return q[0], plants[0, 0, INDEX["effort_gain"]] * tau[0] + plants[0, 0, INDEX["effort_offset"]]


def _begun(case: Case, plants: np.ndarray, windows: Windows) -> tuple[np.ndarray, np.ndarray]:
    """Return position and torque [1, n] of one guess [1, R, C], windows that begin in motion from where their first
    samples say they did."""
    sigma, window, t = case.sigma, windows.sample_window, case.plant.t[windows.sample_row]
    first = np.flatnonzero(np.r_[True, np.diff(window) != 0]) if len(window) else np.zeros(0, int)
    moving = np.abs(case.regimes["_speed"][windows.sample_row[first]]) > JUDGE.turning * case.scales.speed
    if not moving.any():
        return case.plant.simulate(plants, windows)
    size = np.array([START_NOISE * sigma, START_SPEED * case.scales.speed])
    head = windows.heads(np.bincount(window[t < t[first][window] + FIRST], minlength=len(first)))
    q, _ = case.plant.simulate(np.repeat(plants, 3, 0), head, np.array([[0.0, 0.0], [size[0], 0.0], [0.0, size[1]]]))
    slope, measured = q[1:] - q[0], case.plant.q[head.sample_row]
    starts = np.zeros((1, len(first), 2))
    for k in np.flatnonzero(moving):
        early = head.sample_window == k
        A = np.concatenate([slope[:, early].T / sigma, np.eye(2)])
        starts[0, k] = size * np.linalg.lstsq(A, np.r_[(measured - q[0])[early] / sigma, 0.0, 0.0], rcond=None)[0]
    return case.plant.simulate(plants, windows, starts)
