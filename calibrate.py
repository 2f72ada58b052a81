"""Calibrate a hand: python calibrate.py [key=value ...]; python calibrate.py --help lists the settings."""

import sys
from pathlib import Path

from dexsim.cli.ending import guard

CONFIGS = Path(__file__).resolve().parent / "configs"


def main(argv):
    """Settings first, so that a slip is answered before anything heavy loads."""
    from dexsim.calibration import command

    return command.main(argv, CONFIGS)


if __name__ == "__main__":
    sys.exit(guard(main, sys.argv[1:]))
