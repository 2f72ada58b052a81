"""What simulation and real-time loop compute alike of the rotation's observation and goals.

Torch only, no branches on values, no allocation beyond its results: it can be part of a CUDA graph.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch

from dexsim import rotation
from dexsim.errors import UserError

SHAPES = {
    "epsilon": (1e-6, 1e3), "alpha": (0.0, 1e6), "delta_dist": (0.0, 10.0), "delta_rot": (0.0, math.pi),
    "delta_pos": (0.0, 10.0), "spin_max": (0.0, 1e3),
}  # fmt: skip
"""In what figures of the rewards' shapes must lie."""


def sent(
    action: torch.Tensor, target: torch.Tensor, middle: torch.Tensor, half: torch.Tensor, what: str
) -> torch.Tensor:
    """Return what was last sent to the drives [N, J]. target: the targets over each joint's range (middle, half [J]
    rad) in [-1, 1], in absolute mode the action itself; in relative mode a step alone would not tell how hard a finger
    is told to press. step: the action [N, J]."""
    return action if what == "step" else (target - middle) / half


def relative(seen: torch.Tensor, goal: torch.Tensor, how: str) -> torch.Tensor:
    """Return R_object^T R_goal [N, 6, 4 or 0] from quaternions [N, 4] in one frame. A heading that both share cancels,
    so an IMU that does not know north will do.

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
    """Return the goal after orientation q [N, 4] was reached: q turned by `turn` [4] (about the unit vector axis [3]),
    its tilt against the axis removed unless `keep_tilt`."""
    if not keep_tilt:
        q = rotation.upright(q, axis)
    return rotation.normalize(rotation.multiply(turn.expand_as(q), q))


def relabelled(turn: torch.Tensor) -> dict[str, Callable[[torch.Tensor], torch.Tensor]]:
    """Return how rows change where an object's own frame is turned by a matrix [3, 3]; see `HandEnv.symmetries`."""

    def orientation(six: torch.Tensor) -> torch.Tensor:
        """Turn R [N, 6] into R turn."""
        return rotation.six_of_matrix(rotation.matrix_of_six(six) @ turn)

    def relative_(row: torch.Tensor) -> torch.Tensor:
        """Turn R_object^T R_goal into turn^T that turn."""
        if row.shape[1] != 6:
            raise UserError("agent=ppo_symmetric: needs task.observe.orientation=6d")
        return rotation.six_of_matrix(turn.T @ rotation.matrix_of_six(row) @ turn)

    return {"relative_orientation": relative_, "object_orientation": orientation, "object_com": lambda com: com @ turn}


def axis_and_turn(goal: Mapping[str, Any], mirror: bool) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the unit vector [3] that goals turn about, and the turn to the next [4]; mirror: of a mirrored hand,
    whose goals are the mirror image of those in the settings."""
    axis = torch.tensor([float(x) for x in goal["axis"]]) * torch.tensor([-1.0, 1.0, -1.0] if mirror else [1.0] * 3)
    axis = axis / axis.norm()
    return axis, rotation.about(axis, torch.tensor(math.radians(float(goal["angle"]))))


def check(t: Mapping[str, Any]) -> None:
    """Raise UserError for settings of the task that no rotation can have."""
    ends, goal, r = t["termination"], t["goal"], t["reward"]
    what = t["observe"].get("last_action", "step")
    if what not in ("target", "step"):
        raise UserError(f"task.observe.last_action={what}: must be target or step")
    if ends.get("training") is not None and not 0 < ends["training"] <= ends["distance"]:
        raise UserError(
            f"task.termination.training={ends['training']}: must be above 0 and at most task.termination.distance,"
            f" {ends['distance']} m, or null for that one"
        )
    if not 0 <= t["initial"].get("again", 0.0) < 1:
        raise UserError(f"task.initial.again={t['initial']['again']}: must be at least 0 and below 1")
    if len(goal["axis"]) != 3 or not sum(float(x) ** 2 for x in goal["axis"]) > 0:
        raise UserError(f"task.goal.axis={goal['axis']}: must be three numbers, not all 0")
    if not 0 < abs(goal["angle"]) < 180:
        raise UserError(f"task.goal.angle={goal['angle']}: must lie in (0, 180) degrees, or be its negative")
    if not 0 < r["delta_rot"] < math.radians(abs(goal["angle"])):
        raise UserError(
            f"task.reward.delta_rot={r['delta_rot']}: must lie between 0 and the goal's angle, "
            f"{math.radians(abs(goal['angle'])):.3g} rad, or goals are reached as they are set"
        )


def check_drawn_goals(t: Mapping[str, Any], palms: Sequence[str]) -> None:
    """Raise UserError for settings of drawn goals, and of where the palm looks, that cannot be."""
    goal, palm, ends = t["goal"], t["palm"], t["termination"]
    if not palm or not set(palm) <= set(palms):
        raise UserError(f"task.palm={palm}: must be a list of {', '.join(palms)}")
    if not goal["axes"] or not set(goal["axes"]) <= set("xyz"):
        raise UserError(f"task.goal.axes={goal['axes']}: must be a list of x, y, z")
    if not goal["angle"] <= goal["reach"] <= 180:
        raise UserError(
            f"task.goal.reach={goal['reach']}: must lie between task.goal.angle={goal['angle']} and 180 degrees"
        )
    if not goal["patience"] > 0:
        raise UserError(f"task.goal.patience={goal['patience']}: must be above 0 s")
    if not ends["lean_s"] >= 0:
        raise UserError(f"task.termination.lean_s={ends['lean_s']}: must be 0 s or more")
