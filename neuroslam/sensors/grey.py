"""Conversion of colour images to grey."""

from typing import Literal

import cv2
import numpy as np

from neuroslam.compiled import compiled, plain_array, runs_compiled
from neuroslam.types import GreyRule

_THIRDS = np.full((1, 3), 1.0 / 3.0)


def to_grey(
    image: np.ndarray, rule: GreyRule = "luma", channels: Literal["rgb", "bgr"] = "rgb"
) -> np.ndarray:
    r"""Convert a colour image to grey; a grey image is returned as it is.

    .. math:: Y = 0.299\,R + 0.587\,G + 0.114\,B \quad\text{or}\quad M = (R + G + B) / 3

    ``luma`` is :math:`Y` of ITU-R BT.601, as OpenCV computes it. ``mean`` is :math:`M`, as in the
    Python RatSLAM documentation (2017), ``convert-view-to-view-template``, and in OpenRatSLAM.
    Those divide sums of pixels; here every pixel is rounded, so it is at most a third of a grey
    level off.

    Args:
        image: ``uint8``, ``(h, w)`` grey or ``(h, w, 3)``.
        rule: ``luma`` or ``mean``.
        channels: Order of the channels; only ``luma`` depends on it.

    Returns:
        ``uint8``, ``(h, w)``.

    Example:
        >>> red = np.array([[[255, 0, 0]]], np.uint8)
        >>> int(to_grey(red)[0, 0]), int(to_grey(red, "mean")[0, 0])
        (76, 85)
    """
    if image.ndim == 2:
        return image
    if rule == "mean":
        if runs_compiled() and image.dtype == np.uint8 and image.shape[2:] == (3,):
            grey = np.empty(image.shape[:2], np.uint8)
            mean_step(plain_array(image).reshape(-1), grey.reshape(-1))
            return grey
        return cv2.transform(image, _THIRDS)
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY if channels == "rgb" else cv2.COLOR_BGR2GRAY)


@compiled
def mean_step(colour: np.ndarray, grey: np.ndarray) -> None:
    """Write the mean of each three bytes, rounded; a mean of three has no tie."""
    for i in range(grey.shape[0]):
        total = np.uint16(colour[3 * i]) + np.uint16(colour[3 * i + 1]) + colour[3 * i + 2]
        grey[i] = np.uint8(np.uint16(total + 1) // np.uint16(3))
