"""`objects=`, `kept_out=`, `object_scale=`, `object_hulls=`: a user's own objects, written into a task's settings."""

from __future__ import annotations

from typing import Any

from dexsim.assets.objects import own
from dexsim.assets.objects.mesh import MOST_PARTS
from dexsim.errors import UserError


def apply(plain: dict[str, Any]) -> None:
    """Write the objects that the settings name into `task.objects` (in place): paths absolute, folders as their meshes.
    Raises UserError."""
    given = {key: plain.get(key) for key in ("objects", "kept_out")}
    if all(value is None for value in given.values()):
        return
    task = plain["task"]
    from dexsim.tasks import registry

    if not registry.task_class(plain).TAKES_OBJECTS:  # heavy, and only who gives objects needs it
        key = next(k for k, value in given.items() if value is not None)
        name = (plain.get("choices") or {}).get("task") or task.get("name")
        raise UserError(
            f"{key}={given[key]}: task={name} has its own object; {key}= is for tasks that take others"
            " (a task of your own: TAKES_OBJECTS = True in its class)"
        )
    for key, into in (("objects", "train"), ("kept_out", "held_out")):
        names = given[key]
        if names is None:
            continue
        names = [names] if isinstance(names, str) else names
        if not isinstance(names, list) or not names or not all(isinstance(n, str) and n for n in names):
            raise UserError(f"{key}={given[key]}: must be a list of shapes and mesh files, e.g. [mug.obj,box]")
        task["objects"][into] = own.expand(names)
    both = sorted(set(task["objects"]["train"]) & set(task["objects"]["held_out"]))
    if both:
        raise UserError(f"kept_out: '{both[0]}' is trained on as well; name others in objects= or kept_out=")
    scale, hulls = plain.get("object_scale", 1.0), plain.get("object_hulls", own.PARTS)
    if isinstance(scale, bool) or not isinstance(scale, (int, float)) or not 1e-6 <= scale <= 1e3:
        raise UserError(f"object_scale={scale}: must be a positive number, metres per unit; 0.001 for millimetres")
    if isinstance(hulls, bool) or not isinstance(hulls, int) or not 1 <= hulls <= MOST_PARTS:
        raise UserError(f"object_hulls={hulls}: must be a whole number from 1 to {MOST_PARTS}")
    task["objects"]["own"] = {"scale": float(scale), "hulls": hulls}
