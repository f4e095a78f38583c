"""``python -m neuroslam.cli`` is the command ``neuroslam``."""

import sys

from neuroslam.cli import main

if __name__ == "__main__":
    sys.exit(main())
