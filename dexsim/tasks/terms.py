"""Reward terms that tasks share: pure functions of tensors [N, ...]."""

from __future__ import annotations

import torch


def tracking(
    x: torch.Tensor,
    command: torch.Tensor,
    x_max: float,
    sigma: float,
    low: float,
    high: float,
    contact: torch.Tensor,
) -> torch.Tensor:
    """Sum over fingers of R_i [contact_i] (paper, R_force and R_torque), [N].

    x [N, 5]: force [N] or torque over its maximum, thumb first. Four fingers:
    R_i = exp(-(x_i - command x_max)^2 / (2 (sigma x_max)^2)) [low x_max <= x_i <= high x_max]; the thumb: the band
    only. The paper prints tau_thumb in the fingers' torque band; we take it for tau_i. sigma, low, high are fractions
    of x_max.
    """
    band = ((x >= low * x_max) & (x <= high * x_max)).float()
    error = (x[:, 1:] - command[:, None] * x_max) / (sigma * x_max)
    gauss = torch.exp(-0.5 * error.square())
    each = torch.cat([band[:, :1], gauss * band[:, 1:]], 1)
    return (each * contact).sum(1)
