"""Output and exit codes of the commands.

Results go to standard output; progress, notes on errors and warnings go to standard error. With
``--json`` standard output holds one JSON object, and all else goes to standard error.
"""

import json
import math
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from rich.console import Console

from neuroslam.errors import NeuroslamError, printable

console = Console(markup=False, soft_wrap=True)  # keeps paths whole: brackets, long lines
error_console = Console(markup=False, soft_wrap=True, stderr=True)

INTERRUPTED = 130
USER_ERROR = 2
REFUSED = 3


_LONGEST = 4000


@dataclass
class Report:
    """What a command prints: nothing but errors, or one JSON object, or lines and tables.

    Attributes:
        command: Name of the command.
        quiet: Whether progress and results are left out.
        as_json: Whether the summary is printed as JSON.
        exit_code: Exit code of the command.
        summary: Results of the command, by name.
    """

    command: str = ""
    quiet: bool = False
    as_json: bool = False
    exit_code: int = 0
    summary: dict[str, Any] = field(default_factory=dict)


_reports = [Report()]


def report() -> Report:
    """Return what the command in progress prints."""
    return _reports[-1]


@contextmanager
def reporting(command: str, *, quiet: bool, as_json: bool) -> Iterator[Report]:
    """Print the summary of a command as JSON once it has ended, or failed, if it was asked for."""
    now = Report(command, quiet, as_json)
    _reports.append(now)
    try:
        yield now
    except BaseException as error:
        now.exit_code = USER_ERROR if isinstance(error, NeuroslamError) else 1
        if isinstance(error, KeyboardInterrupt):
            now.exit_code = INTERRUPTED
        summarise(error=str(error) or "interrupted")
        raise
    finally:
        _reports.pop()
        if as_json:
            whole = {"command": command, "exit_code": now.exit_code, **now.summary}
            print(json.dumps(plain(whole), allow_nan=False), flush=True)


def summarise(**figures: object) -> None:
    """Add results of the command in progress to its summary, which ``--json`` prints."""
    report().summary.update(figures)


def plain(value: Any) -> Any:  # noqa: ANN401 - anything that JSON can hold, and what becomes it
    """Return a value as JSON can hold it; what is not a finite number becomes ``None``.

    Example:
        >>> from pathlib import Path
        >>> plain({"a": (1, float("nan")), "b": Path("map.png")})
        {'a': [1, None], 'b': 'map.png'}
    """
    if isinstance(value, Enum):
        return plain(value.value)
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(name): plain(one) for name, one in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(one) for one in value]
    listed = getattr(value, "tolist", None)  # an array; numpy is not loaded for this alone
    return str(value) if listed is None else plain(listed())


def complain(command: str, text: str) -> None:
    """Print one line of error to stderr; what is not printable is escaped."""
    line = printable(f"neuroslam {command}: {text}")
    if len(line) > _LONGEST:  # a name in an archive can have millions of characters
        line = f"{line[: _LONGEST // 2]} ... {line[-_LONGEST // 2 :]}"
    print(line, file=sys.stderr)


def say(what: object) -> None:
    """Print a line or a table; what is not printable in a line is escaped.

    It goes to stdout, with ``--json`` to stderr, and nowhere with ``--quiet``.
    """
    now = report()
    if now.quiet:
        return
    to = error_console if now.as_json else console
    to.print(printable(what) if isinstance(what, str) else what)
