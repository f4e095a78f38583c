"""Errors that a user can fix: what was wrong, what was expected and what to do, in one line."""

import difflib
import warnings
from collections.abc import Iterable, Mapping
from typing import Any


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Return the end of a message about an unknown name: the most similar known name, if any.

    Example:
        >>> did_you_mean("treshold", ["threshold", "crop"]), did_you_mean("x", ["threshold"])
        ("; did you mean 'threshold'?", '')
    """
    near = nearest(word, known)
    return "" if near is None else f"; did you mean {near!r}?"


def nearest(word: str, known: Iterable[str]) -> str | None:
    """Return the known name most similar to an unknown one, or ``None`` if none is similar.

    Example:
        >>> nearest("treshold", ["threshold", "crop"])
        'threshold'
    """
    return next(iter(difflib.get_close_matches(word, list(known), n=1)), None)


def counted(n: int, one: str, several: str = "") -> str:
    """Write a count with its noun in the singular or plural.

    Example:
        >>> counted(1, "frame"), counted(2, "frame"), counted(0, "loop closure")
        ('1 frame', '2 frames', '0 loop closures')
        >>> counted(1, "experience is", "experiences are")
        '1 experience is'
    """
    return f"{n:,} {one if n == 1 else several or one + 's'}"


def printable(text: str) -> str:
    r"""Escape what a terminal would not print as it is: control characters, and bytes of a name.

    Names of files and of members of archives come from elsewhere: raw, they could move the cursor,
    set the title of the window, or forge a line.

    Example:
        >>> printable("a\nb\x1b]0;c\udcff"), printable("день")
        ('a\\nb\\x1b]0;c\\xff', 'день')
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else _escaped(c) for c in text)


def csv_text(text: str) -> str:
    """Return a cell of a CSV table that no spreadsheet takes for a formula.

    A text that starts with ``=``, ``+``, ``-``, ``@`` or a control character gets an apostrophe in
    front; a number stays as it is.

    Example:
        >>> csv_text("=1+1.csv"), csv_text("-0.5"), csv_text("drive.avi")
        ("'=1+1.csv", '-0.5', 'drive.avi')
    """
    text = printable(text)
    if not text.startswith(("=", "+", "-", "@")):
        return text
    try:
        float(text)
    except ValueError:
        return f"'{text}"
    return text


def _escaped(character: str) -> str:
    code = ord(character)
    if 0xDC80 <= code <= 0xDCFF:  # a byte that is not UTF-8, as os.fsdecode writes it
        return f"\\x{code - 0xDC00:02x}"
    return character.encode("unicode_escape", "backslashreplace").decode()


def require_utf8(name: object, error: "type[NeuroslamError]") -> None:
    """Refuse a name with bytes that are not UTF-8: libraries below take text only.

    Args:
        name: Of a file or a source.
        error: Type of the error to raise.

    Raises:
        NeuroslamError: Of that type.
    """
    try:
        str(name).encode()
    except UnicodeEncodeError:
        raise error(f"{printable(str(name))}: its name is not UTF-8; rename it") from None


def first_line(error: BaseException) -> str:
    """Return the line of a long error that says what is wrong."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[1] if len(lines) > 1 and lines[0].endswith(":") else (lines or ["?"])[0]


class RenamedKeyWarning(FutureWarning):
    """A config key or option was renamed; the old name is accepted for one release."""


def with_new_names(
    values: Mapping[str, Any], renamed: Mapping[str, str], where: str
) -> dict[str, Any]:
    """Replace old keys by their present names, with a warning for each.

    Args:
        values: Values by key.
        renamed: Present name of each old name.
        where: What the keys belong to, for the warning.

    Example:
        >>> with_new_names({"width": 3}, {"breadth": "width"}, "view")
        {'width': 3}
    """
    known = dict(values)
    for old, new in renamed.items():
        if old in known and new not in known:
            warnings.warn(
                f"{where}: {old} is called {new} now; the old name is read until the next release",
                RenamedKeyWarning,
                stacklevel=2,
            )
            known[new] = known.pop(old)
    return known


class NeuroslamError(Exception):
    """Base of all errors that neuroslam raises on purpose; the command line prints one line."""

    def __str__(self) -> str:
        """Return the message as one line, whatever the names in it hold."""
        return printable(super().__str__())


class ConfigError(NeuroslamError, ValueError):
    """An unusable configuration: unknown key, value out of bounds, unreadable file."""


class SourceError(NeuroslamError, ValueError):
    """A video, folder, log or world that cannot be read, or that contains an unusable frame."""


class BadFrame(SourceError):  # noqa: N818 - the frame is bad, not the source
    """One unusable frame; the source can be read on if the caller skips the frame."""


class CheckpointError(NeuroslamError, ValueError):
    """A brain file that cannot be loaded: truncated, altered, of another version, or no brain."""


class MapError(NeuroslamError, ValueError):
    """An operation that the map or the cells cannot do: an id out of range, silent activity."""


class RunError(NeuroslamError, ValueError):
    """A run directory that cannot be written, resumed or read."""


class WriteError(RunError):
    """A run directory that cannot be written: a full disk, a missing permission."""


class SharedMapError(NeuroslamError, ValueError):
    """A message or a journal of a shared map that is damaged, out of bounds, or not reachable."""


class SpaceError(NeuroslamError, ValueError):
    """Vectors or positions that do not fit a semantic map: wrong dimension, NaN, unknown name."""


_SHOWN = 5


def listed(values: Iterable[object]) -> str:
    """Write the first five values, and how many more there are.

    Example:
        >>> listed(range(7))
        '0, 1, 2, 3, 4 and 2 more'
    """
    rows = [getattr(value, "item", lambda value=value: value)() for value in values]
    shown = ", ".join(f"{v:g}" if isinstance(v, float) else str(v) for v in rows[:_SHOWN])
    more = len(rows) - _SHOWN
    return f"{shown} and {more} more" if more > 0 else shown
