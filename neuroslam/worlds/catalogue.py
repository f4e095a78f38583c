"""The rendered worlds: geometry, textures and routes of each."""

import math
from collections.abc import Callable
from functools import lru_cache
from itertools import pairwise

import numpy as np

from neuroslam.errors import SourceError, did_you_mean
from neuroslam.geometry import TWO_PI
from neuroslam.worlds import alike, paint, paint_outdoors
from neuroslam.worlds.scene import Route, Sense, Surface, World, ellipse_route, rounded_route
from neuroslam.worlds.site import Painter, Point, Site
from neuroslam.worlds.storeys import atrium, garage


def _rectangle(x: float, y: float, clockwise: bool) -> list[Point]:
    ring = [(-x, -y), (x, -y), (x, y), (-x, y), (-x, -y)]
    return ring[::-1] if clockwise else ring


def _ring(semi_x: float, semi_y: float, n: int, clockwise: bool) -> list[Point]:
    t = np.linspace(0.0, TWO_PI, n + 1)
    ring = [(semi_x * math.cos(a), semi_y * math.sin(a)) for a in t[:-1]]
    ring.append(ring[0])
    return ring[::-1] if clockwise else ring


def _indoors(height: float, objects: tuple[paint.WallObject, ...], per_m: float = 64.0) -> Painter:
    return lambda rng, length: (paint.interior(rng, length, height, per_m, objects), per_m)


def _corridor(look: int) -> World:
    """Office corridor around a block of rooms: doors, posters, windows, plants; 33 m a lap."""
    site, height = Site(look), 2.6
    painter = _indoors(height, paint.INDOORS)
    site.wall(_rectangle(6.4, 4.15, clockwise=True), painter)
    site.wall(_rectangle(4.6, 2.35, clockwise=False), painter)
    spots = [
        (6.0, 3.75),
        (-6.0, -3.75),
        (-6.0, 3.75),
        (2.7, -3.85),
        (-4.9, 0.8),
        (-2.5, 2.65),
        (6.05, -1.2),
    ]
    for x, y in spots:
        tall = site.rng.uniform(1.2, 1.7)
        site.figure(x, y, 0.47 * tall, tall, paint_outdoors.plant(site.rng))
    site.pillar(6.1, -3.85, 0.22, height, (205, 200, 188))
    site.pillar(-1.2, 3.98, 0.2, height, (205, 200, 188))
    ground = paint_outdoors.floor(site.rng, 13.0, 8.6, 40.0, "carpet")
    for a, b in ((3.2, -0.6), (-4.0, 0.6)):  # carpets of another colour, so that floors differ too
        tone = paint.hue(site.rng.uniform(0, 360), 0.35, 0.5)
        paint.plaster(ground.part(6.5 + a, 0.0, 6.5 + a + 1.6, 2.2), site.rng, tone, 0.15)
        paint.plaster(ground.part(6.5 + b, 6.4, 6.5 + b + 2.5, 8.6), site.rng, tone, 0.15)
    lights = paint_outdoors.lamps(site.rng, 13.0, 8.6, 32.0)
    return site.build(
        name="corridor",
        description=_first_line(_corridor),
        ground=Surface(ground.image, 40.0, -6.5, -4.3, 0.0),
        ceiling=Surface(lights.image, 32.0, -6.5, -4.3, height),
        routes=[rounded_route(_rectangle(5.5, 3.25, clockwise=False)[:-1], 1.0)],
        sense=Sense(frames_per_lap=340),
        sight_m=16.0,
    )


def _ellipse(look: int) -> World:
    """Picture gallery between two elliptic walls: paintings, doors, parquet; 32 m a lap."""
    site, height = Site(look + 1000), 3.0
    painter = _indoors(height, paint.GALLERY)
    site.wall(_ring(7.1, 5.1, 96, clockwise=True), painter, smooth=True)
    site.wall(_ring(4.9, 2.9, 72, clockwise=False), painter, smooth=True)
    for k in range(5):
        angle = TWO_PI * (k + site.rng.uniform(0.2, 0.8)) / 5
        site.pillar(6.8 * math.cos(angle), 4.8 * math.sin(angle), 0.16, height, (226, 222, 212))
    ground = paint_outdoors.floor(site.rng, 14.6, 10.6, 40.0, "parquet")
    lights = paint_outdoors.lamps(site.rng, 14.6, 10.6, 32.0)
    return site.build(
        name="ellipse",
        description=_first_line(_ellipse),
        ground=Surface(ground.image, 40.0, -7.3, -5.3, 0.0),
        ceiling=Surface(lights.image, 32.0, -7.3, -5.3, height),
        routes=[ellipse_route(6.0, 4.0)],
        sense=Sense(frames_per_lap=400),
    )


def _figure_eight(look: int) -> World:
    """Laboratory with two loops that share an aisle, no odometry; route 2: 2, then 3 laps."""
    site, height = Site(look + 2000), 2.4
    painter = _indoors(height, paint.INDOORS)
    site.wall(_rectangle(6.5, 4.0, clockwise=True), painter)
    for x in (-2.8, 2.8):
        island = [(x + dx, y) for dx, y in _rectangle(1.9, 2.2, clockwise=False)]
        site.wall(island, painter)
    for x, y in ((6.2, 3.7), (-6.2, 3.7), (-6.2, -3.7), (6.2, -3.7), (0.0, 3.85), (0.0, -3.85)):
        site.pillar(x, y, 0.14, height, (190, 192, 196))
    ground = paint_outdoors.floor(site.rng, 13.2, 8.2, 40.0, "tiles")
    lights = paint_outdoors.lamps(site.rng, 13.2, 8.2, 32.0)
    stem, far, y = 0.0, 5.6, 3.1
    loops = [
        (stem, -y),
        (stem, y),
        (-far, y),
        (-far, -y),
        (stem, -y),
        (stem, y),
        (far, y),
        (far, -y),
    ]
    return site.build(
        name="figure_eight",
        description=_first_line(_figure_eight),
        ground=Surface(ground.image, 40.0, -6.6, -4.1, 0.0),
        ceiling=Surface(lights.image, 32.0, -6.6, -4.1, height),
        routes=[
            rounded_route(loops, 0.8),
            rounded_route([*loops[:4], *loops[:4], *loops[4:], *loops[4:], *loops[4:]], 0.8),
        ],
        sense=Sense(frames_per_lap=450, odometry=False),
        sight_m=16.0,
    )


def _town(look: int) -> World:
    """Small town of four blocks; routes 1-4 go around one each, 5 around all, 6: all of these."""
    site = Site(look + 3000, sun_rad=2.2)
    for x, y in ((4.0, 4.0), (-30.0, 4.0), (-30.0, -24.0), (4.0, -24.0)):
        site.block(x, y, x + 26.0, y + 20.0, (6.0, 9.5), _house)
    ring = _rectangle(38.0, 32.0, clockwise=True)
    for a, b in pairwise(ring):
        site.lots(a, b, (6.0, 10.0), _house)
    for _ in range(16):
        side = site.rng.choice([-1.0, 1.0], 2)
        if site.rng.uniform() < 0.5:
            x, y = (
                site.rng.uniform(6.0, 28.0) * side[0],
                site.rng.choice([2.9, 25.1, 30.9]) * side[1],
            )
        else:
            x, y = (
                site.rng.choice([2.9, 31.1, 36.9]) * side[0],
                site.rng.uniform(6.0, 22.0) * side[1],
            )
        tall = site.rng.uniform(3.5, 5.5)
        site.figure(x, y, tall / 1.5, tall, paint_outdoors.tree(site.rng))
    zebras = ((38.5, 38.2), (38.5, 26.8), (38.5, 54.5), (38.5, 10.5))
    ground = _streets(site.rng, (-34.0, 0.0, 34.0), (-28.0, 0.0, 28.0), zebras)
    around = [(0.0, 0.0), (34.0, 0.0), (34.0, 28.0), (0.0, 28.0)]
    routes = [
        rounded_route([(x + dx, y + dy) for x, y in around], 4.0)
        for dx, dy in ((0.0, 0.0), (-34.0, 0.0), (-34.0, -28.0), (0.0, -28.0))
    ]
    routes.append(rounded_route(_rectangle(34.0, 28.0, clockwise=False)[:-1], 4.0))
    inner = [  # each begins in the middle, in the direction in which the one before arrives
        [(0.0, 0.0), (34.0, 0.0), (34.0, 28.0), (0.0, 28.0)],
        [(0.0, 0.0), (0.0, -28.0), (34.0, -28.0), (34.0, 0.0)],
        [(0.0, 0.0), (-34.0, 0.0), (-34.0, -28.0), (0.0, -28.0)],
        [(0.0, 0.0), (0.0, 28.0), (-34.0, 28.0), (-34.0, 0.0)],
    ]
    tour = [(0.0, 28.0)]
    for block in inner:
        tour += block + block
    tour += [(0.0, 0.0), (34.0, 0.0), (34.0, 28.0), (-34.0, 28.0), (-34.0, -28.0)]
    routes.append(rounded_route([*tour, (34.0, -28.0), (34.0, 28.0)], 4.0))
    return site.build(
        name="town",
        description=_first_line(_town),
        ground=ground,
        sky=paint_outdoors.sky(site.rng),
        routes=routes,
        lanes_m=(2.2, -2.2),
        sense=Sense(frames_per_lap=350, horizon=0.62, camera_height_m=1.5),
        haze=(196, 208, 222),
        sight_m=90.0,
    )


def _district(look: int) -> World:
    """Nine blocks of houses; routes 1-4: laps of a corner block, 5: of all, 6: all of these."""
    site = Site(look + 5000, sun_rad=2.2)
    xs, ys = (-51.0, -17.0, 17.0, 51.0), (-42.0, -14.0, 14.0, 42.0)
    for x in xs[:-1]:
        for y in ys[:-1]:
            site.block(x + 4.0, y + 4.0, x + 30.0, y + 24.0, (6.0, 9.5), _house)
    for a, b in pairwise(_rectangle(55.0, 46.0, clockwise=True)):
        site.lots(a, b, (6.0, 10.0), _house)
    for _ in range(24):
        tall, side = site.rng.uniform(3.5, 5.5), site.rng.choice([-2.9, 2.9])
        if site.rng.uniform() < 0.5:
            x, y = (
                site.rng.choice(xs[:-1]) + site.rng.uniform(6.0, 28.0),
                site.rng.choice(ys) + side,
            )
        else:
            x, y = (
                site.rng.choice(xs) + side,
                site.rng.choice(ys[:-1]) + site.rng.uniform(6.0, 22.0),
            )
        site.figure(x, y, tall / 1.5, tall, paint_outdoors.tree(site.rng))
    ground = _streets(site.rng, xs, ys, ())
    ring = [(-51.0, -42.0), (51.0, -42.0), (51.0, 42.0), (-51.0, 42.0)]
    # Each lap begins where the tour arrives, along the edge of the district.
    laps = [
        [(-17.0, -42.0), (-17.0, -14.0), (-51.0, -14.0), (-51.0, -42.0)],
        [(51.0, -42.0), (51.0, -14.0), (17.0, -14.0), (17.0, -42.0)],
        [(51.0, 42.0), (17.0, 42.0), (17.0, 14.0), (51.0, 14.0)],
        [(-51.0, 42.0), (-51.0, 14.0), (-17.0, 14.0), (-17.0, 42.0)],
    ]
    first, second, third, fourth = (lap + lap for lap in laps)
    tour = [*first, *second, ring[1], *third, ring[2], *fourth, ring[3], *ring, ring[0]]
    return site.build(
        name="district",
        description=_first_line(_district),
        ground=ground,
        sky=paint_outdoors.sky(site.rng),
        routes=[rounded_route(one, 4.0) for one in (*laps, ring, tour)],
        lanes_m=(2.2, -2.2),
        sense=Sense(frames_per_lap=350, horizon=0.62, camera_height_m=1.5),
        haze=(196, 208, 222),
        sight_m=90.0,
    )


def _house(rng: np.random.Generator, length: float) -> tuple[np.ndarray, float]:
    return paint_outdoors.facade(rng, length, rng.choice([5.0, 6.4, 8.0, 9.2, 10.6]), 24.0), 24.0


def _streets(
    rng: np.random.Generator,
    xs: tuple[float, ...],
    ys: tuple[float, ...],
    zebras: tuple[tuple[float, float], ...],
) -> Surface:
    """Paint asphalt with pavements along the houses, centre lines and crossings.

    Args:
        rng: Random numbers of the textures.
        xs: Middle lines of the streets along y.
        ys: Middle lines of the streets along x.
        zebras: Centres of zebra crossings, from the corner of the ground.
    """
    per_m, to_x, to_y = 14.0, 4.5 - xs[0], 4.5 - ys[0]
    width_m, depth_m = xs[-1] + to_x + 4.5, ys[-1] + to_y + 4.5
    c = paint_outdoors.floor(rng, width_m, depth_m, per_m, "asphalt")
    pave = c.image.copy()
    paint.masonry(pave, rng, (168, 162, 152), (0.8 * per_m, 0.8 * per_m), 0.12, staggered=False)
    street = np.zeros(c.image.shape[:2], dtype=bool)
    for x in xs:
        (left, _), (right, _) = (c.px(x + to_x + side, 0.0) for side in (-2.3, 2.3))
        street[:, left:right] = True
    for y in ys:
        (_, bottom), (_, top) = (c.px(0.0, y + to_y + side) for side in (-2.3, 2.3))
        street[top:bottom] = True
    c.image[~street] = pave[~street]
    white = (222, 220, 210)
    middle_x, middle_y = [x + to_x for x in xs], [y + to_y for y in ys]
    for x in middle_x:
        for y in np.arange(1.5, depth_m - 2.0, 3.0):
            if min(abs(y - m) for m in middle_y) > 4.0:
                c.rect(x - 0.08, y, x + 0.08, y + 1.5, white)
    for y in middle_y:
        for x in np.arange(1.5, width_m - 2.0, 3.0):
            if min(abs(x - m) for m in middle_x) > 4.0:
                c.rect(x, y - 0.08, x + 1.5, y + 0.08, white)
    for x, y in zebras:
        for dx in np.arange(-2.2, 2.2, 0.8):
            c.rect(x + dx, y - 0.9, x + dx + 0.4, y + 0.9, white)
    return Surface(c.image, per_m, -to_x, -to_y, 0.0)


def _campus(look: int) -> World:
    """Large campus seen all around; routes 1: court, 2: park, 3: everything, 4: laps of each."""
    site = Site(look + 4000, sun_rad=2.2)

    def hall(tall: float, stone: paint.Colour) -> Painter:
        return lambda rng, length: (paint_outdoors.facade(rng, length, tall, 14.0, stone), 14.0)

    def fence(rng: np.random.Generator, length: float) -> tuple[np.ndarray, float]:
        return paint_outdoors.hedge(rng, length, 2.4, 20.0), 20.0

    ring = _rectangle(100.0, 50.0, clockwise=True)
    for a, b in pairwise(ring):
        site.lots(a, b, (20.0, 30.0), fence)
    halls = [
        (-60.0, -5.0, -42.0, 5.0),  # chapel in the elliptic court
        (-88.0, 33.0, -14.0, 44.0),
        (-88.0, -44.0, -30.0, -33.0),
        (-97.0, -20.0, -91.0, 20.0),
        (18.0, -14.0, 40.0, 10.0),
        (54.0, -8.0, 82.0, 14.0),
        (14.0, 28.0, 44.0, 40.0),
        (60.0, 32.0, 90.0, 44.0),
        (26.0, -44.0, 58.0, -34.0),
    ]
    for box in halls:
        stone = paint.hue(
            site.rng.choice([12, 20, 38, 42, 45, 210]), site.rng.uniform(0.1, 0.5), 0.75
        )
        site.block(*box, (90.0, 90.0), hall(site.rng.choice([6.8, 9.4, 12.0]), stone))
    park = [(9.0, -24.0), (47.0, -22.0), (68.0, -20.0), (90.0, -16.0)]
    park += [(91.0, 22.0), (48.0, 20.0), (9.0, 18.0)]

    def court_to(last_deg: int) -> list[Point]:
        angles = np.radians(range(40, last_deg + 1, 20))
        return [(-51.0 + 32.0 * math.cos(t), 21.0 * math.sin(t)) for t in angles]

    court = court_to(320)
    routes = [
        ellipse_route(32.0, 21.0, (-51.0, 0.0)),
        rounded_route(park, 7.0),
        rounded_route([*court, *park], 7.0),
        rounded_route([*court_to(320 + 3 * 360), *park * 3, *[*court, *park] * 3], 7.0),
    ]
    for _ in range(400):
        if len(site.billboards) == 34:
            break
        x, y, tall = (
            site.rng.uniform(-96, 96),
            site.rng.uniform(-46, 46),
            site.rng.uniform(4.0, 8.0),
        )
        clear = min(np.hypot(*(r.poses(400)[:, :2] - (x, y)).T).min() for r in routes) > 3.0
        free = all(not (a - 2 < x < c + 2 and b - 2 < y < d + 2) for a, b, c, d in halls)
        if clear and free:
            site.figure(x, y, tall / 1.5, tall, paint_outdoors.tree(site.rng))
    return site.build(
        name="campus",
        description=_first_line(_campus),
        ground=_lawns(site.rng, routes),
        sky=paint_outdoors.sky(site.rng),
        routes=routes,
        lanes_m=(0.9, -0.9),
        sense=Sense(
            frames_per_lap=1400, laps=1.0, panoramic=True, horizon=0.6, camera_height_m=1.2
        ),
        haze=(190, 204, 220),
        sight_m=110.0,
    )


def _lawns(rng: np.random.Generator, routes: list[Route]) -> Surface:
    """Paint grass with gravel paths along the routes."""
    per_m = 8.0
    c = paint_outdoors.floor(rng, 202.0, 102.0, per_m, "grass")
    for route in routes:
        track = [(x + 101.0, y + 51.0) for x, y, _ in route.poses(600)]
        c.line([*track, track[0]], 3.4, (150, 132, 104))
        c.line([*track, track[0]], 2.8, (186, 170, 138))
    paint.shade(c.image, 1.0 + 0.1 * paint.noise(rng, *c.image.shape[:2], (3.0, 3.0)))
    return Surface(c.image, per_m, -101.0, -51.0, 0.0)


def _first_line(builder: Callable[[int], World]) -> str:
    return (builder.__doc__ or "").split("\n")[0]


_BUILDERS: dict[str, Callable[[int], World]] = {
    "corridor": _corridor,
    "ellipse": _ellipse,
    "figure_eight": _figure_eight,
    "town": _town,
    "campus": _campus,
    "district": _district,
    "garage": garage,
    "atrium": atrium,
    "rooms": alike.rooms,
    "wallpaper": alike.wallpaper,
    "corners": alike.corners,
}


def catalogue() -> dict[str, str]:
    """Return the description of each rendered world by its name.

    Example:
        >>> list(catalogue())[:6]
        ['corridor', 'ellipse', 'figure_eight', 'town', 'campus', 'district']
    """
    return {name: _first_line(builder) for name, builder in _BUILDERS.items()}


@lru_cache(maxsize=2)
def build_world(name: str, look: int = 0) -> World:
    """Build a world of the :func:`catalogue`; equal arguments return the same object.

    Args:
        name: Name of the world.
        look: Seed of all textures, and of the positions of houses, trees and pillars; routes and
            indoor walls do not depend on it.

    Raises:
        SourceError: If there is no such world.
    """
    if name not in _BUILDERS:
        raise SourceError(
            f"world {name!r}: no such world; expected one of {', '.join(_BUILDERS)}"
            f"{did_you_mean(name, _BUILDERS)}"
        )
    return _BUILDERS[name](look)
