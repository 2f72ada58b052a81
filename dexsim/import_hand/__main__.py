"""`python -m dexsim.import_hand model.urdf out=hands/mine`: the same as `dexsim import-hand`."""

import sys

from dexsim.console.ending import guard
from dexsim.import_hand.command import main

if __name__ == "__main__":
    sys.exit(guard(main, sys.argv[1:]))
