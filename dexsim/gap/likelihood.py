"""How probable what a hypothesis leaves is: white noise, and in each window a drift of its own.

    y(t) = f(theta; t) + drift(t) + white,   drift an Ornstein-Uhlenbeck process

The density is that of the process' Kalman filter (Sarkka and Solin, Applied Stochastic Differential Equations, 2019,
10.6): neighbouring residuals that go the same way count as little as they say.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

SIZES = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0)  # of a drift that are tried, x the white noise
TIMES = (0.02, 0.1, 0.5)  # s of a drift that are tried


@dataclass(frozen=True)
class Noise:
    """Standard deviations of white noise and drift, in the residual's unit; time constant of the drift [s]."""

    white: float
    drift: float = 0.0
    time: float = 1.0


def noises(white: float) -> list[Noise]:
    """Return the noises that are tried: without a drift, then of every size and time."""
    return [Noise(white), *(Noise(white, k * white, t) for k in SIZES for t in TIMES)]


class Density:
    """Densities of residuals [m] at times t [m] s in windows [m] (numbers from 0 on, in order), under several noises.

    use [m]: which samples are there. What does not depend on the residuals is computed once.
    """

    def __init__(self, window: np.ndarray, t: np.ndarray, given: Sequence[Noise], use: np.ndarray | None = None):
        rows = np.arange(len(t)) if use is None else np.flatnonzero(use)
        window, t = window[rows], t[rows]
        self.given, self.windows = tuple(given), int(window.max()) + 1 if len(window) else 0
        count = np.bincount(window, minlength=self.windows)
        first = np.concatenate([[0], np.cumsum(count)[:-1]])
        n = int(count.max()) if len(count) else 0
        on = np.arange(n) < count[:, None]
        at = np.where(on, first[:, None] + np.arange(n), 0)  # [W, n] row of each sample
        self.rows, self.on = (rows[at] if len(rows) else at), on
        gap = np.full(on.shape, np.inf)
        gap[:, 1:] = np.diff(np.where(on, t[at] if len(t) else 0.0, np.nan), axis=1)
        white, drift, time = np.array([(k.white, k.drift, k.time) for k in given]).T[:, :, None]
        self.keep = np.nan_to_num(np.exp(-gap[None] / time[:, :, None]))  # [K, W, n] what of the drift goes on
        self.gain, self.spread = np.zeros_like(self.keep), np.ones_like(self.keep)
        known = np.zeros((len(given), self.windows))
        for i in range(n):
            before = self.keep[:, :, i] ** 2 * known + drift**2 * (1 - self.keep[:, :, i] ** 2)
            self.spread[:, :, i] = before + white**2
            self.gain[:, :, i] = before / self.spread[:, :, i]
            known = (1 - self.gain[:, :, i]) * before
        self.constant = -0.5 * np.where(on, np.log(2 * np.pi * self.spread), 0.0).sum(2)  # [K, W]

    def of(self, residuals: np.ndarray) -> np.ndarray:
        """Return the log density [H, K, W] of residuals [H, m] by noise and window."""
        y = np.where(self.on, residuals[:, self.rows], 0.0)  # [H, W, n]
        out = np.repeat(self.constant[None], len(y), 0)
        drift = np.zeros(out.shape)
        for i in range(y.shape[2]):
            drift *= self.keep[:, :, i]
            missed = np.where(self.on[:, i], y[:, None, :, i] - drift, 0.0)
            out -= 0.5 * missed**2 / self.spread[:, :, i]
            drift += self.gain[:, :, i] * missed
        return out


def held_out(log: np.ndarray, fold: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the log density [F] of each fold's windows under the noise [F] (its number) that the other windows ask
    for.

    log [F, K, W]: of the residuals of the fit without each fold; fold [W]: of each window, numbers from 0 on."""
    score, chosen = np.zeros(len(log)), np.zeros(len(log), int)
    for f, by in enumerate(log):
        out = fold == f
        chosen[f] = int(np.argmax(by[:, ~out].sum(1))) if (~out).any() else int(np.argmax(by.sum(1)))
        score[f] = by[chosen[f]][out].sum()
    return score, chosen
