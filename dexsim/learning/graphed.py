"""rsl-rl's PPO update as recorded CUDA graphs: one replay a mini-batch, nothing read from the device until the end.

rsl-rl reads the device five times in each mini-batch (the divergence that steers the learning rate, three losses) and
launches some two hundred small kernels; the GPU waits for both. Here a mini-batch is recorded once and replayed: losses
and their gradients are one kernel (:mod:`dexsim.learning.ppo_kernels`), actor and critic run side by side, the learning
rate is a tensor on the device, and so are the sums of the losses. The mathematics is that of
`rsl_rl.algorithms.PPO.update` (Schulman et al., arXiv:1707.06347, with rsl-rl's adaptive learning rate), results are
equal up to rounding.

With `use_mixed_precision`, factors of products are of half precision, which has as many bits of a mantissa (10) as TF32
and half the bytes; products are added up in single precision, and so are weights and their gradients. The range of half
precision is small: gradients by what a network puts out are scaled so that the largest is `LARGEST`, and where an input
is over `FAR`, the update is one of single precision.
"""

from __future__ import annotations

import contextlib
import gc
from typing import Any

import torch
import warp as wp
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from rsl_rl.modules.distribution import GaussianDistribution
from torch import nn
from torch.nn import functional

from dexsim.learning import ppo_kernels
from dexsim.tasks.structs import filled

LARGEST, FAR = 256.0, 1000.0
ONES = 16
"""Rows of ones that add up a batch's gradients by a matrix product."""


def unsupported(alg: Any) -> str | None:
    """Return why this algorithm's update cannot be recorded, or None if it can."""
    if type(alg) is not PPO:
        return "the algorithm is not rsl-rl's PPO"
    if alg.is_multi_gpu:
        return "several processes learn together"
    if alg.rnd or alg.symmetry:
        return "it explores by RND or mirrors its batches"
    if alg.actor is not alg._raw_actor:
        return "torch.compile is on"
    if any(type(model) is not MLPModel for model in (alg.actor, alg.critic)):
        return "a network is not an MLPModel"
    if type(alg.actor.distribution) is not GaussianDistribution:
        return "its actions are not Gaussian, or their spread depends on what the policy sees"
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


class Linear(torch.autograd.Function):
    """A linear layer: x [B, I or more, then zeros] -> [B, O], of the precision of x; in single where `last`."""

    @staticmethod
    def forward(ctx: Any, x: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor, last: bool) -> torch.Tensor:
        ctx.inputs = weight.shape[1]
        w = functional.pad(weight.to(x.dtype), (0, x.shape[1] - ctx.inputs))
        ctx.save_for_backward(x, w)
        return product(x, w.t()) + bias if last else torch.addmm(bias.to(x.dtype), x, w.t())

    @staticmethod
    def backward(ctx: Any, g: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        x, w = ctx.saved_tensors
        g = g.to(x.dtype)
        by_bias = product(g.new_ones(ONES, len(g)), g)[0]  # faster than a sum
        by_weight = product(g.t(), x)[:, : ctx.inputs]
        return g @ w if ctx.needs_input_grad[0] else None, by_weight, by_bias, None


def product(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Return a @ b, in single precision."""
    if a.dtype != torch.float32 and a.is_cuda:
        return torch.mm(a, b, out_dtype=torch.float32)
    return a.float() @ b.float()


def forward(mlp: nn.Sequential, x: torch.Tensor) -> torch.Tensor:
    """Return what the network makes of x [B, I or more, then zeros], with products of the precision of x."""
    last = len(mlp) - 1
    for n, layer in enumerate(mlp):
        x = Linear.apply(x, layer.weight, layer.bias, n == last) if isinstance(layer, nn.Linear) else layer(x)
    return x


class GraphedUpdate:
    """`alg.update()` of an rsl-rl PPO, recorded on CUDA; on a CPU the same program, not recorded (for tests).

    The first mini-batch runs as it is, so that all that is allocated once is there; the others are recorded, each for
    its part of the samples. A change of what a record refers to (a checkpoint loaded into the optimizer) makes them
    anew.
    """

    def __init__(self, alg: PPO):
        wp.init()
        self.alg = alg
        self.device = torch.device(alg.device)
        st, dev = alg.storage, self.device
        self._size = st.num_envs * st.num_transitions_per_env // alg.num_mini_batches
        self._data: list[torch.Tensor] = []
        self._rate = torch.zeros(1, dtype=torch.float64, device=dev)
        self._rate32 = torch.zeros(1, device=dev)
        self._totals = torch.zeros(4, device=dev)  # losses, mini-batches
        self._block, A = ppo_kernels.BLOCK if dev.type == "cuda" else 1, st.actions.shape[-1]
        self._to_mean, self._to_value = torch.zeros(self._size, A, device=dev), torch.zeros(self._size, 1, device=dev)
        self._to_std, self._old_std = torch.zeros(A, device=dev), torch.zeros(A, device=dev)
        self._blocks = -(-self._size // self._block)
        self._sums = torch.zeros(self._blocks, 3 + A, device=dev)
        self._graphs: dict[int, torch.cuda.CUDAGraph] = {}
        self._key: tuple[int, ...] = ()
        self._own = self._side = None
        if dev.type == "cuda":  # recorded on a stream of its own: the one in use may be the default, which cannot be
            self._own, self._side = torch.cuda.Stream(dev), torch.cuda.Stream(dev)
            self._own_of_warp = wp.stream_from_torch(self._own)

    def update(self) -> dict[str, float]:
        """Learn from the storage's rollout; mean losses by name, as rsl-rl's `update`."""
        alg, st = self.alg, self.alg.storage
        self._prepare()
        group = alg.optimizer.param_groups[0]
        options = {name: group[name] for name in ("lr", "fused", "foreach", "capturable")}
        on_gpu = self.device.type == "cuda"
        rate = self._rate32[0] if on_gpu else alg.learning_rate
        group.update(lr=rate, fused=on_gpu or None, foreach=None, capturable=on_gpu)
        try:
            for _ in range(alg.num_learning_epochs):
                for k in range(alg.num_mini_batches):
                    self._run(k)
            totals = torch.cat([self._totals.double(), self._rate]).tolist()
        finally:
            group.update(options)
        with torch.no_grad():  # what it had lies in the memory of a record
            alg.actor.distribution.update(self._to_mean[:1])
        alg.learning_rate = totals[4]
        for g in alg.optimizer.param_groups:
            g["lr"] = alg.learning_rate
        observations = st.observations.flatten(0, 1)
        for model in (alg.actor, alg.critic):
            model.update_normalization(observations)
        st.clear()
        means = [s / (alg.num_learning_epochs * alg.num_mini_batches) for s in totals[:3]]
        return dict(zip(("value", "surrogate", "entropy"), means, strict=True))

    def _prepare(self) -> None:
        """Put where the records look what changes from one update to the next, in the order of the mini-batches."""
        alg, st = self.alg, self.alg.storage
        self._rate.fill_(alg.learning_rate)
        self._rate32.fill_(alg.learning_rate)
        self._totals.zero_()
        order = torch.randperm(alg.num_mini_batches * self._size, device=self.device)
        observations = st.observations.flatten(0, 1)
        with torch.no_grad():  # the running normalization holds still during an update: once for all mini-batches
            data = [model.get_latent(observations) for model in (alg.actor, alg.critic)]
            if alg.use_mixed_precision and float(torch.stack([x.abs().max() for x in data]).max()) < FAR:
                data = [x.half() for x in data]
            data = [functional.pad(x, (0, -x.shape[1] % 8)) for x in data]  # rows of a multiple of 16 bytes
            data += [x.flatten(0, 1) for x in (st.actions, st.distribution_params[0])]
            scalars = st.actions_log_prob, st.advantages, st.values, st.returns
            data += [x.flatten() for x in scalars]
            self._old_std.copy_(st.distribution_params[1][0, 0])
            if [x.dtype for x in data] != [x.dtype for x in self._data]:
                self._data = [x[: len(order)].clone() for x in data]
            for mine, x in zip(self._data, data, strict=True):
                torch.index_select(x, 0, order, out=mine)
            if self._data[0].dtype != torch.float32:
                self._begin_in_half()
        if self.device.type == "cuda":
            for state in alg.optimizer.state.values():
                state["step"] = state["step"].to(device=self.device, dtype=torch.float32)

    def _begin_in_half(self) -> None:
        """Let the update begin where half precision has the policy: the divergence from it, and the ratio to it, are
        then those of what is learned, and not of rounding."""
        seen, _, actions, mean, log_prob, *_ = self._data
        for part in range(0, len(seen), self._size):
            mean[part : part + self._size] = forward(self.alg.actor.mlp, seen[part : part + self._size])
        log_prob.copy_(torch.distributions.Normal(mean, self._old_std).log_prob(actions).sum(-1))

    def _run(self, k: int) -> None:
        if self._own is None:
            self._mini_batch(k)
            return
        key = self._refers_to()
        if key != self._key:
            self._graphs.clear()
            here = torch.cuda.current_stream()
            self._own.wait_stream(here)
            with torch.cuda.stream(self._own), wp.ScopedStream(self._own_of_warp, sync_enter=False):
                self._mini_batch(k)
            here.wait_stream(self._own)
            self._key = self._refers_to()
            return
        if k not in self._graphs:
            if not self._graphs:
                gc.collect()
            gc.disable()  # a graph destroyed during a capture would be recorded into it
            try:
                graph = torch.cuda.CUDAGraph()
                pool = next(iter(self._graphs.values())).pool() if self._graphs else None
                recording = torch.cuda.graph(graph, pool=pool, stream=self._own, capture_error_mode="thread_local")
                with recording, wp.ScopedStream(self._own_of_warp, sync_enter=False):
                    self._mini_batch(k)
            finally:
                gc.enable()
            self._graphs[k] = graph
        self._graphs[k].replay()

    def _refers_to(self) -> tuple[int, ...]:
        """Return the addresses of all that a record reads and that others could replace."""
        tensors = [*self.alg.actor.parameters(), *self.alg.critic.parameters(), *self._data]
        for state in self.alg.optimizer.state.values():
            tensors += [value for value in state.values() if isinstance(value, torch.Tensor)]
        return tuple(t.data_ptr() for t in tensors)

    def _mini_batch(self, k: int) -> None:
        """Take one step of the optimizer on the samples of mini-batch k."""
        alg, actor, critic = self.alg, self.alg.actor, self.alg.critic
        part = slice(k * self._size, (k + 1) * self._size)
        seen, seen_by_critic, actions, old_mean, log_prob, advantages, old_values, returns = (
            x[part] for x in self._data
        )
        if alg.normalize_advantage_per_mini_batch:
            advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        alg.optimizer.zero_grad(set_to_none=True)
        with self._beside():
            values = forward(critic.mlp, seen_by_critic)
        mean = forward(actor.mlp, seen)
        self._together()
        actor.distribution.update(mean[:1])
        std = actor.distribution.std[0]  # the same for all samples
        self._losses(
            mean, std, values, actions=actions, old_mean=old_mean, log_prob=log_prob, advantage=advantages,
            value=old_values, returns=returns,
        )  # fmt: skip
        with self._beside():
            self._descend(critic, values, self._to_value)
        if std.requires_grad:
            std.backward(self._to_std)
        self._descend(actor, mean, self._to_mean)
        self._together()
        if self.device.type != "cuda":
            for group in alg.optimizer.param_groups:
                group["lr"] = float(self._rate)
        alg.optimizer.step()

    def _losses(self, mean: torch.Tensor, std: torch.Tensor, values: torch.Tensor, **samples: torch.Tensor) -> None:
        """Fill the gradients by mean, standard deviation and value; add up losses; adapt the learning rate."""
        alg = self.alg
        s = filled(
            ppo_kernels.Samples, **samples, old_std=self._old_std, clip=alg.clip_param, value_coef=alg.value_loss_coef,
            clipped_value=int(alg.use_clipped_value_loss),
        )  # fmt: skip
        put_out = [wp.from_torch(x.detach()) for x in (mean, std, values.flatten())]
        to = [wp.from_torch(x) for x in (self._to_mean, self._to_value.flatten(), self._sums)]
        where: dict[str, Any] = {"device": str(self.device), "block_dim": self._block}
        wp.launch(ppo_kernels.losses, dim=self._blocks * self._block, inputs=[s, *put_out, *to], **where)
        desired = (alg.desired_kl or 0.0) if alg.schedule == "adaptive" else 0.0
        rest = [wp.from_torch(x) for x in (self._to_std, self._totals, self._rate, self._rate32)]
        inputs = [to[2], put_out[1], alg.entropy_coef, desired, *rest]
        wp.launch(ppo_kernels.finish, dim=self._sums.shape[1] * self._block, inputs=inputs, **where)

    def _descend(self, model: Any, out: torch.Tensor, gradient: torch.Tensor) -> None:
        """Fill the gradients of a model's weights, of which the norm is at most as the settings say."""
        if self._data[0].dtype == torch.float32:
            out.backward(gradient)
        else:
            scale = gradient.abs().amax().clamp(min=1e-30) / LARGEST
            out.backward(gradient / scale)
            torch._foreach_mul_([p.grad for p in model.mlp.parameters()], scale)
        nn.utils.clip_grad_norm_(model.parameters(), self.alg.max_grad_norm)

    def _beside(self) -> Any:
        """Return a context whose launches run beside those after it, until `_together`."""
        if self._side is None:
            return contextlib.nullcontext()
        self._side.wait_stream(torch.cuda.current_stream())
        return torch.cuda.stream(self._side)

    def _together(self) -> None:
        if self._side is not None:
            torch.cuda.current_stream().wait_stream(self._side)
