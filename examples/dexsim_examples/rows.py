"""Rows of the observation that several skills see, and a reward that they pay: a class lists the ones it wants."""

from dexsim.tasks import observe, reward


@observe("rad", noise=0.003)
def joint_position(self):
    """measured"""
    return self.q


@observe("1")
def sent(self):
    """targets last sent, over each joint's range"""
    return (self.target - self.q_mid) / self.q_half


@observe("N")
def touch(self):
    """sum of a pad's normal forces"""
    return self.touch_force


@observe("m")
def fingertips(self):
    """from the measured angles"""
    return self.tips


@reward(-0.002)
def change(self):
    """change of the action"""
    return (self.action - self.last_action).square().sum(1)
