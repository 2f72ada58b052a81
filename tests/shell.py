"""Running train.py and play.py inside a test, on the dummy task and a copy of the configs."""

from __future__ import annotations

import importlib.util
import shutil
from pathlib import Path

from dexsim.cli.ending import guard

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
    """A copy of configs/ with `task=dummy` and without what other tasks need."""
    target = folder / "configs"
    shutil.copytree(ROOT / "configs", target)
    for group in ("task", "servo", "tactile", "randomize"):
        (target / group).mkdir(exist_ok=True)
    (target / "task" / "dummy.yaml").write_text(DUMMY)
    for file in ("task/grasp.yaml", "randomize/default.yaml"):
        (target / file).write_text((target / file).read_text() if (target / file).exists() else "name: grasp\n")
    return target


def script(name: str, config_dir: Path):
    """The module train.py or play.py, reading its settings from `config_dir`."""
    spec = importlib.util.spec_from_file_location(name, ROOT / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.CONFIGS = config_dir
    return module


def call(name: str, config_dir: Path, *argv: str) -> int:
    """Exit status of `python <name>.py argv...` with the dummy task's make_env."""
    import dummy_task

    module = script(name, config_dir)
    return guard(lambda arguments: module.main(arguments, dummy_task.make_env), list(argv))
