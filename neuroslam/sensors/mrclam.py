r"""Folders of the UTIAS multi-robot data sets (MRCLAM): odometry, landmark sightings, truth.

K. Leung, Y. Halpern, T. Barfoot, H. Liu, "The UTIAS multi-robot cooperative localization and
mapping dataset", IJRR 30(8), 2011. A folder has, for each robot ``N``, ``RobotN_Odometry.dat``
(time, speed, turn rate), ``RobotN_Measurement.dat`` (time, barcode, range, bearing) and,
optionally, ``RobotN_Groundtruth.dat`` (time, x, y, heading), and ``Barcodes.dat`` (subject,
barcode). Subjects up to 5 are the robots, the others are landmarks that stand still: those become
the landmarks of a frame, numbered by subject. ``folder?robot=2`` chooses the robot, ``rate=10`` the
frames per second to which odometry (67 Hz) is summed; a speed holds until the next one. Times are
in seconds, or in ms, us or ns if their size shows that. A line that cannot be read, or an odometry
whose time does not rise, is left out and counted.
"""

from pathlib import Path

import numpy as np
from pydantic import BaseModel, Field

from neuroslam.errors import BadFrame, SourceError, counted
from neuroslam.sensors.datasets import at_times, no_truth
from neuroslam.sensors.images import read_text
from neuroslam.sensors.landmarks import LandmarkWords
from neuroslam.sensors.options import parse_options
from neuroslam.sensors.sightings import require_sightings, sightings_between
from neuroslam.sensors.source import IndexedSource
from neuroslam.sensors.times import in_seconds, unit_note
from neuroslam.sensors.tracks import MAX_SPEED, SLOWEST_S, usable_times
from neuroslam.types import Frame, Pose, Velocity

LAST_ROBOT = 5
"""Subjects up to this number are robots, which move."""

LONGEST_GAP_S = 2.0
"""In a longer gap of the odometry there are no frames."""


class MrclamOptions(BaseModel):
    """Options behind the ``?`` of the folder's name."""

    robot: int = Field(default=1, ge=1, le=LAST_ROBOT, description="number of the robot")
    rate: float = Field(default=10.0, gt=0, le=100, description="frames per second")


class MrclamSource(IndexedSource):
    """Odometry and landmark sightings of one robot of an MRCLAM folder.

    Attributes:
        landmarks_m: True positions of the landmarks by number, if the folder has them.
    """

    landmarks_m: dict[int, tuple[float, float]]

    def __init__(self, folder: Path, options: MrclamOptions) -> None:
        stem = f"Robot{options.robot}"
        self.name = f"{folder}?robot={options.robot}"
        notes: list[str] = []
        odometry = _timed_rows(folder / f"{stem}_Odometry.dat", 3, notes)
        odometry = _rising_rows(f"{self.name}: its odometry", odometry, notes)
        seen = _timed_rows(folder / f"{stem}_Measurement.dat", 4, notes)
        subjects = {int(code): int(who) for who, code in read_rows(folder / "Barcodes.dat", 2)}
        self._rate = self.frame_rate_hz = options.rate
        self._times_s, n_gaps = frame_times(odometry[:, 0], options.rate)
        self.n_frames = len(self._times_s)
        if n_gaps:
            notes.append(
                f"{self.name}: {counted(n_gaps, 'gap')} of more than {LONGEST_GAP_S:g} s in its "
                "odometry, without frames"
            )
        steps = odometry[:-1, 1:] * np.diff(odometry[:, 0])[:, None]
        sums = np.vstack([np.zeros(2), np.cumsum(steps, axis=0)])
        at = np.column_stack([np.interp(self._times_s, odometry[:, 0], c) for c in sums.T])
        self._velocities = np.zeros((self.n_frames, 2))
        self._velocities[1:] = np.diff(at, axis=0) / np.diff(self._times_s)[:, None]
        number = np.array([subjects.get(int(code), -1) for code in seen[:, 1]])
        fixed = number > LAST_ROBOT
        self._seen = np.column_stack([seen[fixed, 0], number[fixed], seen[fixed, 2:4]])
        self._seen = self._seen[np.argsort(self._seen[:, 0], kind="stable")]
        require_sightings(f"{self.name}: its measurements", self._seen[:, 2], self._seen[:, 3])
        self._truth: np.ndarray | None = None
        truth = folder / f"{stem}_Groundtruth.dat"
        if truth.is_file():
            rows = _timed_rows(truth, 4, notes)
            self._truth = at_times(rows[:, 0], rows[:, 1:], self._times_s)
            notes += no_truth(str(truth), self._truth, rows[:, 0], self._times_s)
        self.landmarks_m = {}
        standing = folder / "Landmark_Groundtruth.dat"
        if standing.is_file():
            self.landmarks_m = {int(n): (x, y) for n, x, y in read_rows(standing, 3).tolist()}
        self.landmark_words = tuple(
            LandmarkWords(f"POST_{n}", number=n) for n in sorted(set(number[fixed].tolist()))
        )
        others = int((~fixed).sum())
        self.notes = (
            *notes,
            f"{self.name}: {counted(int(fixed.sum()), 'sighting')} of "
            f"{counted(len(self.landmark_words), 'landmark')}; "
            f"{counted(others, 'sighting')} of robots or unknown barcodes left out",
        )

    def frame(self, index: int) -> Frame:
        """Return the frame of that index, see :meth:`IndexedSource.frame`."""
        time_s, rate = float(self._times_s[index]), self._rate
        v, w = self._velocities[index].tolist()
        if not (abs(v) <= MAX_SPEED and abs(w) <= MAX_SPEED):
            raise BadFrame(
                f"{self.name}: frame {index}: its motion is v = {v:.3g} m/s, w = {w:.3g} rad/s; "
                f"expected at most {MAX_SPEED:,.0f}"
            )
        truth = None if self._truth is None else self._truth[index]
        return Frame(
            index,
            time_s,
            velocity=Velocity(v, w),
            landmarks=sightings_between(self._seen, time_s - 1.0 / rate, time_s),
            truth=Pose(*truth.tolist()) if truth is not None and np.isfinite(truth).all() else None,
        )


def is_mrclam(path: Path) -> bool:
    """Return whether a folder is one of MRCLAM: by its barcodes and an odometry."""
    return (path / "Barcodes.dat").is_file() and any(path.glob("Robot?_Odometry.dat"))


def open_mrclam(path: Path, query: str = "") -> MrclamSource:
    """Open a folder of MRCLAM.

    Args:
        path: The folder.
        query: Options, ``robot=2&rate=10``.

    Raises:
        SourceError: If a file is missing or damaged, or an option is invalid.
    """
    return MrclamSource(path, parse_options(str(path), query, MrclamOptions))


def frame_times(times_s: np.ndarray, rate_hz: float) -> tuple[np.ndarray, int]:
    """Return the times of frames at a rate, without those inside a gap; and the number of gaps.

    Args:
        times_s: Rising times of the odometry.
        rate_hz: Frames per second, counted from the first of them.

    Example:
        >>> frame_times(np.array([0.0, 0.5, 9.5, 10.0]), 2.0)
        (array([ 0. ,  0.5,  9.5, 10. ]), 1)
    """
    since = times_s - times_s[0]
    gaps = np.flatnonzero(np.diff(since) > LONGEST_GAP_S)
    begins = np.concatenate([[0], gaps + 1])
    ends = np.concatenate([gaps, [len(since) - 1]])
    low = np.ceil(since[begins] * rate_hz - 1e-6).astype(np.int64)
    high = np.floor(since[ends] * rate_hz + 1e-6).astype(np.int64)
    numbers = [np.arange(a, b + 1) for a, b in zip(low, high, strict=True)]
    return times_s[0] + np.concatenate(numbers) / rate_hz, len(gaps)


def _timed_rows(path: Path, columns: int, notes: list[str]) -> np.ndarray:
    """Read rows of which the first number is a time, in seconds unless its size shows another."""
    rows = read_rows(path, columns, notes)
    rows[:, 0], unit = in_seconds(rows[:, 0], slowest_s=SLOWEST_S)
    if unit != "s":
        notes.append(unit_note(str(path), None, unit))
    return rows


def _rising_rows(what: str, rows: np.ndarray, notes: list[str]) -> np.ndarray:
    """Leave out the rows whose times do not rise, and note them."""
    usable = usable_times(rows[:, 0])
    lost = int((~usable).sum())
    if usable.sum() < 2 or 2 * lost > len(rows):
        raise SourceError(
            f"{what}: {lost} of {counted(len(rows), 'time')} do not rise; expected rising times"
        )
    if lost:
        notes.append(f"{what}: {counted(lost, 'row')} whose time does not rise left out")
    return rows[usable]


def read_rows(path: Path, columns: int, notes: list[str] | None = None) -> np.ndarray:
    """Read the first columns of a table of numbers separated by blanks; ``#`` begins a comment.

    Args:
        path: The file.
        columns: Number of columns to read.
        notes: Receives a note on the lines that cannot be used and are left out, unless they are
            half of all; ``None``: such a line is an error.

    Raises:
        SourceError: If the file is missing or empty, or a line holds too few numbers.
    """
    text = read_text(path)
    rows, faults = [], []
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        try:
            row = [float(word) for word in words[:columns]]
        except ValueError:
            row = []
        if len(row) < columns or not np.isfinite(row).all():
            faults.append(f"line {number} is {line[:40]!r}; expected {columns} numbers")
            continue
        rows.append(row)
    if faults and (notes is None or len(faults) >= len(rows)):
        raise SourceError(f"{path}: {faults[0]}")
    if faults and notes is not None:
        what = counted(len(faults), "line")
        notes.append(f"{path}: {what} left out, the first: {faults[0]}")
    if not rows:
        raise SourceError(f"{path}: is empty; expected lines of {columns} numbers")
    return np.array(rows)
