"""Find what the simulator left out: python diagnose.py recordings='[a.mcap,...]' out=DIR; --help lists the settings."""

import sys

from dexsim.cli.ending import guard


def main(argv):
    """The settings are read before anything heavy loads."""
    from dexsim.gap import command

    return command.main(argv)


if __name__ == "__main__":
    sys.exit(guard(main, sys.argv[1:]))
