"""Spatial selectivity of rate maps: sparsity, coherence and border score."""

import math
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from neuroslam.errors import MapError
from neuroslam.evaluation.ratemap import label_regions

_EIGHT = np.array([[1.0, 1.0, 1.0], [1.0, 0.0, 1.0], [1.0, 1.0, 1.0]])
_SPREAD = 1e-12  # relative variance below which a map is constant


def sparsity(maps: np.ndarray, occupancy: np.ndarray) -> np.ndarray:
    r"""Return the sparsity of each cell: the share of the arena in which it fires, so to say.

    .. math:: s = \frac{\big(\sum_x p(x) \lambda(x)\big)^2}{\sum_x p(x) \lambda(x)^2}

    By W. E. Skaggs, B. L. McNaughton, M. A. Wilson and C. A. Barnes, *Hippocampus* 6, 1996. A cell
    that fires at one rate in a share :math:`q` of the arena has :math:`s = q`.

    Args:
        maps: Rates, ``(N, n_y, n_x)`` or one ``(n_y, n_x)``; NaN where unvisited.
        occupancy: Time or samples per bin, ``(n_y, n_x)``, of any scale.

    Returns:
        ``(N,)``, in (0, 1]; NaN for a cell that never fires.

    Raises:
        MapError: If the shapes differ, or no visited bin has an occupancy.

    Example:
        >>> sparsity(np.array([[8.0, 0.0], [0.0, 0.0]]), np.ones((2, 2))).tolist()
        [0.25]
    """
    maps = _stack("sparsity", maps)
    weight = np.where(np.isfinite(maps), np.asarray(occupancy, np.float64), 0.0)
    if np.shape(occupancy) != maps.shape[1:] or not (weight.sum(axis=(1, 2)) > 0.0).all():
        raise MapError(
            f"sparsity: occupancy has shape {np.shape(occupancy)}; expected that of a map, "
            f"{maps.shape[1:]}, and time in a visited bin"
        )
    weight /= weight.sum(axis=(1, 2), keepdims=True)
    rate = np.nan_to_num(maps)
    mean, square = (weight * rate).sum(axis=(1, 2)), (weight * rate**2).sum(axis=(1, 2))
    return np.divide(mean**2, square, out=np.full(len(maps), np.nan), where=square > 0.0)


def coherence(maps: np.ndarray) -> np.ndarray:
    r"""Return the spatial coherence: the correlation of each bin's rate with its neighbours' mean.

    .. math:: c = \operatorname{corr}\Big(\lambda(x),\; \tfrac{1}{n_x}\sum_{x' \sim x} \lambda(x')
              \Big)

    over visited bins with at least one visited neighbour of eight (R. U. Muller and J. L. Kubie,
    *J. Neurosci.* 9, 1989, who print :math:`\operatorname{artanh} c`). Of maps that were not
    smoothed; smoothing raises it.

    Args:
        maps: Rates, ``(N, n_y, n_x)`` or one ``(n_y, n_x)``; NaN where unvisited.

    Returns:
        ``(N,)``, in [-1, 1]; NaN of a constant map.

    Example:
        >>> slope = np.tile(np.arange(6.0), (6, 1))
        >>> coherence(slope).round(2).tolist()
        [0.99]
    """
    maps = _stack("coherence", maps)
    values = np.full(len(maps), np.nan)
    for k, one in enumerate(maps):
        visited = np.isfinite(one)
        n = ndimage.convolve(visited.astype(np.float64), _EIGHT, mode="constant")
        around = ndimage.convolve(np.nan_to_num(one), _EIGHT, mode="constant")
        used = visited & (n > 0.5)
        if used.sum() > 1:
            values[k] = _correlation(one[used], around[used] / n[used])
    return values


class Border(NamedTuple):
    """Border scores, ``(N,)`` each.

    Attributes:
        score: :math:`b`, in [-1, 1]; NaN without a field.
        coverage: :math:`c_M`, the largest share of a wall along which one field lies.
        distance: :math:`d_m`, mean distance of the fields to the nearest wall, weighted by rate, as
            a share of half the shorter side.
    """

    score: np.ndarray
    coverage: np.ndarray
    distance: np.ndarray


def border_score(
    maps: np.ndarray, bin_m: float, threshold: float = 0.3, min_area_m2: float = 0.02
) -> Border:
    r"""Return the border scores of cells in a rectangle.

    .. math:: b = \frac{c_M - d_m}{c_M + d_m}

    By T. Solstad, C. N. Boccara, E. Kropff, M.-B. Moser and E. I. Moser, *Science* 322, 2008. A
    field is a connected region above a share of the cell's peak; the walls are the four edges of
    the map, whose outermost bins count as along the wall.

    Args:
        maps: Rates, ``(N, n_y, n_x)`` or one ``(n_y, n_x)``, from wall to wall; NaN where
            unvisited.
        bin_m: Side of a bin.
        threshold: Share of the peak; 0.3 in the paper.
        min_area_m2: Smallest field; 200 cm² in the paper.

    Raises:
        MapError: If ``bin_m`` is not positive.

    Example:
        >>> wall, middle = np.zeros((20, 20)), np.zeros((20, 20))
        >>> wall[:, 0] = middle[8:12, 8:12] = 1.0
        >>> border_score(np.stack([wall, middle]), 0.05).score.round(2).tolist()
        [0.9, -1.0]
    """
    maps = _stack("border_score", maps)
    if not (math.isfinite(bin_m) and bin_m > 0.0):
        raise MapError(f"border_score: bin_m is {bin_m:g}, expected a positive length in metres")
    filled = np.nan_to_num(maps)
    peak = filled.max(axis=(1, 2), keepdims=True)
    labels, n = label_regions((filled > threshold * peak) & (peak > 0.0))
    large = np.bincount(labels.ravel(), minlength=n + 1) * bin_m**2 >= min_area_m2
    large[0] = False
    labels = np.where(large[labels], labels, 0)
    n_y, n_x = maps.shape[1:]
    rows, columns = np.arange(n_y) + 0.5, np.arange(n_x) + 0.5
    to_wall = np.minimum(
        np.minimum(rows, n_y - rows)[:, None], np.minimum(columns, n_x - columns)[None]
    )
    to_wall /= min(n_y, n_x) / 2.0
    cover, away = np.full(len(maps), np.nan), np.full(len(maps), np.nan)
    for k, (of, rate) in enumerate(zip(labels, filled, strict=True)):
        if not of.any():
            continue
        walls = (of[0], of[-1], of[:, 0], of[:, -1])
        cover[k] = max(np.bincount(wall[wall > 0], minlength=1).max() / len(wall) for wall in walls)
        weight = np.where(of > 0, rate, 0.0)
        away[k] = (weight * to_wall).sum() / weight.sum()
    return Border((cover - away) / (cover + away), cover, away)


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    a, b = a - a.mean(), b - b.mean()
    both = float((a * a).sum() * (b * b).sum())
    scale = float(np.abs(a).max() * np.abs(b).max()) * len(a)
    return float((a * b).sum() / math.sqrt(both)) if both > _SPREAD * scale**2 > 0.0 else math.nan


def _stack(who: str, maps: np.ndarray) -> np.ndarray:
    maps = np.asarray(maps, dtype=np.float64)
    if maps.ndim not in (2, 3) or maps.size == 0:
        raise MapError(f"{who}: maps have shape {maps.shape}, expected (N, n_y, n_x), not empty")
    return maps.reshape(-1, *maps.shape[-2:])
