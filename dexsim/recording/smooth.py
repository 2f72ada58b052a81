"""Signals at irregular times, smoothed: value and derivatives."""

from __future__ import annotations

import numpy as np


def at(t: np.ndarray, times: np.ndarray, x: np.ndarray, held: bool = False) -> np.ndarray:
    """Return a signal x [T] of `times` [T] s at t [n] s: on straight lines between its numbers, or (`held`) the last
    one; the first before it; NaN where it has none."""
    ok = np.isfinite(x) & np.isfinite(times)
    if not ok.any():
        return np.full(len(t), np.nan)
    times, x = times[ok], x[ok]
    return x[np.clip(np.searchsorted(times, t, side="right") - 1, 0, None)] if held else np.interp(t, times, x)


class LocalPolynomial:
    """Value and first two time derivatives of signals at t [S] s by weighted least squares in a window of +- width s.

    The window holds at least two samples on each side. Times may be irregular. What depends on them alone is kept: the
    joints of a recording share it.
    """

    def __init__(self, t: np.ndarray, width: float = 0.03, degree: int = 2):
        self.t, n = t, len(t)
        if n < 5:
            return
        step = float(np.median(np.diff(t)))
        k = int(np.clip(round(width / max(step, 1e-6)), 2, 40))
        k = min(k, (n - 1) // 2)
        self._index = np.clip(np.arange(n)[:, None] + np.arange(-k, k + 1)[None, :], 0, n - 1)
        dt = t[self._index] - t[:, None]
        weight = np.exp(-0.5 * (dt / (0.6 * k * step)) ** 2)
        # an index clipped at an end repeats a sample: count it once
        first = np.ones_like(weight, dtype=bool)
        first[:, 1:] = self._index[:, 1:] != self._index[:, :-1]
        weight = weight * first
        self._scale = k * step
        basis = np.stack([(dt / self._scale) ** d for d in range(degree + 1)], -1)  # [S, m, D]
        self._weighted = weight[..., None] * basis
        self._normal = self._weighted.transpose(0, 2, 1) @ basis
        self._normal += 1e-9 * np.eye(degree + 1)

    def __call__(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return value [S, J] of x [S, J], and its derivatives by s and s^2."""
        if len(self.t) < 5:
            zero = np.zeros_like(x)
            return x.copy(), zero, zero
        right = self._weighted.transpose(0, 2, 1) @ x[self._index]
        c = np.linalg.solve(self._normal, right)
        return c[:, 0], c[:, 1] / self._scale, 2.0 * c[:, 2] / self._scale**2


def local_polynomial(t: np.ndarray, x: np.ndarray, width: float = 0.03, degree: int = 2) -> tuple[np.ndarray, ...]:
    """Return `LocalPolynomial` of x [S, J] at t [S] s."""
    return LocalPolynomial(t, width, degree)(x)
