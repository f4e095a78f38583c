"""Bayesian decoding of position from spikes or rates."""

from typing import NamedTuple

import numpy as np

from neuroslam.errors import MapError
from neuroslam.evaluation.ratemap import Bins

_FLOOR = 1e-12
"""Rate of a silent bin, as in pynapple: a spike there is unlikely, not impossible."""

_ROWS = 4096  # times whose posterior is worked out at once


class Decoded(NamedTuple):
    """Decoded positions.

    Attributes:
        position_m: Centre of the most probable bin, ``(T, 2)``.
        probability: Its probability, ``(T,)``.
        mean_m: Mean of the posterior, ``(T, 2)``.
    """

    position_m: np.ndarray
    probability: np.ndarray
    mean_m: np.ndarray


def posterior(
    counts: np.ndarray, maps_hz: np.ndarray, dt_s: float, prior: np.ndarray | None = None
) -> np.ndarray:
    r"""Return the posterior of the position from spike counts in windows.

    .. math:: \log p(x \mid n) = \sum_i n_i \log \lambda_i(x) - \Delta t \sum_i \lambda_i(x)
              + \log p(x) + \text{const}

    for independent Poisson cells (K. Zhang, I. Ginzburg, B. L. McNaughton and T. J. Sejnowski,
    *J. Neurophysiol.* 79, 1998). As ``pynapple.decode_bayes``, but by one product of matrices: that
    function makes an array of times by bins by cells: 26 GB for ten minutes of 300 cells over 900
    bins at 20 Hz.

    Args:
        counts: Spikes in each window, ``(T, N)``; also rates times ``dt_s``.
        maps_hz: Rate maps, ``(N, ...)``; bins that are NaN in a map have probability 0.
        dt_s: Length of a window.
        prior: Probability of each bin before the spikes, of any scale; ``None``: uniform.

    Returns:
        ``(T, ...)``, sum 1 in each window.

    Raises:
        MapError: If the shapes do not fit, a count or rate is negative, or no bin is visited.

    Example:
        >>> maps = np.array([[10.0, 0.0], [0.0, 10.0]])  # two cells, two bins
        >>> posterior(np.array([[1, 0], [0, 2]]), maps, 0.1).round(6).tolist()
        [[1.0, 0.0], [0.0, 1.0]]
    """
    counts, maps = np.asarray(counts, np.float64), np.asarray(maps_hz, np.float64)
    flat = maps.reshape(len(maps), -1)
    usable = np.isfinite(flat).all(axis=0)
    before = np.ones(flat.shape[1]) if prior is None else np.asarray(prior, np.float64).ravel()
    if counts.ndim != 2 or counts.shape[1] != len(flat) or before.shape != flat.shape[1:]:
        raise MapError(
            f"posterior: counts {counts.shape}, maps {maps.shape}, prior {before.shape}; expected "
            "(T, N), (N, ...) and the shape of a map"
        )
    if (counts < 0.0).any() or (flat[:, usable] < 0.0).any() or not dt_s > 0.0:
        raise MapError("posterior: a count, rate or duration is negative; expected spikes and Hz")
    usable &= np.isfinite(before) & (before > 0.0)
    if not usable.any():
        raise MapError("posterior: no bin was visited by all cells' recordings; use larger bins")
    rates = flat[:, usable]
    constant = np.log(before[usable] / before[usable].sum()) - dt_s * rates.sum(axis=0)
    log = counts @ np.log(rates + _FLOOR) + constant
    log -= log.max(axis=1, keepdims=True)
    np.exp(log, out=log)
    log /= log.sum(axis=1, keepdims=True)
    found = np.zeros((len(counts), flat.shape[1]))
    found[:, usable] = log
    return found.reshape(len(counts), *maps.shape[1:])


def decode_position(
    counts: np.ndarray,
    maps_hz: np.ndarray,
    bins: Bins,
    dt_s: float,
    prior: np.ndarray | None = None,
) -> Decoded:
    """Decode the position in every window by :func:`posterior`; memory does not grow with time.

    Args:
        counts: Spikes in each window, ``(T, N)``; also rates times ``dt_s``.
        maps_hz: Rate maps ``(N, n_y, n_x)``.
        bins: The bins of the maps.
        dt_s: Length of a window.
        prior: As in :func:`posterior`.

    Raises:
        MapError: As :func:`posterior`, or if the maps are not over those bins.

    Example:
        >>> maps = np.array([[[10.0, 0.0]], [[0.0, 10.0]]])
        >>> decoded = decode_position([[3, 0]], maps, Bins(0.0, 0.0, 2, 1, 0.5), dt_s=0.1)
        >>> decoded.position_m.tolist()
        [[0.25, 0.25]]
    """
    counts, maps = np.asarray(counts, np.float64), np.asarray(maps_hz, np.float64)
    if maps.ndim != 3 or maps.shape[1:] != bins.shape:
        raise MapError(f"decode_position: maps {maps.shape}, expected (N, {bins.n_y}, {bins.n_x})")
    row, column = np.divmod(np.arange(bins.n_x * bins.n_y), bins.n_x)
    x = bins.x_min_m + (column + 0.5) * bins.bin_m
    y = bins.y_min_m + (row + 0.5) * bins.bin_m
    centres = np.column_stack([x, y])
    found: list[tuple[np.ndarray, ...]] = []
    for start in range(0, max(len(counts), 1), _ROWS):
        p = posterior(counts[start : start + _ROWS], maps, dt_s, prior)
        p = p.reshape(len(p), -1)
        best = p.argmax(axis=1)
        found.append((centres[best], p[np.arange(len(p)), best], p @ centres))
    return Decoded(*(np.concatenate(parts) for parts in zip(*found, strict=True)))
