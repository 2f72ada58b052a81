"""Tasks: what a policy sees, does and is paid for. `make_env` builds one from a resolved configuration."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from dexsim.errors import UserError

if TYPE_CHECKING:
    from dexsim.tasks.env import HandEnv
    from dexsim.tasks.stable_grasps import GraspSet


def task_class(task: Mapping[str, Any]) -> type[HandEnv]:
    """The class of the task with the settings `task` (its `name` and `mode`). Raises UserError for an unknown one."""
    from dexsim.tasks.grasp import GraspEnv
    from dexsim.tasks.rotate import RotateEnv
    from dexsim.tasks.rotate_fingertips import FingertipEnv

    mode = task.get("mode", "palm")
    if mode not in ("palm", "fingertips"):
        raise UserError(f"task.mode={mode}: must be palm or fingertips")
    tasks: dict[str, type[HandEnv]] = {"grasp": GraspEnv, "rotate": RotateEnv if mode == "palm" else FingertipEnv}
    name = task["name"]
    if name not in tasks:
        near = difflib.get_close_matches(name, tasks, 1)
        raise UserError(
            f"task.name='{name}': must be one of {', '.join(tasks)}" + (f"; did you mean {near[0]}?" if near else "")
        )
    return tasks[name]


def make_env(
    cfg: dict, n_worlds: int, device: str, seed: int, engine: str = "auto", grasps: GraspSet | None = None
) -> HandEnv:
    """The environment of `cfg["task"]["name"]`: a `dexsim.tasks.env.HandEnv`, which is an rsl-rl VecEnv.

    cfg: the resolved configuration as a plain dict. engine: "auto", "warp" or "mujoco". grasps: held poses that
    rotation begins with (`tasks.stable_grasps.GraspSet`); by default those of `task.initial.poses` or of the hand,
    searched for first where it has none. Raises UserError for an unknown task and for every impossible value that the
    task finds.
    """
    from dexsim.tasks.rotate import RotateEnv

    made = task_class(cfg["task"])
    if issubclass(made, RotateEnv):
        if grasps is None and cfg["task"]["initial"]["poses"] is None and cfg["task"].get("mode", "palm") == "palm":
            from dexsim.tasks.make_grasps import ensure

            ensure(cfg)
        return made(cfg, n_worlds, device, seed, engine, grasps)
    return made(cfg, n_worlds, device, seed, engine)
