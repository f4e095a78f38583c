"""Circular statistics: tuning to head direction, and locking of spikes to the phase of theta."""

from typing import NamedTuple

import numpy as np

from neuroslam.errors import MapError
from neuroslam.geometry import TWO_PI


class Direction(NamedTuple):
    r"""Mean direction of angles, and Rayleigh's test of uniformity.

    Attributes:
        mean_rad: Mean direction, in (-pi, pi].
        length: Mean vector length :math:`R`, in [0, 1].
        z: Rayleigh's :math:`n R^2`.
        p: Its probability if the angles were uniform.
    """

    mean_rad: float
    length: float
    z: float
    p: float


def mean_direction(angles_rad: np.ndarray, weights: np.ndarray | None = None) -> Direction:
    r"""Return the mean vector of angles, such as the phases of spikes, and Rayleigh's test.

    .. math:: R e^{i\mu} = \frac{\sum_k w_k e^{i\theta_k}}{\sum_k w_k}, \qquad z = n R^2, \qquad
              p = \exp\!\big(\sqrt{1 + 4n + 4(n^2 - R_n^2)} - (1 + 2n)\big)

    with :math:`n = \sum w` and :math:`R_n = nR` (J. H. Zar, *Biostatistical Analysis*, 1999). The
    test is of counts: weights should be numbers of spikes.

    Args:
        angles_rad: ``(n,)``.
        weights: Spikes at each angle, ``(n,)``, not negative; ``None``: one each.

    Raises:
        MapError: If the shapes differ, a number is not finite or negative, or there is no weight.

    Example:
        >>> mean_direction(np.array([0.0, np.pi / 2])).length.__round__(6)
        0.707107
    """
    angles = np.asarray(angles_rad, np.float64).ravel()
    w = np.ones_like(angles) if weights is None else np.asarray(weights, np.float64).ravel()
    n = float(w.sum())
    finite = np.isfinite(angles).all() and np.isfinite(w).all() and (w >= 0.0).all()
    if w.shape != angles.shape or not finite or n <= 0.0:
        raise MapError(
            f"mean_direction: {angles.size} angles and {w.size} weights that sum to {n:g}; "
            "expected as many, all finite, weights not negative and some above 0"
        )
    vector = complex((w * np.exp(1j * angles)).sum() / n)
    length = min(abs(vector), 1.0)
    exponent = np.sqrt(1.0 + 4.0 * n + 4.0 * n**2 * (1.0 - length**2)) - (1.0 + 2.0 * n)
    p = float(np.exp(min(exponent, 0.0)))
    return Direction(float(np.angle(vector)), length, n * length**2, p)


class HeadDirectionTuning(NamedTuple):
    """Tuning of cells to the head's direction; ``(N,)`` but for the curves.

    Attributes:
        bins_rad: Centres of the bins, ``(n_bins,)``.
        curves: Mean activity in each bin, ``(N, n_bins)``; NaN where the head never was.
        preferred_rad: Direction of the mean vector of the curve.
        length: Length of the mean vector of the curve, in [0, 1].
        peak: Largest value of the curve.
    """

    bins_rad: np.ndarray
    curves: np.ndarray
    preferred_rad: np.ndarray
    length: np.ndarray
    peak: np.ndarray


def head_direction_tuning(
    headings_rad: np.ndarray, activity: np.ndarray, n_bins: int = 60
) -> HeadDirectionTuning:
    r"""Return tuning curves over the head's direction, and their mean vectors.

    .. math:: R e^{i\mu} = \frac{\sum_b \lambda_b e^{i\theta_b}}{\sum_b \lambda_b}

    over the bins :math:`b` of the curve, so that directions in which the animal looked more often
    do not count more. For Rayleigh's test of spikes, see :func:`mean_direction`.

    Args:
        headings_rad: ``(T,)``.
        activity: Rates or counts, ``(T, N)``, or ``(T,)`` for one cell; not negative.
        n_bins: Bins over the full turn, from 0.

    Raises:
        MapError: If the shapes do not fit, or a heading is not finite.

    Example:
        >>> heading = np.linspace(0.0, 2.0 * np.pi, 3600, endpoint=False)
        >>> tuned = head_direction_tuning(heading, 1.0 + np.cos(heading - 1.0))
        >>> tuned.preferred_rad.round(2).tolist(), tuned.length.round(2).tolist()
        ([1.0], [0.5])
    """
    headings = np.asarray(headings_rad, np.float64)
    activity = np.asarray(activity, np.float64)
    activity = activity[:, None] if activity.ndim == 1 else activity
    if headings.ndim != 1 or len(activity) != len(headings) or not np.isfinite(headings).all():
        raise MapError(
            f"head_direction_tuning: headings {headings.shape}, activity {activity.shape}; "
            "expected finite (T,) and (T, N)"
        )
    at = np.minimum((headings % TWO_PI / TWO_PI * n_bins).astype(np.int64), n_bins - 1)
    counts = np.bincount(at, minlength=n_bins).astype(np.float64)
    sums = np.stack([np.bincount(at, cell, minlength=n_bins) for cell in activity.T])
    curves = np.divide(sums, counts, out=np.full(sums.shape, np.nan), where=counts > 0.0)
    bins = (np.arange(n_bins) + 0.5) * TWO_PI / n_bins
    rate = np.nan_to_num(curves)
    total = rate.sum(axis=1)
    vector = np.divide(
        rate @ np.exp(1j * bins), total, out=np.full(len(rate), np.nan + 0j), where=total > 0.0
    )
    peak = np.where(total > 0.0, rate.max(axis=1), 0.0)
    return HeadDirectionTuning(bins, curves, np.angle(vector), np.abs(vector), peak)
