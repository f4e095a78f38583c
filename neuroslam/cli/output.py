"""What the commands say, and the codes that they exit with."""

import sys

from rich.console import Console

console = Console(markup=False, soft_wrap=True)  # for paths: brackets in them, one line each

INTERRUPTED = 130
USER_ERROR = 2
REFUSED = 3


def complain(command: str, text: str) -> None:
    """Print a line about what went wrong, where errors go."""
    print(f"neuroslam {command}: {text}", file=sys.stderr)


def say(what: object) -> None:
    """Print what was found: a line, or a table."""
    console.print(what)
