r"""Field of view and image motion of a camera, estimated from revisits without ground truth.

A robot that revisits a place with the same heading has turned by a multiple of the full turn. The
estimated field of view :math:`f` is the one for which the turns of all revisits agree best,

.. math:: J(f) = \operatorname{mean} \bigl(1 - \cos(f\, \Delta s / w)\bigr)

with :math:`\Delta s` the horizontal image shift in between, in pixels, and :math:`w` the width of
the picture. Where the image measures no net turn, :math:`J` falls to 0 at small :math:`f`: only a
valley, which rises on both sides, is an estimate.
"""

from itertools import pairwise
from typing import NamedTuple

import cv2
import numpy as np

from neuroslam.config.sections import Region
from neuroslam.odometry.visual import column_sums, match_profiles

FIELDS_OF_VIEW_DEG = np.arange(30.0, 201.0, 1.0)

_DEPTH = 0.3
"""Depth of a valley below its lower side, of at most 2."""

_MARGIN = 0.05
"""Difference of the errors of two valleys that are equally deep."""

_WORST = 0.5
"""Error of an estimate above which the turns of revisits contradict each other."""


class Shifts(NamedTuple):
    """Unscaled measurements of visual odometry in a region of the picture.

    Attributes:
        region: ``x_min, x_max, y_min, y_max`` in px.
        shift_px: Horizontal offset to the picture before, ``(n,)``; the first is 0.
        difference: Mean difference at that offset, grey in [0, 1], ``(n,)``; the first is 0.
    """

    region: Region
    shift_px: np.ndarray
    difference: np.ndarray


class FieldOfView(NamedTuple):
    r"""An estimated field of view and the error of all candidates.

    Attributes:
        fov_deg: The estimate.
        error: :math:`J` for each of ``FIELDS_OF_VIEW_DEG``.
        region: Region of the picture whose shifts were used, px.
    """

    fov_deg: float
    error: np.ndarray
    region: Region

    @property
    def tried_deg(self) -> np.ndarray:
        """The fields of view compared."""
        return FIELDS_OF_VIEW_DEG


def measure_shifts(pictures: np.ndarray, region: Region, max_shift: int) -> Shifts:
    """Match each picture with the one before it, as visual odometry does.

    Args:
        pictures: In order of time, grey ``uint8``, ``(n, h, w)``.
        region: Region of the pictures that is matched.
        max_shift: Largest offset, px.
    """
    sums = [column_sums(picture, region) for picture in pictures]
    pairs = [match_profiles(b, a, max_shift) for a, b in pairwise(sums)]
    found = np.array([(0, 0.0), *pairs])
    return Shifts(region, found[:, 0], found[:, 1] / (255.0 * (region[3] - region[2])))


def field_of_view(shifts: Shifts, width: int, revisits: np.ndarray) -> FieldOfView | None:
    """Estimate the field of view for which loops close in heading.

    Args:
        shifts: Image shifts of the whole drive.
        width: Width of the pictures, px.
        revisits: Pairs of frames that show the same place, each with its nearest revisit, so that
            about one lap lies between them, ``(m, 2)``.

    Returns:
        The first of the deepest valleys of the error; ``None`` if there is none, or its error is
        large.
    """
    if not len(revisits):
        return None
    turned = np.cumsum(shifts.shift_px) / width
    turned = turned[revisits[:, 1]] - turned[revisits[:, 0]]
    error = (1.0 - np.cos(np.outer(np.deg2rad(FIELDS_OF_VIEW_DEG), turned))).mean(axis=1)
    smooth = cv2.blur(error[:, None], (1, 5), borderType=cv2.BORDER_REPLICATE)[:, 0]
    valleys = [i for i in range(1, len(smooth) - 1) if _is_valley(smooth, i)]
    if not valleys:
        return None
    # Twice the true field of view gives two full turns a lap, so the first valley is right.
    limit = smooth[valleys].min() + _MARGIN
    first = next(i for i in valleys if smooth[i] <= limit)
    return FieldOfView(float(FIELDS_OF_VIEW_DEG[first]), error, shifts.region)


def _is_valley(error: np.ndarray, i: int) -> bool:
    """Return whether an error is small, and rises on both sides."""
    lower_side = min(error[:i].max(), error[i:].max())
    lowest = error[i] <= error[i - 1] and error[i] < error[i + 1]
    return bool(lowest and error[i] <= _WORST and lower_side >= error[i] + _DEPTH)
