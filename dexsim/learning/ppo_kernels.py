"""PPO's losses of a mini-batch and their gradients, in two kernels instead of some two hundred.

Schulman et al., arXiv:1707.06347, for a Gaussian whose standard deviations are the same everywhere, and rsl-rl's
adaptive learning rate. B samples, A actions.
"""

# No `from __future__ import annotations`: Warp resolves these annotations from the closure.

import warp as wp

BLOCK = 256
LOWEST, HIGHEST, FACTOR = 1e-5, 1e-2, 1.5
"""Bounds of rsl-rl's adaptive learning rate, and the step that it makes."""


@wp.struct
class Samples:
    """What a rollout has left of each sample, and the settings of the loss."""

    actions: wp.array2d(dtype=float)
    old_mean: wp.array2d(dtype=float)
    old_std: wp.array(dtype=float)
    log_prob: wp.array(dtype=float)
    advantage: wp.array(dtype=float)
    value: wp.array(dtype=float)
    returns: wp.array(dtype=float)
    clip: float
    value_coef: float
    clipped_value: int


@wp.kernel(enable_backward=False)
def losses(
    s: Samples, mean: wp.array2d(dtype=float), std: wp.array(dtype=float), value: wp.array(dtype=float),
    to_mean: wp.array2d(dtype=float), to_value: wp.array(dtype=float), sums: wp.array2d(dtype=float),
):  # fmt: skip
    """Compute gradients by mean and value; by block, sums of divergence, value loss, surrogate, gradients by std."""
    i = wp.tid()
    b = wp.min(i, mean.shape[0] - 1)
    share = wp.where(i < mean.shape[0], 1.0 / float(mean.shape[0]), 0.0)
    log_prob, divergence = float(0.0), float(0.0)
    for j in range(mean.shape[1]):
        sigma, old = std[j], s.old_std[j]
        z, moved = (s.actions[b, j] - mean[b, j]) / sigma, (s.old_mean[b, j] - mean[b, j]) / sigma
        log_prob -= 0.5 * z * z + wp.log(sigma) + 0.9189385332046727
        ratio2 = old * old / (sigma * sigma)
        divergence += 0.5 * (ratio2 + moved * moved - 1.0 - wp.log(ratio2))
    ratio = wp.exp(log_prob - s.log_prob[b])
    a = s.advantage[b]
    near = -a * wp.clamp(ratio, 1.0 - s.clip, 1.0 + s.clip)
    by_log_prob = wp.where(-a * ratio >= near, -a * ratio, 0.0) * share
    off, since = value[b] - s.returns[b], value[b] - s.value[b]
    squared = off * off
    by_value = 2.0 * off
    if s.clipped_value != 0:
        held = s.value[b] + wp.clamp(since, -s.clip, s.clip) - s.returns[b]
        if wp.abs(since) > s.clip and held * held > squared:
            by_value = 0.0
        squared = wp.max(squared, held * held)
    block, first = i // wp.block_dim(), i % wp.block_dim() == 0
    kl_sum = wp.tile_sum(wp.tile(divergence * share))
    value_sum = wp.tile_sum(wp.tile(squared * share))
    surrogate_sum = wp.tile_sum(wp.tile(wp.max(-a * ratio, near) * share))
    kl, v, g = kl_sum[0], value_sum[0], surrogate_sum[0]
    if first:
        sums[block, 0] = kl
        sums[block, 1] = v
        sums[block, 2] = g
    for j in range(mean.shape[1]):
        z = (s.actions[b, j] - mean[b, j]) / std[j]
        std_sum = wp.tile_sum(wp.tile(by_log_prob * (z * z - 1.0) / std[j]))
        by_std = std_sum[0]
        if first:
            sums[block, 3 + j] = by_std
        if i < mean.shape[0]:
            to_mean[i, j] = by_log_prob * z / std[j]
    if i < mean.shape[0]:
        to_value[i] = s.value_coef * by_value * share


@wp.kernel(enable_backward=False)
def finish(
    sums: wp.array2d(dtype=float), std: wp.array(dtype=float), entropy_coef: float, desired_kl: wp.float64,
    to_std: wp.array(dtype=float), totals: wp.array(dtype=float), rate: wp.array(dtype=wp.float64),
    rate32: wp.array(dtype=float),
):  # fmt: skip
    """Add up over blocks, a column of `sums` each; adapt the learning rate unless desired_kl is 0."""
    column, lane = wp.tid() // wp.block_dim(), wp.tid() % wp.block_dim()
    mine = float(0.0)
    for block in range(lane, sums.shape[0], wp.block_dim()):
        mine += sums[block, column]
    all_of = wp.tile_sum(wp.tile(mine))
    total = all_of[0]
    if lane > 0:
        return
    if column >= 3:
        to_std[column - 3] = total - entropy_coef / std[column - 3]
    elif column > 0:
        totals[column - 1] = totals[column - 1] + total
    else:
        entropy = float(0.0)
        for j in range(std.shape[0]):
            entropy += 1.4189385332046727 + wp.log(std[j])
        totals[2] = totals[2] + entropy
        kl = wp.float64(total)
        if desired_kl > wp.float64(0.0) and totals[3] > 0.0:  # at first nothing has moved, but for rounding
            if kl > desired_kl * wp.float64(2.0):
                rate[0] = wp.max(rate[0] / wp.float64(FACTOR), wp.float64(LOWEST))
            elif kl < desired_kl / wp.float64(2.0) and kl > wp.float64(0.0):
                rate[0] = wp.min(rate[0] * wp.float64(FACTOR), wp.float64(HIGHEST))
        rate32[0] = float(rate[0])
        totals[3] = totals[3] + 1.0


@wp.struct
class Steps:
    """A rollout: T steps of N worlds, A actions."""

    actions: wp.array3d(dtype=float)
    mean: wp.array3d(dtype=float)
    std: wp.array(dtype=float)
    rewards: wp.array2d(dtype=float)
    values: wp.array2d(dtype=float)
    last: wp.array(dtype=float)
    dones: wp.array2d(dtype=wp.uint8)
    time_outs: wp.array2d(dtype=float)
    gamma: float
    lam: float


@wp.kernel(enable_backward=False)
def returns(
    s: Steps, log_prob: wp.array2d(dtype=float), returns: wp.array2d(dtype=float), advantages: wp.array2d(dtype=float)
):
    """Compute log-probabilities of the actions; a world's returns and generalized advantages, of rewards to which the
    value is added where time was out."""
    n = wp.tid()
    after, advantage = float(s.last[n]), float(0.0)
    for k in range(s.rewards.shape[0]):
        t = s.rewards.shape[0] - 1 - k
        value, on = float(s.values[t, n]), wp.where(s.dones[t, n] == wp.uint8(0), 1.0, 0.0)
        reward = s.rewards[t, n] + s.gamma * value * s.time_outs[t, n]
        advantage = reward + on * s.gamma * after - value + on * s.gamma * s.lam * advantage
        returns[t, n] = advantage + value
        advantages[t, n] = returns[t, n] - value
        after = value
        sum = float(0.0)
        for j in range(s.std.shape[0]):
            z = (s.actions[t, n, j] - s.mean[t, n, j]) / s.std[j]
            sum -= 0.5 * z * z + wp.log(s.std[j]) + 0.9189385332046727
        log_prob[t, n] = sum
