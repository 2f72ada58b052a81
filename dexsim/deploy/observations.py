"""The grasp policy's observation, built from named measured signals: the one builder of the simulated task and of the
real-time loop, so that the two cannot drift apart.

Torch only, no branches on values, no allocation beyond its results: it can be part of a CUDA graph.
"""

from __future__ import annotations

from typing import NamedTuple

import torch

OBSERVATION = (  # table (a) of the paper: name, width, unit, what it is on hardware
    ("joint_angle", 12, "rad", "measured"),
    ("joint_torque", 12, "tau/tau_max", "motor current, as calibrated"),
    ("object_position", 3, "m", "x, y held at their first value; z from vision: noisy, delayed"),
    ("object_velocity", 3, "m/s", "finite difference of the measured z; x, y zero"),
    ("contact_force", 5, "F/F_max", "sum of a pad's normal forces"),
    ("contact_centre", 15, "m", "force-weighted mean of taxel positions, palm frame"),
    ("fingertip_position", 15, "m", "palm frame, forward kinematics"),
    ("force_command", 1, "F/F_max", "0..1"),
)
FRAME = {
    "joint_angle": "joint", "joint_torque": "joint", "object_position": "palm", "object_velocity": "palm",
    "contact_force": "taxel, along the normal", "contact_centre": "palm", "fingertip_position": "palm",
    "force_command": "none",
}  # fmt: skip
"""Frame of each row of OBSERVATION. Palm: origin at the palm's centre, x along the fingers, z out of the palm."""
ORDER = {
    "joint_angle": "joints", "joint_torque": "joints", "object_position": "x y z", "object_velocity": "x y z",
    "contact_force": "fingers", "contact_centre": "fingers, x y z each", "fingertip_position": "fingers, x y z each",
    "force_command": "one",
}  # fmt: skip
ACTOR_SIZE = sum(row[1] for row in OBSERVATION)


class Signals(NamedTuple):
    """What is measured, N hands at once. joint_position [N, 12] rad; joint_torque [N, 12] over tau_max, positive along
    positive joint position; object_xy [N, 2], object_z [N] m, object_vz [N] m/s; touch_force [N, 5] N; touch_centre
    [N, 5, 3] and fingertip [N, 5, 3] m, palm frame; command [N] 0..1. Joints in the SDK's order, fingers from the
    thumb."""

    joint_position: torch.Tensor
    joint_torque: torch.Tensor
    object_xy: torch.Tensor
    object_z: torch.Tensor
    object_vz: torch.Tensor
    touch_force: torch.Tensor
    touch_centre: torch.Tensor
    fingertip: torch.Tensor
    command: torch.Tensor


def build(s: Signals, force_max: float) -> torch.Tensor:
    """The actor's observation [N, 66], rows of `OBSERVATION`. force_max: F_max [N] of a fingertip at command 1."""
    n = s.joint_position.shape[0]
    zero2 = torch.zeros_like(s.object_xy)
    return torch.cat([
        s.joint_position,
        s.joint_torque,
        s.object_xy, s.object_z[:, None],
        zero2, s.object_vz[:, None],
        s.touch_force / force_max,
        s.touch_centre.reshape(n, 15),
        s.fingertip.reshape(n, 15),
        s.command[:, None],
    ], 1)  # fmt: skip


def height_speed(z: torch.Tensor, before: torch.Tensor, period: float) -> torch.Tensor:
    """Finite difference [N] m/s of the measured height over one control period [s]."""
    return (z - before) / period


def slices() -> dict[str, slice]:
    """Where each row of `OBSERVATION` lies."""
    out, at = {}, 0
    for name, width, *_ in OBSERVATION:
        out[name] = slice(at, at + width)
        at += width
    return out
