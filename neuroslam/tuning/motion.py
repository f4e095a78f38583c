r"""How wide the camera sees and how fast it goes, told from loops and without truth.

Who comes back to a place, looking as before, has turned by whole turns. So of all fields of view
:math:`f` that is taken for which the turns :math:`\Delta\theta` of all revisits do this best,

.. math:: \min_f \; \operatorname{mean} \bigl(1 - \cos(f\, \Delta s / w)\bigr)

with :math:`\Delta s` the pixels that the picture moved sideways in between, and :math:`w` its
width. One camera cannot tell metres: speeds are scaled so that a view lasts as long as a place.
"""

from itertools import pairwise
from typing import NamedTuple

import cv2
import numpy as np

from neuroslam.config.sections import Region
from neuroslam.odometry.visual import column_sums, match_profiles

FIELDS_OF_VIEW_DEG = np.arange(40.0, 181.0, 1.0)

_AS_GOOD = 0.05


class Shifts(NamedTuple):
    """What visual odometry measures in a region, before it is scaled.

    Attributes:
        region: ``x_min, x_max, y_min, y_max`` in px.
        shift_px: Offset to the picture before, ``(n,)``; the first is 0.
        difference: Smallest difference there, grey in [0, 1], ``(n,)``; the first is 0.
    """

    region: Region
    shift_px: np.ndarray
    difference: np.ndarray


class FieldOfView(NamedTuple):
    r"""A field of view and how well the turns of loops agree with it.

    Attributes:
        fov_deg: The best.
        error: Mean of :math:`1 - \cos` of the turns, for each of ``tried_deg``.
        shifts: The region it was measured in.
    """

    fov_deg: float
    error: np.ndarray
    shifts: Shifts

    @property
    def tried_deg(self) -> np.ndarray:
        """The fields of view that were compared."""
        return FIELDS_OF_VIEW_DEG


def measure_shifts(pictures: np.ndarray, region: Region, max_shift: int) -> Shifts:
    """Match each picture with the one before it, as visual odometry does.

    Args:
        pictures: In order, grey ``uint8``, ``(n, h, w)``.
        region: Part of them that is looked at.
        max_shift: Offsets tried, px.
    """
    sums = [column_sums(picture, region) for picture in pictures]
    pairs = [match_profiles(b, a, max_shift) for a, b in pairwise(sums)]
    found = np.array([(0, 0.0), *pairs])
    return Shifts(region, found[:, 0], found[:, 1] / (255.0 * (region[3] - region[2])))


def field_of_view(shifts: Shifts, width: int, revisits: np.ndarray) -> FieldOfView | None:
    """Find the field of view for which loops close in heading.

    Args:
        shifts: Of the whole drive.
        width: Of the pictures, px.
        revisits: Pairs of frames that show one place, ``(m, 2)``.

    Returns:
        The smallest of the best; ``None`` if loops hold no turn to tell it from.
    """
    turned = np.cumsum(shifts.shift_px) / width
    turned = turned[revisits[:, 1]] - turned[revisits[:, 0]]
    turns = np.outer(np.deg2rad(FIELDS_OF_VIEW_DEG), turned)
    error = (1.0 - np.cos(turns)).mean(axis=1)
    if np.abs(turns).mean() < 1.0:  # a figure of eight: any field of view closes it
        return None
    smooth = cv2.blur(error[:, None], (1, 5), borderType=cv2.BORDER_REPLICATE)[:, 0]
    # Twice the true one would turn every lap by two whole turns: the first good one is the true.
    first = int(np.argmax(smooth <= smooth.min() + _AS_GOOD))
    valley = first + int(np.argmax(np.diff(smooth[first:], append=np.inf) >= 0.0))
    return FieldOfView(float(FIELDS_OF_VIEW_DEG[valley]), error, shifts)
