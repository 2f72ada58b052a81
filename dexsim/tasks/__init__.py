"""Tasks: what a policy sees, does and is paid for. `make_env` builds one from a resolved configuration."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dexsim.tasks.scenes import Base, Free, Hinge, Scene, Screw, Slide, Table, Thing, Tree
    from dexsim.tasks.task import Task
    from dexsim.tasks.terms import command, done, event, memory, metric, observe, reward

_FROM = {
    "scenes": ("Base", "Free", "Hinge", "Scene", "Screw", "Slide", "Table", "Thing", "Tree"),
    "task": ("Task",),
    "terms": ("command", "done", "event", "memory", "metric", "observe", "reward"),
}
__all__ = [
    "Base", "Free", "Hinge", "Scene", "Screw", "Slide", "Table", "Task", "Thing", "Tree", "command", "done", "event",
    "make_env", "memory", "metric", "observe", "reward",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    for module, names in _FROM.items():
        if name in names:
            return getattr(importlib.import_module(f"dexsim.tasks.{module}"), name)
    raise AttributeError(f"module 'dexsim.tasks' has no attribute {name!r}")


def make_env(cfg: dict, n_worlds: int, device: str, seed: int, engine: str = "auto", grasps: Any = None) -> Task:
    """Return the environment of a resolved configuration: a `dexsim.tasks.Task`, which is an rsl-rl VecEnv.

    cfg: as a plain dict; its task's class is found by `dexsim.tasks.registry`. engine: "auto", "warp" or "mujoco".
    grasps: held poses that rotation begins with (`tasks.stable_grasps.GraspSet`); by default those of
    `task.initial.poses` or of the hand, searched for first where it has none. Raises UserError for an unknown task and
    for every impossible value that the task finds.
    """
    from dexsim.tasks.registry import task_class

    given = {} if grasps is None else {"grasps": grasps}
    made = task_class(cfg)
    made.prepare(cfg, **given)
    return made(cfg, n_worlds, device, seed, engine, **given)
