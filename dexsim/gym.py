"""Tasks as gymnasium's environments: `import dexsim.gym` makes each known by its name, "dexsim/Grasp-v0".

    import dexsim.gym, gymnasium
    envs = gymnasium.make_vec("dexsim/Grasp-v0", num_envs=64)     # a gymnasium.vector.VectorEnv
    env = gymnasium.make("dexsim/Grasp-v0")                       # one world
    batch = gymnasium.make("dexsim/Grasp-v0", num_envs=64)        # a batch behind gymnasium.Env's own interface

Without that import, gymnasium takes the module in the name: "dexsim.gym:dexsim/Grasp-v0".
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from dexsim.learning.gym_env import GymVectorEnv


class GymEnv(gymnasium.Env):
    """The same as one ``gymnasium.Env``: of one world, or, with ``num_envs``, of a batch: then observations, rewards
    and ends have a leading axis of worlds, as those of :class:`GymVectorEnv`, and worlds begin anew by themselves."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 48}

    def __init__(self, task: str, num_envs: int | None = None, render_mode: str | None = None, **given: Any) -> None:
        self.vector = make_vector(task, num_envs or 1, render_mode, **given)
        self._batch = num_envs is not None
        self.metadata, self.render_mode = self.vector.metadata, render_mode
        spaces = ("observation_space", "action_space")
        for name in spaces:
            setattr(self, name, getattr(self.vector, name if self._batch else f"single_{name}"))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start new episodes."""
        super().reset(seed=seed)
        obs, info = self.vector.reset(seed=seed, options=options)
        return (obs, info) if self._batch else (obs[0], {k: v[0] for k, v in info.items()})

    def step(self, action: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Return one control step. Of one world, the observation that ends an episode is its own last one."""
        if self._batch:
            return self.vector.step(action)
        obs, reward, over, cut, info = self.vector.step(np.asarray(action)[None])
        last = info.pop("final_obs", None)
        ended = bool(over[0] or cut[0])
        info = {k: v[0] for k, v in info.items() if not k.startswith("_")}
        return (last if ended and last is not None else obs)[0], float(reward[0]), bool(over[0]), bool(cut[0]), info

    def render(self) -> Any:
        """Return a picture [H, W, 3] uint8 of the first world, without a display."""
        return None if self.render_mode is None else self.vector.env.render(0)

    def close(self) -> None:
        """Give back the worlds."""
        self.vector.close()


def make_vector(task: str, num_envs: int = 1, render_mode: str | None = None, **given: Any) -> GymVectorEnv:
    """Return the worlds of a task for gymnasium. given: of `dexsim.make_env` (device, seed, settings), and `group`,
    `as_torch`. Raises UserError."""
    from dexsim import api

    own = {k: given.pop(k) for k in ("group", "as_torch") if k in given}
    env = api.make_env(task=task, worlds=num_envs, **given)
    return GymVectorEnv(env, render_mode=render_mode or "rgb_array", **own)


def register() -> None:
    """Make every task that can be chosen by name known to gymnasium: task lift_it is "dexsim/LiftIt-v0"."""
    from dexsim.tasks import registry

    for entry in registry.entries():
        name = "".join(part.capitalize() for part in entry.name.replace("-", "_").split("_"))
        gymnasium.register(
            f"dexsim/{name}-v0", entry_point="dexsim.gym:GymEnv", vector_entry_point="dexsim.gym:make_vector",
            kwargs={"task": entry.name}, order_enforce=False, disable_env_checker=True,
        )  # fmt: skip


register()
