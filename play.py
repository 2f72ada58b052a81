"""Play a policy: python play.py [key=value ...], the same as `dexsim play`; --help lists the settings."""

import sys

from dexsim.cli.main import main

if __name__ == "__main__":
    sys.exit(main(["play", *sys.argv[1:]]))
