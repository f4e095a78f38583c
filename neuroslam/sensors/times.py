"""Times as tables and file names write them: the column that holds them, and their unit."""

import re
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Literal, NamedTuple

import numpy as np

Unit = Literal["s", "ms", "us", "ns"]

PER_SECOND: dict[Unit, float] = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
UNIT_NAMES: dict[Unit, str] = {
    "s": "seconds",
    "ms": "milliseconds",
    "us": "microseconds",
    "ns": "nanoseconds",
}

_DIGITS: dict[int, Unit] = {13: "ms", 16: "us", 19: "ns"}
"""Number of digits of a Unix time in each unit."""

_SECONDS: Unit = "s"
_LATEST_S = 1e11
"""No recording has a later time: as a Unix time it is the year 5138."""

_UNIX_S = (1e9, 4.2e9)
"""Unix times of the years 2001 to 2103."""

_SLOWEST_UNIX_S = 30.0
"""Longest step between Unix times for which their size alone shows the unit."""

_SPELLINGS: dict[Unit, str] = {
    "s": "s sec secs second seconds",
    "ms": "ms msec msecs milli millis millisecond milliseconds",
    "us": "us \N{MICRO SIGN}s \N{GREEK SMALL LETTER MU}s usec usecs micros microsecond "
    "microseconds",
    "ns": "ns nsec nsecs nanos nanosec nanosecs nanosecond nanoseconds",
}
_UNITS: dict[str, Unit] = {word: u for u, words in _SPELLINGS.items() for word in words.split()}
_NAME_LIST = """
time t times timestamp timestamps stamp stamps ts clock epoch unix unixtime
unixtimestamp epochtime elapsed elapsedtime systemtime systime walltime rostime simtime
headerstamp timesinceepoch timesincestart datetime recordtime logtime gpstime hosttime
devicetime sensortimestamp posixtime
"""
_NAMES = frozenset(_NAME_LIST.split())
_PREFIXES = frozenset(("header", "field", "msg", "pose", "frame", "image", "img", "odom", "imu"))
_COUNTERS = frozenset(("", "frame", "index", "idx", "id", "i", "n", "k", "seq", "row", "number"))
_LIKE_A_LENGTH = re.compile(r"dist|odo|mile|travel|path|tick|encoder|count")
_LIKE_A_TIME = re.compile(r"time|stamp|clock|date|epoch|zeit|temps|tiempo|tempo|\bhms\b")


class TimeColumn(NamedTuple):
    """The time column of a table.

    Attributes:
        index: Number of the column.
        name: Its name, as the table writes it.
        unit: Unit that the name states; ``None`` if it states none.
        rest: Number of the column of nanoseconds since the full second, if there is one.
    """

    index: int
    name: str
    unit: Unit | None
    rest: int | None = None


def time_column(header: Sequence[str]) -> TimeColumn | None:
    """Find the time column of a table by the usual names, in any case, units in brackets or behind.

    ``time_s`` comes first, then a column whose name states a unit, then the first other one. Two
    columns of full seconds and of nanoseconds, as ROS writes them, are one time.

    Args:
        header: Names of the columns.

    Example:
        >>> time_column(["# Time [ns]", "v_m_s", "w_rad_s"])
        TimeColumn(index=0, name='Time [ns]', unit='ns', rest=None)
        >>> time_column(["secs", "nsecs", "v_m_s"]).rest
        1
        >>> time_column(["v_m_s", "w_rad_s"]) is None
        True
    """
    names = [_bare(name) for name in header]
    found: list[TimeColumn] = []
    for index, (name, raw) in enumerate(zip(names, header, strict=True)):
        words, unit = _words_and_unit(name)
        if name.startswith("%time") or name.endswith("header.stamp"):  # of rostopic echo -p
            unit = unit or "ns"
        while len(words) > 1 and words[0] in _PREFIXES:
            words = words[1:]
        if "".join(words) in _NAMES or (not words and unit not in (None, "ns") and name != "s"):
            found.append(TimeColumn(index, raw.strip().lstrip("#").strip().strip('"'), unit))
        elif not words and unit == "ns":  # the fraction, if there are seconds too
            found.append(TimeColumn(index, raw.strip(), "ns"))
    seconds = [c for c in found if c.unit == "s" and _is_unit(names[c.index])]
    nanoseconds = [c for c in found if c.unit == "ns" and _is_unit(names[c.index])]
    if len(seconds) == 1 and len(nanoseconds) == 1:
        return seconds[0]._replace(rest=nanoseconds[0].index)
    for known in (lambda c: names[c.index] == "time_s", lambda c: c.unit is not None):
        for column in found:
            if known(column):
                return column
    return found[0] if found else None


def in_seconds(
    times: np.ndarray, stated: Unit | None = None, slowest_s: float = 2.0
) -> tuple[np.ndarray, Unit]:
    """Convert times to seconds; where no unit is stated, the median step and the size show it.

    The unit is the first of s, ms, us, ns for which the median step is at most ``slowest_s`` (30 s
    for a Unix time of the years 2001 to 2103) and the times are before the year 5138: a step of 50
    is 50 ms. A stated unit holds unless the times would be later than that.

    Args:
        times: ``(n,)``, NaN where unknown.
        stated: Unit that the table states.
        slowest_s: Longest median step of a recording, s.

    Returns:
        Times in seconds, ``(n,)``; the unit.

    Example:
        >>> in_seconds(np.array([1700000000000000000, 1700000000100000000]))[1]
        'ns'
        >>> in_seconds(np.array([0.0, 50.0, 100.0]))[0].tolist()
        [0.0, 0.05, 0.1]
    """
    values = np.asarray(times).astype(np.float64)
    usable = values[np.isfinite(values)]
    largest = float(np.abs(usable).max()) if len(usable) else 0.0
    steps = np.diff(usable)
    steps = steps[steps > 0]
    step = float(np.median(steps)) if len(steps) else 0.0
    possible: list[Unit] = [
        u for u, per_s in PER_SECOND.items() if largest / per_s < _LATEST_S
    ] or [_SECONDS]
    if stated in possible:
        return values / PER_SECOND[stated], stated
    unit = possible[0]
    for one in possible:
        size_s = largest / PER_SECOND[one]
        longest_s = _SLOWEST_UNIX_S if _UNIX_S[0] <= size_s < _UNIX_S[1] else slowest_s
        if step / PER_SECOND[one] <= longest_s:
            unit = one
            break
    return values / PER_SECOND[unit], unit


def unit_note(what: str, stated: Unit | None, unit: Unit) -> str:
    """Return one line on how times were read.

    Example:
        >>> unit_note("times.txt", None, "ns")
        'times.txt: times are in nanoseconds, as their size shows'
    """
    how = (
        "as the name states"
        if stated == unit
        else "as their size shows"
        if unit != "s"
        else "no unit is stated"
    )
    return f"{what}: times are in {UNIT_NAMES[unit]}, {how}"


def parse_time(text: str) -> float | None:
    """Read a time: a number, or an ISO 8601 date with its time of day (UTC if no zone is given).

    Example:
        >>> parse_time("12.5"), parse_time("1970-01-01 00:01:00.5"), parse_time("noon")
        (12.5, 60.5, None)
    """
    text = text.strip()
    try:
        return float(text)
    except ValueError:
        pass
    if ":" not in text:  # a date alone is no time
        return None
    try:
        at = datetime.fromisoformat(text)
    except ValueError:
        return None
    return (at if at.tzinfo else at.replace(tzinfo=UTC)).timestamp()


def unrecognised_time(names: Sequence[str], columns: Sequence[np.ndarray | None]) -> str | None:
    """Return the name of a column that may hold times under an unusual name, or ``None``.

    That is a column with a name like that of a time, or one whose numbers rise from row to row and
    are neither a counter nor a position or distance.

    Args:
        names: Names of the columns that have no known meaning.
        columns: Their numbers, ``(n,)`` each; ``None`` where one is no number.

    Example:
        >>> unrecognised_time(["frame", "zeit"], [np.arange(3.0), np.array([0.0, 0.1, 0.2])])
        'zeit'
        >>> unrecognised_time(["frame", "gain"], [np.arange(3.0), np.ones(3)]) is None
        True
    """
    for name, values in zip(names, columns, strict=True):
        bare = _bare(name)
        if bare in _COUNTERS:
            continue
        if _LIKE_A_TIME.search(bare):
            return name
        if values is None or len(values) < 3 or not np.isfinite(values).all():
            continue
        steps = np.diff(values)
        counts = bool((steps == 1).all())
        if (steps > 0).all() and not counts and not _is_length(bare):
            return name
    return None


class _Name(NamedTuple):
    prefix: str
    whole: str
    mark: str
    fraction: str
    suffix: str


_STAMP = re.compile(r"^(.*?(?<!\d))(\d+)(?:([._,-])(\d+))?(\D*)$")


def decimal_names(names: Sequence[str]) -> list[float] | None:
    """Read file names as decimal numbers, or return ``None`` if they are counters or no numbers.

    ``str(time.time())`` drops trailing zeros, so that ``17.5`` comes after ``17.25``. Counters such
    as ``1.9`` and ``1.10`` have fractions of several digits that end in 0. A mark other than a
    point only counts behind a Unix time.

    Args:
        names: File names without folder and suffix.

    Example:
        >>> decimal_names(["17.5", "17.25", "17.0"])
        [17.5, 17.25, 17.0]
        >>> decimal_names(["1.9", "1.10", "1.11"]) is None
        True
    """
    parts = _stamps(names)
    if parts is None or not any(part.fraction for part in parts):
        return None
    unix = all(len(part.whole) in (9, 10) for part in parts)
    if not unix and any(part.mark not in ("", ".") for part in parts):
        return None
    widths = {len(part.fraction) for part in parts}
    pointed = all(part.mark in ("", ".") for part in parts)
    counts = any(len(part.fraction) > 1 and part.fraction.endswith("0") for part in parts)
    if len(widths) > 1 and counts and not (unix and pointed):
        return None
    return [float(f"{part.whole}.{part.fraction or 0}") for part in parts]


def times_of_names(names: Sequence[str]) -> tuple[np.ndarray, Unit] | None:
    """Read file names as Unix times, in seconds with a fraction, or whole ms, us or ns.

    Args:
        names: File names without folder and suffix, in order.

    Returns:
        Times in seconds, ``(n,)``, and the unit; ``None`` if the names are something else.

    Example:
        >>> times_of_names(["1403636579763555584", "1403636579813555456"])[1]
        'ns'
        >>> times_of_names(["000001", "000002"]) is None
        True
    """
    parts = _stamps(names)
    if parts is None or len(names) < 2:
        return None
    if any(part.fraction for part in parts):
        decimals = decimal_names(names)
        if decimals is None or any(part.mark not in ("", ".") for part in parts):
            return None
        if max(len(part.fraction) for part in parts) < 2:
            return None
        times_s, unit = np.array(decimals), _SECONDS
    else:
        digits = {len(part.whole) for part in parts}
        unit = _DIGITS.get(max(digits))
        if len(digits) != 1 or unit is None:
            return None
        times_s = np.array([int(part.whole) / PER_SECOND[unit] for part in parts])
    in_range = (times_s >= _UNIX_S[0]) & (times_s < _UNIX_S[1])
    if not in_range.all() or not (np.diff(times_s) > 0).all():
        return None
    return times_s, unit


def _stamps(names: Sequence[str]) -> list[_Name] | None:
    """Split names into the parts of a number, or ``None`` if they differ in anything else."""
    parts = []
    for name in names:
        match = _STAMP.match(name)
        if match is None:
            return None
        parts.append(_Name(*(group or "" for group in match.groups())))
    if len({(part.prefix, part.suffix) for part in parts}) > 1:
        return None
    if len({part.mark for part in parts} - {""}) > 1:
        return None
    return parts


def _bare(name: str) -> str:
    return name.strip().lstrip("#").strip().strip("\"'").strip().lower()


def _is_unit(name: str) -> bool:
    words, unit = _words_and_unit(name)
    return unit is not None and all(
        word in (*_PREFIXES, "stamp", "timestamp", "time") for word in words
    )


def _is_length(name: str) -> bool:
    words = re.split(r"[^a-z]+", name)
    lengths = {"x", "y", "z", "m", "mm", "cm", "km", "rad", "deg", "theta", "yaw", "heading"}
    return bool(lengths & set(words)) or bool(
        re.search(r"dist|odo|mile|travel|path|tick|encoder|count", name)
    )


def _words_and_unit(name: str) -> tuple[list[str], Unit | None]:
    """Split a name into words and the unit that it ends with or has in brackets."""
    unit: Unit | None = None
    bracket = re.search(r"[\[(]\s*([a-z\u00b5\u03bc]+)\s*[\])]", name)
    if bracket:
        unit = _UNITS.get(bracket[1])
        if unit is None:
            return [name], None  # a quantity of another unit
        name = name[: bracket.start()] + name[bracket.end() :]
    words = [word for word in re.split(r"[^a-z0-9\u00b5\u03bc]+", name) if word]
    words = [word for word in words if word not in ("in", "since", "the")]
    if unit is None and words and words[-1] in _UNITS:
        unit = _UNITS[words.pop()]
    return words, unit
