"""Whether a motion is safe on a real mechanism: limits of position, speed and torque, and no self-contact; in
simulation."""

from __future__ import annotations

from dataclasses import dataclass, field

import mujoco
import numpy as np

from dexsim.hand.couplings import Couplings
from dexsim.recording.mechanism import Mechanism, Run


@dataclass
class Peaks:
    """What a motion reached. speed, torque [J]: largest, over the limit (a fraction); below: largest excess over the
    position limits [rad]; contacts: pairs of bodies that came nearer than the clearance, with the time of the first."""

    speed: np.ndarray
    torque: np.ndarray
    excess: float
    contacts: dict[tuple[str, str], float] = field(default_factory=dict)


class ContactCheck:
    """Finds bodies of a mechanism that touch, its own collision filter set aside: every pair of two bodies counts but
    neighbours (parent and child) and pairs that are nearer than the clearance at `home` already (`exempt`)."""

    def __init__(self, m: Mechanism, home: np.ndarray, clearance: float):
        spec = m.spec.copy()
        for geom in spec.geoms:
            if geom.contype or geom.conaffinity:
                geom.contype, geom.conaffinity, geom.margin = 1, 1, clearance
        for exclude in list(spec.excludes):
            spec.delete(exclude)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.clearance = clearance
        self.address = np.array([self.model.jnt_qposadr[self.model.joint(j).id] for j in m.joints])
        self._names = [self.model.body(b).name or f"body {b}" for b in range(self.model.nbody)]
        self._couplings = Couplings(self.model, m.joints) if m.hand is not None else None
        self._separate = np.zeros((self.model.nbody, self.model.nbody), bool)  # pairs that are not looked at
        self.exempt: set[tuple[str, str]] = set(self.near(home))
        for pair in self.exempt:
            a, b = (self._names.index(name) for name in pair)
            self._separate[a, b] = self._separate[b, a] = True

    def near(self, q: np.ndarray) -> list[tuple[str, str]]:
        """Return pairs of bodies nearer than the clearance at joint positions q [J] (the other joints at rest, or, in a
        hand, where these hold them)."""
        self.data.qpos[:] = self.model.qpos0
        if self._couplings is not None:
            self._couplings.put(self.data, q)
        else:
            self.data.qpos[self.address] = q
        return self.near_qpos(self.data.qpos.copy())

    def near_qpos(self, qpos: np.ndarray) -> list[tuple[str, str]]:
        """Return the same for a whole qpos [nq]."""
        m, d = self.model, self.data
        d.qpos[:] = qpos
        mujoco.mj_kinematics(m, d)
        mujoco.mj_collision(m, d)
        bodies = m.geom_bodyid[d.contact.geom]
        close = (d.contact.dist < self.clearance) & ~self._separate[bodies[:, 0], bodies[:, 1]]
        if not close.any():
            return []
        pairs = {(min(a, b), max(a, b)) for a, b in ((self._names[i], self._names[k]) for i, k in bodies[close])}
        return sorted(pairs)

    def along(self, run: Run) -> dict[tuple[str, str], float]:
        """Return pairs that came near, with the time of the first."""
        out: dict[tuple[str, str], float] = {}
        for k, qpos in enumerate(run.qpos):
            for pair in self.near_qpos(qpos):
                out.setdefault(pair, k * run.frame_s)
        return out


def peaks(m: Mechanism, run: Run, check: ContactCheck) -> Peaks:
    """Return what a simulated run reached, over what is allowed."""
    torque_limit, limits = m.column("torque_limit"), m.limits
    torque = np.abs(run.torque).max(0)
    excess = np.maximum(run.position - limits[:, 1], limits[:, 0] - run.position).max()
    return Peaks(np.abs(run.velocity).max(0) / m.speeds, torque / torque_limit, float(excess), check.along(run))
