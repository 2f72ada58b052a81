"""Symmetric samples for rsl-rl's `Symmetry`, by what a task declares in `HandEnv.symmetries` (`agent=ppo_symmetric`).

Mittal et al., "Symmetry Considerations for Learning Task Symmetric Robot Policies", ICRA 2024.
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict

from dexsim.errors import UserError


def augmented(
    env: Any, obs: TensorDict | None, actions: torch.Tensor | None
) -> tuple[TensorDict | None, torch.Tensor | None]:
    """Return observations [B, ...] and actions [B, A], then those of every symmetric situation: [(1 + S) B, ...].

    env: one with `symmetries()` and `describe()`. Raises UserError where it declares no symmetry.
    """
    every = env.symmetries()
    if not every:
        raise UserError(
            f"agent=ppo_symmetric: task {env.task['name']} declares no symmetry, as it is set here; use agent=ppo"
        )
    if obs is not None:
        rows: Any = obs.items()
        groups = {name: torch.cat([x, *(_turned(env, name, x, by) for by in every)]) for name, x in rows}
        obs = TensorDict(groups, batch_size=[len(next(iter(groups.values())))], device=obs.device)
    if actions is not None:
        actions = torch.cat([actions, *(by["action"](actions) if "action" in by else actions for by in every)])
    return obs, actions


def _turned(env: Any, group: str, value: torch.Tensor, by: Any) -> torch.Tensor:
    """Return a group's observations [B, D] as the symmetric situation has them, row by row of its table."""
    past = env.history if group == "actor" else 1
    rows = [(name, width // past) for name, width, *_ in env.describe()["observations"][group]]
    if not any(name in by for name, _ in rows):
        return value
    split = value.view(-1, value.shape[1] // past).split([width for _, width in rows], 1)
    turned = [by[name](part) if name in by else part for (name, _), part in zip(rows, split, strict=True)]
    return torch.cat(turned, 1).view(value.shape)
