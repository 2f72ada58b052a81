"""Reorient a cube in the palm: any orientation after any other, to 0.4 rad, goal after goal."""

import torch

from dexsim import rotation
from dexsim.tasks import Task, command, done, event, memory, metric, observe, reward
from dexsim_examples import rows

REACHED, PATIENCE = 0.4, 8.0  # rad; s of training per goal


class Reorient(Task):
    """Turn a cube in the palm to any orientation, one goal after another."""

    camera = {"lookat": [0.05, 0.0, 0.04], "distance": 0.36, "azimuth": 250.0, "elevation": -50.0}
    settings = {
        "episode_s": 24.0,
        "evaluation": {"cap_s": 200.0},
        "presets": {
            "cuda": {
                "worlds": 8192, "iterations": 3800, "sim": {"control_period": 0.042}, "first_actions": 0.01,
                "agent": {"num_steps_per_env": 12, "algorithm": {"gamma": 0.99, "entropy_coef": 0.003}},
            },
            "cpu": {"worlds": 128, "iterations": 200, "sim": {"control_period": 0.042}},
        },
    }  # fmt: skip
    weights = {"change": -0.0005}
    randomize = {"object": {"size": [0.045, 0.052], "mass": {"log": [0.03, 0.1]}}}

    angle = memory()  # rad, left to the goal
    tilt = memory()  # rad, between the cube's axes that point up now and at the goal
    progress = memory()  # rad, what the last step took off both
    goals = memory()  # reached in this episode
    since = memory()  # s, since the last goal
    reached = memory(dtype=torch.bool)
    home = memory(3)  # m, where the cube lay

    def prepare_task(self):
        q = torch.cartesian_prod(*[torch.tensor([-1.0, 0.0, 1.0])] * 4)
        q = q[(q.abs().sum(1) == 1) | (q.abs().sum(1) == 2) | (q.abs().sum(1) == 4)]
        self.alike = (q / q.norm(dim=1, keepdim=True)).to(self.device)  # turns of a cube onto itself, each twice

    def turn(self, pose):
        """Turn from a pose [N, 7] to the goal [N, 4], palm frame."""
        return rotation.multiply(self.commands["goal"], rotation.conjugate(pose[:, 3:]))

    def measure(self, pose):
        """Find what is left to the goal. A cube turns about the palm's normal at any time, but has to be tipped over
        its edges: so the tilt counts beside the angle, and to turn in order to tip costs little."""
        q = self.turn(pose)
        return rotation.angle(q), 2 * torch.atan2(q[:, 1:3].norm(dim=1), q[:, ::3].norm(dim=1))

    @command("1", only="rows")
    def goal(self):
        """orientation to reach, palm frame, w x y z"""
        return self.sampler.quaternion()

    def begin(self, mask):
        self.home = torch.where(mask[:, None], self.hold(mask)[:, :3], self.home)

    @event
    def aim(self, mask):
        angle, tilt = self.measure(self.object_pose)
        self.angle, self.tilt = torch.where(mask, angle, self.angle), torch.where(mask, tilt, self.tilt)

    def update(self):
        angle, tilt = self.measure(self.object_pose)
        self.progress = self.angle - angle + self.tilt - tilt
        self.reached = (angle < REACHED) & (self.drift() < 0.06) & ~self.nan
        self.goals += self.reached
        self.since += self.dt
        renew = self.reached | ((self.since > PATIENCE) & self.learning)
        self.since = torch.where(renew, 0.0, self.since)
        self.renew("goal", renew)
        self.angle, self.tilt = self.measure(self.object_pose)

    def drift(self):
        """Distance of the cube from where it lay at first [N], m."""
        return (self.object_pose[:, :3] - self.home).norm(dim=1)

    # -- what is seen
    joint_position, sent = rows.joint_position, rows.sent

    @observe("1", noise=0.02, delay=(0.0, 0.05), frames=3)
    def to_goal(self):
        """6D of the turn from the cube to its goal, palm frame, from a camera"""
        return rotation.six(self.turn(self.object_pose))

    @observe("1", noise=0.02, delay=(0.0, 0.05))
    def cube_turn(self):
        """6D of how the cube lies: of the 24 orientations that look alike, the one next to the palm's"""
        q = self.object_pose[:, 3:]
        alike = (q @ rotation.conjugate(self.alike).T).argmax(1)
        return rotation.six(rotation.multiply(q, self.alike[alike]))

    @observe("m", noise=0.002, delay=(0.0, 0.05), frames=3)
    def cube_position(self):
        """from a camera, palm frame"""
        return self.object_pose[:, :3]

    touch, fingertips = rows.touch, rows.fingertips

    @observe("rad/s, m/s, s", only="critic")
    def motion(self):
        """of joints and cube; time since the last goal"""
        return torch.cat([self.qd, self.object_velocity[:, :3], self.object_spin, self.since[:, None]], 1)

    @observe("N, kg, 1", only="critic")
    def physics(self):
        """forces of fingers and palm; size, mass, centre and friction of the cube"""
        o = self.objects
        return torch.cat([self.finger_force, self.palm_force[:, None], 10 * o.size, o.mass[:, None], o.com,
                          o.friction[:, None], self.torque], 1)  # fmt: skip

    # -- what is paid
    @reward(3.0)
    def nearer(self):
        """turned and tipped towards the goal, rad"""
        return self.progress.clamp(-1.0, 1.0)

    @reward(0.02)
    def closeness(self, epsilon=0.2):
        """closeness to the goal"""
        return 1 / (self.angle + epsilon)

    @reward(8.0)
    def bonus(self):
        """a goal reached"""
        return self.reached.float()

    @reward(-4.0)
    def lost(self):
        """the cube fell"""
        return self.dropped().float()

    @reward(-0.2)
    def away(self):
        """drift of the cube, m"""
        return self.drift().clamp(max=0.2)

    change = rows.change

    @done
    def dropped(self, below=0.0, far=0.1):
        """centre below the palm, or far from where it lay"""
        return (self.object_pose[:, 2] < below) | (self.drift() > far)

    @metric("goals in a row")
    def successes(self):
        return self.goals
