"""`python -m dexsim COMMAND [key=value ...]`: the console command `dexsim`."""

import sys

from dexsim.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
