"""C MuJoCo behind the Engine interface: worlds on a thread pool (`mujoco.batch`), float64, CPU."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import mujoco
import mujoco.batch
import numpy as np
import torch
import warp as wp

from dexsim.errors import UserError
from dexsim.sim import mujoco_kernels as kernels
from dexsim.sim.begin import Begin
from dexsim.sim.engine import FLAG_NAN, ContactPair, Engine
from dexsim.sim.launches import Launches

_SLOTS, _MANY_SLOTS = 12, 64
"""Contacts of one pair that are summed; more are counted, and fail in `check_overflow`. The many where a model has more
than _FEW_GEOMS that collide, links of several boxes, say: each slot costs time, whether it is used or not."""
_FEW_GEOMS = 48
_LOST = 1 << 6  # bit of `Engine.t.overflow`
_DERIVED = ("body_subtreemass", "body_invweight0", "dof_invweight0")


def compile_with_sensors(spec: mujoco.MjSpec, pairs: Sequence[ContactPair]) -> mujoco.MjModel:
    """Compile `spec` with one contact sensor a pair (C MuJoCo's batch does not hand out its contact list)."""
    kinds = {"geom": mujoco.mjtObj.mjOBJ_GEOM, "body": mujoco.mjtObj.mjOBJ_BODY, "subtree": mujoco.mjtObj.mjOBJ_XBODY}
    spec = spec.copy()
    slots = _SLOTS if sum(bool(g.contype or g.conaffinity) for g in spec.geoms) <= _FEW_GEOMS else _MANY_SLOTS
    field = mujoco.mjtConDataField
    data = sum(
        1 << int(f)
        for f in (field.mjCONDATA_FOUND, field.mjCONDATA_FORCE, field.mjCONDATA_NORMAL, field.mjCONDATA_TANGENT)
    )
    for p in pairs:
        for kind, name in (p.first, p.second):
            if kind not in kinds:
                raise UserError(f"contact pair: kind '{kind}' of '{name}' must be geom, body or subtree")
            if (spec.geom(name) if kind == "geom" else spec.body(name)) is None:
                raise UserError(f"contact pair: no {kind} named '{name}' in the model")
        spec.add_sensor(
            name=f"pair_{p.name}", type=mujoco.mjtSensor.mjSENS_CONTACT, objtype=kinds[p.first[0]], objname=p.first[1],
            reftype=kinds[p.second[0]], refname=p.second[1], intprm=[data, 0, slots],
        )  # fmt: skip
    return spec.compile()


class MujocoEngine(Engine):
    """N worlds on C MuJoCo. See `Engine` for the interface; results do not depend on the number of threads."""

    kind = "mujoco"
    _derived = _DERIVED

    def __init__(
        self, model: mujoco.MjModel, worlds: int, fields: Sequence[str], pairs: Sequence[ContactPair], threads: int,
        real: type = wp.float64,
    ):  # fmt: skip
        super().__init__(model, worlds, "cpu", fields, pairs)
        self.real = real
        self._launch = Launches("cpu", captured=False)
        # A diverged world must keep its NaN, to be seen and reset by the environment like on the other engine. And
        # geoms that move by world are not where the compiler's bounding volumes have them: test every pair of two
        # bodies.
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET | mujoco.mjtDisableBit.mjDSBL_MIDPHASE
        self.batch = mujoco.batch.Batch(model, worlds, threads)
        b = self.batch
        b.forward()
        self._sensordata = b.bind("sensordata") if self.pairs else None
        self._nefc, self._ncon = b.bind("nefc"), b.bind("ncon")
        w, P, N = self.wp, len(self.pairs), worlds
        for name in ("time", "qpos", "qvel", "qfrc_applied"):
            setattr(w, name, wp.array(b.bind(name), dtype=wp.float64, device="cpu", copy=False))
            setattr(self.t, name, torch.from_numpy(b.bind(name)))
        self.t.xfrc_applied = torch.from_numpy(b.bind("xfrc_applied"))
        self._warmstart = torch.from_numpy(b.bind("qacc_warmstart"))
        w.xpos = wp.zeros((N, model.nbody), dtype=wp.vec3, device="cpu")
        w.xmat = wp.zeros((N, model.nbody), dtype=wp.mat33, device="cpu")
        w.pair_normal = wp.zeros((N, P), dtype=float, device="cpu")
        w.pair_force = wp.zeros((N, P), dtype=wp.vec3, device="cpu")
        w.flags = wp.zeros(N, dtype=int, device="cpu")
        for name in ("xpos", "xmat", "pair_normal", "pair_force", "flags"):
            setattr(self.t, name, wp.to_torch(getattr(w, name)))
        self._begin = Begin(self.real, self.wp, self.t, self._warmstart)
        self._overflow, self._most = wp.zeros(N, dtype=int, device="cpu"), wp.zeros(1, dtype=int, device="cpu")
        self.t.overflow = wp.to_torch(self._overflow)
        if P:
            sensors = [model.sensor(f"pair_{p.name}").id for p in self.pairs]
            first = [model.sensor_adr[s] for s in sensors]
            self._slots = int(model.sensor_intprm[sensors[0], 2])
            self._contact_args: list[wp.array] = [
                wp.array(self._sensordata, dtype=wp.float64, device="cpu", copy=False),
                wp.array(first, dtype=int, device="cpu"),
            ]
        self._fields = {name: b.expand(name) for name in dict.fromkeys((*fields, *_DERIVED))}
        self._fields_t = {k: torch.from_numpy(v) for k, v in self._fields.items()}
        # Of a body whose centre lies on its only joint's axis, C MuJoCo takes the inertia as it was compiled, armature
        # and all (`dof_M0`), so what is written to `dof_armature` is put there too.
        self._simple = np.flatnonzero(model.dof_simplenum) if "dof_armature" in fields else np.zeros(0, int)
        self._inertia = b.expand("dof_M0") if len(self._simple) else np.zeros((worlds, 0))
        self._own_inertia = self._without_armature()
        self._disabled = b.expand("opt.disableflags")
        self._flags = self._disabled.copy()
        self._fields_wp: dict[str, wp.array] = {}
        if model.nmocap:
            raise UserError(
                "sim.engine=mujoco: the model has mocap bodies, which it does not place; use sim.engine=warp"
            )
        self._tree = kernels.tree(model, self._fields)
        self._pos = wp.zeros((N, model.nbody), dtype=wp.vec3d, device="cpu")
        self._quat = wp.zeros((N, model.nbody), dtype=wp.vec4d, device="cpu")
        self._peak = np.zeros(2)
        self.refresh()

    def field(self, name: str) -> torch.Tensor:
        return self._fields_t[name]

    def wp_field(self, name: str) -> wp.array:
        if name not in self._fields_wp:
            self._fields_wp[name] = wp.array(self._fields[name], dtype=wp.float64, device="cpu", copy=False)
        return self._fields_wp[name]

    def step(
        self, substeps: int, before_each: Callable[[], None] | None = None, after: Callable[[], None] | None = None
    ) -> None:
        b = self.batch
        with wp.ScopedDevice("cpu"):
            if before_each is None and self.wp.outside is None:
                self._with_armature()
                b.step(nstep=substeps)
            else:
                # the sensors' contact forces are read after the last step only
                self._disabled[:] = self._flags | int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
                for k in range(substeps):
                    if k == substeps - 1:
                        self._disabled[:] = self._flags
                    if before_each is not None:
                        before_each()
                    self._one_step()
            self._check()
            self._contacts()
            self._kinematics()
            if after is not None:
                after()

    def contacts(self, on: np.ndarray) -> None:
        """Simulate contacts in the worlds where `on` [N] holds, in no others, in steps with `before_each`."""
        off = int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        self._flags[:] = np.where(on.reshape(-1, *[1] * (self._flags.ndim - 1)), self._flags & ~off, self._flags | off)

    def changed(self) -> list[np.ndarray]:
        """Return what a step changes and the next depends on, in place."""
        return [*(x.numpy() for x in vars(self.wp).values() if isinstance(x, wp.array)), self._warmstart.numpy(),
                *self._fields.values()]  # fmt: skip

    def refresh(self) -> None:
        self._kinematics()

    def set_state(self, mask: torch.Tensor, qpos: torch.Tensor, qvel: torch.Tensor) -> None:
        self._begin(mask, qpos, qvel)
        self._forget_outside(mask)

    def keep_outside(self) -> None:
        if self.mjm.opt.integrator == mujoco.mjtIntegrator.mjINT_DISCRETE:
            raise UserError("sim.engine=mujoco: friction under load from outside is read from a step of implicitfast, "
                            "implicit or Euler; the model's integrator is discrete")  # fmt: skip
        super().keep_outside()

        def view(x: np.ndarray) -> wp.array:
            return wp.array(x, dtype=wp.float64, device="cpu", copy=False)

        read = ("qfrc_smooth", "qfrc_damper", "qfrc_constraint", "qacc")
        level = self._fields.get("dof_frictionloss", self.mjm.dof_frictionloss[None].copy())
        self._before = np.zeros(self.t.qvel.shape)
        arrays = [
            kernels.friction_rows(self.mjm), level, self._fields["dof_invweight0"], self._before,
            *map(self.batch.bind, read),
        ]  # fmt: skip
        self._outside_args = [*map(view, arrays), self.wp.qfrc_applied, self.wp.outside]

    def _one_step(self) -> None:
        """Take one physics step of the batch, and what the dofs felt from outside in it, where that is asked for."""
        self._with_armature()
        if self.wp.outside is None:
            self.batch.step()
            return
        self._before[:] = self.t.qvel.numpy()
        self.batch.step()
        self._launch("outside", kernels.outside_torque, (self.n, self.mjm.nv), self._outside_args)

    def set_const(self) -> None:
        self.batch.set_const()
        self._own_inertia = self._without_armature()

    def _without_armature(self) -> np.ndarray:
        """Return the inertia [N, S] of the S dofs of `_simple`, kg.m2 or kg, less their armature."""
        i = self._simple
        return self._inertia[:, i] - self._fields["dof_armature"][:, i] if len(i) else np.zeros((self.n, 0))

    def _with_armature(self) -> None:
        i = self._simple
        if len(i):
            self._inertia[:, i] = self._own_inertia + self._fields["dof_armature"][:, i]

    def peaks(self) -> dict[str, float]:
        return {"contacts": float(self._peak[0]), "rows": float(self._peak[1]), "nconmax": 0, "njmax": 0}

    def check_overflow(self) -> None:
        if bool((self.t.overflow & _LOST).any()):
            raise UserError(
                f"contact overflow: a contact pair had {self._most.numpy()[0]} contacts, sim.engine=mujoco sums"
                f" {self._slots}; use sim.engine=warp, or pairs of fewer geoms"
            )
        self.t.overflow.zero_()

    def _kinematics(self) -> None:
        """Compute the poses of the present qpos. The batch offers whole stages only, and each of its calls waits for
        all its threads."""
        args = [self._tree, self.wp.qpos, self._pos, self._quat, self.wp.xpos, self.wp.xmat]
        self._launch("poses", kernels.poses, self.n, args)

    def _contacts(self) -> None:
        if not self.pairs:
            return
        args = [
            *self._contact_args, self._slots, _LOST, self.wp.flags, FLAG_NAN, self.wp.pair_normal, self.wp.pair_force,
            self._overflow, self._most,
        ]  # fmt: skip
        self._launch("contacts", kernels.read_contacts, (self.n, len(self.pairs)), args)
        sound = self.t.flags.numpy() == 0
        self._peak[0] = max(self._peak[0], self._ncon.reshape(-1).max(initial=0, where=sound))
        self._peak[1] = max(self._peak[1], self._nefc.reshape(-1).max(initial=0, where=sound))

    def _check(self) -> None:
        args = [self.wp.qpos, self.wp.qvel, FLAG_NAN, self.wp.flags]
        self._launch("check", kernels.check_worlds, self.n, args)
