"""Force-controlled grasp by inverted catching: an object is dropped on a palm-up hand, which must catch it, hold it
against pushes, and press with a commanded force.

Paper: "Force-Adaptive Grasping" (setup), table "Observation for force-adaptive grasping", equations of R_torque,
R_force, R_diff, R_outter, R_action, R_vel. Constants the paper does not publish are marked `ours` in
configs/task/grasp.yaml.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
import warp as wp

from dexsim.assets.objects import library
from dexsim.errors import UserError
from dexsim.hand.places import approach
from dexsim.tactile.clearance import Clearance
from dexsim.tasks import base_path, grasp_rewards, observations
from dexsim.tasks import grasp_kernels as kernels
from dexsim.tasks.env import HandEnv
from dexsim.tasks.press import fingertip_press
from dexsim.tasks.servos import ServoRandomizer
from dexsim.tasks.structs import filled

CENTRE_LENGTH = 0.03
"""Sideways distance [m] of the object from the middle of the fingers that costs the whole weight of the reward
`centre`, of a hand of UNIT_SPAN."""


def privileged(joints: int, fingers: int) -> tuple[tuple[str, int], ...]:
    """(name, width) of what the critic sees beyond the actor's rows, with task.critic=privileged."""
    return (
        ("joint_velocity", joints), ("object_quaternion", 4), ("object_velocity_full", 6), ("object_size", 3),
        ("object_kind", 4),
        ("object_mass", 1), ("object_com", 3), ("object_friction", 1), ("contact_stiffness", 1), ("contact_damping", 1),
        ("push", 3),
        ("finger_force", fingers), ("palm_force", 1), ("kp", joints), ("torque_limit", joints),
        ("target_error", joints), ("command_time", 1),
    )  # fmt: skip


def _is_range(pair: Any) -> bool:
    """Two numbers, 0 <= low <= high <= 1."""
    if not isinstance(pair, list) or len(pair) != 2:
        return False
    return all(isinstance(x, (int, float)) and not isinstance(x, bool) for x in pair) and 0 <= pair[0] <= pair[1] <= 1


class GraspEnv(HandEnv):
    """Catch an object, hold it against pushes, press with a commanded force."""

    TAKES_OBJECTS = True

    @classmethod
    def check_deployed(cls, source: str) -> None:
        """It can."""

    def setup(self) -> None:
        t, n, dev = self.task, self.num_envs, self.device
        felt = (t.get("observe") or {}).get("touch", True)  # checkpoints from before have no such setting
        if not isinstance(felt, bool):
            raise UserError(f"task.observe.touch={felt}: must be true or false")
        self.felt = self.pads if felt else 0  # pads that the actor sees
        drive = 1.0
        for name in ("servo.efficiency", "servo.torque_limit"):
            low, high, _ = self.sampler.range(name)
            drive *= (low + high) / 2
        # another world does not tell its drives
        believed = self.cfg.get("belief") or {"servo": self.cfg["servo"], "drive": drive}
        self.f_max = fingertip_press(
            self.hand, believed["servo"], stiffness=t["contact"]["stiffness"], drive=believed["drive"]
        )
        # index tensors on the device: a Python list would be copied there at every use
        pressed = [self.hand.fingers[k] for k in self.hand.others]
        self.inner = torch.tensor([f.flexion[0] for f in pressed], device=dev)
        self.outer = torch.tensor([f.flexion[1] for f in pressed if len(f.flexion) > 1], dtype=torch.long, device=dev)
        closing = torch.as_tensor(self.hand.closing, dtype=torch.float32, device=dev)
        self.root_closes, self.inner_closes = closing[self.roots], closing[self.inner]
        self.tau_max = self.effort[self.roots]
        self.servo_random = ServoRandomizer(self.servo, self.sampler)
        train, held = t["objects"]["train"], t["objects"]["held_out"]
        if not held:
            raise UserError(
                "task.objects.held_out=[]: must name a shape, e.g. [cross]; policies are judged on some that they never"
                " met"
            )
        names = [v.shape.name for v in self.objects.scene.variants]
        self.train_rows = torch.tensor([i for i, s in enumerate(names) if s in train], device=dev)
        self.held_rows = torch.tensor([i for i, s in enumerate(names) if s in held], device=dev)
        # every shape is equally likely, whatever the number of its baked sizes
        self.row_weight = torch.tensor([1.0 / names.count(s) for s in names], device=dev)
        emphasis = t["objects"].get("emphasis", {})
        for name, times in emphasis.items():
            if name not in library() or not 0 < times <= 100:
                raise UserError(
                    f"task.objects.emphasis: {name}: {times}: must name a shape ({', '.join(library())}) and be above"
                    " 0, at most 100"
                )
        self.emphasis = torch.tensor([float(emphasis.get(s, 1.0)) for s in names], device=dev)
        self.draw_from(self.train_rows, self.emphasis)
        self.clearance = Clearance(self.touch)
        self.kinds = torch.nn.functional.one_hot(self.objects.kind, 4).float()
        for name, low, high in (
            ("object.mass", 1e-3, 5.0),
            ("object.friction", 0.05, 3.0),
            ("object.scale", 0.3, 3.0),
            ("object.com", -0.25, 0.25),
            ("contact.stiffness", 100.0, 1e5),
            ("contact.damping_ratio", 0.0, 3.0),
            ("servo.delay", -0.5, 0.5),
            ("push.weights", 0.0, 20.0),
        ):
            self.sampler.check(name, low, high)
        if not 0 <= t["command"]["low"] <= t["command"]["high"] <= 1:
            raise UserError(
                f"task.command: low={t['command']['low']}, high={t['command']['high']} must satisfy 0 <= low <= high"
                " <= 1"
            )
        self.thumb_range = t["command"].get("thumb")
        if self.thumb_range is not None and not _is_range(self.thumb_range):
            raise UserError(
                f"task.command.thumb={self.thumb_range}: must be null or [low, high] with 0 <= low <= high <= 1"
            )
        if t["critic"] not in ("paper", "privileged"):
            raise UserError(f"task.critic={t['critic']}: must be paper or privileged")
        base_path.of((t.get("evaluation") or {}).get("base", "turn"))  # refused now, not after the training
        self.gravity0 = torch.tensor([0.0, 0.0, -9.81], device=dev)
        where, xy, beside = self.places, t["initial"]["object_xy"], t["reward"]["centre_y"]
        self.centre0 = torch.tensor(where.catch[:2].tolist() if xy is None else xy, device=dev)
        self.reach = torch.tensor(where.middle.tolist(), device=dev)  # the middle of the grasp
        self.beside = float(where.beside[1]) if beside is None else beside
        h = 0.5**0.5  # rotations that bring the body's x, y or z axis to palm y
        to_y = torch.tensor([[h, 0.0, 0.0, h], [1.0, 0.0, 0.0, 0.0], [h, -h, 0.0, 0.0]], device=dev)
        self.lay = to_y[torch.tensor([int(v.shape.extents.argmax()) for v in self.objects.scene.variants], device=dev)]
        pose = t["initial"]["pose"]
        angles = self.hand.pose("open").tolist() if pose is None else [pose[j] for j in self.hand.joints]
        self.pose0 = torch.tensor(angles, device=dev)

        def zeros(*shape: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
            return torch.zeros(n, *shape, dtype=dtype, device=dev)

        self.command, self.command_left = zeros(), zeros()
        self.thumb_command = zeros() - 1.0  # below 0: none of its own
        self.push, self.push_left, self.push_wait = zeros(3), zeros(), zeros()
        self.first_xy, self.z_seen, self.vz_seen = zeros(2), zeros(), zeros()
        lag = max(1, int(round(t["sensors"]["vision_delay"][1] / self.dt)) + 1)
        self.z_history, self.z_delay = zeros(lag + 1), zeros(dtype=torch.long)
        self.torque_bias = zeros(self.num_actions)
        self.outside_force = zeros(3)  # N on the object's body frame, on top of the random pushes (evaluation)
        self.fixed_command: torch.Tensor | None = None  # [N], or None to resample within the episode
        self.fixed_thumb: torch.Tensor | None = None  # the same of the thumb's own
        self.pushes = True
        self._for_kernels(zeros)

    def _for_kernels(self, zeros: Callable[..., torch.Tensor]) -> None:
        """Memory that the kernels share with this (`grasp_kernels.py`, `grasp_rewards.py`)."""
        t, J, F = self.task, self.num_actions, self.fingers
        self.start = SimpleNamespace(hand=zeros(J), pose=zeros(7), velocity=zeros(6))  # of episodes that begin now
        self.sensed = SimpleNamespace(joint_position=zeros(J), joint_torque=zeros(J), tip=zeros(F, 3), seen=zeros())
        true = {name: getattr(self, name) for name in ("q", "torque", "torque_bias", "effort", "tips", "z_delay")}
        self._truth = filled(kernels.Truth, z=self.object_pose[:, 2:3], **true)
        self._sensed = filled(kernels.Sensed, z_history=self.z_history, **vars(self.sensed))
        self._dropped = zeros(dtype=torch.bool)
        self._measured = torch.zeros(len(grasp_rewards.METRICS) + 1, self.num_envs, device=self.device)
        names = ("command", "command_left", "push", "push_left", "push_wait")
        self._orders = filled(kernels.Orders, **{name: getattr(self, name) for name in names})
        names = ("first_xy", "z_history", "z_delay", "z_seen", "torque_bias")
        self._begun = filled(
            kernels.Begun, **vars(self.start), **{name: getattr(self, name) for name in names}
        )
        low, high = (round(x / self.dt) for x in t["sensors"]["vision_delay"])
        self._place = filled(
            kernels.Place, unit=self.unit, rise=self.rise, xy=wp.vec2(*self.centre0.tolist()), pose=self.pose0,
            low=self.q_low.contiguous(), high=self.q_high.contiguous(), lay=self.lay, delay_low=low, delay_high=high,
        )  # fmt: skip
        state = ("q", "qd", "torque", "action", "last_action", "tip_force", "self_force", "object_pose")
        moving = ("object_velocity", "command", "thumb_command", "episode_length")
        own = {
            name: getattr(self, "_episode_length" if name == "episode_length" else name) for name in state + moving
        }
        self._state = filled(grasp_rewards.State, clearance=self.clearance.distance, **own)
        hand = ("opposing", "others", "roots", "root_closes", "tau_max", "inner", "inner_closes", "outer", "q_mid")
        tables = {name: getattr(self, name) for name in hand}
        tables = {k: v if v.is_floating_point() else v.to(torch.int32) for k, v in tables.items()}
        self._hand_shape = tables | {"middle": wp.vec3(*self.reach.tolist())}
        self._xfrc = wp.from_torch(self.engine.t.xfrc_applied)

    def _shape(self) -> Any:
        """Forms of rewards and terminations as the settings have them now."""
        r, end, u = self.task["reward"], self.task["termination"], self.unit
        names = ("force_sigma", "force_low", "force_high", "torque_sigma", "torque_low", "torque_high")
        return filled(
            grasp_rewards.Shape, **{name: float(r[name]) for name in names}, f_max=self.f_max,
            contact=r["contact_threshold"], reach_length=u * r["reach_length"], beside=self.beside,
            centre_length=u * CENTRE_LENGTH, distance=u * end["distance"], below=u * end["below"] + self.rise,
            **self._hand_shape,
        )  # fmt: skip

    def kernels(self) -> list[wp.Kernel]:
        return [*super().kernels(), kernels.begin, kernels.orders_kernel(self.engine.real), grasp_rewards.rewards]

    def _launch(self, kernel: Any, dim: Any, *args: Any) -> None:
        inputs = [wp.from_torch(x) if isinstance(x, torch.Tensor) else x for x in args]
        wp.launch(kernel, dim=dim, inputs=inputs, device=self.device)

    def feel(self) -> None:
        super().feel()
        self.clearance.launch()

    def draw_from(self, rows: torch.Tensor, emphasis: torch.Tensor | None = None) -> None:
        """Objects of new episodes are drawn from these rows of the scene's table [R]: every shape equally often, or by
        its emphasis (one number a row of the table)."""
        weight = self.row_weight[rows] if emphasis is None else (self.row_weight * emphasis)[rows]
        self._rows, self._cumulative = rows, (weight / weight.sum()).cumsum(0)

    # -- episodes
    # ------------------------------------------------------------------------------------------------------------
    def begin_episodes(self, mask: torch.Tensor) -> None:
        s = self.sampler
        pick = torch.searchsorted(self._cumulative, s.uniform()).clamp(max=len(self._cumulative) - 1)
        scale = self.unit * s.draw("object.scale")[:, None] * s.draw("object.aspect", 3)
        self.objects.write(
            mask,
            self._rows[pick],
            scale=scale,
            mass=s.draw("object.mass"),
            com=s.draw("object.com", 3),
            friction=s.draw("object.friction"),
            stiffness=s.draw("contact.stiffness"),
            damping_ratio=s.draw("contact.damping_ratio"),
        )
        self.touch.shape_id.copy_(self.objects.variant.to(torch.int32))
        self.touch.shape_size.copy_(self.objects.size)
        self.touch.randomize(mask, self.rng)
        self.servo_random.draw(mask)
        gravity = self.engine.field("opt.gravity")
        torch.where(mask[:, None], self.gravity0.to(gravity.dtype), gravity, out=gravity)

        fall = filled(
            kernels.Fall,
            joint=s.draw("initial.joint", self.num_actions),
            object_xy=s.draw("initial.object_xy", 2),
            drop=s.draw("initial.drop"),
            roll=s.uniform(),
            tilt_axis=s.normal(3),
            tilt=s.draw("initial.tilt"),
            velocity_xy=s.draw("initial.velocity_xy", 2),
            velocity_z=s.draw("initial.velocity_z"),
            spin=s.draw("initial.spin", 3),
            vision_xy=s.draw("sensors.vision_xy", 2),
            delay=s.uniform(),
            torque_bias=s.draw("sensors.torque_bias", self.num_actions),
        )
        orders, o = self._draw_orders(), self.objects
        args = (self._place, fall, *orders, o.variant, o.radius, o.mass, self._begun, self._orders)
        self._launch(kernels.begin, self.num_envs, mask, *args)
        self._command_thumb(mask)
        self.place(mask, self.start.hand, self.start.pose, self.start.velocity)

    def _draw_orders(self) -> tuple[Any, Any]:
        """A new command and push for every world, as the kernels take them: how a command is drawn, and what was."""
        c, s, fixed = self.task["command"], self.sampler, self.fixed_command
        (first, last), low = c["hold_s"], c["low"]
        how = filled(
            kernels.CommandRange, fixed=fixed is not None, low=low, span=c["high"] - low, hold_low=first,
            hold_span=last - first,
        )  # fmt: skip
        drawn = filled(
            kernels.Draws,
            value=s.uniform() if fixed is None else fixed,
            hold=s.uniform(),
            weights=s.draw("push.weights"),
            direction=s.normal(3),
            duration=s.draw("push.duration"),
            wait=s.draw("push.wait"),
        )
        return how, drawn

    def memory(self) -> dict:
        names = ("command", "command_left", "push", "push_left", "push_wait", "first_xy", "z_seen", "vz_seen")
        thumb = () if self.thumb_range is None else ("thumb_command",)
        own = {name: getattr(self, name) for name in (*names, *thumb, "z_history", "torque_bias", "outside_force")}
        return super().memory() | own | {"z_delay": (self.z_delay, 0, self.z_history.shape[1] - 1)}

    def before_physics(self) -> None:
        """The command changes once it was held for long enough; pushes come and go."""
        o, kernel = self.objects, kernels.orders_kernel(self.engine.real)
        args = (*self._draw_orders(), o.mass, self.outside_force, self._orders, self._xfrc)
        left = self.command_left if self.thumb_range is None else self.command_left.clone()
        self._launch(kernel, self.num_envs, self.dt, self.pushes, o.body, *args)
        self._command_thumb(self.command_left > left)  # a new command is held for longer than was left of the old

    def _command_thumb(self, mask: torch.Tensor) -> None:
        """Where mask [N] holds, a new command of the thumb's own, if it has one."""
        if self.thumb_range is None:
            return
        low, high = self.thumb_range
        drawn = low + (high - low) * self.sampler.uniform() if self.fixed_thumb is None else self.fixed_thumb
        self.thumb_command.copy_(torch.where(mask, drawn, self.thumb_command))

    # -- terminations
    # --------------------------------------------------------------------------------------------------------
    def terminated(self) -> dict[str, torch.Tensor]:
        """Dropped: the object's centre is below the palm or far from it."""
        self._launch(grasp_rewards.dropped, self.num_envs, self._state, self._shape(), self._dropped)
        return {"dropped": self._dropped}

    # -- rewards
    # ---------------------------------------------------------------------------------------------------------------
    def reward_words(self) -> dict[str, str]:
        words = grasp_rewards.TERMS
        return words | {"centre": f"{words['centre']}, over {self.unit * CENTRE_LENGTH:.3g} m"}

    def rewards(self) -> dict[str, torch.Tensor]:
        w, names = self.task["rewards"], tuple(grasp_rewards.TERMS)
        rows = len(names) + len(grasp_rewards.METRICS) + 1
        out = torch.empty(rows, self.num_envs, device=self.device)
        weights = grasp_rewards.Weights(*(float(w.get(name, 0.0)) for name in names))
        self._launch(grasp_rewards.rewards, self.num_envs, weights, self.dt, self._state, self._shape(), out)
        self._measured = out[len(names) :]
        # checkpoints from before lack some
        return {name: term for name, term in zip(names, out, strict=False) if name in w}

    # -- observations
    # ----------------------------------------------------------------------------------------------------------
    def observe(self, advance: bool) -> dict[str, torch.Tensor]:
        s, size, J, F, sensed = self.sampler, self.task["sensors"], self.num_actions, self.fingers, self.sensed
        height = s.normal() if advance else self.z_seen  # without a step no picture is taken
        noise = filled(
            kernels.Noise,
            joint_size=size["joint_noise"],
            torque_size=size["torque_noise"],
            tip_size=size["tip_noise"],
            height_size=size["vision_z_noise"],
            joint=s.normal(J),
            torque=s.normal(J),
            tip=s.normal(3 * F),
            height=height,
        )
        self._launch(kernels.sense, (self.num_envs, J + F + 1), advance, noise, self._truth, self._sensed)
        if advance:
            self.vz_seen.copy_(observations.height_speed(sensed.seen, self.z_seen, self.dt))
            self.z_seen.copy_(sensed.seen)
        torque_max = self.effort
        actor = observations.build(
            observations.Signals(
                joint_position=sensed.joint_position,
                joint_torque=sensed.joint_torque,
                object_xy=self.first_xy,
                object_z=self.z_seen,
                object_vz=self.vz_seen.masked_fill(self.episode_length_buf == 0, 0.0),
                touch_force=self.touch.force[:, : self.felt],
                touch_centre=self.touch.centre[:, : self.felt],
                fingertip=sensed.tip,
                command=self._commands(),
            ),
            self.f_max,
        )  # the deployed loop builds its own with the same function
        critic = [
            self.q, self.torque / torque_max, self.object_pose[:, :3], self.object_velocity[:, :3],
            self.touch.force_clean[:, : self.pads] / self.f_max, self.touch.centre_clean[:, : self.pads].flatten(1),
            self.tips.flatten(1),
            self._commands().reshape(self.num_envs, -1),
        ]  # fmt: skip
        if self.task["critic"] == "privileged":
            critic += self._privileged()
        return {
            "actor": torch.where(self.nan[:, None], 0.0, actor),
            "critic": torch.nan_to_num(torch.cat(critic, 1)),
        }

    def _commands(self) -> torch.Tensor:
        """[N], or [N, 2] with the thumb's own."""
        return self.command if self.thumb_range is None else torch.stack([self.command, self.thumb_command], 1)

    def rows(self) -> list[tuple[str, int, str, str]]:
        """(name, width, unit, what it is on hardware) of the actor's observation."""
        return self._observed(self.felt)

    def _observed(self, pads: int) -> list[tuple[str, int, str, str]]:
        return observations.rows(self.num_actions, self.fingers, pads, 1 if self.thumb_range is None else 2)

    def _privileged(self) -> list[torch.Tensor]:
        o = self.objects
        kind = self.kinds[o.variant]
        pushing = self.engine.t.xfrc_applied[:, o.body, :3].float()
        return [
            self.qd, self.object_pose[:, 3:], self.object_velocity, o.size, kind, o.mass[:, None], o.com,
            o.friction[:, None],
            o.stiffness[:, None] / 1e4, o.damping_ratio[:, None], pushing, self.finger_force / self.f_max,
            self.palm_force[:, None] / self.f_max,
            self.servo.column("kp").float(), self.servo.column("torque_limit").float(), self.target - self.q,
            self.command_left[:, None],
        ]  # fmt: skip

    # -- what the log shows
    # ------------------------------------------------------------------------------------------------------
    def metrics(self) -> dict[str, torch.Tensor]:
        """Means over the worlds that are late enough in their episode."""
        sums = self._measured.sum(1)
        means = (sums[:-1] / sums[-1].clamp(min=1)).unbind()
        return {f"task/{name}": mean for name, mean in zip(grasp_rewards.METRICS, means, strict=True)}

    def describe(self) -> dict:
        """Tables for the first screen."""
        table = self.rows()
        groups = {"actor": [(name, width, f"{unit}; {text}") for name, width, unit, text in table]}
        whole = self._observed(self.pads)
        critic = [(name, width, f"{unit}; clean") for name, width, unit, _ in whole]
        if self.task["critic"] == "privileged":
            critic += [(name, width, "privileged") for name, width in privileged(self.num_actions, self.fingers)]
        groups["critic"] = critic
        return {
            "observations": groups,
            "action": self.action_rows(),
            "rewards": self.reward_rows(),
            "terminations": [
                (
                    "dropped",
                    f"centre below {self.unit * self.task['termination']['below'] + self.rise:.3g} m or"
                    f" {self.unit * self.task['termination']['distance']:.3g} m away",
                ),
                *self.usual_ends(),
            ],
            "randomization": self.sampler.rows(),
            "notes": [
                f"F_max = {self.f_max:.2f} N a fingertip: static press at {self.tau_max[self.others[0]].item():.2f} N.m"
                " (command 1)",
                *self.hand_notes(),
            ],
            "headline": ["task/held", "task/force_error"],
        }

    def evaluate(
        self,
        policy: Callable[..., torch.Tensor],
        episodes: int = 256,
        seed: int = 0,
        progress: Callable[..., None] | None = None,
    ) -> dict:
        """Play `episodes` episodes; see `tasks/grasp_eval.py`."""
        from dexsim.tasks.grasp_eval import evaluate

        return evaluate(self, policy, episodes, seed, progress)

    def scripted_policy(self, rate: float = 0.5, wait: float = 0.35) -> Callable[[Mapping], torch.Tensor]:
        """A policy without learning, from the actor's observation alone: open for `wait` seconds of an episode, then
        close thumb and fingers at `rate` (of the largest action), each joint until its torque reaches 0.1 + 0.6 F_cmd
        of its maximum. A floor for what is learned, and a check that the physics can hold anything at all."""
        if self.task["action"]["mode"] != "relative":
            raise UserError(f"policy=scripted: moves by task.action.mode=relative, not {self.task['action']['mode']}")
        start = {name: part.start for name, part in observations.slices(self.rows()).items()}
        torque, vz, command = start["joint_torque"], start["object_velocity"] + 2, start["force_command"]
        way, closing = approach(self.hand), np.zeros(self.num_actions)
        for k in self.hand.others:
            turned = list(self.hand.fingers[k].flexion[:2])
            closing[turned] = rate * way[turned]
        for k in self.hand.opposing:
            finger = self.hand.fingers[k]
            for j in finger.joints:
                closing[j] = (0.8 if j in finger.flexion else 1.0) * rate * way[j]
        step = torch.as_tensor(closing, dtype=torch.float32, device=self.device)
        age = torch.zeros(self.num_envs, device=self.device)

        def policy(obs: Mapping) -> torch.Tensor:
            x = obs["actor"]
            # a finite difference of a noisy height is exactly zero only where an episode has just begun
            age.copy_(torch.where(x[:, vz] == 0, torch.zeros_like(age), age + self.dt))
            light = x[:, torque : torque + self.num_actions].abs() < (0.1 + 0.6 * x[:, command])[:, None]
            return step * (light & (age >= wait)[:, None])

        return policy
