"""What installed packages bring: classes and functions by their entry points, and those that the user names.

    [project.entry-points."dexsim.tasks"]      a task: a class derived from dexsim.tasks.Task
    [project.entry-points."dexsim.effects"]    an effect of the diagnosis: derived from dexsim.gap.effects.Effect
    [project.entry-points."dexsim.laws"]       a law of drives: a dexsim.actuator.law.Law
    [project.entry-points."dexsim.drivers"]    a hand's driver: what makes a dexsim.deploy.driver.HandDriver
    [project.entry-points."dexsim.readers"]    a format of recordings

Loading one runs its package's code, so only what is installed, or what the user typed in full, is loaded. A law and an
effect of the current folder are typed with any command: law=MODULE:NAME effect=MODULE:CLASS.
"""

from __future__ import annotations

import importlib
import os
import re
import sys
from collections.abc import Sequence
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

from dexsim.errors import UserError

NAMED = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")
"""What the user names in full: module:Class."""
TYPED = "DEXSIM_TYPED"
"""Environment variable with what was typed: processes that this one begins know it too."""


def take(argv: Sequence[str]) -> list[str]:
    """Take law=MODULE:NAME and effect=MODULE:CLASS off a command line, and remember them. Returns the rest."""
    own = [a for a in argv if a.startswith(("law=", "effect=")) and is_named(a.partition("=")[2])]
    os.environ[TYPED] = " ".join([os.environ.get(TYPED, ""), *own])
    return [a for a in argv if a not in own]


def installed(group: str) -> dict[str, EntryPoint]:
    """Return entry points of a group by name, and what was typed as such."""
    out = {point.name: point for point in entry_points(group=group)}
    for text in os.environ.get(TYPED, "").split():
        kind, _, where = text.partition("=")
        if group == f"dexsim.{kind}s":
            name = where.partition(":")[2].lower()
            out[name] = EntryPoint(name, where, group)
    return out


def is_named(text: str) -> bool:
    """Return whether a text is spelled "module:Class"."""
    return bool(NAMED.fullmatch(text))


def load(where: str, about: str) -> Any:
    """Return what "module:Name" names; the current folder is looked in too. Raises UserError, which begins with
    `about`."""
    module, _, name = where.partition(":")
    here = str(Path.cwd())
    if here not in sys.path and "" not in sys.path:
        sys.path.insert(0, here)
    try:
        loaded = importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name and (module == error.name or module.startswith(f"{error.name}.")):
            raise UserError(
                f"{about}: there is no module {error.name}, neither installed nor in {here}; run this in the folder"
                " that holds it, or install its package"
            ) from None
        raise UserError(f"{about}: {module} needs the module {error.name}, which is not installed") from None
    except UserError:
        raise
    except Exception as error:
        raise UserError(f"{about}: {module} fails as it is imported: {_failure(error)}") from error
    found = getattr(loaded, name, None)
    if found is None:
        own = [k for k, v in vars(loaded).items() if getattr(v, "__module__", "") == module and not k.startswith("_")]
        raise UserError(f"{about}: {module} has no {name}; there are {', '.join(own) or 'none'} in it")
    return found


def _failure(error: Exception) -> str:
    """Return an error and the line of the file in which it arose, in one line."""
    line = getattr(error, "lineno", None)
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    line = line or (trace.tb_lineno if trace is not None else 0)
    file = getattr(error, "filename", None) or (trace.tb_frame.f_code.co_filename if trace is not None else "")
    return f"{type(error).__name__}: {error} ({Path(str(file)).name}, line {line})"
