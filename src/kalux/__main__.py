"""``python -m kalux``: the command line."""

import sys

from kalux.cli import main

if __name__ == "__main__":
    sys.exit(main())
