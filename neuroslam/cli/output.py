"""Output and exit codes of the commands."""

import sys

from rich.console import Console

from neuroslam.errors import printable

console = Console(markup=False, soft_wrap=True)  # keeps paths whole: brackets, long lines

INTERRUPTED = 130
USER_ERROR = 2
REFUSED = 3


_LONGEST = 4000


def complain(command: str, text: str) -> None:
    """Print one line of error to stderr; what is not printable is escaped."""
    line = printable(f"neuroslam {command}: {text}")
    if len(line) > _LONGEST:  # a name in an archive can have millions of characters
        line = f"{line[: _LONGEST // 2]} ... {line[-_LONGEST // 2 :]}"
    print(line, file=sys.stderr)


def say(what: object) -> None:
    """Print a line or a table to stdout; what is not printable in a line is escaped."""
    console.print(printable(what) if isinstance(what, str) else what)
