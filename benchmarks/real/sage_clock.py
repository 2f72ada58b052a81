"""Which of SAGE's motions log their commands a period late.

A servo's current follows its position error and its speed (the law of its firmware and motor, whatever the load):
|current| = |a error - b speed + c| + d, one a, b, c, d a joint. The error that explains the current best is the one
with the command that was in force: the logged one, or that of a period later, where the log writes each command down
after the servo has had it. What most motions have counts as right (a delay that all share is for the fit). The current
has lost its sign and is used for nothing else; no model of the motion takes part.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from dexsim.errors import UserError

JAW = 2.34  # rad per unit of the jaw's 0..1
SLOW, STEP, FAR = 0.1, 3.0, 0.15  # rad/s: a period must matter; rad/s, rad: steps saturate the drive
LEAST = 40  # samples of a joint in a motion
ALIKE = 5.0  # neighbouring samples that count as one
SURE = 25.0  # difference of log-likelihoods (each squared misfit capped at 9) that is asked for
ROUNDS = 4


def _mean(x: np.ndarray, n: int) -> np.ndarray:
    return np.convolve(np.pad(x, n // 2, mode="edge"), np.ones(n) / n, "valid")


class _Joint:
    """One joint of one motion where its target moves: error [2, n] with the command as logged and a period later (rad),
    speed [n] (rad/s), |current| [n]."""

    def __init__(self, t: np.ndarray, q: np.ndarray, c: np.ndarray, current: np.ndarray):
        speed, rate = np.gradient(_mean(q, 5), t), np.abs(np.gradient(c, t))
        later = lambda k: c[np.clip(np.arange(len(c)) + k, 0, len(c) - 1)]  # noqa: E731
        # a period's command is in force for half of what the sample shows, the one before it for the other half
        errors = np.stack([0.5 * (later(k) + later(k - 1)) - q for k in (0, 1)])
        on = (rate > SLOW) & (rate < STEP) & (np.abs(errors[0]) < FAR)
        self.error, self.speed, self.current = errors[:, on], speed[on], current[on]


def late(data: Path) -> dict[str, float]:
    """Return by motion the difference of log-likelihoods in favour of commands logged a period late; above `SURE` they
    are."""
    files = sorted(data.glob("*.npz"))
    if not files:
        raise UserError(f"{data}: no motions (*.npz); see benchmarks/real/convert_sage.py for where from")
    motions = {}
    for path in files:
        raw = np.load(path)
        scale = np.r_[np.ones(5), JAW]
        q, c = raw["pos"] * scale, raw["cmd"] * scale
        motions[path.stem] = [_Joint(raw["t"], q[:, j], c[:, j], raw["tau_abs"][:, j]) for j in range(q.shape[1])]
    choice, out = dict.fromkeys(motions, 0), {}
    for _ in range(ROUNDS):
        out = dict.fromkeys(motions, 0.0)
        for j in range(6):
            error, speed, current = (
                np.concatenate(x)
                for x in zip(
                    *((m[j].error[choice[n]], m[j].speed, m[j].current) for n, m in motions.items()), strict=True
                )
            )
            misfit = lambda p, e, v, i: np.abs(p[0] * e - p[1] * v + p[2]) + p[3] - i  # noqa: E731
            fit = least_squares(
                misfit, [2.0, 0.1, 0.0, 0.0], loss="soft_l1", f_scale=0.02, args=(error, speed, current)
            )
            sigma = 1.48 * float(np.median(np.abs(fit.fun)))
            for name, joints in motions.items():
                x = joints[j]
                if len(x.speed) >= LEAST:
                    a, b = (np.minimum((misfit(fit.x, e, x.speed, x.current) / sigma) ** 2, 9.0).sum() for e in x.error)
                    out[name] += float(a - b) / ALIKE / 2
        choice = {n: int(v > 0) for n, v in out.items()}
    return out
