r"""Displacement of a camera over a flat floor: the floor before it is laid over that of before.

A pixel below the horizon shows the floor at a known place if the height and the tilt of the camera
are known. After a turn by :math:`\varphi` and a displacement :math:`d` along the bisector of the
two headings the same place is at another pixel; with :math:`u(i, d)` for it,

.. math:: d = \arg\min_d \sum_i \rho(I_2(u(i, d)) - I_1(u_i))

over the pixels of a strip straight ahead; :math:`\rho` is bounded, so that things on the floor do
not count. A search over the whole range of speeds is refined by iteratively reweighted least
squares (Gauss-Newton), for bands of the strip from near to far. The first band that differs from
those before it is a wall that begins there, whose displacement would be too large.
"""

import math
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np

from neuroslam.odometry.fusion import Measured, fused

_HALF_WIDTH = 0.6  # of the strip, in heights of the camera
_SLOPE = 0.12  # of the farthest row, below the horizon
_MOST_PIXELS = 1500
_MOST_TRIALS = 64
_BACKWARD = 0.25  # share of the search that is backward
_STEP_PX = 0.5  # of the search, in the nearest row
_LEVELS = 6.0  # difference in grey levels beyond which a pixel is no floor
_SMOOTH_PX = 0.7
_LOCAL_PX = 9  # width of the mean that is subtracted, so that light does not count
_ITERATIONS = 6
_ALIKE = 25.0  # pixels that share one independent residual
_BANDS = 4  # parts of the strip, from near to far
_APART = 2.0  # standard deviations by which two of them may differ on a floor
_ALONE = 0.2  # share by which the nearest is uncertain if the next one differs


class Strip(NamedTuple):
    """Pixels of the floor straight ahead.

    Attributes:
        row: Of each pixel, ``float32 (n,)``.
        column: The same.
        ahead: Place on the floor in heights of the camera, forward, ``(n,)``.
        left: And to the left.
        focal_px: Focal length.
        nearest: Place of the nearest pixel, forward.
    """

    row: np.ndarray
    column: np.ndarray
    ahead: np.ndarray
    left: np.ndarray
    focal_px: float
    nearest: float


@lru_cache(maxsize=8)
def strip_of(height: int, width: int, focal_px: float, tilt_rad: float) -> Strip:
    """Return the pixels of the floor straight ahead, for a camera whose image is a plane.

    Args:
        height: Of the image in px.
        width: Likewise.
        focal_px: Focal length in px.
        tilt_rad: Tilt of the camera downwards.

    Example:
        >>> strip = strip_of(60, 80, 40.0, 0.0)
        >>> round(strip.nearest, 2), bool(strip.row.min() > 30)
        (1.36, True)
    """
    rows, columns = np.mgrid[0:height, 0:width].astype(np.float64)
    x = (columns + 0.5 - 0.5 * width) / focal_px
    y = (rows + 0.5 - 0.5 * height) / focal_px
    down = y * math.cos(tilt_rad) + math.sin(tilt_rad)
    z = math.cos(tilt_rad) - y * math.sin(tilt_rad)
    inside = (down > _SLOPE * z) & (z > 0.0) & (np.abs(x) < _HALF_WIDTH * down)
    at = np.flatnonzero(inside)
    at = at[:: max(1, -(-len(at) // _MOST_PIXELS))]
    x, down, z = (each.reshape(-1)[at] for each in (x, down, z))
    ahead, left = z / down, -x / down
    row, column = (each.reshape(-1)[at].astype(np.float32) for each in (rows, columns))
    nearest = float(ahead.min()) if len(at) else math.inf
    return Strip(row, column, ahead, left, focal_px, nearest)


def floor_motion(
    before: np.ndarray,
    now: np.ndarray,
    turn_rad: float,
    focal_px: float,
    tilt_rad: float,
    largest: float,
) -> Measured | None:
    """Return the displacement along the bisector of the headings, in heights of the camera.

    Args:
        before: Grey image, ``uint8 (h, w)``.
        now: The next one, of the same size.
        turn_rad: Turn to the left between them.
        focal_px: Focal length in px.
        tilt_rad: Tilt of the camera downwards.
        largest: Largest displacement forward that is searched for.

    Returns:
        Displacement and its standard deviation; ``None`` where the floor is not visible, or has no
        texture.

    Example:
        >>> floor = np.random.default_rng(0).integers(0, 255, (60, 80)).astype(np.uint8)
        >>> floor = cv2.GaussianBlur(floor, (0, 0), 2.0)
        >>> round(floor_motion(floor, floor, 0.0, 40.0, 0.0, 0.5).value, 3)
        0.0
    """
    strip = strip_of(*before.shape, focal_px, tilt_rad)
    if len(strip.row) < 50:
        return None
    first, second = _flattened(before), _flattened(now)
    grey = first[strip.row.astype(int), strip.column.astype(int)]
    half = 0.5 * turn_rad
    # Places in the axes of the bisector: turned back by half of the turn.
    ahead = math.cos(half) * strip.ahead + math.sin(half) * strip.left
    left = math.cos(half) * strip.left - math.sin(half) * strip.ahead

    def seen(moved: np.ndarray, some: slice | np.ndarray) -> np.ndarray:
        """Return the grey levels of places after each displacement, ``(k, n)``; NaN: none."""
        at = ahead[None, some] - moved[:, None]
        z = math.cos(half) * at + math.sin(half) * left[some]
        side = math.cos(half) * left[some] - math.sin(half) * at
        depth = z * math.cos(tilt_rad) + math.sin(tilt_rad)
        down = math.cos(tilt_rad) - z * math.sin(tilt_rad)
        visible = depth > 0.05
        depth = np.where(visible, depth, 1.0)
        column = 0.5 * before.shape[1] - 0.5 - focal_px * side / depth
        row = 0.5 * before.shape[0] - 0.5 + focal_px * down / depth
        visible &= (row >= 0) & (row <= before.shape[0] - 1)
        visible &= (column >= 0) & (column <= before.shape[1] - 1)
        values = cv2.remap(
            second, column.astype(np.float32), row.astype(np.float32), cv2.INTER_LINEAR
        )
        return np.where(visible, values, np.nan)

    step = _STEP_PX * strip.nearest**2 / focal_px
    n = min(math.ceil(largest / step), _MOST_TRIALS)
    trials = step * np.arange(-math.ceil(_BACKWARD * n), n + 1)
    apart = np.minimum(np.abs(seen(trials, slice(None)) - grey), _LEVELS)
    total, bands = None, 0
    for band in np.array_split(np.argsort(strip.ahead), _BANDS):  # from near to far
        known = np.isfinite(apart[:, band]).sum(axis=1)
        cost = np.nansum(apart[:, band], axis=1) / np.maximum(known, 1)
        cost[known < 0.5 * len(band)] = np.inf
        if not np.isfinite(cost).any():
            continue
        start = float(trials[cost.argmin()])
        one = _refined(lambda moved, band=band: seen(moved, band), grey[band], start, step)
        if one is None:
            continue
        if total is not None:
            if abs(one.value - total.value) > _APART * math.hypot(one.sigma, total.sigma):
                return total.widened(_ALONE) if bands == 1 else total  # a wall begins here
            one = fused([total, one])
        total, bands = one, bands + 1
    return total


def _refined(
    seen: Callable[[np.ndarray], np.ndarray], grey: np.ndarray, start: float, step: float
) -> Measured | None:
    """Refine a displacement by Gauss-Newton steps, weighted by Tukey's function."""
    found, small = start, 0.25 * step
    for _ in range(_ITERATIONS):
        low, at, high = seen(np.array([found - small, found, found + small]))
        slope, residual = (high - low) / (2.0 * small), at - grey
        unknown = ~(np.isfinite(slope) & np.isfinite(residual))
        slope[unknown] = residual[unknown] = 0.0
        weight = np.maximum(1.0 - (residual / _LEVELS) ** 2, 0.0) ** 2
        weight[unknown] = 0.0
        information = float((weight * slope * slope).sum())
        if not information > 0.0:
            return None
        change = -float((weight * slope * residual).sum()) / information
        found += min(max(change, -step), step)
        if abs(change) < 1e-2 * step:
            break
    if abs(found - start) > 3.0 * step:
        return None
    scale = max(math.sqrt(float((weight * residual**2).sum() / weight.sum())), 0.3)
    return Measured(found, scale * math.sqrt(_ALIKE / information))


def _flattened(image: np.ndarray) -> np.ndarray:
    """Return an image without its local mean, ``float32``."""
    smooth = cv2.GaussianBlur(image, (0, 0), _SMOOTH_PX).astype(np.float32)
    return smooth - cv2.blur(smooth, (_LOCAL_PX, _LOCAL_PX))
