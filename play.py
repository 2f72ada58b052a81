"""Play a policy: python play.py checkpoint=PATH [key=value ...]; python play.py --help lists the settings."""

import sys
from pathlib import Path

from dexsim.cli import start
from dexsim.cli.ending import guard

CONFIGS = Path(__file__).resolve().parent / "configs"


def main(argv, make_env=None):
    """Settings first, so that a slip is answered before anything heavy loads; then the episodes."""
    ready = start.for_play(argv, CONFIGS)
    if ready is None:  # --help or --cfg
        return 0
    from dexsim.cli import play

    return play.run(ready, make_env)


if __name__ == "__main__":
    sys.exit(guard(main, sys.argv[1:]))
