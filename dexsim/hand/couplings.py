"""Joints that no motor drives by itself: they follow others through equality constraints and fixed tendons.

MuJoCo's constraints move them in a simulation. Here they are placed: where a state is set and where kinematics alone is
asked for, so that no step begins with a constraint violated.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from dexsim.errors import UserError

if TYPE_CHECKING:
    import torch

STEP = 1e-5  # rad or m, of differences
CLOSE = 1e-9  # of a length: met
SWEEPS = 30
"""Of projections onto the tendons' lengths; a finger's tendons share few joints."""


class Couplings:
    """How the joints of `model` that are not `driven` follow those that are.

    passive: their names; loose: of these, the ones that nothing holds; address, dof: of the driven ones in qpos and
    qvel. A joint equality gives q = q0 + sum_k c_k (q' - q'0)^k of another joint; tendons of fixed
    coefficients, tied or limited, leave more freedom: of the joints' positions that they allow, the one nearest to the
    joints' springs' rest is taken, by projections in turn (Kaczmarz), within the joints' limits.

    Raises UserError for joints that follow each other in a ring.
    """

    def __init__(self, model: mujoco.MjModel, driven: Iterable[str], where: str = "model"):
        m, order = model, list(driven)
        names = set(order)
        self.model = m
        self.address = [int(m.jnt_qposadr[m.joint(name).id]) for name in order]
        self.dof = [int(m.jnt_dofadr[m.joint(name).id]) for name in order]
        tied = {int(m.eq_obj1id[e]): e for e in range(m.neq) if m.eq_type[e] == mujoco.mjtEq.mjEQ_JOINT}
        free = {j for j in range(m.njnt) if _one_dof(m, j) and m.joint(j).name not in names}
        self.passive = tuple(m.joint(j).name for j in sorted(free))
        self._laws: list[tuple[int, int, np.ndarray]] = []  # qpos of the follower, of the other or -1, coefficients
        waiting = [j for j in tied if j in free]
        while waiting:
            ready = [j for j in waiting if int(m.eq_obj2id[tied[j]]) not in waiting]
            if not ready:
                raise UserError(f"{where}: joints {', '.join(m.joint(j).name for j in waiting)} follow each other")
            for j in ready:
                e, waiting = tied[j], [x for x in waiting if x != j]
                other = int(m.eq_obj2id[e])
                law = m.eq_data[e, :5] if other >= 0 else np.append(m.eq_data[e, :1], np.zeros(4))
                self._laws.append((int(m.jnt_qposadr[j]), int(m.jnt_qposadr[other]) if other >= 0 else -1, law.copy()))
                free.discard(j)
        self._rows: list[tuple[np.ndarray, float, float]] = []  # coefficients [nq], least and largest length
        held: set[int] = set()
        for t in range(m.ntendon):
            if (found := _fixed(m, t)) is None:
                continue
            found, low, high = _tied(m, t, found)
            for at, other, law in self._laws[::-1]:  # a tendon pulls what follows by pulling its leader
                if found[at] and other >= 0 and _joint(m, other) in free:
                    still = found[at] * (m.qpos0[at] + law[0] - law[1] * m.qpos0[other])
                    found[other] += law[1] * found[at]
                    found[at], low, high = 0.0, low - still, high - still
            if np.isfinite([low, high]).any():
                self._rows.append((found, low, high))
                held |= {int(a) for a in np.flatnonzero(found)}
        self._free = sorted({int(m.jnt_qposadr[j]) for j in free} & held)
        self._groups: list[list[int]] = []
        for k, (row, *_) in enumerate(self._rows):
            mine = {a for a in np.flatnonzero(row) if a in self._free}
            if not mine:
                continue
            separate = (g for g in self._groups if all(not mine & set(np.flatnonzero(self._rows[o][0])) for o in g))
            group = next(separate, None)
            self._groups.append([k]) if group is None else group.append(k)
        one = [np.count_nonzero(row[self._free]) <= 1 for row, *_ in self._rows]
        alone = all(one)  # of intervals of one joint that meet, the last that is entered lies in all
        self._sweeps = 0 if not self._groups else 1 if alone else SWEEPS
        self._on: dict[tuple[torch.device, torch.dtype], tuple[Any, ...]] = {}
        self.loose = tuple(m.joint(j).name for j in sorted(free) if int(m.jnt_qposadr[j]) not in held)

    @property
    def tied(self) -> bool:
        """Return whether some joint follows others."""
        return bool(self._laws) or bool(self._free and self._rows)

    def placed(self, qpos: np.ndarray) -> np.ndarray:
        """Return `complete` of an array [..., nq]."""
        import torch  # here, for it takes a second to import, and most hands have nothing that follows

        return self.complete(torch.as_tensor(qpos.copy())).numpy()

    def complete(self, qpos: torch.Tensor) -> torch.Tensor:
        """Return qpos [..., nq] with the joints that follow where the others hold them. A new tensor."""
        import torch

        q = qpos.clone()
        self._follow(q)
        if self._free:
            free, rest, low, high, rows = self._tensors(q)
            q[..., free] = rest.clamp(low, high)
            for _ in range(self._sweeps):
                most = 0.0
                for a, b, least, largest in rows:  # rows together share no free joint
                    length = q @ a
                    miss = torch.minimum(torch.maximum(length, least), largest) - length
                    q[..., free] = (q[..., free] + miss @ b).clamp(low, high)
                    most = max(most, float(miss.abs().max())) if q.device.type == "cpu" else 1.0
                if most < CLOSE:  # nobody waits for a GPU to say so
                    break
            if any(other in self._free for _, other, _ in self._laws):
                self._follow(q)
        return q

    def _follow(self, q: torch.Tensor) -> None:
        """Place in q [..., nq] what follows another joint by an equality."""
        import torch

        m = self.model
        for at, other, law in self._laws:
            x = q[..., other] - m.qpos0[other] if other >= 0 else torch.zeros_like(q[..., at])
            total = torch.full_like(x, float(law[4]))
            for c in law[3::-1]:
                total = total * x + float(c)
            q[..., at] = m.qpos0[at] + total

    def _tensors(self, q: torch.Tensor) -> tuple[Any, ...]:
        """Return addresses, rest and limits [F] of the joints that tendons hold, and groups of rows, one a tendon, that
        share none of these: coefficients [nq, R], how the joints [R, F] share what the lengths miss, and least and
        largest lengths [R]. Made once: a recorded step must find them on its device."""
        import torch

        key = (q.device, q.dtype)
        if key not in self._on:
            m, at = self.model, self._free
            joints = [_joint(m, a) for a in at]
            limits = np.where(m.jnt_limited[joints, None], m.jnt_range[joints], [-np.inf, np.inf])
            rest = np.where(m.jnt_stiffness[joints] > 0, m.qpos_spring[at], m.qpos0[at])

            def to(x: np.ndarray) -> torch.Tensor:
                return torch.as_tensor(x, dtype=q.dtype, device=q.device)

            rows = []
            for group in self._groups:
                a = np.stack([self._rows[k][0] for k in group])
                b = a[:, at] / (a[:, at] ** 2).sum(1, keepdims=True)
                ends = np.array([self._rows[k][1:] for k in group])
                rows.append((to(a.T), to(b), to(ends[:, 0]), to(ends[:, 1])))
            free = torch.as_tensor(at, device=q.device)
            self._on[key] = free, to(rest), to(limits[:, 0]), to(limits[:, 1]), rows
        return self._on[key]

    def put(self, data: mujoco.MjData, values: np.ndarray) -> None:
        """Set the driven joints' positions [J] in qpos, and those of what follows them."""
        data.qpos[self.address] = values
        if self.passive:
            data.qpos[:] = self.placed(data.qpos)

    def along(self, columns: np.ndarray, qpos: np.ndarray) -> np.ndarray:
        """Return columns [..., nv] of a Jacobian by dof as those [..., J] of the driven joints, at a state [nq]: what
        follows moves along."""
        if not self.passive:
            return columns[..., self.dof]
        return columns @ self.motion(qpos)

    def motion(self, qpos: np.ndarray) -> np.ndarray:
        """Return how fast every dof moves with each driven joint [nv, J], at a state [nq]."""
        m = self.model
        out = np.zeros((m.nv, len(self.address)))
        ends = np.repeat(np.asarray(qpos, float)[None], 2 * len(self.address), 0)
        for k, a in enumerate(self.address):
            ends[2 * k, a] -= STEP
            ends[2 * k + 1, a] += STEP
        both = self.placed(ends)
        slope = (both[1::2] - both[::2]).T / (2 * STEP)
        for j in range(m.njnt):
            if _one_dof(m, j):
                out[m.jnt_dofadr[j]] = slope[m.jnt_qposadr[j]]
        return out

    def dragged(self, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return positions [n, nq] along a motion of the driven joints, and how every dof moves with each of them
        [n, nv, J]. A joint that a tendon holds with slack stays where it is until the tendon drags it (a play
        operator); of joints that tendons share, `complete` tells, and the middle of the motion how they move."""
        m, q = self.model, self.placed(qpos)
        moves = np.repeat(self.motion(q[len(q) // 2])[None], len(q), 0)
        if not self._rows or self._sweeps != 1:
            return q, moves
        for at in self._free:
            joint = _joint(m, at)
            dof, mine = int(m.jnt_dofadr[joint]), [row for row in self._rows if row[0][at]]
            ends = [np.sort((np.array(row[1:]) - (q @ row[0] - row[0][at] * q[:, at])[:, None]) / row[0][at], 1)
                    for row in mine]  # fmt: skip
            low, high = (pick.reduce([x[:, k] for x in ends]) for k, pick in ((0, np.maximum), (1, np.minimum)))
            if m.jnt_limited[joint]:
                low, high = (np.clip(x, *m.jnt_range[joint]) for x in (low, high))
            for k in range(1, len(q)):
                q[k, at] = min(max(q[k - 1, at], low[k]), high[k])
            moving = np.diff(q[:, at], prepend=q[0, at]) != 0
            moves[:, dof] = 0.0
            for (row, *_), x in zip(mine, ends, strict=True):
                pulled = moving & (np.isclose(q[:, at], x[:, 0]) | np.isclose(q[:, at], x[:, 1]))
                moves[pulled, dof] = -row[self.address] / row[at]
        return q, moves


def _one_dof(m: mujoco.MjModel, j: int) -> bool:
    return int(m.jnt_type[j]) in (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))


def _joint(m: mujoco.MjModel, address: int) -> int:
    """Return the joint whose position stands at an address of qpos."""
    return int(np.flatnonzero(m.jnt_qposadr == address)[0])


def _fixed(m: mujoco.MjModel, t: int) -> np.ndarray | None:
    """Return coefficients [nq] of a fixed tendon; None: a spatial one."""
    out = np.zeros(m.nq)
    for w in range(m.tendon_adr[t], m.tendon_adr[t] + m.tendon_num[t]):
        if m.wrap_type[w] != mujoco.mjtWrap.mjWRAP_JOINT:
            return None
        out[m.jnt_qposadr[m.wrap_objid[w]]] += m.wrap_prm[w]
    return out


def _tied(m: mujoco.MjModel, t: int, arms: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Return what is bounded of a tendon whose coefficients are `arms` [nq]: its length, or what it has more than a
    share of another's; coefficients [nq], least and largest value."""
    for e in range(m.neq):
        if m.eq_type[e] == mujoco.mjtEq.mjEQ_TENDON and m.eq_obj1id[e] == t:
            length, other = float(m.tendon_length0[t] + m.eq_data[e, 0]), int(m.eq_obj2id[e])
            if other >= 0 and (others := _fixed(m, other)) is not None:
                share = float(m.eq_data[e, 1])
                arms, length = arms - share * others, length - share * float(m.tendon_length0[other])
            return arms, length, length
    if m.tendon_limited[t]:
        return arms, float(m.tendon_range[t, 0]), float(m.tendon_range[t, 1])
    return arms, -np.inf, np.inf
