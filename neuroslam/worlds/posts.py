"""Posts with markers in a rendered world, and which landmarks a camera sees there."""

import math
from dataclasses import replace

import numpy as np

from neuroslam.geometry import TWO_PI
from neuroslam.sensors.markers import marker_dictionary, marker_image
from neuroslam.types import Pose
from neuroslam.worlds.render import cast
from neuroslam.worlds.scene import Billboard, World

_MODULE_PX = 12  # of a painted marker
_NEAREST_M = 0.2


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
    black = marker_image(dictionary, number, side)
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
