"""What help pages and hints need: the command that a user typed to get here, so that they name commands that work for
them, and the settings of a config file."""

from __future__ import annotations

import re
import shlex
import sys
from pathlib import Path

DOORS = ("train", "play", "diagnose", "calibrate")
"""Jobs that also have a script at the top of the repository."""


def name(job: str) -> str:
    """Return the command of a job, called the way this process was: "dexsim play", "python -m dexsim play" or "python
    play.py"."""
    called = Path(sys.argv[0])
    if _by_door() and job in DOORS:
        return f"python {job}.py"
    return (
        f"python -m dexsim {job}" if (called.parent.name, called.name) == ("dexsim", "__main__.py") else f"dexsim {job}"
    )


def typed() -> str:
    """Return this process's command line as the user typed it."""
    given = sys.argv[1:]
    head = name(given[0]) if given and not _by_door() else f"python {Path(sys.argv[0]).name}"
    return " ".join([head, *map(shlex.quote, given if _by_door() else given[1:])])


def torchrun(job: str, processes: int, machines: int = 1) -> str:
    """Return the command that starts a job in this many processes of each of several machines at once."""
    nodes = f"--nnodes={machines} --rdzv_backend=c10d --rdzv_endpoint=HOST:29500 " if machines > 1 else ""
    return f"torchrun {nodes}--nproc_per_node={processes} " + (
        f"{job}.py" if _by_door() and job in DOORS else f"-m dexsim {job}"
    )


def words(text: str) -> str:
    """Return a text that says `dexsim train` or `python train.py`, with the commands of :func:`name` instead."""
    jobs = "|".join(DOORS)
    return re.sub(rf"python ({jobs})\.py|(?<!-m )\bdexsim ({jobs})\b", lambda match: name(match[1] or match[2]), text)


def _by_door() -> bool:
    called = Path(sys.argv[0])
    return called.suffix == ".py" and called.stem in DOORS


def settings(path: Path) -> list[tuple[str, str, str]]:
    """Return (dotted key, default, comment) of each commented line ``key: value  # comment`` of a config file."""
    rows, owner = [], ""
    for line in path.read_text("utf-8").splitlines():
        if match := re.match(r"^(\w+):\s*$", line):
            owner = match[1] + "."
        elif match := re.match(r"^(\s*)(\w+):\s*(\S+)\s+#\s*(.+)$", line):
            indent, key, value, comment = match.groups()
            rows.append(((owner if indent else "") + key, value, comment))
    return rows
