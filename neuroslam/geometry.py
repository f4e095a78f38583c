"""Angles and rigid motions in the plane, SE(2); all rotations are counter-clockwise.

The sine and cosine of one angle are :mod:`math`'s, those of an array numpy's; the two may differ in
the last bit.
"""

import math
from typing import TypeVar

import numpy as np

from neuroslam.types import Pose

Coordinate = TypeVar("Coordinate", float, np.ndarray)
"""A number, or an array of numbers."""

TWO_PI = 2.0 * math.pi
ORIGIN = Pose(0.0, 0.0, 0.0)


def wrap_angle(angle_rad: float) -> float:
    """Bring an angle into [-pi, pi).

    Example:
        >>> round(wrap_angle(3 * math.pi / 2), 6) == round(-math.pi / 2, 6)
        True
    """
    return (angle_rad + math.pi) % TWO_PI - math.pi


def wrap_angles(angles_rad: np.ndarray) -> np.ndarray:
    """Bring an array of angles into [-pi, pi); the shape stays.

    Example:
        >>> wrap_angles(np.array([0.0, 2 * math.pi])).tolist()
        [0.0, 0.0]
    """
    return (angles_rad + math.pi) % TWO_PI - math.pi


def rotate(x: Coordinate, y: Coordinate, by_rad: float) -> tuple[Coordinate, Coordinate]:
    """Rotate a vector, or vectors given as two arrays of coordinates, by one angle.

    Example:
        >>> [round(value, 9) for value in rotate(1.0, 0.0, math.pi / 2)]
        [0.0, 1.0]
    """
    c, s = math.cos(by_rad), math.sin(by_rad)
    return c * x - s * y, s * x + c * y


def rotate_points(points: np.ndarray, by_rad: float | np.ndarray) -> np.ndarray:
    """Rotate points about the origin.

    Args:
        points: ``(..., 2)``.
        by_rad: One angle for all points, or an array of the shape of ``points[..., 0]``.

    Returns:
        Rotated points, ``(..., 2)``.

    Example:
        >>> rotate_points(np.array([[1.0, 0.0], [0.0, 2.0]]), math.pi / 2).round(9).tolist()
        [[0.0, 1.0], [-2.0, 0.0]]
        >>> rotate_points(np.ones((2, 2)), np.array([0.0, math.pi])).round(9).tolist()
        [[1.0, 1.0], [-1.0, -1.0]]
    """
    x, y = points[..., 0], points[..., 1]
    if isinstance(by_rad, np.ndarray):
        c, s = np.cos(by_rad), np.sin(by_rad)
        return np.stack([c * x - s * y, s * x + c * y], axis=-1)
    return np.stack(rotate(x, y, by_rad), axis=-1)


def rotation_matrix(by_rad: float) -> np.ndarray:
    r"""Return :math:`R(\theta)`, ``(2, 2)``, which rotates a column vector: :math:`x' = R x`.

    Example:
        >>> (rotation_matrix(math.pi / 2) @ [1.0, 0.0]).round(9).tolist()
        [0.0, 1.0]
    """
    c, s = math.cos(by_rad), math.sin(by_rad)
    return np.array([[c, -s], [s, c]])


def compose(first: Pose, second: Pose) -> Pose:
    r"""Express ``second``, given in the frame of ``first``, in the world: :math:`p_1 \oplus p_2`.

    Example:
        >>> compose(Pose(1.0, 0.0, math.pi / 2), Pose(2.0, 0.0, 0.0)).y_m
        2.0
    """
    c, s = math.cos(first.theta_rad), math.sin(first.theta_rad)
    return Pose(
        first.x_m + c * second.x_m - s * second.y_m,
        first.y_m + s * second.x_m + c * second.y_m,
        wrap_angle(first.theta_rad + second.theta_rad),
    )


def relative(first: Pose, second: Pose) -> Pose:
    r"""Express the world pose ``second`` in the frame of ``first``: :math:`\ominus p_1 \oplus p_2`.

    Example:
        >>> relative(Pose(1.0, 1.0, 0.0), Pose(3.0, 2.0, 0.5))
        Pose(x_m=2.0, y_m=1.0, theta_rad=0.5)
    """
    c, s = math.cos(first.theta_rad), math.sin(first.theta_rad)
    dx, dy = second.x_m - first.x_m, second.y_m - first.y_m
    return Pose(c * dx + s * dy, -s * dx + c * dy, wrap_angle(second.theta_rad - first.theta_rad))


def compose_poses(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Apply :func:`compose` row by row.

    Args:
        first: x, y in metres and heading in radians, ``(..., 3)``.
        second: Poses in the frame of ``first``, of a shape that broadcasts with it.

    Returns:
        Poses in the world, ``(..., 3)``; headings in [-pi, pi).

    Example:
        >>> compose_poses(np.array([1.0, 0.0, math.pi / 2]), np.array([[2.0, 0.0, 0.0]]))[0, 1]
        np.float64(2.0)
    """
    c, s = np.cos(first[..., 2]), np.sin(first[..., 2])
    x, y = second[..., 0], second[..., 1]
    return np.stack(
        [
            first[..., 0] + c * x - s * y,
            first[..., 1] + s * x + c * y,
            wrap_angles(first[..., 2] + second[..., 2]),
        ],
        axis=-1,
    )


def relative_poses(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Apply :func:`relative` row by row.

    Args:
        first: x, y in metres and heading in radians, ``(..., 3)``.
        second: Poses in the same frame, of a shape that broadcasts with it.

    Returns:
        ``second`` in the frame of ``first``, ``(..., 3)``; headings in [-pi, pi).

    Example:
        >>> relative_poses(np.array([1.0, 1.0, 0.0]), np.array([[3.0, 2.0, 0.5]])).tolist()
        [[2.0, 1.0, 0.5]]
    """
    c, s = np.cos(first[..., 2]), np.sin(first[..., 2])
    moved = second - first
    dx, dy = moved[..., 0], moved[..., 1]
    return np.stack([c * dx + s * dy, c * dy - s * dx, wrap_angles(moved[..., 2])], axis=-1)


def move_points(points_m: np.ndarray, start: Pose, end: Pose) -> np.ndarray:
    r"""Move points by the rigid motion that takes one pose to another.

    .. math:: x' = R(\theta_1 - \theta_0)\,(x - x_0) + x_1

    Args:
        points_m: ``(..., 2)``.
        start: Pose :math:`(x_0, \theta_0)` before the motion.
        end: Pose :math:`(x_1, \theta_1)` after it.

    Returns:
        Moved points, ``(..., 2)``.

    Example:
        >>> move_points(np.array([[2.0, 0.0]]), Pose(1.0, 0.0, 0.0), Pose(5.0, 5.0, math.pi / 2))
        array([[5., 6.]])
    """
    turn_rad = end.theta_rad - start.theta_rad
    return np.asarray(rotate_points(points_m - np.array(start[:2]), turn_rad) + np.array(end[:2]))


def integrate_velocities(
    v_m_s: np.ndarray, w_rad_s: np.ndarray, dt_s: np.ndarray, start: Pose = ORIGIN
) -> np.ndarray:
    """Dead-reckon a track: turn first, then move along the new heading, as the experience map does.

    Args:
        v_m_s: Forward speeds, shape ``(n,)``.
        w_rad_s: Turn rates, shape ``(n,)``.
        dt_s: Durations, shape ``(n,)``.
        start: Pose before the first step.

    Returns:
        Poses after each step, shape ``(n, 3)``: x, y in metres, heading in radians, unwrapped.

    Example:
        >>> integrate_velocities(np.ones(2), np.zeros(2), np.ones(2))[:, 0].tolist()
        [1.0, 2.0]
    """
    theta = start.theta_rad + np.cumsum(w_rad_s * dt_s)
    x = start.x_m + np.cumsum(v_m_s * dt_s * np.cos(theta))
    y = start.y_m + np.cumsum(v_m_s * dt_s * np.sin(theta))
    return np.column_stack([x, y, theta])
