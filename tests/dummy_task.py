"""A tiny task for tests of the shell: N points on a line are pushed to a goal. Every part of the env contract, no
physics."""

from __future__ import annotations

import mujoco
import numpy as np
import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict

NAMES = ("left", "right")
XML = """<mujoco><worldbody><light pos="0 0 1"/><body><freejoint/><geom size="0.03" rgba=".9 .4 .2 1"/></body>
 </worldbody></mujoco>"""


class DummyEnv(VecEnv):
    """State x [N, 2]; action [N, 2] moves it; reward -|x - goal|; ends after `task.steps` steps or outside +-2."""

    def __init__(self, cfg, n_worlds, device, seed, engine):
        self.cfg, self.num_envs, self.num_actions, self.device = cfg, n_worlds, 2, device
        self.action_names, self.dt = NAMES, 0.05
        self.max_episode_length = int(cfg["task"]["steps"])
        self.episode_length_buf = torch.zeros(n_worlds, dtype=torch.long, device=device)
        self._x = torch.zeros(n_worlds, 2, device=device)
        self.rng = torch.Generator(device=device).manual_seed(seed)
        self._count = torch.zeros((), dtype=torch.long)
        self.keep_final_obs = False
        self.reset_all()

    def reset_all(self):
        self._restart(torch.ones(self.num_envs, dtype=torch.bool, device=self.device))

    def _restart(self, mask):
        fresh = torch.rand(self.num_envs, 2, generator=self.rng, device=self.device) * 2 - 1
        self._x.copy_(torch.where(mask[:, None], fresh, self._x))
        self.episode_length_buf[mask] = 0

    def get_observations(self):
        both = torch.cat([self._x, self._x.abs()], dim=1)
        return TensorDict({"actor": self._x, "critic": both}, batch_size=[self.num_envs])

    def step(self, actions):
        self._x += 0.1 * actions.clamp(-1, 1)  # a graph from a policy would stick to the state, as in a real task
        self.episode_length_buf += 1
        self._count += 1
        reward = 1.0 - self._x.abs().sum(1)
        lost = self._x.abs().amax(1) > 2
        late = (self.episode_length_buf >= self.max_episode_length) & ~lost
        extras = {"time_outs": late, "log": {"reward/near": reward.mean(), "hold": lost.float().mean()}}
        if self.keep_final_obs:
            extras["final_obs"] = self.get_observations().clone()
        self._restart(lost | late)
        return self.get_observations(), reward, lost | late, extras

    def check(self):
        """Do nothing: nothing can overflow here."""

    def describe(self):
        return {"observations": {"actor": [("x", 2, "m")], "critic": [("x", 2, "m"), ("x clean", 2, "m")]},
                "action": [(n, -1.0, 1.0, "-") for n in NAMES], "rewards": [("near", 1.0, "-|x|")],
                "terminations": [("lost", "|x| > 2")], "randomization": [("start", (-1.0, 1.0), "m")],
                "headline": ["reward/near"]}

    def state_dict(self):
        return {"x": self._x.clone(), "age": self.episode_length_buf.clone(), "count": self._count.clone(),
                "generator": self.rng.get_state()}

    def load_state_dict(self, state):
        self._x.copy_(state["x"])
        self.episode_length_buf[:] = state["age"]
        self._count.copy_(state["count"])
        self.rng.set_state(state["generator"].cpu())

    def scripted_policy(self):
        return lambda obs: -obs["actor"] * 10

    def evaluate(self, policy, episodes, seed, progress):
        self.rng.manual_seed(seed)
        self.reset_all()
        obs = self.get_observations()
        total = torch.zeros(self.num_envs)
        for step in range(self.max_episode_length - 1):
            obs, reward, _, _ = self.step(policy(obs))
            total += reward
            progress(step + 1, self.max_episode_length - 1)
        frames = 5
        qpos = np.zeros((frames, 7))
        qpos[:, 3] = 1
        overlay = {"force": np.ones((frames, 5)), "command": np.linspace(0, 5, frames)}

        def progress_plot(axes):
            axes.plot([0, 1], [0, 1])

        return {
            "metrics": {
                "episodes": episodes,
                "mean_return": float(total.mean()),
                "graph": self._x.requires_grad,
                "nothing": float("nan"),
            },
            "tables": [("by world", ("world", "return"), [(0, float(total[0]))])],
            "frames": {"model": [mujoco.MjModel.from_xml_string(XML)], "qpos": [qpos], "overlay": [overlay]},
            "plots": [("second", progress_plot), progress_plot],
        }


def make_env(cfg, n_worlds, device, seed, engine):
    return DummyEnv(cfg, n_worlds, device, seed, engine)
