"""The rotation task in which feeling is needed: `task=rotate_fingertips`.

A cube of unknown size, weight and friction is held by fingertips above the palm, which looks up, sideways or down, and
is pushed now and then. Goals are turns of `goal.angle` about a random one of the palm's axes in a random direction,
within `goal.reach` of how the cube was held at first. A camera gives its pose late, with noise, and not at all for
stretches. Whatever but a fingertip touches it for longer than `termination.lean_s` ends the episode. All constants are
ours; reward and success are those of `tasks/rotate.py`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch

from dexsim import rotation
from dexsim.errors import UserError
from dexsim.hand.skin import tip_skins
from dexsim.tactile.layout import hand_layout
from dexsim.tasks import observations_rotate as shared
from dexsim.tasks.patches import Patches
from dexsim.tasks.rotate import RotateEnv
from dexsim.tasks.rotate_eval import PALMS, TOUCH, TipTrials
from dexsim.tasks.stable_grasps import FINGERTIPS, GraspSet
from dexsim.tasks.terms import done, memory, metric, observe, reward


def camera_length(env: Any) -> int:
    """Count the pictures that are kept: as many as may be late, and the newest."""
    return math.ceil(env.sampler.range("camera.delay")[1] / env.dt) + 2


class FingertipEnv(TipTrials, RotateEnv):
    """Turn a cube that fingertips hold, about three axes, seen late and with gaps.

    first [N, 4]: orientation as first held; pull [N, 3] m/s2: gravity, palm frame; palm [N]: index into
    PALMS; other_force [N] N on anything but fingertips; hidden [N] s that the camera sees nothing yet;
    old [N] s, its last pose's age."""

    TAKES_OBJECTS = False  # its held poses are of a cube
    holds = "fingertips", (0.04, 0.065)
    choices = {**RotateEnv.choices, "perception": ("camera",)}
    ranges = {
        "camera.delay": (0.0, 0.5), "camera.tilt": (-0.5, 0.5), "camera.offset": (-0.05, 0.05),
        "camera.visible": (0.0, 1e6), "camera.hidden": (0.0, 1e6),
        "push.weights": (0.0, 20.0), "push.duration": (0.0, 10.0), "push.wait": (0.0, 1e6),
    }  # fmt: skip

    first, palm = memory(4, reset=False), memory(dtype=torch.long, reset=False)
    leaning, other_force = memory(), memory()  # s and N, touched by anything but fingertips
    push_force, push_left, push_wait = memory(3, reset=False), memory(reset=False), memory(reset=False)
    past_pose, camera_delay = memory(camera_length, 7, reset=False), memory(dtype=torch.long, reset=False)
    camera_tilt, camera_offset = memory(3, reset=False), memory(3, reset=False)
    pull, seen_position = memory(3, reset=False), memory(3, reset=False)
    hidden, visible, old = memory(reset=False), memory(reset=False), memory(reset=False)  # s

    # -- setting up
    @classmethod
    def needs_taxels(cls, task: dict) -> bool:
        """Patches are sums of taxels."""
        return task["observe"]["taxels"] is not None or super().needs_taxels(task)

    @classmethod
    def check_deployed(cls, source: str) -> None:
        """Raise UserError: no policy of this task can be exported."""
        raise UserError(f"{source}: its task's camera and arm are not read by the deployed loop; export another policy")

    @classmethod
    def prepare(cls, cfg: dict, **given: Any) -> None:
        """Prepare nothing: poses held by fingertips come with dexsim, or are given."""

    @classmethod
    def another_world(cls, u: Any, friction: float, size: float) -> dict[str, Any]:
        """Draw nothing: its camera is no IMU."""
        return {}

    def adapt(self) -> Mapping[str, Mapping[str, Any]]:
        """Return the switches of the base class; without a pose where `observe.orientation` is none."""
        posed = {"actor": self.task["observe"]["orientation"] != "none"}
        return {**super().adapt(), "object_position": posed, "pose_age": posed}

    def set_objects(self) -> None:
        """Set cubes that fingertips hold."""
        if self.grasps is None and self.task["initial"]["poses"] is None:
            edges, hand = [self.unit * x for x in self.sampler.range("object.size")[:2]], self.hand
            if hand.name != "xhand":
                raise UserError(
                    f"hand={hand.name}: has no cubes held by fingertips for this task to begin with; make them with"
                    f" dexsim stable-grasps hold=fingertips hand={hand.folder} out=FILE, and give"
                    " task.initial.poses=FILE"
                )
            found = GraspSet.load(FINGERTIPS).derived(hand.mirror, hand.scale).within(*edges)
            self.grasps = found.to(self.device)
        super().set_objects()

    def prepare_task(self) -> None:
        super().prepare_task()
        t, dev = self.task, self.device
        shared.check_drawn_goals(t, PALMS)
        self.patches = None
        if t["observe"]["taxels"] is not None:
            layout = hand_layout(self.hand)
            if self.taxel_point is not None:
                raise UserError("task.observe.taxels: needs task.observe.force_weighted=true")
            if layout is None:
                raise UserError(f"task.observe.taxels: hand={self.hand.name} has no touch pads; use null")
            lifted = layout.lifted(tip_skins(self.hand)) if self.touch.cfg.lift else layout
            self.patches = Patches(lifted, t["observe"]["taxels"], dev)
        self.palms = torch.tensor([PALMS.index(p) for p in t["palm"]], device=dev)
        angle, axes = math.radians(t["goal"]["angle"]), torch.eye(3, device=dev)
        axes = axes[["xyz".index(a) for a in t["goal"]["axes"]]]
        signed = torch.cat([axes, -axes])
        self.turns = rotation.about(signed, torch.full((len(signed),), angle, device=dev))  # [2 A, 4]
        # on the device, so that a recorded step sees a change
        self.patience = torch.tensor(float(t["goal"]["patience"]), device=dev)
        self.reach_rad = math.radians(t["goal"]["reach"]) + 1e-3

    def symmetries(self) -> list:
        """Return none: its goals are turns about the palm's axes from how the cube was held, drawn for one frame of
        it."""
        return []

    # -- an episode begins
    def begin_episodes(self, mask: torch.Tensor) -> None:
        s, m1 = self.sampler, mask[:, None]
        which = self.palms[(s.uniform() * len(self.palms)).long().clamp(max=len(self.palms) - 1)]
        self.palm = torch.where(mask, which, self.palm)
        azimuth, zero = 2 * math.pi * s.uniform(), torch.zeros_like(self.leaning)
        up = torch.stack([zero, zero, zero - 1], 1)
        side = torch.stack([azimuth.cos(), azimuth.sin(), zero], 1)
        down = torch.where((which == 0)[:, None], up, torch.where((which == 1)[:, None], side, -up))
        self.pull = torch.where(m1, 9.81 * down, self.pull)
        super().begin_episodes(mask)

    def begin(self, mask: torch.Tensor) -> None:
        super().begin(mask)
        s, m1 = self.sampler, mask[:, None]
        pose = self.engine.t.qpos[:, self.object_q].float()
        self.first = torch.where(m1, pose[:, 3:], self.first)
        self.goal = torch.where(m1, self._drawn_goal(self.first), self.goal)
        self._new_push(mask)
        self.camera_tilt = torch.where(m1, s.draw("camera.tilt", 3), self.camera_tilt)
        self.camera_offset = torch.where(m1, s.draw("camera.offset", 3), self.camera_offset)
        delay = (s.draw("camera.delay") / self.dt).round().long()
        self.camera_delay = torch.where(mask, delay, self.camera_delay)
        self.visible = torch.where(mask, s.draw("camera.visible"), self.visible)
        self.hidden = torch.where(mask, s.draw("camera.hidden"), self.hidden)

    def _advance_goal(self) -> None:
        """Set the next goal where this one was reached, and in training where it was not for `goal.patience` s."""
        super()._advance_goal()
        late = self.since * self.dt >= self.patience
        self.goal = torch.where(late[:, None], self._drawn_goal(self.goal), self.goal)
        self.since.masked_fill_(late, 0)

    def end_curriculum(self) -> None:
        """End it as the base class does; a goal now stays until it is reached."""
        super().end_curriculum()
        self.patience.fill_(math.inf)

    def next_goal(self, q: torch.Tensor) -> torch.Tensor:
        """Return the goal after the present one [N, 4]. q is not used: errors of one goal do not add to the next."""
        return self._drawn_goal(self.goal)

    def _drawn_goal(self, last: torch.Tensor) -> torch.Tensor:
        """Return `last` [N, 4] turned about a random axis in a random direction, so that it stays within `goal.reach`
        of the start; where no turn does, by the one that leads there most."""
        every = rotation.normalize(rotation.multiply(self.turns[None], last[:, None]))  # [N, 2 A, 4]
        far = rotation.error(every, self.first[:, None].expand_as(every))
        score = torch.where(far <= self.reach_rad, self.sampler.uniform(every.shape[1]), -far)
        pick = score.argmax(1)[:, None, None].expand(-1, 1, 4)
        return every.gather(1, pick)[:, 0]

    # -- pushes
    def _new_push(self, mask: torch.Tensor) -> None:
        """Draw a push in a random direction, of a multiple of the object's weight, after a random wait."""
        s = self.sampler
        size = s.draw("push.weights") * self.objects.mass * 9.81
        self.push_force = torch.where(mask[:, None], s.direction() * size[:, None], self.push_force)
        self.push_left = torch.where(mask, s.draw("push.duration"), self.push_left)
        self.push_wait = torch.where(mask, s.draw("push.wait"), self.push_wait)

    def before_physics(self) -> None:
        super().before_physics()
        self.push_wait -= self.dt
        on = self.push_wait <= 0
        self.push_left -= self.dt * on
        over = self.push_left <= 0
        self.push(torch.where((on & ~over)[:, None], self.push_force, 0.0))
        self._new_push(over)

    # -- how it goes and ends
    def update(self) -> None:
        other = (self.finger_force - self.tip_force).clamp(min=0).sum(1) + self.palm_force
        self.other_force = other
        self.leaning = torch.where(other > TOUCH, self.leaning + self.dt, torch.zeros_like(self.leaning))
        super().update()

    def lasts(self, p: torch.Tensor) -> None:
        """Judge which episodes go on: dropped, too far from where it began; tipped, leaned against for too long."""
        limit = self.task["termination"]
        self.dropped = (p - self.home).norm(dim=1) > limit["distance"]
        self.tipped = self.leaning > limit["lean_s"]

    @done(name="leaned")
    def is_tipped(self) -> torch.Tensor:
        """touched by anything but fingertips for more than termination.lean_s"""
        return self.tipped

    @reward(-0.1)
    def other(self) -> torch.Tensor:
        """ours: touched by palm or links"""
        return (self.other_force > TOUCH).float()

    turning = None  # type: ignore[assignment]  # about one axis: says nothing here

    @metric("share", now=True)
    def touched_by_others(self) -> torch.Tensor:
        return (self.other_force > TOUCH).float()

    @metric("share", now=True)
    def unseen(self) -> torch.Tensor:
        return (self.old > 0.12).float()

    # -- what is seen
    def sense_object(self, fresh: torch.Tensor) -> None:
        """Sense by a camera in place of the IMU: a pose, late, noisy, off by a constant; hidden, the last stays."""
        sense, s = self.task["sensors"], self.sampler
        off = rotation.from_vector(self.camera_tilt + sense["camera_rotation"] * s.normal(3))
        now = torch.cat([
            self.object_pose[:, :3] + self.camera_offset + sense["camera_position"] * s.normal(3),
            rotation.multiply(off, self.object_pose[:, 3:]),
        ], 1)  # fmt: skip
        now = torch.where(self.nan[:, None], torch.zeros_like(now), now)
        moved = torch.cat([now[:, None], self.past_pose[:, :-1]], 1)
        self.past_pose = torch.where(fresh[:, None, None], now[:, None].expand_as(moved), moved)
        late = self.camera_delay.clamp(0, moved.shape[1] - 1)[:, None, None].expand(-1, 1, 7)
        pose = self.past_pose.gather(1, late)[:, 0]

        gone = (self.visible <= 0) & ~fresh
        self.visible -= self.dt
        self.hidden -= self.dt * gone
        back = gone & (self.hidden <= 0)
        self.visible = torch.where(back, s.draw("camera.visible"), self.visible)
        self.hidden = torch.where(back, s.draw("camera.hidden"), self.hidden)
        sees = (~gone)[:, None]
        self.seen = torch.where(sees, rotation.normalize(pose[:, 3:]), self.seen)
        self.seen_position = torch.where(sees, pose[:, :3], self.seen_position)
        self.old = torch.where(gone, self.old + self.dt, self.camera_delay * self.dt)

    @observe("m")
    def contact_centre(self) -> torch.Tensor:
        """force-weighted mean of taxel positions, palm frame; of observe.taxels where they are set"""
        if self.clean or self.patches is None:
            return super().contact_centre()
        return self.of_pads(self.patches.read(self.raw_taxels)[1])

    @observe("N")
    def contact_force(self) -> torch.Tensor:
        """sum of a pad's normal forces; of observe.taxels where they are set"""
        return self.touch_force if self.clean or self.patches is None else self.patches.read(self.raw_taxels)[0]

    @observe("m", only="actor")
    def object_position(self) -> torch.Tensor:
        """from the camera, palm frame"""
        return self.seen_position

    @observe("s", only="actor")
    def pose_age(self) -> torch.Tensor:
        """since the picture that the pose is of"""
        return self.old

    @observe("1")
    def goal_turn(self) -> torch.Tensor:
        """6D of the goal, from how the object was held at first, palm frame"""
        return rotation.six(rotation.multiply(self.goal, rotation.conjugate(self.first)))

    @observe("1")
    def gravity(self) -> torch.Tensor:
        """direction in the palm frame, from the arm"""
        return self.pull / 9.81

    @observe("N, s, s", only="critic")
    def known(self) -> dict[str, torch.Tensor]:
        """pushes, the pose's age, leaning"""
        pushing = self.engine.t.xfrc_applied[:, self.objects.body, :3].float()
        return {"push": pushing, "pose_age": self.old, "leaning": self.leaning}

    # -- what the log and an evaluation show
    def notes(self) -> list[str]:
        """Return notes on palm and goals, beside those of the base class."""
        t = self.task
        return [*super().notes(),
                f"palm {', '.join(t['palm'])}; goals within {t['goal']['reach']} degrees of the start"]  # fmt: skip
