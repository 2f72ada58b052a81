"""In-hand rotation: turn a cube, or one's own objects, on a palm-up hand about an axis of the palm, 90 degrees a goal.

Paper: "In-Hand Object Rotation" (setup), its tables of the observation and the reward, and the ablation's settings.
Constants that it does not publish are marked `ours` in configs/task/rotate.yaml.

Actions are relative (`action.mode`): a target moves by action * scale a step. Action zero then holds the grasp an
episode starts with, and exploration begins from a held cube; absolute actions would throw it at once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import torch

from dexsim import rotation
from dexsim.tasks import observations_rotate as shared
from dexsim.tasks.parts import Held, ImuInside, TipMotion
from dexsim.tasks.rotate_eval import Trials
from dexsim.tasks.stable_grasps import CUBE
from dexsim.tasks.terms import SIX, VECTOR, done, memory, metric, observe, reward


class RotateEnv(Trials, Held, ImuInside, TipMotion):
    """Turn a cube on the palm about one axis, 90 degrees at a time.

    goal [N, 4]: orientation to reach (object to palm); home [N, 3]: where the cube lay when the episode began, m;
    successes [N]: goals reached in this episode."""

    holds = "palm", (0.045, 0.06)
    choices = {"perception": ("imu", "proprioception"), "critic": ("paper", "privileged", "placed"),
               "observe.orientation": ("6d", "quaternion", "none")}  # fmt: skip
    shapes = shared.SHAPES

    goal, home = memory(4, reset=False), memory(3, reset=False)
    successes, since = memory(dtype=torch.long), memory(dtype=torch.long)  # since: control steps, since the last one
    # of the last step, also where an episode has begun since; a recorded step writes into this memory
    reached, dropped, tipped = (memory(dtype=torch.bool, reset=False) for _ in range(3))
    d_rot, d_pos = memory(reset=False), memory(reset=False)  # rad, m, to the goal and from `home`

    # -- setting up
    @classmethod
    def needs_taxels(cls, task: dict) -> bool:
        """Tell whether it needs taxels, as the plain mean does."""
        return not task["observe"]["force_weighted"]

    @classmethod
    def another_world(cls, u: Callable[..., float], friction: float, size: float) -> dict[str, Any]:
        randomize = {
            "object.size": [round(size, 4), round(size + 0.002, 4)], "object.mass": u(0.06, 0.12, 3),
            "object.com": [-0.02, 0.02], "object.friction": friction, "contact.stiffness": u(6000.0, 8500.0),
            "contact.damping_ratio": u(0.6, 0.9), "sensors.joint_bias": 0.0, "imu.delay": u(0.02, 0.05),
            "imu.tilt": [-0.03, 0.03],
        }  # fmt: skip
        return {"randomize": randomize, "sensors": {"joint_noise": 0.001}}

    def adapt(self) -> Mapping[str, Mapping[str, Any]]:
        """Return the rows of the paper's ablation, `observe` and `perception`, as switches of observations."""
        t = self.task
        blind, o = t["perception"] == "proprioception", t["observe"]
        self.history = t["history"] if blind else 1
        rows = {name: {"actor": o.get(name, True) is not False} for name in (
            "joint_angle", "last_action", "contact_centre", "contact_force", "fingertip_position")}  # fmt: skip
        rows["fingertip_position"]["actor"] &= not blind
        rows["follower_angle"] = dict.fromkeys(("actor", "critic"), bool(self.hand.sensed))
        rows["joint_velocity"] = {"actor": blind and o.get("joint_velocity", True)}
        rows["relative_orientation"] = {"actor": not blind and o["orientation"] != "none"}
        return rows | {"privileged": {"critic": t["critic"] != "paper"}}

    def prepare_task(self) -> None:
        t, dev = self.task, self.device
        shared.check(t)
        ends = t["termination"]
        self.farthest = torch.tensor(self.unit * (ends.get("training") or ends["distance"]), device=dev)
        self.again = torch.tensor(float(t["initial"].get("again", 0.0)), device=dev)
        self.axis, self.turn = (x.to(dev) for x in shared.axis_and_turn(t["goal"], self.hand.mirror))
        self.taxel_point = None if t["observe"]["force_weighted"] else self.taxels()

    def symmetries(self) -> list[dict[str, Callable[[torch.Tensor], torch.Tensor]]]:
        """Return those of a cube, which looks the same from each side: quarter turns of its own frame about its z."""
        if self.names != (CUBE,):
            return []
        turns = [rotation.about(self.up, torch.tensor(k * math.pi / 2, device=self.device)) for k in (1, 2, 3)]
        return [shared.relabelled(rotation.to_matrix(turn)) for turn in turns]

    # -- an episode begins
    def once_more(self, drawn: torch.Tensor) -> torch.Tensor:
        """Begin anew from the pose lost just now, with probability `initial.again` times the share of worlds that have
        reached a goal: before anything turns, hard poses would else be most of what is met, and teach to hold still."""
        if not self.task["initial"].get("again", 0.0):
            return drawn
        chance = self.again * (self.successes > 0).float().mean()
        return torch.where((self.dropped | self.tipped) & (self.sampler.uniform() < chance), self.begun_with, drawn)

    def begin(self, mask: torch.Tensor) -> None:
        m1, pose = mask[:, None], self.begin_held(mask)
        self.goal = torch.where(m1, self.next_goal(pose[:, 3:]), self.goal)
        self.home = torch.where(m1, pose[:, :3], self.home)
        self.begin_sensors(mask)

    def next_goal(self, q: torch.Tensor) -> torch.Tensor:
        """Return the goal after orientation q [N, 4] was reached: q turned by the goal's angle about the palm's axis,
        its tilt against that axis removed unless `goal.keep_tilt`."""
        return shared.next_goal(q, self.axis, self.turn, self.task["goal"]["keep_tilt"])

    # -- how it goes and ends
    def end_curriculum(self) -> None:
        """End the curriculum; the cube may go as far as `termination.distance`, and no start is met more often."""
        super().end_curriculum()
        self.again.fill_(0.0)
        self.farthest.fill_(self.unit * self.task["termination"]["distance"])

    def update(self) -> None:
        p, q, r = self.object_pose[:, :3], self.object_pose[:, 3:], self.task["reward"]
        self.lasts(p)
        self.d_rot, self.d_pos = rotation.error(q, self.goal), (p - self.home).norm(dim=1)
        there = (self.d_rot < r["delta_rot"]) & (self.d_pos < self.unit * r["delta_pos"])
        self.reached = there & ~self.nan & ~(self.dropped | self.tipped)

    def lasts(self, p: torch.Tensor) -> None:
        """Judge which episodes go on, by the object's place [N, 3] m: dropped, too low or too far from where it began;
        tipped, the goal's upper face looks away from the axis."""
        self.dropped = ((p - self.home).norm(dim=1) > self.farthest) | (p[:, 2] < self.lowest[self.objects.variant])
        self.tipped = self._tilt_from_goal() > self.task["termination"]["tilt"]

    def _tilt_from_goal(self) -> torch.Tensor:
        """Return the angle between the palm axis as goal and present orientation have it in the object's frame."""
        a = rotation.rotate(rotation.conjugate(self.goal), self.axis.expand(self.num_envs, 3))
        b = rotation.rotate(rotation.conjugate(self.object_pose[:, 3:]), self.axis.expand(self.num_envs, 3))
        return torch.atan2(torch.linalg.cross(a, b).norm(dim=1), (a * b).sum(1))

    def rewards(self) -> dict[str, torch.Tensor]:
        out = super().rewards()
        self._advance_goal()
        return out

    def _advance_goal(self) -> None:
        """Set the next goal where this one was reached."""
        self.goal = torch.where(self.reached[:, None], self.next_goal(self.object_pose[:, 3:]), self.goal)
        self.goal_heading = torch.where(self.reached, self.heading, self.goal_heading)
        self.successes += self.reached
        self.since += 1
        self.since.masked_fill_(self.reached, 0)

    @done(name="dropped")
    def is_dropped(self) -> torch.Tensor:
        """its centre is too far from where it began (termination.distance), or too low (termination.below)"""
        return self.dropped

    @done(name="tipped")
    def is_tipped(self) -> torch.Tensor:
        """the goal's upper face looks more than termination.tilt away from the axis"""
        return self.tipped

    # -- what is paid: table "Reward for in-hand object rotation", and ours
    @reward(0.02, name="goal")
    def close_to_goal(self) -> torch.Tensor:
        """w_goal, close to goal"""
        r = self.task["reward"]
        near = torch.sigmoid(-r["alpha"] * (self.d_pos / self.unit - r["delta_dist"]))
        return 1 / (self.d_rot.abs() + r["epsilon"]) * near

    @reward(-0.0005, name="action")
    def change(self) -> torch.Tensor:
        """w_action"""
        return (self.action - self.last_action).square().sum(1)

    @reward(20.0, name="bonus")
    def reaching(self) -> torch.Tensor:
        """C_Bonus"""
        return self.reached.float()

    @reward(0.0)
    def spin(self) -> torch.Tensor:
        """ours: turning about the axis"""
        most = self.task["reward"]["spin_max"]
        turned = (self.object_spin * self.axis).sum(1) * math.copysign(1.0, self.task["goal"]["angle"])
        return turned.clamp(-most, most)

    @reward(0.0)
    def lost(self) -> torch.Tensor:
        """ours: dropped or tipped"""
        return (self.dropped | self.tipped).float()

    @reward(0.0, name="velocity")
    def moving(self) -> torch.Tensor:
        """ours: joint speed"""
        return self.qd.square().sum(1)

    @reward(0.0, name="torque")
    def straining(self) -> torch.Tensor:
        """ours: motor torque"""
        return (self.torque / self.effort).square().sum(1)

    # -- what is seen: table "Observation for in-hand object rotation"
    def sense(self, fresh: torch.Tensor) -> None:
        self.sense_tips(fresh)
        if self.task["perception"] != "proprioception":
            self.sense_object(fresh)

    @observe("rad", noise="sensors.joint_noise")
    def joint_angle(self) -> torch.Tensor:
        """measured"""
        return self.q if self.clean else self.q + self.joint_bias

    @observe("rad", noise="sensors.joint_noise")
    def follower_angle(self) -> torch.Tensor:
        """measured, of joints without a drive"""
        return self.followers()

    @observe("rad/s", noise="sensors.velocity_noise", only="actor")
    def joint_velocity(self) -> torch.Tensor:
        """measured"""
        return self.qd

    @observe("1", mirror=SIX)
    def relative_orientation(self) -> torch.Tensor:
        """6D of R_object^T R_goal, both in the palm frame; object from its IMU"""
        if self.clean:
            return shared.relative(self.object_pose[:, 3:], self.goal, "6d")
        return shared.relative(self.seen, self.goal_seen(), self.task["observe"]["orientation"])

    @observe("1", name="last_action")
    def sent(self) -> torch.Tensor:
        """targets last sent, over each joint's range in [-1, 1]; or the action (observe.last_action=step)"""
        what = self.task["observe"].get("last_action", "step")
        return shared.sent(self.action, self.target, self.q_mid, self.q_half, what)

    @observe("m", mirror=VECTOR)
    def contact_centre(self) -> torch.Tensor:
        """mean of taxel positions, palm frame, weighted by force (observe.force_weighted)"""
        if self.clean or self.taxel_point is None:
            return self.touch_centre
        return self.plain_centre(self.taxel_point)[:, : self.pads]

    @observe("N")
    def contact_force(self) -> torch.Tensor:
        """sum of a pad's normal forces"""
        return self.touch_force

    @observe("m", noise="sensors.tip_noise", mirror=VECTOR)
    def fingertip_position(self) -> torch.Tensor:
        """palm frame, forward kinematics"""
        return self.tips

    @observe("1; m/s, rad/s", only="critic")
    def truth(self) -> dict[str, torch.Tensor]:
        """how object, fingertips and joints are and move, palm frame"""
        return {
            "object_orientation": rotation.six(self.object_pose[:, 3:]), "fingertip_velocity": self.tip_velocity,
            "fingertip_rotation": rotation.six_of_matrix(self.tip_rot), "joint_velocity": self.qd,
            "object_velocity": self.object_velocity[:, :3], "object_spin": self.object_spin,
        }  # fmt: skip

    @observe("SI", only="critic")
    def privileged(self) -> dict[str, torch.Tensor]:
        """ours, with task.critic=privileged or placed: drift does not tell a start at the palm's edge from others"""
        o, placed = self.objects, self.task["critic"] == "placed"
        return {
            "drift": self.object_pose[:, :3] - self.home, "object_size": o.size[:, :1], "object_mass": o.mass,
            "object_com": o.com, "object_friction": o.friction, "contact_damping": o.damping_ratio,
            "finger_force": self.finger_force, "palm_force": self.palm_force, "torque": self.torque,
            "target_error": self.target - self.q,
        } | ({"object_centre": self.object_pose[:, :3]} if placed else {})  # fmt: skip

    # -- what the log shows
    @metric("1/min", now=True)
    def successes_per_minute(self) -> torch.Tensor:
        return self.reached.float() * (60 / self.dt)

    @metric("goals in a row", name="successes")
    def in_a_row(self) -> torch.Tensor:
        return (self.successes + self.reached).float()

    @metric("rad", now=True)
    def rotation_error(self) -> torch.Tensor:
        return self.d_rot

    @metric("m", now=True)
    def drift(self) -> torch.Tensor:
        return self.d_pos

    @metric("rad/s", now=True, name="spin")
    def turning(self) -> torch.Tensor:
        return (self.object_spin * self.axis).sum(1)

    @metric("fingers", now=True)
    def tips_touching(self) -> torch.Tensor:
        return (self.touch.force_clean > 0.05).float().sum(1)

    def notes(self) -> list[str]:
        """Return notes on the held poses, and on when a goal counts."""
        assert self.grasps is not None  # since setup
        edge, r, far = 1000 * self.grasps.edge, self.task["reward"], float(self.farthest)
        what = "cubes" if self.names == (CUBE,) else ", ".join(self.names)
        return [f"{len(self.grasps)} held poses, {what} of {edge.min():.0f}-{edge.max():.0f} mm",
                f"reached: rotation error below {r['delta_rot']} rad and drift below"
                f" {self.unit * r['delta_pos']:.3g} m; dropped: {far:.3g} m from where it began"]  # fmt: skip
