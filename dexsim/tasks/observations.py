"""The grasp policy's observation, built from named measured signals: the one builder of the simulated task and of the
real-time loop, so that the two cannot drift apart.

Torch only, no branches on values, no allocation beyond its results: it can be part of a CUDA graph.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch

ROWS = {
    "joint_angle": ("rad", "joint", "joints"), "follower_angle": ("rad", "joint", "joints without a drive"),
    "joint_torque": ("tau/tau_max", "joint", "joints"), "object_position": ("m", "palm", "x y z"),
    "object_velocity": ("m/s", "palm", "x y z"), "contact_force": ("F/F_max", "taxel, along the normal", "fingers"),
    "contact_centre": ("m", "palm", "fingers, x y z each"), "fingertip_position": ("m", "palm", "fingers, x y z each"),
    "force_command": ("F/F_max", "none", "one"),
}  # fmt: skip
"""Unit, frame and order of each row. Palm: origin at the palm's centre, x along the fingers, z out of the palm."""


class Signals(NamedTuple):
    """What is measured, N hands at once. joint_position [N, J] rad; joint_torque [N, J] over tau_max, positive along
    positive joint position; object_xy [N, 2], object_z [N] m, object_vz [N] m/s; touch_force [N, P] N, touch_centre
    [N, P, 3] (P pads, 0 without touch) and fingertip [N, F, 3] m, palm frame; command [N] 0..1, or [N, 2] with the
    thumb's; follower [N, S] rad: measured joints without a drive (None: none). Joints and fingers in the
    hand's order."""

    joint_position: torch.Tensor
    joint_torque: torch.Tensor
    object_xy: torch.Tensor
    object_z: torch.Tensor
    object_vz: torch.Tensor
    touch_force: torch.Tensor
    touch_centre: torch.Tensor
    fingertip: torch.Tensor
    command: torch.Tensor
    follower: torch.Tensor | None = None


def build(s: Signals, names: Sequence[str], force_max: float) -> torch.Tensor:
    """Return the rows of these names, one after another [N, D]. force_max: F_max [N] of a fingertip at command 1."""
    rows = {
        "joint_angle": s.joint_position,
        "follower_angle": s.joint_position[:, :0] if s.follower is None else s.follower,
        "joint_torque": s.joint_torque,
        "object_position": torch.cat([s.object_xy, s.object_z[:, None]], 1),
        "object_velocity": torch.cat([torch.zeros_like(s.object_xy), s.object_vz[:, None]], 1),
        "contact_force": s.touch_force / force_max,
        "contact_centre": s.touch_centre.flatten(1),
        "fingertip_position": s.fingertip.flatten(1),
        "force_command": s.command.reshape(len(s.command), -1),
    }
    return torch.cat([rows[name] for name in names], 1)


def height_speed(z: torch.Tensor, before: torch.Tensor, period: float) -> torch.Tensor:
    """Return finite difference [N] m/s of the measured height over one control period [s]."""
    return (z - before) / period


def slices(table: Sequence[tuple[Any, ...]]) -> dict[str, slice]:
    """Return where each row of a table (name, width, ...) lies."""
    out, at = {}, 0
    for name, width, *_ in table:
        out[name] = slice(at, at + width)
        at += width
    return out
