"""Rendered worlds of three dimensions: a garage of three storeys, and a tall hall to fly in."""

import numpy as np

from neuroslam.worlds import paint, paint_outdoors
from neuroslam.worlds.scene import Ramp, Route, Sense, Surface, World, rounded_route
from neuroslam.worlds.site import Painter, Point, Site

STOREY_M = 2.7
"""From floor to floor."""

_RING = [(-8.0, -6.0), (8.0, -6.0), (8.0, 6.0), (-8.0, 6.0)]
_UP, _DOWN = [(-8.0, 2.0), (8.0, 2.0)], [(-8.0, -2.0), (8.0, -2.0)]
"""Ramps through the block: left turns only, entered from the left lane, left on the right one."""


def _box(x0: float, y0: float, x1: float, y1: float, inside: bool = False) -> list[Point]:
    ring = [(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)]
    return ring[::-1] if inside else ring


def _tour(changes: list[int], laps: int) -> tuple[list[Point], list[float]]:
    """Return the corners and heights of a drive: laps on a storey, then a ramp up (1) or down (-1).

    The first storey begins at the first corner of the ring, the others after their ramp.
    """
    corners, heights, storey = list(_RING), [0.0] * 4, 0
    for change in changes:
        for _ in range(laps - 1):
            corners += _RING
            heights += [storey * STOREY_M] * 4
        corners += _UP if change > 0 else _DOWN
        heights += [storey * STOREY_M, (storey + change) * STOREY_M]
        storey += change
        corners += _RING[2:]
        heights += [storey * STOREY_M] * 2
    for _ in range(laps - 1):
        corners += _RING
        heights += [storey * STOREY_M] * 4
    return corners, heights


def garage(look: int) -> World:
    """Garage of three storeys that look alike, and ramps; routes 1: up and down, 2: one storey."""
    site, tall = Site(look + 6000), 2.4
    objects = (paint.door, paint.poster, paint.extinguisher, paint.board, paint.poster)

    def painter(rng: np.random.Generator, length: float) -> tuple[np.ndarray, float]:
        return paint.interior(rng, length, tall, 48.0, objects), 48.0

    site.wall(_box(-9.6, -7.6, 9.6, 7.6, inside=True), painter)
    for low, high in ((3.2, 4.4), (-0.8, 0.8), (-4.4, -3.2)):
        site.wall(_box(-6.4, low, 6.4, high), painter)
    for x, y in ((9.3, 7.3), (-9.3, 7.3), (-9.3, -7.3), (9.3, -7.3), (0.0, 7.35), (-3.0, -7.35)):
        site.pillar(x, y, 0.2, tall, (205, 200, 188))
    ground = paint_outdoors.floor(site.rng, 19.4, 15.4, 32.0, "asphalt")
    for x in np.arange(2.0, 18.0, 2.5):  # parking bays along both long walls
        for y in (0.1, 13.9):
            ground.rect(x, y, x + 0.1, y + 1.4, (222, 220, 210))
    lights = paint_outdoors.lamps(site.rng, 19.4, 15.4, 24.0)
    return site.build(
        name="garage",
        description=(garage.__doc__ or "").split("\n")[0],
        ground=Surface(ground.image, 32.0, -9.7, -7.7, 0.0),
        ceiling=Surface(lights.image, 24.0, -9.7, -7.7, tall),
        routes=[
            _route(*_tour([1, 1, -1, -1], 2), level_arcs=True),
            rounded_route(_RING, 1.5),
        ],
        sense=Sense(frames_per_lap=1900, laps=1.0),
        sight_m=16.0,
        ramps=(Ramp(-6.5, 6.5, 0.8, 3.2, STOREY_M), Ramp(-6.5, 6.5, -3.2, -0.8, -STOREY_M)),
        storey_m=STOREY_M,
    )


def _route(corners: list[Point], heights: list[float], level_arcs: bool = False) -> Route:
    return rounded_route(corners, 1.5, heights, level_arcs)


def _stack(one: Painter, n: int) -> Painter:
    """Paint a wall of one storey, and repeat it upwards."""

    def painter(rng: np.random.Generator, length: float) -> tuple[np.ndarray, float]:
        image, per_m = one(rng, length)
        return np.tile(image, (n, 1, 1)), per_m

    return painter


def atrium(look: int) -> World:
    """Hall with three galleries that look alike, for a drone; routes 1: up and down, 2: level."""
    site = Site(look + 7000)

    def storey(rng: np.random.Generator, length: float) -> tuple[np.ndarray, float]:
        return paint.interior(rng, length, STOREY_M, 40.0, paint.GALLERY), 40.0

    painter = _stack(storey, 3)
    site.wall(_box(-8.0, -6.0, 8.0, 6.0, inside=True), painter)
    site.wall(_box(-4.0, -2.0, 4.0, 2.0), painter)
    ground = paint_outdoors.floor(site.rng, 16.2, 12.2, 32.0, "parquet")
    lights = paint_outdoors.lamps(site.rng, 16.2, 12.2, 24.0)
    ring = [(-6.0, -4.0), (6.0, -4.0), (6.0, 4.0), (-6.0, 4.0)]
    corners: list[Point] = []
    heights: list[float] = []
    for at, after in ((0, 0), (0, 1), (1, 1), (1, 2), (2, 2), (2, 1), (1, 1), (1, 0), (0, 0)):
        corners += ring  # a change of height takes the second half of a lap
        heights += [at * STOREY_M, at * STOREY_M, (at + after) / 2 * STOREY_M, after * STOREY_M]
    return site.build(
        name="atrium",
        description=(atrium.__doc__ or "").split("\n")[0],
        ground=Surface(ground.image, 32.0, -8.1, -6.1, 0.0),
        ceiling=Surface(lights.image, 24.0, -8.1, -6.1, 3 * STOREY_M),
        routes=[_route(corners, heights), rounded_route(ring, 1.5)],
        sense=Sense(frames_per_lap=1800, laps=1.0),
        flown=True,
        sight_m=16.0,
    )
