"""Train a policy: python train.py task=grasp [key=value ...]; python train.py --help lists the settings."""

import sys
from pathlib import Path

from dexsim.cli import start, sweep
from dexsim.cli.ending import guard

CONFIGS = Path(__file__).resolve().parent / "configs"


def main(argv, make_env=None):
    """Settings first, so that a slip is answered before anything heavy loads; then one run, or a sweep of them."""
    if sweep.wanted(argv):
        return sweep.run(argv, CONFIGS, Path(__file__).resolve())
    ready = start.for_train(argv, CONFIGS)
    if ready is None:  # --help or --cfg
        return 0
    from dexsim.cli import train

    return train.run(ready, make_env)


if __name__ == "__main__":
    sys.exit(guard(main, sys.argv[1:]))
