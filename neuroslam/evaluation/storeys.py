"""Measures of maps of several storeys: errors in x, y and z, and storeys that were confused."""

import numpy as np

from neuroslam.evaluation.trajectory import align


def error_in_3d(estimate: np.ndarray, truth: np.ndarray) -> np.ndarray:
    r"""Return the distance of every point from the truth, aligned in four degrees of freedom.

    Gravity is known, so the alignment turns about the vertical and moves along x, y and z:

    .. math:: \min_{\psi, t} \sum_i \lVert y_i - (R_z(\psi)\, x_i + t) \rVert^2

    Args:
        estimate: Points in metres, ``(n, 3)``.
        truth: Points at the same instants, same shape.

    Returns:
        Metres, ``(n,)``; their root mean square is the ATE.

    Raises:
        MapError: If shapes differ, or the points do not fix a rotation.

    Example:
        >>> ramp = np.array([[0.0, 0.0, 0.0], [4.0, 0.0, 1.0], [4.0, 3.0, 2.0]])
        >>> turned = ramp[:, [1, 0, 2]] * (1.0, -1.0, 1.0) + (5.0, 6.0, 7.0)
        >>> error_in_3d(turned, ramp).round(9).tolist()
        [0.0, 0.0, 0.0]
    """
    flat = align(estimate[:, :2], truth[:, :2])
    apart = estimate[:, :2] @ flat.rotation.T + flat.translation - truth[:, :2]
    up = (estimate[:, 2] - estimate[:, 2].mean()) - (truth[:, 2] - truth[:, 2].mean())
    return np.asarray(np.sqrt((apart * apart).sum(1) + up * up))


def on_another_storey(
    experience: np.ndarray, first_frame: np.ndarray, height_m: np.ndarray, storey_m: float
) -> np.ndarray:
    """Return at which frames a robot is believed at an experience of another storey.

    Args:
        experience: That the robot is believed at, for every frame, ``(n,)``.
        first_frame: Frame that made each experience, ``(experiences,)``.
        height_m: True height at every frame, ``(n,)``.
        storey_m: From floor to floor; half of it is another storey.

    Example:
        >>> at, made = np.array([0, 1, 0]), np.array([0, 1])
        >>> on_another_storey(at, made, np.array([0.0, 3.0, 3.0]), 3.0).tolist()
        [False, False, True]
    """
    return np.asarray(np.abs(height_m[first_frame[experience]] - height_m) > storey_m / 2)
