"""Memory that the grasp shares with its kernels (`grasp_kernels.py`, `grasp_rewards.py`), and their launches."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import torch
import warp as wp

from dexsim.tactile.clearance import Clearance
from dexsim.tasks import grasp_kernels as kernels
from dexsim.tasks import grasp_rewards
from dexsim.tasks.structs import filled
from dexsim.tasks.task import Task
from dexsim.tasks.terms import joints, memory

CENTRE_LENGTH = 0.03
"""Sideways distance [m] of the object from the middle of the fingers that costs the whole weight of the reward
`centre`, of a hand of UNIT_SPAN."""


def camera_length(env: Any) -> int:
    """Count the pictures that are kept: as many as may be late, and the newest."""
    return max(1, int(round(env.task["sensors"]["vision_delay"][1] / env.dt)) + 1) + 1


class Launches(Task):
    """The kernels of a `GraspEnv`, which inherits this, and the memory that they work on."""

    command, command_left = memory(reset=False), memory(reset=False)  # share of F_max; s
    thumb_command = memory(reset=False)  # below 0: none of its own
    push_force, push_left, push_wait = memory(3, reset=False), memory(reset=False), memory(reset=False)
    first_xy, z_seen, vz_seen = memory(2, reset=False), memory(reset=False), memory(reset=False)
    z_history, z_delay = memory(camera_length, reset=False), memory(dtype=torch.long, reset=False)
    torque_bias = memory(joints, reset=False)
    outside_force = memory(3, reset=False)  # N on the object's body frame, on top of the random pushes (evaluation)

    f_max: float  # N at command 1; these are the task's own, see `GraspEnv.prepare_task`
    beside: float
    pushes: bool
    fixed_command: torch.Tensor | None
    fixed_thumb: torch.Tensor | None
    thumb_range: list[float] | None
    clearance: Clearance
    centre0: torch.Tensor
    reach: torch.Tensor
    pose0: torch.Tensor
    lay: torch.Tensor
    tau_max: torch.Tensor
    root_closes: torch.Tensor
    inner: torch.Tensor
    inner_closes: torch.Tensor
    outer: torch.Tensor

    def prepare_kernels(self) -> None:
        """Allocate what the kernels share with the task."""
        t, J, F = self.task, self.num_actions, self.fingers

        def zeros(*shape: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
            return torch.zeros(self.num_envs, *shape, dtype=dtype, device=self.device)

        self.begun = SimpleNamespace(hand=zeros(J), pose=zeros(7), velocity=zeros(6))  # of episodes that begin now
        self.sensed = SimpleNamespace(joint_position=zeros(J), joint_torque=zeros(J), tip=zeros(F, 3), seen=zeros())
        true = {name: getattr(self, name) for name in ("q", "torque", "torque_bias", "effort", "tips", "z_delay")}
        self._truth = filled(kernels.Truth, z=self.object_pose[:, 2:3], **true)
        self._readings = filled(kernels.Sensed, z_history=self.z_history, **vars(self.sensed))
        self._dropped = zeros(dtype=torch.bool)
        self.measured = torch.zeros(len(grasp_rewards.METRICS) + 1, self.num_envs, device=self.device)
        names = ("command", "thumb_command", "command_left", "push_left", "push_wait")
        self._orders = filled(kernels.Orders, push=self.push_force, **{name: getattr(self, name) for name in names})
        begun = ("first_xy", "z_history", "z_delay", "z_seen", "torque_bias")
        self._begun = filled(kernels.Begun, **vars(self.begun), **{name: getattr(self, name) for name in begun})
        low, high = (round(x / self.dt) for x in t["sensors"]["vision_delay"])
        self._place = filled(
            kernels.Place, unit=self.unit, rise=self.rise, xy=wp.vec2(*self.centre0.tolist()), pose=self.pose0,
            low=self.q_low.contiguous(), high=self.q_high.contiguous(), lay=self.lay, delay_low=low, delay_high=high,
        )  # fmt: skip
        state = ("q", "qd", "torque", "action", "last_action", "tip_force", "self_force", "object_pose")
        moving = ("object_velocity", "command", "thumb_command", "episode_length")
        own = {name: getattr(self, "_episode_length" if name == "episode_length" else name) for name in state + moving}
        self._state = filled(grasp_rewards.State, clearance=self.clearance.distance, **own)
        hand = ("opposing", "others", "roots", "root_closes", "tau_max", "inner", "inner_closes", "outer", "q_mid")
        tables = {name: getattr(self, name) for name in hand}
        tables = {k: v if v.is_floating_point() else v.to(torch.int32) for k, v in tables.items()}
        self._hand_shape = tables | {"middle": wp.vec3(*self.reach.tolist())}
        self._xfrc = wp.from_torch(self.engine.t.xfrc_applied)

    def _shape(self) -> Any:
        """Return forms of rewards and terminations as the settings have them now."""
        r, end, u = self.task["reward"], self.task["termination"], self.unit
        names = ("force_sigma", "force_low", "force_high", "torque_sigma", "torque_low", "torque_high")
        lift = r["force_low"] if self.task["command"].get("zero") else 0.0
        return filled(
            grasp_rewards.Shape, **{name: float(r[name]) for name in names}, f_max=self.f_max, lift=lift,
            contact=r["contact_threshold"], reach_length=u * r["reach_length"], beside=self.beside,
            centre_length=u * CENTRE_LENGTH, distance=u * end["distance"], below=u * end["below"] + self.rise,
            **self._hand_shape,
        )  # fmt: skip

    def kernels(self) -> list[wp.Kernel]:
        return [*super().kernels(), kernels.begin, kernels.orders_kernel(self.engine.real), grasp_rewards.rewards]

    def _launch(self, kernel: Any, dim: Any, *args: Any) -> None:
        inputs = [wp.from_torch(x) if isinstance(x, torch.Tensor) else x for x in args]
        wp.launch(kernel, dim=dim, inputs=inputs, device=self.device)

    def _draw_orders(self) -> tuple[Any, Any]:
        """Draw a new command and push for every world, as the kernels take them."""
        c, s, fixed = self.task["command"], self.sampler, self.fixed_command
        (first, last), low = c["hold_s"], c["low"]
        drawn = self.thumb_range if self.fixed_thumb is None else None
        thumb_low, thumb_high = drawn or (0.0, 1.0)
        how = filled(
            kernels.CommandRange, fixed=fixed is not None, zero=c.get("zero", 0.0), low=low, span=c["high"] - low,
            hold_low=first, hold_span=last - first, thumb_low=thumb_low, thumb_span=thumb_high - thumb_low,
        )  # fmt: skip
        return how, filled(
            kernels.Draws, value=s.uniform() if fixed is None else fixed, hold=s.uniform(),
            weights=s.draw("push.weights"), direction=s.normal(3), duration=s.draw("push.duration"),
            wait=s.draw("push.wait"),
            thumb=s.uniform() if drawn else self.thumb_command if self.fixed_thumb is None else self.fixed_thumb,
        )  # fmt: skip

    def launch_begin(self, mask: torch.Tensor) -> None:
        """Draw a fall, a command and a push of a new episode where mask [N] holds, into `begun` and the memory."""
        s, o = self.sampler, self.objects
        fall = filled(
            kernels.Fall, joint=s.draw("initial.joint", self.num_actions), object_xy=s.draw("initial.object_xy", 2),
            drop=s.draw("initial.drop"), roll=s.uniform(), tilt_axis=s.normal(3), tilt=s.draw("initial.tilt"),
            velocity_xy=s.draw("initial.velocity_xy", 2), velocity_z=s.draw("initial.velocity_z"),
            spin=s.draw("initial.spin", 3), vision_xy=s.draw("sensors.vision_xy", 2), delay=s.uniform(),
            torque_bias=s.draw("sensors.torque_bias", self.num_actions),
        )  # fmt: skip
        args = (self._place, fall, *self._draw_orders(), o.variant, o.radius, o.mass, self._begun, self._orders)
        self._launch(kernels.begin, self.num_envs, mask, *args)

    def launch_orders(self) -> None:
        """Commands and pushes move on by a control step."""
        o, kernel = self.objects, kernels.orders_kernel(self.engine.real)
        args = (*self._draw_orders(), o.mass, self.outside_force, self._orders, self._xfrc)
        self._launch(kernel, self.num_envs, self.dt, self.pushes, o.body, *args)

    def launch_sense(self) -> None:
        """Read encoders, currents and the camera, a control step later, with noise, into `sensed`."""
        s, size, J, F = self.sampler, self.task["sensors"], self.num_actions, self.fingers
        noise = filled(
            kernels.Noise, joint_size=size["joint_noise"], torque_size=size["torque_noise"], tip_size=size["tip_noise"],
            height_size=size["vision_z_noise"], height=s.normal(), joint=s.normal(J), torque=s.normal(J),
            tip=s.normal(3 * F),
        )  # fmt: skip
        self._launch(kernels.sense, (self.num_envs, J + F + 1), noise, self._truth, self._readings)

    def launch_rewards(self) -> dict[str, torch.Tensor]:
        """Return terms by name, weighted [N]; write what the log shows into `measured`."""
        w, names = self.task["rewards"], tuple(grasp_rewards.TERMS)
        rows = len(names) + len(grasp_rewards.METRICS) + 1
        out = torch.empty(rows, self.num_envs, device=self.device)
        weights = grasp_rewards.Weights(*(float(w.get(name, 0.0)) for name in names))
        self._launch(grasp_rewards.rewards, self.num_envs, weights, self.dt, self._state, self._shape(), out)
        self.measured = out[len(names) :]
        # checkpoints from before lack some
        return {name: term for name, term in zip(names, out, strict=False) if name in w}
