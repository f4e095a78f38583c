"""Views of range scans: a scan as a panoramic picture of one row, for templates and search."""

import numpy as np

from neuroslam.sensors.scan import checked_ranges

HALF_GREY_M = 2.0
"""Range that is drawn half as bright as a range of 0."""


def scan_picture(ranges: np.ndarray, half_m: float = HALF_GREY_M) -> np.ndarray:
    r"""Draw a scan as a picture of one row: near is bright, :math:`255\, h / (h + r)`.

    Args:
        ranges: Metres, ``(n,)``, at bearings evenly over the full turn, counter-clockwise from
            straight ahead; ``inf``, where nothing is in range, is black.
        half_m: :math:`h`; larger: far surfaces count more.

    Returns:
        ``uint8``, ``(1, n)``: straight behind at both edges, straight ahead in the middle, left on
        the left, as in a panoramic image.

    Raises:
        BadFrame: If the scan is invalid.

    Example:
        >>> scan_picture(np.array([0.0, 2.0, 6.0, np.inf, np.inf, np.inf, 6.0, 2.0])).tolist()
        [[0, 0, 64, 128, 255, 128, 64, 0]]
    """
    scan = checked_ranges(ranges)
    middle = len(scan) // 2
    left_to_right = scan[(middle - np.arange(len(scan))) % len(scan)]
    return np.rint(255.0 * half_m / (half_m + left_to_right)).astype(np.uint8)[None]
