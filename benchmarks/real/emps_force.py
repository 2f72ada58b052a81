"""EMPS as its authors judge it: the recorded force drives a mass with friction, without feedback; and least squares on
the force."""

from __future__ import annotations

from pathlib import Path

import numpy as np

FILES = {"estimation": "DATA_EMPS.mat", "pulses": "DATA_EMPS_PULSES.mat"}
SUBSTEPS = 4


def load(data: Path, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times s, positions m, forces N of one of FILES."""
    from scipy.io import loadmat

    raw = loadmat(data / FILES[name])
    get = lambda key: np.asarray(raw[key], float).reshape(-1)  # noqa: E731
    return get("t"), get("qm"), float(raw["gtau"].squeeze()) * get("vir")


def open_loop(
    t: np.ndarray,
    q: np.ndarray,
    force: np.ndarray,
    mass: float,
    viscous: float,
    coulomb: float,
    offset: float = 0.0,
    peak: float = 0.0,
    v_s: float = 1.0,
    by_direction: float = 0.0,
    late: float = 0.0,
) -> float:
    """Return RMSE [m] of the position that the recorded force alone gives, acting `late` s late:
    M a = F - Fv v - by_direction |v| - (Fc + peak exp(-(v/v_s)^2)) sign(v) - offset."""
    dt = float(np.median(np.diff(t))) / SUBSTEPS
    if late:
        force = np.interp(t - late, t, force)
    x, v, out = float(q[0]), 0.0, np.empty(len(q))
    for i in range(len(q)):
        out[i] = x
        for _ in range(SUBSTEPS):
            drive = force[i] - offset
            level = coulomb + (peak * np.exp(-((v / v_s) ** 2)) if peak else 0.0)
            free = v + dt * (drive - viscous * v - by_direction * abs(v)) / mass
            stop = dt * level / mass  # dry friction takes speed away, never turns it round
            v = free - stop if free > stop else free + stop if free < -stop else 0.0
            x += dt * v
    return float(np.sqrt(np.mean((out - q) ** 2)))
