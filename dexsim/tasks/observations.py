"""The grasp policy's observation, built from named measured signals: the one builder of the simulated task and of the
real-time loop, so that the two cannot drift apart.

Torch only, no branches on values, no allocation beyond its results: it can be part of a CUDA graph.
"""

from __future__ import annotations

from typing import NamedTuple

import torch

FRAME = {
    "joint_angle": "joint", "follower_angle": "joint", "joint_torque": "joint", "object_position": "palm",
    "object_velocity": "palm",
    "contact_force": "taxel, along the normal", "contact_centre": "palm", "fingertip_position": "palm",
    "force_command": "none",
}  # fmt: skip
"""Frame of each of `rows`. Palm: origin at the palm's centre, x along the fingers, z out of the palm."""
ORDER = {
    "joint_angle": "joints", "follower_angle": "joints without a drive", "joint_torque": "joints",
    "object_position": "x y z", "object_velocity": "x y z",
    "contact_force": "fingers", "contact_centre": "fingers, x y z each", "fingertip_position": "fingers, x y z each",
    "force_command": "one",
}  # fmt: skip


def rows(joints: int, fingers: int, pads: int, commands: int = 1, sensed: int = 0) -> list[tuple[str, int, str, str]]:
    """(name, width, unit, what it is on hardware) of the observation, table (a) of the paper, for a hand of so many
    joints, fingers and touch pads (without pads: without the rows of touch). commands: 2 where the thumb has its own,
    after the others'; sensed: joints without a drive that are measured."""
    table = (
        ("joint_angle", joints, "rad", "measured"),
        ("follower_angle", sensed, "rad", "measured, of joints without a drive"),
        ("joint_torque", joints, "tau/tau_max", "motor current, as calibrated"),
        ("object_position", 3, "m", "x, y held at their first value; z from vision: noisy, delayed"),
        ("object_velocity", 3, "m/s", "finite difference of the measured z; x, y zero"),
        ("contact_force", pads, "F/F_max", "sum of a pad's normal forces"),
        ("contact_centre", 3 * pads, "m", "force-weighted mean of taxel positions, palm frame"),
        ("fingertip_position", 3 * fingers, "m", "palm frame, forward kinematics"),
        ("force_command", commands, "F/F_max", "0..1"),
    )
    return [row for row in table if row[1]]


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


def build(s: Signals, force_max: float) -> torch.Tensor:
    """Return the actor's observation [N, D], rows of `rows`. force_max: F_max [N] of a fingertip at command 1."""
    zero2 = torch.zeros_like(s.object_xy)
    return torch.cat([
        s.joint_position,
        *([] if s.follower is None else [s.follower]),
        s.joint_torque,
        s.object_xy, s.object_z[:, None],
        zero2, s.object_vz[:, None],
        s.touch_force / force_max,
        s.touch_centre.flatten(1),
        s.fingertip.flatten(1),
        s.command.reshape(len(s.command), -1),
    ], 1)  # fmt: skip


def height_speed(z: torch.Tensor, before: torch.Tensor, period: float) -> torch.Tensor:
    """Return finite difference [N] m/s of the measured height over one control period [s]."""
    return (z - before) / period


def slices(table: list[tuple[str, int, str, str]]) -> dict[str, slice]:
    """Return where each of `rows` lies."""
    out, at = {}, 0
    for name, width, *_ in table:
        out[name] = slice(at, at + width)
        at += width
    return out
