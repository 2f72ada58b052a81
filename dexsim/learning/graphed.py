"""rsl-rl's PPO update as a recorded CUDA graph: one replay a mini-batch, nothing read from the device until the end.

rsl-rl reads the device five times in each mini-batch (the divergence that steers the learning rate, three losses) and
launches some two hundred small kernels; the GPU waits for both. Here a mini-batch is recorded once and replayed: the
learning rate is a tensor on the device, and so are the sums of the losses. The mathematics is that of
`rsl_rl.algorithms.PPO.update` (Schulman et al., arXiv:1707.06347, with rsl-rl's adaptive learning rate), results are
equal up to rounding.
"""

from __future__ import annotations

import gc
from typing import Any

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from rsl_rl.modules.distribution import GaussianDistribution
from torch import nn

LOWEST, HIGHEST, FACTOR = 1e-5, 1e-2, 1.5
"""Bounds of rsl-rl's adaptive learning rate, and the step that it makes."""


def unsupported(alg: Any) -> str | None:
    """Return why this algorithm's update cannot be recorded, or None if it can."""
    if type(alg) is not PPO:
        return "the algorithm is not rsl-rl's PPO"
    if alg.is_multi_gpu:
        return "several processes learn together"
    if alg.rnd or alg.symmetry:
        return "it explores by RND or mirrors its batches"
    if alg.use_mixed_precision or alg.actor is not alg._raw_actor:
        return "mixed precision or torch.compile is on"
    if any(type(model) is not MLPModel for model in (alg.actor, alg.critic)):
        return "a network is not an MLPModel"
    if type(alg.optimizer) not in (torch.optim.Adam, torch.optim.AdamW):
        return "the optimizer is not Adam"
    return None


def sample_without_waiting(actor: Any) -> None:
    """Let a Gaussian actor draw its actions without reading the device: the same numbers, to the bit.

    `torch.normal` looks whether a standard deviation is negative, which makes the CPU wait for the GPU at every step;
    one that is an exponential or clamped to above 0 cannot be.
    """
    distribution: Any = getattr(actor, "distribution", None)
    if type(distribution) is not GaussianDistribution:
        return

    def sample() -> torch.Tensor:
        mean, std = distribution.params
        return torch.randn_like(mean).mul_(std).add_(mean).detach()

    distribution.sample = sample


class GraphedUpdate:
    """`alg.update()` of an rsl-rl PPO, recorded on CUDA; on a CPU the same program, not recorded (for tests).

    The first mini-batch runs as it is, so that all that is allocated once is there; the next is recorded. A change of
    what the record refers to (a checkpoint loaded into the optimizer) makes it anew.
    """

    def __init__(self, alg: PPO):
        self.alg = alg
        self.device = torch.device(alg.device)
        st = alg.storage
        self._size = st.num_envs * st.num_transitions_per_env // alg.num_mini_batches
        self._chosen = torch.zeros(self._size, dtype=torch.long, device=self.device)
        self._advantages = torch.zeros(st.num_envs * st.num_transitions_per_env, 1, device=self.device)
        self._inputs: list[torch.Tensor] = []
        self._rate = torch.zeros((), dtype=torch.float64, device=self.device)
        self._rate32 = torch.zeros((), device=self.device)
        self._sums = torch.zeros(3, device=self.device)
        self._graph: torch.cuda.CUDAGraph | None = None
        self._key: tuple[int, ...] = ()
        self._warm = False

    def update(self) -> dict[str, float]:
        """Learn from the storage's rollout; mean losses by name, as rsl-rl's `update`."""
        alg, st = self.alg, self.alg.storage
        self._prepare()
        group = alg.optimizer.param_groups[0]
        options = {name: group[name] for name in ("lr", "fused", "foreach", "capturable")}
        on_gpu = self.device.type == "cuda"
        rate = self._rate32 if on_gpu else alg.learning_rate
        group.update(lr=rate, fused=on_gpu or None, foreach=None, capturable=on_gpu)
        try:
            count = alg.num_mini_batches * self._size
            order = torch.randperm(count, device=self.device)
            for _ in range(alg.num_learning_epochs):
                for k in range(alg.num_mini_batches):
                    self._chosen.copy_(order[k * self._size : (k + 1) * self._size])
                    self._run()
            totals = torch.cat([self._sums.double(), self._rate[None]]).tolist()
        finally:
            group.update(options)
        alg.learning_rate = totals[3]
        for g in alg.optimizer.param_groups:
            g["lr"] = alg.learning_rate
        observations = st.observations.flatten(0, 1)
        for model in (alg.actor, alg.critic):
            model.update_normalization(observations)
        st.clear()
        means = [s / (alg.num_learning_epochs * alg.num_mini_batches) for s in totals[:3]]
        return dict(zip(("value", "surrogate", "entropy"), means, strict=True))

    def _prepare(self) -> None:
        """Put where the record looks what changes from one update to the next."""
        alg, st = self.alg, self.alg.storage
        self._rate.fill_(alg.learning_rate)
        self._rate32.fill_(alg.learning_rate)
        self._sums.zero_()
        self._advantages.copy_(st.advantages.flatten(0, 1))
        with torch.no_grad():  # the running normalization holds still during an update: once for all mini-batches
            for n, model in enumerate((alg.actor, alg.critic)):
                latent = model.get_latent(st.observations.flatten(0, 1))
                if n == len(self._inputs):
                    self._inputs.append(latent.contiguous())
                else:
                    self._inputs[n].copy_(latent)
        if self.device.type == "cuda":
            for state in alg.optimizer.state.values():
                state["step"] = state["step"].to(device=self.device, dtype=torch.float32)

    def _run(self) -> None:
        if self.device.type != "cuda":
            self._mini_batch()
            return
        key = self._refers_to()
        if self._graph is not None and key == self._key:
            self._graph.replay()
        elif not self._warm or key != self._key:
            self._graph, self._warm = None, True
            side, here = self._side(), torch.cuda.current_stream()
            side.wait_stream(here)
            with torch.cuda.stream(side):
                self._mini_batch()
            here.wait_stream(side)
            self._key = self._refers_to()
        else:
            gc.collect()
            gc.disable()  # a graph destroyed during a capture would be recorded into it
            try:
                self.alg.optimizer.zero_grad(set_to_none=True)
                graph = torch.cuda.CUDAGraph()
                with torch.cuda.graph(graph, stream=self._side(), capture_error_mode="thread_local"):
                    self._mini_batch()
            finally:
                gc.enable()
            self._graph = graph
            graph.replay()

    def _side(self) -> torch.cuda.Stream:
        if not hasattr(self, "_stream"):
            self._stream = torch.cuda.Stream(self.device)
        return self._stream

    def _refers_to(self) -> tuple[int, ...]:
        """Return the addresses of all that a record reads and that others could replace."""
        st, tensors = self.alg.storage, []
        for model in (self.alg.actor, self.alg.critic):
            tensors += list(model.parameters())
        for state in self.alg.optimizer.state.values():
            tensors += [value for value in state.values() if isinstance(value, torch.Tensor)]
        tensors += [st.actions, st.values, st.returns, st.actions_log_prob, *(st.distribution_params or ())]
        return tuple(t.data_ptr() for t in tensors)

    def _mini_batch(self) -> None:
        """Take one step of the optimizer on the samples `_chosen`."""
        alg, st = self.alg, self.alg.storage
        actor, critic, distribution = alg.actor, alg.critic, alg.actor.distribution

        def chosen(x: torch.Tensor) -> torch.Tensor:
            return x.flatten(0, 1).index_select(0, self._chosen)

        advantages = self._advantages.index_select(0, self._chosen)
        if alg.normalize_advantage_per_mini_batch:
            advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        advantages = advantages.squeeze(-1)
        old_values, returns = chosen(st.values), chosen(st.returns)
        old_log_prob = chosen(st.actions_log_prob).squeeze(-1)
        old_params = tuple(chosen(p) for p in st.distribution_params)

        distribution.update(actor.mlp(self._inputs[0].index_select(0, self._chosen)))
        log_prob = actor.get_output_log_prob(chosen(st.actions))
        values = critic.mlp(self._inputs[1].index_select(0, self._chosen))
        entropy = actor.output_entropy.mean()
        if alg.desired_kl is not None and alg.schedule == "adaptive":
            with torch.no_grad():
                self._adapt(actor.get_kl_divergence(old_params, actor.output_distribution_params).mean())

        ratio = torch.exp(log_prob - old_log_prob)
        clipped = ratio.clamp(1.0 - alg.clip_param, 1.0 + alg.clip_param)
        surrogate = torch.max(-advantages * ratio, -advantages * clipped).mean()
        if alg.use_clipped_value_loss:
            near = old_values + (values - old_values).clamp(-alg.clip_param, alg.clip_param)
            value = torch.max((values - returns).pow(2), (near - returns).pow(2)).mean()
        else:
            value = (returns - values).pow(2).mean()
        loss = surrogate + alg.value_loss_coef * value - alg.entropy_coef * entropy
        alg.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        for model in (actor, critic):
            nn.utils.clip_grad_norm_(model.parameters(), alg.max_grad_norm)
        alg.optimizer.step()
        with torch.no_grad():
            self._sums += torch.stack((value, surrogate, entropy))

    def _adapt(self, kl: torch.Tensor) -> None:
        """Adapt the learning rate as rsl-rl does, on the device."""
        alg, rate = self.alg, self._rate
        lower, higher = (rate / FACTOR).clamp(min=LOWEST), (rate * FACTOR).clamp(max=HIGHEST)
        up = (kl < alg.desired_kl / 2.0) & (kl > 0.0)
        rate.copy_(torch.where(kl > alg.desired_kl * 2.0, lower, torch.where(up, higher, rate)))
        self._rate32.copy_(rate)
        if self.device.type != "cuda":
            for group in alg.optimizer.param_groups:
                group["lr"] = float(rate)
