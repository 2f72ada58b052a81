"""Spin a stick about its middle on the fingers, turn after turn."""

from __future__ import annotations

import math

import torch

from dexsim import rotation
from dexsim.tasks import Task, done, memory, metric, observe, reward
from dexsim_examples import rows

RADIUS, HALF = (0.008, 0.011), (0.045, 0.06)  # m, of the stick: radius, half its length


class Spin(Task):
    """Turn a stick about its middle between the fingers, turn after turn."""

    settings = {
        "episode_s": 12.0,
        "evaluation": {"cap_s": 60.0},
        "objects": {"train": ["capsule"]},
        "presets": {
            "cuda": {
                "worlds": 8192, "iterations": 3000, "sim": {"control_period": 0.042}, "first_actions": 0.01,
                "agent": {"num_steps_per_env": 12, "algorithm": {"gamma": 0.99, "entropy_coef": 0.002}},
            },
            "cpu": {"worlds": 128, "iterations": 200, "sim": {"control_period": 0.042}},
        },
    }  # fmt: skip
    randomize = {"object": {"mass": {"log": [0.02, 0.06]}, "friction": [0.6, 1.2], "com": [-0.02, 0.02]},
                 "start": {"heading": [-3.1416, 3.1416], "aside": [-0.008, 0.008]}}  # fmt: skip

    heading = memory()  # rad, of the stick about the palm's normal
    turned = memory()  # rad, since the episode began
    moved = memory()  # rad, in the last step
    home = memory(3)  # m

    def prepare_task(self):
        pose = self.pose("open")
        pose[[self.joints.index(j) for j in self.joints if j.endswith("joint1") and "thumb" not in j]] = 0.25
        pose[[self.joints.index(j) for j in self.joints if j.endswith("joint2") and "thumb" not in j]] = 0.45
        self.ready = pose
        self.base = self.objects.primitive_size(torch.zeros(1, dtype=torch.long, device=self.device),
                                                torch.ones(1, 3, device=self.device))  # fmt: skip

    def begin(self, mask):
        s, n = self.sampler, self.num_envs
        u = s.uniform(2)
        size = torch.stack([RADIUS[0] + (RADIUS[1] - RADIUS[0]) * u[:, 0], HALF[0] + (HALF[1] - HALF[0]) * u[:, 1]], 1)
        scale = torch.cat([size / self.base[:, :2], torch.ones(n, 1, device=self.device)], 1)
        self.give_object(mask, torch.zeros(n, dtype=torch.long, device=self.device), scale)
        heading, zero = s.draw("start.heading"), torch.zeros(n, device=self.device)
        lay = rotation.from_vector(torch.stack([zero, zero + math.pi / 2, zero], 1))  # the capsule's z lies along x
        turn = rotation.from_vector(torch.stack([zero, zero, heading], 1))
        where = torch.tensor([0.075, 0.0, 0.052], device=self.device).expand(n, 3).clone()
        where[:, :2] += s.draw("start.aside", 2)
        self.start(mask, self.ready, torch.cat([where, rotation.multiply(turn, lay)], 1))
        self.heading = torch.where(mask, heading, self.heading)
        self.home = torch.where(mask[:, None], where, self.home)

    def along(self):
        """Unit vector along the stick [N, 3]."""
        z = torch.zeros_like(self.object_pose[:, :3])
        z[:, 2] = 1.0
        return rotation.rotate(self.object_pose[:, 3:], z)

    def update(self):
        a = self.along()
        now = torch.atan2(a[:, 1], a[:, 0])
        off = now - self.heading
        self.moved = torch.atan2(off.sin(), off.cos())
        self.heading = now
        self.turned += torch.nan_to_num(self.moved)

    # -- what is seen
    joint_position, sent = rows.joint_position, rows.sent

    @observe("m, 1", noise=0.002, delay=(0.0, 0.05))
    def stick(self):
        """middle and direction, from a camera, palm frame"""
        return torch.cat([self.object_pose[:, :3], 0.05 * self.along()], 1)

    touch, fingertips = rows.touch, rows.fingertips

    @observe("rad/s, m/s", only="critic")
    def motion(self):
        """joints, stick"""
        return torch.cat([self.qd, self.object_velocity[:, :3], self.object_spin], 1)

    @observe("N, m, kg, 1", only="critic")
    def physics(self):
        """forces of fingers and palm; size, mass and friction of the stick"""
        o = self.objects
        return torch.cat([self.finger_force, self.palm_force[:, None], 10 * o.size, 10 * o.mass[:, None],
                          o.friction[:, None]], 1)  # fmt: skip

    # -- what is paid
    @reward(0.5)
    def spin(self, fastest=4.0):
        """turning about the palm's normal, rad/s"""
        return (self.moved / self.dt).clamp(-fastest, fastest)

    @reward(-4.0)
    def away(self):
        """drift of its middle, m"""
        return (self.object_pose[:, :3] - self.home).norm(dim=1).clamp(max=0.15)

    @reward(-0.3)
    def tilted(self):
        """out of level"""
        return self.along()[:, 2].abs()

    @reward(-20.0)
    def lost(self):
        """the stick fell"""
        return self.dropped().float()

    change = rows.change

    @done
    def dropped(self, below=0.0, far=0.07, tilt=0.8):
        """its middle far from where it lay, or it stands on end"""
        away = (self.object_pose[:, :3] - self.home).norm(dim=1) > far
        return away | (self.object_pose[:, 2] < below) | (self.along()[:, 2].abs() > tilt)

    @metric("turns")
    def turns(self):
        return self.turned / (2 * math.pi)
