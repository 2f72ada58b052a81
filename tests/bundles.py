"""Checkpoints and bundles made for tests: an untrained grasp policy with a normalization that is not the identity."""

from __future__ import annotations

from pathlib import Path

import torch
from worlds import task_cfg

from dexsim.learning import checkpoint
from dexsim.learning.ppo import agent_config

QUIET = (
    "task.sensors.joint_noise=0",
    "task.sensors.torque_noise=0",
    "task.sensors.tip_noise=0",
    "task.sensors.vision_z_noise=0",
    "task.sensors.vision_delay=[0,0]",
    "randomize.sensors.vision_xy=0",
    "randomize.sensors.torque_bias=0",
)
"""Sensors without noise, bias or delay: what a recording of the truth can reproduce."""


QUIET_TURN = (
    "task.sensors.joint_noise=0",
    "task.sensors.velocity_noise=0",
    "task.sensors.tip_noise=0",
    "task.sensors.imu_noise=0",
    "task.sensors.imu_heading_walk=0",
    "randomize.sensors.joint_bias=0",
    "randomize.imu.delay=0",
    "randomize.imu.heading_rate=0",
    "randomize.imu.tilt=0",
)
"""The same for the rotation."""


def make_checkpoint(path: Path, *settings: str, seed: int = 0, task: str = "grasp") -> Path:
    """Return a policy checkpoint of a task with random weights."""
    from rsl_rl.utils import resolve_class

    from dexsim.learning.ppo import agent_errors
    from dexsim.tasks import make_env

    cfg = task_cfg("agent.actor.hidden_dims=[32,32]", *settings, worlds=1, task=task)
    env = make_env(cfg, 1, "cpu", seed, "mujoco")
    torch.manual_seed(seed)
    agent = agent_config(cfg, "cpu")
    with agent_errors():
        kind, rest = resolve_class(agent["actor"])
        actor = kind(env.get_observations(), agent["obs_groups"], "actor", env.num_actions, **rest)
    state = actor.state_dict()
    size = state["obs_normalizer._mean"].shape
    state["obs_normalizer._mean"] = 0.3 * torch.randn(size)
    state["obs_normalizer._var"] = 0.2 + torch.rand(size)
    state["obs_normalizer._std"] = state["obs_normalizer._var"].sqrt()
    checkpoint.save(path, {
        "kind": "policy", "config": cfg, "versions": {"dexsim": "0.1.0"}, "git": {"commit": "unknown", "dirty": False},
        "layout": checkpoint.layout_of(env), "iteration": 3, "steps": 72, "actor": state})  # fmt: skip
    return path
