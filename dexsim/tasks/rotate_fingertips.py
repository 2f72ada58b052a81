"""The rotation task in which feeling is needed: `task=rotate_fingertips`.

A cube of unknown size, weight and friction is held by fingertips above the palm, which looks up, sideways or down, and
is pushed now and then. Goals are turns of `goal.angle` about a random one of the palm's axes in a random direction,
within `goal.reach` of how the cube was held at first. A camera gives its pose late, with noise, and not at all for
stretches. Whatever but a fingertip touches it for longer than `termination.lean_s` ends the episode. All constants are
ours; reward and success are those of `tasks/rotate.py`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from dexsim import rotation
from dexsim.errors import UserError
from dexsim.hand.skin import tip_skins
from dexsim.tactile.layout import hand_layout
from dexsim.tasks.patches import Patches
from dexsim.tasks.rotate import RotateEnv
from dexsim.tasks.stable_grasps import FINGERTIPS, GraspSet

PALMS = ("up", "side", "down")
"""Where the palm looks; `side`: gravity lies in the palm's plane, in any direction."""
POSE = (
    ("object_position", 3, "m", "from the camera, palm frame"),
    ("pose_age", 1, "s", "since the picture that the pose is of"),
)
TOLD = (
    ("goal_turn", 6, "1", "6D of the goal, from how the object was held at first, palm frame"),
    ("gravity", 3, "1", "direction in the palm frame, from the arm"),
)
CRITIC = (("goal_turn", 6), ("gravity", 3), ("push", 3), ("pose_age", 1), ("leaning", 1))
TOUCH = 0.1  # N on anything but fingertips that counts as touching it


class FingertipEnv(RotateEnv):
    """Turn a cube that fingertips hold, about three axes, seen late and with gaps.

    start [N, 4]: orientation as first held; gravity [N, 3] m/s2, palm frame; palm [N]: index into
    PALMS; other_force [N] N on anything but fingertips; hidden [N] s that the camera sees nothing yet; age [N] s."""

    TAKES_OBJECTS = False  # its held poses are of a cube
    PERCEPTION = ("camera",)
    ENDS = ("dropped", "leaned", "nan")

    def __init__(
        self, cfg: dict, n_worlds: int, device: str, seed: int, engine: str = "auto", grasps: GraspSet | None = None
    ):
        """grasps: start from these instead of the file `task.initial.poses`."""
        if cfg["task"]["observe"]["taxels"] is not None:  # patches are sums of taxels
            cfg = {**cfg, "tactile": {**cfg["tactile"], "raw": True}}
        super().__init__(cfg, n_worlds, device, seed, engine, grasps)

    @classmethod
    def check_deployed(cls, source: str) -> None:
        """UserError: it cannot."""
        raise UserError(f"{source}: its task's camera and arm are not read by the deployed loop; export another policy")

    @classmethod
    def prepare(cls, cfg: dict, **given: Any) -> None:
        """Nothing: poses held by fingertips come with dexsim, or are given."""

    def setup(self) -> None:
        t, n, dev = self.task, self.num_envs, self.device
        if self.grasps is None and t["initial"]["poses"] is None:
            edges, hand = [self.unit * x for x in self.sampler.range("object.size")[:2]], self.hand
            if hand.name != "xhand":
                raise UserError(
                    f"hand={hand.name}: has no cubes held by fingertips for this task to begin with; make them with"
                    f" dexsim stable-grasps hold=fingertips hand={hand.folder} out=FILE, and give"
                    " task.initial.poses=FILE"
                )
            self.grasps = GraspSet.load(FINGERTIPS).derived(hand.mirror, hand.scale).within(*edges).to(dev)
        self._check_fingertips()
        super().setup()

        def zeros(*shape: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
            return torch.zeros(n, *shape, dtype=dtype, device=dev)

        self.patches = None
        if t["observe"]["taxels"] is not None:
            if self.taxel_point is not None:
                raise UserError("task.observe.taxels: needs task.observe.force_weighted=true")
            layout = hand_layout(self.hand)
            if layout is None:
                raise UserError(f"task.observe.taxels: hand={self.hand.name} has no touch pads; use null")
            if self.touch.cfg.lift:
                layout = layout.lifted(tip_skins(self.hand))
            self.patches = Patches(layout, t["observe"]["taxels"], dev)
        self.gravity = self.gravity.expand(n, 3).clone()
        self.palm = zeros(dtype=torch.long)
        self.palms = torch.tensor([PALMS.index(p) for p in t["palm"]], device=dev)
        angle = math.radians(t["goal"]["angle"])
        axes = torch.eye(3, device=dev)[["xyz".index(a) for a in t["goal"]["axes"]]]
        signed = torch.cat([axes, -axes])
        self.turns = rotation.about(signed, torch.full((len(signed),), angle, device=dev))  # [2 A, 4]
        # on the device, so that a recorded step sees a change
        self.patience = torch.tensor(float(t["goal"]["patience"]), device=dev)
        self.reach_rad = math.radians(t["goal"]["reach"]) + 1e-3
        self.start = zeros(4)
        self.start[:, 0] = 1.0
        self.other_force, self.leaning = zeros(), zeros()
        self.push, self.push_left, self.push_wait = zeros(3), zeros(), zeros()
        lag = math.ceil(self.sampler.range("camera.delay")[1] / self.dt) + 1
        self.past_pose, self.camera_delay = zeros(lag + 1, 7), zeros(dtype=torch.long)
        self.camera_tilt, self.camera_offset = zeros(3), zeros(3)
        self.hidden, self.visible = zeros(), zeros()
        self.seen_position, self.age = zeros(3), zeros()

    def _check_fingertips(self) -> None:
        t = self.task
        goal, palm = t["goal"], t["palm"]
        if not palm or not set(palm) <= set(PALMS):
            raise UserError(f"task.palm={palm}: must be a list of {', '.join(PALMS)}")
        if not goal["axes"] or not set(goal["axes"]) <= set("xyz"):
            raise UserError(f"task.goal.axes={goal['axes']}: must be a list of x, y, z")
        if not goal["angle"] <= goal["reach"] <= 180:
            raise UserError(
                f"task.goal.reach={goal['reach']}: must lie between task.goal.angle={goal['angle']} and 180 degrees"
            )
        if not goal["patience"] > 0:
            raise UserError(f"task.goal.patience={goal['patience']}: must be above 0 s")
        if not t["termination"]["lean_s"] >= 0:
            raise UserError(f"task.termination.lean_s={t['termination']['lean_s']}: must be 0 s or more")
        for name, low, high in (
            ("camera.delay", 0.0, 0.5),
            ("camera.tilt", -0.5, 0.5),
            ("camera.offset", -0.05, 0.05),
            ("camera.visible", 0.0, 1e6),
            ("camera.hidden", 0.0, 1e6),
            ("push.weights", 0.0, 20.0),
            ("push.duration", 0.0, 10.0),
            ("push.wait", 0.0, 1e6),
        ):
            self.sampler.check(name, low, high)

    def memory(self) -> dict:
        names = ("gravity", "start", "leaning", "other_force", "push", "push_left", "push_wait", "past_pose", "age")
        more = ("camera_tilt", "camera_offset", "hidden", "visible", "seen_position")
        own: dict = {name: getattr(self, name) for name in names + more}
        own["palm"] = self.palm, 0, len(PALMS) - 1
        own["camera_delay"] = self.camera_delay, 0, self.past_pose.shape[1] - 1
        return super().memory() | own

    # -- episodes
    # ------------------------------------------------------------------------------------------------------------
    def begin_episodes(self, mask: torch.Tensor) -> None:
        s, m1 = self.sampler, mask[:, None]
        which = self.palms[(s.uniform() * len(self.palms)).long().clamp(max=len(self.palms) - 1)]
        self.palm.copy_(torch.where(mask, which, self.palm))
        azimuth, zero = 2 * math.pi * s.uniform(), torch.zeros_like(self.leaning)
        up = torch.stack([zero, zero, zero - 1], 1)
        side = torch.stack([azimuth.cos(), azimuth.sin(), zero], 1)
        down = torch.where((which == 0)[:, None], up, torch.where((which == 1)[:, None], side, -up))
        self.gravity.copy_(torch.where(m1, 9.81 * down, self.gravity))
        super().begin_episodes(mask)
        pose = self.engine.t.qpos[:, self.object_q].float()
        self.start.copy_(torch.where(m1, pose[:, 3:], self.start))
        self.goal.copy_(torch.where(m1, self._drawn_goal(self.start), self.goal))
        self.leaning.masked_fill_(mask, 0.0)
        self.other_force.masked_fill_(mask, 0.0)
        self._new_push(mask)
        for own, new in (
            (self.camera_tilt, s.draw("camera.tilt", 3)),
            (self.camera_offset, s.draw("camera.offset", 3)),
        ):
            own.copy_(torch.where(m1, new, own))
        self.camera_delay.copy_(torch.where(mask, (s.draw("camera.delay") / self.dt).round().long(), self.camera_delay))
        self.visible.copy_(torch.where(mask, s.draw("camera.visible"), self.visible))
        self.hidden.copy_(torch.where(mask, s.draw("camera.hidden"), self.hidden))

    def _advance_goal(self) -> None:
        """The next goal where this one was reached, and in training where it was not for `goal.patience` s."""
        super()._advance_goal()
        late = self.since * self.dt >= self.patience
        self.goal.copy_(torch.where(late[:, None], self._drawn_goal(self.goal), self.goal))
        self.since.masked_fill_(late, 0)

    def end_curriculum(self) -> None:
        """As the base class; and a goal now stays until it is reached."""
        super().end_curriculum()
        self.patience.fill_(math.inf)

    def next_goal(self, q: torch.Tensor) -> torch.Tensor:
        """The goal after the present one [N, 4]. q is not used: errors of one goal do not add to the next."""
        return self._drawn_goal(self.goal)

    def _drawn_goal(self, last: torch.Tensor) -> torch.Tensor:
        """`last` [N, 4] turned about a random axis in a random direction, so that it stays within `goal.reach` of the
        start; where no turn does, by the one that leads there most."""
        every = rotation.normalize(rotation.multiply(self.turns[None], last[:, None]))  # [N, 2 A, 4]
        far = rotation.error(every, self.start[:, None].expand_as(every))
        score = torch.where(far <= self.reach_rad, self.sampler.uniform(every.shape[1]), -far)
        pick = score.argmax(1)[:, None, None].expand(-1, 1, 4)
        return every.gather(1, pick)[:, 0]

    # -- pushes
    # --------------------------------------------------------------------------------------------------------------
    def _new_push(self, mask: torch.Tensor) -> None:
        """A push in a random direction, of a multiple of the object's weight, after a random wait."""
        s = self.sampler
        size = s.draw("push.weights") * self.objects.mass * 9.81
        self.push.copy_(torch.where(mask[:, None], s.direction() * size[:, None], self.push))
        self.push_left.copy_(torch.where(mask, s.draw("push.duration"), self.push_left))
        self.push_wait.copy_(torch.where(mask, s.draw("push.wait"), self.push_wait))

    def before_physics(self) -> None:
        super().before_physics()
        self.push_wait -= self.dt
        on = self.push_wait <= 0
        self.push_left -= self.dt * on
        over = self.push_left <= 0
        force = torch.where((on & ~over)[:, None], self.push, torch.zeros_like(self.push))
        applied = self.engine.t.xfrc_applied
        applied[:, self.objects.body, :3] = force.to(applied.dtype)
        self._new_push(over)

    # -- terminations and rewards
    # --------------------------------------------------------------------------------------------
    def terminated(self) -> dict[str, torch.Tensor]:
        """Dropped: too far from where it began. Leaned: touched by palm or links for too long (`tipped` of the base
        class, which such an end takes the place of)."""
        limit = self.task["termination"]
        other = (self.finger_force - self.tip_force).clamp(min=0).sum(1) + self.palm_force
        self.other_force.copy_(other)
        self.leaning.copy_(torch.where(other > TOUCH, self.leaning + self.dt, torch.zeros_like(self.leaning)))
        self.dropped.copy_((self.object_pose[:, :3] - self.home).norm(dim=1) > limit["distance"])
        self.tipped.copy_(self.leaning > limit["lean_s"])
        self.nan_end.copy_(self.nan)
        return {"dropped": self.dropped, "leaned": self.tipped}

    def reward_words(self) -> dict[str, str]:
        return super().reward_words() | {"other": "ours: touched by palm or links"}

    def rewards(self) -> dict[str, torch.Tensor]:
        out = super().rewards()
        w = self.task["rewards"].get("other", 0.0)
        if w:
            out["other"] = w * (self.other_force > TOUCH).float()
        return out

    def _measure(self) -> None:
        super()._measure()
        del self._metrics["task/spin"]  # about one axis: says nothing here
        self._metrics |= {
            "task/touched_by_others": (self.other_force > TOUCH).float().mean(),
            "task/unseen": (self.age > 0.12).float().mean(),
        }

    # -- observations
    # ----------------------------------------------------------------------------------------------------------
    def _read_imu(self, fresh: torch.Tensor) -> None:
        """The camera in place of the IMU: a pose, late, noisy, off by a constant; while hidden, the last one stays."""
        sense, s = self.task["sensors"], self.sampler
        off = rotation.from_vector(self.camera_tilt + sense["camera_rotation"] * s.normal(3))
        now = torch.cat([
            self.object_pose[:, :3] + self.camera_offset + sense["camera_position"] * s.normal(3),
            rotation.multiply(off, self.object_pose[:, 3:]),
        ], 1)  # fmt: skip
        now = torch.where(self.nan[:, None], torch.zeros_like(now), now)
        moved = torch.cat([now[:, None], self.past_pose[:, :-1]], 1)
        self.past_pose.copy_(torch.where(fresh[:, None, None], now[:, None].expand_as(moved), moved))
        pose = self.past_pose.gather(1, self.camera_delay[:, None, None].expand(-1, 1, 7))[:, 0]

        gone = (self.visible <= 0) & ~fresh
        self.visible -= self.dt
        self.hidden -= self.dt * gone
        back = gone & (self.hidden <= 0)
        self.visible.copy_(torch.where(back, s.draw("camera.visible"), self.visible))
        self.hidden.copy_(torch.where(back, s.draw("camera.hidden"), self.hidden))
        sees = (~gone)[:, None]
        self.seen.copy_(torch.where(sees, rotation.normalize(pose[:, 3:]), self.seen))
        self.seen_position.copy_(torch.where(sees, pose[:, :3], self.seen_position))
        self.age.copy_(torch.where(gone, self.age + self.dt, self.camera_delay * self.dt))

    def _felt(self) -> tuple[torch.Tensor, torch.Tensor]:
        """As the base class, through `observe.taxels` where it is set."""
        if self.patches is None:
            return super()._felt()
        assert self.touch.raw is not None  # asked for with observe.taxels
        force, local = self.patches.read(self.touch.raw)
        pos, rot = self.engine.t.xpos[:, self.tip_body].float(), self.engine.t.xmat[:, self.tip_body].float()
        return force, (pos + (rot @ local[..., None])[..., 0]).flatten(1)

    def observe(self, advance: bool) -> dict[str, torch.Tensor]:
        out = super().observe(advance)
        goal_turn = rotation.six(rotation.multiply(self.goal, rotation.conjugate(self.start)))
        told = [goal_turn, self.gravity / 9.81]
        pose = [] if self.task["observe"]["orientation"] == "none" else [self.seen_position, self.age[:, None]]
        extra = torch.where(self.nan[:, None], torch.zeros((), device=self.device), torch.cat(pose + told, 1))
        pushing = self.engine.t.xfrc_applied[:, self.objects.body, :3].float()
        known = torch.cat([*told, pushing, self.age[:, None], self.leaning[:, None]], 1)
        return {
            "actor": torch.cat([out["actor"], extra], 1),
            "critic": torch.cat([out["critic"], torch.nan_to_num(known)], 1),
        }

    # -- what the log and an evaluation show
    # ---------------------------------------------------------------------------------
    def describe(self) -> dict:
        out, t = super().describe(), self.task
        rows = TOLD if t["observe"]["orientation"] == "none" else (*POSE, *TOLD)
        actor = [
            (name, width, text.replace("object from its IMU", "object from the camera"))
            for name, width, text in out["observations"]["actor"]
        ]
        out["observations"]["actor"] = actor + [(name, width, f"{unit}; {text}") for name, width, unit, text in rows]
        out["observations"]["critic"] += [(name, width, "clean") for name, width in CRITIC]
        limit = t["termination"]
        out["terminations"] = [
            ("dropped", f"centre {limit['distance']} m from its start"),
            ("leaned", f"touched by anything but fingertips for more than {limit['lean_s']} s"),
            *out["terminations"][2:],
        ]
        out["notes"].append(f"palm {', '.join(t['palm'])}; goals within {t['goal']['reach']} degrees of the start")
        return out

    def trial_facts(self) -> dict[str, torch.Tensor]:
        return {
            "palm": self.palm,
            "edge": 2 * self.objects.size[:, 0],
            "mass": self.objects.mass,
            "friction": self.objects.friction,
        }

    def trial_counts(self) -> dict[str, torch.Tensor]:
        return {"other_steps": self.other_force > TOUCH}

    def of_trials(self, r: dict) -> dict:
        """Share of the time in which anything but fingertips touched; and every trial: its successes, seconds, end,
        palm, edge m, mass kg, friction, seconds in which anything but fingertips touched."""
        other = r["other_steps"] * self.dt
        rows = zip(
            r["successes"].tolist(), np.round(r["time"], 3).tolist(), r["end"].tolist(), r["palm"].tolist(),
            np.round(r["edge"], 4).tolist(), np.round(r["mass"], 4).tolist(), np.round(r["friction"], 3).tolist(),
            np.round(other, 3).tolist(), strict=True,
        )  # fmt: skip
        return {
            "touched_by_others": float(other.sum() / max(r["time"].sum(), 1e-9)),
            "trials": [[*a[:3], PALMS[a[3]], *a[4:]] for a in rows],
        }
