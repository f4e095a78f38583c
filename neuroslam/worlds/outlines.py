"""Geometry of outlines in the plane: checks, containment, distances and crossings.

An outline is ``(n, 2)`` vertices in metres, the first not repeated, or the three numbers
``(x, y, radius)`` of a circle.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from neuroslam.errors import SourceError
from neuroslam.geometry import TWO_PI

_FLAT_M = 1e-300  # rise of a side whose slope is finite
MOST_VERTICES = 4000
"""Of an outline; all pairs of its sides are compared."""

TOUCH_M = 1e-9
"""A position nearer to a wall than this is at the wall, on its free side."""


def bearings_of(directions: np.ndarray) -> np.ndarray:
    """Return the angles of vectors ``(n, 2)``, in (-pi, pi]."""
    angle = np.arctan2(directions[:, 1], directions[:, 0])
    return np.asarray(np.where(angle <= -math.pi, math.pi, angle) + 0.0)  # no negative zeros


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the cross products of vectors in the plane, ``(..., 2)``."""
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def vertices_of(outline: np.ndarray) -> np.ndarray:
    """Return the vertices of an outline, ``(n, 2)``; a circle has 180."""
    if outline.ndim == 2:
        return outline
    angle = TWO_PI * np.arange(180) / 180
    return np.asarray(outline[:2] + outline[2] * np.column_stack([np.cos(angle), np.sin(angle)]))


def checked_outline(values: ArrayLike, name: str) -> np.ndarray:
    """Check an outline, and return it with the vertices counter-clockwise.

    Raises:
        SourceError: If it has too few vertices, sides of length 0, or crosses itself.
    """
    try:
        outline = np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise SourceError(f"{name} is not of numbers; expected metres") from None
    if len(np.atleast_1d(outline)) > MOST_VERTICES:
        raise SourceError(
            f"{name} has {len(outline):,} vertices; expected at most {MOST_VERTICES:,}"
        )
    if outline.shape != (3,) and (outline.ndim != 2 or outline.shape[1] != 2 or len(outline) < 3):
        raise SourceError(
            f"{name} has shape {outline.shape}; expected (n, 2) vertices, at least 3, or the "
            "centre and radius of a circle (3,)"
        )
    if not np.isfinite(outline).all():
        raise SourceError(f"{name} has numbers that are not finite; expected metres")
    if outline.ndim == 1:
        if outline[2] <= 0:
            raise SourceError(f"{name} has the radius {outline[2]} m; expected more than 0")
        return outline
    n, side = len(outline), np.roll(outline, -1, 0) - outline
    short = np.flatnonzero(np.hypot(*side.T) <= TOUCH_M)
    if len(short):
        raise SourceError(
            f"{name}: side {short[0]} has length 0; expected distinct vertices, the first just once"
        )
    ends = np.roll(outline, -1, 0)
    over = crossings(outline, ends, outline, ends)
    touch = to_segments(outline, outline, ends) <= TOUCH_M
    at = np.arange(n)
    touch[at, at] = touch[at, at - 1] = False  # a vertex is on its own two sides
    i, j = np.nonzero(over | touch)
    if len(i):
        raise SourceError(
            f"{name} crosses itself at sides {i[0]} and {j[0]}; expected a simple polygon"
        )
    return outline if cross(outline, ends).sum() > 0 else outline[::-1].copy()


def checked_walls(walls: Sequence[ArrayLike], name: str) -> np.ndarray:
    """Check free-standing walls, and return them as ``(n, 2, 2)``.

    Raises:
        SourceError: If a wall is not two distinct points.
    """
    found = np.empty((len(walls), 2, 2))
    for k, wall in enumerate(walls):
        ends = np.asarray(wall, dtype=np.float64)
        if ends.shape != (2, 2) or not np.isfinite(ends).all():
            raise SourceError(
                f"{name}: wall {k} has shape {ends.shape} or numbers that are not finite; expected "
                "two ends (2, 2) in metres"
            )
        if math.dist(*ends.tolist()) <= TOUCH_M:
            raise SourceError(f"{name}: wall {k} has length 0; expected two distinct ends")
        found[k] = ends
    return found


def within(points: np.ndarray, outline: np.ndarray) -> np.ndarray:
    """Return which points ``(n, 2)`` are inside an outline: where a ray crosses it oddly often."""
    if outline.ndim == 1:
        return np.asarray(np.hypot(*(points - outline[:2]).T) < outline[2])
    (x0, y0), (x1, y1) = outline.T, np.roll(outline, -1, 0).T
    x, y = points[:, :1], points[:, 1:]
    rise = y1 - y0
    slope = (x1 - x0) / np.where(np.abs(rise) > _FLAT_M, rise, 1.0)
    crossed = ((y0 > y) != (y1 > y)) & (x < x0 + (y - y0) * slope)
    return np.asarray(np.logical_xor.reduce(crossed, axis=1))


def to_segments(points: np.ndarray, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Return the distances of points ``(n, 2)`` to segments ``(m, 2)``, ``(n, m)``."""
    span, gap = ends - starts, points[:, None] - starts
    squared = np.sum(span**2, axis=1)
    along = np.sum(gap * span, axis=2) / np.where(squared > 0, squared, 1.0)
    off = gap - np.clip(along, 0.0, 1.0)[..., None] * span
    return np.asarray(np.hypot(off[..., 0], off[..., 1]))


def crossings(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Return which segments ``ab`` ``(n, 2)`` cross which ``cd`` ``(m, 2)``, ``(n, m)``."""
    a, b = a[:, None], b[:, None]

    def sides(start: np.ndarray, end: np.ndarray, points: np.ndarray) -> np.ndarray:
        span = end - start
        off = cross(span, points - start) / np.hypot(span[..., 0], span[..., 1])
        return np.where(np.abs(off) <= TOUCH_M, 0.0, np.sign(off))

    across = sides(a, b, c) * sides(a, b, d) < 0
    return np.asarray(across & (sides(c, d, a) * sides(c, d, b) < 0))


def meet(a: np.ndarray, b: np.ndarray) -> bool:
    """Return whether two outlines touch or cross."""
    if a.ndim == b.ndim == 1:
        apart = math.dist(a[:2], b[:2])
        return bool(abs(a[2] - b[2]) - TOUCH_M <= apart <= a[2] + b[2] + TOUCH_M)
    if a.ndim == 1:
        a, b = b, a
    ends = np.roll(a, -1, 0)
    if b.ndim == 1:
        nearest = to_segments(b[None, :2], a, ends).min()
        farthest = np.hypot(*(a - b[:2]).T).max()
        return bool(nearest <= b[2] + TOUCH_M and farthest >= b[2] - TOUCH_M)
    b_ends = np.roll(b, -1, 0)
    near = min(to_segments(a, b, b_ends).min(), to_segments(b, a, ends).min())
    return bool(near <= TOUCH_M or crossings(a, ends, b, b_ends).any())
