"""Sources without images: a motion CSV or the track of an animal; and the clock of all sources.

A motion CSV has a header and one line per frame. The columns ``v_m_s`` and ``w_rad_s`` (or
``vtrans`` and ``vrot``) are required. Optional are the time, the turn rate of a gyroscope,
``gyro_rad_s``, the speed upwards, ``v_z_m_s`` (``v_m_s`` is then the horizontal one), and the true
pose, ``x_m``, ``y_m`` and ``theta_rad``, all empty where unknown.
Other columns are ignored. The time is ``time_s`` or a column with another usual name, in s, ms, us
or ns (:mod:`neuroslam.sensors.times`); a table with a column that looks like a time and has no
usual name is refused.

A track is an ``.npz`` with the positions ``pos``, ``(n, 2)`` in metres, and the times ``t``,
``(n,)`` in seconds, or an ``.npy`` with the positions alone.
"""

import csv
import io
import math
import re
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from neuroslam.errors import BadFrame, SourceError, counted
from neuroslam.geometry import wrap_angles
from neuroslam.limits import (
    NotReadableError,
    check_regular,
    fits,
    is_bomb,
    size_text,
    too_much,
)
from neuroslam.sensors.source import IndexedSource
from neuroslam.sensors.times import (
    TimeColumn,
    in_seconds,
    parse_time,
    time_column,
    unit_note,
    unrecognised_time,
)
from neuroslam.types import Frame, Pose, Velocity

_ALIASES = {"vtrans": "v_m_s", "vrot": "w_rad_s"}
_MOTION = ("v_m_s", "w_rad_s")
_GYROSCOPE, _CLIMB = "gyro_rad_s", "v_z_m_s"
_TRUTH = ("x_m", "y_m", "theta_rad")
_MAY_HOLD_PICKLES = (b"\x80", b"PK", b"\x93NUMPY")  # first bytes of a pickle, an .npz and an .npy
_COPIES = 4  # of positions: as they are, as numbers, velocities and poses
_EXPECTED = (
    "expected v_m_s,w_rad_s (or vtrans,vrot), optionally time_s, gyro_rad_s, v_z_m_s and "
    "x_m,y_m,theta_rad"
)
_X = re.compile(r"(?:p|pos_?|position_?)?x(?:_?pos)?(?:[_ \[(].*)?")


MAX_SPEED = 1e6
"""In m/s and rad/s: only a damaged log has more, and its sums could overflow."""

SLOWEST_S = 10.0
"""Longest step of times that a format defines in seconds; a longer one shows another unit."""


SLOW_S = 1.0
"""Longest step of times in seconds that is not reported."""


class Clock:
    """Times of the frames of a source: recorded times, which must rise, or ``index / rate``.

    Args:
        name: Name of the source, for messages.
        times_s: Recorded times in seconds, ``(n,)``; ``None`` if there are none.
        frame_rate_hz: Frames per second if there are no times.

    Example:
        >>> Clock("walk", None, 20.0).at(3)
        0.15
        >>> Clock("run", np.array([0.0, 0.5, 0.25]), 20.0).at(2)
        Traceback (most recent call last):
        neuroslam.errors.BadFrame: run: frame 2: its time 0.25 s is not after 0.5 s; times must rise
    """

    def __init__(self, name: str, times_s: np.ndarray | None, frame_rate_hz: float) -> None:
        self.name = name
        self.times_s = times_s
        self.frame_rate_hz = frame_rate_hz
        self.notes: tuple[str, ...] = ()
        if times_s is None:
            self.notes = (f"{name}: has no times; {frame_rate_hz:g} frames per second assumed",)
        if times_s is not None:
            self._before = _latest_before(times_s)
            steps = np.diff(times_s[rising(times_s)])
            self.frame_rate_hz = 1.0 / float(np.median(steps)) if len(steps) else frame_rate_hz

    def at(self, index: int) -> float:
        """Return the time of a frame in seconds.

        Raises:
            BadFrame: If the time is not finite, or not later than all times before it.
        """
        if self.times_s is None:
            return index / self.frame_rate_hz
        time_s = float(self.times_s[index])
        if not np.isfinite(time_s):
            raise BadFrame(f"{self.name}: frame {index}: its time is {time_s} s; expected a number")
        if not time_s > self._before[index]:
            raise BadFrame(
                f"{self.name}: frame {index}: its time {time_text(time_s)} is not after "
                f"{time_text(self._before[index])}; times must rise"
            )
        return time_s


def rising(times_s: np.ndarray) -> np.ndarray:
    """Return which times are finite and later than all times before them, ``(n,)`` bool.

    Example:
        >>> rising(np.array([0.0, 0.5, 0.25, np.nan, 1.0])).tolist()
        [True, True, False, False, True]
    """
    return np.asarray(np.isfinite(times_s) & (times_s > _latest_before(times_s)))


def usable_times(times_s: np.ndarray) -> np.ndarray:
    """Return which times of a track to use, ``(n,)`` bool: they rise, and most are kept.

    Those are the times later than all before, or those earlier than all after, so that one wrong
    time costs its own row, whether it is too early or too late.

    Example:
        >>> usable_times(np.array([0.0, 99.0, 1.0, 2.0])).tolist()
        [True, False, True, True]
    """
    early = rising(times_s)
    late = rising(-times_s[::-1])[::-1]
    return early if early.sum() >= late.sum() else late


def _latest_before(times_s: np.ndarray) -> np.ndarray:
    """Return the latest finite time before each, ``(n,)``; -inf if there is none."""
    latest = np.maximum.accumulate(np.where(np.isfinite(times_s), times_s, -np.inf))
    return np.concatenate([[-np.inf], latest[:-1]])


def time_text(time_s: float) -> str:
    """Write a time to the microsecond, without trailing zeros; a Unix time keeps all digits.

    Example:
        >>> time_text(0.25), time_text(1700000000.0500001)
        ('0.25 s', '1700000000.05 s')
    """
    return f"{round(time_s, 6):.16g} s"


@dataclass(frozen=True)
class Track:
    """Measured motion, one row per frame.

    Attributes:
        name: Name of the file, for messages.
        velocities: Forward speed (m/s) and turn rate (rad/s), ``(n, 2)``.
        times_s: Times in seconds, ``(n,)``; ``None`` if there are none.
        truth: True poses, ``(n, 3)``, NaN where unknown; ``None`` if there are none.
        rows: Name of each row, for messages.
        notes: How the times were read, one line each.
        gyroscope: Turn rate by a gyroscope (rad/s), ``(n,)``, NaN where unknown; ``None``: it has
            none.
        climb: Speed upwards (m/s), likewise.
    """

    name: str
    velocities: np.ndarray
    times_s: np.ndarray | None
    truth: np.ndarray | None
    rows: Sequence[str]
    notes: tuple[str, ...] = ()
    gyroscope: np.ndarray | None = None
    climb: np.ndarray | None = None

    def speed_upwards(self, index: int) -> float | None:
        """Return the speed upwards at that frame, or ``None`` if it is unknown."""
        if self.climb is None or not math.isfinite(self.climb[index]):
            return None
        return float(self.climb[index])

    def turn_rate(self, index: int) -> float | None:
        """Return the turn rate by the gyroscope at that frame, or ``None`` if it is unknown."""
        if self.gyroscope is None or not math.isfinite(self.gyroscope[index]):
            return None
        return float(self.gyroscope[index])

    def velocity(self, index: int) -> Velocity:
        """Return the motion over the interval that ends at that frame.

        Raises:
            BadFrame: If the motion is not finite, or impossibly fast.
        """
        v, w = self.velocities[index].tolist()
        if not (abs(v) <= MAX_SPEED and abs(w) <= MAX_SPEED):  # NaN too
            raise BadFrame(
                f"{self.name}: frame {index} ({self.rows[index]}): its motion is v = {v} m/s, "
                f"w = {w} rad/s; expected finite numbers, at most {MAX_SPEED:,.0f}"
            )
        return Velocity(v, w)

    def pose(self, index: int) -> Pose | None:
        """Return the true pose at that frame, or ``None`` if it is unknown."""
        if self.truth is None or not np.isfinite(self.truth[index]).all():
            return None
        return Pose(*self.truth[index].tolist())


class TrackSource(IndexedSource):
    """Source of frames with motion, and the true pose if known, but without images."""

    def __init__(self, track: Track, frame_rate_hz: float) -> None:
        self.name = track.name
        self.track = track
        self.clock = Clock(track.name, track.times_s, frame_rate_hz)
        self.n_frames = len(track.velocities)
        self.frame_rate_hz = self.clock.frame_rate_hz
        self.notes = (*track.notes, *self.clock.notes)

    def frame(self, index: int) -> Frame:
        """Return the frame of that index, see :meth:`IndexedSource.frame`."""
        time_s = self.clock.at(index)
        velocity = self.track.velocity(index)
        return Frame(
            index,
            time_s,
            velocity=velocity,
            truth=self.track.pose(index),
            turn_rate_rad_s=self.track.turn_rate(index),
            v_z_m_s=self.track.speed_upwards(index),
        )


def parse_motion(text: str, name: str) -> Track:
    r"""Read a motion CSV; the module's docstring describes its format.

    Raises:
        SourceError: If the table is empty, lacks a column, or a line does not fit the header.

    Example:
        >>> parse_motion("vtrans,vrot\n0.5,0.1\n", "walk.csv").velocity(0)
        Velocity(v_m_s=0.5, w_rad_s=0.1)
    """
    table, rows, notes = parse_table(
        text, name, _MOTION, _EXPECTED, optional=("time_s", _GYROSCOPE, _CLIMB), together=_TRUTH
    )
    return Track(
        name,
        np.column_stack([table[field] for field in _MOTION]),
        table.get("time_s"),
        np.column_stack([table[field] for field in _TRUTH]) if _TRUTH[0] in table else None,
        rows,
        notes,
        table.get(_GYROSCOPE),
        table.get(_CLIMB),
    )


def has_positions(header: Sequence[str]) -> bool:
    """Return whether the header of a table names positions, and no motion.

    Example:
        >>> has_positions(["time_ms", "x_cm", "y_cm"]), has_positions(["v_m_s", "w_rad_s", "x_m"])
        (True, False)
    """
    fields = [field.strip().lstrip("#").strip().lower() for field in header]
    moves = any(_ALIASES.get(field, field) in _MOTION for field in fields)
    return not moves and any(_X.fullmatch(field) for field in fields)


class Table(NamedTuple):
    """A table of numbers.

    Attributes:
        columns: The columns by name, each ``(n,)``.
        rows: Name of each row, for messages.
        notes: How its times were read, one line each.
    """

    columns: dict[str, np.ndarray]
    rows: list[str]
    notes: tuple[str, ...] = ()


def parse_table(
    text: str,
    name: str,
    needed: Sequence[str],
    expected: str,
    optional: Sequence[str] = (),
    together: Sequence[str] = (),
    aliases: Mapping[str, str] | None = None,
    on_bad_row: Callable[[str], object] | None = None,
) -> Table:
    r"""Read a CSV of numbers with a header; an empty field is NaN.

    Lines that start with ``#`` are comments, but the header may start with it. If ``time_s`` is
    among the columns, the time column is found by any usual name and converted to seconds.

    Args:
        text: Content of the file.
        name: Name of the file, for messages.
        needed: Required columns.
        expected: Description of the expected columns, for messages.
        optional: Optional columns.
        together: Optional columns that are complete or absent; a field that is no number is NaN,
            with a note.
        aliases: Name of the column for each other name that it may have, in lower case.
        on_bad_row: Called with the fault of each row that cannot be read, which is then left out;
            ``None``: the fault is raised.

    Raises:
        SourceError: If the table is empty, lacks a column, its times are not recognised, or a line
            does not fit the header.

    Example:
        >>> parse_table("x_m,y_m\n1,2\n3,\n", "walk.csv", ("x_m", "y_m"), "").columns["y_m"]
        array([ 2., nan])
    """
    header, numbered = header_and_rows(text, name)
    if not header:
        raise SourceError(f"{name}: is empty; {expected}, and one line per frame")
    lowered = [field.strip().lstrip("#").strip().lower() for field in header]
    known = _ALIASES | dict(aliases or {})
    columns = [known.get(field, field) for field in lowered]
    with_time = "time_s" in (*needed, *optional)
    time = time_column(header) if with_time else None
    if time is not None:
        columns = [column if column != "time_s" else "" for column in columns]
        columns[time.index] = "time_s"
    needed = [*needed, *(together if any(field in columns for field in together) else ())]
    twice = [field for field in (*needed, *optional) if columns.count(field) > 1]
    if twice:
        raise SourceError(
            f"{name}: has {columns.count(twice[0])} columns of {twice[0]}; expected one"
        )
    missing = [field for field in needed if field not in columns]
    if missing:
        raise SourceError(
            f"{name}: has the columns {','.join(lowered)[:100]}, but no {missing[0]}; {expected}"
            + separator_note(header)
        )
    if not numbered:
        raise SourceError(f"{name}: has a header, but no lines; expected one line per frame")
    wanted = [*(field for field in optional if field in columns), *needed]
    if with_time and time is None:
        _require_no_times(header, columns, [row for _, row in numbered], wanted, name)
    numbers = [columns.index(field) for field in wanted]
    values, rows, lost = [], [], []
    for line, row in numbered:
        try:
            if len(row) != len(columns):
                raise SourceError(
                    f"{name}: line {line} has {len(row)} values; expected {len(columns)}"
                )
            found = []
            for column, number in zip(wanted, numbers, strict=True):
                try:
                    found.append(_number(row[number], name, line, column, column == "time_s"))
                except SourceError as fault:
                    if column not in together:
                        raise
                    found.append(math.nan)
                    lost.append(str(fault))
            if time is not None and time.rest is not None:
                found.append(_number(row[time.rest], name, line, header[time.rest]))
            values.append(found)
            rows.append(f"line {line}")
        except SourceError as fault:
            if on_bad_row is None:
                raise
            on_bad_row(str(fault))
    array = np.array(values, dtype=np.float64).reshape(len(values), len(values[0]) if values else 0)
    table = dict(zip(wanted, array.T, strict=False)) if len(values) else {
        field: np.zeros(0) for field in wanted
    }  # fmt: skip
    notes: tuple[str, ...] = ()
    if lost:
        notes = (f"{counted(len(lost), 'field')} of truth cannot be read, the first: {lost[0]}",)
    if time is not None:
        rest = array[:, -1] if time.rest is not None and len(values) else None
        table["time_s"], found = _as_seconds(table["time_s"], rest, time, name)
        notes = (*found, *notes)
    return Table(table, rows, notes)


def separator_note(header: Sequence[str]) -> str:
    """Return what to do about a header that other characters than commas separate."""
    for mark, what in ((";", "semicolons"), ("\t", "tabs"), (" ", "spaces")):
        if len(header) == 1 and len(header[0].strip().split(mark)) > 1:
            return f"; its columns are separated by {what}: write commas, and points in numbers"
    return ""


def header_and_rows(text: str, name: str) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Return the header, and the rows with the number of their line, without comments."""
    reader = csv.reader(io.StringIO(text))
    try:
        lines = [(reader.line_num, row) for row in reader if any(field.strip() for field in row)]
    except csv.Error as error:  # a field without end, a NUL
        raise SourceError(
            f"{name}: line {reader.line_num} is no line of a CSV table ({error})"
        ) from None
    comments = [row for _, row in lines if row[0].lstrip().startswith("#")]
    rows = [(number, row) for number, row in lines if not row[0].lstrip().startswith("#")]
    leading = 0
    while leading < len(lines) and lines[leading][1][0].lstrip().startswith("#"):
        leading += 1
    if leading and (not rows or all(_is_number(field) for field in rows[0][1])):
        return comments[leading - 1], rows  # numpy.savetxt writes the header as a comment
    return (rows[0][1], rows[1:]) if rows else ([], [])


def _is_number(text: str) -> bool:
    return not text.strip() or parse_time(text) is not None


def _require_no_times(
    header: list[str], columns: list[str], rows: list[list[str]], wanted: list[str], name: str
) -> None:
    """Refuse a table without a time column if another column looks like one."""
    names, values = [], []
    for index, (raw, column) in enumerate(zip(header, columns, strict=True)):
        if column in wanted or column in _TRUTH:
            continue
        fields = [row[index] if index < len(row) else "" for row in rows]
        parsed = [parse_time(field) for field in fields]
        names.append(raw.strip())
        values.append(None if None in parsed else np.array(parsed, dtype=np.float64))
    found = unrecognised_time(names, values)
    if found is not None:
        raise SourceError(
            f"{name}: its times are not recognised: column {found!r} looks like a time; name it "
            "time_s, time_ms, time_us or time_ns, or leave it out if it is none"
        )


def _as_seconds(
    values: np.ndarray, rest: np.ndarray | None, column: TimeColumn, name: str
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Convert a time column to seconds, and say how, unless it is ``time_s`` in seconds."""
    whole = bool((values == np.floor(values)).all())
    if rest is not None and whole and bool(((rest >= 0) & (rest < 1e9)).all()):
        note = f"{name}: times are columns {column.index + 1} and {(column.rest or 0) + 1}"
        return values + rest / 1e9, (f"{note}, in seconds and nanoseconds",)
    times_s, unit = in_seconds(values, column.unit)
    if column.name.lower() == "time_s" and unit == "s":
        return times_s, ()
    return times_s, (unit_note(f"{name}: column {column.name!r}", column.unit, unit),)


def _number(text: str, name: str, line: int, column: str, is_time: bool = False) -> float:
    if not text.strip():
        return math.nan
    try:
        time_s = parse_time(text) if is_time else None
        return float(text) if time_s is None else time_s
    except ValueError:
        also = " of seconds, or a date and time as 2024-05-01T12:00:00" if is_time else ""
        raise SourceError(
            f"{name}: line {line}: {column} is {text.strip()[:40]!r}; expected a number{also}"
        ) from None


def read_track(path: Path, frame_rate_hz: float) -> Track:
    """Read a track as motion and truth; the module's docstring describes its format.

    Raises:
        SourceError: If the file is damaged, contains pickled objects, or lacks the arrays.
    """
    _, times, positions, notes = read_positions(path)
    n = len(positions)
    usable = np.isfinite(positions).all(axis=1)
    if times is not None:
        usable &= rising(times)
    clock = np.arange(n) / frame_rate_hz if times is None else times
    velocities, truth = np.full((n, 2), np.nan), np.full((n, 3), np.nan)
    if usable.any():
        velocities[usable], truth[usable] = motion_along(clock[usable], positions[usable])
    return Track(str(path), velocities, times, truth, [f"row {row}" for row in range(n)], notes)


class Positions(NamedTuple):
    """The file of a track.

    Attributes:
        arrays: All arrays of the file by name.
        times_s: Times in seconds, ``(n,)``; ``None`` if there are none.
        positions: ``(n, 2)`` in metres.
        notes: How the times were read, one line each.
    """

    arrays: dict[str, np.ndarray]
    times_s: np.ndarray | None
    positions: np.ndarray
    notes: tuple[str, ...]


def read_positions(path: Path) -> Positions:
    """Read the file of a track.

    Raises:
        SourceError: If the file is damaged, contains pickled objects, or lacks the arrays.
    """
    arrays = _load_arrays(path)
    if "pos" not in arrays or ("t" not in arrays and path.suffix == ".npz"):
        raise SourceError(
            f"{path}: has the arrays {(', '.join(arrays) or 'none')[:100]}; expected pos (n, 2) in "
            "metres and t (n,) in seconds"
        )
    shapes = {key: arrays[key].shape for key in ("pos", "t") if key in arrays}
    n = len(arrays["pos"]) if arrays["pos"].ndim else 0
    numeric = all(arrays[key].dtype.kind in "fiu" for key in shapes)
    if n == 0 or not numeric or shapes["pos"] != (n, 2) or shapes.get("t", (n,)) != (n,):
        raise SourceError(
            f"{path}: {', '.join(f'{key} is {shape}' for key, shape in shapes.items())}; "
            "expected numbers, pos (n, 2) in metres and t (n,) in seconds, n above 0"
        )
    times, notes = None, ()
    if "t" in arrays:
        times, unit = in_seconds(arrays["t"], slowest_s=SLOWEST_S)
        notes = () if unit == "s" else (unit_note(f"{path}: t", None, unit),)
        steps = np.diff(times[np.isfinite(times)])
        if unit == "s" and len(steps) and np.median(steps) > SLOW_S:
            notes = (
                f"{path}: t advances by {np.median(steps):.3g} s a row; expected at most "
                f"{SLOW_S:g} s: are the times in milliseconds?",
            )
    return Positions(arrays, times, arrays["pos"].astype(np.float64), notes)


def motion_along(times_s: np.ndarray, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    r"""Convert positions to motion along the path: turn towards the next position, then move.

    .. math:: v_k = |p_k - p_{k-1}| / \Delta t, \quad w_k = (h_k - h_{k-1}) / \Delta t

    The heading :math:`h_k` is the direction of the step; without a step it stays. Dead reckoning
    with :func:`neuroslam.geometry.integrate_velocities` restores the positions.

    Args:
        times_s: Rising times in seconds, ``(n,)``.
        positions: ``(n, 2)`` in metres.

    Returns:
        Velocities ``(n, 2)`` in m/s and rad/s, the first zero; poses ``(n, 3)``.

    Example:
        >>> motion_along(np.array([0.0, 0.5]), np.array([[0.0, 0.0], [0.0, 1.0]]))[0].tolist()
        [[0.0, 0.0], [2.0, 0.0]]
    """
    steps = np.diff(positions, axis=0)
    lengths = np.hypot(steps[:, 0], steps[:, 1])
    last_moved = np.maximum.accumulate(np.where(lengths > 0, np.arange(len(steps)), 0))
    headings = np.arctan2(steps[:, 1], steps[:, 0])[last_moved]
    headings = np.concatenate([headings[:1] if len(steps) else [0.0], headings])
    velocities = np.zeros((len(positions), 2))
    velocities[1:, 0] = lengths / np.diff(times_s)
    velocities[1:, 1] = wrap_angles(np.diff(headings)) / np.diff(times_s)
    return velocities, np.column_stack([positions, headings])


def _load_arrays(path: Path) -> dict[str, np.ndarray]:
    try:
        check_regular(path)
        with path.open("rb") as file:
            _require_room(file, path)
            loaded = np.load(file, allow_pickle=False)
            if isinstance(loaded, np.ndarray):
                return {"pos": loaded}
            return {key: loaded[key] for key in loaded.files}
    except NotReadableError as error:
        raise SourceError(f"{path}: {error}") from None
    except (
        *(ValueError, EOFError, OSError, zipfile.BadZipFile, zlib.error, struct.error),
        *(SyntaxError, TypeError, KeyError, OverflowError, MemoryError),  # of damaged headers
        *(tokenize.TokenError, NotImplementedError, RuntimeError, RecursionError),
    ) as error:
        if "pickle" in str(error):  # numpy's message for every unknown format
            with path.open("rb") as file:
                pickled = file.read(6).startswith(_MAY_HOLD_PICKLES)
            raise SourceError(
                f"{path}: contains pickled objects, which are never loaded; expected plain arrays"
                if pickled
                else f"{path}: is not an .npz or .npy file; expected one written by numpy"
            ) from None
        raise SourceError(
            f"{path}: is damaged or incomplete ({_first_line(error)}); expected an .npz or .npy"
        ) from None


def _require_room(file: BinaryIO, path: Path) -> None:
    """Check how much memory the arrays of a file take, by what it states about them.

    Raises:
        NotReadableError: If they do not fit into the budget, or an archive is made to fill memory.
    """
    stated = size = path.stat().st_size
    if zipfile.is_zipfile(file):
        with zipfile.ZipFile(file) as archive:
            stated = sum(member.file_size for member in archive.infolist())
    file.seek(0)
    if is_bomb(size, stated):
        raise NotReadableError(
            f"its {size_text(size)} become {size_text(stated)}; expected an array of positions"
        )
    if not fits(needed := _COPIES * stated):
        raise NotReadableError(too_much(needed))


def _first_line(error: Exception) -> str:
    return (str(error) or type(error).__name__).splitlines()[0]
