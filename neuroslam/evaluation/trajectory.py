"""Error of a track against the truth: alignment, ATE, RPE, shape; TUM trajectory files."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from neuroslam.errors import MapError, SourceError
from neuroslam.geometry import relative_poses
from neuroslam.limits import read_table
from neuroslam.state.files import write_atomically

AlignmentMode = Literal["none", "rigid", "similarity"]


class Alignment(NamedTuple):
    """A similarity transform: ``point -> scale * rotation @ point + translation``.

    Attributes:
        rotation: Proper rotation, ``(d, d)``.
        translation: Metres, ``(d,)``.
        scale: Metres of truth per metre of estimate; 1 unless the mode is ``similarity``.
    """

    rotation: np.ndarray
    translation: np.ndarray
    scale: float

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Transform points ``(n, d)`` from the frame of the estimate to that of the truth."""
        return np.asarray(self.scale * points @ self.rotation.T + self.translation)

    def undo(self, points: np.ndarray) -> np.ndarray:
        """Transform points ``(n, d)`` from the frame of the truth to that of the estimate."""
        return np.asarray((points - self.translation) @ self.rotation / self.scale)


class ErrorStatistics(NamedTuple):
    """Statistics of ``n`` errors, in the unit of the errors."""

    rmse: float
    mean: float
    median: float
    max: float
    n: int


class RelativePoseError(NamedTuple):
    """Drift over a fixed number of frames: metres and radians."""

    translation_m: ErrorStatistics
    rotation_rad: ErrorStatistics


class Track(NamedTuple):
    """A track: times ``(n,)`` in s; x, y in m and heading in rad ``(n, 3)``; height in m ``(n,)``.

    Without heights it is in the plane.
    """

    times_s: np.ndarray
    poses: np.ndarray
    heights_m: np.ndarray | None = None


def align(estimate: np.ndarray, truth: np.ndarray, mode: AlignmentMode = "rigid") -> Alignment:
    r"""Find the transform of a track with the least squared distance to the truth.

    .. math:: \min_{c, R, t} \frac1n \sum_i \lVert y_i - (c R x_i + t) \rVert^2

    Closed form by S. Umeyama, "Least-squares estimation of transformation parameters between two
    point patterns", IEEE PAMI 13(4), 1991, Eqs. 34-43.

    Args:
        estimate: Points :math:`x_i`, ``(n, d)`` with d 2 or 3, metres.
        truth: Points :math:`y_i` at the same instants, same shape.
        mode: ``none`` is the identity, ``rigid`` keeps :math:`c = 1`, ``similarity`` finds the
            scale too.

    Raises:
        MapError: If shapes differ, a number is not finite, or the points do not fix a rotation
            (fewer than two distinct points in the plane).

    Example:
        >>> square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
        >>> found = align(square, 2.0 * square + 3.0, "similarity")
        >>> round(found.scale, 9), found.translation.round(9).tolist()
        (2.0, [3.0, 3.0])
    """
    estimate, truth = _as_points(estimate, truth)
    d = estimate.shape[1]
    if mode == "none":
        return Alignment(np.eye(d), np.zeros(d), 1.0)
    mean_x, mean_y = estimate.mean(axis=0), truth.mean(axis=0)  # Eqs. 34, 35
    x, y = estimate - mean_x, truth - mean_y
    for name, points, centred in (("estimate", estimate, x), ("truth", truth, y)):
        if np.abs(centred).max() <= 1e-12 * np.abs(points).max():
            raise MapError(
                f"alignment: all {len(points)} points of the {name} are equal; "
                "two distinct points are needed, or mode 'none'"
            )
    variance_x = np.square(x).sum() / len(x)  # Eq. 36
    covariance = y.T @ x / len(x)  # Eq. 38
    u, singular, vt = np.linalg.svd(covariance)
    if singular[d - 2] <= 1e-12 * math.sqrt(variance_x * np.square(y).sum() / len(y)):
        raise MapError(
            "alignment: the points do not fix a rotation (on one line, or unrelated); "
            "use mode 'none' or a track that turns"
        )
    sign = np.ones(d)
    if np.linalg.det(u) * np.linalg.det(vt) < 0:  # Eq. 43: a rotation, never a mirror
        sign[-1] = -1.0
    rotation = (u * sign) @ vt  # Eq. 40
    scale = float(singular @ sign / variance_x) if mode == "similarity" else 1.0  # Eq. 42
    return Alignment(rotation, mean_y - scale * rotation @ mean_x, scale)  # Eq. 41


def absolute_trajectory_error(
    estimate: np.ndarray, truth: np.ndarray, mode: AlignmentMode = "rigid"
) -> ErrorStatistics:
    r"""Return statistics of :math:`\lVert y_i - (c R x_i + t) \rVert` after :func:`align`.

    Args:
        estimate: Positions ``(n, d)``, metres.
        truth: Positions at the same instants, same shape.
        mode: Alignment before the error is measured.

    Returns:
        RMSE, mean, median and maximum in metres, and the number of points.

    Raises:
        MapError: As :func:`align`.

    Example:
        >>> track = np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]])
        >>> absolute_trajectory_error(track, track + [[0, 0], [0, 3], [0, 0]], "none").max
        3.0
    """
    estimate, truth = _as_points(estimate, truth)
    moved = align(estimate, truth, mode).apply(estimate)
    return statistics_of(np.linalg.norm(moved - truth, axis=1))


def relative_pose_error(
    estimate: np.ndarray, truth: np.ndarray, delta: int = 1
) -> RelativePoseError:
    r"""Compare the displacements over ``delta`` frames, starting at every frame :math:`i`.

    .. math:: E_i = \ominus (\ominus q_i \oplus q_{i+\Delta})
              \oplus (\ominus p_i \oplus p_{i+\Delta})

    Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012. The magnitude
    of :math:`E_i` does not depend on where the two tracks start, so there is no alignment.

    Args:
        estimate: Poses :math:`p`, ``(n, 3)``: x, y in metres, heading in radians.
        truth: Poses :math:`q` at the same instants, same shape.
        delta: :math:`\Delta`, frames, at least 1 and less than ``n``.

    Raises:
        MapError: If shapes differ, a number is not finite, or ``delta`` is out of bounds.

    Example:
        >>> straight = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
        >>> relative_pose_error(1.1 * straight, straight).translation_m.mean.__round__(6)
        0.1
    """
    estimate, truth = _as_points(estimate, truth)
    if estimate.shape[1] != 3:
        raise MapError(f"relative error: got shape {estimate.shape}, expected (n, 3) poses")
    if not 1 <= delta < len(estimate):
        raise MapError(
            f"relative error: delta is {delta} frames, expected 1 to {len(estimate) - 1} "
            f"for {len(estimate)} poses"
        )
    estimated, true = (relative_poses(poses[:-delta], poses[delta:]) for poses in (estimate, truth))
    error = relative_poses(true, estimated)
    return RelativePoseError(
        statistics_of(np.hypot(error[:, 0], error[:, 1])), statistics_of(np.abs(error[:, 2]))
    )


def associate(
    first_s: np.ndarray, second_s: np.ndarray, max_difference_s: float = 0.02
) -> tuple[np.ndarray, np.ndarray]:
    """Pair the times of two tracks that are nearest to each other; each is used at most once.

    Args:
        first_s: Rising times, ``(n,)``.
        second_s: Rising times, ``(m,)``.
        max_difference_s: Largest difference of a pair.

    Returns:
        Indices into the first and into the second, of equal length, rising; empty without a pair.

    Raises:
        MapError: If times decrease.

    Example:
        >>> [i.tolist() for i in associate([0.0, 1.0, 2.0], [1.01, 2.5], 0.1)]
        [[1], [0]]
    """
    first_s, second_s = np.asarray(first_s, np.float64), np.asarray(second_s, np.float64)
    for name, times in (("first", first_s), ("second", second_s)):
        if (np.diff(times) < 0).any():
            at = int(np.argmax(np.diff(times) < 0)) + 1
            raise MapError(
                f"associate: times of the {name} track decrease at index {at}, from "
                f"{times[at - 1]:.3f} s to {times[at]:.3f} s; sort them first"
            )
    if not (len(first_s) and len(second_s)):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    there, back = _nearest(first_s, second_s), _nearest(second_s, first_s)
    index = np.flatnonzero(back[there] == np.arange(len(first_s)))
    near = np.abs(first_s[index] - second_s[there[index]]) <= max_difference_s
    return index[near], there[index[near]]


def path_length(points: np.ndarray) -> float:
    """Return the length of a track ``(n, d)``, in its unit; 0 for fewer than two points.

    Example:
        >>> path_length(np.array([[0.0, 0.0], [3.0, 4.0], [3.0, 5.0]]))
        6.0
    """
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def shape_rmse(a_xy: np.ndarray, b_xy: np.ndarray) -> float:
    """Compare the shapes of two tracks: RMSE after a similarity alignment of ``a`` to ``b``.

    Args:
        a_xy: Positions ``(n, 2)``, any unit.
        b_xy: Positions at the same instants, same shape.

    Returns:
        RMSE as a fraction of the diagonal of the bounding box of ``b``.

    Raises:
        MapError: As :func:`align`.

    Example:
        >>> shape_rmse([[0, 0], [1, 0], [0, 1]], [[5, 5], [5, 7], [3, 5]]).__round__(9)
        0.0
    """
    rmse = absolute_trajectory_error(a_xy, b_xy, "similarity").rmse
    return rmse / float(np.linalg.norm(np.ptp(np.asarray(b_xy, np.float64), axis=0)))


def write_tum(path: Path, track: Track) -> None:
    """Write a track as TUM lines ``time x y z qx qy qz qw``: times to 1 ns, positions to 1 nm."""
    half = np.asarray(track.poses)[:, 2] / 2.0
    heights = ["0"] * len(half)
    if track.heights_m is not None:
        heights = [f"{z:.9f}" for z in track.heights_m]
    lines = [
        f"{time:.9f} {x:.9f} {y:.9f} {z} 0 0 {qz:.12f} {qw:.12f}\n"
        for time, (x, y, _), z, qz, qw in zip(
            track.times_s, track.poses, heights, np.sin(half), np.cos(half), strict=True
        )
    ]
    write_atomically(Path(path), lambda file: file.write_text("".join(lines), encoding="ascii"))


class TumFile(NamedTuple):
    """Content of a TUM file: times in s ``(n,)``, positions in m, quaternions x, y, z, w."""

    times_s: np.ndarray
    positions: np.ndarray
    quaternions: np.ndarray


def read_tum(path: Path) -> Track:
    """Read TUM lines ``time x y z qx qy qz qw``; roll and pitch are ignored.

    A file whose z are all 0 is a track in the plane.

    Raises:
        SourceError: If the file is missing or a line is invalid; the message has its number.
    """
    t, positions, q = read_tum_file(path)
    (qx, qy, qz, qw), norm = q.T, np.square(q).sum(axis=1)
    yaw = np.arctan2(2.0 * (qw * qz + qx * qy), norm - 2.0 * (qy**2 + qz**2))
    heights = positions[:, 2].copy() if positions[:, 2].any() else None
    return Track(t, np.column_stack([positions[:, :2], yaw]), heights)


def read_tum_file(path: Path, on_bad_line: Callable[[str], object] | None = None) -> TumFile:
    """Read TUM lines ``time x y z qx qy qz qw``.

    Args:
        path: The file.
        on_bad_line: Called with the fault of each invalid line, which is then left out; ``None``:
            the fault is raised. Half of the lines or more are a fault of the file.

    Raises:
        SourceError: If the file is missing or a line is invalid; the message has its number.
    """
    try:
        lines = read_table(Path(path)).splitlines()
    except FileNotFoundError:
        raise SourceError(f"trajectory {path}: no such file") from None
    except (OSError, ValueError) as error:
        raise SourceError(f"trajectory {path}: cannot be read as text ({error})") from None
    rows: list[list[float]] = []
    faults: list[str] = []
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        wrong = _tum_fault(line, rows)
        if wrong:
            faults.append(
                f"line {number}: {wrong}; expected 'time x y z qx qy qz qw', times rising"
            )
            if on_bad_line is None:
                break
    if faults and (on_bad_line is None or len(faults) >= len(rows)):
        raise SourceError(f"trajectory {path}, {faults[0]}")
    if not rows:
        raise SourceError(
            f"trajectory {path}: has no pose; expected lines 'time x y z qx qy qz qw'"
        )
    for fault in faults:
        if on_bad_line is not None:
            on_bad_line(fault)
    table = np.array(rows)
    return TumFile(table[:, 0], table[:, 1:4], table[:, 4:])


def _tum_fault(line: str, rows: list[list[float]]) -> str:
    # Appends the line's numbers to the rows, or returns what is wrong with them.
    words = line.split()
    try:
        row = [float(word) for word in words]
    except ValueError:
        return f"got {line.strip()[:60]!r}, not numbers"
    if len(row) != 8:
        return f"got {len(row)} numbers"
    if not all(map(math.isfinite, row)):
        return "got a number that is not finite"
    if not any(row[4:]):
        return "got a quaternion of length 0"
    if rows and row[0] <= rows[-1][0]:
        return f"time {words[0]} is not above the time before, {rows[-1][0]:.9f}"
    rows.append(row)
    return ""


def _as_points(estimate: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    estimate, truth = np.asarray(estimate, np.float64), np.asarray(truth, np.float64)
    if estimate.shape != truth.shape or estimate.ndim != 2 or estimate.shape[1] not in (2, 3):
        raise MapError(
            f"trajectories: got shapes {estimate.shape} and {truth.shape}, expected two equal "
            "(n, 2) or (n, 3); pair the instants with associate()"
        )
    if not len(estimate):
        raise MapError("trajectories: got no points, expected at least one")
    for name, points in (("estimate", estimate), ("truth", truth)):
        if not np.isfinite(points).all():
            at = int(np.argmin(np.isfinite(points).all(axis=1)))
            raise MapError(f"trajectories: point {at} of the {name} is not finite")
    return estimate, truth


def _nearest(of: np.ndarray, among: np.ndarray) -> np.ndarray:
    after = np.searchsorted(among, of).clip(1, max(1, len(among) - 1))
    after = np.minimum(after, len(among) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(of - among[before] <= among[after] - of, before, after)


def statistics_of(errors: np.ndarray) -> ErrorStatistics:
    """Return the statistics of errors, ``(n,)``."""
    return ErrorStatistics(
        rmse=math.sqrt(float(np.mean(np.square(errors)))),
        mean=float(np.mean(errors)),
        median=float(np.median(errors)),
        max=float(np.max(errors)),
        n=len(errors),
    )
