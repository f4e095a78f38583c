"""Extents of landmarks in the plane: distance from, and share in a box, of walls and regions."""

import numpy as np


def distance_to(corners_m: np.ndarray, closed: bool, point_m: np.ndarray) -> float:
    """Return the distance of a point from a line through corners, or from a polygon.

    Args:
        corners_m: In order, ``(n, 2)``; one corner: a point.
        closed: They are a polygon; inside it the distance is 0.
        point_m: ``(2,)``.

    Example:
        >>> wall = np.array([[0.0, 0.0], [2.0, 0.0]])
        >>> distance_to(wall, False, np.array([1.0, 1.5]))
        1.5
    """
    if closed and is_inside(corners_m, point_m):
        return 0.0
    ends = np.roll(corners_m, -1, axis=0)
    begins = corners_m
    if not closed and len(corners_m) > 1:
        begins, ends = begins[:-1], ends[:-1]
    along = ends - begins
    length = np.maximum((along**2).sum(-1), 1e-12)
    share = (((point_m - begins) * along).sum(-1) / length).clip(0.0, 1.0)
    return float(np.hypot(*(begins + share[:, None] * along - point_m).T).min())


def is_inside(corners_m: np.ndarray, point_m: np.ndarray) -> bool:
    """Return whether a point is in a polygon: a ray from it crosses an odd number of edges.

    Example:
        >>> square = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]])
        >>> is_inside(square, np.array([1.0, 1.0])), is_inside(square, np.array([3.0, 1.0]))
        (True, False)
    """
    (x, y), (px, py) = corners_m.T, point_m
    x2, y2 = np.roll(x, -1), np.roll(y, -1)
    crosses = (y > py) != (y2 > py)
    rise = np.where(crosses, y2 - y, 1.0)
    return bool((crosses & (px < x + (py - y) / rise * (x2 - x))).sum() % 2)


def length_share(corners_m: np.ndarray, low_m: np.ndarray, high_m: np.ndarray) -> float:
    """Return the share of a line through corners, ``(n, 2)``, that is in a box.

    Example:
        >>> wall = np.array([[0.0, 0.5], [4.0, 0.5]])
        >>> length_share(wall, np.zeros(2), np.ones(2))
        0.25
    """
    begins, along = corners_m[:-1], np.diff(corners_m, axis=0)
    length = np.hypot(*along.T)
    if not length.sum() > 0.0:
        return float(((begins[0] >= low_m) & (begins[0] <= high_m)).all())
    first, last = np.zeros(len(along)), np.ones(len(along))
    for axis in range(2):  # the part of each segment between two sides of the box
        moves = along[:, axis] != 0.0
        step = np.where(moves, along[:, axis], 1.0)
        cuts = np.stack([low_m[axis] - begins[:, axis], high_m[axis] - begins[:, axis]]) / step
        within = (begins[:, axis] >= low_m[axis]) & (begins[:, axis] <= high_m[axis])
        first = np.where(moves, np.maximum(first, cuts.min(0)), np.where(within, first, 1.0))
        last = np.where(moves, np.minimum(last, cuts.max(0)), np.where(within, last, 0.0))
    return float((np.maximum(last - first, 0.0) * length).sum() / length.sum())


def area_share(corners_m: np.ndarray, low_m: np.ndarray, high_m: np.ndarray) -> float:
    """Return the share of a polygon's area, corners ``(n, 2)``, that is in a box.

    The polygon is cut at each side of the box in turn (Sutherland and Hodgman, Commun. ACM 17,
    1974).

    Example:
        >>> square = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]])
        >>> area_share(square, np.zeros(2), np.ones(2))
        0.25
    """
    whole = _area(corners_m)
    if not whole > 0.0:
        return length_share(np.vstack([corners_m, corners_m[:1]]), low_m, high_m)
    cut = corners_m
    for axis in range(2):
        for side, sign in ((low_m[axis], 1.0), (high_m[axis], -1.0)):
            cut = _cut(cut, axis, float(side), sign)
    return _area(cut) / whole


def _cut(corners: np.ndarray, axis: int, side: float, sign: float) -> np.ndarray:
    kept: list[np.ndarray] = []
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        inside = sign * (a[axis] - side) >= 0.0, sign * (b[axis] - side) >= 0.0
        if inside[0]:
            kept.append(a)
        if inside[0] != inside[1]:
            kept.append(a + (side - a[axis]) / (b[axis] - a[axis]) * (b - a))
    return np.array(kept).reshape(-1, 2)


def _area(corners: np.ndarray) -> float:
    x, y = corners.T
    return 0.5 * abs(float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum()))
