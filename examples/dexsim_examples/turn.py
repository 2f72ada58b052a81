"""Turn a knob with friction ten times round, until its stop, and back."""

from __future__ import annotations

import math

import torch

from dexsim.tasks import Hinge, Scene, Task, done, memory, metric, observe, reward
from dexsim_examples import rows

TURNS = 10  # there, and as many back
LAST = 2 * math.pi * (TURNS + 0.5)  # rad, where the knob stops


class Turn(Task):
    """Turn a knob with friction until ten turns are done, and back again."""

    scene = Scene(object=Hinge(at=(0.052, 0.005, 0.062), axis=(0, 0, 1), range=(-math.pi, LAST), friction=0.01))
    settings = {
        "episode_s": 10.0,
        "evaluation": {"cap_s": 120.0},
        "objects": {"train": ["hexprism"], "baked_scales": [1.0, 1.1, 1.2]},
        "presets": {
            "cuda": {
                "worlds": 8192, "iterations": 2500, "sim": {"control_period": 0.042}, "first_actions": 0.01,
                "agent": {"num_steps_per_env": 12, "algorithm": {"gamma": 0.99, "entropy_coef": 0.002}},
            },
            "cpu": {"worlds": 128, "iterations": 200, "sim": {"control_period": 0.042}},
        },
    }  # fmt: skip
    randomize = {"knob": {"friction": [0.005, 0.03]}}  # N.m

    way = memory()  # +1 there, -1 back
    most = memory()  # rad, farthest there
    back = memory()  # rad, turned back from there
    finished = memory(dtype=torch.bool)

    def prepare_task(self):
        self.at, self.dof = self.q_of("object_joint"), self.v_of("object_joint")

    def begin(self, mask):
        s = self.sampler
        angle, way = s.uniform() * LAST, torch.where(s.uniform() < 0.5, -1.0, 1.0)
        if not self.learning:  # judged from the beginning on
            angle, way = torch.zeros_like(angle), torch.ones_like(way)
        friction = self.engine.field("dof_frictionloss")
        drawn = s.draw("knob.friction").to(friction.dtype)
        friction[:, self.dof] = torch.where(mask, drawn, friction[:, self.dof])
        self.start(mask, "cupped", also={self.at: angle})
        self.way, self.most = torch.where(mask, way, self.way), torch.where(mask, angle, self.most)

    def update(self):
        angle, first = self.object_joint, 2 * math.pi * TURNS
        self.most = torch.where(self.way > 0, torch.maximum(self.most, angle), self.most)
        self.back = torch.where(self.way < 0, self.most - angle, self.back)
        arrived = (self.way < 0) & (angle <= 0.0)
        self.finished = arrived & (self.most >= first)
        turn = ((self.way > 0) & (angle >= first)) | (arrived & self.learning)
        self.way = torch.where(turn, -self.way, self.way)

    # -- what is seen
    joint_position, sent = rows.joint_position, rows.sent

    @observe("1", noise=0.02, delay=(0.0, 0.05))
    def knob(self):
        """cosine and sine of its angle, from a camera"""
        return torch.stack([self.object_joint.cos(), self.object_joint.sin()], 1)

    @observe("1")
    def direction(self):
        """which way to turn"""
        return self.way

    touch, fingertips = rows.touch, rows.fingertips

    @observe("rad/s", only="critic")
    def motion(self):
        """joints, knob"""
        return torch.cat([self.qd, self.object_speed[:, None]], 1)

    @observe("N, N.m, 1", only="critic")
    def physics(self):
        """forces of the fingers, friction of knob and surface"""
        dry = self.engine.field("dof_frictionloss")[:, self.dof].float()
        return torch.cat([self.finger_force, 30 * dry[:, None], self.objects.friction[:, None], self.torque], 1)

    # -- what is paid
    @reward(0.5)
    def turning(self, fastest=6.0):
        """speed of the knob the way it should go, rad/s"""
        return (self.way * self.object_speed).clamp(-fastest, fastest)

    change = rows.change

    @reward(-0.02)
    def on_itself(self):
        """what fingers press on the hand with, N"""
        return self.self_force.sum(1).clamp(max=20.0)

    @done
    def complete(self):
        """there and back"""
        return self.finished

    @metric("turns")
    def there(self):
        return self.most / (2 * math.pi)

    @metric("turns")
    def and_back(self):
        return self.back / (2 * math.pi)

    @metric("share")
    def done_both(self):
        return self.finished.float()
