"""Filtered derivatives of a recorded motion, and what torque the model's rigid body asks of every joint along it.

Position and torque pass the same low-pass forth and back (Butterworth, 4th order), so that both are late by nothing;
the body's torque is MuJoCo's inverse dynamics M(q) a + c(q, v) + g(q) less its passive forces, with the model's own dry
friction in the joints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.signal import butter, filtfilt

CUTOFF = 0.2  # of half the sampling rate, and no more than
TOP = 60.0  # Hz
LEAST = 5.0  # Hz: of the cutoff
EDGE, SWING = 50, 2.0  # samples, and periods of the cutoff, at each end in which the filter still swings in
RATE = 250.0  # Hz at which the model is evaluated; inertia and bias change slowly, accelerations keep their own rate


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
    every = max(int(round(1.0 / (RATE * m.step))), 1)
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
