"""Paths through worlds of landmarks in two or three dimensions, random or recorded."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.interpolate import make_interp_spline

from neuroslam.errors import SourceError
from neuroslam.worlds.rodent import Walk


class LandmarkPath(NamedTuple):
    """Positions of an animal at equal time steps.

    Attributes:
        time_step_s: Time between two rows in seconds.
        position_m: ``(steps, dimension)``; scaled to the box, see ``metres``.
        metres: Metres per unit of the positions, if they were scaled to a box.
    """

    time_step_s: float
    position_m: np.ndarray
    metres: float = 1.0

    @property
    def velocity_m_s(self) -> np.ndarray:
        """Backward differences of the positions, ``(steps, dimension)``; the first is zero."""
        return np.diff(self.position_m, axis=0, prepend=self.position_m[:1]) / self.time_step_s

    @property
    def time_s(self) -> np.ndarray:
        """Time since the first row, ``(steps,)``."""
        return np.arange(len(self.position_m)) * self.time_step_s

    def resampled(self, time_step_s: float) -> "LandmarkPath":
        """Return the path at another time step, interpolated by a cubic spline."""
        if time_step_s == self.time_step_s:
            return self
        n = round((len(self.position_m) - 1) * self.time_step_s / time_step_s) + 1
        times = np.minimum(np.arange(n) * time_step_s, self.time_s[-1])
        return self._replace(
            time_step_s=time_step_s, position_m=_spline(self.time_s, self.position_m, times)
        )

    def first(self, seconds: float) -> "LandmarkPath":
        """Return the first seconds of the path."""
        return self._replace(position_m=self.position_m[: round(seconds / self.time_step_s)])


def band_limited_path(
    duration_s: float,
    limit_hz: float = 0.08,
    dimension: int = 2,
    seed: int = 0,
    time_step_s: float = 1e-3,
    reach_m: float = 0.9,
) -> LandmarkPath:
    """Make a path of band-limited white noise, with each coordinate scaled to the reach.

    Args:
        duration_s: Duration, and period of the noise.
        limit_hz: Highest frequency.
        dimension: Dimension of the space.
        seed: Seed of the noise.
        time_step_s: Time between two rows.
        reach_m: Largest absolute coordinate.

    Raises:
        SourceError: If the duration is shorter than one period of the limit.

    Example:
        >>> path = band_limited_path(20.0, 0.1, seed=1, time_step_s=0.01)
        >>> path.position_m.shape, float(abs(path.position_m).max().round(6))
        ((2000, 2), 0.9)
    """
    n, highest = round(duration_s / time_step_s), int(limit_hz * duration_s)
    if highest < 1:
        raise SourceError(
            f"a path of {duration_s} s has no frequency below {limit_hz} Hz; expected at "
            f"least {1 / limit_hz:.1f} s"
        )
    generator = np.random.default_rng(seed)
    waves = np.zeros((n // 2 + 1, dimension), dtype=np.complex128)
    real, imaginary = generator.standard_normal((2, highest, dimension))
    waves[1 : highest + 1] = real + 1j * imaginary
    x = np.fft.irfft(waves, n=n, axis=0)
    low, high = x.min(0), x.max(0)
    return LandmarkPath(time_step_s, reach_m * (2.0 * (x - low) / (high - low) - 1.0))


def read_path(path: str | Path, time_step_s: float = 1e-3, reach_m: float = 0.9) -> LandmarkPath:
    """Read a recorded path, scaled to a box.

    Args:
        path: A ``.npy`` with one row of coordinates per step, or a ``.csv`` with a time in seconds
            and the coordinates per row, with or without a header.
        time_step_s: Time between two rows of a ``.npy``, and of the result.
        reach_m: Half the longest side after scaling, all axes by one factor.

    Raises:
        SourceError: If the file cannot be read, or contains no path.
    """
    path = Path(path)
    try:
        if path.suffix == ".npy":
            table = np.load(path, allow_pickle=False)
            times = np.arange(len(table)) * time_step_s
        elif path.suffix == ".csv":
            table = np.genfromtxt(path, delimiter=",", dtype=np.float64)
            table = table[1:] if np.isnan(table[:1]).all() else table
            times, table = table[:, 0], table[:, 1:]
        else:
            raise SourceError(f"{path}: unknown suffix; expected a .npy or a .csv file")
    except OSError as error:
        raise SourceError(f"{path}: cannot be read ({error.strerror or error})") from None
    except (ValueError, IndexError) as error:
        if isinstance(error, SourceError):
            raise
        raise SourceError(f"{path}: is damaged ({error}); expected a table of numbers") from None
    return _into_box(times, table, time_step_s, reach_m, str(path))


KITTI_SEQUENCES = tuple(f"{number:02d}" for number in range(11))
"""KITTI odometry sequences whose true poses are published; those of 11 to 21 are not."""


def kitti_files(folder: str | Path, sequence: str = "00") -> tuple[Path, Path]:
    """Find the files of true poses and of times of a KITTI odometry sequence.

    Args:
        folder: With ``poses/00.txt`` and ``sequences/00/times.txt``, as KITTI's archives unpack, or
            with ``KITTI_00_gt.txt`` and ``KITTI_00_gt_times.txt``.
        sequence: Number of the sequence, of two digits.

    Raises:
        SourceError: If KITTI publishes no poses of the sequence, or there are no such files.

    Example:
        >>> kitti_files(".", "11")
        Traceback (most recent call last):
        neuroslam.errors.SourceError: KITTI sequence '11': its true poses are not published; \
expected one of 00, 01, 02, 03, 04, 05, 06, 07, 08, 09, 10
    """
    if sequence not in KITTI_SEQUENCES:
        raise SourceError(
            f"KITTI sequence {sequence!r}: its true poses are not published; expected one of "
            f"{', '.join(KITTI_SEQUENCES)}"
        )
    folder = Path(folder)
    pairs = (
        (f"KITTI_{sequence}_gt.txt", f"KITTI_{sequence}_gt_times.txt"),
        (f"poses/{sequence}.txt", f"sequences/{sequence}/times.txt"),
    )
    found = [(folder / poses, folder / times) for poses, times in pairs]
    for poses, times in found:
        if poses.is_file() and times.is_file():
            return poses, times
    for poses, times in found:
        if poses.is_file():
            raise SourceError(
                f"{times}: no such file; KITTI's times are in its archive of calibration files"
            )
    raise SourceError(
        f"{folder}: has no poses of KITTI sequence {sequence}; expected {pairs[0][0]} or "
        f"{pairs[1][0]}, from KITTI's archive of ground truth poses"
    )


def read_kitti(
    folder: str | Path, sequence: str = "00", time_step_s: float = 1e-3, reach_m: float = 0.9
) -> LandmarkPath:
    """Read the true poses of a KITTI odometry sequence as a path in three dimensions.

    The camera's axes (x right, y down, z ahead) are converted to x right, y ahead, z up.

    Args:
        folder: As for :func:`kitti_files`.
        sequence: Number of the sequence.
        time_step_s: Time step of the path.
        reach_m: Half the longest side after scaling, all axes by one factor.

    Raises:
        SourceError: If a file is missing or has other columns.
    """
    poses, times = (_table(file) for file in kitti_files(folder, sequence))
    if poses.shape[1] != 12 or times.shape[1] != 1 or len(poses) != len(times):
        raise SourceError(
            f"{folder}: poses have shape {poses.shape}, times {times.shape}; expected (n, 12) and "
            "(n, 1)"
        )
    positions = np.stack([poses[:, 3], poses[:, 11], -poses[:, 7]], axis=-1)
    return _into_box(times[:, 0], positions, time_step_s, reach_m, str(folder))


def path_of_walk(walk: Walk, time_step_s: float = 1e-3, reach_m: float = 0.9) -> LandmarkPath:
    """Convert a rodent's walk to a path, scaled to a box."""
    return _into_box(walk.times_s, walk.positions, time_step_s, reach_m, walk.name)


def _table(path: Path) -> np.ndarray:
    try:
        return np.loadtxt(path, ndmin=2)
    except OSError as error:
        raise SourceError(f"{path}: cannot be read ({error.strerror or error})") from None
    except ValueError as error:
        raise SourceError(f"{path}: is damaged ({error}); expected a table of numbers") from None


def _into_box(
    times: np.ndarray, positions: np.ndarray, time_step_s: float, reach_m: float, name: str
) -> LandmarkPath:
    """Scale positions to a box, all axes by one factor, and sample them at equal steps."""
    if positions.ndim != 2 or len(positions) < 4 or positions.shape[1] < 1:
        raise SourceError(
            f"{name}: positions have shape {positions.shape}; expected (n, dimension), n at least 4"
        )
    if not np.isfinite(positions).all() or not (np.diff(times) > 0).all():
        raise SourceError(
            f"{name}: a position is not finite, or a time does not rise; expected finite positions "
            "and rising times"
        )
    low, high = positions.min(0), positions.max(0)
    metres = float((high - low).max()) / (2.0 * reach_m)
    if metres == 0:
        raise SourceError(f"{name}: all positions are equal; expected a path")
    scaled = (positions - (low + high) / 2) / metres
    n = int((times[-1] - times[0]) / time_step_s + 1e-9) + 1
    even = times[0] + np.arange(n) * time_step_s
    sampled = _spline(times, scaled, np.minimum(even, times[-1]))
    return LandmarkPath(time_step_s, np.clip(sampled, -reach_m, reach_m), metres)


def _spline(times: np.ndarray, positions: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    return np.asarray(make_interp_spline(times, positions, k=3)(wanted))
