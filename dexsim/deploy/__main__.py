"""`python -m dexsim.deploy ...`: the same as `dexsim deploy ...`."""

import sys

if __name__ == "__main__":
    from dexsim.cli.deploy import main
    from dexsim.console.ending import guard

    sys.exit(guard(main, sys.argv[1:]))
