"""Running `dexsim train` and `dexsim play` inside a test, on the dummy task and a copy of the configs."""

from __future__ import annotations

import shutil
from pathlib import Path

from dexsim.cli import commands
from dexsim.console.ending import guard
from dexsim.paths import CONFIGS

ROOT = Path(__file__).resolve().parents[1]
DUMMY = """name: dummy
steps: 20
nested: {inner: 1.0, high: 2.0}
sizes: [1.0, 2.0]
mass: {log: [0.03, 0.3]}
flag: true
presets:
  cpu: {worlds: 4, iterations: 2, task: {nested: {high: 3.0}}}
"""


def configs(folder: Path) -> Path:
    """Return a copy of configs/ with `task=dummy` and without what other tasks need."""
    target = folder / "configs"
    shutil.copytree(CONFIGS, target)
    for group in ("task", "servo", "tactile", "randomize"):
        (target / group).mkdir(exist_ok=True)
    (target / "task" / "dummy.yaml").write_text(DUMMY)
    for file in ("task/grasp.yaml", "randomize/default.yaml"):
        (target / file).write_text((target / file).read_text() if (target / file).exists() else "name: grasp\n")
    return target


def call(name: str, config_dir: Path, *argv: str) -> int:
    """Exit status of `dexsim <name> argv...` with the dummy task's make_env and the settings of `config_dir`."""
    import dummy_task

    return guard(lambda arguments: getattr(commands, name)(arguments, config_dir, dummy_task.make_env), list(argv))
