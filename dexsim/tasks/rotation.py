"""Rotations as tensors: quaternions [..., 4] are (w, x, y, z), unit."""

from __future__ import annotations

import torch


def multiply(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Hamilton product a b: first b, then a."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack([
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    ], -1)  # fmt: skip


def about(axis: torch.Tensor, angle: torch.Tensor) -> torch.Tensor:
    """Rotation by angle [...] rad about unit axis [..., 3]."""
    half = (angle / 2)[..., None]
    return torch.cat([half.cos(), axis * half.sin()], -1)
