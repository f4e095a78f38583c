"""Frames of landmark positions: those of experiences, and the alignment of two sessions."""

import math
from collections.abc import Callable
from itertools import combinations

import numpy as np

from neuroslam.geometry import rotate_points, rotation_matrix
from neuroslam.spiking.sightings import LEAST_SEEN, NAMED
from neuroslam.state.mergeable import State
from neuroslam.types import Pose


def into_frame(pose: np.ndarray, point_m: np.ndarray) -> np.ndarray:
    """Express a point, ``(2,)``, in the frame of a pose, ``(3,)``.

    Example:
        >>> into_frame(np.array([1.0, 0.0, np.pi / 2]), np.array([1.0, 2.0])).round(6).tolist()
        [2.0, 0.0]
    """
    return rotate_points(point_m - pose[:2], -pose[2])


def from_frame(poses: np.ndarray, points_m: np.ndarray) -> np.ndarray:
    """Invert :func:`into_frame` for ``(n, 3)`` poses and ``(n, 2)`` points."""
    return poses[:, :2] + rotate_points(points_m, poses[:, 2])


def shared_frames(
    loaded: State, partial: State, confirm: int = 2, same_m: float = 1.0
) -> tuple[Pose, Pose] | None:
    """Align two semantic maps by the named landmarks that both know.

    The alignment is that of the largest group which one rotation and one shift bring together
    within ``same_m``.

    Returns:
        A pose in the partial map's frame, and the same in the loaded one's; ``None`` if fewer
        than ``confirm`` landmarks agree, or not more than half.
    """
    tables = [
        {
            (kind, number): place
            for kind, number, seen, place in zip(
                *(state[f"known.{c}"].tolist() for c in ("kind", "number", "seen", "place_m")),
                strict=True,
            )
            if kind == NAMED and seen >= LEAST_SEEN
        }
        for state in (loaded, partial)
    ]
    both = sorted(tables[0].keys() & tables[1].keys())
    if len(both) < max(confirm, 2):
        return None
    onto, start = (np.array([table[key] for key in both]) for table in tables)
    best = None
    for i, j in combinations(range(len(both)), 2):
        if np.linalg.norm(start[i] - start[j]) < same_m:
            continue
        fit = _alignment(start[[i, j]], onto[[i, j]])
        near = np.linalg.norm(fit(start) - onto, axis=1) <= same_m
        if best is None or near.sum() > best.sum():
            best = near
    if best is None or best.sum() < confirm or 2 * best.sum() <= len(both):
        return None
    turn = _turn_between(start[best], onto[best])
    (x, y), (onto_x, onto_y) = start[best].mean(0).tolist(), onto[best].mean(0).tolist()
    return Pose(x, y, 0.0), Pose(onto_x, onto_y, turn)


def _turn_between(start_m: np.ndarray, onto_m: np.ndarray) -> float:
    """Return the rotation that fits one set of points to another best, least squares."""
    a, b = start_m - start_m.mean(0), onto_m - onto_m.mean(0)
    across = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return math.atan2(across.sum(), (a * b).sum())


def _alignment(start_m: np.ndarray, onto_m: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    turn = _turn_between(start_m, onto_m)
    rotation = rotation_matrix(turn)
    return lambda points: (points - start_m.mean(0)) @ rotation.T + onto_m.mean(0)
