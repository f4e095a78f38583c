r"""RatSLAM's relaxation of the map, link by link.

One loop visits the links in the order of their source, then of their number, and each visit moves
both ends by a share of the link's error, in opposite directions (multisession RatSLAM, Eq. 8, which
moves all at once and has the wrong sign for links that end at an experience):

.. math:: \theta_s \leftarrow \theta_s + \alpha\, e,\quad \theta_t \leftarrow \theta_t - \alpha\, e,
          \qquad e = \operatorname{wrap}(\theta_t - \theta_s - f)

and likewise for x and y, where the error is :math:`p_t - p_s - d\,(\cos, \sin)(\theta_s + h)`.
"""

import math

import numpy as np

from neuroslam import compiled as switch
from neuroslam.compiled import compiled
from neuroslam.geometry import TWO_PI, wrap_angle, wrap_angles


def relax_sequentially(
    poses: np.ndarray,
    source: np.ndarray,
    target: np.ndarray,
    distance_m: np.ndarray,
    heading_rad: np.ndarray,
    facing_rad: np.ndarray,
    correction: float,
) -> np.ndarray:
    """Relax once: the definition, slow; :class:`Relaxation` gives the same.

    Args as of :class:`Relaxation` and :meth:`Relaxation.run`. Return the poses.

    Example:
        >>> poses = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
        >>> link = [np.array([v]) for v in (0, 1, 1.0, 0.0, 0.0)]
        >>> relax_sequentially(poses, *link, correction=0.5)[:, 0].tolist()
        [0.5, 1.5]
    """
    x, y, theta = np.array(poses, dtype=np.float64).T.tolist()
    columns = (source, target, distance_m, heading_rad, facing_rad)
    order = np.argsort(source, kind="stable")
    for s, t, distance, heading, facing in zip(*(c[order].tolist() for c in columns), strict=True):
        bearing = theta[s] + heading
        error_x = correction * (x[t] - x[s] - distance * math.cos(bearing))
        error_y = correction * (y[t] - y[s] - distance * math.sin(bearing))
        x[s], x[t], y[s], y[t] = x[s] + error_x, x[t] - error_x, y[s] + error_y, y[t] - error_y
        if not math.isnan(facing):
            turn = correction * wrap_angle(theta[t] - theta[s] - facing)
            theta[s], theta[t] = theta[s] + turn, theta[t] - turn
    return np.column_stack([x, y, wrap_angles(np.array(theta))])


@compiled
def relax(
    poses: np.ndarray,
    source: np.ndarray,
    target: np.ndarray,
    distance_m: np.ndarray,
    heading_rad: np.ndarray,
    facing_rad: np.ndarray,
    loops: int,
    correction: float,
    tolerance: float,
) -> float:
    """Relax in place, links in the order of visits; return the largest movement of the last loop.

    Headings do not depend on positions, so that each loop turns all poses first. Arguments of
    :class:`Relaxation` and :meth:`Relaxation.run`.
    """
    n, n_links, moved = poses.shape[0], source.size, 0.0
    bearing, along_x, along_y = np.empty(n_links), np.empty(n_links), np.empty(n_links)
    x, y, theta, before = np.empty(n), np.empty(n), np.empty(n), np.empty((3, n))
    for i in range(n):
        x[i], y[i], theta[i] = poses[i, 0], poses[i, 1], poses[i, 2]
    for loop in range(loops):
        for i in range(n):
            before[0, i], before[1, i], before[2, i] = x[i], y[i], theta[i]
        for k in range(n_links):
            s, t, facing = source[k], target[k], facing_rad[k]
            bearing[k] = theta[s] + heading_rad[k]
            if facing == facing:  # known
                turn = theta[t] - theta[s] - facing
                if not -math.pi <= turn < math.pi:  # rare, and a division
                    turn -= TWO_PI * np.floor((turn + math.pi) / TWO_PI)
                theta[s] += correction * turn
                theta[t] -= correction * turn
        _displacements(bearing, distance_m, along_x, along_y)
        for k in range(n_links):
            s, t = source[k], target[k]
            error_x = correction * (x[t] - x[s] - along_x[k])
            error_y = correction * (y[t] - y[s] - along_y[k])
            x[s] += error_x
            y[s] += error_y
            x[t] -= error_x
            y[t] -= error_y
        if (loops - 1 - loop) % CHECK_EVERY == 0:
            moved = 0.0
            for i in range(n):
                moved = max(moved, abs(x[i] - before[0, i]))
                moved = max(moved, abs(y[i] - before[1, i]))
                turned = theta[i] - before[2, i]
                moved = max(moved, abs(turned - TWO_PI * np.floor((turned + math.pi) / TWO_PI)))
            if moved <= tolerance:
                break
    for i in range(n):
        poses[i, 0], poses[i, 1] = x[i], y[i]
        poses[i, 2] = theta[i] - TWO_PI * np.floor((theta[i] + math.pi) / TWO_PI)
    return moved


CHECK_EVERY = 20
"""Loops between two checks for convergence; the last loop is always checked."""


@compiled
def _displacements(
    bearing: np.ndarray, distance: np.ndarray, along_x: np.ndarray, along_y: np.ndarray
) -> None:
    r"""Compute :math:`d \cos b` and :math:`d \sin b` of all links, four times as fast as libm.

    Without a branch, so that it is vectorised: :math:`b` is reduced to
    :math:`|r| \le \pi/4` by the nearest multiple of :math:`\pi/2` (in two parts, Cody and Waite),
    and the Taylor series, below :math:`10^{-17}` from the function there, is summed.
    """
    for k in range(bearing.size):
        turns = np.floor(bearing[k] * (2.0 / math.pi) + 0.5)
        r = bearing[k] - turns * 1.57079632673412561417  # 33 bits of pi / 2
        r = r - turns * 6.07710050650619224932e-11  # and the rest
        z = r * r
        s = 1.0 / 6227020800.0 - z / 1307674368000.0 + z * z / 355687428096000.0
        s = -1.0 / 5040.0 + z * (1.0 / 362880.0 + z * (-1.0 / 39916800.0 + z * s))
        s = r + r * z * (-1.0 / 6.0 + z * (1.0 / 120.0 + z * s))
        c = -1.0 / 87178291200.0 + z / 20922789888000.0 - z * z / 6402373705728000.0
        c = 1.0 / 40320.0 + z * (-1.0 / 3628800.0 + z * (1.0 / 479001600.0 + z * c))
        c = 1.0 - 0.5 * z + z * z * (1.0 / 24.0 + z * (-1.0 / 720.0 + z * c))
        half = np.floor(0.5 * turns)
        odd = turns - 2.0 * half  # cosine and sine change places
        sign = 1.0 - 2.0 * (half - 2.0 * np.floor(0.5 * half))
        along_x[k] = distance[k] * sign * ((1.0 - odd) * c - odd * s)
        along_y[k] = distance[k] * sign * ((1.0 - odd) * s + odd * c)


class Relaxation:
    """Relaxes the poses of a map with a fixed set of links.

    Args:
        source: Pose at which each link begins, ``int64``, shape ``(links,)``.
        target: Pose at which it ends; never its source.
        distance_m: Distance from source to target.
        heading_rad: Direction of the target, relative to the source's heading.
        facing_rad: Heading of the target relative to the source's; NaN where it is unknown, then
            the link moves positions only.

    Example:
        >>> poses = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
        >>> relaxation = Relaxation(*(np.array([v]) for v in (0, 1, 1.0, 0.0, 0.0)))
        >>> poses, moved = relaxation.run(poses, loops=1, correction=0.5)
        >>> poses[:, 0].tolist(), moved
        ([0.5, 1.5], 0.5)
    """

    def __init__(
        self,
        source: np.ndarray,
        target: np.ndarray,
        distance_m: np.ndarray,
        heading_rad: np.ndarray,
        facing_rad: np.ndarray,
    ) -> None:
        order = np.argsort(source, kind="stable")
        self._links = (
            source[order].astype(np.uint64),  # without a sign: no check for counting from the end
            target[order].astype(np.uint64),
            distance_m[order],
            heading_rad[order],
            facing_rad[order],
        )

    def run(
        self, poses: np.ndarray, loops: int, correction: float, tolerance: float = 0.0
    ) -> tuple[np.ndarray, float]:
        """Relax until the map has converged, at most ``loops`` times.

        Links that contradict each other never stop correcting: each undoes what the other did. So
        the map has converged if no pose moves over a whole loop.

        Args:
            poses: x, y in metres and heading in radians, shape ``(n, 3)``; not altered.
            loops: Largest number of loops.
            correction: Share of its error by which a link moves each of its ends, in (0, 0.5].
            tolerance: The map has converged if no pose moved farther (m, rad) in a loop.

        Returns:
            The poses, headings in [-pi, pi), and the largest movement of a pose in the last loop (m
            or rad; 0 without loops or links).
        """
        moved = 0.0
        if loops == 0 or not len(self._links[0]):
            return np.array(poses, dtype=np.float64), moved
        if not switch.ENABLED:
            for left in range(loops - 1, -1, -1):
                before, poses = poses, relax_sequentially(poses, *self._links, correction)
                if left % CHECK_EVERY == 0:
                    away = poses - before
                    moved = float(max(np.abs(away[:, :2]).max(), np.abs(wrap_angles(away)).max()))
                    if moved <= tolerance:
                        break
            return poses, moved
        solved = np.array(poses, dtype=np.float64, order="C")
        return solved, relax(solved, *self._links, loops, correction, tolerance)
