"""Inverse dynamics: what lies behind the motor, from the recorded motor torque alone, whatever the firmware did.

    torque = inertia * a + viscous * v + coulomb * sign(v) + offset          (IDIM-LS: Gautier, Janot, Vandanjon 2013)

Position and torque pass the same low-pass forth and back, so that both are late by nothing. Linear, hence at once and without
a start; it needs a logged torque, and readings fast beside the motion.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import butter, filtfilt

CUTOFF = 0.2  # of half the sampling rate, and no more than TOP Hz
TOP = 60.0
RATE = 200.0  # Hz: readings slower than this are too few for a second derivative
DRAWS = 300
BLOCK = 0.5  # s
NAMES = ("inertia", "viscous_friction", "coulomb_friction", "offset")


@dataclass
class Inverse:
    """value, low, high [4] by `NAMES` (90 %, block bootstrap), in kg.m2, N.m.s/rad, N.m (kg, N.s/m, N for a slide); residual:
    rms of what is left over the rms of the torque. extra: (a further effect, share of the residual's rms it removes)."""

    value: dict[str, float]
    low: dict[str, float]
    high: dict[str, float]
    residual: float
    extra: list[tuple[str, float]]


def identify(t: np.ndarray, q: np.ndarray, torque: np.ndarray, seed: int = 0, test: tuple[np.ndarray, ...] | None = None) -> Inverse:
    """From times [n] s, positions [n] and motor torques [n] of one joint without gravity. test: (t, q, torque) of a recording
    that only judges the further effects. Raises ValueError for fewer than 200 samples."""
    if len(t) < 200:
        raise ValueError(f"{len(t)} samples are too few for inverse dynamics (200)")
    v, X, u, blocks, smooth = _filtered(t, q, torque)
    theta = np.linalg.lstsq(X, u, rcond=None)[0]
    left = u - X @ theta
    count = int(blocks.max()) + 1
    grams = np.stack([X[blocks == b].T @ X[blocks == b] for b in range(count)])
    sides = np.stack([X[blocks == b].T @ u[blocks == b] for b in range(count)])
    pick = np.random.default_rng(seed).integers(0, count, (DRAWS, count))
    draws = np.stack([np.linalg.lstsq(grams[i].sum(0), sides[i].sum(0), rcond=None)[0] for i in pick])
    low, high = np.quantile(draws, [0.05, 0.95], axis=0)
    tv, tX, tu, _, tsmooth = (v, X, u, blocks, smooth) if test is None else _filtered(*test)
    before = np.std(tu - tX @ theta)
    extra = []
    for name, column in _further(float(np.abs(v).max())).items():
        more = np.linalg.lstsq(np.column_stack([X, smooth(column(v))]), u, rcond=None)[0]
        after = np.std(tu - np.column_stack([tX, tsmooth(column(tv))]) @ more)
        extra.append((name, float(1 - after / before)))
    pack = lambda x: {n: float(y) for n, y in zip(NAMES, x, strict=True)}  # noqa: E731
    return Inverse(pack(theta), pack(low), pack(high), float(np.std(left) / np.std(u)), sorted(extra, key=lambda e: -e[1]))


def texts(cases, runs, train: list[int], test: list[int], seed: int = 0) -> list[str]:
    """In words, of each joint that gravity does not load and whose motor torque was logged: its figures by inverse dynamics from
    the first training recording, and the further effect that helps most on the first one kept out."""
    out = []
    for case in cases:
        seen = lambda r, j=case.index: (runs[r].t, runs[r].q[:, j], runs[r].torque[:, j])  # noqa: E731
        good = lambda r: runs[r].torque is not None and np.isfinite(seen(r)[2]).all() and len(runs[r].t) >= 2000  # noqa: B023, E731
        first = next((r for r in train if good(r)), None)
        if first is None or case.scales.gravity > 0.02 * case.scales.tau or 1 / np.median(np.diff(runs[first].t)) < RATE or case.scales.others:
            continue
        other = next((r for r in test if r not in train and good(r)), None)
        found = identify(*seen(first), seed, None if other is None else seen(other))
        said = ", ".join(f"{n.replace('_', ' ')} {found.value[n]:.4g} ({found.low[n]:.4g} to {found.high[n]:.4g})" for n in NAMES)
        text = f"{case.joint}: by the recorded motor torque alone: {said}; {100 * found.residual:.1f} % of the torque is left"
        name, share = found.extra[0]
        if share > 0.05:
            text += f"; {name} takes {100 * share:.0f} % of that away" + (" in the recording kept out" if other is not None else "")
        out.append(text)
    return out


def _further(top: float) -> dict:
    """One more effect each, as a column of the speed."""
    out = {"viscous friction that differs by direction": lambda v: np.abs(v), "friction with the square of the speed": lambda v: v * np.abs(v)}
    for part in (0.02, 0.08, 0.2):
        out[f"stribeck_friction (v_s {part * top:.3g})"] = lambda v, s=part * top: np.sign(v) * np.exp(-((v / s) ** 2))
    return out


def _filtered(t: np.ndarray, q: np.ndarray, torque: np.ndarray) -> tuple:
    """Speeds [m], columns [m, 4], torques [m], blocks [m], and the filter for a further column of the speeds: what jumps with
    the sign of the speed must be smoothed as the torque is."""
    step = float(np.median(np.diff(t)))
    even = np.arange(t[0], t[-1], step)
    q, torque = np.interp(even, t, q), np.interp(even, t, torque)
    b, a = butter(4, min(CUTOFF, TOP * 2 * step))
    once, u = filtfilt(b, a, q), filtfilt(b, a, torque)
    v = np.gradient(once, step)
    acceleration = np.gradient(v, step)
    edge = slice(50, -50)  # the filter's ends
    smooth = lambda x: filtfilt(b, a, x)[edge]  # noqa: E731
    X = np.stack([acceleration[edge], v[edge], smooth(np.sign(v)), np.ones(len(v[edge]))], 1)
    return v, X, u[edge], ((even[edge] - even[0]) / BLOCK).astype(int), smooth
