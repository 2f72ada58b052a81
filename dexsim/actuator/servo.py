"""The servo of an engine's joints: its table, its state, and the launch that runs before each physics step."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import mujoco
import torch
import warp as wp

from dexsim.actuator.columns import (
    COLUMNS,
    DELAYS,
    ENCODER,
    FEATURE_OF,
    FEATURES,
    INDEX,
    MEMORY,
    NAMES,
    column,
    did_you_mean,
)
from dexsim.actuator.kernel import (
    EXTENDED,
    EXTRA_SLOTS,
    QUEUE,
    SLOTS,
    drives,
    given_kernel,
    reset_kernel,
    send_kernel,
    servo_kernel,
)
from dexsim.actuator.reference import Step, measured_position
from dexsim.actuator.table import ServoTable
from dexsim.errors import UserError
from dexsim.sim.launches import Launches

FIELDS = ("dof_damping", "dof_frictionloss", "dof_armature")  # per-world model fields that the engine must declare


class Servo:
    """Drives J named hinge or slide joints of an engine with N worlds. The law and its integration: `kernel.py`.

    Arguments:
        engine: see `dexsim.sim`; the fields in `FIELDS` declared per world; timestep fixed.
        joints: names of the joints, in the order of every [N, J] array here.
        table: what is believed of the drives; written to every world.
        control_period: shortest time between targets [s], so that the queue outlasts the longest delay (else 8).
        varied: names of the columns that will be given values other than the table's (by randomization, say): what of
            the kernel is left out where no drive needs it (`columns.FEATURES`) follows from the table and from these.

    Where the table states play or elasticity (`backlash`, `softness`), a rotor of its own is simulated, and the table's
    `loop_encoder` and `position_encoder` say on which side of it the encoders are.

    Tensors share memory with the kernel; write them in place:
        params [N, J, C] columns of `columns.py`, SI; nominal [J, C] as the table states them;
        state [N, J, S] slots `slots`: motor torque of the last step [N.m], enabled (1 driven, 0 free), then the queue's
            stamps [s] and targets [rad], oldest first, then what the features need;
        torque [N, J] motor torque as its current shows it, at the start of the last physics step: after clipping and
            lag, before efficiency and friction, positive along positive joint position [N.m];
        base_damping, base_frictionloss, base_armature [N, J] the model's own joint damping, friction and armature, to
            which the servo's are added (an armature loses its rotor where there is play). Randomize these, not the
            model fields: the servo overwrites them before each physics step, the armature only where play is simulated;
        misread: whether the encoders may report other positions than the joints have;
        first_memory: the slot of the first number of `columns.MEMORY` in a state; -1 where nothing is remembered;
        home [N, J] positions [rad] from which a joint that drags another is counted (default: the model's qpos0);
        inertia [N, J] about the joints [kg.m2], for the integration only: an estimate serves.
    """

    def __init__(
        self, engine: Any, joints: Sequence[str], table: ServoTable, *, control_period: float | None = None,
        varied: Sequence[str] = (),
    ):  # fmt: skip
        self.engine = engine
        self.joints = tuple(joints)
        self.table = table
        mjm, n, device, real = engine.mjm, engine.n, engine.device, engine.real
        known = [name for name in (mjm.joint(i).name for i in range(mjm.njnt)) if name]
        table.check_joints([*known, *self.joints])
        dof_q, dof = _addresses(mjm, self.joints, known)
        if len(set(dof)) != len(dof):
            raise UserError(f"servo: a joint is driven twice in {list(joints)}; each joint has one drive.")

        nominal = table.nominal(self.joints)
        _check_drags(table, self.joints, nominal)
        named = {*_stated(table, self.joints), *varied}
        self.features = frozenset(FEATURE_OF[name] for name in named if name in FEATURE_OF)
        self.queue, self.control_period = 8, control_period
        # the newest entry, one a period through the longest delay, and one before (three, where they have rates)
        if control_period:
            longest = table.bounds(self.joints)[1][:, [INDEX[name] for name in DELAYS]].sum(1).max()
            self.queue = max(8, math.ceil(longest / control_period) + 3 + 2 * ("controller" in self.features))
        self.slots = {name: i for i, name in enumerate(SLOTS)}
        for k in range(self.queue):
            self.slots[f"stamp{k}"] = QUEUE + k
            self.slots[f"target{k}"] = QUEUE + self.queue + k
        before_play = "play" in self.features and "motor" in table.encoder("position", self.joints)
        self._bent = bool(named & ENCODER)  # what an encoder shows may be no straight line in the position
        self.misread = before_play or self._bent or bool(named & {"position_offset", "position_scale"})
        extended = bool(self.features & EXTENDED)
        self.first_memory = QUEUE + 2 * self.queue if extended else -1
        if extended:
            self.slots |= {name: self.first_memory + i for i, name in enumerate(EXTRA_SLOTS)}

        j, c, s = len(self.joints), len(NAMES), len(self.slots)
        zeros = lambda *shape: wp.zeros(shape, dtype=real, device=device)  # noqa: E731

        def index(values: Any) -> wp.array:
            return wp.array(values, dtype=int, device=device)

        self._params, self._state, self._torque = zeros(n, j, c), zeros(n, j, s), zeros(n, j)
        self._inertia, self._base_damping, self._base_frictionloss = zeros(n, j), zeros(n, j), zeros(n, j)
        self._base_armature, self._home, self._given = zeros(n, j), zeros(n, j), zeros(n)
        self._target, self._stamp = zeros(n, j), zeros(n)
        self._mask = wp.zeros(n, dtype=wp.bool, device=device)
        self._dof, self._dof_q = index(dof), index(dof_q)

        self.params, self.state, self.torque = (wp.to_torch(a) for a in (self._params, self._state, self._torque))
        self._by_name = {name: self.params[:, :, i] for name, i in INDEX.items()}  # views
        self.base_damping = wp.to_torch(self._base_damping)
        self.base_frictionloss = wp.to_torch(self._base_frictionloss)
        self.base_armature, self.home = wp.to_torch(self._base_armature), wp.to_torch(self._home)
        self._target_t, self._stamp_t, self._mask_t = (wp.to_torch(a) for a in (self._target, self._stamp, self._mask))
        as_tensor = lambda x: torch.as_tensor(x, dtype=self.params.dtype, device=self.params.device)  # noqa: E731
        self._as_tensor = as_tensor
        self.qpos, self._qvel = (torch.as_tensor(x, device=self.params.device) for x in (dof_q, dof))  # [J] addresses

        self.nominal = as_tensor(nominal)
        self.params[:] = self.nominal
        self.inertia = wp.to_torch(self._inertia)
        self.inertia[:] = as_tensor(1.0 / mjm.dof_invweight0[dof])
        self.base_damping[:] = as_tensor(mjm.dof_damping[dof])
        self.base_frictionloss[:] = as_tensor(mjm.dof_frictionloss[dof])
        self.base_armature[:] = as_tensor(mjm.dof_armature[dof])
        self.home[:] = as_tensor(mjm.qpos0[dof_q])
        on_loop, on_position = ([x == "motor" for x in table.encoder(at, self.joints)] for at in ("loop", "position"))
        self._loop_motor = index([int(x) for x in on_loop])
        self._position_motor = torch.as_tensor(on_position, device=self.params.device) if any(on_position) else None
        self.torque_max = as_tensor(nominal[:, INDEX["torque_limit"]])  # [J], what a normalised torque is over
        self.current_per_torque = as_tensor(table.current(self.joints))  # [J] A per N.m, nan where unknown

        if "load" in self.features:
            engine.keep_outside()
        self._servo = servo_kernel(real, table.drive == "voltage", self.features)
        self._send, self._reset, self._sum = send_kernel(real), reset_kernel(real, extended), given_kernel(real)
        self._period = 1.0 / table.control_rate if table.control_rate else 0.0
        self._shape = (n, j)
        self._launch = Launches(device, captured=engine.kind != "mujoco")
        self._wp = engine.wp
        self._fields = {name: engine.wp_field(name) for name in FIELDS}
        self._drives = drives(real)()
        own = (
            "params", "state", "torque", "inertia", "base_damping", "base_frictionloss", "base_armature", "home",
            "given", "dof", "dof_q", "loop_motor",
        )  # fmt: skip
        for name in own:
            setattr(self._drives, name, getattr(self, f"_{name}"))
        for name in ("time", "qpos", "qvel", "qfrc_applied", *(("outside",) if "load" in self.features else ())):
            setattr(self._drives, name, getattr(self._wp, name))
        for name, field in self._fields.items():
            setattr(self._drives, name, field)
        self.reset(None, as_tensor(mjm.qpos0[dof_q]).expand(n, j))

    # -- parameters ------------------------------------------------------------

    def column(self, name: str) -> torch.Tensor:
        """Return [N, J] view of one column of `params`; UserError with the valid names for another name."""
        return self.params[:, :, INDEX[column(name).name]]

    def check_simulated(self, name: str) -> None:
        """Raise UserError if the kernel was built without what a column needs: neither the table nor `varied` names
        it."""
        feature = FEATURE_OF.get(column(name).name)
        if feature and feature not in self.features:
            raise UserError(
                f"servo column '{name}' is not simulated here: state one of {', '.join(FEATURES[feature])} in the "
                "servo's file."
            )

    # -- targets ------------------------------------------------------------

    def send(
        self, target: torch.Tensor, mask: torch.Tensor | None = None, stamp: torch.Tensor | float | None = None
    ) -> None:
        """Queue target [N, J] (rad) where mask [N] bool holds (None: all worlds), stamped [s] ([N] or one; None: now).

        Stamps must not decrease. With the table's control_rate a target acts from that bus's next tick. No host sync.
        """
        self._target_t.copy_(target)
        self._set_mask(mask)
        time = self._wp.time
        if stamp is not None:
            self._stamp_t.copy_(self._as_tensor(stamp).expand_as(self._stamp_t))
            time = self._stamp
        name = "send" if stamp is None else "send stamped"
        args = (self.queue, self._period, self._mask, time, self._target, self._state)
        self._launch(name, self._send, self._shape, args)

    def reset(self, mask: torch.Tensor | None, q: torch.Tensor) -> None:
        """Puts the drives of the masked worlds [N] bool (None: all) at rest, targets q [N, J] (rad) held since ever."""
        self._target_t.copy_(q)
        self._set_mask(mask)
        args = (self.queue, self._mask, self._target, self._state, self._torque)
        self._launch("reset", self._reset, self._shape, args)

    def begin_setpoint(self, known: torch.Tensor) -> None:
        """Begin the setpoint of each drive, reset just now, at a position [rad] and speed [rad/s] known [N, J, 2]; NaN:
        where the joint is."""
        if "profile" in self.features:
            at = self._as_tensor(known)
            ok = torch.isfinite(at).all(-1)
            for name, x in (("setpoint", at[..., 0]), ("setpoint_speed", at[..., 1]), ("setpoint_new", -1.0 * ok)):
                self.state[:, :, self.slots[name]] = torch.where(ok, x, 0.0)

    # -- the step ------------------------------------------------------------

    def before_each(self) -> None:
        """Launches the servo for one physics step: the engine's `before_each` (capturable; one launch, two where a
        supply sags)."""
        if "sag" in self.features:
            self._launch("given", self._sum, self._shape[0], (self._shape[1], self._torque, self._given))
        self._launch("servo", self._servo, self._shape, (self.engine.dt, self.queue, self._drives))

    # -- what an observer reads ------------------------------------------------------------

    def position(self) -> torch.Tensor:
        """Return [N, J] position that the encoders report: scale * position + offset of the joints [rad]."""
        return self.measured(self._turned()[0])

    def velocity(self) -> torch.Tensor:
        """Return [N, J] velocity that the encoders report [rad/s]."""
        q, v = self._turned()
        return measured_position(self._by_name, q, self.features, torch, self._remembered())[1] * v

    def measured(self, q: torch.Tensor) -> torch.Tensor:
        """Return what the encoders report [N, J] where they stand at q [N, J] (rad)."""
        reading: torch.Tensor = measured_position(self._by_name, q, self.features, torch, self._remembered())[0]
        return reading

    def unmeasured(self, reported: torch.Tensor) -> torch.Tensor:
        """Return the position [N, J] at which the encoders report so [N, J] (rad): the inverse of `measured`."""
        q = (reported - self.column("position_offset")) / self.column("position_scale")
        # the error is a small part of the position: each turn wins a digit or more
        for _ in range(6 if self._bent else 0):
            q = q + (reported - self.measured(q)) / self.column("position_scale")
        return q

    def _remembered(self) -> Step | None:
        """Return what the encoders remember; None where none does."""
        if not self._bent or self.first_memory < 0:
            return None
        of = {name: self.state[:, :, self.slots[name]] for name in MEMORY}
        return Step(self.engine.dt, self.state[:, :, self.slots["fresh"]] != 0, of)

    @property
    def at_rotor(self) -> bool:
        """True if some encoder reports a rotor before a play: `position` is then more than `measured` of the joints."""
        return self._position_motor is not None and "play" in self.features

    def _turned(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return ([N, J] position, velocity) of what the reporting encoders turn with: the joints, or the rotors
        before a play."""
        q, v = self.engine.t.qpos[:, self.qpos], self.engine.t.qvel[:, self._qvel]
        here = self._position_motor
        if here is None or not self.at_rotor:
            return q, v
        rotor, a, b, fresh = (self.state[:, :, self.slots[name]] for name in ("rotor", "line_a", "line_b", "fresh"))
        w = torch.where(fresh != 0, v, a + b * v)
        return torch.where(here & (fresh == 0), rotor + self.engine.dt * w, q), torch.where(here, w, v)

    # -- state ------------------------------------------------------------

    def get_state(self) -> torch.Tensor:
        """Return a copy of state [N, J, S]."""
        return self.state.clone()

    def set_state(self, state: torch.Tensor, mask: torch.Tensor | None = None) -> None:
        """Sets state [N, J, S] in the masked worlds [N] bool (None: all)."""
        if mask is None:
            self.state.copy_(state)
        else:
            self.state.copy_(torch.where(mask[:, None, None], state, self.state))
        self.torque.copy_(self.state[:, :, self.slots["motor"]])

    def memory(self) -> dict[str, torch.Tensor]:
        """Return what a step leaves to the next and what randomization draws, live."""
        names = ("params", "state", "torque", "inertia", "base_damping", "base_frictionloss", "base_armature", "home")
        return {name: getattr(self, name) for name in names}

    def _set_mask(self, mask: torch.Tensor | None) -> None:
        if mask is None:
            self._mask_t.fill_(True)
        else:
            self._mask_t.copy_(mask)


def _check_drags(table: ServoTable, joints: Sequence[str], nominal: Any) -> None:
    """Raise UserError where `coupling_from` is no other joint's number."""
    for j, joint in enumerate(joints):
        source, bounds = nominal[j, INDEX["coupling_from"]], table.value(joint, "coupling")
        used = not bounds.unknown and (bounds.low != 0.0 or bounds.high != 0.0)
        if used and (source not in range(len(joints)) or source == j):
            raise UserError(
                f"{table.source}: joints.{joint}.coupling_from is {source:g}; it must be the number of another joint, "
                f"0 to {len(joints) - 1}: " + ", ".join(f"{k} {name}" for k, name in enumerate(joints) if k != j)
            )


def _stated(table: ServoTable, joints: Sequence[str]) -> list[str]:
    """Return the columns that the table gives a value, or a range, other than the neutral one for some joint; unknown
    ones are neutral."""
    nominal, (low, high), unknown = table.nominal(joints), table.bounds(joints), table.unknown(joints)
    return [
        c.name
        for i, c in enumerate(COLUMNS)
        if (
            (~unknown[:, i]) & ((nominal[:, i] != c.neutral) | (low[:, i] != c.neutral) | (high[:, i] != c.neutral))
        ).any()
    ]


def _addresses(mjm: mujoco.MjModel, names: Sequence[str], known: Sequence[str]) -> tuple[list[int], list[int]]:
    """Return the qpos and dof addresses of the named joints; UserError for an unknown name or a joint not a hinge or
    slide."""
    qpos, dof = [], []
    for name in names:
        if name not in known:
            hint = did_you_mean(name, known)
            raise UserError(f"servo: joint '{name}' is not in the model.{hint} Its joints: {', '.join(known)}")
        joint = mjm.joint(name).id
        if int(mjm.jnt_type[joint]) not in (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)):
            raise UserError(f"servo: joint '{name}' is neither a hinge nor a slide; a servo drives those only.")
        qpos.append(int(mjm.jnt_qposadr[joint]))
        dof.append(int(mjm.jnt_dofadr[joint]))
    return qpos, dof
