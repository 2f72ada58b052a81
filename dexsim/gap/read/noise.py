"""Noise of signals, from what each sample misses a smooth curve through its neighbours by."""

from __future__ import annotations

import numpy as np

from dexsim.gap.read import Run

BESIDE = 3  # neighbours on each side by which a sample's noise is told
# whether a reading is rounded, a test of a signal: of its samples like the one before; others do not repeat
REPEATS = 0.5


def noise(t: np.ndarray, x: np.ndarray, miss: np.ndarray | None = None) -> tuple[float, float]:
    """Return (standard deviation of the measurement noise, quantum) of one signal, from each sample's misfit to a local
    parabola through its neighbours without it (miss: `misfit`, where it is known). The quantum is 0 where the values
    are not on a grid."""
    steps = np.unique(np.round(np.abs(np.diff(x)), 9))
    steps = steps[steps > 1e-7]
    quantum = 0.0
    if len(steps):
        smallest = steps[0]
        if (
            len(steps) < 0.2 * len(x) + 20
            and np.mean(np.abs(steps[:20] / smallest - np.round(steps[:20] / smallest)) < 0.05) > 0.9
        ):
            quantum = float(smallest)
    changes = np.abs(np.diff(x))
    # steps of an encoder that are not all alike
    if not quantum and np.mean(changes == 0.0) > REPEATS and (changes > 1e-7).any():
        quantum = float(np.quantile(changes[changes > 1e-7], 0.1))
    if len(x) < 2 * BESIDE + 3:
        return max(quantum / np.sqrt(12), 1e-9), quantum
    miss = misfit(t, x[:, None])[:, 0] if miss is None else miss
    # a robust mean: what the parabola cannot follow is not noise
    cut = 4 * np.median(np.abs(miss)) + 1e-12
    rms = float(np.sqrt(np.mean(np.minimum(miss**2, cut**2))))
    return max(rms, quantum / np.sqrt(12), 1e-9), quantum


def noise_of(run: Run, j: int) -> tuple[float, float]:
    """Return `noise` of joint j's position in a run. Every joint's case asks for that of all others, each time anew
    that cases are built: it is kept with the run, for as long as the run has these positions."""
    return noises(run)[1][j]


def noises(run: Run) -> tuple[np.ndarray, list[tuple[float, float]], list[np.ndarray]]:
    """Return (positions [S, J]; by joint the `noise` of its readings, and what these miss local cubics by
    (`misfit`))."""
    if run.noises is None or run.noises[0] is not run.q:
        each = [run.readings(j) for j in range(run.q.shape[1])]
        if run.read is None:
            miss = list(misfit(run.t, run.q).T)
        else:
            miss = [misfit(t, q[:, None])[:, 0] for t, q in each]
        run.noises = run.q, [noise(t, q, m) for (t, q), m in zip(each, miss, strict=True)], miss
    return run.noises


def misfit(t: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return [S - 2 BESIDE, J] by what each sample of signals x [S, J] at t [S] s misses a local cubic through its
    neighbours without it, of the noise's own size; nothing where there are too few."""
    k = BESIDE
    if len(x) < 2 * k + 3:
        return np.empty((0, x.shape[1]))
    index = np.arange(k, len(x) - k)[:, None] + np.r_[-k:0, 1 : k + 1]
    dt = t[index] - t[k:-k, None]
    scale = max(float(np.median(np.diff(t))) * k, 1e-9)
    basis = np.stack([np.ones_like(dt), dt / scale, (dt / scale) ** 2, (dt / scale) ** 3], -1)
    normal = np.einsum("smd,sme->sde", basis, basis) + 1e-9 * np.eye(4)
    size = np.sqrt(1 + np.linalg.inv(normal)[:, 0, 0])
    out = np.empty((len(index), x.shape[1]))
    for j, signal in enumerate(x.T):
        c = np.linalg.solve(normal, np.einsum("smd,sm->sd", basis, signal[index])[..., None])
        out[:, j] = (signal[k:-k] - c[:, 0, 0]) / size
    return out
