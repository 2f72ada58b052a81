"""The commands that read their settings from the config files: each from its arguments to its exit status.

Settings are read first, so that a slip is answered before anything heavy loads.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from dexsim.paths import CONFIGS

MakeEnv = Callable[..., Any]


def train(argv: list[str], config_dir: Path = CONFIGS, make_env: MakeEnv | None = None) -> int:
    """Run one training, or a sweep of them. make_env replaces `dexsim.tasks.make_env` (tests)."""
    from dexsim.cli import start, sweep

    if sweep.wanted(argv):
        return sweep.run(argv, config_dir)
    ready = start.for_train(argv, config_dir)
    if ready is None:  # --help or --cfg
        return 0
    from dexsim.cli import train as training

    return training.run(ready, make_env)


def play(argv: list[str], config_dir: Path = CONFIGS, make_env: MakeEnv | None = None) -> int:
    """Play episodes with a policy, a live view, or a recording's replay."""
    from dexsim.cli import start

    ready = start.for_play(argv, config_dir)
    if ready is None:  # --help or --cfg
        return 0
    from dexsim.cli import play as playing

    return playing.run(ready, make_env)


def calibrate(argv: list[str], config_dir: Path = CONFIGS) -> int:
    """Measure current to torque and force, taxels, rubber."""
    from dexsim.calibration import command

    return command.main(argv, config_dir)
