"""A dexsim environment as a ``gymnasium.vector.VectorEnv``: the same object, other conventions.

    envs = gymnasium.make_vec("dexsim/Grasp-v0", num_envs=64)      # any task, by its name; or
    envs = GymVectorEnv(dexsim.make_env(task=Lift, worlds=64))
    obs, info = envs.reset(seed=1)
    obs, reward, terminated, truncated, info = envs.step(envs.action_space.sample())
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from dexsim.errors import UserError


class GymVectorEnv(VectorEnv):
    """Worlds reset in the step that ends their episode (``AutoresetMode.SAME_STEP``).

    Observations [N, D] float32 are one group of the environment's, by default what the actor sees; the other groups
    are in ``info``. Actions [N, A] float32 lie in [-1, 1]. Where an episode ends, ``info["final_obs"]`` [N, D] holds
    its last observation for the worlds of ``info["_final_obs"]`` (rows of the others are not meaningful). Time limits
    are truncations, all else is termination.

    Args:
        env: the environment (rsl-rl's ``VecEnv``) with its generator ``rng`` and ``reset_all()``; it gives
            ``extras["final_obs"]`` once ``keep_final_obs`` is set.
        group: observation group to return.
        as_torch: return and take torch tensors on the environment's device instead of NumPy arrays.
    """

    def __init__(
        self, env: Any, group: str = "actor", as_torch: bool = False, render_mode: str | None = "rgb_array"
    ) -> None:
        first = env.get_observations()
        if group not in first.keys():
            raise UserError(f"group={group}: this environment has the observation groups {', '.join(first.keys())}")
        self.env, self.num_envs, self._group, self._torch = env, int(env.num_envs), group, as_torch
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": ["rgb_array"],
                         "render_fps": round(1 / env.dt)}  # fmt: skip
        self.render_mode = render_mode
        env.keep_final_obs = True
        size = first[group].shape[-1]
        self.single_observation_space = Box(-np.inf, np.inf, (size,), np.float32)
        self.single_action_space = Box(-1.0, 1.0, (int(env.num_actions),), np.float32)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start a new episode in every world; a seed makes what follows repeatable."""
        if seed is not None and not isinstance(seed, (int, np.integer)):
            raise UserError("seed: one whole number for all worlds")
        if seed is not None:
            self.env.rng.manual_seed(int(seed))
            torch.manual_seed(int(seed))
        with torch.no_grad():
            self.env.reset_all()
        obs = self.env.get_observations()
        return self._out(obs[self._group]), self._others(obs)

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Advance every world by one control step. ``actions`` [N, A] are clipped to [-1, 1]."""
        actions = torch.as_tensor(actions, dtype=torch.float32, device=self.env.device)
        if actions.shape != self.action_space.shape:
            raise UserError(f"actions have shape {tuple(actions.shape)}, must be {self.action_space.shape}")
        with torch.no_grad():
            obs, reward, done, extras = self.env.step(actions)
        done = done.bool()
        truncated = extras["time_outs"].bool() & done
        info = self._others(obs)
        if bool(done.any()):
            if "final_obs" in extras:
                info["final_obs"] = self._out(extras["final_obs"][self._group])
            info["_final_obs"] = self._out(done)
        return self._out(obs[self._group]), self._out(reward), self._out(done & ~truncated), self._out(truncated), info

    def render(self, worlds: int = 4) -> tuple[np.ndarray, ...] | None:
        """Return pictures [H, W, 3] uint8 of the first worlds, without a display; None with render_mode=None."""
        if self.render_mode is None:
            return None
        return tuple(self.env.render(k) for k in range(min(worlds, self.num_envs)))

    def close_extras(self, **kwargs: Any) -> None:
        """Close the environment, too (called by ``close``)."""
        getattr(self.env, "close", lambda: None)()

    def _others(self, obs: Any) -> dict[str, Any]:
        return {name: self._out(obs[name]) for name in obs.keys() if name != self._group}

    def _out(self, value: torch.Tensor) -> Any:
        """Return a copy (the environment changes its buffers in place): torch tensor or NumPy array."""
        value = value.detach().clone()
        return value if self._torch else value.cpu().numpy()
