"""The recorded torque of a joint beside what the model's rigid body asks for along the recorded motion, and what is
left as columns of a linear least squares: what friction, inertia, offset and gravity's factors would make of it.

Position and torque pass the same low-pass forth and back (Butterworth, 4th order), so that both are late by nothing;
the body's torque is MuJoCo's inverse dynamics M(q) a + c(q, v) + g(q) less its passive forces, with the model's own dry
friction in the joints.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from scipy.signal import butter, filtfilt

from dexsim.gap.read.runs import BLOCK, Run

CUTOFF = 0.2  # of half the sampling rate, and no more than
TOP = 60.0  # Hz: of the cutoff, too
LEAST = 5.0  # Hz: of the cutoff
EDGE, SWING = 50, 2.0  # samples, and periods of the cutoff, at each end in which the filter still swings in
# Hz at which the model is evaluated; inertia and bias change slowly, accelerations keep their own rate
MODEL_RATE = 250.0
RATE = 100.0  # Hz: readings slower than this are too few for a second derivative
PER_CUTOFF = 10.0  # samples kept a period of the filter's cutoff
HEAVY = 0.02  # of a joint's torque: gravity that matters
NAMES = ("inertia", "viscous_friction", "coulomb_friction", "offset")
WEIGHT = ("gravity", "gravity_across")  # factors on gravity's torque, beyond the model's, that are fitted beside them


@dataclass
class Motion:
    """Even times t [n] s; filtered positions q, speeds v, accelerations a and torques u [n, J]; step [s]; cutoff
    [Hz]."""

    t: np.ndarray
    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    u: np.ndarray
    step: float
    cutoff: float

    @property
    def edge(self) -> int:
        """Samples at each end that are not to be used."""
        return max(EDGE, int(SWING / (self.cutoff * self.step)))

    def smooth(self, x: np.ndarray) -> np.ndarray:
        """x [n] through the filter that the torque passed: what jumps with the sign of a speed must pass it as well."""
        return _pass(x, self.cutoff, self.step)


@dataclass
class Body:
    """By sample and joint [n, J]: torque that the model's body asks for (positive along positive motion), of it
    gravity's, gravity's a quarter turn on (what a shifted centre of mass adds), and the inertia about the joint. N.m,
    N.m, N.m, kg.m2 (N, N, N, kg for a slide)."""

    torque: np.ndarray
    gravity: np.ndarray
    across: np.ndarray
    inertia: np.ndarray


def highest(t: np.ndarray) -> float:
    """The highest cutoff [Hz] that readings at times t [n] s allow."""
    return min(CUTOFF * 0.5 / float(np.median(np.diff(t))), TOP)


def motion(t: np.ndarray, q: np.ndarray, torque: np.ndarray, cutoff: float) -> Motion:
    """From times [S], positions and torques [S, J] as recorded."""
    step = float(np.median(np.diff(t)))
    even = np.arange(t[0], t[-1], step)
    through = lambda x: np.stack([_pass(np.interp(even, t, c), cutoff, step) for c in x.T], 1)  # noqa: E731
    q, u = through(q), through(torque)
    v = np.gradient(q, step, axis=0)
    return Motion(even, q, v, np.gradient(v, step, axis=0), u, step, cutoff)


def _pass(x: np.ndarray, cutoff: float, step: float) -> np.ndarray:
    b, a = butter(4, cutoff * 2 * step)
    return filtfilt(b, a, x)


def body(model: mujoco.MjModel, gravity: np.ndarray, joints: Sequence[str], m: Motion) -> Body:
    """Of `joints` (the motion's columns) in world gravity [3] m/s2; the model's other joints rest where the model has
    them."""
    data = mujoco.MjData(model)
    ids = [model.joint(name).id for name in joints]
    at, dof = np.array([model.jnt_qposadr[i] for i in ids]), np.array([model.jnt_dofadr[i] for i in ids])
    bodies = np.array([model.jnt_bodyid[i] for i in ids])
    slide = np.array([int(model.jnt_type[i]) == int(mujoco.mjtJoint.mjJNT_SLIDE) for i in ids])
    every = max(int(round(1.0 / (MODEL_RATE * m.step))), 1)
    rows = np.unique(np.r_[np.arange(0, len(m.t), every), len(m.t) - 1])
    rest, diag = np.empty((2, len(rows), len(ids)))
    axis, arm = np.empty((2, len(rows), len(ids), 3))
    kept = np.array(model.opt.gravity), model.opt.disableflags
    model.opt.gravity[:] = gravity
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT) | int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    full = np.zeros((model.nv, model.nv))
    try:
        for k, i in enumerate(rows):
            data.qpos[at], data.qvel[dof], data.qacc[dof] = m.q[i], m.v[i], m.a[i]
            mujoco.mj_inverse(model, data)
            mujoco.mj_fullM(model, data, full)
            diag[k] = full[dof, dof]
            rest[k] = data.qfrc_inverse[dof] - diag[k] * m.a[i]
            axis[k], arm[k] = data.xaxis[ids], data.subtree_com[bodies] - data.xanchor[ids]
    finally:
        model.opt.gravity[:], model.opt.disableflags = kept
    mass, turned = model.body_subtreemass[bodies], np.cross(axis, arm)
    pull = -mass * np.where(slide, axis @ gravity, turned @ gravity)
    across = np.where(slide, 0.0, -mass * (np.cross(axis, turned) @ gravity))
    back = lambda x: np.stack([np.interp(m.t, m.t[rows], c) for c in x.T], 1)  # noqa: E731
    inertia, dry = back(diag), np.array([float(model.dof_frictionloss[d]) for d in dof])
    torque = inertia * m.a + back(rest)
    for j in np.flatnonzero(dry > 0):
        torque[:, j] += dry[j] * m.smooth(np.sign(m.v[:, j]))
    return Body(torque, back(pull), back(across), inertia)


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


def columns_of(given: Sequence[tuple], j: int, efficiency: float = 1.0, loaded: bool | None = None) -> Columns:
    """Of joint j; given: (Motion, Body or None[, span s]) of each recording; efficiency: of the drive, believed;
    loaded: whether gravity's factors are among the columns, by default where it matters in these recordings."""
    pieces, parts, at = [], [], 0
    inertia = (
        float(np.median(np.concatenate([b.inertia[:, j] for _, b, *_ in given]))) if given[0][1] is not None else 0.0
    )
    weights = [
        np.abs(b.gravity[:, j]).max() / max(float(np.abs(m.u[:, j]).max()), 1e-12)
        for m, b, *_ in given
        if b is not None
    ]
    if loaded is None:
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
    m = motion(run.t, run.q, np.nan_to_num(run.torque), cutoff)
    return m, None if model is None else body(model, run.gravity, run.joints, m)


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
