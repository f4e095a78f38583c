"""Errors that a user can mend: who, what was got, what was expected, what to do, in one line."""

import difflib
import warnings
from collections.abc import Iterable, Mapping
from typing import Any


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """End a line about an unknown name with the known one that is most like it, if any is.

    Example:
        >>> did_you_mean("treshold", ["threshold", "crop"]), did_you_mean("x", ["threshold"])
        ("; did you mean 'threshold'?", '')
    """
    near = nearest(word, known)
    return "" if near is None else f"; did you mean {near!r}?"


def nearest(word: str, known: Iterable[str]) -> str | None:
    """Return the known name that is most like an unknown one, if any is like it at all.

    Example:
        >>> nearest("treshold", ["threshold", "crop"])
        'threshold'
    """
    return next(iter(difflib.get_close_matches(word, list(known), n=1)), None)


def counted(n: int, one: str, several: str = "") -> str:
    """Say how many, in the right number.

    Example:
        >>> counted(1, "frame"), counted(2, "frame"), counted(0, "loop closure")
        ('1 frame', '2 frames', '0 loop closures')
        >>> counted(1, "place is", "places are")
        '1 place is'
    """
    return f"{n:,} {one if n == 1 else several or one + 's'}"


class RenamedKeyWarning(FutureWarning):
    """A config key or option that is called otherwise now; the old name is read for one release."""


def with_new_names(
    values: Mapping[str, Any], renamed: Mapping[str, str], where: str
) -> dict[str, Any]:
    """Return values by their present names, and warn of old ones.

    Args:
        values: By key.
        renamed: Old name to new one.
        where: What the keys are of, for the warning.

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


class ConfigError(NeuroslamError, ValueError):
    """A configuration that cannot be used: unknown key, value out of bounds, unreadable file."""


class SourceError(NeuroslamError, ValueError):
    """A video, folder, log or world that cannot be read, or a frame in it that cannot be used."""


class BadFrame(SourceError):  # noqa: N818 - a frame is bad, the source is not
    """One frame that cannot be used; the ones after it may be, if the policy is to skip."""


class CheckpointError(NeuroslamError, ValueError):
    """A brain file that cannot be loaded: truncated, altered, of another version, not a brain."""


class MapError(NeuroslamError, ValueError):
    """An operation that the map or the cells cannot do: an id out of range, activity that died."""


class RunError(NeuroslamError, ValueError):
    """A run directory that cannot be written, resumed or read."""


class SpaceError(NeuroslamError, ValueError):
    """Vectors or positions that do not fit a semantic map: wrong dimension, NaN, unknown name."""


_SHOWN = 5


def listed(values: Iterable[object]) -> str:
    """Write the first five of many values, and how many more there are.

    Example:
        >>> listed(range(7))
        '0, 1, 2, 3, 4 and 2 more'
    """
    rows = [value.item() if hasattr(value, "item") else value for value in values]
    shown = ", ".join(f"{v:g}" if isinstance(v, float) else str(v) for v in rows[:_SHOWN])
    more = len(rows) - _SHOWN
    return f"{shown} and {more} more" if more > 0 else shown
