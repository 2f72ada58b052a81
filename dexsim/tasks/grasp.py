"""Force-controlled grasp by inverted catching: an object is dropped on a palm-up hand, which must catch it, hold it
against pushes, and press with a commanded force.

Paper: "Force-Adaptive Grasping" (setup), table "Observation for force-adaptive grasping", equations of R_torque,
R_force, R_diff, R_outter, R_action, R_vel. Constants the paper does not publish are marked `ours` in
configs/task/grasp.yaml.
"""

from __future__ import annotations

import numpy as np
import torch

from dexsim import rotation
from dexsim.assets.objects import library
from dexsim.deploy import observations
from dexsim.errors import UserError
from dexsim.hand.places import approach
from dexsim.tactile.clearance import Clearance
from dexsim.tasks import base_path, terms
from dexsim.tasks.env import HandEnv
from dexsim.tasks.press import fingertip_press
from dexsim.tasks.servos import ServoRandomizer

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


class GraspEnv(HandEnv):
    """The grasp task; see the module."""

    def setup(self) -> None:
        t, n, dev = self.task, self.num_envs, self.device
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
        names = [v.shape.name for v in self.scene.variants]
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
        if t["critic"] not in ("paper", "privileged"):
            raise UserError(f"task.critic={t['critic']}: must be paper or privileged")
        base_path.of((t.get("evaluation") or {}).get("base", "turn"))  # refused now, not after the training
        self.gravity0 = torch.tensor([0.0, 0.0, -9.81], device=dev)
        where, xy, beside = self.places, t["initial"]["object_xy"], t["reward"]["centre_y"]
        self.centre0 = torch.tensor(where.catch[:2].tolist() if xy is None else xy, device=dev)
        self.reach = torch.tensor(where.middle.tolist(), device=dev)  # the middle of the grasp
        self.beside = float(where.beside[1]) if beside is None else beside
        self.across = torch.tensor([0.0, 1.0, 0.0], device=dev)
        h = 0.5**0.5  # rotations that bring the body's x, y or z axis to palm y
        to_y = torch.tensor([[h, 0.0, 0.0, h], [1.0, 0.0, 0.0, 0.0], [h, -h, 0.0, 0.0]], device=dev)
        self.lay = to_y[torch.tensor([int(v.shape.extents.argmax()) for v in self.scene.variants], device=dev)]
        pose = t["initial"]["pose"]
        angles = self.hand.pose("open").tolist() if pose is None else [pose[j] for j in self.hand.joints]
        self.pose0 = torch.tensor(angles, device=dev)

        def zeros(*shape, dtype=torch.float32):
            return torch.zeros(n, *shape, dtype=dtype, device=dev)

        self.command, self.command_left = zeros(), zeros()
        self.push, self.push_left, self.push_wait = zeros(3), zeros(), zeros()
        self.first_xy, self.z_seen, self.vz_seen = zeros(2), zeros(), zeros()
        lag = max(1, int(round(t["sensors"]["vision_delay"][1] / self.dt)) + 1)
        self.z_history, self.z_delay = zeros(lag + 1), zeros(dtype=torch.long)
        self.torque_bias = zeros(self.num_actions)
        self.outside_force = zeros(3)  # N on the object's body frame, on top of the random pushes (evaluation)
        self.fixed_command: torch.Tensor | None = None  # [N], or None to resample within the episode
        self.pushes = True

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
        s, t = self.sampler, self.task
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
        gravity.copy_(torch.where(mask[:, None], self.gravity0.to(gravity.dtype), gravity))

        hand = self.pose0 + s.draw("initial.joint", self.num_actions)
        hand = torch.maximum(torch.minimum(hand, self.q_high), self.q_low)
        # the drop: the lowest point of the object starts `drop` above the palm
        xy = self.centre0 + self.unit * s.draw("initial.object_xy", 2)
        z = self.objects.radius + self.unit * s.draw("initial.drop") + self.rise
        pose = torch.cat([xy, z[:, None], self._orientation()], 1)
        velocity = torch.cat(
            [s.draw("initial.velocity_xy", 2), s.draw("initial.velocity_z")[:, None], s.draw("initial.spin", 3)], 1
        )
        self.place(mask, hand, pose, velocity)
        self.first_xy.copy_(torch.where(mask[:, None], xy + s.draw("sensors.vision_xy", 2), self.first_xy))
        self.z_history.copy_(torch.where(mask[:, None], z[:, None].expand_as(self.z_history), self.z_history))
        low, high = (round(x / self.dt) for x in t["sensors"]["vision_delay"])
        delay = (low + (high - low + 1) * s.uniform()).long().clamp(low, high)
        self.z_delay.copy_(torch.where(mask, delay, self.z_delay))
        self.z_seen.copy_(torch.where(mask, z, self.z_seen))
        bias = s.draw("sensors.torque_bias", self.num_actions)
        self.torque_bias.copy_(torch.where(mask[:, None], bias, self.torque_bias))
        self._new_command(mask)
        self._new_push(mask)

    def _orientation(self) -> torch.Tensor:
        """Random orientations [N, 4]: the object's longest axis lies across the fingers (palm y) up to a tilt of
        `initial.tilt` rad about a random axis; about its longest axis it is turned at random. A tilt of pi is any
        orientation."""
        s = self.sampler
        lay = self.lay[self.objects.variant]
        roll = rotation.about(self.across.expand(self.num_envs, 3), 2 * torch.pi * s.uniform())
        tilt = rotation.about(s.direction(), s.draw("initial.tilt"))
        return rotation.multiply(tilt, rotation.multiply(roll, lay))

    def _new_command(self, mask: torch.Tensor) -> None:
        c, s = self.task["command"], self.sampler
        value = c["low"] + (c["high"] - c["low"]) * s.uniform() if self.fixed_command is None else self.fixed_command
        self.command.copy_(torch.where(mask, value, self.command))
        hold = c["hold_s"][0] + (c["hold_s"][1] - c["hold_s"][0]) * s.uniform()
        self.command_left.copy_(torch.where(mask, hold, self.command_left))

    def _new_push(self, mask: torch.Tensor) -> None:
        """A push in a random direction, of a multiple of the object's weight, after a random wait."""
        s = self.sampler
        size = s.draw("push.weights") * self.objects.mass * 9.81
        self.push.copy_(torch.where(mask[:, None], s.direction() * size[:, None], self.push))
        self.push_left.copy_(torch.where(mask, s.draw("push.duration"), self.push_left))
        self.push_wait.copy_(torch.where(mask, s.draw("push.wait"), self.push_wait))

    def memory(self) -> dict:
        names = ("command", "command_left", "push", "push_left", "push_wait", "first_xy", "z_seen", "vz_seen")
        own = {name: getattr(self, name) for name in (*names, "z_history", "torque_bias", "outside_force")}
        return super().memory() | own | {"z_delay": (self.z_delay, 0, self.z_history.shape[1] - 1)}

    def before_physics(self) -> None:
        self.command_left -= self.dt
        self._new_command(self.command_left <= 0)
        self.push_wait -= self.dt
        on = self.push_wait <= 0
        if not self.pushes:
            on = torch.zeros_like(on)
        self.push_left -= self.dt * on
        over = self.push_left <= 0
        force = torch.where((on & ~over)[:, None], self.push, torch.zeros_like(self.push)) + self.outside_force
        self.engine.t.xfrc_applied[:, self.objects.body, :3] = force.to(self.engine.t.xfrc_applied.dtype)
        self._new_push(over)

    # -- terminations
    # --------------------------------------------------------------------------------------------------------
    def terminated(self) -> dict[str, torch.Tensor]:
        """Dropped: the object's centre is below the palm or far from it."""
        limit = self.task["termination"]
        p = self.object_pose[:, :3]
        away = (p - self.reach).norm(dim=1) > self.unit * limit["distance"]
        # while a world's gravity is turned, "below" means away from the palm
        return {"dropped": away | (p[:, 2] < self.unit * limit["below"] + self.rise)}

    # -- rewards
    # ---------------------------------------------------------------------------------------------------------------
    def rewards(self) -> dict[str, torch.Tensor]:
        w, r = self.task["rewards"], self.task["reward"]
        force, contact = self.tip_force, self.tip_force > r["contact_threshold"]
        torque = self.torque[:, self.roots] * self.root_closes
        opposed, pressed = contact[:, self.opposing].any(1), contact[:, self.others]
        aside = force[:, self.others] / self.f_max - self.command[:, None]
        out = {
            # R_force and R_torque: sum over fingers of R_i * contact_i (paper, eqs. for R_force, R_torque)
            "force": w["force"]
            * terms.tracking(
                force, self.command, self.f_max, r["force_sigma"], r["force_low"], r["force_high"], contact
            ),
            "torque": w["torque"]
            * terms.tracking(
                torque / self.tau_max, self.command, 1.0, r["torque_sigma"], r["torque_low"], r["torque_high"], contact
            ),
            # R_diff: variance of the first joints of the fingers beside the opposing one
            "diff": w["diff"] * (self.q[:, self.inner] * self.inner_closes).var(dim=1, unbiased=False),
            # R_outter: distance of the second joints from their mid-range, not squared
            "outer": w["outer"] * (self.q[:, self.outer] - self.q_mid[self.outer]).norm(dim=1),
            "termination": w["termination"] * self._ended(),
            "action": w["action"] * (self.action - self.last_action).square().sum(1),  # R_action
            "velocity": w["velocity"] * self.qd.square().sum(1),  # R_vel
            # ours: touching with thumb and fingers at all, and keeping the object where the hand can hold it
            "grip": w["grip"] * opposed * pressed.float().mean(1),
            "force_near": w["force_near"] * (1 - aside.abs()).clamp(min=0).mean(1),
            # a finger that does not touch has nothing else that says which way the object lies
            "reach": w["reach"]
            * torch.exp(
                -self.clearance.distance[:, self.others].clamp(min=0) / (self.unit * r["reach_length"])
            ).mean(1),
            "self": w["self"] * (self.self_force.sum(1) / self.f_max).clamp(max=5.0),
            "still": w["still"] * (self.object_velocity[:, :3].norm(dim=1).clamp(max=1.0)),
        }
        if "worst" in w:  # checkpoints from before have neither of the two
            # the mean hides one finger that presses on nothing
            out["worst"] = w["worst"] * (1 - aside.abs().amax(1)).clamp(min=0)
            # an object that lies to one side is out of the reach of the outer fingers
            out["centre"] = w["centre"] * (
                (self.object_pose[:, 1] - self.beside).abs() / (self.unit * CENTRE_LENGTH)
            ).clamp(max=2.0)
        self._measure(opposed, pressed)
        return out

    def _ended(self) -> torch.Tensor:
        return self.terminated()["dropped"].float()

    # -- observations
    # ----------------------------------------------------------------------------------------------------------
    def observe(self, advance: bool) -> dict[str, torch.Tensor]:
        s, sense, J = self.sampler, self.task["sensors"], self.num_actions
        z = self.object_pose[:, 2]
        if advance:
            self.z_history.copy_(torch.cat([z[:, None], self.z_history[:, :-1]], 1))
            seen = self.z_history.gather(1, self.z_delay[:, None])[:, 0] + sense["vision_z_noise"] * s.normal()
            self.vz_seen.copy_(observations.height_speed(seen, self.z_seen, self.dt))
            self.z_seen.copy_(seen)
        fresh = self.episode_length_buf == 0
        vz = torch.where(fresh, torch.zeros_like(z), self.vz_seen)
        torque_max = self.effort
        actor = observations.build(
            observations.Signals(
                joint_position=self.q + sense["joint_noise"] * s.normal(J),
                joint_torque=self.torque / torque_max + self.torque_bias + sense["torque_noise"] * s.normal(J),
                object_xy=self.first_xy,
                object_z=self.z_seen,
                object_vz=vz,
                touch_force=self.touch.force[:, : self.pads],
                touch_centre=self.touch.centre[:, : self.pads],
                fingertip=self.tips + sense["tip_noise"] * s.normal(3 * self.fingers).reshape(self.tips.shape),
                command=self.command,
            ),
            self.f_max,
        )  # the deployed loop builds its own with the same function
        critic = [
            self.q, self.torque / torque_max, self.object_pose[:, :3], self.object_velocity[:, :3],
            self.touch.force_clean[:, : self.pads] / self.f_max, self.touch.centre_clean[:, : self.pads].flatten(1),
            self.tips.flatten(1),
            self.command[:, None],
        ]  # fmt: skip
        if self.task["critic"] == "privileged":
            critic += self._privileged()
        ok = ~self.nan[:, None]
        return {
            "actor": torch.where(ok, actor, torch.zeros_like(actor)),
            "critic": torch.nan_to_num(torch.cat(critic, 1)),
        }

    def rows(self) -> list[tuple[str, int, str, str]]:
        """(name, width, unit, what it is on hardware) of the actor's observation."""
        return observations.rows(self.num_actions, self.fingers, self.pads)

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
    def _measure(self, opposed: torch.Tensor, pressed: torch.Tensor) -> None:
        late = self.episode_length_buf * self.dt > 2.0
        count = late.sum().clamp(min=1)

        def mean(x):
            return (x * late).sum() / count

        self._metrics = {
            "task/held": mean((opposed & pressed.any(1)).float()),
            "task/force_error": mean(
                (self.tip_force[:, self.others] - self.command[:, None] * self.f_max).abs().mean(1)
            ),
            "task/fingers_touching": mean(pressed.float().sum(1)),
            "task/force_other": mean(self.self_force.sum(1)),
        }

    def metrics(self) -> dict[str, torch.Tensor]:
        return self._metrics

    def describe(self) -> dict:
        """Tables for the first screen."""
        r = self.task["rewards"]
        notes = {
            "force": "R_force",
            "torque": "R_torque",
            "diff": "R_diff",
            "outer": "R_outter",
            "termination": "terminal penalty",
            "action": "R_action",
            "velocity": "R_vel",
            "grip": "ours: thumb and fingers touch",
            "still": "ours: object speed",
            "force_near": "ours: 1 - |F_i - F_cmd F_max| / F_max, mean of the fingers",
            "reach": "ours: pads near the object",
            "worst": "ours: force_near of the finger that is furthest off",
            "centre": f"ours: object beside the fingers' middle, over {self.unit * CENTRE_LENGTH:.3g} m",
            "self": "ours: tips pressing on the hand",
        }
        table = self.rows()
        groups = {"actor": [(name, width, f"{unit}; {text}") for name, width, unit, text in table]}
        critic = [(name, width, f"{unit}; clean") for name, width, unit, _ in table]
        if self.task["critic"] == "privileged":
            critic += [(name, width, "privileged") for name, width in privileged(self.num_actions, self.fingers)]
        groups["critic"] = critic
        act = self.task["action"]
        return {
            "observations": groups,
            "action": [
                (j, float(lo), float(hi), f"rad ({act['mode']})")
                for j, lo, hi in zip(self.hand.joints, self.q_low.tolist(), self.q_high.tolist(), strict=True)
            ],
            "rewards": [(k, w, notes[k]) for k, w in r.items()],
            "terminations": [
                (
                    "dropped",
                    f"centre below {self.unit * self.task['termination']['below'] + self.rise:.3g} m or"
                    f" {self.unit * self.task['termination']['distance']:.3g} m away",
                ),
                ("nan", "state not finite"),
                ("time_out", f"{self.max_episode_length} steps"),
            ],
            "randomization": [
                (name, f"[{lo:g}, {hi:g}]" + (" log" if log else ""), "")
                for name, (lo, hi, log) in self.sampler.ranges.items()
            ],
            "notes": [
                f"F_max = {self.f_max:.2f} N a fingertip: static press at {self.tau_max[self.others[0]].item():.2f} N.m"
                " (command 1)",
                *self.hand_notes(),
            ],
            "headline": ["task/held", "task/force_error"],
        }

    def evaluate(self, policy, episodes: int = 256, seed: int = 0, progress=None) -> dict:
        """Play `episodes` episodes; see `tasks/grasp_eval.py`."""
        from dexsim.tasks.grasp_eval import evaluate

        return evaluate(self, policy, episodes, seed, progress)

    def scripted_policy(self, rate: float = 0.5, wait: float = 0.35):
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
        closing = torch.as_tensor(closing, dtype=torch.float32, device=self.device)
        age = torch.zeros(self.num_envs, device=self.device)

        def policy(obs) -> torch.Tensor:
            x = obs["actor"]
            # a finite difference of a noisy height is exactly zero only where an episode has just begun
            age.copy_(torch.where(x[:, vz] == 0, torch.zeros_like(age), age + self.dt))
            light = x[:, torque : torque + self.num_actions].abs() < (0.1 + 0.6 * x[:, command])[:, None]
            return closing * (light & (age >= wait)[:, None])

        return policy
