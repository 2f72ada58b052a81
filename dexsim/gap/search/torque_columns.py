"""One joint's recorded torque as columns of a linear least squares: what the model's body leaves, and what friction,
inertia, offset and gravity's factors would make of it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from dexsim.gap.read.runs import Run
from dexsim.gap.search import body_torque
from dexsim.gap.search.body_torque import EDGE, Body, Motion

RATE = 100.0  # Hz: readings slower than this are too few for a second derivative
PER_CUTOFF = 10.0  # samples kept a period of the filter's cutoff
HEAVY = 0.02  # of a joint's torque: gravity that matters
BLOCK = 0.5  # s
NAMES = ("inertia", "viscous_friction", "coulomb_friction", "offset")
WEIGHT = ("gravity", "gravity_across")  # factors on gravity's torque, beyond the model's, that are fitted beside them


@dataclass
class Piece:
    """One recording at its full rate: q, v, load (the body's torque) [n] and which samples are kept."""

    motion: Motion
    q: np.ndarray
    v: np.ndarray
    load: np.ndarray
    keep: np.ndarray


@dataclass
class Columns:
    """One joint's pieces in a row, thinned to what the filter leaves: columns X [m, K] by `names`, torque beyond the
    body u [m], speeds v [m], what a lag of one second would add per unit of inertia `rise` [m], the torque itself [m],
    blocks [m]; inertia of the model (median), extent of the motion, whether gravity pulls, seconds in all."""

    pieces: list[Piece]
    names: tuple[str, ...]
    X: np.ndarray
    u: np.ndarray
    v: np.ndarray
    rise: np.ndarray
    torque: np.ndarray
    blocks: np.ndarray
    inertia: float
    span: float
    loaded: bool
    seconds: float

    def column(self, f: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]) -> np.ndarray:
        """[m] f(q, v, load) through the filter."""
        return np.concatenate([p.motion.smooth(f(p.q, p.v, p.load))[p.keep] for p in self.pieces])

    def without(self, names: Collection[str]) -> Columns:
        """The same with figures that are held at 0."""
        on = [n not in names for n in self.names]
        return replace(self, X=self.X[:, on], names=tuple(n for n in self.names if n not in names))

    def pack(self, x: np.ndarray) -> dict[str, float]:
        """Coefficients by name, the inertia with the model's."""
        out = {n: float(y) for n, y in zip(self.names, x, strict=False)}
        return out | ({"inertia": out["inertia"] + self.inertia} if "inertia" in out else {"inertia": self.inertia})


def columns_of(given: Sequence[tuple], j: int, efficiency: float = 1.0) -> Columns:
    """Of joint j; given: (Motion, Body or None[, span s]) of each recording; efficiency: of the drive, believed."""
    pieces, parts, at = [], [], 0
    inertia = (
        float(np.median(np.concatenate([b.inertia[:, j] for _, b, *_ in given]))) if given[0][1] is not None else 0.0
    )
    weights = [
        np.abs(b.gravity[:, j]).max() / max(float(np.abs(m.u[:, j]).max()), 1e-12)
        for m, b, *_ in given
        if b is not None
    ]
    loaded = bool(weights) and max(weights) > HEAVY
    for m, b, *rest in given:
        q, v, torque = m.q[:, j], m.v[:, j], efficiency * m.u[:, j]
        load = np.zeros_like(q) if b is None else b.torque[:, j]
        keep = np.zeros(len(q), bool)
        keep[m.edge : len(q) - m.edge : max(int(1.0 / (PER_CUTOFF * m.cutoff * m.step)), 1)] = True
        if rest and rest[0] is not None:
            keep &= (m.t - m.t[0] >= rest[0][0]) & (m.t - m.t[0] <= rest[0][1])
        columns = [m.a[:, j], v, m.smooth(np.sign(v)), np.ones(len(v))]
        columns += [b.gravity[:, j], b.across[:, j]] if loaded else []
        rise = np.gradient(m.a[:, j] if b is None else load / inertia, m.step)
        block = at + ((m.t - m.t[0]) / BLOCK).astype(int)
        at = int(block.max()) + 1
        parts.append(tuple(x[keep] for x in (np.stack(columns, 1), torque - load, v, rise, torque, block)))
        pieces.append(Piece(m, q, v, load, keep))
    X, u, v, rise, torque, block = (np.concatenate(x) for x in zip(*parts, strict=True))
    q = np.concatenate([p.q[p.keep] for p in pieces])
    seconds = sum(
        float(p.keep.sum()) * max(int(1.0 / (PER_CUTOFF * p.motion.cutoff * p.motion.step)), 1) * p.motion.step
        for p in pieces
    )
    _, block = np.unique(block, return_inverse=True)
    names = NAMES + (WEIGHT if loaded else ())
    return Columns(
        pieces, names, X, u, v, rise, torque, block, inertia, float(np.ptp(q)) if len(q) else 0.0, loaded, seconds
    )

def readable(run: Run, j: int) -> bool:
    """Whether a run's torque of joint j can be differentiated beside its motion."""
    if (
        run.torque is None
        or run.torque_unit != "N.m"
        or not np.isfinite(run.torque[:, j]).all()
        or len(run.t) < 2 * EDGE + 100
    ):
        return False
    return 1 / np.median(np.diff(run.t)) >= 0.97 * RATE


def moved(run: Run, model: mujoco.MjModel | None, cutoff: float) -> tuple[Motion, Body | None]:
    m = body_torque.motion(run.t, run.q, np.nan_to_num(run.torque), cutoff)
    return m, None if model is None else body_torque.body(model, run.gravity, run.joints, m)


def sums(X: np.ndarray, u: np.ndarray, of: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations [count, K, K], [count, K] of the rows of each part `of` [m]."""
    rows = [np.flatnonzero(of == b) for b in range(count)]
    return np.stack([X[i].T @ X[i] for i in rows]), np.stack([X[i].T @ u[i] for i in rows])


def solved(grams: np.ndarray, sides: np.ndarray) -> np.ndarray:
    """Coefficients [.., K] of normal equations [.., K, K], [.., K], columns scaled alike; 0 for a column that is not
    there."""
    scale = np.sqrt(np.maximum(np.einsum("...kk->...k", grams), 1e-300))
    scaled = grams / (scale[..., :, None] * scale[..., None, :]) + 1e-13 * np.eye(grams.shape[-1])
    return np.linalg.solve(scaled, (sides / scale)[..., None])[..., 0] / scale


def least(X: np.ndarray, u: np.ndarray) -> np.ndarray:
    return solved(X.T @ X, X.T @ u)


def misfit(d: Columns) -> float:
    return float(np.std(d.u - d.X @ least(d.X, d.u)))


def unphysical(d: Columns) -> dict[str, str]:
    """Figures that least squares make negative where nothing can be, one after another, each with the reason."""
    out: dict[str, str] = {}
    while True:
        left = d.without(out)
        x = left.pack(least(left.X, left.u))
        negative = [n for n in ("inertia", "coulomb_friction", "viscous_friction") if n not in out and x[n] < 0]
        if not negative:
            return out
        out[negative[0]] = (
            f"the least squares give {x[negative[0]]:.3g}, and nothing has a negative {negative[0].replace('_', ' ')}"
        )
