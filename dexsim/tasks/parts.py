"""Parts that tasks are put together from, beside `Task` itself: a held object to begin with, sensors with memory."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import torch

from dexsim import rotation
from dexsim.assets.objects.own import is_own
from dexsim.errors import UserError
from dexsim.hand.skin import tip_skins
from dexsim.tactile.layout import hand_layout, tip_layout
from dexsim.tasks.stable_grasps import CUBE, GraspSet, called, held_poses
from dexsim.tasks.task import Task
from dexsim.tasks.terms import fingers, joints, memory

LEAST = 0.4  # of an object's smallest extent: its centre is never lower over the palm while it lies there


class Held(Task):
    """A task whose episodes begin with a cube, or a user's own objects, held in one of the poses of a file.

    grasps: those poses; in_order: world i begins with row i of them.
    """

    in_order = False
    begun_with = memory(dtype=torch.long, reset=False)  # row of `grasps` that each world's episode began with
    holds: ClassVar[tuple[str, tuple[float, float]]]
    """Carrier of the object as an episode begins (`dexsim stable-grasps hold=`), usual edges of cubes, m."""

    def __init__(
        self, cfg: dict, n_worlds: int, device: str, seed: int, engine: str = "auto", grasps: GraspSet | None = None
    ):
        """Take the held poses; grasps: start from these instead of the file `task.initial.poses`."""
        self.check_objects(cfg["task"])
        if self.needs_taxels(cfg["task"]):
            cfg = {**cfg, "tactile": {**cfg["tactile"], "raw": True}}
        super().__init__(cfg, n_worlds, device, seed, engine, grasps)

    @classmethod
    def needs_taxels(cls, task: dict) -> bool:
        """Tell whether the task needs every taxel's force, beside sums and centres of pads."""
        return False

    @classmethod
    def check_objects(cls, task: dict) -> None:
        """Raise UserError for objects that this task cannot turn."""
        objects, tips = task["objects"], not cls.TAKES_OBJECTS
        if not objects["train"]:
            raise UserError(f"task.objects.train=[]: must name '{CUBE}'{'' if tips else ' or mesh files'}")
        for key in ("train", "held_out"):
            for name in objects[key]:
                if name != CUBE and (tips or not is_own(name)):
                    more = "" if tips else " or the path of a mesh"
                    raise UserError(f"task.objects.{key}: '{name}': this task turns '{CUBE}'{more}")
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

    def set_objects(self) -> None:
        """Set the held poses that episodes begin with, and how low each object may lie."""
        t, dev = self.task, self.device
        if self.grasps is None:
            edges = [self.unit * x for x in self.sampler.range("object.size")[:2]]
            found = held_poses(self.hand, t["initial"]["poses"]).within(*edges).to(dev)
            self.grasps = found.numbered(self.names, t["initial"]["poses"] or f"of hand={self.hand.name}")
        self.box_half = torch.ones(1, 3, device=dev)
        if CUBE in self.names:
            box = torch.full((1,), self.names.index(CUBE), device=dev)
            self.box_half = self.objects.primitive_size(box, torch.ones(1, 3, device=dev))
        below = self.unit * t["termination"]["below"]
        lies = [below if v.shape.name == CUBE else min(below, LEAST * float(min(v.shape.extents)) * v.scale)
                for v in self.objects.scene.variants]  # fmt: skip
        self.lowest = torch.tensor([x + self.rise for x in lies], device=dev)
        trained = self.grasps.shape < len(t["objects"]["train"])
        self.poses_of = torch.nonzero(trained)[:, 0], torch.nonzero(~trained)[:, 0]
        self.judge_kept_out(False)

    @property
    def names(self) -> tuple[str, ...]:
        """What held poses call the objects, in the order of the scene's table; those trained on first."""
        return tuple(called(name) for name in self.shape_names)

    def judge_kept_out(self, kept_out: bool) -> None:
        """Begin episodes with objects kept out of the training from now on, or with those of it."""
        self.allowed = self.poses_of[kept_out]  # one and the same tensor each time: a recorded step holds on to it

    def draw_object(self, mask: torch.Tensor) -> None:
        g, of = self.grasps, self.allowed
        assert g is not None  # since setup
        if self.in_order:
            self._pick = torch.arange(self.num_envs, device=self.device)
        else:
            drawn = of[(self.sampler.uniform() * len(of)).long().clamp(max=len(of) - 1)]
            self._pick = self.once_more(drawn)
            self.begun_with = torch.where(mask, self._pick, self.begun_with)
        self.draw_physics()
        self.give_object(mask, g.shape[self._pick], g.edge[self._pick][:, None] / 2 / self.box_half)

    def memory(self) -> dict:
        """Return the declared memory; a row within those of `grasps`."""
        assert self.grasps is not None  # since setup
        return super().memory() | {"begun_with": (self.begun_with, 0, len(self.grasps) - 1)}

    def once_more(self, drawn: torch.Tensor) -> torch.Tensor:
        """Return the rows of `grasps` [N] that episodes begin with, given those that were drawn."""
        return drawn

    def begin_held(self, mask: torch.Tensor) -> torch.Tensor:
        """Place hand and object, where mask holds, in the pose that `draw_object` has drawn, the targets give or take
        `randomize.initial.target`. Returns the object's pose [N, 7]."""
        g, pick = self.grasps, self._pick
        assert g is not None  # since setup
        target = g.target[pick] + self.sampler.draw("initial.target", self.num_actions)
        target = torch.maximum(torch.minimum(target, self.q_high), self.q_low)
        self.place(mask, g.hand[pick], g.pose[pick], torch.zeros_like(self.object_velocity), target)
        return g.pose[pick]


def _imu_length(env: Any) -> int:
    """Count the readings of the IMU that are kept: as many as may be late, and the newest."""
    return max(1, math.ceil(env.sampler.range("imu.delay")[1] / env.dt) + 1) + 1


class ImuInside(Task):
    """A task whose object has an IMU inside, and whose encoders have a bias. seen [N, 4]: the orientation that it
    says; `goal` [N, 4] is the task's own."""

    ranges = {"imu.delay": (0.0, 0.5), "imu.heading_rate": (-0.2, 0.2), "imu.tilt": (-0.3, 0.3)}

    goal: Any
    heading, goal_heading = memory(), memory()  # rad, by which the IMU's heading has drifted; as the goal was set
    heading_rate, imu_tilt = memory(reset=False), memory(3, reset=False)
    imu_past, imu_delay = memory(_imu_length, 4, reset=False), memory(dtype=torch.long, reset=False)
    seen = memory(4, reset=False)
    joint_bias = memory(joints, reset=False)

    def setup(self) -> None:
        self.up = torch.tensor([0.0, 0.0, 1.0], device=self.device)  # an IMU knows where down is, but not its heading
        super().setup()

    def begin_sensors(self, mask: torch.Tensor) -> None:
        """Draw what is constant within an episode."""
        s, m1 = self.sampler, mask[:, None]
        self.heading_rate = torch.where(mask, s.draw("imu.heading_rate"), self.heading_rate)
        self.imu_tilt = torch.where(m1, s.draw("imu.tilt", 3), self.imu_tilt)
        self.imu_tilt[:, 2] = 0.0  # heading has its own drift
        self.joint_bias = torch.where(m1, s.draw("sensors.joint_bias", self.num_actions), self.joint_bias)
        self.imu_delay = torch.where(mask, (s.draw("imu.delay") / self.dt).round().long(), self.imu_delay)

    def sense_object(self, fresh: torch.Tensor) -> None:
        """Read the orientation as an IMU in the object has it: late, noisy, slightly tilted, its heading drifting."""
        size, s = self.task["sensors"], self.sampler
        walk = size["imu_heading_walk"] * math.sqrt(self.dt) * s.normal()
        self.heading += torch.where(fresh, torch.zeros_like(walk), self.heading_rate * self.dt + walk)
        off = rotation.from_vector(self.imu_tilt + size["imu_noise"] * s.normal(3))
        now = rotation.multiply(self._drift(self.heading), rotation.multiply(off, self.object_pose[:, 3:]))
        now = torch.where(self.nan[:, None], torch.zeros_like(now), now)
        moved = torch.cat([now[:, None], self.imu_past[:, :-1]], 1)
        self.imu_past = torch.where(fresh[:, None, None], now[:, None].expand_as(moved), moved)
        late = self.imu_delay.clamp(0, moved.shape[1] - 1)[:, None, None].expand(-1, 1, 4)
        self.seen = rotation.normalize(self.imu_past.gather(1, late)[:, 0])

    def goal_seen(self) -> torch.Tensor:
        """Return the goal [N, 4] as the actor has it: set from the IMU, it carries the heading drift of that moment;
        what drifted since is error."""
        return rotation.multiply(self._drift(self.goal_heading), self.goal)

    def _drift(self, heading: torch.Tensor) -> torch.Tensor:
        return rotation.about(self.up.expand(self.num_envs, 3), heading)


class TipMotion(Task):
    """A task that knows how its fingertips move. tip_velocity [N, F, 6]: linear m/s and angular rad/s over the last
    control step, palm frame; tip_rot [N, F, 3, 3]: their links' matrices."""

    tip_rot, tip_last = memory(fingers, 3, 3, reset=False), memory(fingers, 3, reset=False)
    tip_velocity = memory(fingers, 6, reset=False)

    def sense_tips(self, fresh: torch.Tensor) -> None:
        """Find velocities over the last control step: linear, and angular from the rotation between the two."""
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
        self.tip_velocity = torch.cat([linear, turn / self.dt], -1)
        self.tip_rot, self.tip_last = rot, self.tips

    def taxels(self) -> torch.Tensor:
        """Return places of all taxels [P, T, 3] m in the frames of their pads' links."""
        layout = hand_layout(self.hand) or tip_layout(self.hand)
        lifted = layout.lifted(tip_skins(self.hand)) if self.touch.cfg.lift and self.pads else layout
        return torch.as_tensor(lifted.point, dtype=torch.float32, device=self.device)

    @property
    def raw_taxels(self) -> torch.Tensor:
        """Force on each taxel [N, P, T], N, of a task that needs taxels."""
        assert self.touch.raw is not None
        return self.touch.raw

    def plain_centre(self, point: torch.Tensor) -> torch.Tensor:
        """Return contact centres [N, P, 3] without force weighting: the mean position of the taxels that feel
        anything."""
        on = (self.raw_taxels > 0).float()
        count = on.sum(-1, keepdim=True)
        mean = torch.einsum("nft,ftc->nfc", on, point) / count.clamp(min=1)
        return self.of_pads(torch.where(count > 0, mean, self.pad_centre))

    def of_pads(self, local: torch.Tensor) -> torch.Tensor:
        """Places [N, P, 3] in the palm frame of those in the frames of the pads' links."""
        pos, rot = self.engine.t.xpos[:, self.pad_body].float(), self.engine.t.xmat[:, self.pad_body].float()
        return pos + (rot @ local[..., None])[..., 0]
