r"""Fusion of several measurements of one quantity, weighted by their variances.

.. math:: \hat x = \frac{\sum_i x_i / \sigma_i^2}{\sum_i 1 / \sigma_i^2}, \qquad
          \hat\sigma^2 = \frac{1}{\sum_i 1 / \sigma_i^2}

A measurement that differs by more than 4 standard deviations from the most accurate one is left
out: a wheel that slips, or a view that moves with the robot.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple, Self

_GATE = 4.0


class Measured(NamedTuple):
    """A measurement and its standard deviation; infinite: it says nothing."""

    value: float
    sigma: float

    def times(self, factor: float) -> Self:
        """Return the measurement in another unit."""
        return type(self)(self.value * factor, self.sigma * abs(factor))

    def widened(self, share: float) -> Self:
        """Return it with a further error, independent of its own, as a share of its value."""
        return type(self)(self.value, math.hypot(self.sigma, share * self.value))


def fused(measurements: Sequence[Measured]) -> Measured | None:
    """Return the mean of measurements, weighted by their variances.

    Args:
        measurements: Of one quantity, in one unit; their standard deviations are above 0.

    Returns:
        ``None`` if there is none that says anything.

    Example:
        >>> fused([Measured(1.0, 0.1), Measured(1.3, 0.2)])
        Measured(value=1.06, sigma=0.08944271909999159)
        >>> fused([Measured(1.0, 0.1), Measured(9.0, 0.2)]).value  # more than 4 sigma away
        1.0
    """
    known = [m for m in measurements if math.isfinite(m.sigma)]
    if not known:
        return None
    best = min(known, key=lambda m: m.sigma)
    kept = [
        m for m in known if abs(m.value - best.value) <= _GATE * math.hypot(m.sigma, best.sigma)
    ]
    weight = sum(m.sigma**-2 for m in kept)
    return Measured(sum(m.value * m.sigma**-2 for m in kept) / weight, weight**-0.5)
