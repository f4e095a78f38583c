"""Posts with markers in a rendered world, and their visibility from a pose."""

import math
from dataclasses import replace

import numpy as np

from neuroslam.geometry import wrap_angles
from neuroslam.sensors.landmarks import LandmarkWords
from neuroslam.sensors.markers import marker_dictionary, marker_image
from neuroslam.types import Pose
from neuroslam.worlds.landmarks import COLOURS, SHAPES
from neuroslam.worlds.render import cast
from neuroslam.worlds.scene import Billboard, World

_MODULE_PX = 12  # side of a marker's module in its texture
_NEAREST_M = 0.2


def with_markers(
    world: World, n: int, eye_m: float, size_m: float = 0.4, dictionary: str = "4X4_50"
) -> tuple[World, np.ndarray]:
    """Add posts with markers along the first route, alternating left and right of it.

    Args:
        world: The world; it is not changed.
        n: Number of posts, at equal distances along the route.
        eye_m: Height of the camera, and of the centres of the markers.
        size_m: Side of the black square.
        dictionary: Name of the marker dictionary.

    Returns:
        The world with its posts, and their positions, ``(n, 2)``; the number of a marker is its
        row.
    """
    route = world.routes[0]
    poses = route.at((np.arange(n) + 0.5) * (route.length_m / n))
    positions: list[tuple[float, float]] = []
    cutouts, billboards = list(world.cutouts), list(world.billboards)
    for number, (x, y, theta) in enumerate(poses.tolist()):
        side = theta + (math.pi / 2.0 if number % 2 else -math.pi / 2.0)
        ray = np.array([[math.cos(side), math.sin(side)]])
        room_m = float(cast(world, Pose(x, y, theta), ray, eye_m)[-1].depth[0])
        offset_m = min(max(room_m - 0.3, 0.4), 1.6)
        post_x, post_y = x + offset_m * float(ray[0, 0]), y + offset_m * float(ray[0, 1])
        positions.append((post_x, post_y))
        cutouts.append(_post(dictionary, number, size_m, eye_m))
        height_m = eye_m + 0.7 * size_m
        billboards.append(Billboard(post_x, post_y, 1.4 * size_m, height_m, len(cutouts) - 1))
    changed = replace(world, cutouts=tuple(cutouts), billboards=tuple(billboards))
    return changed, np.array(positions).reshape(-1, 2)


def words_of_posts(n: int) -> tuple[LandmarkWords, ...]:
    """Return name and attributes of posts: a colour and a shape, and its size.

    The first 25 posts are small and have a pair of a colour and a shape each; those after them are
    large and repeat the pairs.

    Example:
        >>> [(post.name, post.words) for post in words_of_posts(27)[::13]]
        [('RED_SQUARE', 'RED * SQUARE + SMALL'), ('ORANGE_CIRCLE', 'ORANGE * CIRCLE + SMALL'), \
('LARGE_BLUE_SQUARE', 'BLUE * SQUARE + LARGE')]
    """
    pairs = [(colour, shape) for shape in SHAPES for colour in COLOURS]
    table = []
    for number in range(n):
        colour, shape = pairs[number % len(pairs)]
        large = number >= len(pairs)
        name = f"LARGE_{colour}_{shape}" if large else f"{colour}_{shape}"
        words = f"{colour} * {shape} + {'LARGE' if large else 'SMALL'}"
        table.append(LandmarkWords(name, words, number=number))
    return tuple(table)


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


def in_sight(world: World, pose: Pose, positions_m: np.ndarray, eye_m: float) -> np.ndarray:
    """Return distance and bearing of positions, ``(n, 2)``; hidden ones have distance ``inf``."""
    off = positions_m - np.array(pose[:2])
    distance = np.hypot(*off.T)
    rays = off / np.maximum(distance, 1e-9)[:, None]
    bearing = wrap_angles(np.arctan2(off[:, 1], off[:, 0]) - pose.theta_rad)
    # One ray at a time: the renderer skips walls behind rays of similar direction.
    clear = np.array([cast(world, pose, ray[None], eye_m)[-1].depth[0] for ray in rays]).reshape(-1)
    seen = (distance <= clear) & (distance > _NEAREST_M)
    return np.column_stack([np.where(seen, distance, np.inf), bearing])
