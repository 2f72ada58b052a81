"""A rollout of rsl-rl's PPO in few launches: what is not needed to act is computed once, when the rollout is over.

rsl-rl computes values, log-probabilities and returns step by step, in some hundred small kernels a step. Actions need
only the actor; values of all steps are one pass of the critic over what was stored, log-probabilities, bootstrapped
rewards and generalized advantages (Schulman et al., arXiv:1506.02438) are one kernel over worlds.
"""

from __future__ import annotations

from typing import Any

import torch
import warp as wp
from rsl_rl.algorithms import PPO

from dexsim.learning import ppo_kernels
from dexsim.tasks.structs import filled


class Rollout:
    """`act`, `process_env_step` and `compute_returns` of an rsl-rl PPO whose update can be recorded
    (:func:`dexsim.learning.graphed.unsupported`). T steps, N worlds, A actions."""

    def __init__(self, alg: PPO):
        wp.init()
        self.alg, st = alg, alg.storage
        self._shape = st.actions.shape
        st.distribution_params = torch.zeros_like(st.actions), torch.zeros_like(st.actions)
        self._time_outs = torch.zeros(self._shape[:2], device=st.device)
        self._noise = self._std = torch.empty(0)

    def act(self, obs: Any) -> torch.Tensor:
        """Store observations; return actions [N, A], drawn."""
        st, actor = self.alg.storage, self.alg.actor
        t = st.step
        st.observations[t].copy_(obs)
        mean = actor.mlp(actor.get_latent(obs))
        if t == 0:
            actor.distribution.update(mean[:1])
            self._std = actor.distribution.std
            st.distribution_params[1].copy_(self._std)
            self._noise = torch.randn(self._shape, device=st.device)
        st.distribution_params[0][t].copy_(mean)
        return torch.addcmul(mean, self._std, self._noise[t], out=st.actions[t])

    def store(self, rewards: torch.Tensor, dones: torch.Tensor, time_outs: torch.Tensor | None) -> None:
        """Store what a step gave: rewards, dones and time-outs [N]."""
        st = self.alg.storage
        st.rewards[st.step].copy_(rewards.view(-1, 1))
        st.dones[st.step].copy_(dones.view(-1, 1))
        if time_outs is not None:
            self._time_outs[st.step].copy_(time_outs)
        st.step += 1

    def compute_returns(self, obs: Any) -> None:
        """Fill values, log-probabilities, returns and advantages. obs: those after the last step."""
        alg, st = self.alg, self.alg.storage
        for t in range(0, self._shape[0], 6):
            part = st.observations[t : t + 6]
            st.values[t : t + 6].view(-1, 1).copy_(alg.critic(part.flatten(0, 1)))
        steps = filled(
            ppo_kernels.Steps, actions=st.actions, mean=st.distribution_params[0], std=self._std[0],
            rewards=st.rewards[..., 0], values=st.values[..., 0], last=alg.critic(obs)[:, 0], dones=st.dones[..., 0],
            time_outs=self._time_outs, gamma=alg.gamma, lam=alg.lam,
        )  # fmt: skip
        st.advantages = torch.empty_like(st.returns)
        out = [wp.from_torch(x[..., 0]) for x in (st.actions_log_prob, st.returns, st.advantages)]
        wp.launch(ppo_kernels.returns, dim=self._shape[1], inputs=[steps, *out], device=str(st.device))
        if not alg.normalize_advantage_per_mini_batch:
            st.advantages = (st.advantages - st.advantages.mean()) / (st.advantages.std() + 1e-8)
