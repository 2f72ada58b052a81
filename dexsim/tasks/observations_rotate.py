"""The rotation policy's observation, built from named measured signals: the one builder of the simulated task and of
the real-time loop, as `observations.py` is for the grasp.

Torch only, no branches on values, no allocation beyond its results: it can be part of a CUDA graph.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch

from dexsim import rotation

ORIENTATION = {"6d": 6, "quaternion": 4, "none": 0}


def actor(joints: int, fingers: int, pads: int) -> tuple[tuple[str, int, str, str], ...]:
    """Table (b), (name, width, unit, what it is on hardware), for a hand of so many joints, fingers and touch pads."""
    return (
        ("joint_angle", joints, "rad", "measured"),
        ("relative_orientation", 6, "1", "6D of R_object^T R_goal, both in the palm frame; object from its IMU"),
        ("last_action", joints, "1", "targets last sent, over each joint's range in [-1, 1]"),
        ("contact_centre", 3 * pads, "m", "force-weighted mean of taxel positions, palm frame"),
        ("contact_force", pads, "N", "sum of a pad's normal forces"),
        ("fingertip_position", 3 * fingers, "m", "palm frame, forward kinematics"),
    )


def proprioception(joints: int, pads: int) -> tuple[tuple[str, int, str, str], ...]:
    """The same without an object's pose; `history` of these, newest first."""
    return (
        ("joint_angle", joints, "rad", "measured"),
        ("joint_velocity", joints, "rad/s", "measured"),
        ("last_action", joints, "1", "targets last sent, over each joint's range in [-1, 1]"),
        ("contact_centre", 3 * pads, "m", "force-weighted mean of taxel positions, palm frame"),
        ("contact_force", pads, "N", "sum of a pad's normal forces"),
    )


FRAME = {
    "joint_angle": "joint", "joint_velocity": "joint", "relative_orientation": "object", "last_action": "joint",
    "contact_centre": "palm", "contact_force": "taxel, along the normal", "fingertip_position": "palm",
}  # fmt: skip
"""Frame of each row. Palm: origin at the palm's centre, x along the fingers, z out of the palm."""
ORDER = {
    "joint_angle": "joints", "joint_velocity": "joints", "last_action": "joints",
    "contact_centre": "fingers, x y z each",
    "contact_force": "fingers", "fingertip_position": "fingers, x y z each",
    "relative_orientation": "6d: the matrix's first two columns, one after the other; quaternion: w x y z",
}  # fmt: skip


class Signals(NamedTuple):
    """What is measured, N hands at once. joint_position [N, J] rad; joint_velocity [N, J] rad/s (used without an IMU
    only); orientation [N, 4]: the object's as its IMU says, goal [N, 4] in the same frame, w x y z; sent [N, J], see
    `sent`; touch_force [N, P] N, touch_centre [N, P, 3], fingertip [N, F, 3] m, palm frame (P = 0 without touch); past
    [N, H, D]: the last H frames, newest first (perception=proprioception, else empty); fresh [N] bool: an episode
    begins."""

    joint_position: torch.Tensor
    joint_velocity: torch.Tensor
    orientation: torch.Tensor
    goal: torch.Tensor
    sent: torch.Tensor
    touch_force: torch.Tensor
    touch_centre: torch.Tensor
    fingertip: torch.Tensor
    past: torch.Tensor
    fresh: torch.Tensor


def rows(
    task: Mapping[str, Any], joints: int, fingers: int, pads: int, frames: int | None = None
) -> list[tuple[str, int, str, str]]:
    """(name, width, unit, what) of the actor's observation under a task's `observe` and `perception`, for a hand of so
    many joints, fingers and touch pads. frames: of how many control steps a row of the history is taken (default:
    `history`)."""
    o = task["observe"]
    blind = task["perception"] == "proprioception"
    out = []
    for name, width, unit, text in proprioception(joints, pads) if blind else actor(joints, fingers, pads):
        if name == "relative_orientation":
            width = ORIENTATION[o["orientation"]]
            text = text if width != 4 else "quaternion, sign as it comes"
        elif name == "last_action" and o.get("last_action", "step") == "step":
            text = "as sent"
        elif name == "contact_centre" and not o.get("force_weighted", True):
            text = "mean position of the touched taxels, palm frame"
        if width and o.get(name, True) is not False:
            count = (frames or task["history"]) if blind else 1
            out.append((name, width * count, unit, text))
    return out


def build(s: Signals, task: Mapping[str, Any]) -> torch.Tensor:
    """The actor's observation [N, D], rows of `rows(task)`. With perception=proprioception the newest frame is put
    before `past`, whose oldest is left out; a fresh episode's history is its first frame."""
    n, joints = s.joint_position.shape
    parts = {
        "joint_angle": s.joint_position, "joint_velocity": s.joint_velocity, "last_action": s.sent,
        "contact_centre": s.touch_centre.flatten(1), "contact_force": s.touch_force,
        "fingertip_position": s.fingertip.flatten(1),
    }  # fmt: skip
    blind = task["perception"] == "proprioception"
    if not blind:
        parts["relative_orientation"] = relative(s.orientation, s.goal, task["observe"]["orientation"])
    sizes = joints, parts["fingertip_position"].shape[1] // 3, s.touch_force.shape[1]
    frame = torch.cat([parts[row[0]] for row in rows(task, *sizes, frames=1)], 1)
    if not blind:
        return frame
    moved = torch.cat([frame[:, None], s.past[:, :-1]], 1)
    return torch.where(s.fresh[:, None, None], frame[:, None].expand_as(moved), moved).reshape(n, -1)


def sent(
    action: torch.Tensor, target: torch.Tensor, middle: torch.Tensor, half: torch.Tensor, what: str
) -> torch.Tensor:
    """What was last sent to the drives [N, J]. target: the targets over each joint's range (middle, half [J] rad) in
    [-1, 1], in absolute mode the action itself; in relative mode a step alone would not tell how hard a finger is told
    to press.
    step: the action [N, J]."""
    return action if what == "step" else (target - middle) / half


def relative(seen: torch.Tensor, goal: torch.Tensor, how: str) -> torch.Tensor:
    """R_object^T R_goal [N, 6, 4 or 0] from quaternions [N, 4] in one frame. A heading that both share cancels, so an
    IMU that does not know north will do.

    As a quaternion: both orientations pass through rotation matrices, whose quaternion has the sign of its largest
    component, so the sign of the product jumps with the object's attitude. It is left so: the double cover is what
    this setting studies.
    """
    if how == "none":
        return seen[:, :0]
    if how == "quaternion":
        a, b = (rotation.from_matrix(rotation.to_matrix(q)) for q in (seen, goal))
        return rotation.multiply(rotation.conjugate(a), b)
    return rotation.six(rotation.multiply(rotation.conjugate(seen), goal))


def next_goal(q: torch.Tensor, axis: torch.Tensor, turn: torch.Tensor, keep_tilt: bool) -> torch.Tensor:
    """The goal after orientation q [N, 4] was reached: q turned by `turn` [4] (about the unit vector axis [3]), its
    tilt against the axis removed unless `keep_tilt`."""
    if not keep_tilt:
        q = rotation.upright(q, axis)
    return rotation.normalize(rotation.multiply(turn.expand_as(q), q))
