"""Gymnasium-Robotics' Shadow hand with a block and touch sensors, one world, one thread. Needs no dexsim:

    python shadow_loop.py SECONDS
"""

from __future__ import annotations

import importlib.metadata
import json
import sys
import time
import warnings

warnings.filterwarnings("ignore")
import gymnasium as gym  # noqa: E402
import gymnasium_robotics  # noqa: E402
import numpy as np  # noqa: E402

NAME = "HandManipulateBlockRotateXYZ_ContinuousTouchSensors-v1"


def main(seconds: float) -> dict:
    """Environment steps per second of CPU time under random actions, and physics steps of a model second."""
    gym.register_envs(gymnasium_robotics)
    env = gym.make(NAME)
    obs, _ = env.reset(seed=0)
    env.action_space.seed(0)
    raw = env.unwrapped
    steps, start = 0, time.process_time()
    while time.process_time() - start < seconds:
        obs, _, terminated, truncated, _ = env.step(env.action_space.sample())
        steps += 1
        if terminated or truncated:
            env.reset()
    spent = time.process_time() - start
    touch = raw.model.nsensor
    return {"peer": f"{NAME}, gymnasium-robotics {importlib.metadata.version('gymnasium-robotics')}, mujoco"
                    f" {importlib.metadata.version('mujoco')}",
            "steps_per_cpu_s": steps / spent, "physics_per_step": int(raw.n_substeps),
            "timestep": float(raw.model.opt.timestep),
            "control_s": float(raw.n_substeps * raw.model.opt.timestep), "dofs": int(raw.model.nv),
            "sensors": int(touch),
            "observation": int(np.asarray(obs["observation"]).size)}


if __name__ == "__main__":
    print(json.dumps(main(float(sys.argv[1]))))
