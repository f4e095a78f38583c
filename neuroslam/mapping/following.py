"""Position of a robot that follows the links of the map: as far along them as it drove."""

import math

import numpy as np

_MOST_LINKS = 50
"""Links that a robot may pass unseen; beyond them it stays at the last one."""


def along_links(
    experience: int,
    dx_m: float,
    dy_m: float,
    poses: np.ndarray,
    source: np.ndarray,
    target: np.ndarray,
) -> tuple[float, float, int]:
    """Return how far along the links a robot is that drove on from an experience.

    While the views show that the robot is on a path of the map, odometry says how far along that
    path it is; its small errors of heading would put it beside the path. Of several links ahead
    the one whose direction is nearest to that driven is taken, at each next experience the
    straightest. At the end of the links the robot drives on in their direction.

    Args:
        experience: Where it began.
        dx_m: Displacement since then by odometry, along x of the map, metres.
        dy_m: Along y.
        poses: Poses of all experiences, ``(n, 3)``.
        source: Experience at which each link begins, ``(links,)``.
        target: Experience at which it ends, ``(links,)``.

    Returns:
        Displacement along x and y, metres, and the last experience that was passed.

    Example:
        >>> corner = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0]])
        >>> ends = np.array([0, 1]), np.array([1, 2])
        >>> x, y, passed = along_links(0, 1.5, 0.1, corner, *ends)  # round the corner
        >>> round(x, 3), round(y, 3), passed
        (1.0, 0.503, 1)
    """
    left_m = math.hypot(dx_m, dy_m)
    if not left_m:
        return 0.0, 0.0, experience
    x_0, y_0 = poses[experience, :2].tolist()
    x, y, here = x_0, y_0, experience
    along_x, along_y = dx_m / left_m, dy_m / left_m
    for _ in range(_MOST_LINKS):
        ahead = target[source == here]
        if not len(ahead):
            return x - x_0 + along_x * left_m, y - y_0 + along_y * left_m, here
        to_x, to_y = poses[ahead, 0] - x, poses[ahead, 1] - y
        length = np.maximum(np.hypot(to_x, to_y), 1e-12)
        best = int(((to_x * along_x + to_y * along_y) / length).argmax())
        link_m = float(length[best])
        along_x, along_y = float(to_x[best]) / link_m, float(to_y[best]) / link_m
        if link_m >= left_m:
            return x - x_0 + along_x * left_m, y - y_0 + along_y * left_m, here
        left_m -= link_m
        here = int(ahead[best])
        x, y = poses[here, :2].tolist()
    return x - x_0, y - y_0, here
