"""Train a policy: python train.py [key=value ...], the same as `dexsim train`; --help lists the settings."""

import sys

from dexsim.cli.main import main

if __name__ == "__main__":
    sys.exit(main(["train", *sys.argv[1:]]))
