"""Sources without pictures: a CSV of motion, or the track of an animal; and the times of frames.

A motion CSV has a header and one line a frame. It needs the columns ``v_m_s`` and ``w_rad_s`` (or
``vtrans`` and ``vrot``), may have ``time_s``, and may have the true pose ``x_m``, ``y_m``,
``theta_rad``, empty where it is not known; other columns are not read.

A track is an ``.npz`` with the positions ``pos``, ``(n, 2)`` in metres, and the times ``t``,
``(n,)`` in seconds, or an ``.npy`` with the positions alone.
"""

import csv
import io
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from neuroslam.errors import BadFrame, SourceError
from neuroslam.geometry import wrap_angles
from neuroslam.sensors.source import IndexedSource
from neuroslam.types import Frame, Pose, Velocity

_ALIASES = {"vtrans": "v_m_s", "vrot": "w_rad_s"}
_MOTION = ("v_m_s", "w_rad_s")
_TRUTH = ("x_m", "y_m", "theta_rad")
_FASTEST = 1e6  # m/s, rad/s: no robot's, but that of a damaged log, whose sums would overflow
_MAY_HOLD_PICKLES = (b"\x80", b"PK", b"\x93NUMPY")  # a pickle, an .npz and an .npy begin so
_EXPECTED = "expected v_m_s,w_rad_s (or vtrans,vrot), if you like time_s, and x_m,y_m,theta_rad"


class Clock:
    """The times of the frames of a source: given ones, which must rise, or ``index / rate``.

    Args:
        name: The source, for messages.
        times_s: Times in seconds, ``(n,)``, or ``None`` where the source has none.
        frame_rate_hz: Frames per second where it has none.

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
        if times_s is not None:
            finite = np.where(np.isfinite(times_s), times_s, -np.inf)
            latest = np.maximum.accumulate(finite)
            self._before = np.concatenate([[-np.inf], latest[:-1]])
            steps = np.diff(times_s[self.usable])
            self.frame_rate_hz = 1.0 / float(np.median(steps)) if len(steps) else frame_rate_hz

    @property
    def usable(self) -> np.ndarray:
        """Which of the given times are finite and later than all before, ``(n,)`` bool."""
        return np.isfinite(self.times_s) & (self.times_s > self._before)

    def at(self, index: int) -> float:
        """Return the time of a frame in seconds.

        Raises:
            BadFrame: If it is not finite or not later than those before.
        """
        if self.times_s is None:
            return index / self.frame_rate_hz
        time_s = float(self.times_s[index])
        if not np.isfinite(time_s):
            raise BadFrame(f"{self.name}: frame {index}: its time is {time_s}; expected a number")
        if not time_s > self._before[index]:
            raise BadFrame(
                f"{self.name}: frame {index}: its time {time_s:g} s is not after "
                f"{self._before[index]:g} s; times must rise"
            )
        return time_s


@dataclass(frozen=True)
class Track:
    """Measured motion, one row a frame.

    Attributes:
        name: Where it comes from, for messages.
        velocities: Forward speed (m/s) and turn rate (rad/s), ``(n, 2)``.
        times_s: ``(n,)``, or ``None``.
        truth: True poses, ``(n, 3)``, NaN where unknown, or ``None``.
        rows: How each row is called in messages.
    """

    name: str
    velocities: np.ndarray
    times_s: np.ndarray | None
    truth: np.ndarray | None
    rows: Sequence[str]

    def velocity(self, index: int) -> Velocity:
        """Return the motion over the interval that ends at that frame.

        Raises:
            BadFrame: If it is not finite, or no robot's.
        """
        v, w = self.velocities[index].tolist()
        if not (abs(v) <= _FASTEST and abs(w) <= _FASTEST):  # NaN too
            raise BadFrame(
                f"{self.name}: frame {index} ({self.rows[index]}): its motion is v = {v} m/s, "
                f"w = {w} rad/s; expected finite numbers, at most {_FASTEST:g}"
            )
        return Velocity(v, w)

    def pose(self, index: int) -> Pose | None:
        """Return the true pose at that frame, or ``None`` where it is not known."""
        if self.truth is None or not np.isfinite(self.truth[index]).all():
            return None
        return Pose(*self.truth[index].tolist())


class TrackSource(IndexedSource):
    """Frames that hold motion, and the true pose where it is known, but no picture."""

    def __init__(self, track: Track, frame_rate_hz: float) -> None:
        self.name = track.name
        self.track = track
        self.clock = Clock(track.name, track.times_s, frame_rate_hz)
        self.n_frames = len(track.velocities)
        self.frame_rate_hz = self.clock.frame_rate_hz

    def frame(self, index: int) -> Frame:
        """Make the frame of that number, see :meth:`IndexedSource.frame`."""
        time_s = self.clock.at(index)
        velocity = self.track.velocity(index)
        return Frame(index, time_s, velocity=velocity, truth=self.track.pose(index))


def parse_motion(text: str, name: str) -> Track:
    r"""Read a motion CSV, as the head of this module describes it.

    Raises:
        SourceError: If it is empty, lacks a column, or a line does not fit the header.

    Example:
        >>> parse_motion("vtrans,vrot\n0.5,0.1\n", "walk.csv").velocity(0)
        Velocity(v_m_s=0.5, w_rad_s=0.1)
    """
    table, rows = parse_table(text, name, _MOTION, _EXPECTED, optional=("time_s",), whole=_TRUTH)
    return Track(
        name,
        np.column_stack([table[field] for field in _MOTION]),
        table.get("time_s"),
        np.column_stack([table[field] for field in _TRUTH]) if _TRUTH[0] in table else None,
        rows,
    )


def parse_table(
    text: str,
    name: str,
    needed: Sequence[str],
    expected: str,
    optional: Sequence[str] = (),
    whole: Sequence[str] = (),
) -> tuple[dict[str, np.ndarray], list[str]]:
    r"""Read the numbers of a CSV that has a header; an empty field is NaN.

    Args:
        text: What the file holds.
        name: The file, for messages.
        needed: Columns it must have.
        expected: What to say it should have had.
        optional: Columns it may have.
        whole: Columns of which it has all or none.

    Returns:
        The columns, each ``(n,)``; how each row is called in messages.

    Raises:
        SourceError: If it is empty, lacks a column, or a line does not fit the header.

    Example:
        >>> parse_table("x_m,y_m\n1,2\n3,\n", "walk.csv", ("x_m", "y_m"), "")[0]["y_m"]
        array([ 2., nan])
    """
    reader = csv.reader(io.StringIO(text))
    numbered = [(reader.line_num, row) for row in reader if any(field.strip() for field in row)]
    if not numbered:
        raise SourceError(f"{name}: is empty; {expected}, and a line for each frame")
    header = [field.strip().lower() for field in numbered[0][1]]
    columns = [_ALIASES.get(field, field) for field in header]
    needed = [*needed, *(whole if any(field in columns for field in whole) else ())]
    missing = [field for field in needed if field not in columns]
    if missing:
        raise SourceError(
            f"{name}: has the columns {','.join(header)[:100]} and no {missing[0]}; {expected}"
        )
    if len(numbered) == 1:
        raise SourceError(f"{name}: has a header and no lines after it; expected one a frame")
    wanted = [*(field for field in optional if field in columns), *needed]
    places = [columns.index(field) for field in wanted]
    values = np.empty((len(numbered) - 1, len(wanted)))
    for out, (line, row) in zip(values, numbered[1:], strict=True):
        if len(row) != len(columns):
            raise SourceError(f"{name}: line {line} has {len(row)} values; expected {len(columns)}")
        for at, place in enumerate(places):
            out[at] = _number(row[place], name, line, wanted[at])
    rows = [f"line {line}" for line, _ in numbered[1:]]
    return dict(zip(wanted, values.T, strict=True)), rows


def _number(text: str, name: str, line: int, column: str) -> float:
    try:
        return float(text) if text.strip() else np.nan
    except ValueError:
        raise SourceError(
            f"{name}: line {line}: {column} is {text.strip()[:40]!r}; expected a number"
        ) from None


def read_track(path: Path, frame_rate_hz: float) -> Track:
    """Read a track, as the head of this module describes it: positions become motion and truth.

    Raises:
        SourceError: If the file is damaged, holds pickled objects, or has other arrays in it.
    """
    _, times, positions = read_positions(path)
    n = len(positions)
    usable = np.isfinite(positions).all(axis=1)
    if times is not None:
        usable &= Clock(str(path), times, frame_rate_hz).usable
    clock = np.arange(n) / frame_rate_hz if times is None else times
    velocities, truth = np.full((n, 2), np.nan), np.full((n, 3), np.nan)
    if usable.any():
        velocities[usable], truth[usable] = motion_along(clock[usable], positions[usable])
    return Track(str(path), velocities, times, truth, [f"row {row}" for row in range(n)])


def read_positions(path: Path) -> tuple[dict[str, np.ndarray], np.ndarray | None, np.ndarray]:
    """Read all arrays of a track's file, and of them the times and positions, both ``float64``.

    Raises:
        SourceError: If the file is damaged, holds pickled objects, or has other arrays in it.
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
    times = arrays["t"].astype(np.float64) if "t" in arrays else None
    return arrays, times, arrays["pos"].astype(np.float64)


def motion_along(times_s: np.ndarray, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    r"""Turn positions into motion along the path: turn to face the next position, then go there.

    .. math:: v_k = |p_k - p_{k-1}| / \Delta t, \quad w_k = (h_k - h_{k-1}) / \Delta t

    The heading :math:`h_k` is that of the step; who stands still keeps it. Dead-reckoning the
    result with :func:`neuroslam.geometry.integrate_velocities` gives the positions again.

    Args:
        times_s: ``(n,)``, rising.
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
        with path.open("rb") as file:
            loaded = np.load(file, allow_pickle=False)
            if isinstance(loaded, np.ndarray):
                return {"pos": loaded}
            return {key: loaded[key] for key in loaded.files}
    except (ValueError, EOFError, OSError, zipfile.BadZipFile) as error:
        if "pickle" in str(error):  # numpy says so of whatever it does not know
            with path.open("rb") as file:
                pickled = file.read(6).startswith(_MAY_HOLD_PICKLES)
            raise SourceError(
                f"{path}: holds pickled objects, which are never loaded; expected plain arrays"
                if pickled
                else f"{path}: is not an .npz or .npy file; expected one that numpy wrote"
            ) from None
        raise SourceError(
            f"{path}: is not a whole .npz or .npy file ({_first_line(error)})"
        ) from None


def _first_line(error: Exception) -> str:
    return (str(error) or type(error).__name__).splitlines()[0]
