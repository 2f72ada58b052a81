"""`dexsim COMMAND [key=value ...]`: finds the command, loads nothing else."""

from __future__ import annotations

import difflib
import importlib
import os
import sys
from dataclasses import dataclass

from dexsim import door
from dexsim.console import program
from dexsim.console.ending import guard
from dexsim.errors import UserError
from dexsim.version import VERSION


@dataclass(frozen=True)
class Command:
    """One sub-command. where: "module:function" of (arguments) -> exit status; about: one line for the first screen;
    bare: whether it runs without any argument, else that asks for the page `USAGE` of its module."""

    where: str
    about: str
    bare: bool = False
    # whether joints are searched side by side: threads of the linear algebra would take the cores from them (read by
    # OpenBLAS when NumPy loads, so it must be said before)
    side_by_side: bool = False


COMMANDS: dict[str, Command] = {
    "demo": Command(
        "dexsim.cli.demo:main", "find a hidden effect, then play a trained hand in the browser", side_by_side=True
    ),
    "train": Command("dexsim.cli.commands:train", "train a policy in many simulated worlds at once"),
    "play": Command(
        "dexsim.cli.commands:play", "play a policy (metrics, plots, video, live view) or replay a recording"
    ),
    "tasks": Command("dexsim.cli.tasks:main", "list the tasks, those of installed packages too", True),
    "diagnose": Command(
        "dexsim.gap.command:main",
        "find the physics that the simulator leaves out of your recordings",
        side_by_side=True,
    ),
    "calibrate": Command("dexsim.cli.commands:calibrate", "measure torque per current, taxels and rubber"),
    "excite": Command("dexsim.excite:main", "write safe motions that show what a hand's drives do"),
    "record": Command("dexsim.cli.record:main", "record a robot over ROS 2"),
    "audit": Command("dexsim.gap.audit:main", "say what is in recordings, what is wrong with them, what they can tell"),
    "convert": Command("dexsim.recording.convert:main", "write a log (CSV, NPZ, a bag) as a recording"),
    "import-hand": Command("dexsim.import_hand.command:main", "make a hand of a robot's URDF or MJCF file"),
    "import-object": Command("dexsim.import_object:main", "make an object to grasp of a mesh file"),
    "export": Command("dexsim.export:main", "write a policy as one folder that a robot can run"),
    "deploy": Command("dexsim.cli.deploy:main", "run an exported policy on a hand, real or simulated"),
    "stable-grasps": Command("dexsim.cli.stable_grasps:main", "make the held poses that rotation episodes start from",
                             True),  # fmt: skip
    "doctor": Command("dexsim.cli.doctor:main", "say what this machine has and lacks, for a report of a bug", True),
    "nan-dump": Command("dexsim.tasks.nan_replay:main", "repeat the step at which a world stopped being finite"),
}
HELP = ("-h", "--help", "help")
PARTS = ("check", "skin")
"""Commands of `deploy` and `import-hand`, which have pages of their own."""
RARER = ("stable-grasps", "doctor", "nan-dump")
FIRST_SCREEN = """usage: dexsim COMMAND [key=value ...]

Train dexterous hands in simulation, feel like the real hand, and find what the simulator left out.

commands:
{common}

rarer:
{rarer}

first steps:
  dexsim demo                                        a hidden effect found, a trained hand in the browser: a minute
  dexsim train device=cpu iterations=180             a first look at training: five minutes on two cores
  dexsim play policy=scripted task=grasp             a policy that needs no training

  dexsim COMMAND --help     its settings (key=default) and examples
  dexsim --version

Results go into runs/ and out/ of the folder you are in, or where out= says.
"""


def first_screen() -> str:
    """Return what `dexsim --help` prints."""

    def lines(names: list[str]) -> str:
        return "\n".join(f"  {name:<15}{COMMANDS[name].about}" for name in names)

    return FIRST_SCREEN.format(common=lines([n for n in COMMANDS if n not in RARER]), rarer=lines(list(RARER)))


def dispatch(argv: list[str]) -> int:
    """Run one command; returns its exit status. Raises UserError for a command that does not exist."""
    if argv and argv[0] in ("--version", "-V", "version"):
        print(f"dexsim {VERSION}")
        return 0
    if argv[:1] == ["help"] and len(argv) > 1:
        argv = [argv[1], "--help"]
    if not argv or argv[0] in HELP:
        print(first_screen(), end="")
        return 0 if argv else 2
    name = argv[0]
    if name not in COMMANDS:
        near = difflib.get_close_matches(name, COMMANDS, 1)
        hint = f"did you mean {near[0]}? " if near else f"there are {', '.join(COMMANDS)} "
        raise UserError(f"unknown command '{name}': {hint}(dexsim --help)")
    if COMMANDS[name].side_by_side:
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    module, _, function = COMMANDS[name].where.partition(":")
    loaded, given = importlib.import_module(module), door.take(argv[1:])
    wants_page = any(a in HELP for a in given) and given[0] not in PARTS if given else not COMMANDS[name].bare
    if wants_page and (page := getattr(loaded, "USAGE", None)) is not None:
        print(program.words(page), end="")
        return 0 if given else 2
    status: int = getattr(loaded, function)(given)
    return status


def main(argv: list[str] | None = None) -> int:
    """Return the console command `dexsim`, `python -m dexsim` and the scripts at the top; returns the exit status."""
    return guard(dispatch, sys.argv[1:] if argv is None else argv)
