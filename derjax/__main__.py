"""`python -m derjax`: the same as the command `derjax`."""

import sys

from .commands.main import main

if __name__ == "__main__":
    sys.exit(main())
