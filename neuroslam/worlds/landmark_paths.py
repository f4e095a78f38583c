"""Paths through worlds of landmarks: random, recorded, in two or three dimensions."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.interpolate import make_interp_spline

from neuroslam.errors import SourceError
from neuroslam.worlds.rodent import Walk


class LandmarkPath(NamedTuple):
    """Where an animal is, at even steps.

    Attributes:
        time_step_s: Between two rows.
        position_m: ``(steps, dimension)``; in units of the box, see ``metres``.
        metres: How many a unit of the positions is, if they were scaled into a box.
    """

    time_step_s: float
    position_m: np.ndarray
    metres: float = 1.0

    @property
    def velocity_m_s(self) -> np.ndarray:
        """Backward differences, ``(steps, dimension)``; nothing at first."""
        return np.diff(self.position_m, axis=0, prepend=self.position_m[:1]) / self.time_step_s

    @property
    def time_s(self) -> np.ndarray:
        """Since the first row, ``(steps,)``."""
        return np.arange(len(self.position_m)) * self.time_step_s

    def resampled(self, time_step_s: float) -> "LandmarkPath":
        """Return the same path at other steps, through a cubic spline."""
        if time_step_s == self.time_step_s:
            return self
        n = round((len(self.position_m) - 1) * self.time_step_s / time_step_s) + 1
        at = np.minimum(np.arange(n) * time_step_s, self.time_s[-1])
        return self._replace(
            time_step_s=time_step_s, position_m=_spline(self.time_s, self.position_m, at)
        )

    def first(self, seconds: float) -> "LandmarkPath":
        """Return its beginning."""
        return self._replace(position_m=self.position_m[: round(seconds / self.time_step_s)])


def band_limited_path(
    duration_s: float,
    limit_hz: float = 0.08,
    dimension: int = 2,
    seed: int = 0,
    time_step_s: float = 1e-3,
    reach_m: float = 0.9,
) -> LandmarkPath:
    """Make a path of white noise below a frequency, each coordinate scaled to the reach.

    Args:
        duration_s: After which it would repeat.
        limit_hz: Highest frequency in it.
        dimension: Of the space.
        seed: Of the noise.
        time_step_s: Between two rows.
        reach_m: Largest coordinate.

    Raises:
        SourceError: If there is no frequency below the limit.

    Example:
        >>> path = band_limited_path(20.0, 0.1, seed=1, time_step_s=0.01)
        >>> path.position_m.shape, float(abs(path.position_m).max().round(6))
        ((2000, 2), 0.9)
    """
    n, highest = round(duration_s / time_step_s), int(limit_hz * duration_s)
    if highest < 1:
        raise SourceError(
            f"a path of {duration_s} s has no frequency below {limit_hz} Hz; make it longer than "
            f"{1 / limit_hz:.0f} s"
        )
    draw = np.random.default_rng(seed)
    waves = np.zeros((n // 2 + 1, dimension), dtype=np.complex128)
    real, imaginary = draw.standard_normal((2, highest, dimension))
    waves[1 : highest + 1] = real + 1j * imaginary
    x = np.fft.irfft(waves, n=n, axis=0)
    low, high = x.min(0), x.max(0)
    return LandmarkPath(time_step_s, reach_m * (2.0 * (x - low) / (high - low) - 1.0))


def read_path(path: str | Path, time_step_s: float = 1e-3, reach_m: float = 0.9) -> LandmarkPath:
    """Read a recorded path into a box: ``.npy`` of positions, or ``.csv`` with times before them.

    Args:
        path: A ``.npy`` has a row of coordinates for each step; a ``.csv`` has rows of a time in
            seconds and the coordinates, with or without a line of names above.
        time_step_s: Between two rows of a ``.npy``, and of what is returned.
        reach_m: The longest side is scaled to twice this, all axes by one factor.

    Raises:
        SourceError: If it cannot be read, or is no path.
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
            raise SourceError(f"{path}: a path is a .npy or a .csv file")
    except OSError:
        raise SourceError(f"{path}: cannot be read") from None
    except (ValueError, IndexError) as error:
        if isinstance(error, SourceError):
            raise
        raise SourceError(f"{path}: not a table of numbers ({error})") from None
    return _into_box(times, table, time_step_s, reach_m, str(path))


def read_kitti(
    folder: str | Path, sequence: str = "00", time_step_s: float = 1e-3, reach_m: float = 0.9
) -> LandmarkPath:
    """Read the true poses of a KITTI odometry sequence as a path in three dimensions.

    The camera's axes are turned to east, north and up: x is to the right, z ahead and y down.

    Args:
        folder: Holds ``KITTI_00_gt.txt`` and ``KITTI_00_gt_times.txt``, or other sequences'.
        sequence: Its number.
        time_step_s: Of the path.
        reach_m: The longest side is scaled to twice this, all axes by one factor.

    Raises:
        SourceError: If a file is missing or has other columns.
    """
    poses, times = (
        _table(Path(folder) / f"KITTI_{sequence}_gt{end}.txt") for end in ("", "_times")
    )
    if poses.shape[1] != 12 or times.shape[1] != 1 or len(poses) != len(times):
        raise SourceError(
            f"{folder}: poses {poses.shape} and times {times.shape}, expected 12 numbers and one "
            "in each of as many rows"
        )
    at = np.stack([poses[:, 3], poses[:, 11], -poses[:, 7]], axis=-1)
    return _into_box(times[:, 0], at, time_step_s, reach_m, str(folder))


def path_of_walk(walk: Walk, time_step_s: float = 1e-3, reach_m: float = 0.9) -> LandmarkPath:
    """Take a rodent's walk, scaled into a box."""
    return _into_box(walk.times_s, walk.positions, time_step_s, reach_m, walk.name)


def _table(path: Path) -> np.ndarray:
    try:
        return np.loadtxt(path, ndmin=2)
    except OSError:
        raise SourceError(f"{path}: cannot be read") from None
    except ValueError as error:
        raise SourceError(f"{path}: not a table of numbers ({error})") from None


def _into_box(
    times: np.ndarray, at: np.ndarray, time_step_s: float, reach_m: float, who: str
) -> LandmarkPath:
    """Scale positions into a box, all axes alike, and sample them evenly."""
    if at.ndim != 2 or len(at) < 4 or at.shape[1] < 1:
        raise SourceError(f"{who}: positions of shape {at.shape}, expected (at least 4, dimension)")
    if not np.isfinite(at).all() or not (np.diff(times) > 0).all():
        raise SourceError(f"{who}: positions must be numbers, and times must rise")
    low, high = at.min(0), at.max(0)
    metres = float((high - low).max()) / (2.0 * reach_m)
    if metres == 0:
        raise SourceError(f"{who}: it stays at one place")
    scaled = (at - (low + high) / 2) / metres
    n = int((times[-1] - times[0]) / time_step_s + 1e-9) + 1
    even = times[0] + np.arange(n) * time_step_s
    position = _spline(times, scaled, np.minimum(even, times[-1]))
    return LandmarkPath(time_step_s, np.clip(position, -reach_m, reach_m), metres)


def _spline(times: np.ndarray, at: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    return make_interp_spline(times, at, k=3)(wanted)
