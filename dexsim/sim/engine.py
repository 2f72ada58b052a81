"""The interface of a physics engine, and what both engines share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import SimpleNamespace

import mujoco
import numpy as np
import torch
import warp as wp

from dexsim.errors import UserError

FLAG_NAN = 1 << 30
"""Bit of `Engine.t.flags`: a state of this world is not finite (or its speed is absurd)."""
NEAR_BIT = 1 << 2  # of MuJoCo-Warp: more pairs of geoms come near each other than sim.nconmax has room for
OVERFLOW_BITS = (1 << 0) | (1 << 1) | (1 << 2) | (1 << 3) | (1 << 4) | (1 << 8)
"""Bits of `Engine.t.flags` that mean lost contacts or constraint rows (MuJoCo-Warp's OverflowType)."""


@dataclass(frozen=True)
class ContactPair:
    """A named pair of geom groups whose contact force is measured.

    first, second: (kind, name) with kind "geom", "body" or "subtree" (a body and all its descendants).
    """

    name: str
    first: tuple[str, str]
    second: tuple[str, str]


def geoms_of(model: mujoco.MjModel, kind: str, name: str) -> np.ndarray:
    """Return the ids of the geoms that (kind, name) selects; raises UserError when the name is unknown."""
    if kind == "geom":
        gid = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, name)
        if gid >= 0:
            return np.array([gid])
    elif kind in ("body", "subtree"):
        bid = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
        if bid >= 0:
            bodies = {bid}
            if kind == "subtree":
                for b in range(bid + 1, model.nbody):
                    if model.body_parentid[b] in bodies:
                        bodies.add(b)
            return np.flatnonzero(np.isin(model.geom_bodyid, list(bodies)))
    else:
        raise UserError(f"contact pair: kind '{kind}' of '{name}' must be geom, body or subtree")
    raise UserError(f"contact pair: no {kind} named '{name}' in the model")


def _pairs(flags: int) -> str:
    """Return what the peak of contacts does not show."""
    return ", pairs that come near, which count against sim.nconmax too" if flags & NEAR_BIT else ""


class Engine:
    """N worlds of one `mujoco.MjModel`.

    Attributes:
      n: number of worlds. device: "cpu" or "cuda:i". dt: physics step [s]. mjm: the compiled model.
      real: Warp scalar type of states (`wp.float32` on MuJoCo-Warp, `wp.float64` on C MuJoCo).
      wp: Warp arrays that live as long as the engine, and never move:
        time [N], qpos [N, nq], qvel [N, nv], qfrc_applied [N, nv] (of `real`);
        xpos [N, nbody] vec3 and xmat [N, nbody] mat33 (float32): body frames in the world;
        pair_normal [N, P]: sum of normal contact forces [N]; pair_force [N, P] vec3: net force on the pair's first
        member, world frame [N]; flags [N] int32;
        outside [N, nv] (of `real`) after `keep_outside`, else None.
      t: the same memory as torch tensors, with xfrc_applied [N, nbody, 6] (world-frame force then torque).
    """

    kind = ""
    _derived: Sequence[str] = ()  # fields by world that MuJoCo derives from the others
    real: type  # Warp's scalar of states
    _warmstart: torch.Tensor  # [N, nv] accelerations that the solver begins with

    def __init__(
        self, model: mujoco.MjModel, worlds: int, device: str, fields: Sequence[str], pairs: Sequence[ContactPair]
    ):
        if worlds < 1:
            raise UserError(f"worlds={worlds}: must be at least 1")
        self.mjm, self.n, self.device, self.dt = model, worlds, device, float(model.opt.timestep)
        self.pairs = tuple(pairs)
        self.field_names = tuple(fields)
        self.wp = SimpleNamespace(outside=None)
        self.t = SimpleNamespace()

    # -- names -------------------------------------------------------------------------------------------------------
    def body(self, name: str) -> int:
        return self._id(mujoco.mjtObj.mjOBJ_BODY, "body", name)

    def geom(self, name: str) -> int:
        return self._id(mujoco.mjtObj.mjOBJ_GEOM, "geom", name)

    def joint(self, name: str) -> int:
        return self._id(mujoco.mjtObj.mjOBJ_JOINT, "joint", name)

    def qpos_index(self, joints: Sequence[str]) -> np.ndarray:
        """Index into qpos of each (one-DoF) joint, int array [J]."""
        return np.array([self.mjm.jnt_qposadr[self.joint(j)] for j in joints], dtype=np.int32)

    def dof_index(self, joints: Sequence[str]) -> np.ndarray:
        """Index into qvel of each (one-DoF) joint, int array [J]."""
        return np.array([self.mjm.jnt_dofadr[self.joint(j)] for j in joints], dtype=np.int32)

    def pair(self, name: str) -> int:
        """Return the column of a contact pair in pair_normal and pair_force."""
        for k, p in enumerate(self.pairs):
            if p.name == name:
                return k
        raise UserError(f"no contact pair '{name}'; declared: {', '.join(p.name for p in self.pairs) or 'none'}")

    def _id(self, obj: mujoco.mjtObj, kind: str, name: str) -> int:
        i = mujoco.mj_name2id(self.mjm, obj, name)
        if i < 0:
            count = {"body": self.mjm.nbody, "geom": self.mjm.ngeom, "joint": self.mjm.njnt}[kind]
            known = [mujoco.mj_id2name(self.mjm, obj, k) or f"#{k}" for k in range(count)]
            raise UserError(f"model has no {kind} '{name}'; it has: {', '.join(known)}")
        return i

    # -- the engine's own part -----------------------------------------------------------------------------------------
    def field(self, name: str) -> torch.Tensor:
        """Return the per-world values [N, ...] of a declared model field; written in place, seen by the next step."""
        raise NotImplementedError

    def wp_field(self, name: str) -> wp.array:
        """Return the same memory as `field`, as a Warp array of `real` (dof fields: [N, nv])."""
        raise NotImplementedError

    def step(
        self, substeps: int, before_each: Callable[[], None] | None = None, after: Callable[[], None] | None = None
    ) -> None:
        """Step substeps x (before_each, one physics step), then poses, contact forces and flags, then `after`.

        The callbacks only launch Warp kernels on arrays that exist already: MuJoCo-Warp records the sequence once
        and replays it.
        """
        raise NotImplementedError

    def refresh(self) -> None:
        """Compute the body poses for the present qpos (after `set_state`), nothing else."""
        raise NotImplementedError

    def set_state(self, mask: torch.Tensor, qpos: torch.Tensor, qvel: torch.Tensor) -> None:
        """Set, where mask [N] (bool) holds, the state to (qpos [N, nq], qvel [N, nv]), time, warm start, applied and
        contact forces := 0. Poses follow at the next `refresh` or `step`."""
        raise NotImplementedError

    def reset(self, mask: torch.Tensor) -> None:
        """Do `set_state` to the model's qpos0 at rest."""
        qpos = torch.as_tensor(self.mjm.qpos0, dtype=self.t.qpos.dtype, device=self.device).expand(self.n, -1)
        self.set_state(mask, qpos, torch.zeros_like(self.t.qvel))

    def memory(self) -> dict[str, torch.Tensor | tuple[torch.Tensor, int, int]]:
        """Return what one step leaves to the next, live: state, warm start, applied forces, model fields by world.
        Whole numbers with their lowest and highest."""
        t = self.t
        out = {
            "time": t.time, "qpos": t.qpos, "qvel": t.qvel, "qacc_warmstart": self._warmstart,
            "qfrc_applied": t.qfrc_applied, "xfrc_applied": t.xfrc_applied,
        }  # fmt: skip
        if self.wp.outside is not None:
            out["outside"] = t.outside
        for name in dict.fromkeys((*self.field_names, *self._derived)):
            field = self.field(name)
            out[name] = (field, -1, self.mjm.nmesh - 1) if name == "geom_dataid" else field
        return out

    def keep_outside(self) -> None:
        """Make that from now on `wp.outside` and `t.outside` [N, nv] hold what a dof felt from outside in the last
        physics step, N.m or N: gravity, Coriolis and springs, contacts, limits, pushes; all but `qfrc_applied`,
        damping and the dof's own dry friction. 0 after `set_state`. Nobody who does not ask pays for it. Call it
        before the first `step`."""
        if self.wp.outside is None:
            self.wp.outside = wp.zeros((self.n, self.mjm.nv), dtype=self.real, device=self.device)
            self.t.outside = wp.to_torch(self.wp.outside)

    def _forget_outside(self, mask: torch.Tensor) -> None:
        if self.wp.outside is not None:
            self.t.outside.masked_fill_(mask[:, None], 0.0)

    def set_const(self) -> None:
        """Recompute what MuJoCo derives from masses, inertias and sizes (invweight0 and the like) in all worlds."""
        raise NotImplementedError

    def peaks(self) -> dict[str, float]:
        """Return the largest numbers of contacts and constraint rows seen, and the room for them. Reads from the
        device."""
        raise NotImplementedError

    def check_overflow(self) -> None:
        """Fail if contacts or constraint rows were lost since the last call. Reads from the device: call it rarely."""
        # masked before the maximum: another world's harmless, larger bit must not hide a loss
        flags = int((self.t.overflow & OVERFLOW_BITS).max().item())
        if flags:
            p = self.peaks()
            raise UserError(
                f"contact overflow (flags {flags:#x}{_pairs(flags)}): peak {p['contacts']:.1f} contacts a world of "
                f"sim.nconmax={p['nconmax']} on average, {p['rows']:.0f} constraint rows of sim.njmax={p['njmax']}; "
                f"raise the one that is full (e.g. sim.nconmax={2 * int(p['nconmax'])} sim.njmax={2 * int(p['njmax'])})"
            )
        self.t.overflow.zero_()
