"""Builds a rendered world: walls with their textures, pillars and figures."""

import math
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from neuroslam.geometry import TWO_PI
from neuroslam.worlds import paint, paint_outdoors
from neuroslam.worlds.scene import Billboard, World

Point = tuple[float, float]
Painter = Callable[[np.random.Generator, float], tuple[np.ndarray, float]]
"""Paints a wall of a length in metres; returns the texture and its pixels per metre."""


class Site:
    """Collects walls, pillars and figures while a world is being built."""

    def __init__(self, look: int, sun_rad: float | None = None) -> None:
        self.sun_rad = sun_rad  # direction of the sun; None: all walls are lit equally
        self.rng = np.random.default_rng([20_260, look])
        self.walls: list[tuple[float, float, float, float]] = []
        self.wall_strips: list[int] = []
        self.offsets: list[float] = []
        self.strips: list[tuple[np.ndarray, float]] = []
        self.pillars: list[tuple[float, float, float]] = []
        self.pillar_strips: list[int] = []
        self.billboards: list[Billboard] = []
        self.cutouts: list[np.ndarray] = []

    def wall(self, points: list[Point], painter: Painter, smooth: bool = False) -> None:
        """Add walls along a polyline, visible from its right; ``smooth``: with one texture."""
        legs = list(pairwise(points))
        lengths = [math.dist(a, b) for a, b in legs]
        offset = 0.0
        for i, (a, b) in enumerate(legs):
            if i == 0 or not smooth:
                image, per_m = painter(self.rng, sum(lengths) if smooth else lengths[i])
                if (
                    self.sun_rad is not None
                ):  # the normal of a wall is to the right of its direction
                    normal = math.atan2(b[1] - a[1], b[0] - a[0]) - math.pi / 2.0
                    paint.shade(image, 0.85 + 0.2 * math.cos(normal - self.sun_rad))
                self.strips.append((image, per_m))
                offset = 0.0
            self.walls.append((*a, *b))
            self.wall_strips.append(len(self.strips) - 1)
            self.offsets.append(offset)
            offset += lengths[i]

    def lots(self, a: Point, b: Point, lot_m: tuple[float, float], painter: Painter) -> None:
        """Add a row of houses from ``a`` to ``b``, each with its own front."""
        length = math.dist(a, b)
        cuts = [0.0]
        while length - cuts[-1] > 1.5 * lot_m[1]:
            cuts.append(cuts[-1] + self.rng.uniform(*lot_m))
        n = max(1, round((length - cuts[-1]) / lot_m[1]))
        cuts += [cuts[-1] + (length - cuts[-1]) * (i + 1) / n for i in range(n)]
        east, north = (b[0] - a[0]) / length, (b[1] - a[1]) / length
        at = [(a[0] + east * t, a[1] + north * t) for t in cuts]
        first = len(self.strips)
        self.wall(at, painter)
        for i in range(len(cuts) - 2):
            left, right = (self.strips[first + i + k] for k in (0, 1))
            here, behind = at[i + 1], (at[i + 1][0] - 6.0 * north, at[i + 1][1] + 6.0 * east)
            if _height_m(left) > _height_m(right):  # the side of the higher house is visible
                self.wall([here, behind], partial(_side, front=left))
            elif _height_m(left) < _height_m(right):
                self.wall([behind, here], partial(_side, front=right))

    def block(
        self,
        x0: float,
        y0: float,
        x1: float,
        y1: float,
        lot_m: tuple[float, float],
        painter: Painter,
    ) -> None:
        """Add a rectangular block of houses, visible from outside."""
        ring = [(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)]
        for a, b in pairwise(ring):
            self.lots(a, b, lot_m, painter)

    def pillar(
        self, x: float, y: float, radius: float, height: float, colour: paint.Colour
    ) -> None:
        """Add a round pillar with random bands."""
        c = paint.Canvas(TWO_PI * radius, height, 64.0, colour)
        for z in np.arange(0.15, height - 0.2, 0.45):
            c.rect(0.0, z, c.width_m, z + 0.2, paint.hue(self.rng.uniform(0, 360), 0.6, 0.7))
        around = np.linspace(0.0, TWO_PI, c.image.shape[1])[None]
        paint.shade(c.image, np.repeat(0.85 + 0.15 * np.cos(around), len(c.image), axis=0))
        self.strips.append((c.image, 64.0))
        self.pillars.append((x, y, radius))
        self.pillar_strips.append(len(self.strips) - 1)

    def figure(self, x: float, y: float, width: float, height: float, image: np.ndarray) -> None:
        """Add a cut-out."""
        self.cutouts.append(image)
        self.billboards.append(Billboard(x, y, width, height, len(self.cutouts) - 1))

    def build(self, **rest: Any) -> World:  # noqa: ANN401 - checked by World
        """Return the finished world, with six kinds of pedestrians.

        Args:
            **rest: The other attributes of :class:`World`.
        """
        people: list[tuple[int, ...]] = []
        for _ in range(6):
            cycle = paint_outdoors.person(self.rng)
            people.append(tuple(range(len(self.cutouts), len(self.cutouts) + len(cycle))))
            self.cutouts += cycle
        return World(
            walls=np.array(self.walls),
            wall_strips=np.array(self.wall_strips),
            wall_offsets_m=np.array(self.offsets),
            strips=self.strips,
            pillars=np.array(self.pillars).reshape(-1, 3),
            pillar_strips=np.array(self.pillar_strips, dtype=int),
            billboards=tuple(self.billboards),
            cutouts=tuple(self.cutouts),
            people=tuple(people),
            **rest,
        )


def _height_m(strip: tuple[np.ndarray, float]) -> float:
    return float(strip[0].shape[0] / strip[1])


def _side(
    rng: np.random.Generator, length_m: float, front: tuple[np.ndarray, float]
) -> tuple[np.ndarray, float]:
    """Paint the windowless side of a house in the colour of its front."""
    r, g, b = np.median(front[0], axis=(0, 1)).astype(int).tolist()
    colour = r, g, b
    c = paint.Canvas(length_m, _height_m(front), 12.0, colour)
    paint.plaster(c.image, rng, colour, 0.1)
    c.rect(0.0, c.height_m - 0.3, length_m, c.height_m, paint.darker(colour, 0.6))
    return c.image, c.image.shape[0] / c.height_m
