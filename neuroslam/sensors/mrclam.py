r"""Folders of the UTIAS multi-robot data sets (MRCLAM): odometry, landmark sightings, truth.

K. Leung, Y. Halpern, T. Barfoot, H. Liu, "The UTIAS multi-robot cooperative localization and
mapping dataset", IJRR 30(8), 2011. A folder has, for each robot ``N``, ``RobotN_Odometry.dat``
(time, speed, turn rate), ``RobotN_Measurement.dat`` (time, barcode, range, bearing) and,
optionally, ``RobotN_Groundtruth.dat`` (time, x, y, heading), and ``Barcodes.dat`` (subject,
barcode). Subjects up to 5 are the robots, the others are landmarks that stand still: those become
the landmarks of a frame, numbered by subject. ``folder?robot=2`` chooses the robot, ``rate=10`` the
frames per second to which odometry (67 Hz) is summed; a speed holds until the next one.
"""

from pathlib import Path

import numpy as np
from pydantic import BaseModel, Field

from neuroslam.errors import BadFrame, SourceError, counted
from neuroslam.sensors.datasets import at_times
from neuroslam.sensors.images import read_text
from neuroslam.sensors.landmarks import LandmarkWords
from neuroslam.sensors.options import parse_options
from neuroslam.sensors.sightings import sightings_between
from neuroslam.sensors.source import IndexedSource
from neuroslam.types import Frame, Pose, Velocity

LAST_ROBOT = 5
"""Subjects up to this number are robots, which move."""


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
        odometry = read_rows(folder / f"{stem}_Odometry.dat", 3)
        seen = read_rows(folder / f"{stem}_Measurement.dat", 4)
        subjects = {int(code): int(who) for who, code in read_rows(folder / "Barcodes.dat", 2)}
        begin_s, end_s = odometry[0, 0], odometry[-1, 0]
        if not end_s > begin_s:
            raise SourceError(f"{self.name}: its odometry lasts 0 s; expected rising times")
        self.n_frames = int((end_s - begin_s) * options.rate + 1e-6) + 1
        self._rate = self.frame_rate_hz = options.rate
        self._times_s = begin_s + np.arange(self.n_frames) / options.rate
        steps = odometry[:-1, 1:] * np.diff(odometry[:, 0])[:, None]
        sums = np.vstack([np.zeros(2), np.cumsum(steps, axis=0)])
        at = np.column_stack([np.interp(self._times_s, odometry[:, 0], c) for c in sums.T])
        self._velocities = np.diff(at, axis=0, prepend=at[:1]) * options.rate
        number = np.array([subjects.get(int(code), -1) for code in seen[:, 1]])
        fixed = number > LAST_ROBOT
        self._seen = np.column_stack([seen[fixed, 0], number[fixed], seen[fixed, 2:4]])
        self._seen = self._seen[np.argsort(self._seen[:, 0], kind="stable")]
        self._truth: np.ndarray | None = None
        truth = folder / f"{stem}_Groundtruth.dat"
        if truth.is_file():
            rows = read_rows(truth, 4)
            self._truth = at_times(rows[:, 0], rows[:, 1:], self._times_s)
        self.landmarks_m = {}
        standing = folder / "Landmark_Groundtruth.dat"
        if standing.is_file():
            self.landmarks_m = {int(n): (x, y) for n, x, y in read_rows(standing, 3).tolist()}
        self.landmark_words = tuple(
            LandmarkWords(f"POST_{n}", number=n) for n in sorted(set(number[fixed].tolist()))
        )
        others = int((~fixed).sum())
        self.notes = (
            f"{self.name}: {counted(int(fixed.sum()), 'sighting')} of "
            f"{counted(len(self.landmark_words), 'landmark')}; "
            f"{counted(others, 'sighting')} of robots or unknown barcodes left out",
        )

    def frame(self, index: int) -> Frame:
        """Return the frame of that index, see :meth:`IndexedSource.frame`."""
        time_s, rate = float(self._times_s[index]), self._rate
        v, w = self._velocities[index].tolist()
        if not np.isfinite([v, w]).all():
            raise BadFrame(f"{self.name}: frame {index}: its motion is not finite")
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


def read_rows(path: Path, columns: int) -> np.ndarray:
    """Read the first columns of a table of numbers separated by blanks; ``#`` begins a comment.

    Raises:
        SourceError: If the file is missing or empty, or a line holds too few numbers.
    """
    try:
        text = read_text(path)
    except OSError as error:
        raise SourceError(f"{path}: cannot be read ({error.strerror or error})") from None
    rows = []
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        try:
            row = [float(word) for word in words[:columns]]
        except ValueError:
            row = []
        if len(row) < columns or not np.isfinite(row).all():
            raise SourceError(f"{path}: line {number} is {line[:40]!r}; expected {columns} numbers")
        rows.append(row)
    if not rows:
        raise SourceError(f"{path}: is empty; expected lines of {columns} numbers")
    return np.array(rows)
