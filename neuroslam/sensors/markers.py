"""Landmarks that a camera can name: square markers (ArUco, AprilTag), found by OpenCV."""

import math
from dataclasses import replace
from functools import cached_property

import cv2
import numpy as np

from neuroslam.errors import SourceError, did_you_mean
from neuroslam.geometry import TWO_PI
from neuroslam.sensors.frames import check_picture
from neuroslam.types import Pose
from neuroslam.worlds.render import cast
from neuroslam.worlds.scene import Billboard, World

_MODULE_PX = 12  # of a painted marker
_SMALL_PX = 480  # narrower pictures are enlarged: the detector needs a few pixels a module
_NEAREST_M = 0.2


def marker_dictionary(name: str) -> "cv2.aruco.Dictionary":
    """Return OpenCV's dictionary of markers of that name, as ``4X4_50`` or ``APRILTAG_36H11``.

    Raises:
        SourceError: If there is none; with the names there are.
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
    """Finds markers in pictures, and from their known size where they are.

    Args:
        dictionary: As of :func:`marker_dictionary`.
        size_m: Side of the black square.
        fov_deg: Horizontal view of the whole picture; pictures are taken as undistorted.
        panoramic: The picture is a cylinder all around.

    Example:
        >>> camera = MarkerDetector("4X4_50", size_m=0.2, fov_deg=90.0)
        >>> picture = np.full((240, 320), 255, np.uint8)
        >>> picture[100:140, 140:180] = marker_picture("4X4_50", 7, 40)
        >>> [[round(abs(x), 2) for x in row] for row in camera(picture).tolist()]
        [[7.0, 0.8, 0.0]]
    """

    def __init__(
        self, dictionary: str, size_m: float, fov_deg: float = 90.0, panoramic: bool = False
    ) -> None:
        self.dictionary, self.size_m = dictionary, size_m
        self.fov_deg, self.panoramic = fov_deg, panoramic
        marker_dictionary(dictionary)
        if not panoramic and not fov_deg < 180.0:
            raise SourceError(f"markers: a view of {fov_deg:g} degrees is no pinhole's; below 180")

    @cached_property
    def _detector(self) -> "cv2.aruco.ArucoDetector":
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        return cv2.aruco.ArucoDetector(marker_dictionary(self.dictionary), parameters)

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Return number, distance (m, in the plane) and bearing (rad) of each, ``(n, 3)``.

        Args:
            image: ``uint8``, ``(h, w)`` grey or ``(h, w, 3)`` RGB.
        """
        check_picture(image, "markers")
        grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        times = max(1, math.ceil(_SMALL_PX / grey.shape[1]))
        if times > 1:
            grey = cv2.resize(grey, None, fx=times, fy=times, interpolation=cv2.INTER_CUBIC)
        corners, ids, _ = self._detector.detectMarkers(grey)
        if ids is None:
            return np.empty((0, 3))
        height, width = grey.shape
        ids = ids.ravel()
        once = [k for k, number in enumerate(ids) if (ids == number).sum() == 1]  # twice: which?
        where = [self._where(corners[k].reshape(4, 2).astype(np.float64), width, height)
                 for k in once]  # fmt: skip
        rows = [(float(ids[k]), *at) for k, at in zip(once, where, strict=True) if at is not None]
        return np.array(sorted(rows)).reshape(-1, 3)

    def _where(self, corners: np.ndarray, width: int, height: int) -> tuple[float, float] | None:
        """Distance and bearing of one marker from its four corners in pixels."""
        if self.panoramic:
            focal = width / TWO_PI
            across = (corners[:, 0].mean() + 0.5 - 0.5 * width) / focal
            tall = np.linalg.norm(corners[[3, 2]] - corners[[0, 1]], axis=1).mean()
            return self.size_m * focal / tall, -across
        focal = 0.5 * width / math.tan(math.radians(self.fov_deg) / 2.0)
        half = self.size_m / 2.0
        square = np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])
        optics = np.array(
            [[focal, 0, 0.5 * (width - 1)], [0, focal, 0.5 * (height - 1)], [0, 0, 1]]
        )
        found, _, way = cv2.solvePnP(square, corners, optics, None, flags=cv2.SOLVEPNP_IPPE_SQUARE)
        x, _, depth = (float(value) for value in np.ravel(way))
        if not found or not depth > 0.0:
            return None
        return math.hypot(x, depth), math.atan2(-x, depth)


def marker_picture(dictionary: str, number: int, side_px: int) -> np.ndarray:
    """Draw a marker, ``uint8 (side, side)``, without a margin.

    Raises:
        SourceError: If the dictionary has no such number.
    """
    known = marker_dictionary(dictionary)
    n = len(known.bytesList)
    if not 0 <= number < n:
        raise SourceError(f"markers {dictionary}: no number {number}; it has 0 to {n - 1}")
    return cv2.aruco.generateImageMarker(known, number, side_px)


def with_markers(
    world: World, n: int, eye_m: float, size_m: float = 0.4, dictionary: str = "4X4_50"
) -> tuple[World, np.ndarray]:
    """Put up posts with markers along the first route, left and right of it, at the height of eyes.

    Args:
        world: It is not changed.
        n: How many, evenly along the route.
        eye_m: Height of the camera, at which their middles are.
        size_m: Side of the black square.
        dictionary: Of which markers.

    Returns:
        The world with its posts, and where they stand, ``(n, 2)``; the number of a marker is its
        row.
    """
    route = world.routes[0]
    poses = route.at((np.arange(n) + 0.5) * (route.length_m / n))
    places, cutouts, billboards = [], list(world.cutouts), list(world.billboards)
    for number, (x, y, theta) in enumerate(poses.tolist()):
        side = theta + (math.pi / 2.0 if number % 2 else -math.pi / 2.0)
        ray = np.array([[math.cos(side), math.sin(side)]])
        room = float(cast(world, Pose(x, y, theta), ray, eye_m)[-1].depth[0])
        away = min(max(room - 0.3, 0.4), 1.6)
        places.append((x + away * ray[0, 0], y + away * ray[0, 1]))
        cutouts.append(_post(dictionary, number, size_m, eye_m))
        tall = eye_m + 0.7 * size_m
        billboards.append(Billboard(*places[-1], 1.4 * size_m, tall, len(cutouts) - 1))
    changed = replace(world, cutouts=tuple(cutouts), billboards=tuple(billboards))
    return changed, np.array(places).reshape(-1, 2)


def _post(dictionary: str, number: int, size_m: float, eye_m: float) -> np.ndarray:
    """Paint a white board with a marker on a post, ``uint8 (h, w, 4)``."""
    modules = marker_dictionary(dictionary).markerSize + 2
    side = modules * _MODULE_PX
    margin = round(0.2 * side)
    width = side + 2 * margin
    height = round(width * (eye_m + 0.7 * size_m) / (1.4 * size_m))
    image = np.zeros((height, width, 4), np.uint8)
    middle = width // 2
    image[width:, middle - _MODULE_PX // 2 : middle + _MODULE_PX // 2] = (96, 96, 96, 255)
    image[:width] = 255
    black = marker_picture(dictionary, number, side)
    image[margin : margin + side, margin : margin + side, :3] = black[..., None]
    return image


def in_sight(world: World, pose: Pose, places_m: np.ndarray, eye_m: float) -> np.ndarray:
    """Return distance and bearing of places, ``(n, 2)``, and ``inf`` for those behind a wall."""
    off = places_m - np.array(pose[:2])
    distance = np.hypot(*off.T)
    rays = off / np.maximum(distance, 1e-9)[:, None]
    bearing = np.arctan2(off[:, 1], off[:, 0]) - pose.theta_rad
    bearing = (bearing + math.pi) % TWO_PI - math.pi
    # One ray at a time: rays in all directions together are another case of the renderer's.
    clear = np.array(
        [cast(world, pose, ray[None], eye_m)[-1].depth[0] for ray in rays]
    ).reshape(-1)  # fmt: skip
    seen = (distance <= clear) & (distance > _NEAREST_M)
    return np.column_stack([np.where(seen, distance, np.inf), bearing])
