r"""Errors of a trajectory against true relative poses of pairs of instants.

.. math:: \varepsilon = \frac1N \sum_{ij} \big\lVert \mathrm{trans}(\delta_{ij} \ominus
          \delta^*_{ij}) \big\rVert, \qquad
          \varepsilon_\theta = \frac1N \sum_{ij} \big\lvert \mathrm{rot}(\delta_{ij} \ominus
          \delta^*_{ij}) \big\rvert

R. Kuemmerle et al., "On measuring the accuracy of SLAM algorithms", Autonomous Robots 27, 2009. No
alignment is needed, and one error in a heading does not spoil all that follows.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from neuroslam.errors import RunError, counted
from neuroslam.geometry import relative_poses, wrap_angles
from neuroslam.limits import read_bounded

FAR_S = 100.0
"""Relations whose ends are farther apart in time say whether loops are closed."""

_COLUMNS = 8  # t1 t2 x y z roll pitch yaw


class Relations(NamedTuple):
    """True relative poses.

    Attributes:
        times_s: The two instants of each, ``(n, 2)``.
        poses: Pose of the robot at the second in the frame of the first, m and rad, ``(n, 3)``.
    """

    times_s: np.ndarray
    poses: np.ndarray


class RelationErrors(NamedTuple):
    """Errors of each relation.

    Attributes:
        translation_m: Of the position, ``(n,)``.
        rotation_rad: Of the heading, absolute, ``(n,)``.
        apart_s: Time between the two instants, ``(n,)``.
    """

    translation_m: np.ndarray
    rotation_rad: np.ndarray
    apart_s: np.ndarray

    @property
    def far(self) -> np.ndarray:
        """Which relations span more than :data:`FAR_S`."""
        return self.apart_s > FAR_S


def read_relations(path: str | Path) -> Relations:
    """Read relations, ``t1 t2 x y z roll pitch yaw`` a line, in s, m and rad.

    Raises:
        RunError: If the file cannot be read, or a line is no relation.
    """
    try:
        text = read_bounded(Path(path)).decode()
    except (OSError, ValueError) as error:
        raise RunError(
            f"{path}: cannot be read ({getattr(error, 'strerror', None) or error})"
        ) from None
    rows = []
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        try:
            row = [float(word) for word in words]
        except ValueError:
            row = []
        if len(row) != _COLUMNS or not np.isfinite(row).all():
            raise RunError(
                f"{path}: line {number} is {line[:40]!r}; expected t1 t2 x y z roll pitch yaw"
            )
        rows.append(row)
    if not rows:
        raise RunError(f"{path}: has no relations; expected lines of t1 t2 x y z roll pitch yaw")
    table = np.array(rows)
    return Relations(table[:, :2], table[:, [2, 3, 7]])


def relation_errors(
    times_s: np.ndarray, poses: np.ndarray, relations: Relations, tolerance_s: float = 0.5
) -> RelationErrors:
    """Compare a trajectory with true relations.

    Args:
        times_s: Times of the poses, rising, ``(n,)``.
        poses: x, y and heading, m and rad, ``(n, 3)``.
        relations: The truth.
        tolerance_s: Largest distance in time of the pose that is used from an instant; relations
            without such poses are left out.

    Raises:
        RunError: If no relation has poses.

    Example:
        >>> track = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.1]])
        >>> truth = Relations(np.array([[0.0, 1.0]]), np.array([[1.2, 0.0, 0.1]]))
        >>> relation_errors(np.array([0.0, 1.0]), track, truth).translation_m.round(3).tolist()
        [0.2]
    """
    after = np.searchsorted(times_s, relations.times_s).clip(1, len(times_s) - 1)
    earlier = relations.times_s - times_s[after - 1] < times_s[after] - relations.times_s
    rows = after - earlier
    near = np.abs(times_s[rows] - relations.times_s) <= tolerance_s
    known = near[:, 0] & near[:, 1]
    if not known.any():
        raise RunError(
            f"none of {counted(len(known), 'relation')} has poses within {tolerance_s} s of its "
            "instants; do the track and the relations have one clock?"
        )
    rows = rows[known]
    found = relative_poses(poses[rows[:, 0]], poses[rows[:, 1]])
    error = relative_poses(relations.poses[known], found)
    return RelationErrors(
        np.hypot(error[:, 0], error[:, 1]),
        np.abs(wrap_angles(error[:, 2])),
        np.ptp(relations.times_s[known], axis=1),
    )
