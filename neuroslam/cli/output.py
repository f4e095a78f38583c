"""Output and exit codes of the commands."""

import sys

from rich.console import Console

console = Console(markup=False, soft_wrap=True)  # keeps paths whole: brackets, long lines

INTERRUPTED = 130
USER_ERROR = 2
REFUSED = 3


def complain(command: str, text: str) -> None:
    """Print one line of error to stderr."""
    print(f"neuroslam {command}: {text}", file=sys.stderr)


def say(what: object) -> None:
    """Print a line or a table to stdout."""
    console.print(what)
