r"""Odometry from range scans: each scan is registered to the surfaces that the last scans show.

The pose :math:`x` of the robot minimises the distances of the scan's points :math:`p_i` from the
surfaces, lines through :math:`q_i` with normals :math:`n_i`, and stays near what the wheels
measure, :math:`\hat x` with covariance :math:`\Sigma`:

.. math:: \sum_i \rho\!\big(n_i \cdot (x \oplus p_i - q_i)\big)
          + \lVert x - \hat x \rVert^2_{\Sigma^{-1}}

with Cauchy's :math:`\rho`, by Gauss-Newton (point-to-line ICP: A. Censi, ICRA 2008). Where the
surfaces do not show a direction, as along a bare corridor, the wheels decide it.
"""

import math
from collections import deque
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

from neuroslam.geometry import TWO_PI, compose, rotate_points, wrap_angle
from neuroslam.sensors.scan import checked_ranges
from neuroslam.types import Pose, Velocity

REACH_M = 30.0
"""Farther ranges are not used: their points lie too far apart to show a surface."""

SIGMA_M = 0.04
"""Standard deviation of a range, with the roughness of walls."""

SCANS = 15
"""Scans whose surfaces the next one is registered to."""

LEAST_SHARE = 0.3
"""Share of a scan's points that must lie on known surfaces; with fewer the wheels alone count."""

_CORRELATED = 4.0  # neighbouring beams err alike: so many count as one
_LEAST_POINTS = 15
_ROUNDS = 12
_NEAREST_M = 0.05  # shorter ranges are the robot itself
_KEY_M, _KEY_RAD = 0.3, 0.25  # motion after which a scan is added to the known surfaces
_STEP_M, _PER_M = 0.02, 0.1  # standard deviation of the wheels: constant, and per metre
_STEP_RAD, _PER_RAD = 0.02, 0.3  # the same of turns


class Surfaces(NamedTuple):
    """Points on surfaces and the normals there, ``(n, 2)`` each, metres."""

    points: np.ndarray
    normals: np.ndarray

    def at(self, pose: Pose) -> "Surfaces":
        """Return the surfaces as seen from a robot at a pose, in the frame of that pose."""
        moved = rotate_points(self.points, pose.theta_rad) + np.array([pose.x_m, pose.y_m])
        return Surfaces(moved, rotate_points(self.normals, pose.theta_rad))


class Registered(NamedTuple):
    """Result of a registration.

    Attributes:
        pose: Pose of the robot in the frame of the known surfaces.
        share: Share of the scan's points on known surfaces, in [0, 1].
        rms_m: Root mean square of their distances from them; ``inf`` without any.
        information: Information of the surfaces about x, y and heading, ``(3, 3)``, without the
            wheels'.
    """

    pose: Pose
    share: float
    rms_m: float
    information: np.ndarray


def surfaces_in_scan(ranges: np.ndarray) -> Surfaces:
    """Return the points of a scan that lie on a surface, and its normal there.

    Args:
        ranges: Metres, ``(n,)``, at bearings evenly over the full turn, counter-clockwise from
            straight ahead; ``inf`` where nothing is in range.

    Raises:
        BadFrame: If the scan is invalid, see :func:`~neuroslam.sensors.scan.checked_ranges`.

    Example:
        >>> bearings = TWO_PI * np.arange(360) / 360
        >>> ahead = np.where(np.cos(bearings) > 0.5, 2.0 / np.cos(bearings), np.inf)
        >>> found = surfaces_in_scan(ahead)
        >>> len(found.points), found.normals[0].round(3).tolist()
        (119, [-1.0, 0.0])
    """
    scan = checked_ranges(ranges)
    seen = (scan < REACH_M) & (scan > _NEAREST_M)
    r = np.where(seen, scan, 0.0)
    bearings = np.arange(len(scan)) * (TWO_PI / len(scan))
    points = np.column_stack([r * np.cos(bearings), r * np.sin(bearings)])
    before, after = np.roll(points, 1, axis=0), np.roll(points, -1, axis=0)
    chord = after - before
    length = np.hypot(*chord.T)
    normals = np.column_stack([-chord[:, 1], chord[:, 0]]) / np.maximum(length, 1e-9)[:, None]
    off = np.abs(((points - 0.5 * (before + after)) * normals).sum(axis=1))
    spacing = 12.0 * TWO_PI / len(scan)  # walls seen at up to some 80 degrees from their normal
    flat = (length < 0.1 + spacing * r) & (length > 1e-6) & (off < 0.03 + 0.02 * r)
    flat &= seen & np.roll(seen, 1) & np.roll(seen, -1)
    return Surfaces(points[flat], normals[flat])


class KnownSurfaces:
    """Surfaces that scans are registered to.

    Args:
        parts: Surfaces in one frame.
    """

    def __init__(self, parts: list[Surfaces]) -> None:
        self.points = np.concatenate([part.points for part in parts])
        self.normals = np.concatenate([part.normals for part in parts])
        self._tree = cKDTree(self.points) if len(self.points) else None

    def register(
        self,
        scan: Surfaces,
        guess: Pose,
        sigma_m: float,
        sigma_rad: float,
        reach_m: float = 0.5,
    ) -> Registered:
        """Find the pose from which a scan shows these surfaces.

        Args:
            scan: Surfaces in the frame of the robot.
            guess: Expected pose.
            sigma_m: Standard deviation of its position.
            sigma_rad: Standard deviation of its heading.
            reach_m: Largest distance of a point from its surface in the first round.
        """
        nothing = Registered(guess, 0.0, math.inf, np.zeros((3, 3)))
        if self._tree is None or len(scan.points) < _LEAST_POINTS:
            return nothing
        start, x = np.array(guess), np.array(guess)
        prior = np.diag([sigma_m**-2, sigma_m**-2, sigma_rad**-2])
        residual, information, share = np.zeros(1), np.zeros((3, 3)), 0.0
        for at in range(_ROUNDS):
            turned = rotate_points(scan.points, x[2])
            limit = max(reach_m * 0.6**at, 3.0 * SIGMA_M)
            apart, nearest = self._tree.query(turned + x[:2], distance_upper_bound=limit)
            near = np.isfinite(apart)
            if near.sum() < _LEAST_POINTS:
                return nothing
            of, normal = nearest[near], self.normals[nearest[near]]
            residual = ((turned[near] + x[:2] - self.points[of]) * normal).sum(axis=1)
            arm = np.column_stack([-turned[near, 1], turned[near, 0]])
            rows = np.column_stack([normal, (normal * arm).sum(axis=1)])
            weight = 1.0 / (1.0 + (residual / (2.0 * SIGMA_M)) ** 2)
            weight /= SIGMA_M**2 * _CORRELATED
            information = rows.T @ (rows * weight[:, None])
            step = np.linalg.solve(
                information + prior, -rows.T @ (weight * residual) - prior @ (x - start)
            )
            x = x + step
            share = float(near.mean())
            if limit <= 3.0 * SIGMA_M and np.abs(step).max() < 1e-4:
                break
        pose = Pose(float(x[0]), float(x[1]), wrap_angle(float(x[2])))
        return Registered(pose, share, float(np.sqrt((residual**2).mean())), information)


class ScanOdometry:
    """Measures self-motion by registering scans, with wheel odometry as a first guess.

    Example:
        >>> bearings = TWO_PI * np.arange(360) / 360
        >>> along, aside = (np.maximum(f(bearings), 1e-9) for f in (np.cos, np.sin))
        >>> def corner(x_m):  # walls 3 m ahead and 2 m to the left of the start
        ...     return np.minimum((3.0 - x_m) / along, 2.0 / aside)
        >>> odometry = ScanOdometry()
        >>> _ = odometry(corner(0.0), Velocity(0.0, 0.0), 0.2)
        >>> moved = odometry(corner(0.10), Velocity(0.4, 0.0), 0.2)  # the wheels slip: 0.08 m
        >>> round(moved.x_m, 2)
        0.1
    """

    def __init__(self) -> None:
        self.pose = Pose(0.0, 0.0, 0.0)
        self._scans: deque[Surfaces] = deque(maxlen=SCANS)
        self._key: Pose | None = None
        self._known = KnownSurfaces([Surfaces(np.empty((0, 2)), np.empty((0, 2)))])

    def __call__(self, ranges: np.ndarray, velocity: Velocity, dt_s: float) -> Pose:
        """Return the pose at a scan in the frame of the first one.

        Args:
            ranges: Metres, ``(n,)``, evenly over the full turn.
            velocity: By the wheels, since the scan before.
            dt_s: Time since the scan before.

        Raises:
            BadFrame: If the scan is invalid.
        """
        scan = surfaces_in_scan(ranges)
        turn, way = velocity.w_rad_s * dt_s, velocity.v_m_s * dt_s
        step = Pose(way * math.cos(0.5 * turn), way * math.sin(0.5 * turn), turn)
        here = compose(self.pose, step)
        if way or turn:
            found = self._known.register(
                scan, here, _STEP_M + _PER_M * abs(way), _STEP_RAD + _PER_RAD * abs(turn)
            )
            here = found.pose if found.share > LEAST_SHARE else here
        self.pose = here
        key = self._key
        moved = key is None or (
            math.hypot(here.x_m - key.x_m, here.y_m - key.y_m) > _KEY_M
            or abs(wrap_angle(here.theta_rad - key.theta_rad)) > _KEY_RAD
        )
        if moved and len(scan.points) >= _LEAST_POINTS:
            self._scans.append(scan.at(here))
            self._key, self._known = here, KnownSurfaces(list(self._scans))
        return here
