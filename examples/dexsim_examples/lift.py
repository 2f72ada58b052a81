"""Lift objects from a table with a hand on a base of six servos, and hold them up against pushes."""

from __future__ import annotations

import torch

from dexsim import rotation
from dexsim.tasks import Base, Scene, Table, Task, done, event, memory, metric, observe, reward
from dexsim_examples import rows

UP = 0.05  # m
TOP = -0.13  # m, of the table


class Lift(Task):
    """Lift objects from a table with a moving hand, and hold them up against pushes."""

    scene = Scene(base=Base(palm="down", travel=0.15, turn=0.5), table=Table(top=TOP, centre=(0.05, 0.0)))
    camera = {"lookat": [0.04, 0.0, -0.02], "distance": 0.75, "azimuth": 130.0, "elevation": -20.0}
    settings = {
        "episode_s": 6.0,
        "objects": {
            "train": ["box", "sphere", "capsule", "cylinder", "rock", "egg", "hexprism", "wedge", "tee", "bracket",
                      "peanut", "bolt"],
            "emphasis": {"wedge": 3.0, "hexprism": 2.0, "tee": 2.0},
            "held_out": ["tetra", "pebble", "crescent", "cross"],
            "baked_scales": [1.0, 1.15],
        },
        "presets": {
            "cuda": {"worlds": 8192, "iterations": 500, "sim": {"control_period": 0.042}, "first_actions": 0.01,
                     "agent": {"num_steps_per_env": 16, "algorithm": {"entropy_coef": 0.002}}},
            "cpu": {"worlds": 128, "iterations": 200, "sim": {"control_period": 0.042}},
        },
    }  # fmt: skip
    randomize = {
        "object": {"scale": [0.95, 1.15], "mass": {"log": [0.03, 0.2]}, "friction": [0.6, 1.2]},
        "start": {"aside": [-0.03, 0.03]},
        "push": {"weights": [0.0, 1.5]},
    }

    rest = memory()  # m, height of the object's centre as it lies on the table
    held = memory()  # s, up without a break
    pushing = memory()  # s, left of a push
    force = memory(3)  # N

    def begin(self, mask):
        s, n = self.sampler, self.num_envs
        where = torch.tensor([0.05, 0.0, TOP + 0.005], device=self.device).expand(n, 3).clone()
        where[:, :2] += s.draw("start.aside", 2)
        where[:, 2] += self.objects.radius
        self.start(mask, "open", torch.cat([where, s.quaternion()], 1))

    @event(every_s=(1.0, 2.0))
    def pushed(self, mask):
        s = self.sampler
        force = s.direction() * (s.draw("push.weights") * self.objects.mass * 9.81)[:, None]
        self.force = torch.where(mask[:, None], force, self.force)
        self.pushing = torch.where(mask, 0.4, self.pushing)

    def update(self):
        z, young = self.object_pose[:, 2], self.age < 0.5
        self.rest = torch.where(young, z, torch.minimum(self.rest, z))
        self.held = torch.where(self.height() > UP, self.held + self.dt, 0.0)
        self.pushing -= self.dt
        on = (self.pushing > 0) & ~young & (self.height() > 0.02)  # what lies on the table is left in peace
        self.push(torch.where(on[:, None], self.force, 0.0))

    def height(self):
        """Of the object over where it lay [N], m."""
        return self.object_pose[:, 2] - self.rest

    def grip(self):
        """Share of a grip [N]: the thumb and at least one finger that press."""
        on = (self.tip_force > 0.1).float()
        return on[:, self.opposing].amax(1) * on[:, self.others].sum(1).clamp(max=3) / 3

    # -- what is seen
    @observe("rad, m", noise=0.002)
    def joint_position(self):
        """of hand and base, measured"""
        return self.q

    sent = rows.sent

    @observe("m", noise=0.003, delay=(0.0, 0.08))
    def object_place(self):
        """from a camera; then from the palm"""
        return torch.cat([self.object_pose[:, :3], self.object_pose[:, :3] - self.q[:, -6:-3]], 1)

    @observe("1, m", noise=0.02, delay=(0.0, 0.08))
    def object_form(self):
        """6D of its orientation, its radius"""
        return torch.cat([rotation.six(self.object_pose[:, 3:]), 10 * self.objects.radius[:, None]], 1)

    touch = rows.touch

    @observe("m")
    def fingertips(self):
        """to the object, from the measured angles and a camera"""
        return self.tips - self.object_pose[:, None, :3]

    @observe("rad/s, m/s, N", only="critic")
    def truth(self):
        """motion, forces, physics, push"""
        o = self.objects
        return torch.cat([self.qd, self.object_velocity, self.finger_force, self.palm_force[:, None], o.size,
                          10 * o.mass[:, None], o.com, o.friction[:, None], self.force, self.height()[:, None],
                          self.held[:, None]], 1)  # fmt: skip

    # -- what is paid
    @reward(0.5)
    def reach(self, length=0.06):
        """fingertips near the object"""
        return (-(self.tips - self.object_pose[:, None, :3]).norm(dim=2) / length).exp().mean(1)

    @reward(0.5)
    def gripping(self):
        """thumb and fingers press"""
        return self.grip()

    @reward(3.0)
    def raised(self, top=0.08):
        """height over the table, in a grip"""
        return (self.height() / top).clamp(0, 1) * (0.2 + 0.8 * self.grip())

    @reward(1.0)
    def up(self):
        """held up"""
        return (self.height() > UP + 0.01).float()

    @reward(-0.5)
    def swing(self):
        """speed of the object up there, m/s"""
        return self.object_velocity[:, :3].norm(dim=1).clamp(max=1.0) * (self.height() > 0.02)

    change = rows.change

    @done
    def gone(self, far=0.2):
        """off the table"""
        return ((self.object_pose[:, :2] - 0.05).norm(dim=1) > far) | (self.object_pose[:, 2] < TOP - 0.05)

    @metric("share")
    def held_up(self):
        return (self.held > 2.0).float()
