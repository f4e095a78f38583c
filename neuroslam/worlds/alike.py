"""Rendered worlds whose places look the same: rooms in a row, wallpaper, a loop of equal corners.

Each has one mark only by which its places can be distinguished; a world without any could not be
localised in by anyone. With another ``mark`` the world is a second building that differs from the
first in that alone.
"""

import math

import numpy as np

from neuroslam.worlds import paint, paint_outdoors
from neuroslam.worlds.scene import Sense, Surface, World, rounded_route
from neuroslam.worlds.site import Painter, Point, Site

ROOM_M = 4.0
"""Length of a room of :func:`rooms`."""

N_ROOMS = 6
"""Number of its rooms."""

MOTIF_M = 1.0
"""Distance at which the wallpaper of :func:`wallpaper` repeats."""

SIDE_M = 7.6
"""Side of the square that the route of :func:`corners` goes around, before rounding."""

_LANE_M = 0.9
_PER_M = 40.0


def _same(look: int, salt: int, height_m: float) -> Painter:
    """Return a painter that paints every wall of one length alike."""

    def painter(_rng: np.random.Generator, length_m: float) -> tuple[np.ndarray, float]:
        rng = np.random.default_rng([look, salt])
        return paint.interior(rng, length_m, height_m, 48.0, paint.INDOORS), 48.0

    return painter


def _plain(look: int, salt: int, height_m: float) -> Painter:
    """Return a painter of walls without objects."""

    def painter(_rng: np.random.Generator, length_m: float) -> tuple[np.ndarray, float]:
        rng = np.random.default_rng([look, salt])
        c = paint.Canvas(length_m, height_m, 48.0, (215, 208, 192))
        paint.plaster(c.image, rng, paint.hue(rng.uniform(0, 360), 0.25, 0.75), 0.03)
        c.rect(0.0, 0.0, length_m, 0.1, (66, 58, 52))
        return c.image, 48.0

    return painter


def _mark(look: int, height_m: float) -> Painter:
    """Return a painter of the wall that is found once: pictures in strong colours."""

    def painter(_rng: np.random.Generator, length_m: float) -> tuple[np.ndarray, float]:
        rng = np.random.default_rng([look, 99])
        c = paint.Canvas(length_m, height_m, 48.0, paint.hue(rng.uniform(0, 360), 0.6, 0.6))
        for k in range(int(length_m / 0.6)):
            tone = paint.hue(rng.uniform(0, 360), 0.8, 0.9)
            c.rect(0.6 * k + 0.1, 0.5, 0.6 * k + 0.5, rng.uniform(1.2, height_m - 0.3), tone)
        return c.image, 48.0

    return painter


def _repeated(tile: np.ndarray, across: int, up: int = 1) -> np.ndarray:
    return np.ascontiguousarray(np.tile(tile, (up, across, 1)))


def rooms(look: int, mark: int | None = None) -> World:
    """Six rooms in a row, identical but for the wall of one end; there and back is 45 m a lap."""
    site, height, half = Site(look + 6000), 2.6, 2.0
    width = N_ROOMS * ROOM_M
    north, south = _same(look, 1, height), _same(look, 2, height)
    east, west = _plain(look, 3, height), _plain(look, 4, height)
    for k in range(N_ROOMS):
        x0, x1 = ROOM_M * k, ROOM_M * (k + 1)
        site.wall([(x0, half), (x1, half)], north)
        site.wall([(x1, -half), (x0, -half)], south)
    jambs = [-half, -_LANE_M - 0.5, -_LANE_M + 0.5, _LANE_M - 0.5, _LANE_M + 0.5, half]
    for k in range(1, N_ROOMS):
        for low, high in zip(jambs[::2], jambs[1::2], strict=True):
            site.wall([(ROOM_M * k, high), (ROOM_M * k, low)], west)  # seen on the way east
            site.wall([(ROOM_M * k, low), (ROOM_M * k, high)], east)
    site.wall([(width, half), (width, -half)], _mark(look if mark is None else mark, height))
    site.wall([(0.0, -half), (0.0, half)], east)
    ground = paint_outdoors.floor(site.rng, ROOM_M, 2 * half, _PER_M, "parquet").image
    lights = paint_outdoors.lamps(site.rng, ROOM_M, 2 * half, 32.0).image
    ends = [(1.0, -_LANE_M), (width - 1.0, -_LANE_M), (width - 1.0, _LANE_M), (1.0, _LANE_M)]
    return site.build(
        name="rooms",
        description=(rooms.__doc__ or "").split("\n")[0],
        ground=Surface(_repeated(ground, N_ROOMS), _PER_M, 0.0, -half, 0.0),
        ceiling=Surface(_repeated(lights, N_ROOMS), 32.0, 0.0, -half, height),
        routes=[rounded_route(ends, 0.8)],
        sense=Sense(frames_per_lap=360),
        sight_m=5.0,
    )


def wallpaper(look: int, mark: int | None = None) -> World:
    """Corridor of 20 m with one wallpaper everywhere and a mark at one end; 38 m a lap."""
    site, height, half, length = Site(look + 7000), 2.6, 1.6, 20.0
    rng = np.random.default_rng([look, 5])
    motif = paint.Canvas(MOTIF_M, height, 48.0, paint.hue(rng.uniform(0, 360), 0.2, 0.85))
    for _ in range(5):
        x, z = rng.uniform(0.0, 0.7), rng.uniform(0.2, height - 0.6)
        tone = paint.hue(rng.uniform(0, 360), 0.6, 0.6)
        motif.rect(x, z, x + rng.uniform(0.1, 0.3), z + rng.uniform(0.2, 0.6), tone)

    def paper(_rng: np.random.Generator, length_m: float) -> tuple[np.ndarray, float]:
        return _repeated(motif.image, math.ceil(length_m / MOTIF_M)), 48.0

    site.wall([(0.0, half), (length, half)], paper)
    site.wall([(length, -half), (0.0, -half)], paper)
    site.wall([(length, half), (length, -half)], _mark(look if mark is None else mark, height))
    site.wall([(0.0, -half), (0.0, half)], paper)
    ground = paint_outdoors.floor(site.rng, MOTIF_M, 2 * half, _PER_M, "carpet").image
    white = np.full((32, 32, 3), 214, dtype=np.uint8)
    ends = [(0.8, -0.7), (length - 0.8, -0.7), (length - 0.8, 0.7), (0.8, 0.7)]
    return site.build(
        name="wallpaper",
        description=(wallpaper.__doc__ or "").split("\n")[0],
        ground=Surface(_repeated(ground, int(length / MOTIF_M)), _PER_M, 0.0, -half, 0.0),
        ceiling=Surface(_repeated(white, int(length), 4), 32.0, 0.0, -2.0, height),
        routes=[rounded_route(ends, 0.6)],
        sense=Sense(frames_per_lap=300),
        sight_m=5.0,
    )


def corners(look: int, mark: int | None = None) -> World:
    """Square corridor of four identical sides and corners, with a mark at one; 28 m a lap."""
    site, height = Site(look + 8000), 2.6
    outside, inside = 0.5 * SIDE_M + 1.2, 0.5 * SIDE_M - 1.2
    ends, middle = _same(look, 6, height), _same(look, 8, height)
    marked = _mark(look if mark is None else mark, height)
    for k in range(4):  # clockwise: each side begins and ends in a corner
        turn = [(-outside, -outside), (-outside, outside), (outside, outside), (outside, -outside)]
        (x0, y0), (x1, y1) = turn[k], turn[(k + 1) % 4]
        cuts = [(x0 + (x1 - x0) * t, y0 + (y1 - y0) * t) for t in (0.0, 0.25, 0.75, 1.0)]
        site.wall(cuts[0:2], marked if k == 2 else ends)
        site.wall(cuts[1:3], middle)
        site.wall(cuts[2:4], marked if k == 1 else ends)
    site.wall(_square(inside), _same(look, 7, height))
    size = 2 * outside
    ground = paint_outdoors.floor(site.rng, size, size, _PER_M, "tiles").image
    lights = paint_outdoors.lamps(site.rng, size, size, 32.0).image
    r = 0.5 * SIDE_M
    return site.build(
        name="corners",
        description=(corners.__doc__ or "").split("\n")[0],
        ground=Surface(_turned(ground), _PER_M, -outside, -outside, 0.0),
        ceiling=Surface(_turned(lights), 32.0, -outside, -outside, height),
        routes=[rounded_route([(-r, -r), (r, -r), (r, r), (-r, r)], 1.0)],
        sense=Sense(frames_per_lap=224),
        sight_m=6.0,
    )


def _square(half: float) -> list[Point]:
    return [(-half, -half), (half, -half), (half, half), (-half, half), (-half, -half)]


def _turned(image: np.ndarray) -> np.ndarray:
    """Average an image with its quarter turns, so that it looks the same from each side."""
    n = min(image.shape[:2])
    square = image[:n, :n].astype(np.float32)
    return np.mean([np.rot90(square, k) for k in range(4)], axis=0).astype(np.uint8)
