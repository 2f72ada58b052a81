"""MuJoCo-Warp behind the Engine interface: the only place that captures graphs."""

from __future__ import annotations

import gc
from collections.abc import Callable, Sequence
from contextlib import ExitStack

import mujoco
import mujoco_warp as mjw
import numpy as np
import torch
import warp as wp

from dexsim.errors import UserError
from dexsim.sim import collision as narrow_phase
from dexsim.sim import contact, warmup
from dexsim.sim import solver as newton
from dexsim.sim.begin import Begin
from dexsim.sim.beside import Beside
from dexsim.sim.engine import FLAG_NAN, ContactPair, Engine

_DERIVED = ("body_subtreemass", "body_invweight0", "dof_invweight0")
_STREAMS: dict[int, wp.Stream] = {}


def _warp_stream(stream: torch.cuda.Stream) -> wp.Stream:
    """Warp's view of a torch stream: one for each, kept. A second view of the same stream would, when the first is
    collected, be unknown to Warp."""
    if stream.cuda_stream not in _STREAMS:
        _STREAMS[stream.cuda_stream] = wp.stream_from_torch(stream)
    return _STREAMS[stream.cuda_stream]


class WarpEngine(Engine):
    """N worlds on MuJoCo-Warp, float32, CPU or CUDA. See `Engine` for the interface.

    narrow: who finds the contacts of convex hulls, None = MuJoCo-Warp itself.
    newton: who finds the contact forces, None = MuJoCo-Warp itself.
    beside: lets stages of a recorded step run side by side, None = one after the other.
    """

    kind = "warp"
    _derived = _DERIVED

    def __init__(
        self, model: mujoco.MjModel, worlds: int, device: str, fields: Sequence[str], pairs: Sequence[ContactPair],
        deterministic: bool, nconmax: int, njmax: int, collision: str, solver: str = "auto",
    ):  # fmt: skip
        super().__init__(model, worlds, device, fields, pairs)
        self.real = wp.float32
        why_not = narrow_phase.unsupported(model)
        if collision == "hand" and why_not:
            raise UserError(f"sim.collision=hand: {why_not}; use sim.collision=mujoco")
        self.nconmax, self.njmax = nconmax, -(-njmax // 16) * 16  # the solver's tiles want multiples of 16
        no_solver = newton.unsupported(model, device, self.njmax)
        if solver == "hand" and no_solver:
            raise UserError(f"sim.solver=hand: {no_solver}; use sim.solver=mujoco")
        coupled = model.neq or model.ntendon  # a hand's joints that follow others
        if solver == "auto" and no_solver and coupled and device.startswith("cuda"):
            print(f"contact forces by MuJoCo-Warp's own solver: of dexsim's, {no_solver}", flush=True)
        wp.config.log_level = wp.LOG_WARNING
        wp.init()
        if device.startswith("cuda"):
            # torch and Warp share one non-default stream: ordered without synchronisation, and capturable
            torch.cuda.set_device(device)
            stream = torch.cuda.current_stream()
            if stream.cuda_stream == 0:
                stream = torch.cuda.Stream()
                torch.cuda.set_stream(stream)
            wp.set_stream(_warp_stream(stream), device)
        with wp.ScopedDevice(device):
            batched = {f for f in fields if not f.startswith("opt.")} | set(_DERIVED)
            self.m = mjw.put_model(model, batch_sizes=dict.fromkeys(batched, worlds))
            self.m.opt.warn_overflow = False  # the device's printf serialises the GPU; flags tell instead
            if deterministic:
                self.m.opt.deterministic = int(mjw.DeterminismType.ALL)
            if "opt.gravity" in fields:
                self.m.opt.gravity = wp.array(np.tile(model.opt.gravity, (worlds, 1)), dtype=wp.vec3)
            self.d = mjw.put_data(model, mujoco.MjData(model), nworld=worlds, nconmax=nconmax, njmax=self.njmax)
            self.narrow = (
                narrow_phase.NarrowPhase(model, self.m, self.d) if collision != "mujoco" and not why_not else None
            )
            if self.narrow is not None and not self.narrow.number:
                self.narrow = None
            self.newton = newton.NewtonSolver(self.m, self.d) if solver != "mujoco" and not no_solver else None
            plain = device.startswith("cuda") and self.narrow is not None and self.newton is not None
            # moments of contacts, rows of speeds: what is computed beside is needed
            by_contact = (model.actuator_trntype == mujoco.mjtTrn.mjTRN_BODY).any() or coupled
            more = (_warp_stream(torch.cuda.Stream()) for _ in range(2))
            self.beside = Beside(*more) if plain and not (deterministic or by_contact) else None
            P = len(self.pairs)
            w = self.wp
            w.time, w.qpos, w.qvel, w.qfrc_applied = self.d.time, self.d.qpos, self.d.qvel, self.d.qfrc_applied
            w.xpos, w.xmat = self.d.xpos, self.d.xmat
            w.pair_normal = wp.zeros((worlds, P), dtype=float)
            w.pair_force = wp.zeros((worlds, P), dtype=wp.vec3)
            w.flags = wp.zeros(worlds, dtype=int)
            self._overflow = wp.zeros(worlds, dtype=int)
            self._peak = wp.zeros(2, dtype=int)
            self._normal_sum = wp.zeros((worlds, P), dtype=int)
            self._force_sum = wp.zeros((worlds, P, 3), dtype=int)
            self._table: wp.array | None = wp.array(contact.pair_table(model, self.pairs), dtype=int) if P else None
        for name in ("time", "qpos", "qvel", "qfrc_applied", "xpos", "xmat", "pair_normal", "pair_force", "flags"):
            setattr(self.t, name, wp.to_torch(getattr(w, name)))
        self.t.overflow = wp.to_torch(self._overflow)
        self.t.xfrc_applied = wp.to_torch(self.d.xfrc_applied)
        self._warmstart = wp.to_torch(self.d.qacc_warmstart)
        self._begin = Begin(self.real, self.wp, self.t, self._warmstart)
        self._simplex = wp.to_torch(self.narrow.simplex) if self.narrow is not None else None
        self._fields = {}
        for name in set(fields) | set(_DERIVED):
            owner, attr = (self.m.opt, name[4:]) if name.startswith("opt.") else (self.m, name)
            self._fields[name] = getattr(owner, attr)
        self._fields_t = {k: wp.to_torch(v) for k, v in self._fields.items()}
        self._graphs: dict = {}
        self._eager_done: set = set()
        warmup.begin(self._one_step, device)
        with wp.ScopedDevice(device):
            warmup.finish(self._positions)  # the others are compiled while a task is built
        self.refresh()

    def field(self, name: str) -> torch.Tensor:
        return self._fields_t[name]

    def wp_field(self, name: str) -> wp.array:
        return self._fields[name]

    def step(
        self, substeps: int, before_each: Callable[[], None] | None = None, after: Callable[[], None] | None = None
    ) -> None:
        warmup.finish()

        def program() -> None:
            for _ in range(substeps):
                if before_each is not None:
                    before_each()
                self.physics_step()
            self._positions()
            self._outputs()
            if after is not None:
                after()

        self._run(("step", substeps, before_each, after), program)

    def physics_step(self) -> None:
        """Launch one bare physics step."""
        with ExitStack() as stack:
            recorded = wp.get_device(self.device).captures  # what is not waits for Python anyway
            for ours in (self.narrow, self.newton, self.beside if recorded else None):
                if ours is not None:
                    stack.enter_context(ours.in_place())
            mjw.step(self.m, self.d)
        if self.wp.outside is not None:
            d = self.d
            own = [d.qfrc_smooth, d.qfrc_applied, d.qfrc_damper, d.qfrc_constraint, d.dof_frictionadr, d.efc.force]
            wp.launch(contact.outside_torque, dim=(self.n, self.mjm.nv), inputs=own, outputs=[self.wp.outside])

    def _one_step(self) -> None:
        self.physics_step()
        self._positions()
        self._outputs()

    def _positions(self) -> None:
        mjw.kinematics(self.m, self.d)

    def refresh(self) -> None:
        self._run(("refresh",), self._positions)

    def set_state(self, mask: torch.Tensor, qpos: torch.Tensor, qvel: torch.Tensor) -> None:
        self._begin(mask, qpos, qvel)
        self._forget_outside(mask)
        if self._simplex is not None:
            self._simplex.masked_fill_(mask[:, None, None], -1)

    def memory(self) -> dict:
        # checked where it is used
        own = {} if self._simplex is None else {"simplex": (self._simplex, -(2**31), 2**31 - 1)}
        return super().memory() | own

    def set_const(self) -> None:
        with wp.ScopedDevice(self.device):
            mjw.set_const(self.m, self.d)

    def peaks(self) -> dict[str, float]:
        contacts, rows = self._peak.numpy()
        return {"contacts": contacts / self.n, "rows": float(rows), "nconmax": self.nconmax, "njmax": self.njmax}

    def _outputs(self) -> None:
        d = self.d
        if self.pairs:
            now = contact.Contacts()
            for name in ("geom", "worldid", "frame", "dim", "friction", "efc_address"):
                setattr(now, name, getattr(d.contact, name))
            now.nacon, now.efc_force, now.njmax = d.nacon, d.efc.force, d.njmax
            now.pyramidal = int(self.mjm.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL)
            wp.launch(
                contact.add_contacts,
                dim=d.naconmax,
                inputs=[now, self._table],
                outputs=[self._normal_sum, self._force_sum],
            )
            wp.launch(
                contact.read_sums,
                dim=(self.n, len(self.pairs)),
                inputs=[self._normal_sum, self._force_sum],
                outputs=[self.wp.pair_normal, self.wp.pair_force],
            )
        wp.launch(
            contact.check_worlds,
            dim=self.n,
            inputs=[d.qpos, d.qvel, d.overflow, d.nacon, d.nefc, FLAG_NAN],
            outputs=[self.wp.flags, self._overflow, self._peak],
        )

    def _run(self, key: tuple, program: Callable[[], None]) -> None:
        """Run a step. First call: eager (kernels compile). Second: recorded, then replayed; the same path on CPU and
        CUDA."""
        with wp.ScopedDevice(self.device):
            inside = self.device.startswith("cuda") and torch.cuda.is_current_stream_capturing()
            if inside or key not in self._eager_done:  # inside another recording, be part of it
                program()
                self._eager_done.add(key)
                return
            graph = self._graphs.get(key)
            if graph is None:
                gc.collect()
                gc.disable()  # a graph destroyed during a capture would be recorded into it
                try:
                    with wp.ScopedCapture() as capture:
                        program()
                finally:
                    gc.enable()
                graph = self._graphs[key] = capture.graph
            wp.capture_launch(graph)
