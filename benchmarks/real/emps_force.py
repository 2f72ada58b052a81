"""EMPS as its authors judge it: the recorded force drives a mass with friction, without feedback; and least squares on the force."""

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


def open_loop(t: np.ndarray, q: np.ndarray, force: np.ndarray, mass: float, viscous: float, coulomb: float, offset: float = 0.0,
              peak: float = 0.0, v_s: float = 1.0) -> float:
    """RMSE [m] of the position that the recorded force alone gives: M a = F - Fv v - (Fc + peak exp(-(v/v_s)^2)) sign(v) - offset."""
    dt = float(np.median(np.diff(t))) / SUBSTEPS
    x, v, out = float(q[0]), 0.0, np.empty(len(q))
    for i in range(len(q)):
        out[i] = x
        for _ in range(SUBSTEPS):
            drive = force[i] - offset
            level = coulomb + peak * np.exp(-((v / v_s) ** 2))
            free = v + dt * (drive - viscous * v) / mass
            stop = dt * level / mass  # dry friction takes speed away, never turns it round
            v = np.sign(free) * max(abs(free) - stop, 0.0)
            x += dt * v
    return float(np.sqrt(np.mean((out - q) ** 2)))


def least_squares(t: np.ndarray, q: np.ndarray, force: np.ndarray, cut: float = 40.0) -> dict[str, float]:
    """M, Fv, Fc, offset by least squares of the filtered force on acceleration, speed, sign and one (the literature's IDIM-LS)."""
    from scipy.signal import butter, decimate, filtfilt

    dt = float(np.median(np.diff(t)))
    b, a = butter(4, cut * 2 * dt)
    smooth = filtfilt(b, a, q)
    v = np.gradient(smooth, dt)
    acc = np.gradient(v, dt)
    columns = np.stack([acc, v, np.sign(v), np.ones_like(v)], 1)
    keep = slice(200, -200)
    X = np.stack([decimate(c[keep], 25, ftype="iir", zero_phase=True) for c in columns.T], 1)
    y = decimate(force[keep], 25, ftype="iir", zero_phase=True)
    x = np.linalg.lstsq(X, y, rcond=None)[0]
    return dict(zip(("mass", "viscous", "coulomb", "offset"), map(float, x), strict=True))
