"""Decision of the experience map: a new experience, a known one, or none."""

import math

import numpy as np

from neuroslam.state.population import Action
from neuroslam.types import NO_EXPERIENCE, PoseEstimate


def choose_action(
    cells: PoseEstimate,
    relative_heading_cells: float,
    bound: np.ndarray,
    ids: np.ndarray,
    current: int,
    threshold_cells: float,
    torus: tuple[int, int, int],
) -> tuple[Action, int]:
    """Decide whether a view at a pose is a new experience, a known one, or the current one.

    Args:
        cells: Pose-cell estimate now.
        relative_heading_cells: Heading now minus that at which the view was learnt, in cells.
        bound: Pose-cell estimates at which experiences with this view were made, ``(m, 3)``.
        ids: Their ids, ``(m,)``.
        current: Id of the current experience.
        threshold_cells: Distance on the torus beyond which the view makes a new experience.
        torus: ``(n_x, n_y, n_theta)``.

    Returns:
        ``("create", -1)``, ``("link", id)`` or ``("none", current)``.

    Example:
        >>> near = np.array([[5.0, 5.0, 0.5]])
        >>> choose_action(PoseEstimate(5, 6, 35.5), 0.0, near, np.array([3]), 7, 2.0, (21, 21, 36))
        ('link', 3)
    """
    if len(ids) == 0:
        return "create", NO_EXPERIENCE
    n = np.asarray(torus, dtype=np.float64)
    now = np.array([cells.x, cells.y, cells.theta - relative_heading_cells])
    away = np.abs(bound - now) % n
    away = np.minimum(away, n - away)
    squares = (away * away).sum(axis=1)
    nearest = int(squares.argmin())
    if math.sqrt(squares[nearest]) > threshold_cells:
        return "create", NO_EXPERIENCE
    found = int(ids[nearest])
    return ("none", current) if found == current else ("link", found)
