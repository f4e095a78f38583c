"""Hexagonal symmetry of rate maps: autocorrelogram, grid score, spacing and orientation."""

import math
from functools import lru_cache
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from neuroslam.errors import MapError
from neuroslam.evaluation.ratemap import label_regions

if TYPE_CHECKING:
    from scipy.sparse import csr_array

Unvisited = Literal["skip", "silent"]

MIN_OVERLAP_BINS = 20
"""Fewest overlapping bins for a correlation: the autocorrelogram is NaN below."""

CENTRE_THRESHOLD = 0.2
"""Correlation at the edge of the central peak."""

MIN_SIDE_BINS = 10
"""Bins along the shorter side of a map that has a grid score."""

_REACH = 0.8  # rings end here, as a share of the map's shorter side: beyond, overlaps are small
_MEAN_OF_RADII = 3  # a high score at a single radius may be chance
_ANGLES_DEG = (60, 120, 30, 90, 150)
_MIN_VARIANCE = 1e-10  # of the map's own; below, an overlap is flat but for rounding
_CELLS_AT_ONCE = 16  # so many transforms fit into the processor's cache
_MIN_APART_RAD = math.radians(30.0)  # two of the six inner peaks are never nearer in angle


def autocorrelogram(maps: np.ndarray, unvisited: Unvisited = "skip") -> np.ndarray:
    r"""Correlate every map with itself, shifted by every whole number of bins.

    .. math:: r(\tau) = \frac{n \sum \lambda(x) \lambda(x - \tau)
              - \sum \lambda(x) \sum \lambda(x - \tau)}
              {\sqrt{n \sum \lambda(x)^2 - [\sum \lambda(x)]^2}
               \sqrt{n \sum \lambda(x - \tau)^2 - [\sum \lambda(x - \tau)]^2}}

    Eq. 13 of the SLRB paper, after F. Sargolini et al., Science 312, 2006: Pearson's correlation,
    every sum over the :math:`n` bins that were visited in both. (In print one :math:`n` is an
    :math:`M` and the last bracket lacks its sum.) All shifts at once by FFT.

    Args:
        maps: ``(..., n_y, n_x)``; NaN where unvisited.
        unvisited: ``skip`` leaves unvisited bins out, as the formula does. ``silent`` gives them
            the map's lowest rate; opexebo and BNT give them rate 0.

    Returns:
        ``(..., 2 n_y - 1, 2 n_x - 1)``, zero shift in the middle, in [-1, 1]. NaN where fewer than
        :data:`MIN_OVERLAP_BINS` bins overlap or nothing varies among them: a constant map is NaN
        throughout.

    Raises:
        MapError: If the maps are smaller than 10 by 10 bins, or infinite somewhere.

    Example:
        >>> stripes = np.tile([1.0, 0.0, 0.0, 0.0], (12, 3))
        >>> r = autocorrelogram(stripes)
        >>> r.shape, r[11, 11].round(6).item(), r[11, 15].round(6).item()
        ((23, 23), 1.0, 1.0)
    """
    maps = _as_maps("autocorrelogram", maps)
    stack = maps.reshape(-1, *maps.shape[-2:])
    parts = [
        _correlate(stack[start : start + _CELLS_AT_ONCE], unvisited)
        for start in range(0, len(stack), _CELLS_AT_ONCE)
    ]
    shape = tuple(2 * n - 1 for n in stack.shape[1:])
    return np.concatenate(parts).reshape(*maps.shape[:-2], *shape)


def gridness(maps: np.ndarray, unvisited: Unvisited = "silent") -> np.ndarray:
    r"""Return the grid score: the map's similarity to itself at 60 degrees minus that at 30.

    .. math:: \mathrm{HGS} = \min(c_{60}, c_{120}) - \max(c_{30}, c_{90}, c_{150})

    Eq. 14 of the SLRB paper; :math:`c_\beta` is Pearson's correlation of the autocorrelogram with
    itself turned by :math:`\beta`, over a ring. The ring begins at the edge of the central peak
    (radius :math:`\lfloor\sqrt{A/\pi}\rfloor` bins of the region above
    :data:`CENTRE_THRESHOLD`) and ends at every whole radius up to 0.8 of the shorter side; the
    score is the largest mean over three consecutive ends. These are the rules of R. F. Langston et
    al., Science 328, 2010, as implemented in opexebo and BNT (Kavli Institute, Trondheim).

    The default ``silent`` follows those too, so that scores can be compared. In a round arena it
    differs by up to 0.2 from ``skip``, which is Eq. 13 to the letter. Noise scores higher with
    ``skip``, as the rim of the autocorrelogram then rests on few bins: of 200 maps of smoothed
    noise one in twenty exceeded 0.56 in a circle and 0.60 in a triangle, against 0.15 and 0.51.

    Args:
        maps: ``(..., n_y, n_x)``; NaN where unvisited.
        unvisited: As in :func:`autocorrelogram`.

    Returns:
        ``(...,)`` in [-2, 2]: a hexagonal grid is above 1, a single field about 0, a square grid
        below 0. NaN where the map is constant (it has no autocorrelogram), or the central peak
        leaves no room for rings.

    Raises:
        MapError: As :func:`autocorrelogram`.

    Example:
        >>> y, x = np.mgrid[:60, :60]
        >>> waves = [x, x / 2 + y * 0.75**0.5, x / 2 - y * 0.75**0.5]
        >>> hexagons = sum(np.cos(2 * np.pi / 13 * wave) for wave in waves)
        >>> bool(gridness(hexagons) > 1.2)
        True
    """
    maps = _as_maps("gridness", maps)
    stack = maps.reshape(-1, *maps.shape[-2:])
    scores = [
        _score(_correlate(stack[start : start + _CELLS_AT_ONCE], unvisited))
        for start in range(0, len(stack), _CELLS_AT_ONCE)
    ]
    return np.concatenate(scores).reshape(maps.shape[:-2])


class GridStats(NamedTuple):
    """Spacing and orientation of a grid; all but the diameter are NaN without six inner peaks.

    Attributes:
        spacing_m: Mean distance of the six inner peaks of the autocorrelogram from its centre.
        orientation_rad: Their direction modulo 60 degrees, in (-pi/6, pi/6], counter-clockwise
            from the x axis.
        ellipticity: Longer over shorter axis of the ellipse through the six; 1 is a circle.
        field_diameter_m: Diameter of the disc with the area of the autocorrelogram's central peak
            above :data:`CENTRE_THRESHOLD`; larger than that of a firing field.
        peaks_m: The six peaks, counter-clockwise from the first above the x axis, ``(6, 2)``.
    """

    spacing_m: float
    orientation_rad: float
    ellipticity: float
    field_diameter_m: float
    peaks_m: np.ndarray


def grid_stats(rate_map: np.ndarray, bin_m: float, unvisited: Unvisited = "skip") -> GridStats:
    """Measure a grid by the six inner peaks of its autocorrelogram.

    Peaks are the nearest maxima outside the central peak, at least 30 degrees apart in direction,
    refined to a fraction of a bin by a parabola. Any map with three pairs of peaks has these
    numbers; :func:`gridness` measures whether it is a grid.

    Args:
        rate_map: ``(n_y, n_x)``; NaN where unvisited.
        bin_m: Side of a bin.
        unvisited: As in :func:`autocorrelogram`; ``silent`` moves the peaks towards the centre.

    Raises:
        MapError: As :func:`autocorrelogram`, or if there is more than one map.

    Example:
        >>> y, x = np.mgrid[:60, :60]
        >>> waves = [x, x / 2 + y * 0.75**0.5, x / 2 - y * 0.75**0.5]
        >>> hexagons = sum(np.cos(2 * np.pi / 13 * wave) for wave in waves)
        >>> stats = grid_stats(hexagons, bin_m=0.02)  # 13 bins between crests, 15 between fields
        >>> round(stats.spacing_m, 2), round(stats.ellipticity, 1)
        (0.3, 1.0)
    """
    rate_map = _as_maps("grid_stats", rate_map)
    if rate_map.ndim != 2:
        raise MapError(f"grid_stats: got maps of shape {rate_map.shape}, expected one (n_y, n_x)")
    r = _correlate(rate_map[None], unvisited)[0]
    area = _centre_area(r[None])[0]
    diameter = 2.0 * math.sqrt(area / math.pi) * bin_m if area else math.nan
    pairs = _inner_pairs(r, math.sqrt(area / math.pi))
    if len(pairs) < 3:
        return GridStats(math.nan, math.nan, math.nan, diameter, np.full((6, 2), np.nan))
    x, y = pairs.T
    # Three pairs fix the ellipse a x^2 + b x y + c y^2 = 1; its axes are the matrix's eigenvalues.
    a, b, c = np.linalg.solve(np.column_stack([x * x, x * y, y * y]), np.ones(3))
    low, high = np.linalg.eigvalsh([[a, b / 2], [b / 2, c]])
    angles = np.arctan2(y, x)
    peaks = np.concatenate([pairs[np.argsort(angles)], -pairs[np.argsort(angles)]]) * bin_m
    return GridStats(
        spacing_m=float(np.hypot(x, y).mean() * bin_m),
        orientation_rad=float(np.angle(np.exp(6j * angles).sum()) / 6.0),
        ellipticity=math.sqrt(high / low) if low > 0.0 else math.nan,
        field_diameter_m=diameter,
        peaks_m=peaks,
    )


def _as_maps(who: str, maps: np.ndarray) -> np.ndarray:
    maps = np.asarray(maps, dtype=np.float64)
    if maps.ndim < 2 or maps.size == 0 or min(maps.shape[-2:]) < MIN_SIDE_BINS:
        raise MapError(
            f"{who}: maps have shape {maps.shape}, expected (..., n_y, n_x), each side at least "
            f"{MIN_SIDE_BINS} bins; take smaller bins or a larger arena"
        )
    if np.isinf(maps).any():
        raise MapError(f"{who}: a rate is infinite; expected finite rates, NaN where unvisited")
    return maps


def _correlate(maps: np.ndarray, unvisited: Unvisited) -> np.ndarray:
    """Eq. 13 for ``(N, n_y, n_x)``."""
    from scipy import fft  # slow to import, not always needed

    visited = np.isfinite(maps)
    if unvisited == "silent":
        lowest = np.where(visited, maps, np.inf).min(axis=(1, 2), keepdims=True)
        maps = np.where(visited, maps, lowest)
        visited = np.isfinite(maps)  # all, but for a map without one visited bin
    elif unvisited != "skip":
        raise MapError(f"autocorrelogram: unvisited is {unvisited!r}, expected 'skip' or 'silent'")
    if (visited == visited[:1]).all():
        visited = visited[:1]  # one arena: its transform is needed once
    standard = _standardise(maps, visited)

    full = tuple(2 * n - 1 for n in maps.shape[1:])
    padded = tuple(fft.next_fast_len(n, real=True) for n in full)
    shift = tuple(n - 1 for n in maps.shape[1:])

    def transform(values: np.ndarray) -> np.ndarray:
        return np.asarray(fft.rfft2(values, padded))

    def over_shifts(product: np.ndarray) -> np.ndarray:
        wrapped = np.asarray(fft.irfft2(product, padded, overwrite_x=True))
        return np.roll(wrapped, shift, axis=(1, 2))[:, : full[0], : full[1]]

    of_mask = transform(visited.astype(np.float64))
    of_map = transform(standard)
    of_square = transform(standard * standard)
    n = np.rint(over_shifts(of_mask * of_mask.conj()))
    # The sums over the shifted map are those over the map itself for the opposite shift.
    total = over_shifts(of_map * of_mask.conj())
    variance = n * over_shifts(of_square * of_mask.conj()) - total * total
    r = n * over_shifts(of_map * of_map.conj()) - total * total[:, ::-1, ::-1]
    enough = (n >= MIN_OVERLAP_BINS) & (variance > _MIN_VARIANCE * n * n)
    enough = enough & enough[:, ::-1, ::-1]
    deviation = np.sqrt(np.where(enough, variance, 1.0))
    r /= deviation * deviation[:, ::-1, ::-1]
    return np.where(enough, np.clip(r, -1.0, 1.0), np.nan)


def _standardise(maps: np.ndarray, visited: np.ndarray) -> np.ndarray:
    """Scale to mean 0 and deviation 1 over the visited bins, 0 elsewhere; a constant map gives 0.

    Eq. 13 does not depend on it, but its rounding errors do.
    """
    count = np.maximum(visited.sum(axis=(1, 2), keepdims=True), 1)
    largest = np.where(visited, np.abs(maps), 0.0).max(axis=(1, 2), keepdims=True)
    scaled = np.where(visited, maps, 0.0) / np.where(largest > 0.0, largest, 1.0)
    centred = np.where(visited, scaled - scaled.sum(axis=(1, 2), keepdims=True) / count, 0.0)
    deviation = np.sqrt((centred**2).sum(axis=(1, 2), keepdims=True) / count)
    varies = deviation > 1e-12
    return np.where(varies, centred / np.where(varies, deviation, 1.0), 0.0)


def _centre_area(r: np.ndarray) -> np.ndarray:
    """Bins in the central peak of ``(N, rows, columns)``; 0 where there is no autocorrelogram."""
    labels = label_regions(r > CENTRE_THRESHOLD)[0]  # NaN is not above
    centre = labels[:, r.shape[1] // 2, r.shape[2] // 2][:, None, None]
    return np.sum((labels == centre) & (centre > 0), axis=(1, 2))


class _Rings(NamedTuple):
    """The ring bins of an autocorrelogram's upper half, sorted by radius."""

    bins: np.ndarray  # flat index of every bin
    starts: np.ndarray  # where each whole radius begins among them
    turned: "csr_array"  # bilinear weights, (5 turns x bins, all bins)


@lru_cache(maxsize=8)
def _rings(rows: int, columns: int) -> _Rings:
    """Sort the bins by radius: those at a distance in (k - 1, k] have radius k = 1, 2, ....

    The autocorrelogram is symmetric under a turn of 180 degrees, so its upper half is enough.
    """
    from scipy.sparse import csr_array, vstack

    y, x = np.mgrid[:rows, :columns]
    y, x = y - rows // 2, x - columns // 2
    radius = np.ceil(np.hypot(x, y)).astype(np.int64)
    n_radii = int(_REACH * (min(rows, columns) + 1) / 2)
    used = (radius >= 1) & (radius <= n_radii) & ((y > 0) | ((y == 0) & (x > 0)))
    flat = np.flatnonzero(used)
    flat = flat[np.argsort(radius.ravel()[flat], kind="stable")]
    starts = np.searchsorted(radius.ravel()[flat], np.arange(1, n_radii + 1))
    at_x, at_y = x.ravel()[flat], y.ravel()[flat]
    turns = []
    for angle in np.deg2rad(_ANGLES_DEG):
        column = np.cos(angle) * at_x - np.sin(angle) * at_y + columns // 2
        row = np.sin(angle) * at_x + np.cos(angle) * at_y + rows // 2
        turns.append(_bilinear(row, column, rows, columns))
    return _Rings(flat, starts, csr_array(vstack(turns)))


def _bilinear(row: np.ndarray, column: np.ndarray, rows: int, columns: int) -> "csr_array":
    """Weights of the four bins around every point, ``(points, rows x columns)``."""
    from scipy.sparse import csr_array

    row, column = row.round(9), column.round(9)  # a point on a bin needs no neighbour
    low_row, low_column = np.floor(row).astype(np.int64), np.floor(column).astype(np.int64)
    points, indices, weights = [], [], []
    for up in (0, 1):
        for right in (0, 1):
            weight = np.abs(1 - up - (row - low_row)) * np.abs(1 - right - (column - low_column))
            keep = np.flatnonzero(weight > 0.0)
            points.append(keep)
            indices.append((low_row[keep] + up) * columns + low_column[keep] + right)
            weights.append(weight[keep])
    where = (np.concatenate(points), np.concatenate(indices))
    return csr_array((np.concatenate(weights), where), shape=(len(row), rows * columns))


def _score(r: np.ndarray) -> np.ndarray:
    """Eq. 14 for autocorrelograms ``(N, rows, columns)``."""
    n_cells, rows, columns = r.shape
    rings = _rings(rows, columns)
    flat = np.ascontiguousarray(r.reshape(n_cells, -1).T)
    here = flat[rings.bins]
    turned = (rings.turned @ flat).reshape(len(_ANGLES_DEG), *here.shape)
    valid = np.isfinite(here) & np.isfinite(turned)
    a, b = np.where(valid, here, 0.0), np.where(valid, turned, 0.0)
    products = (valid.astype(np.float64), a, b, a * a, b * b, a * b)
    # Sums up to every radius, from 0; a ring is the difference of two of them.
    sums = np.zeros((6, len(_ANGLES_DEG), len(rings.starts) + 1, n_cells))
    for upto, product in zip(sums, products, strict=True):
        np.cumsum(np.add.reduceat(product, rings.starts, axis=1), axis=1, out=upto[:, 1:])
    inner = np.floor(np.sqrt(_centre_area(r) / np.pi)).astype(np.int64)
    inside = np.minimum(inner, len(rings.starts))[None, None, None]
    n, a, b, aa, bb, ab = sums - np.take_along_axis(sums, inside, axis=2)
    spread_a, spread_b = n * aa - a * a, n * bb - b * b
    floor = 1e-12 * n * n
    varies = (spread_a > floor) & (spread_b > floor)
    norm = np.sqrt(np.where(varies, spread_a * spread_b, 1.0))
    c = np.where(varies, (n * ab - a * b) / norm, np.nan)
    scores = c[:2].min(axis=0) - c[2:].max(axis=0)
    outer = np.arange(len(scores))[:, None]
    scores = np.where((outer > inner) & (inner > 0), scores, np.nan)
    windows = len(scores) - _MEAN_OF_RADII + 1
    means = sum(scores[k : k + windows] for k in range(_MEAN_OF_RADII)) / _MEAN_OF_RADII
    best = np.where(np.isnan(means), -np.inf, means).max(axis=0)
    return np.where(np.isfinite(best), best, np.nan)


def _inner_pairs(r: np.ndarray, centre_radius: float) -> np.ndarray:
    """Up to three peaks ``(x, y)`` of the upper half, in bins; the other three lie opposite."""
    from scipy import ndimage

    rows, columns = r.shape
    filled = np.where(np.isfinite(r), r, -np.inf)
    # A peak is the highest within half the radius of a field, so ripples within a field are none.
    size = 2 * max(1, round(centre_radius / 2)) + 1
    is_peak = (filled == ndimage.maximum_filter(filled, size)) & (filled > 0.0)
    is_peak[[0, -1]] = is_peak[:, [0, -1]] = False
    row, column = np.nonzero(is_peak)
    y, x = row - rows // 2, column - columns // 2
    distance = np.hypot(x, y)
    keep = (distance > centre_radius) & (distance <= _REACH * (min(rows, columns) + 1) / 2)
    keep &= (y > 0) | ((y == 0) & (x > 0))
    order = np.flatnonzero(keep)[np.argsort(distance[keep], kind="stable")]
    pairs: list[np.ndarray] = []
    directions: list[float] = []
    for i in order:
        direction = math.atan2(y[i], x[i])
        apart = [abs(math.remainder(direction - other, math.pi)) for other in directions]
        patch = r[row[i] - 1 : row[i] + 2, column[i] - 1 : column[i] + 2]
        if min(apart, default=math.pi) < _MIN_APART_RAD or not np.isfinite(patch).all():
            continue
        pairs.append(np.array([x[i], y[i]]) + _vertex(patch))
        directions.append(direction)
        if len(pairs) == 3:
            break
    return np.array(pairs).reshape(-1, 2)


def _vertex(patch: np.ndarray) -> np.ndarray:
    """Return the vertices of the parabolas in x and y through a maximum and its neighbours."""
    offset = []
    for before, at, after in (patch[1], patch[:, 1]):
        bend = before - 2.0 * at + after
        offset.append(0.5 * (before - after) / bend if bend < 0.0 else 0.0)
    return np.array(offset)
