"""Find what the simulator leaves out: python diagnose.py [key=value ...], the same as `dexsim diagnose`; see --help."""

import sys

from dexsim.cli.main import main

if __name__ == "__main__":
    sys.exit(main(["diagnose", *sys.argv[1:]]))
