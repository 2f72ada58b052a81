"""Force-controlled grasp by inverted catching: an object is dropped on a palm-up hand, which must catch it, hold it
against pushes, and press with a commanded force.

Paper: "Force-Adaptive Grasping" (setup), table "Observation for force-adaptive grasping", equations of R_torque,
R_force, R_diff, R_outter, R_action, R_vel. Constants the paper does not publish are marked `ours` in
configs/task/grasp.yaml.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch

from dexsim import typed
from dexsim.errors import UserError
from dexsim.tactile.clearance import Clearance
from dexsim.tasks import base_path, grasp_rewards, observations
from dexsim.tasks.grasp_launch import CENTRE_LENGTH, Launches
from dexsim.tasks.press import fingertip_press
from dexsim.tasks.terms import VECTOR, done, observe


def _is_range(pair: Any) -> bool:
    """Tell whether it is two numbers, 0 <= low <= high <= 1."""
    if not isinstance(pair, list) or len(pair) != 2:
        return False
    return all(isinstance(x, (int, float)) and not isinstance(x, bool) for x in pair) and 0 <= pair[0] <= pair[1] <= 1


class GraspEnv(Launches):
    """Catch an object, hold it against pushes, press with a commanded force."""

    evaluation = "dexsim.tasks.grasp_eval"
    choices = {"critic": ("paper", "privileged"), "observe.touch": (True, False)}
    ranges = {"object.scale": (0.3, 3.0), "servo.delay": (-0.5, 0.5), "push.weights": (0.0, 20.0)}
    shapes = {"contact_threshold": (0.0, 100.0), "force_sigma": (1e-3, 10.0), "force_low": (0.0, 10.0),
              "force_high": (0.0, 10.0), "torque_sigma": (1e-3, 10.0), "torque_low": (0.0, 10.0),
              "torque_high": (0.0, 10.0), "reach_length": (1e-4, 1.0)}  # fmt: skip

    # -- setting up
    @classmethod
    def check_deployed(cls, source: str) -> None:
        """Accept every policy: the deployed loop has this task."""

    @classmethod
    def another_world(cls, u: Callable[..., float], friction: float, size: float) -> dict[str, Any]:
        randomize = {"object.friction": [0.5, 1.0], "contact.stiffness": u(6000.0, 8500.0),
                     "contact.damping_ratio": u(0.6, 0.9)}  # fmt: skip
        return {"randomize": randomize, "sensors": {"joint_noise": 0.001, "torque_noise": 0.01}}

    def adapt(self) -> Mapping[str, Mapping[str, Any]]:
        """`observe.touch` and `critic` as switches of observations."""
        t = self.task
        touch = {"actor": (t.get("observe") or {}).get("touch", True)}  # checkpoints from before have no such setting
        sensed = dict.fromkeys(("actor", "critic"), bool(self.hand.sensed))
        return {"contact_force": touch, "contact_centre": touch, "follower_angle": sensed,
                "privileged": {"critic": t["critic"] == "privileged"}}  # fmt: skip

    def prepare_task(self) -> None:
        self._check()
        t, dev = self.task, self.device
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
        self.clearance = Clearance(self.touch)
        self.kinds = torch.nn.functional.one_hot(self.objects.kind, 4).float()
        where, xy, beside = self.places, t["initial"]["object_xy"], t["reward"]["centre_y"]
        self.centre0 = torch.tensor(where.catch[:2].tolist() if xy is None else xy, device=dev)
        self.reach = torch.tensor(where.middle.tolist(), device=dev)  # the middle of the grasp
        beside = float(where.beside[1]) if beside is None else beside
        self.beside = typed.number("task.reward.centre_y", beside, -1.0, 1.0)
        h = 0.5**0.5  # rotations that bring the body's x, y or z axis to palm y
        to_y = torch.tensor([[h, 0.0, 0.0, h], [1.0, 0.0, 0.0, 0.0], [h, -h, 0.0, 0.0]], device=dev)
        self.lay = to_y[torch.tensor([int(v.shape.extents.argmax()) for v in self.objects.scene.variants], device=dev)]
        pose = t["initial"]["pose"]
        angles = self.hand.pose("open").tolist() if pose is None else [pose[j] for j in self.hand.joints]
        self.pose0 = torch.tensor(angles, device=dev)
        self.thumb_command.fill_(-1.0)
        self.fixed_command: torch.Tensor | None = None  # [N], or None to resample within the episode
        self.fixed_thumb: torch.Tensor | None = None  # the same of the thumb's own
        self.pushes = True
        self.prepare_kernels()

    def _check(self) -> None:
        t = self.task
        if not t["objects"]["held_out"]:
            raise UserError(
                "task.objects.held_out=[]: must name a shape, e.g. [cross]; policies are judged on some that they never"
                " met"
            )
        if not 0 <= t["command"]["low"] <= t["command"]["high"] <= 1:
            raise UserError(
                f"task.command: low={t['command']['low']}, high={t['command']['high']} must satisfy 0 <= low <= high"
                " <= 1"
            )
        for part, name in (("termination", "untouched"), ("command", "zero")):
            if not 0 <= (share := t[part].get(name, 0.0)) <= 1:
                raise UserError(f"task.{part}.{name}={share}: must lie in [0, 1]")
        self.thumb_range = t["command"].get("thumb")
        if self.thumb_range is not None and not _is_range(self.thumb_range):
            raise UserError(
                f"task.command.thumb={self.thumb_range}: must be null or [low, high] with 0 <= low <= high <= 1"
            )
        base_path.of((t.get("evaluation") or {}).get("base", "turn"))  # refused now, not after the training

    def memory(self) -> dict:
        """Return the declared memory; a picture's age within those that are stored."""
        return super().memory() | {"z_delay": (self.z_delay, 0, self.z_history.shape[1] - 1)}

    # -- an episode begins, and goes on
    def begin(self, mask: torch.Tensor) -> None:
        """Begin episodes: an object falls on the open hand."""
        self.launch_begin(mask)
        self.place(mask, self.begun.hand, self.begun.pose, self.begun.velocity)

    def before_physics(self) -> None:
        """Change commands that were held for long enough; begin and end pushes."""
        super().before_physics()
        self.launch_orders()

    def feel(self) -> None:
        super().feel()
        self.clearance.launch()

    def update(self) -> None:
        # not for sure: all worlds would begin anew at once; an evaluation goes on, and counts
        rate = 0.0 if self.fixed_command is not None else self.task["termination"].get("untouched") or 0.0
        drawn = self.sampler.uniform() if rate else self.command
        args = self.finger_force, float(rate), drawn, self.dt, self._state, self._shape(), self._dropped
        self._launch(grasp_rewards.dropped, self.num_envs, *args)

    @done(name="dropped")
    def is_dropped(self) -> torch.Tensor:
        """centre below the palm (termination.below) or far from it (termination.distance); or not held, while learning
        (termination.untouched)"""
        return self._dropped

    # -- what is paid: every term is computed by one kernel
    def reward_words(self) -> dict[str, str]:
        words = grasp_rewards.TERMS | super().reward_words()
        return words | {"centre": f"{words['centre']}, over {self.unit * CENTRE_LENGTH:.3g} m"}

    def rewards(self) -> dict[str, torch.Tensor]:
        return self.launch_rewards() | super().rewards()

    # -- what is seen: table "Observation for force-adaptive grasping"; noise is that of `sensors`, by one kernel
    def sense(self, fresh: torch.Tensor) -> None:
        self.launch_sense()
        self.vz_seen = observations.height_speed(self.sensed.seen, self.z_seen, self.dt)
        self.z_seen = self.sensed.seen

    @observe("rad")
    def joint_angle(self) -> torch.Tensor:
        """measured"""
        return self.q if self.clean else self.sensed.joint_position

    @observe("rad", noise="sensors.joint_noise")
    def follower_angle(self) -> torch.Tensor:
        """measured, of joints without a drive"""
        return self.followers()

    @observe("tau/tau_max")
    def joint_torque(self) -> torch.Tensor:
        """motor current, as calibrated"""
        return self.torque / self.effort if self.clean else self.sensed.joint_torque

    @observe("m", mirror=VECTOR)
    def object_position(self) -> torch.Tensor:
        """x, y held at their first value; z from vision: noisy, delayed"""
        return self.object_pose[:, :3] if self.clean else torch.cat([self.first_xy, self.z_seen[:, None]], 1)

    @observe("m/s", name="object_velocity", mirror=VECTOR)
    def object_moves(self) -> torch.Tensor:
        """finite difference of the measured z; x, y zero"""
        if self.clean:
            return self.object_velocity[:, :3]
        return torch.cat([torch.zeros_like(self.first_xy), self.height_speed()[:, None]], 1)

    def height_speed(self) -> torch.Tensor:
        """Return the speed of the object as the camera has it [N], m/s; 0 as an episode begins."""
        return self.vz_seen.masked_fill(self.episode_length_buf == 0, 0.0)

    def commanded_force(self) -> torch.Tensor:
        """Return the commanded force of each finger [N, F] in N; NaN for one that is told none."""
        out = self.command[:, None].repeat(1, len(self.hand.finger_names))
        out[:, self.opposing] = self.thumb_command.where(self.thumb_command >= 0, torch.nan)[:, None]
        return self.f_max * out

    @observe("F/F_max")
    def contact_force(self) -> torch.Tensor:
        """sum of a pad's normal forces"""
        return self.touch_force / self.f_max

    @observe("m", mirror=VECTOR)
    def contact_centre(self) -> torch.Tensor:
        """force-weighted mean of taxel positions, palm frame"""
        return self.touch_centre

    @observe("m", mirror=VECTOR)
    def fingertip_position(self) -> torch.Tensor:
        """palm frame, forward kinematics"""
        return self.tips if self.clean else self.sensed.tip

    @observe("F/F_max")
    def force_command(self) -> torch.Tensor:
        """0..1; with task.command.thumb the thumb's own after it"""
        return self.command if self.thumb_range is None else torch.stack([self.command, self.thumb_command], 1)

    @observe("SI", only="critic")
    def privileged(self) -> dict[str, torch.Tensor]:
        """with task.critic=privileged"""
        o, column = self.objects, self.servo.column
        return {
            "joint_velocity": self.qd, "object_quaternion": self.object_pose[:, 3:],
            "object_velocity_full": self.object_velocity, "object_size": o.size, "object_kind": self.kinds[o.variant],
            "object_mass": o.mass, "object_com": o.com, "object_friction": o.friction,
            "contact_stiffness": o.stiffness / 1e4, "contact_damping": o.damping_ratio,
            "push": self.engine.t.xfrc_applied[:, o.body, :3].float(), "finger_force": self.finger_force / self.f_max,
            "palm_force": self.palm_force / self.f_max, "kp": column("kp").float(),
            "torque_limit": column("torque_limit").float(), "target_error": self.target - self.q,
            "command_time": self.command_left,
        }  # fmt: skip

    # -- what the log shows
    def metrics(self) -> dict[str, torch.Tensor]:
        """Means over the worlds that are late enough in their episode."""
        sums = self.measured.sum(1)
        means = (sums[:-1] / sums[-1].clamp(min=1)).unbind()
        return {f"task/{name}": mean for name, mean in zip(grasp_rewards.METRICS, means, strict=True)}

    def notes(self) -> list[str]:
        """Say what a command of 1 means."""
        tau = self.tau_max[self.others[0]].item()
        return [f"F_max = {self.f_max:.2f} N a fingertip: static press at {tau:.2f} N.m (command 1)"]

    def describe(self) -> dict:
        """Return tables for the first screen."""
        return super().describe() | {"headline": ["task/held", "task/force_error"]}

    def scripted_policy(self, rate: float = 0.5, wait: float = 0.35) -> Callable[[Mapping], torch.Tensor]:
        """Return a policy without learning; see `tasks/grasp_eval.py`."""
        from dexsim.tasks.grasp_eval import scripted

        return scripted(self, rate, wait)
