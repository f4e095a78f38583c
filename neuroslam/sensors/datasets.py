r"""Folders with the layout of TUM RGB-D, KITTI, EuRoC, TUM-VI, or a tub of donkeycar.

Each has images with times, and may have ground-truth poses in three dimensions. The truth of a
frame is the pose projected onto the ground plane: position, and heading of the optical axis.

============  =======================================================  ======================
TUM RGB-D     ``rgb.txt``, ``rgb/``; ``groundtruth.txt``               z is up
KITTI raw     ``image_02/data/``, ``timestamps.txt``;                  Mercator plane, x east,
              ``oxts/data/``, ``oxts/timestamps.txt``                  m from the first pose
KITTI         ``image_0/`` or ``image_2/``, ``times.txt``;             y is down: ground x is
              ``poses.txt`` or ``../../poses/NN.txt``                  z, ground y is -x
EuRoC         ``mav0/cam0/data.csv``, ``data/``, ``sensor.yaml``;      z is up
              ``mav0/state_groundtruth_estimate0/data.csv``
TUM-VI        as EuRoC; ``mav0/mocap0/data.csv``,                      z is up
              ``dso/camchain.yaml``
donkeycar     ``manifest.json``, ``catalog_N.catalog``, ``images/``    no truth
============  =======================================================  ======================
"""

import re
from pathlib import Path

import numpy as np

from neuroslam.errors import SourceError, counted
from neuroslam.geometry import wrap_angles
from neuroslam.sensors.axes import axes_note, rotate
from neuroslam.sensors.images import (
    ImageFile,
    ImageSource,
    is_image_name,
    natural_key,
    open_image_list,
    parse_times,
    read_text,
)
from neuroslam.sensors.times import in_seconds, parse_time, unit_note
from neuroslam.sensors.tracks import SLOWEST_S, time_text
from neuroslam.sensors.tub import is_tub, open_tub
from neuroslam.types import GreyRule

MAX_GAP_S = 0.1
"""An image as far in time as this from every known pose has no truth."""

_MAX_BEYOND_S = 0.02
"""An image farther than this before the first known pose or after the last has no truth."""

_ROUNDING_S = 1e-6
"""Unix times in s differ by less than this through rounding."""

_KITTI_CAMERAS = ("image_2", "image_0", "image_3", "image_1")
_RAW_CAMERAS = ("image_02", "image_00", "image_03", "image_01")
_EARTH_M = 6378137.0  # radius of the Earth
_TRUTHS = ("state_groundtruth_estimate0", "mocap0")  # of EuRoC and of TUM-VI


def open_dataset(path: Path, frame_rate_hz: float, grey: GreyRule = "luma") -> ImageSource | None:
    """Open a folder of one of the datasets; ``None`` if it has none of their layouts.

    Raises:
        SourceError: If a file of the dataset is missing or damaged.
    """
    if (path / "rgb.txt").is_file():
        return open_tum(path, frame_rate_hz, grey)
    for mav in (path / "mav0", path):
        if (mav / "cam0" / "data.csv").is_file():
            return open_euroc(mav, frame_rate_hz, grey)
    if is_tub(path):
        return open_tub(path, frame_rate_hz, grey)
    if any((path / camera).is_dir() for camera in _KITTI_CAMERAS):
        return open_kitti(path, frame_rate_hz, grey)
    if any((path / camera / "data").is_dir() for camera in _RAW_CAMERAS):
        return open_kitti_raw(path, frame_rate_hz, grey)
    return None


def open_tum(path: Path, frame_rate_hz: float, grey: GreyRule = "luma") -> ImageSource:
    """Open a folder of the TUM RGB-D benchmark.

    Raises:
        SourceError: If a file is missing or damaged.
    """
    images = open_image_list(path / "rgb.txt", frame_rate_hz)
    times, truth = images.clock.times_s, None
    notes = list(images.notes)
    truth_file = path / "groundtruth.txt"
    if truth_file.is_file():
        if times is None:
            raise SourceError(
                f"{path / 'rgb.txt'}: has no times; expected lines 'time_s path', as the poses of "
                "groundtruth.txt are assigned by time"
            )
        rows = _table(truth_file, 8, notes)
        known_s, unit = in_seconds(rows[:, 0], "s")
        if unit != "s":
            notes.append(unit_note(str(truth_file), "s", unit))
        forward = rotate(rows[:, 4:8], np.array([0.0, 0.0, 1.0]))
        poses = _on_ground(rows[:, 1], rows[:, 2], forward[:, 0], forward[:, 1])
        truth = at_times(known_s, poses, times)
        notes += no_truth(str(truth_file), truth, known_s, times)
        option = f"run with --truth {truth_file} --axes camera"
        if note := axes_note(str(truth_file), rows[:, 1:4], option):
            notes.append(note)
    return ImageSource(
        str(path),
        images.images,
        times,
        images.clock.frame_rate_hz,
        truth=truth,
        grey=grey,
        notes=tuple(notes),
    )


def open_kitti(path: Path, frame_rate_hz: float, grey: GreyRule = "luma") -> ImageSource:
    """Open a sequence of the KITTI odometry benchmark.

    Raises:
        SourceError: If a file is missing or damaged.
    """
    folder = next(path / camera for camera in _KITTI_CAMERAS if (path / camera).is_dir())
    names = sorted((f.name for f in folder.iterdir() if is_image_name(f.name)), key=natural_key)
    if not names:
        raise SourceError(f"{folder}: contains no images; expected files like 000000.png")
    times_file = path / "times.txt"
    times, truth, notes = None, None, []
    if times_file.is_file():
        times, found = parse_times(read_text(times_file), str(times_file))
        notes += found
    numbered = path.resolve().parent.parent / "poses" / f"{path.resolve().name}.txt"
    for poses_file in (path / "poses.txt", numbered):
        if poses_file.is_file():
            rows = _table(poses_file, 12, notes, keep=len(names))
            if len(rows) != len(names):
                raise SourceError(
                    f"{poses_file}: {len(rows)} poses for {len(names)} images; expected one each"
                )
            truth = _on_ground(rows[:, 11], -rows[:, 3], rows[:, 10], -rows[:, 2])
            break
    images = [ImageFile(name, folder / name) for name in names]
    return ImageSource(
        str(path), images, times, frame_rate_hz, truth=truth, grey=grey, notes=tuple(notes)
    )


def open_kitti_raw(path: Path, frame_rate_hz: float, grey: GreyRule = "luma") -> ImageSource:
    r"""Open a drive of the raw KITTI recordings; the truth is that of its GPS and IMU (OXTS).

    Latitude :math:`\varphi` and longitude :math:`\lambda` are projected as in the development kit,
    with the scale :math:`s = \cos\varphi_0` of the first pose and the Earth's radius :math:`R`:

    .. math:: x = s R \lambda, \qquad y = s R \ln \tan(\pi/4 + \varphi/2)

    Raises:
        SourceError: If a file is missing or damaged.
    """
    folder = next(path / camera for camera in _RAW_CAMERAS if (path / camera / "data").is_dir())
    names = sorted(f.name for f in (folder / "data").iterdir() if is_image_name(f.name))
    if not names:
        raise SourceError(f"{folder / 'data'}: contains no images; expected 0000000000.png")
    notes: list[str] = []
    times, truth = _raw_times(folder / "timestamps.txt", notes), None
    if times is not None:
        times = _of_numbers(times, names, folder, notes)
        finite = times[np.isfinite(times)]
        begin_s = finite[0] if len(finite) else 0.0
        times = times - begin_s
        oxts = path / "oxts"
        known = _raw_times(oxts / "timestamps.txt", notes)
        files = sorted((oxts / "data").glob("*.txt"))
        if known is not None and files:
            known = _of_numbers(known, [file.name for file in files], oxts, notes) - begin_s
            poses = _gps_poses(files, oxts, notes)
            truth = at_times(known, poses, times)
            notes.append(f"{oxts}: GPS and IMU are the truth; the motion is that of the images")
            notes += no_truth(str(oxts), truth, known, times)
    images = [ImageFile(name, folder / "data" / name) for name in names]
    return ImageSource(
        str(path), images, times, frame_rate_hz, truth=truth, grey=grey, notes=tuple(notes)
    )


def _gps_poses(files: list[Path], oxts: Path, notes: list[str]) -> np.ndarray:
    """Return the pose of each file of OXTS on the ground, ``(n, 3)``, NaN where it has none."""
    rows, faults = np.full((len(files), 6), np.nan), []
    for k, file in enumerate(files):
        try:
            row = _table(file, 6, [])[0]
            if not 0.0 < abs(row[0]) < 85.0 or abs(row[1]) > 180.0:
                raise SourceError(f"{file}: latitude {row[0]:g}, longitude {row[1]:g}; no position")
            rows[k] = row
        except SourceError as fault:
            faults.append(str(fault))
    usable = np.isfinite(rows).all(axis=1)
    if not usable.any():
        raise SourceError(f"{oxts}: no file has a pose, the first: {faults[0]}")
    if faults:
        notes.append(lost_rows(str(oxts), faults, len(files)))
    lat, lon = np.radians(rows[:, 0]), np.radians(rows[:, 1])
    first = int(usable.argmax())
    scale_m = np.cos(lat[first]) * _EARTH_M
    x, y = scale_m * lon, scale_m * np.log(np.tan(np.pi / 4.0 + lat / 2.0))
    return np.column_stack([x - x[first], y - y[first], rows[:, 5]])


def _of_numbers(
    times_s: np.ndarray, names: list[str], folder: Path, notes: list[str]
) -> np.ndarray:
    """Return the time of each file; if some are missing, by the numbers that are their names.

    Raises:
        SourceError: If there are more files than times, or their names are no numbers.
    """
    if len(times_s) == len(names):
        return times_s
    stems = [name.partition(".")[0] for name in names]
    numbers = [int(stem) if stem.isascii() and stem.isdigit() else -1 for stem in stems]
    if min(numbers) < 0 or max(numbers) >= len(times_s):
        raise SourceError(
            f"{folder}: {len(times_s)} times for {counted(len(names), 'file')}; expected one each"
        )
    missing = counted(len(times_s) - len(names), "file is", "files are")
    notes.append(f"{folder}: {missing} missing of {len(times_s)}; the others keep their times")
    return times_s[numbers]


def _raw_times(path: Path, notes: list[str]) -> np.ndarray | None:
    if not path.is_file():
        return None
    lines = read_text(path).split("\n")
    times = [np.nan if (t := parse_time(line)) is None else t for line in lines if line.strip()]
    if not times or np.isnan(times).all():
        raise SourceError(
            f"{path}: has no times; expected lines like 2011-09-26 13:02:25.594360375"
        )
    times_s, unit = in_seconds(np.array(times), slowest_s=SLOWEST_S)
    if unit != "s":
        notes.append(unit_note(str(path), None, unit))
    return times_s


def open_euroc(mav: Path, frame_rate_hz: float, grey: GreyRule = "luma") -> ImageSource:
    """Open the left camera of a ``mav0`` folder of the EuRoC MAV or the TUM-VI dataset.

    Raises:
        SourceError: If a file is missing or damaged.
    """
    camera = mav / "cam0"
    lines = [line.split(",") for line in read_text(camera / "data.csv").splitlines()]
    lines = [line for line in lines if line[0].strip() and not line[0].startswith("#")]
    try:
        stamps = [float(line[0]) for line in lines]
        names = [line[1].strip() for line in lines]
    except (ValueError, IndexError):
        raise SourceError(
            f"{camera / 'data.csv'}: is damaged; expected lines 'time in ns,image file'"
        ) from None
    if not names:
        raise SourceError(f"{camera / 'data.csv'}: lists no images; expected one per line")
    images = [ImageFile(name, camera / "data" / name) for name in names]
    truth, notes = None, []
    times = _nanoseconds(np.array(stamps), str(camera / "data.csv"), notes)
    truth_file = next((f for t in _TRUTHS if (f := mav / t / "data.csv").is_file()), None)
    if truth_file is not None:
        rows = _table(truth_file, 8, notes, ",")
        chain = mav.parent / "dso" / "camchain.yaml"
        axis = _axis_in_chain(chain) if chain.is_file() else _optical_axis(camera / "sensor.yaml")
        forward = rotate(rows[:, [5, 6, 7, 4]], axis)  # EuRoC writes w first
        poses = _on_ground(rows[:, 1], rows[:, 2], forward[:, 0], forward[:, 1])
        known_s = _nanoseconds(rows[:, 0], str(truth_file), notes)
        truth = at_times(known_s, poses, times)
        notes += no_truth(str(truth_file), truth, known_s, times)
        option = f"convert it and run with --truth FILE --axes camera, or leave {truth_file} out"
        if note := axes_note(str(truth_file), rows[:, 1:4], option):
            notes.append(note)
    return ImageSource(
        str(mav.parent), images, times, frame_rate_hz, truth=truth, grey=grey, notes=tuple(notes)
    )


def _nanoseconds(times: np.ndarray, name: str, notes: list[str]) -> np.ndarray:
    """Convert times that should be in nanoseconds to seconds, and note another unit."""
    times_s, unit = in_seconds(times, slowest_s=SLOWEST_S)
    if unit != "ns" and len(times) > 1:
        notes.append(unit_note(name, None, unit))
    return times / 1e9 if unit == "ns" or len(times) == 1 else times_s


def no_truth(
    name: str, truth: np.ndarray, known_s: np.ndarray, times_s: np.ndarray
) -> tuple[str, ...]:
    """Return a note if no frame has a true pose.

    Args:
        name: File of the truth.
        truth: Poses of the frames, ``(m, 3)``, NaN where unknown.
        known_s: Times of the truth in seconds.
        times_s: Times of the frames.
    """
    if np.isfinite(truth).all(axis=1).any():
        return ()
    spans = [
        f"{time_text(float(np.nanmin(t)))} to {time_text(float(np.nanmax(t)))}"
        if np.isfinite(t).any()
        else "no time"
        for t in (known_s, times_s)
    ]
    return (
        f"{name}: no frame has a true pose: it spans {spans[0]}, the frames {spans[1]}; expected "
        "one clock",
    )


def at_times(known_s: np.ndarray, poses: np.ndarray, times_s: np.ndarray) -> np.ndarray:
    """Interpolate poses on the ground plane at given times.

    Args:
        known_s: Times of the poses in seconds, ``(n,)``.
        poses: x, y (m) and heading (rad), ``(n, 3)``.
        times_s: Times at which poses are needed, ``(m,)``.

    Returns:
        Poses ``(m, 3)``, NaN where no pose is known within less than ``MAX_GAP_S``, or, before the
        first known pose and after the last, within 0.02 s. A row that is not finite is unknown.

    Example:
        >>> poses = np.array([[0.0, 0.0, 3.0], [1.0, 0.0, -3.2]])
        >>> at_times(np.array([0.0, 0.1]), poses, np.array([0.05, 9.0])).round(3).tolist()
        [[0.5, 0.0, 3.042], [nan, nan, nan]]
    """
    known = np.isfinite(known_s) & np.isfinite(poses[:, :2]).all(axis=1)
    headed = known & np.isfinite(poses[:, 2])
    order = np.argsort(known_s, kind="stable")
    known, headed = order[known[order]], order[headed[order]]
    xy = _interpolated(known_s[known], poses[known, :2], times_s)
    heading = _interpolated(known_s[headed], np.unwrap(poses[headed, 2])[:, None], times_s)
    return np.column_stack([xy, wrap_angles(heading)])


def _interpolated(known_s: np.ndarray, values: np.ndarray, times_s: np.ndarray) -> np.ndarray:
    """Interpolate values ``(n, c)`` at rising times; NaN where none is known near enough."""
    if not len(known_s):
        return np.full((len(times_s), values.shape[1]), np.nan)
    found = np.column_stack([np.interp(times_s, known_s, column) for column in values.T])
    after = np.searchsorted(known_s, times_s)
    since = np.where(after > 0, times_s - known_s[after - 1], np.inf)
    until = np.where(
        after < len(known_s), known_s[after.clip(max=len(known_s) - 1)] - times_s, np.inf
    )
    gap = np.minimum(since, until)
    inside = np.isfinite(since) & np.isfinite(until) & (gap < MAX_GAP_S - _ROUNDING_S)
    found[~(inside | (gap <= _MAX_BEYOND_S + _ROUNDING_S))] = np.nan
    return found


def _table(
    path: Path,
    columns: int,
    notes: list[str],
    separator: str | None = None,
    keep: int | None = None,
) -> np.ndarray:
    """Read the first columns of a table of numbers; lines that start with ``#`` are comments.

    A line that cannot be read, is not finite, or has a quaternion of length 0 costs its row; the
    notes count them.

    Args:
        path: The file.
        columns: Number of columns to read.
        notes: Receives a note on the lines that cannot be used.
        separator: Separator of the columns; ``None``: blanks.
        keep: Number of rows expected, one for each image: an unusable row is NaN then.

    Raises:
        SourceError: If half of the lines or more cannot be used.
    """
    lines = [
        (number, line)
        for number, line in enumerate(read_text(path).rstrip().splitlines(), start=1)
        if not line.lstrip().startswith("#")
    ]
    if keep is None or len(lines) != keep:
        lines = [(number, line) for number, line in lines if line.strip()]
    rows, faults = [], []
    for number, line in lines:
        try:
            row = [float(word) for word in line.split(separator)[:columns]]
        except ValueError:
            row = []
        is_lost = columns == 8 and not any(row[4:8])  # a quaternion of length 0
        if len(row) < columns or is_lost or not np.isfinite(row).all():
            faults.append(f"line {number} is {line[:40]!r}; expected {columns} numbers")
            row = [np.nan] * columns
        rows.append(row)
    if not rows:
        raise SourceError(f"{path}: contains no poses; expected {columns} numbers per line")
    if 2 * len(faults) >= len(rows):
        raise SourceError(f"{path}: {faults[0]}")
    if faults:
        notes.append(lost_rows(str(path), faults, len(rows)))
    table = np.array(rows)
    return table if keep is not None else table[np.isfinite(table).all(axis=1)]


def lost_rows(name: str, faults: list[str], n_rows: int) -> str:
    """Return a note on the rows of a truth that cannot be used.

    Example:
        >>> lost_rows("truth.tum", ["line 7: got 3 numbers"], 60)
        'truth.tum: 1 of 60 rows has no usable pose, the first: line 7: got 3 numbers'
    """
    have = "has" if len(faults) == 1 else "have"
    return (
        f"{name}: {len(faults)} of {counted(n_rows, 'row')} {have} no usable pose, "
        f"the first: {faults[0]}"
    )


def _on_ground(
    x_m: np.ndarray, y_m: np.ndarray, ahead_x: np.ndarray, ahead_y: np.ndarray
) -> np.ndarray:
    return np.column_stack([x_m, y_m, np.arctan2(ahead_y, ahead_x)])


def _optical_axis(sensor: Path) -> np.ndarray:
    """Direction of the optical axis in the body frame: third column of ``T_BS``; x without it."""
    if not sensor.is_file():
        return np.array([1.0, 0.0, 0.0])
    data = re.search(r"T_BS:.*?data:\s*\[(.*?)\]", read_text(sensor), re.DOTALL)
    try:
        words = [] if data is None else data[1].split(",")
        matrix = np.array([float(word) for word in words]).reshape(4, 4)
    except ValueError:
        raise SourceError(f"{sensor}: has no T_BS; expected a matrix of 16 numbers") from None
    return matrix[:3, 2]


def _axis_in_chain(chain: Path) -> np.ndarray:
    """Direction of the optical axis of the first camera in the frame of the IMU.

    It is the third row of ``T_cam_imu`` of Kalibr's ``camchain.yaml``.
    """
    data = re.search(r"T_cam_imu:\s*((?:-\s*\[[^\]]*\]\s*){4})", read_text(chain))
    words = [] if data is None else re.findall(r"[-+\d.eE]+(?=\s*[,\]])", data[1])
    try:
        matrix = np.array([float(word) for word in words]).reshape(4, 4)
    except ValueError:
        raise SourceError(f"{chain}: has no T_cam_imu; expected a matrix of 16 numbers") from None
    return matrix[2, :3]
