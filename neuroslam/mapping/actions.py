"""Decision of the experience map: a new experience, a known one, or none."""

import math

import numpy as np

from neuroslam import compiled as switch
from neuroslam.compiled import compiled
from neuroslam.state.population import Action
from neuroslam.types import NO_EXPERIENCE, PoseEstimate


def choose_action(
    cells: PoseEstimate,
    relative_heading_cells: float,
    bound: np.ndarray,
    templates: np.ndarray,
    template: int,
    current: int,
    threshold_cells: float,
    torus: tuple[int, int, int],
) -> tuple[Action, int]:
    """Decide whether a view at a pose is a new experience, a known one, or the current one.

    Args:
        cells: Pose-cell estimate now.
        relative_heading_cells: Heading now minus that at which the view was learnt, in cells.
        bound: Pose-cell estimates at which the experiences were made, ``(n, 3)``.
        templates: Their views, ``(n,)``.
        template: The view now.
        current: Id of the current experience.
        threshold_cells: Distance on the torus beyond which the view makes a new experience.
        torus: ``(n_x, n_y, n_theta)``.

    Returns:
        ``("create", -1)``, ``("link", id)`` or ``("none", current)``.

    Example:
        >>> near, views = np.array([[5.0, 5.0, 0.5]]), np.array([3])
        >>> choose_action(PoseEstimate(5, 6, 35.5), 0.0, near, views, 3, 7, 2.0, (21, 21, 36))
        ('link', 0)
    """
    now = (float(cells.x), float(cells.y), float(cells.theta - relative_heading_cells))
    find = nearest_bound if switch.ENABLED else nearest_bound_of_arrays
    nearest, square = find(bound, templates, template, now, torus)
    if nearest == NO_EXPERIENCE or math.sqrt(square) > threshold_cells:
        return "create", NO_EXPERIENCE
    return ("none", current) if nearest == current else ("link", nearest)


def nearest_bound_of_arrays(
    bound: np.ndarray,
    templates: np.ndarray,
    template: int,
    now: tuple[float, float, float],
    torus: tuple[int, int, int],
) -> tuple[int, float]:
    r"""Find the experience with a view whose pose in cells is nearest on the torus.

    .. math:: \min_i \sum_a \min(|b_{ia} - c_a|_{n_a},\, n_a - |b_{ia} - c_a|_{n_a})^2

    Args:
        bound: As of :func:`choose_action`; so are ``templates``, ``template`` and ``torus``.
        templates: See there.
        template: See there.
        now: Pose in cells, x, y, theta.
        torus: See there.

    Returns:
        Its id, the first of equals, and the square of the distance; -1 and infinity if none has
        this view.

    Example:
        >>> bound = np.array([[5.0, 5.0, 35.5], [5.0, 5.0, 2.0]])
        >>> nearest_bound_of_arrays(bound, np.array([4, 4]), 4, (5, 5, 0.5), (21, 21, 36))
        (0, 1.0)
    """
    ids = np.flatnonzero(templates == template)
    if len(ids) == 0:
        return NO_EXPERIENCE, math.inf
    n = np.asarray(torus, dtype=np.float64)
    away = np.abs(bound[ids] - now) % n
    away = np.minimum(away, n - away)
    squares = (away * away).sum(axis=1)
    nearest = int(squares.argmin())
    return int(ids[nearest]), float(squares[nearest])


@compiled
def nearest_bound(
    bound: np.ndarray,
    templates: np.ndarray,
    template: int,
    now: tuple[float, float, float],
    torus: tuple[int, int, int],
) -> tuple[int, float]:
    """Do the same, in one pass over the experiences."""
    nearest, least = NO_EXPERIENCE, np.inf
    for i in range(templates.size):
        if templates[i] == template:
            square = 0.0
            for axis in range(3):
                away = abs(bound[i, axis] - now[axis]) % torus[axis]
                away = min(away, torus[axis] - away)
                square += away * away
            if square < least:
                nearest, least = i, square
    return nearest, least
