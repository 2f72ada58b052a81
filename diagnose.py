"""Find what the simulator left out: python diagnose.py [key=value ...], the same as `dexsim diagnose`; --help lists the settings."""

import sys

from dexsim.cli.main import main

if __name__ == "__main__":
    sys.exit(main(["diagnose", *sys.argv[1:]]))
