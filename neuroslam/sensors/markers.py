"""Landmarks that a camera can identify: square markers (ArUco, AprilTag), detected by OpenCV."""

import math
from functools import cached_property

import cv2
import numpy as np

from neuroslam.errors import SourceError, did_you_mean
from neuroslam.geometry import TWO_PI
from neuroslam.sensors.frames import check_image

_SMALL_PX = 480  # narrower images are enlarged: the detector needs a few pixels per module


def marker_dictionary(name: str) -> "cv2.aruco.Dictionary":
    """Return OpenCV's marker dictionary of a name such as ``4X4_50`` or ``APRILTAG_36H11``.

    Raises:
        SourceError: If there is no such dictionary; the message lists those there are.
    """
    known = {key[5:]: key for key in dir(cv2.aruco) if key.startswith("DICT_")}
    if name.upper() not in {key.upper() for key in known}:
        raise SourceError(
            f"markers {name!r}: no such dictionary; expected one of {', '.join(sorted(known))}"
            f"{did_you_mean(name.upper(), known)}"
        )
    key = next(value for short, value in known.items() if short.upper() == name.upper())
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, key))


class MarkerDetector:
    """Detects markers in images and measures their position from their known size.

    Args:
        dictionary: Name for :func:`marker_dictionary`.
        size_m: Side of the black square.
        fov_deg: Horizontal field of view of the whole image; images are assumed undistorted.
        panoramic: The image is a cylindrical panorama of the full turn.

    Example:
        >>> camera = MarkerDetector("4X4_50", size_m=0.2, fov_deg=90.0)
        >>> image = np.full((240, 320), 255, np.uint8)
        >>> image[100:140, 140:180] = marker_image("4X4_50", 7, 40)
        >>> [[round(abs(x), 2) for x in row] for row in camera(image).tolist()]
        [[7.0, 0.8, 0.0]]
    """

    def __init__(
        self, dictionary: str, size_m: float, fov_deg: float = 90.0, panoramic: bool = False
    ) -> None:
        self.dictionary, self.size_m = dictionary, size_m
        self.fov_deg, self.panoramic = fov_deg, panoramic
        marker_dictionary(dictionary)
        if not panoramic and not fov_deg < 180.0:
            raise SourceError(
                f"markers: view of {fov_deg} degrees; expected less than 180, or a panoramic camera"
            )

    def __getstate__(self) -> dict[str, object]:
        """Return the state without OpenCV's detector, which cannot be copied and is made again."""
        return {name: value for name, value in self.__dict__.items() if name != "_detector"}

    @cached_property
    def _detector(self) -> "cv2.aruco.ArucoDetector":
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        return cv2.aruco.ArucoDetector(marker_dictionary(self.dictionary), parameters)

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Return number, distance (m, in the plane) and bearing (rad) of each marker, ``(n, 3)``.

        Args:
            image: ``uint8``, ``(h, w)`` grey or ``(h, w, 3)`` RGB.
        """
        check_image(image, "markers")
        grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        times = max(1, math.ceil(_SMALL_PX / grey.shape[1]))
        if times > 1:
            grey = cv2.resize(grey, None, fx=times, fy=times, interpolation=cv2.INTER_CUBIC)
        corners, ids, _ = self._detector.detectMarkers(grey)
        if ids is None:
            return np.empty((0, 3))
        height, width = grey.shape
        ids = ids.ravel()
        # A number that is seen twice is ambiguous, and left out.
        once = [k for k, number in enumerate(ids) if (ids == number).sum() == 1]
        located = [
            self._locate(corners[k].reshape(4, 2).astype(np.float64), width, height) for k in once
        ]
        rows = [(float(ids[k]), *at) for k, at in zip(once, located, strict=True) if at is not None]
        return np.array(sorted(rows)).reshape(-1, 3)

    def _locate(self, corners: np.ndarray, width: int, height: int) -> tuple[float, float] | None:
        """Return distance and bearing of a marker from its four corners in pixels."""
        if self.panoramic:
            focal = width / TWO_PI
            across = (corners[:, 0].mean() + 0.5 - 0.5 * width) / focal
            height_px = np.linalg.norm(corners[[3, 2]] - corners[[0, 1]], axis=1).mean()
            return self.size_m * focal / height_px, -across
        focal = 0.5 * width / math.tan(math.radians(self.fov_deg) / 2.0)
        half = self.size_m / 2.0
        square = np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])
        optics = np.array(
            [[focal, 0, 0.5 * (width - 1)], [0, focal, 0.5 * (height - 1)], [0, 0, 1]]
        )
        found, _, offset = cv2.solvePnP(
            square, corners, optics, None, flags=cv2.SOLVEPNP_IPPE_SQUARE
        )
        x, _, depth = (float(value) for value in np.ravel(offset))
        if not found or not depth > 0.0:
            return None
        return math.hypot(x, depth), math.atan2(-x, depth)


def marker_image(dictionary: str, number: int, side_px: int) -> np.ndarray:
    """Draw a marker, ``uint8 (side, side)``, without a margin.

    Raises:
        SourceError: If the dictionary has no marker of that number.
    """
    known = marker_dictionary(dictionary)
    n = len(known.bytesList)
    if not 0 <= number < n:
        raise SourceError(f"markers {dictionary}: no number {number}; expected 0 to {n - 1}")
    return cv2.aruco.generateImageMarker(known, number, side_px)
