"""Keeps of an environment what a checkpoint holds."""

from __future__ import annotations

import zlib

import torch

from dexsim.tasks import worlds
from dexsim.tasks.episodes import Episodes


class Kept(Episodes):
    """Worlds that a run goes on with as if it had not stopped; see `HandEnv`."""

    def memory(self) -> dict[str, torch.Tensor | tuple[torch.Tensor, int, int]]:
        """Return the state that a control step leaves to the next, live; a task adds its own. Whole numbers with
        their lowest and highest."""
        names = ("action", "last_action", "target", "q", "qd", "torque", "object_pose", "object_velocity", "tips")
        out = {name: getattr(self, name) for name in (*names, "nan")}
        out |= {f"obs_{group}": value for group, value in self.obs.items()}
        return out | {"episode_length": (self._episode_length, 0, 2**31), "width": self.sampler.width}

    def keep_worlds(self) -> dict[str, torch.Tensor]:
        """Return a copy of all worlds: with it, a run goes on as if it had not stopped (`tasks/worlds.py`)."""
        return worlds.keep(self)

    def load_worlds(self, state: dict[str, torch.Tensor]) -> None:
        """Go on from `keep_worlds()`. Raises ValueError, and changes nothing, for those of another environment."""
        worlds.put_back(self, state)

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Return what a resumed run needs beside the worlds: counters and random state."""
        return {"rng": self.rng.get_state(), "nan_count": self.nan_count.clone()}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        rng = state["rng"].cpu()
        if rng.shape == self.rng.get_state().shape:
            self.rng.set_state(rng)
        else:  # learned until now on another kind of device, whose generator is another one
            self.rng.manual_seed(zlib.crc32(rng.numpy().tobytes()))
        self.nan_count.copy_(state["nan_count"])
        self.reset_all()
