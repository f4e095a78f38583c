"""Detects the walls in a lidar scan: the feet of the perpendiculars, the input of boundary cells.

A line is fitted to a window that slides over the beams. If the foot of the perpendicular on that
line lies among the window's points, there may be a wall, straight or curved. The inliers of the
wall are collected and fitted once more, with a parabola if they are curved.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from neuroslam import compiled as steps
from neuroslam.compiled import compiled
from neuroslam.errors import BadFrame
from neuroslam.geometry import TWO_PI, rotate, wrap_angle, wrap_angles
from neuroslam.sensors.frames import checked_array

_WINDOW_M = 0.06  # half the window: shows a corner of 90 degrees, but not the curve of a pillar
_WALL_M = 0.25  # half the longest wall segment that is fitted
_MIN_POINTS = 5  # of a wall
_OUTLIER = 3.0  # tolerances
_BENT, _SHARP = 2.5, 3.0  # standard deviations that distinguish a curve, a corner from a line
_SAME_RAD = 0.5  # walls that share points and differ by less in bearing are one
_ROUNDS = 4


class _Points(NamedTuple):
    """The scan extended by a third of a turn at both ends, so that no window has to wrap.

    Attributes:
        xy: Points in metres, x ahead, ``(2, m)``; zero where the beam hits nothing.
        seen: Whether the beam hits a surface, ``(m,)``.
        first: First beam on the same surface as each beam, ``(m,)``.
        last: Last beam on the same surface, ``(m,)``.
        pad: Number of beams before the first of the scan.
        step: Angle from beam to beam.
    """

    xy: np.ndarray
    seen: np.ndarray
    first: np.ndarray
    last: np.ndarray
    pad: int
    step: float


class _Wall(NamedTuple):
    """Distance and bearing of the foot, and the first and last beam on the wall."""

    distance_m: float
    bearing_rad: float
    first: int
    last: int


class _Curve(NamedTuple):
    """Coefficients of a fitted wall in the frame of its foot, RMS residual, degrees of freedom."""

    q: tuple[float, float, float]
    rms: float
    free: int


def walls_in_scan(ranges: ArrayLike, reach_m: float, tolerance_m: float = 0.01) -> np.ndarray:
    """Detect the walls in a scan: the feet of the perpendiculars on them.

    A convex corner is a local minimum of the distance as well, but no wall: it is rejected, as is a
    wall whose foot lies outside its visible part.

    Args:
        ranges: Metres, ``(n,)``, at bearings evenly over the full turn, counter-clockwise from
            straight ahead; ``inf`` where nothing is in range.
        reach_m: Largest distance of a wall. The range of the lidar should be larger, as a wall is
            detected by its points on both sides of the foot.
        tolerance_m: Standard deviation of the noise of the ranges. A curve that deviates less from
            a line may be fitted as straight.

    Returns:
        Distance in metres and bearing relative to the heading in [-pi, pi), ``(m, 2)``, nearest
        first.

    Raises:
        BadFrame: If the scan is not ``(n,)`` with at least 8 beams, or contains NaN or negative
            ranges; if the reach or the tolerance is not positive.

    Example:
        >>> beams = 2 * np.pi * np.arange(180) / 180
        >>> ahead = np.where(np.cos(beams) > 0.1, 0.2 / np.cos(beams), np.inf)
        >>> walls_in_scan(ahead, reach_m=0.3).round(3).tolist()
        [[0.2, 0.0]]
    """
    if not (reach_m > 0.0 and 0.0 < tolerance_m < np.inf):
        raise BadFrame(
            f"scan: reach_m is {reach_m} and tolerance_m is {tolerance_m}; expected both above 0"
        )
    scan = checked_ranges(ranges)
    found: list[_Wall] = []
    if scan.min() > reach_m + _OUTLIER * tolerance_m:
        return np.empty((0, 2))
    if steps.ENABLED:
        rows = find_walls(np.ascontiguousarray(scan), float(reach_m), float(tolerance_m))
        return rows[np.lexsort((rows[:, 1], rows[:, 0])), :2]
    points = _extended(scan, tolerance_m)
    residual, distance, bearing = _fit_windows(points, scan, reach_m, tolerance_m)
    n, pad = len(scan), points.pad
    while residual[seed := int(residual.argmin())] < np.inf:
        wall = _grow(points, pad + seed, distance[seed], bearing[seed], tolerance_m)
        if wall is None or wall.distance_m > reach_m:
            used = np.arange(seed - 1, seed + 2)
        else:
            used = np.arange(wall.first - pad, wall.last + 1 - pad)
            if not any(_same(wall, other, n) for other in found):
                found.append(wall)
        residual[used % n] = np.inf
    return np.array(sorted(wall[:2] for wall in found)).reshape(-1, 2)


def checked_ranges(ranges: object) -> np.ndarray:
    """Check the ranges of a scan.

    Args:
        ranges: Metres, ``(n,)``; ``inf`` where nothing is in range.

    Returns:
        The ranges as ``float64``.

    Raises:
        BadFrame: If the scan is not ``(n,)`` with at least 8 beams, or contains NaN, negative
            ranges or values that are no numbers.

    Example:
        >>> checked_ranges([1.0, 2.0])
        Traceback (most recent call last):
        neuroslam.errors.BadFrame: scan: ranges have shape (2,); expected (n,), at least 8 beams
    """
    scan = checked_array(ranges, "scan: ranges", (None,), "metres, at least 8 beams")
    if len(scan) < 8:
        raise BadFrame(f"scan: ranges have shape {scan.shape}; expected (n,), at least 8 beams")
    if not scan.min() >= 0.0:  # NaN too
        at = int(np.flatnonzero(~(scan >= 0.0))[0])
        raise BadFrame(
            f"scan: beam {at} measures {scan[at]} m; expected at least 0 m, or inf where nothing "
            "is in range"
        )
    return scan


def _extended(scan: np.ndarray, tolerance_m: float) -> _Points:
    n = len(scan)
    step, pad = TWO_PI / n, n // 3
    seen = scan < np.inf
    r = np.where(seen, scan, 0.0)
    before = np.concatenate([r[-1:], r[:-1]])
    # The range of one wall, at up to 75 degrees of incidence, changes by less from beam to beam.
    starts = np.abs(r - before) > 5.0 * tolerance_m + 4.0 * step * np.minimum(r, before)
    starts |= ~(seen & np.roll(seen, 1))
    order = np.arange(-pad, n + pad) % n
    at, starts = np.arange(len(order)), starts[order]
    first = np.maximum.accumulate(np.where(starts, at, 0))
    next_start = np.minimum.accumulate(np.where(starts, at, len(order))[::-1])[::-1]
    beam = step * np.arange(n)
    xy = np.empty((2, n))
    np.multiply(r, np.cos(beam), out=xy[0])
    np.multiply(r, np.sin(beam), out=xy[1])
    last = np.append(next_start[1:], len(order)) - 1
    return _Points(xy[:, order], seen[order], first, last, pad, step)


def _fit_windows(
    points: _Points, scan: np.ndarray, reach_m: float, tolerance_m: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    r"""Fit a line to a window about each beam, by its moments: :math:`p \cdot n(\alpha) = d`.

    The normal is the direction of least variance, :math:`\lambda_- = \tfrac12 (c_{xx} + c_{yy} -
    \sqrt{(c_{xx} - c_{yy})^2 + 4 c_{xy}^2})`.

    Returns:
        For each beam, ``(n,)``: RMS distance of the window's points from the line, ``inf`` without
        a wall; distance of the wall; its bearing.
    """
    n, step = len(scan), points.step
    here = np.flatnonzero(scan <= np.hypot(reach_m, _WINDOW_M) + _OUTLIER * tolerance_m)
    r = np.maximum(scan[here], tolerance_m)
    half = np.clip(np.ceil(np.arctan(_WINDOW_M / r) / step), 2, n // 5).astype(np.int64)
    at = points.pad + here
    low, high = np.maximum(at - half, points.first[at]), np.minimum(at + half, points.last[at])
    x, y = points.xy
    sums = np.zeros((6, len(x) + 1))
    for row, value in zip(sums, (points.seen, x, y, x * x, x * y, y * y), strict=True):
        np.cumsum(value, out=row[1:])
    count, *moments = sums[:, high + 1] - sums[:, low]
    count = np.maximum(count, 1.0)
    x, y, xx, xy, yy = (moment / count for moment in moments)
    xx, xy2, yy = xx - x * x, 2.0 * (xy - x * y), yy - y * y
    normal = 0.5 * (np.arctan2(xy2, xx - yy) + np.pi)
    d = x * np.cos(normal) + y * np.sin(normal)
    least = 0.5 * (xx + yy - np.hypot(xx - yy, xy2))
    bearing = normal + np.pi * (d < 0.0)
    free = np.maximum(count - 2.0, 1.0)
    rms = np.sqrt(np.maximum(least, 0.0) * count / free)
    off = np.abs(wrap_angles(bearing - step * (0.5 * (low + high) - points.pad)))
    valid = (count >= _MIN_POINTS) & (rms <= _max_rms(tolerance_m, free))
    valid &= (np.abs(d) <= reach_m + 2.0 * tolerance_m) & (off <= step * (0.5 * (high - low) + 0.5))
    residuals, distances, bearings = np.full(n, np.inf), np.zeros(n), np.zeros(n)
    residuals[here] = np.where(valid, rms, np.inf)
    distances[here], bearings[here] = np.abs(d), bearing
    return residuals, distances, bearings


def _grow(
    points: _Points, seed: int, distance_m: float, bearing_rad: float, tolerance_m: float
) -> _Wall | None:
    r"""Collect the inliers of the wall at a beam, and fit them.

    In the frame of the foot, u along the wall and v beyond it, the wall is
    :math:`v = q_0 + q_1 u + q_2 u^2`, with :math:`q_2` only if it is significant. The weight of a
    point with residual :math:`e` is :math:`1 - (e / 3\sigma)^2`. A corner,
    :math:`v = q_0 + q_1 u + q_2 |u|` with :math:`q_2 > 0`, is no wall: the result is ``None``.
    """
    reach = (len(points.seen) - 2 * points.pad) // 3
    start = max(int(points.first[seed]), seed - reach)
    x, y = points.xy[:, start : min(int(points.last[seed]), seed + reach) + 1]
    curvature, limit, ends = 0.0, _OUTLIER * tolerance_m, (0, 0)
    curve, corner, inside, low, high = None, False, False, 0, 0
    for _ in range(_ROUNDS):
        ahead, u = rotate(x, y, -bearing_rad)
        v = ahead - distance_m
        weight = 1.0 - ((v - curvature * u * u) / limit) ** 2
        outliers = np.flatnonzero((weight < 0.0) | (np.abs(u) > _WALL_M))
        k = int(outliers.searchsorted(seed - start))
        low = int(outliers[k - 1]) + 1 if k else 0
        high = int(outliers[k]) if k < len(outliers) else len(u)
        if high - low < _MIN_POINTS or not low <= seed - start < high:
            return None
        u, v = u[low:high], v[low:high]
        rows = np.empty((5, high - low))
        rows[0], rows[1], rows[4] = 1.0, u, v
        np.multiply(u, u, out=rows[2])
        np.abs(u, out=rows[3])
        curve, corner = _fit(((rows * weight[low:high]) @ rows.T).tolist(), high - low, tolerance_m)
        if curve is None:
            return None
        q0, q1, q2 = curve.q
        foot = _foot(distance_m + q0, q1, q2)
        if foot is None:
            return None
        along, off = foot
        pitch = off * points.step
        inside = bool(u[0] - pitch <= along <= u[-1] + pitch)
        distance_m, bearing_rad = math.hypot(along, off), bearing_rad + math.atan2(along, off)
        curvature = q2
        if ends == (low, high):
            break
        ends = low, high
    if curve is None or corner or not inside or curve.rms > _max_rms(tolerance_m, curve.free):
        return None
    return _Wall(distance_m, wrap_angle(bearing_rad), start + low, start + high - 1)


def _fit(table: list[list[float]], count: int, tolerance_m: float) -> tuple[_Curve | None, bool]:
    """Fit line, parabola and corner by their moments; return the wall, and whether it is a corner.

    Args:
        table: Weighted sums of the products of 1, u, u^2, |u| and v, ``(5, 5)``.
        count: Number of points.
        tolerance_m: Standard deviation of their noise.
    """
    (s, su, suu, sa, sv), (_, _, suuu, sua, suv), (_, _, s4, _, suuv), (*_, saa, sav), _ = table
    svv = table[4][4]
    det = s * suu - su * su
    if det <= 1e-12 * s * suu:
        return None, False
    q0, q1 = (suu * sv - su * suv) / det, (s * suv - su * sv) / det
    curve = _curve((q0, q1, 0.0), svv - q0 * sv - q1 * suv, count - 2)
    if count < _MIN_POINTS + 3:
        return curve, False
    bent, q2_std = _third(det, (s, su, suu), (suu, suuu, s4), (sv, suv, suuv), svv, count)
    kinked, kink_std = _third(det, (s, su, suu), (sa, sua, saa), (sv, suv, sav), svv, count)
    noise_m = max(kinked.rms, 0.1 * tolerance_m)  # a lower bound, else rounding makes corners
    sharp = kinked.q[2] > _SHARP * kink_std * noise_m and kinked.rms < bent.rms
    # Curved only if noise does not explain it; else a wall would bend around the next corner.
    return bent if abs(bent.q[2]) > _BENT * q2_std * tolerance_m else curve, sharp


def _third(
    det: float,
    line: tuple[float, float, float],
    column: tuple[float, float, float],
    target: tuple[float, float, float],
    svv: float,
    count: int,
) -> tuple[_Curve, float]:
    """Fit 1, u and a third column; return also its coefficient's deviation for noise of 1 m."""
    s, su, suu = line
    c0, c1, cc = column
    v0, v1, vc = target
    a0, a1 = (suu * c0 - su * c1) / det, (s * c1 - su * c0) / det
    own = max(cc - a0 * c0 - a1 * c1, 1e-9 * cc)  # squared norm of its part that is no line
    q2 = (vc - a0 * v0 - a1 * v1) / own
    q0 = (suu * v0 - su * v1) / det - a0 * q2
    q1 = (s * v1 - su * v0) / det - a1 * q2
    curve = _curve((q0, q1, q2), svv - q0 * v0 - q1 * v1 - q2 * vc, count - 3)
    return curve, 1.0 / math.sqrt(own)


def _curve(q: tuple[float, float, float], squares: float, free: int) -> _Curve:
    return _Curve(q, math.sqrt(max(squares, 0.0) / free), free)


def _foot(q0: float, q1: float, q2: float) -> tuple[float, float] | None:
    """Find the nearest point of a parabola by Newton's method; ``None`` if it is no minimum."""
    along = 0.0
    for _ in range(3):
        off, slope = q0 + (q1 + q2 * along) * along, q1 + 2.0 * q2 * along
        rise = 1.0 + slope * slope + 2.0 * q2 * off
        if rise < 0.1:
            return None
        along -= (along + off * slope) / rise
    return along, q0 + (q1 + q2 * along) * along


def _max_rms(tolerance_m: float, free: float | np.ndarray) -> float | np.ndarray:
    """Return the RMS residual that a wall exceeds with probability 1 %.

    Args:
        tolerance_m: Standard deviation of the noise.
        free: Degrees of freedom of the fit.
    """
    return tolerance_m * (1.0 + 2.5 / np.sqrt(2.0 * free))


def _same(wall: _Wall, other: _Wall, n: int) -> bool:
    """Return whether two walls have a similar bearing and the foot of one is on the other."""
    turn = wrap_angle(wall.bearing_rad - other.bearing_rad)
    return abs(turn) < _SAME_RAD and any(
        (a.bearing_rad / TWO_PI * n + n // 3 - b.first + 0.5) % n <= b.last - b.first + 1
        for a, b in ((wall, other), (other, wall))
    )


# --- compiled steps -------------------------------------------------------------------------------


@compiled
def _angle(angle_rad: float) -> float:
    """Do as :func:`~neuroslam.geometry.wrap_angle`."""
    return (angle_rad + math.pi) % TWO_PI - math.pi


@compiled
def _largest_rms(tolerance_m: float, free: float) -> float:
    """Do as ``_max_rms``."""
    return tolerance_m * (1.0 + 2.5 / math.sqrt(2.0 * free))


@compiled
def _third_of(
    line: tuple[float, ...], det: float, c0: float, c1: float, cc: float, vc: float, free: int
) -> tuple[float, float, float, float, float]:
    """Do as ``_third``; ``line`` has the sums of 1, u, u^2, v, uv and v^2."""
    s, su, suu, v0, v1, svv = line
    a0, a1 = (suu * c0 - su * c1) / det, (s * c1 - su * c0) / det
    own = max(cc - a0 * c0 - a1 * c1, 1e-9 * cc)
    q2 = (vc - a0 * v0 - a1 * v1) / own
    q0 = (suu * v0 - su * v1) / det - a0 * q2
    q1 = (s * v1 - su * v0) / det - a1 * q2
    squares = svv - q0 * v0 - q1 * v1 - q2 * vc
    return q0, q1, q2, math.sqrt(max(squares, 0.0) / free), 1.0 / math.sqrt(own)


@compiled
def _fitted(
    t: tuple[float, ...], count: int, tolerance_m: float
) -> tuple[float, float, float, float, int, bool]:
    """Do as ``_fit``, by the sums that :func:`_grown` makes; no degrees of freedom: no wall."""
    s, su, suu, suuu, s4, sa, sua, saa, sv, suv, suuv, sav, svv = t
    det = s * suu - su * su
    if det <= 1e-12 * s * suu:
        return 0.0, 0.0, 0.0, 0.0, 0, False
    q0, q1 = (suu * sv - su * suv) / det, (s * suv - su * sv) / det
    rms = math.sqrt(max(svv - q0 * sv - q1 * suv, 0.0) / (count - 2))
    if count < _MIN_POINTS + 3:
        return q0, q1, 0.0, rms, count - 2, False
    line = (s, su, suu, sv, suv, svv)
    b0, b1, b2, bent, q2_std = _third_of(line, det, suu, suuu, s4, suuv, count - 3)
    _, _, k2, kinked, kink_std = _third_of(line, det, sa, sua, saa, sav, count - 3)
    noise_m = max(kinked, 0.1 * tolerance_m)
    sharp = k2 > _SHARP * kink_std * noise_m and kinked < bent
    if abs(b2) > _BENT * q2_std * tolerance_m:
        return b0, b1, b2, bent, count - 3, sharp
    return q0, q1, 0.0, rms, count - 2, sharp


@compiled
def _grown(
    xy: np.ndarray, start: int, end: int, seed: int, distance_m: float, bearing_rad: float,
    tolerance_m: float, step: float,
) -> tuple[float, float, int, int]:  # fmt: skip
    """Do as ``_grow`` on the points from ``start`` to ``end``; a negative distance: no wall."""
    none = (-1.0, 0.0, 0, 0)
    curvature, limit, low, high = 0.0, _OUTLIER * tolerance_m, -1, -1
    rms, free, corner, inside = 0.0, 0, False, False
    for _ in range(_ROUNDS):
        c, s = math.cos(-bearing_rad), math.sin(-bearing_rad)
        before, first, last = (low, high), start, end
        for side in range(2):  # from the seed on, then back from it
            k = seed - side
            while start <= k < end:
                u, v = s * xy[0, k] + c * xy[1, k], c * xy[0, k] - s * xy[1, k] - distance_m
                away = (v - curvature * u * u) / limit
                if 1.0 - away * away < 0.0 or abs(u) > _WALL_M:
                    break
                k += 1 - 2 * side
            if side:
                first = k + 1
            else:
                last = k
        low, high = first, last
        if high - low < _MIN_POINTS or not low <= seed < high:
            return none
        t0 = t1 = t2 = t3 = t4 = t5 = t6 = t7 = t8 = t9 = t10 = t11 = t12 = 0.0
        from_u = to_u = 0.0
        for k in range(low, high):
            u, v = s * xy[0, k] + c * xy[1, k], c * xy[0, k] - s * xy[1, k] - distance_m
            away = (v - curvature * u * u) / limit
            w, uu, a = 1.0 - away * away, u * u, abs(u)
            t0 += w
            t1 += w * u
            t2 += w * uu
            t3 += w * uu * u
            t4 += w * uu * uu
            t5 += w * a
            t6 += w * u * a
            t7 += w * a * a
            t8 += w * v
            t9 += w * u * v
            t10 += w * uu * v
            t11 += w * a * v
            t12 += w * v * v
            if k == low:
                from_u = u
            to_u = u
        sums = (t0, t1, t2, t3, t4, t5, t6, t7, t8, t9, t10, t11, t12)
        q0, q1, q2, rms, free, corner = _fitted(sums, high - low, tolerance_m)
        if free == 0:
            return none
        along = 0.0
        for _ in range(3):
            off = distance_m + q0 + (q1 + q2 * along) * along
            slope = q1 + 2.0 * q2 * along
            rise = 1.0 + slope * slope + 2.0 * q2 * off
            if rise < 0.1:
                return none
            along -= (along + off * slope) / rise
        off = distance_m + q0 + (q1 + q2 * along) * along
        pitch = off * step
        inside = from_u - pitch <= along <= to_u + pitch
        distance_m = math.hypot(along, off)
        bearing_rad += math.atan2(along, off)
        curvature = q2
        if before == (low, high):
            break
    if corner or not inside or rms > _largest_rms(tolerance_m, free):
        return none
    return distance_m, _angle(bearing_rad), low, high - 1


@compiled
def find_walls(scan: np.ndarray, reach_m: float, tolerance_m: float) -> np.ndarray:
    """Do as :func:`walls_in_scan` for a checked scan with something near, by plain loops.

    Returns:
        Distance, bearing, and first and last beam on each wall, ``(m, 4)``, in any order.
    """
    n = scan.shape[0]
    step, pad = TWO_PI / n, n // 3
    m = n + 2 * pad
    xy, sums = np.zeros((2, m)), np.zeros((6, m + 1))
    seen, starts = np.zeros(m, np.bool_), np.zeros(m, np.bool_)
    first, last = np.zeros(m, np.int64), np.zeros(m, np.int64)
    for at in range(m):
        k = (at - pad) % n
        here, before = scan[k], scan[k - 1 if k else n - 1]
        seen[at] = here < np.inf
        starts[at] = not (seen[at] and before < np.inf)
        if seen[at]:
            xy[0, at], xy[1, at] = here * math.cos(step * k), here * math.sin(step * k)
        if not starts[at]:
            edge = 5.0 * tolerance_m + 4.0 * step * min(here, before)
            starts[at] = abs(here - before) > edge
        first[at] = at if starts[at] or at == 0 else first[at - 1]
        x, y = xy[0, at], xy[1, at]
        sums[0, at + 1] = sums[0, at] + (1.0 if seen[at] else 0.0)
        sums[1, at + 1], sums[2, at + 1] = sums[1, at] + x, sums[2, at] + y
        sums[3, at + 1], sums[4, at + 1] = sums[3, at] + x * x, sums[4, at] + x * y
        sums[5, at + 1] = sums[5, at] + y * y
    end = m - 1
    for at in range(m - 1, -1, -1):
        last[at] = end
        if starts[at]:
            end = at - 1
    residual, distance, bearing = np.empty(n), np.zeros(n), np.zeros(n)
    farthest = math.hypot(reach_m, _WINDOW_M) + _OUTLIER * tolerance_m
    for k in range(n):
        residual[k] = np.inf
        if not scan[k] <= farthest:
            continue
        r, at = max(scan[k], tolerance_m), pad + k
        half = min(max(math.ceil(math.atan(_WINDOW_M / r) / step), 2), n // 5)
        low, high = max(at - half, first[at]), min(at + half, last[at])
        count = max(sums[0, high + 1] - sums[0, low], 1.0)
        x, y = (
            (sums[1, high + 1] - sums[1, low]) / count,
            (sums[2, high + 1] - sums[2, low]) / count,
        )
        xx = (sums[3, high + 1] - sums[3, low]) / count - x * x
        xy2 = 2.0 * ((sums[4, high + 1] - sums[4, low]) / count - x * y)
        yy = (sums[5, high + 1] - sums[5, low]) / count - y * y
        normal = 0.5 * (math.atan2(xy2, xx - yy) + math.pi)
        d = x * math.cos(normal) + y * math.sin(normal)
        least = 0.5 * (xx + yy - math.hypot(xx - yy, xy2))
        bearing[k], distance[k] = normal + (math.pi if d < 0.0 else 0.0), abs(d)
        free = max(count - 2.0, 1.0)
        rms = math.sqrt(max(least, 0.0) * count / free)
        off = abs(_angle(bearing[k] - step * (0.5 * (low + high) - pad)))
        if (
            count >= _MIN_POINTS and rms <= _largest_rms(tolerance_m, free)
            and abs(d) <= reach_m + 2.0 * tolerance_m and off <= step * (0.5 * (high - low) + 0.5)
        ):  # fmt: skip
            residual[k] = rms
    found, n_found, reach = np.empty((n, 4)), 0, n // 3
    while True:
        seed = 0
        for k in range(n):
            if residual[k] < residual[seed]:
                seed = k
        if residual[seed] == np.inf:
            return found[:n_found]
        at = pad + seed
        start, stop = int(max(first[at], at - reach)), int(min(last[at], at + reach)) + 1
        off_m, towards, low, high = _grown(
            xy, start, stop, at, distance[seed], bearing[seed], tolerance_m, step
        )
        if off_m < 0.0 or off_m > reach_m:
            for k in range(seed - 1, seed + 2):
                residual[k % n] = np.inf
            continue
        for k in range(low - pad, high + 1 - pad):
            residual[k % n] = np.inf
        new = True
        for other in range(n_found):
            o_bearing, o_low, o_high = found[other, 1], found[other, 2], found[other, 3]
            mine = (towards / TWO_PI * n + n // 3 - o_low + 0.5) % n <= o_high - o_low + 1
            its = (o_bearing / TWO_PI * n + n // 3 - low + 0.5) % n <= high - low + 1
            if abs(_angle(towards - o_bearing)) < _SAME_RAD and (mine or its):
                new = False
        if new:
            found[n_found, 0], found[n_found, 1] = off_m, towards
            found[n_found, 2], found[n_found, 3] = low, high
            n_found += 1
