"""Calibrate a hand: python calibrate.py [key=value ...], the same as `dexsim calibrate`; --help lists the settings."""

import sys

from dexsim.cli.main import main

if __name__ == "__main__":
    sys.exit(main(["calibrate", *sys.argv[1:]]))
