"""Angles and rigid motions in the plane."""

import math

import numpy as np

from neuroslam.types import Pose

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
    """Bring an array of angles into [-pi, pi); same shape.

    Example:
        >>> wrap_angles(np.array([0.0, 2 * math.pi])).tolist()
        [0.0, 0.0]
    """
    return (angles_rad + math.pi) % TWO_PI - math.pi


def rotate(x: float, y: float, by_rad: float) -> tuple[float, float]:
    """Turn a vector counter-clockwise.

    Example:
        >>> [round(value, 9) for value in rotate(1.0, 0.0, math.pi / 2)]
        [0.0, 1.0]
    """
    c, s = math.cos(by_rad), math.sin(by_rad)
    return c * x - s * y, s * x + c * y


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
