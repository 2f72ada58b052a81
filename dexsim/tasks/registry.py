"""Finds tasks: those of dexsim, those of installed packages, and any class that the user names.

    dexsim train task=grasp                      a task of dexsim: a file of dexsim/configs/task, which names its class
    dexsim train task=lift                       of an installed package: an entry point of the group `dexsim.tasks`
    dexsim train task=my_tasks.lift:Lift         anything importable, the current folder included

A file (a checkpoint, a bundle, a dump) names its task as "module:Class" too, but has no say in what is imported: a
class is loaded only if dexsim or an installed package provides it, or the user named it in this process.
"""

from __future__ import annotations

import difflib
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dexsim import door
from dexsim.console import program
from dexsim.errors import UserError
from dexsim.paths import CONFIGS

if TYPE_CHECKING:
    from dexsim.tasks.task import Task

GROUP = "dexsim.tasks"
_named: dict[str, type[Task] | None] = {}
"""Classes that the user named in this process: typed on the command line (None until it is loaded), or given as an
object."""


@dataclass(frozen=True)
class Entry:
    """A task that can be chosen by name. where: "module:Class"; origin: "dexsim", or the package that provides it."""

    name: str
    where: str
    origin: str


@cache
def built_in(folder: Path = CONFIGS / "task") -> dict[str, str]:
    """Return the tasks of dexsim, name -> "module:Class": each settings file of a task names its class."""
    found = {}
    for file in sorted(folder.glob("*.yaml")):
        named = re.search(r"^class: *(\S+)", file.read_text(encoding="utf-8"), re.M)
        if named:
            found[file.stem] = named[1]
    return found


def entries() -> Iterator[Entry]:
    """Yield all tasks that can be chosen by name."""
    for name, where in built_in().items():
        yield Entry(name, where, "dexsim")
    for name, point in door.installed(GROUP).items():
        yield Entry(name, point.value, point.dist.name if point.dist else "?")


def name_class(where: str, made: type[Task] | None = None) -> str:
    """Note that the user named this class, so that it may be imported; made: the class itself. Returns `where`."""
    _named[where] = made or _named.get(where)
    return where


def where_of(made: type) -> str:
    """Return the "module:Class" of a class. Of one in the script that runs, the script's name is the module."""
    module = made.__module__
    if module == "__main__" and getattr(sys.modules["__main__"], "__file__", None):
        module = Path(str(sys.modules["__main__"].__file__)).stem
    return f"{module}:{made.__name__}"


def find(choice: str) -> str:
    """Return the "module:Class" of a chosen task: a name, or a class, which is then named by the user. Raises
    UserError."""
    if door.is_named(choice):
        return name_class(choice)
    known = {entry.name: entry.where for entry in entries()}
    if choice not in known:
        near = difflib.get_close_matches(choice, known, 1)
        raise UserError(
            f"task={choice}: no such task; task can be {', '.join(known)}, or a class of your own,"
            f" task=module:Class{f' (did you mean {near[0]}?)' if near else ''}"
        )
    return known[choice]


def load(where: str, source: str = "") -> type[Task]:
    """Return the class "module:Class". Raises UserError: nobody that may name it has, it cannot be imported, or it is
    no task.

    source: the file that names it, for the message.
    """
    if where in _named and _named[where] is not None:
        return _named[where]  # type: ignore[return-value]  # looked at just now
    if where not in _named and not provided(where):
        said = f"{source}: its task" if source else "the task"
        raise UserError(
            f"{said} {where} is provided by no installed package; if you trust its code, type task={where} as well:"
            f" {program.typed()} task={where}"
        )
    made = _imported(where, f"{source}: task {where}" if source else f"task={where}")
    if where in _named:
        _named[where] = made
    return made


def provided(where: str) -> bool:
    """Return whether dexsim or an installed package provides a class, so that whoever names it may have it imported."""
    return where in built_in().values() or where in {point.value for point in door.installed(GROUP).values()}


def typing(where: str) -> str:
    """Return what a command that is given a file of this task must say too: " task=module:Class", or nothing."""
    return "" if provided(where) else f" task={where}"


def _imported(where: str, about: str) -> type[Task]:
    made = door.load(where, about)
    if not (isinstance(made, type) and hasattr(made, "declared")):  # as every Task has
        raise UserError(f"{about}: {where.partition(':')[2]} is no task: derive it from dexsim.tasks.Task")
    return made


def of_config(cfg: dict[str, Any]) -> str:
    """Return the "module:Class" of a resolved config's task. Checkpoints from before name no class: the settings file
    of the task that they chose does."""
    task = cfg["task"]
    where = task.get("class")
    if where is None:
        chosen = (cfg.get("choices") or {}).get("task") or task["name"]
        return find(str(chosen))
    return str(where)


def task_class(cfg: dict[str, Any], source: str = "") -> type[Task]:
    """Return the class of a resolved config's task. Raises UserError; source: the file that the config is from."""
    return load(of_config(cfg), source)
