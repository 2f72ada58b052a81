"""A scripted pinch holds a 50 g box by the fingertips alone, palm vertical, without it sinking: friction, rubber and
drives agree."""

from __future__ import annotations

import pytest
import torch

from dexsim.cli import start
from dexsim.paths import CONFIGS
from dexsim.tasks.rotate import RotateEnv
from dexsim.tasks.stable_grasps import GraspSet

MASS, FRICTION, EDGE = 0.05, 0.9, 0.0403  # kg, 1, m
FINGER_OF = [0, 0, 0, 1, 1, 1, 2, 2, 3, 3, 4, 4]  # of each joint
OPEN = (1.248, 0.371, 0.951, 0.0, 0.387, 0.87, 0.387, 0.87, 0.387, 0.87, 0.387, 0.87)  # rad, SDK order
POSE = (0.0560, -0.0005, 0.0940, 0.9861, 0.0120, 0.1440, -0.0819)  # of the box between thumb and fingers, palm frame
CLOSING = (1, 0, 0, 0, 1, 1, 1, 1, 1, 1, 0, 0)  # joints that move
SPEED, PRESS = 0.8, 0.12  # rad/s until a tip touches; rad by which it then presses on
FINGERS_UP = (-9.81, 0.0, 0.0)  # m/s2, gravity in the palm frame: the palm is vertical


def pinch(engine: str, gravity: tuple, friction: float = FRICTION, seconds: float = 5.0) -> dict[str, torch.Tensor]:
    """Close on the weightless box, turn gravity on, wait. Two worlds that differ by a millimetre in where the box
    begins."""
    cfg = start.for_train(
        [
            "task=rotate",
            "device=cpu",
            "randomize=rotate_fixed",
            f"randomize.object.mass={MASS}",
            f"randomize.object.friction={friction}",
            "sim.control_period=0.021",
            "worlds=2",
        ],
        CONFIGS,
    ).cfg
    torch.set_num_threads(1)
    hand, pose = torch.tensor([OPEN, OPEN]), torch.tensor([POSE, POSE])
    pose[1, 2] += 0.001
    env = RotateEnv(cfg, 2, "cpu", 0, engine, grasps=GraspSet(torch.full((2,), EDGE), hand, hand, pose))
    env.in_order = True
    env.reset_all()
    g, closing = env.engine.field("opt.gravity"), torch.tensor(CLOSING).float()
    g.zero_()
    touched = torch.zeros(2, 5, dtype=torch.bool)

    def play(duration: float, close: bool) -> None:
        for _ in range(round(duration / env.dt)):
            if close:
                first = (env.tip_force > 0.05) & ~touched
                target = torch.where(touched[:, FINGER_OF], env.target, env.target + closing * SPEED * env.dt)
                target = torch.where(first[:, FINGER_OF], env.q + closing * PRESS, target)
                touched.logical_or_(first)
                env.target.copy_(torch.maximum(torch.minimum(target, env.q_high), env.q_low))
            env.servo.send(env.target)
            env.engine.step(env.decimation, env.servo.before_each, env.touch.launch)
            env.read_state()

    play(1.5, True)
    play(0.5, False)
    down = torch.tensor(gravity)
    g[:] = down.to(g.dtype)
    before = env.object_pose.clone()
    play(seconds, False)
    return {
        "sunk": ((env.object_pose[:, :3] - before[:, :3]) @ down) / down.norm(),
        "moved": (env.object_pose - before)[:, :3].norm(dim=1),
        "tips": env.tip_force.clone(),
        "other": (env.finger_force - env.tip_force).abs().amax(1) + env.palm_force,
    }


def check(r: dict[str, torch.Tensor]) -> None:
    assert (r["sunk"].abs() < 0.005).all() and (r["moved"] < 0.008).all(), r
    assert (r["other"] < 1e-3).all(), r  # by the fingertips alone
    assert (r["tips"][:, 0] > 0.05).all() and (r["tips"][:, 1:].sum(1) > 0.05).all(), r


def test_a_pinch_holds_on_c_mujoco():
    """Measured: sunk by less than 1 mm in 5 s."""
    check(pinch("mujoco", FINGERS_UP))


def test_a_slippery_box_falls():
    """The test can fail: with a friction of 0.05 the box is gone."""
    r = pinch("mujoco", FINGERS_UP, friction=0.05, seconds=1.5)
    assert (r["sunk"] > 0.02).all()


@pytest.mark.slow
def test_a_pinch_holds_on_mujoco_warp():
    check(pinch("warp", FINGERS_UP))
