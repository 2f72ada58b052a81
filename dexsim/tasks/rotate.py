"""In-hand cube rotation: turn a cube, or a user's own objects, on a palm-up hand about one axis of the palm, 90 degrees
at a time.

Paper: "In-Hand Object Rotation" (setup), tables "Observation for in-hand object rotation" and "Reward for in-hand
object rotation", and the ablation's settings. Constants the paper does not publish are marked `ours` in
configs/task/rotate.yaml.

Actions are relative (`action.mode`): a target moves by action * scale a step. Action zero then holds the grasp an
episode starts with, and exploration begins from a held cube; absolute actions would throw it at once.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch

from dexsim import rotation
from dexsim.assets.objects.own import is_own
from dexsim.errors import UserError
from dexsim.hand.skin import tip_skins
from dexsim.tactile.layout import hand_layout, tip_layout
from dexsim.tasks import observations_rotate as observations
from dexsim.tasks.env import HandEnv
from dexsim.tasks.observations_rotate import ORIENTATION
from dexsim.tasks.servos import ServoRandomizer
from dexsim.tasks.stable_grasps import CUBE, GraspSet, called, held_poses

LEAST = 0.4  # of an object's smallest extent: its centre is never lower over the palm while it lies there


def critic(joints: int, fingers: int) -> tuple[tuple[str, int, str, str], ...]:
    """(name, width, unit, what) of what the critic sees beyond the actor's rows, which it gets clean and whole."""
    return (
        ("object_orientation", 6, "1", "6D, palm frame"),
        ("fingertip_velocity", 6 * fingers, "m/s, rad/s", "linear and angular of each"),
        ("fingertip_rotation", 6 * fingers, "1", "6D of each"),
        ("joint_velocity", joints, "rad/s", ""),
        ("object_velocity", 3, "m/s", ""),
        ("object_spin", 3, "rad/s", ""),
    )


def privileged(joints: int, fingers: int) -> tuple[tuple[str, int], ...]:
    """(name, width) of what else it sees with task.critic=privileged, ours."""
    return (
        ("drift", 3), ("object_size", 1), ("object_mass", 1), ("object_com", 3), ("object_friction", 1),
        ("contact_damping", 1),
        ("finger_force", fingers), ("palm_force", 1), ("torque", joints), ("target_error", joints),
    )  # fmt: skip


class RotateEnv(HandEnv):
    """Turn a cube on the palm about one axis, 90 degrees at a time.

    goal [N, 4]: orientation to reach (object to palm); home [N, 3]: where the cube lay when the episode began, m;
    successes [N]: goals reached in this episode.
    """

    TAKES_OBJECTS = True
    PERCEPTION: tuple[str, ...] = ("imu", "proprioception")
    ENDS: tuple[str, ...] = ("dropped", "tipped", "nan")
    """How a trial can end but for the cap, in the order of `end_kind`."""

    def __init__(
        self, cfg: dict, n_worlds: int, device: str, seed: int, engine: str = "auto", grasps: GraspSet | None = None
    ):
        """grasps: start from these instead of the file `task.initial.poses`."""
        self.check_objects(cfg["task"])
        self.grasps, self.in_order = grasps, False
        if not cfg["task"]["observe"]["force_weighted"]:  # the plain mean needs every taxel
            cfg = {**cfg, "tactile": {**cfg["tactile"], "raw": True}}
        super().__init__(cfg, n_worlds, device, seed, engine)

    @classmethod
    def check_deployed(cls, source: str) -> None:
        """It can."""

    @classmethod
    def check_objects(cls, task: dict) -> None:
        """Raises UserError for objects that this task cannot turn."""
        objects, tips = task["objects"], not cls.TAKES_OBJECTS
        if not objects["train"]:
            raise UserError(f"task.objects.train=[]: must name '{CUBE}'{'' if tips else ' or mesh files'}")
        for key in ("train", "held_out"):
            for name in objects[key]:
                if name != CUBE and (tips or not is_own(name)):
                    raise UserError(
                        f"task.objects.{key}: '{name}': this task turns '{CUBE}'"
                        f"{'' if tips else ' or the path of a mesh'}"
                    )
        names = [called(name) for name in dict.fromkeys((*objects["train"], *objects["held_out"]))]
        if len(set(names)) < len(names):
            raise UserError(
                f"task.objects: {', '.join(names)}: two of one name, and held poses know a mesh by its file's name;"
                " rename one"
            )

    @classmethod
    def prepare(cls, cfg: dict, **given: Any) -> None:
        """Search for the held poses of a hand that has none yet."""
        if given.get("grasps") is None and cfg["task"]["initial"]["poses"] is None:
            from dexsim.tasks.make_grasps import ensure

            ensure(cfg)

    def setup(self) -> None:
        t, n, dev, F = self.task, self.num_envs, self.device, self.fingers
        self._check()
        self.servo_random = ServoRandomizer(self.servo, self.sampler)
        edges = [self.unit * x for x in self.sampler.range("object.size")[:2]]
        if self.grasps is None:
            self.grasps = held_poses(self.hand, t["initial"]["poses"]).within(*edges).to(dev)
            source = t["initial"]["poses"] or f"of hand={self.hand.name}"
            self.grasps = self.grasps.numbered(self.names, source)
        self.box_half = torch.ones(1, 3, device=dev)
        if CUBE in self.names:
            box = torch.full((1,), self.names.index(CUBE), device=dev)
            self.box_half = self.objects.primitive_size(box, torch.ones(1, 3, device=dev))
        below = self.unit * t["termination"]["below"]
        self.lowest = torch.tensor(
            [below + self.rise if v.shape.name == CUBE else
             min(below, LEAST * float(min(v.shape.extents)) * v.scale) + self.rise
             for v in self.objects.scene.variants],
            device=dev,
        )  # fmt: skip
        ends = t["termination"]
        self.farthest = torch.tensor(self.unit * (ends.get("training") or ends["distance"]), device=dev)
        trained = self.grasps.shape < len(t["objects"]["train"])
        self.poses_of = torch.nonzero(trained)[:, 0], torch.nonzero(~trained)[:, 0]
        self.judge_kept_out(False)
        axis = torch.tensor([float(x) for x in t["goal"]["axis"]], device=dev)
        self.axis = axis / axis.norm()
        self.up = torch.tensor([0.0, 0.0, 1.0], device=dev)  # an IMU knows where down is, but not its heading
        self.turn = rotation.about(self.axis, torch.tensor(math.radians(t["goal"]["angle"]), device=dev))
        self.gravity = torch.tensor([0.0, 0.0, -9.81], device=dev)

        def zeros(*shape: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
            return torch.zeros(n, *shape, dtype=dtype, device=dev)

        self.worlds = torch.arange(n, device=dev)
        self.learned = torch.zeros((), device=dev)  # control steps of each world while training, for the curriculum
        self.goal, self.home = zeros(4), zeros(3)
        self.goal[:, 0] = 1.0
        self.successes, self.since = zeros(dtype=torch.long), zeros(dtype=torch.long)
        self.last_done = zeros(dtype=torch.long)  # successes of each world's last ended episode
        self.reached, self.dropped, self.tipped, self.nan_end = (zeros(dtype=torch.bool) for _ in range(4))
        self.d_rot, self.d_pos = zeros(), zeros()
        self.tip_rot, self.tip_last, self.tip_rot_last = zeros(F, 3, 3), zeros(F, 3), zeros(F, 3, 3)
        self.tip_velocity = zeros(F, 6)
        lag = max(1, math.ceil(self.sampler.range("imu.delay")[1] / self.dt) + 1)
        self.imu_past, self.imu_delay = zeros(lag + 1, 4), zeros(dtype=torch.long)
        self.imu_past[..., 0] = 1.0
        self.heading, self.heading_rate, self.goal_heading, self.imu_tilt = zeros(), zeros(), zeros(), zeros(3)
        self.seen = zeros(4)
        self.seen[:, 0] = 1.0
        self.joint_bias = zeros(self.num_actions)
        observe = t["observe"]
        frame = sum(row[1] for row in observations.rows(t, *self.sizes, frames=1))
        self.past = zeros(t["history"], frame) if t["perception"] == "proprioception" else None
        self.taxel_point = None
        if not observe["force_weighted"]:
            layout = hand_layout(self.hand) or tip_layout(self.hand)
            felt = layout.lifted(tip_skins(self.hand)) if self.touch.cfg.lift and self.pads else layout
            self.taxel_point = torch.as_tensor(felt.point, dtype=torch.float32, device=dev)  # [F, T, 3], link frame
            self.pad_centre = torch.as_tensor(layout.centre(), dtype=torch.float32, device=dev)

    @property
    def sizes(self) -> tuple[int, int, int]:
        """Joints, fingers and touch pads."""
        return self.num_actions, self.fingers, self.pads

    @property
    def names(self) -> tuple[str, ...]:
        """What held poses call the objects, in the order of the scene's table; those trained on first."""
        return tuple(called(name) for name in self.shape_names)

    def judge_kept_out(self, kept_out: bool) -> None:
        """Episodes begin with objects kept out of the training from now on, or with those of it."""
        self.allowed = self.poses_of[kept_out]  # one and the same tensor each time: a recorded step holds on to it

    def _check(self) -> None:
        t = self.task
        for key, known in (("perception", self.PERCEPTION), ("critic", ("paper", "privileged"))):
            if t[key] not in known:
                raise UserError(f"task.{key}={t[key]}: must be {' or '.join(known)}")
        orientation = t["observe"]["orientation"]
        if orientation not in ORIENTATION:
            raise UserError(f"task.observe.orientation={orientation}: must be {', '.join(ORIENTATION)}")
        c = t.get("curriculum") or {"steps": 0, "start": 1.0}
        if not (c["steps"] >= 0 and 0 <= c["start"] <= 1):
            raise UserError(f"task.curriculum={c}: steps must be 0 (none) or more, start must lie in [0, 1]")
        if t["observe"].get("last_action", "step") not in ("target", "step"):
            raise UserError(f"task.observe.last_action={t['observe']['last_action']}: must be target or step")
        if t["perception"] == "proprioception" and not 1 <= t["history"] <= 32:
            raise UserError(f"task.history={t['history']}: must lie in [1, 32]")
        ends = t["termination"]
        if ends.get("training") is not None and not 0 < ends["training"] <= ends["distance"]:
            raise UserError(
                f"task.termination.training={ends['training']}: must be above 0 and at most task.termination.distance,"
                f" {ends['distance']} m, or null for that one"
            )
        goal = t["goal"]
        if len(goal["axis"]) != 3 or not sum(float(x) ** 2 for x in goal["axis"]) > 0:
            raise UserError(f"task.goal.axis={goal['axis']}: must be three numbers, not all 0")
        if not 0 < abs(goal["angle"]) < 180:
            raise UserError(f"task.goal.angle={goal['angle']}: must lie in (0, 180) degrees, or be its negative")
        r = t["reward"]
        if not r["epsilon"] > 0:
            raise UserError(f"task.reward.epsilon={r['epsilon']}: must be above 0")
        if not 0 < r["delta_rot"] < math.radians(abs(goal["angle"])):
            raise UserError(
                f"task.reward.delta_rot={r['delta_rot']}: must lie between 0 and the goal's angle, "
                f"{math.radians(abs(goal['angle'])):.3g} rad, or goals are reached as they are set"
            )
        for name, low, high in (
            ("object.mass", 1e-3, 5.0),
            ("object.friction", 0.05, 3.0),
            ("object.com", -0.25, 0.25),
            ("contact.stiffness", 100.0, 1e5),
            ("contact.damping_ratio", 0.0, 3.0),
            ("imu.delay", 0.0, 0.5),
            ("imu.heading_rate", -0.2, 0.2),
            ("imu.tilt", -0.3, 0.3),
        ):
            self.sampler.check(name, low, high)

    # -- randomization, widened as training goes on
    # -------------------------------------------------------------------------
    def before_physics(self) -> None:
        c = self.task.get("curriculum") or {"steps": 0}
        if c["steps"]:
            self.learned += 1
            self.sampler.width.copy_((c["start"] + (1 - c["start"]) * self.learned / c["steps"]).clamp(max=1.0))

    def end_curriculum(self) -> None:
        """From now on all ranges whole, and the cube may go as far as `termination.distance` (evaluation)."""
        self.learned.fill_(float((self.task.get("curriculum") or {"steps": 0})["steps"]))
        self.sampler.width.fill_(1.0)
        self.farthest.fill_(self.unit * self.task["termination"]["distance"])

    def memory(self) -> dict:
        names = ("goal", "home", "heading", "heading_rate", "goal_heading", "imu_tilt", "imu_past", "seen")
        more = ("joint_bias", "tip_rot", "tip_last", "tip_velocity")
        own: dict = {name: getattr(self, name) for name in names + more}
        own |= {name: (getattr(self, name), 0, 2**31) for name in ("successes", "since", "last_done")}
        own["imu_delay"] = self.imu_delay, 0, self.imu_past.shape[1] - 1
        return super().memory() | own | ({} if self.past is None else {"past": self.past})

    def state_dict(self) -> dict[str, torch.Tensor]:
        return super().state_dict() | {"learned": self.learned.clone()}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        self.learned.copy_(state.get("learned", self.learned))
        super().load_state_dict(state)

    # -- episodes
    # ------------------------------------------------------------------------------------------------------------
    def begin_episodes(self, mask: torch.Tensor) -> None:
        s, m1 = self.sampler, mask[:, None]
        self.last_done.copy_(torch.where(mask, self.successes, self.last_done))
        g, of = self.grasps, self.allowed
        assert g is not None  # since setup
        pick = self.worlds if self.in_order else of[(s.uniform() * len(of)).long().clamp(max=len(of) - 1)]
        self.give_object(mask, g.shape[pick], g.edge[pick])
        self.touch.randomize(mask, self.rng)
        self.servo_random.draw(mask)
        gravity = self.engine.field("opt.gravity")
        gravity.copy_(torch.where(m1, self.gravity.to(gravity.dtype), gravity))
        pose = g.pose[pick]
        hand, target = g.hand[pick], g.target[pick] + s.draw("initial.target", self.num_actions)
        target = torch.maximum(torch.minimum(target, self.q_high), self.q_low)
        self.place(mask, hand, pose, torch.zeros_like(self.object_velocity), target)

        self.goal.copy_(torch.where(m1, self.next_goal(pose[:, 3:]), self.goal))
        self.home.copy_(torch.where(m1, pose[:, :3], self.home))
        for own in (self.successes, self.since, self.heading, self.goal_heading):
            own.masked_fill_(mask, 0)
        self.heading_rate.copy_(torch.where(mask, s.draw("imu.heading_rate"), self.heading_rate))
        self.imu_tilt.copy_(torch.where(m1, s.draw("imu.tilt", 3), self.imu_tilt))
        self.imu_tilt[:, 2] = 0.0  # heading has its own drift
        self.joint_bias.copy_(torch.where(m1, s.draw("sensors.joint_bias", self.num_actions), self.joint_bias))
        delay = (s.draw("imu.delay") / self.dt).round().long()
        self.imu_delay.copy_(torch.where(mask, delay, self.imu_delay))

    def give_object(self, mask: torch.Tensor, row: torch.Tensor, edge: torch.Tensor) -> None:
        """Where mask holds: an object by its row [N] of the scene's table, a cube of this edge [N] m, its mass, centre
        of mass, friction and rubber drawn anew."""
        s = self.sampler
        self.objects.write(
            mask,
            row,
            scale=edge[:, None] / 2 / self.box_half,
            mass=s.draw("object.mass"),
            com=s.draw("object.com", 3),
            friction=s.draw("object.friction"),
            stiffness=s.draw("contact.stiffness"),
            damping_ratio=s.draw("contact.damping_ratio"),
        )
        self.touch.shape_id.copy_(self.objects.variant.to(torch.int32))
        self.touch.shape_size.copy_(self.objects.size)

    def next_goal(self, q: torch.Tensor) -> torch.Tensor:
        """The goal after orientation q [N, 4] was reached: q turned by the goal's angle about the palm's axis, its tilt
        against that axis removed unless `goal.keep_tilt`."""
        return observations.next_goal(q, self.axis, self.turn, self.task["goal"]["keep_tilt"])

    # -- terminations
    # --------------------------------------------------------------------------------------------------------
    def terminated(self) -> dict[str, torch.Tensor]:
        """Dropped: the centre is too low (of a flat object, lower yet) or too far from where it began. Tipped: the
        goal's upper face looks more than `tilt` away from the axis."""
        limit = self.task["termination"]
        p = self.object_pose[:, :3]
        away = (p - self.home).norm(dim=1) > self.farthest
        self.dropped.copy_(away | (p[:, 2] < self.lowest[self.objects.variant]))
        self.tipped.copy_(self._tilt_from_goal() > limit["tilt"])
        self.nan_end.copy_(self.nan)
        return {"dropped": self.dropped, "tipped": self.tipped}

    def end_kind(self) -> torch.Tensor:
        """Index into ENDS [N] of what ended the episodes that `terminated` has just ended."""
        return torch.where(self.nan_end, 2, torch.where(self.dropped, 0, 1))

    def _tilt_from_goal(self) -> torch.Tensor:
        """Angle between the palm axis as the goal's and as the present orientation have it in the object's frame."""
        a = rotation.rotate(rotation.conjugate(self.goal), self.axis.expand(self.num_envs, 3))
        b = rotation.rotate(rotation.conjugate(self.object_pose[:, 3:]), self.axis.expand(self.num_envs, 3))
        return torch.atan2(torch.linalg.cross(a, b).norm(dim=1), (a * b).sum(1))

    # -- rewards
    # ---------------------------------------------------------------------------------------------------------------
    def reward_words(self) -> dict[str, str]:
        return {
            "goal": "w_goal, close to goal",
            "action": "w_action",
            "bonus": "C_Bonus",
            "spin": "ours: turning about the axis",
            "lost": "ours: dropped or tipped",
            "velocity": "ours: joint speed",
            "torque": "ours: motor torque",
        }

    def rewards(self) -> dict[str, torch.Tensor]:
        w, r = dict.fromkeys(self.reward_words(), 0.0) | self.task["rewards"], self.task["reward"]
        q = self.object_pose[:, 3:]
        self.d_rot.copy_(rotation.error(q, self.goal))
        self.d_pos.copy_((self.object_pose[:, :3] - self.home).norm(dim=1))
        # goal: 1 / (|d_rot| + eps) * 1 / (1 + exp(alpha (d_goal - delta_dist))), table "Reward for in-hand object
        # rotation"
        close = 1 / (self.d_rot.abs() + r["epsilon"]) * torch.sigmoid(
            -r["alpha"] * (self.d_pos / self.unit - r["delta_dist"])
        )
        lost = self.dropped | self.tipped  # `terminated` comes first
        there = (self.d_rot < r["delta_rot"]) & (self.d_pos < self.unit * r["delta_pos"])
        self.reached.copy_(there & ~self.nan & ~lost)
        out = {
            "goal": w["goal"] * close,
            "action": w["action"] * (self.action - self.last_action).square().sum(1),
            "bonus": w["bonus"] * self.reached.float(),
        }
        # ours, beyond the table; a weight of 0 leaves a term out
        if w["spin"]:
            spin = (self._spin() * self.axis).sum(1) * math.copysign(1.0, self.task["goal"]["angle"])
            out["spin"] = w["spin"] * spin.clamp(-r["spin_max"], r["spin_max"])
        if w["lost"]:
            out["lost"] = w["lost"] * lost.float()
        if w["velocity"]:
            out["velocity"] = w["velocity"] * self.qd.square().sum(1)
        if w["torque"]:
            out["torque"] = w["torque"] * (self.torque / self.effort).square().sum(1)
        self._measure()
        self._advance_goal()
        return out

    def _advance_goal(self) -> None:
        """The next goal where this one was reached."""
        self.goal.copy_(torch.where(self.reached[:, None], self.next_goal(self.object_pose[:, 3:]), self.goal))
        self.goal_heading.copy_(torch.where(self.reached, self.heading, self.goal_heading))
        self.successes += self.reached
        self.since += 1
        self.since.masked_fill_(self.reached, 0)

    def _spin(self) -> torch.Tensor:
        """Angular velocity of the object in the palm frame [N, 3], rad/s (the engine has it in the object's)."""
        return rotation.rotate(self.object_pose[:, 3:], self.object_velocity[:, 3:])

    # -- observations
    # ----------------------------------------------------------------------------------------------------------
    def observe(self, advance: bool) -> dict[str, torch.Tensor]:
        n, t = self.num_envs, self.task
        s, sense = self.sampler, t["sensors"]
        fresh = self.episode_length_buf == 0
        if advance:
            self._feel_motion(fresh)
            if t["perception"] != "proprioception":
                self._read_imu(fresh)
        angle = self.q + self.joint_bias + sense["joint_noise"] * s.normal(self.num_actions)
        P, F = self.pads, self.fingers
        force, centre = self._felt()
        tips, sent = self.tips.flatten(1), self._last_action()
        imu = t["perception"] != "proprioception"
        past = tips[:, None, :0] if self.past is None else self.past
        actor = observations.build(
            observations.Signals(
                joint_position=angle,
                joint_velocity=self.qd if imu else self.qd + sense["velocity_noise"] * s.normal(self.num_actions),
                orientation=self.seen,
                goal=self._goal_seen(),
                sent=sent,
                touch_force=force,
                touch_centre=centre,
                fingertip=tips + sense["tip_noise"] * s.normal(3 * F) if imu else tips,
                past=past,
                fresh=fresh,
            ),
            t,
        )  # the deployed loop builds its own with the same function
        actor = torch.where(self.nan[:, None], torch.zeros_like(actor), actor)
        if advance and self.past is not None:
            self.past.copy_(actor.view_as(self.past))
        q = self.object_pose[:, 3:]
        critic = [
            self.q, rotation.six(rotation.multiply(rotation.conjugate(q), self.goal)), sent,
            self.touch.centre_clean[:, :P].flatten(1), self.touch.force_clean[:, :P], tips,
            rotation.six(q), self.tip_velocity.flatten(1), rotation.six_of_matrix(self.tip_rot).reshape(n, 6 * F),
            self.qd,
            self.object_velocity[:, :3], self._spin(),
        ]  # fmt: skip
        if t["critic"] == "privileged":
            o = self.objects
            critic += [
                self.object_pose[:, :3] - self.home,
                o.size[:, :1],
                o.mass[:, None],
                o.com,
                o.friction[:, None],
                o.damping_ratio[:, None],
                self.finger_force,
                self.palm_force[:, None],
                self.torque,
                self.target - self.q,
            ]
        return {"actor": actor, "critic": torch.nan_to_num(torch.cat(critic, 1))}

    def _last_action(self) -> torch.Tensor:
        """What was last sent to the drives [N, J]; see `observations_rotate.sent`."""
        return observations.sent(
            self.action, self.target, self.q_mid, self.q_half, self.task["observe"].get("last_action", "step")
        )

    def _feel_motion(self, fresh: torch.Tensor) -> None:
        """Fingertip velocities over the last control step: linear, and angular from the rotation between the two."""
        rot = self.engine.t.xmat[:, self.tip_body].float()
        rot = torch.where(self.nan[:, None, None, None], torch.zeros_like(rot), rot)
        new = fresh[:, None, None]
        step = rot @ torch.where(new[..., None], rot, self.tip_rot).transpose(-1, -2)
        linear = (self.tips - torch.where(new, self.tips, self.tip_last)) / self.dt
        # half the antisymmetric part is sin(angle) * axis: at 15 rad/s and 25 ms 2 % short of the angle
        twice = (
            step[..., 2, 1] - step[..., 1, 2],
            step[..., 0, 2] - step[..., 2, 0],
            step[..., 1, 0] - step[..., 0, 1],
        )
        turn = torch.stack(twice, -1) / 2
        self.tip_velocity.copy_(torch.cat([linear, turn / self.dt], -1))
        self.tip_rot.copy_(rot)
        self.tip_last.copy_(self.tips)

    def _read_imu(self, fresh: torch.Tensor) -> None:
        """Orientation as an IMU in the cube reports it: late, noisy, slightly tilted, its heading drifting."""
        sense, s = self.task["sensors"], self.sampler
        walk = sense["imu_heading_walk"] * math.sqrt(self.dt) * s.normal()
        self.heading += torch.where(fresh, torch.zeros_like(walk), self.heading_rate * self.dt + walk)
        off = rotation.from_vector(self.imu_tilt + sense["imu_noise"] * s.normal(3))
        drift = rotation.about(self.up.expand(self.num_envs, 3), self.heading)
        now = rotation.multiply(drift, rotation.multiply(off, self.object_pose[:, 3:]))
        now = torch.where(self.nan[:, None], torch.zeros_like(now), now)
        moved = torch.cat([now[:, None], self.imu_past[:, :-1]], 1)
        self.imu_past.copy_(torch.where(fresh[:, None, None], now[:, None].expand_as(moved), moved))
        pick = self.imu_delay[:, None, None].expand(-1, 1, 4)
        self.seen.copy_(rotation.normalize(self.imu_past.gather(1, pick)[:, 0]))

    def _goal_seen(self) -> torch.Tensor:
        """The goal [N, 4] as the actor has it: set from the IMU, so it carries the heading drift of that moment; what
        drifted since is error."""
        drift = rotation.about(self.up.expand(self.num_envs, 3), self.goal_heading)
        return rotation.multiply(drift, self.goal)

    def _relative(self) -> torch.Tensor:
        """R_object^T R_goal as the actor sees it."""
        return observations.relative(self.seen, self._goal_seen(), self.task["observe"]["orientation"])

    def _felt(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Contact force [N, P] N and centre [N, 3 P] m as the actor has them."""
        centre = self.touch.centre.flatten(1) if self.taxel_point is None else self._plain_centre()
        return self.touch.force[:, : self.pads], centre[:, : 3 * self.pads]

    def _plain_centre(self) -> torch.Tensor:
        """Contact centres [N, 3 F] without force weighting: the mean position of the taxels that feel anything."""
        assert self.touch.raw is not None  # asked for with observe.force_weighted=false
        on = (self.touch.raw > 0).float()
        count = on.sum(-1, keepdim=True)
        mean = torch.einsum("nft,ftc->nfc", on, self.taxel_point) / count.clamp(min=1)
        local = torch.where(count > 0, mean, self.pad_centre)
        pos, rot = self.engine.t.xpos[:, self.tip_body].float(), self.engine.t.xmat[:, self.tip_body].float()
        return (pos + (rot @ local[..., None])[..., 0]).flatten(1)

    # -- what the log shows
    # ------------------------------------------------------------------------------------------------------
    def _measure(self) -> None:
        touching = (self.touch.force_clean > 0.05).float().sum(1)
        self._metrics = {
            "task/successes_per_minute": self.reached.float().mean() * (60 / self.dt),
            "task/successes": self.last_done.float().mean(),
            "task/rotation_error": self.d_rot.mean(),
            "task/drift": self.d_pos.mean(),
            "task/spin": (self._spin() * self.axis).sum(1).mean(),
            "task/tips_touching": touching.mean(),
        }

    def metrics(self) -> dict[str, torch.Tensor]:
        return self._metrics

    def describe(self) -> dict:
        """Tables for the first screen."""
        t = self.task
        whole = [row for row in observations.actor(*self.sizes) if row[1]]
        seen = [(name, width, f"{unit}; clean") for name, width, unit, _ in whole]
        seen += [row[:3] for row in critic(*self.sizes[:2])]
        if t["critic"] == "privileged":
            seen += [(name, width, "privileged") for name, width in privileged(*self.sizes[:2])]
        limit, r = t["termination"], t["reward"]
        actor = [(name, width, f"{unit}; {text}") for name, width, unit, text in observations.rows(t, *self.sizes)]
        assert self.grasps is not None  # since setup
        edge, what = 1000 * self.grasps.edge, "cubes" if self.names == (CUBE,) else ", ".join(self.names)
        return {
            "observations": {"actor": actor, "critic": seen},
            "action": self.action_rows(),
            "rewards": [row for row in self.reward_rows() if row[1]],
            "terminations": [
                ("dropped", f"centre {float(self.farthest):.3g} m from its start or below"
                 f" {self.unit * limit['below'] + self.rise:.3g} m"),
                ("tipped", f"{limit['tilt']} rad away from lying on its face"),
                *self.usual_ends(),
            ],
            "randomization": self.sampler.rows(),
            "notes": [
                f"{len(self.grasps)} held poses, {what} of {edge.min():.0f}-{edge.max():.0f} mm",
                f"reached: rotation error below {r['delta_rot']} rad and drift below"
                f" {self.unit * r['delta_pos']:.3g} m",
                *self.hand_notes(),
            ],
        }

    def trial_facts(self) -> dict[str, torch.Tensor]:
        """What an evaluation keeps of each trial as it begins, [N] each."""
        return {}

    def trial_counts(self) -> dict[str, torch.Tensor]:
        """What an evaluation counts, step by step, while a trial lasts, bool [N] each."""
        return {}

    def of_trials(self, r: dict) -> dict:
        """Further metrics of an evaluation, from the arrays [E] of its trials."""
        return {}

    def evaluate(
        self,
        policy: Callable[..., torch.Tensor],
        episodes: int = 256,
        seed: int = 0,
        progress: Callable[..., None] | None = None,
    ) -> dict:
        """Play `episodes` trials; see `tasks/rotate_eval.py`."""
        from dexsim.tasks.rotate_eval import evaluate

        return evaluate(self, policy, episodes, seed, progress)
