"""``python -m neuroslam``: the command line."""

import sys

from neuroslam.cli import main

if __name__ == "__main__":
    sys.exit(main())
