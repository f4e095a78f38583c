"""Measures of tuning curves."""

import numpy as np


def tuning_width(curve: np.ndarray, level: float = 0.5) -> float:
    """Return the width of a tuning curve in degrees, between the two crossings of a level.

    Args:
        curve: Rates at directions evenly over the full turn, one peak, ``(n,)``.
        level: Share of the peak above the smallest rate, between 0 and 1.

    Example:
        >>> angle = np.arange(360) * np.pi / 180.0
        >>> round(tuning_width(1.0 + np.cos(angle)), 6)
        180.0
    """
    curve = np.asarray(curve, dtype=np.float64)
    n = len(curve)
    fine = np.fft.irfft(np.fft.rfft(curve), n=n * 64) * 64.0
    middle = len(fine) // 2
    fine = np.roll(fine, middle - int(fine.argmax()))
    height = fine.min() + level * (fine.max() - fine.min())
    below = np.flatnonzero(fine < height)  # the nearest on either side of the peak
    left_of, right_of = below[below < middle], below[below > middle]
    i = int(left_of[-1]) if len(left_of) else -1
    j = int(right_of[0]) if len(right_of) else len(fine)
    left, right = (
        k
        + step
        * (height - fine[k % len(fine)])
        / (fine[(k + step) % len(fine)] - fine[k % len(fine)])
        for k, step in ((i, 1), (j, -1))
    )
    return float((right - left) * 360.0 / len(fine))
