r"""Odometry of ROS bags: whether its twist agrees with its own poses, and motion from the poses.

``nav_msgs/Odometry`` has a pose in the frame ``header.frame_id`` and a twist in the frame
``child_frame_id`` (REP 105). Many programs fill only the pose, or write the twist in the frame of
the map or in degrees. The poses are the integral of the twist, so each can be checked by the other.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from neuroslam.geometry import wrap_angle, wrap_angles
from neuroslam.types import Velocity

_CHUNK_S = 0.5
"""Seconds over which twist and poses are compared: long against the jitter of stamps."""

_STILL_M, _STILL_RAD = 0.05, 0.1
"""Motion below which there is nothing to compare."""

_AGREES = (0.7, 1.4)
"""Bounds of the median ratio of twist to poses that agree."""

_FASTEST_M_S = 50.0
"""Speed between two poses above which they jump."""


class OdometrySample(NamedTuple):
    """One message: time (s), position (m), heading (rad), and twist in m/s and rad/s."""

    time_s: float
    x_m: float
    y_m: float
    z_m: float
    heading_rad: float
    vx_m_s: float
    vy_m_s: float
    vz_m_s: float
    w_rad_s: float


class OdometryCheck(NamedTuple):
    """Result of comparing twist and poses.

    Attributes:
        use: ``twist`` or ``poses``; empty: neither can be used.
        why: Reason, if it is not an agreeing twist.
        moves: Whether there is any motion.
    """

    use: str
    why: str = ""
    moves: bool = True


def odometry_sample(message: Any, time_s: float) -> OdometrySample:  # noqa: ANN401
    """Read a ``nav_msgs/Odometry``; the heading is NaN if the quaternion is not one.

    Args:
        message: The message.
        time_s: Its time.
    """
    p, q = message.pose.pose.position, message.pose.pose.orientation
    twist = message.twist.twist
    norm = math.hypot(q.x, q.y, q.z, q.w)
    heading = math.nan
    if 0.5 < norm < 2.0:
        heading = math.atan2(2.0 * (q.w * q.z + q.x * q.y), norm**2 - 2.0 * (q.y**2 + q.z**2))
    linear = twist.linear
    return OdometrySample(
        *(float(v) for v in (time_s, p.x, p.y, p.z, heading)),
        *(float(v) for v in (linear.x, linear.y, linear.z, twist.angular.z)),
    )


def motion_between(before: OdometrySample, now: OdometrySample) -> Velocity:
    r"""Return the forward speed and turn rate that lead from one pose to the next.

    .. math:: v = \frac{(p' - p) \cdot u(\theta + \Delta/2)}{\Delta t}, \quad
              w = \frac{\Delta}{\Delta t}, \quad \Delta = \theta' - \theta

    Args:
        before: Sample at the earlier time.
        now: Sample at the later time.

    Example:
        >>> still = OdometrySample(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        >>> motion_between(still, still._replace(time_s=0.5, x_m=1.0))
        Velocity(v_m_s=2.0, w_rad_s=0.0)
    """
    dt_s = now.time_s - before.time_s
    turn = wrap_angle(now.heading_rad - before.heading_rad)
    middle = before.heading_rad + 0.5 * turn
    ahead = (now.x_m - before.x_m) * math.cos(middle) + (now.y_m - before.y_m) * math.sin(middle)
    return Velocity(ahead / dt_s, turn / dt_s)


class _Chunks(NamedTuple):
    """Motion over intervals of half a second, ``(n,)`` each or ``(n, 2)``: by poses and by twist.

    Attributes:
        displacement_m: Displacement of the poses in their frame, ``(n, 2)``.
        ahead_m: Forward displacement of the poses.
        aside_m: Sideways displacement of the poses.
        climb_m: Vertical displacement of the poses.
        turn_rad: Turn of the poses.
        twist_ahead_m: Integral of the forward twist.
        twist_m: Integral of the twist, taken as it is, ``(n, 2)``.
        twist_turned_m: Integral of the twist turned by the heading, ``(n, 2)``.
        twist_climb_m: Integral of the vertical twist.
        twist_rad: Integral of the turn rate.
        fastest_m_s: Greatest speed between two poses.
    """

    displacement_m: np.ndarray
    ahead_m: np.ndarray
    aside_m: np.ndarray
    climb_m: np.ndarray
    turn_rad: np.ndarray
    twist_ahead_m: np.ndarray
    twist_m: np.ndarray
    twist_turned_m: np.ndarray
    twist_climb_m: np.ndarray
    twist_rad: np.ndarray
    fastest_m_s: np.ndarray


def check_odometry(windows: Sequence[Sequence[OdometrySample]]) -> OdometryCheck:
    """Compare the twist of odometry with its own poses.

    Args:
        windows: Successive samples of some parts of a recording.

    Returns:
        Which of the two to use, and why. Without motion, or with fewer than four samples, the
        twist is used.
    """
    rows = [np.array(window, np.float64).reshape(-1, 9) for window in windows]
    every = np.concatenate(rows) if rows else np.empty((0, 9))
    if len(every) < 4:
        return OdometryCheck("twist")
    has_twist = np.isfinite(every[:, [5, 8]]).all(axis=1).mean() > 0.5
    has_pose = np.isfinite(every[:, 1:5]).all(axis=1).mean() > 0.5
    parts = [chunks for window in rows if (chunks := _chunks(window, has_twist)) is not None]
    if not has_pose or not parts:
        if not has_twist:
            return OdometryCheck("", "neither its poses nor its twist are numbers")
        moves = bool(np.abs(every[:, [5, 8]]).max() > 0.0)
        return OdometryCheck(
            "twist" if moves or has_pose else "", "its poses are not numbers", moves
        )
    c = _Chunks(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    return _compared(c, has_twist)


def _chunks(window: np.ndarray, has_twist: bool) -> _Chunks | None:
    """Integrate poses and twist over intervals of half a second."""
    usable = np.isfinite(window[:, :5]).all(axis=1)
    if has_twist:
        usable &= np.isfinite(window[:, [5, 8]]).all(axis=1)
    window = window[usable]
    if len(window):
        latest = np.maximum.accumulate(window[:, 0])
        window = window[np.concatenate([[True], np.diff(latest) > 0.0])]
    if len(window) < 2:
        return None
    dt = np.diff(window[:, 0])
    step = np.diff(window[:, 1:4], axis=0)
    turn = wrap_angles(np.diff(window[:, 4]))
    middle = window[:-1, 4] + 0.5 * turn
    c, s = np.cos(middle), np.sin(middle)
    twist = np.nan_to_num(0.5 * (window[:-1, 5:] + window[1:, 5:]) * dt[:, None])
    columns = np.column_stack([
        step[:, 0], step[:, 1], c * step[:, 0] + s * step[:, 1], c * step[:, 1] - s * step[:, 0],
        step[:, 2], turn, twist[:, 0], twist[:, 1], c * twist[:, 0] - s * twist[:, 1],
        s * twist[:, 0] + c * twist[:, 1], twist[:, 2], twist[:, 3],
    ])  # fmt: skip
    number = ((window[1:, 0] - window[0, 0]) / _CHUNK_S - 1e-9).astype(np.int64)
    starts = np.flatnonzero(np.concatenate([[True], np.diff(number) > 0]))
    sums = np.add.reduceat(columns, starts, axis=0)
    speed = np.hypot(step[:, 0], step[:, 1]) / dt
    return _Chunks(
        displacement_m=sums[:, :2],
        ahead_m=sums[:, 2],
        aside_m=sums[:, 3],
        climb_m=sums[:, 4],
        turn_rad=sums[:, 5],
        twist_ahead_m=sums[:, 6],
        twist_m=sums[:, 6:8],
        twist_turned_m=sums[:, 8:10],
        twist_climb_m=sums[:, 10],
        twist_rad=sums[:, 11],
        fastest_m_s=np.maximum.reduceat(speed, starts),
    )


def _compared(c: _Chunks, has_twist: bool) -> OdometryCheck:
    moved, climbed = np.hypot(*c.displacement_m.T).sum(), np.abs(c.climb_m).sum()
    turned = np.abs(c.turn_rad).sum()
    poses_move = moved > _STILL_M or turned > _STILL_RAD
    if climbed > 0.5 and climbed > 2.0 * moved:
        return OdometryCheck(
            "",
            f"its poses move {climbed:.1f} m along z and {moved:.1f} m along x and y, as in camera "
            "axes; expected z up",
        )
    jumps = int((c.fastest_m_s > _FASTEST_M_S).sum())
    poses_sound = poses_move and jumps <= 0.05 * len(c.fastest_m_s)
    if not has_twist:
        why = "its twist is not a number"
        return OdometryCheck("poses" if poses_sound else "", why, poses_move)
    twist_m, twist_rad = np.hypot(*c.twist_m.T).sum(), np.abs(c.twist_rad).sum()
    twist_moves = twist_m > _STILL_M or twist_rad > _STILL_RAD
    if not poses_move:
        why = f"its poses do not move, its twist does, {twist_m:.1f} m" if twist_moves else ""
        return OdometryCheck("twist", why, bool(twist_moves))
    why = _disagreement(c, float(moved), float(turned), float(twist_m), float(twist_rad))
    if not why:
        return OdometryCheck("twist", _sideways(c))
    if poses_sound:
        return OdometryCheck("poses", why)
    return OdometryCheck("", f"{why}, and its poses jump, at up to {c.fastest_m_s.max():.0f} m/s")


def _disagreement(c: _Chunks, moved: float, turned: float, twist_m: float, twist_rad: float) -> str:
    """Say how the twist differs from the poses; empty if it does not."""
    if twist_m < 0.05 * moved and moved > _STILL_M:
        both = twist_rad < 0.05 * turned or turned <= _STILL_RAD
        return (
            f"its {'twist' if both else 'linear twist'} is zero while its poses move {moved:.1f} m "
            f"and turn {turned:.1f} rad"
        )
    if twist_rad < 0.05 * turned and turned > _STILL_RAD:
        return f"its turn rate is zero while its poses turn {turned:.1f} rad"
    speed = _ratio(c.twist_ahead_m, c.ahead_m) if moved > _STILL_M else None
    rate = _ratio(c.twist_rad, c.turn_rad) if turned > _STILL_RAD else None
    if speed is not None and not speed[1]:
        as_it_is = np.hypot(*(c.twist_m - c.displacement_m).T).sum()
        by_heading = np.hypot(*(c.twist_turned_m - c.displacement_m).T).sum()
        if as_it_is < 0.3 * moved and by_heading > 2.0 * as_it_is:
            return (
                "its twist is in the frame of the map; expected that of the robot, x forward "
                "(child_frame_id)"
            )
        return f"its speed is {speed[0]:.3g} times that of its poses"
    if rate is not None and not rate[1]:
        degrees = 40.0 < rate[0] < 75.0
        return (
            f"its turn rate is {rate[0]:.3g} times that of its poses"
            f"{': degrees for radians' if degrees else ''}"
        )
    return ""


def _ratio(twist: np.ndarray, poses: np.ndarray) -> tuple[float, bool] | None:
    """Return the median ratio over the chunks with much motion, and whether the two agree."""
    size = np.maximum(np.abs(twist), np.abs(poses))
    much = size > 0.3 * np.quantile(size, 0.9)
    nonzero = much & (np.abs(poses) > 1e-6)
    if not nonzero.any():
        return None
    ratio = float(np.median(twist[nonzero] / poses[nonzero]))
    close = np.abs(twist - poses)[much] <= 0.35 * size[much]
    low, high = _AGREES
    return ratio, bool(low < ratio < high and close.mean() >= 0.5)


def _sideways(c: _Chunks) -> str:
    ahead, aside = np.abs(c.ahead_m).sum(), np.abs(c.aside_m).sum()
    if aside > _STILL_M and aside > 0.3 * (ahead + aside):
        return (
            f"its poses move {aside:.1f} m sideways and {ahead:.1f} m ahead; only the forward "
            "speed is used"
        )
    return ""
