"""Paints the textures of indoor surfaces from a seed: masonry, wood, doors, posters.

Colours are RGB in 0..255, lengths are metres, heights are above the floor.
"""

import math
from collections.abc import Callable

import cv2
import numpy as np

Colour = tuple[int, int, int]


def hue(degrees: float, saturation: float, value: float) -> Colour:
    """Return the RGB colour of a hue (degrees), saturation and value (0..1).

    Example:
        >>> hue(0.0, 1.0, 1.0)
        (255, 0, 0)
    """
    wheel = (np.array([5.0, 3.0, 1.0]) + degrees / 60.0) % 6.0
    share = np.clip(np.minimum(wheel, 4.0 - wheel), 0.0, 1.0)
    rgb = 255.0 * value * (1.0 - saturation * share)
    r, g, b = (round(float(c)) for c in rgb)
    return r, g, b


def darker(colour: Colour, factor: float) -> Colour:
    """Return ``colour`` times ``factor``, clipped at white."""
    r, g, b = (min(255, int(c * factor)) for c in colour)
    return r, g, b


def noise(rng: np.random.Generator, h: int, w: int, grain_px: tuple[float, float]) -> np.ndarray:
    """Return smooth noise in about [-1, 1], ``float32 (h, w)``; grain (down, across) in px."""
    total = np.zeros((h, w), dtype=np.float32)
    weight = 0.6
    for octave in range(3):
        size = [max(2, math.ceil(n / g * 2**octave)) for n, g in zip((h, w), grain_px, strict=True)]
        coarse = rng.uniform(-1.0, 1.0, (min(size[0], h), min(size[1], w))).astype(np.float32)
        total += weight * cv2.resize(coarse, (w, h), interpolation=cv2.INTER_LINEAR)
        weight *= 0.5
    return total


class Canvas:
    """Texture of a wall or floor: x to the right from its left end, z up from its foot."""

    def __init__(self, width_m: float, height_m: float, per_m: float, colour: Colour) -> None:
        self.per_m = per_m
        self.width_m, self.height_m = width_m, height_m
        shape = (max(2, round(height_m * per_m)), max(2, round(width_m * per_m)))
        self.image = np.empty((*shape, 3), dtype=np.uint8)
        self.image[:] = colour

    def px(self, x: float, z: float) -> tuple[int, int]:
        """Return column and row of a point in metres."""
        return round(x * self.per_m), round((self.height_m - z) * self.per_m)

    def part(self, x0: float, z0: float, x1: float, z1: float) -> np.ndarray:
        """Return a writable view of a rectangle, clipped at the borders of the image."""
        (left, bottom), (right, top) = self.px(x0, z0), self.px(x1, z1)
        return self.image[max(top, 0) : max(bottom, 0), max(left, 0) : max(right, 0)]

    def rect(self, x0: float, z0: float, x1: float, z1: float, colour: Colour) -> None:
        """Fill a rectangle."""
        self.part(x0, z0, x1, z1)[:] = colour

    def framed(
        self, x0: float, z0: float, x1: float, z1: float, frame: Colour, fill: Colour, edge: float
    ) -> None:
        """Fill a rectangle with a frame of width ``edge`` in metres and a shadow below."""
        self.rect(x0 - 0.02, z0 - 0.04, x1 + 0.03, z1, darker(frame, 0.45))
        self.rect(x0, z0, x1, z1, frame)
        self.rect(x0 + edge, z0 + edge, x1 - edge, z1 - edge, fill)

    def disc(self, x: float, z: float, radius: float, colour: Colour) -> None:
        """Fill a circle."""
        cv2.circle(
            self.image, self.px(x, z), max(1, round(radius * self.per_m)), colour, -1, cv2.LINE_AA
        )

    def line(self, points: list[tuple[float, float]], width: float, colour: Colour) -> None:
        """Draw a polyline."""
        pixels = np.array([self.px(*point) for point in points], dtype=np.int32)
        thick = max(1, round(width * self.per_m))
        cv2.polylines(self.image, [pixels], False, colour, thick, cv2.LINE_AA)

    def polygon(self, points: list[tuple[float, float]], colour: Colour) -> None:
        """Fill a polygon."""
        pixels = np.array([self.px(*point) for point in points], dtype=np.int32)
        cv2.fillPoly(self.image, [pixels], colour, cv2.LINE_AA)


def shade(part: np.ndarray, factor: np.ndarray | float) -> None:
    """Multiply a part of an image by a factor, ``(h, w)`` or a number, in place."""
    if isinstance(factor, np.ndarray) and factor.ndim == 2:
        factor = factor[..., None]
    part[:] = np.clip(part * factor, 0, 255).astype(np.uint8)


def plaster(
    part: np.ndarray, rng: np.random.Generator, colour: Colour, depth: float = 0.05
) -> None:
    """Fill with slightly uneven paint."""
    part[:] = colour
    if part.size:
        h, w = part.shape[:2]
        shade(part, 1.0 + depth * noise(rng, h, w, (25.0, 40.0)))


def masonry(
    part: np.ndarray,
    rng: np.random.Generator,
    colour: Colour,
    stone_px: tuple[float, float],
    spread: float = 0.25,
    staggered: bool = True,
) -> None:
    """Fill with bricks, blocks or tiles of ``stone_px`` (down, across), each with its own shade."""
    h, w = part.shape[:2]
    if not part.size:
        return
    row = (np.arange(h) / stone_px[0])[::-1]
    shift = 0.5 * (row.astype(int) % 2) if staggered else np.zeros(h)
    column = np.arange(w)[None] / stone_px[1] + shift[:, None]
    tone = rng.uniform(1.0 - spread, 1.0 + spread, (int(row.max()) + 1, int(column.max()) + 2))
    factor = tone[row.astype(int)[:, None], column.astype(int)]
    joint = (row % 1.0 < 1.1 / stone_px[0])[:, None] | (column % 1.0 < 1.1 / stone_px[1])
    part[:] = colour
    shade(part, factor * (1.0 + 0.06 * noise(rng, h, w, (40.0, 60.0))))
    part[joint] = (0.55 * np.array(colour) + 70.0).astype(np.uint8)


def planks(
    part: np.ndarray,
    rng: np.random.Generator,
    colour: Colour,
    plank_px: float,
    spread: float = 0.16,
) -> None:
    """Fill with upright wooden planks."""
    h, w = part.shape[:2]
    if not part.size:
        return
    column = np.arange(w) / plank_px
    tone = rng.uniform(1.0 - spread, 1.0 + spread, int(column.max()) + 1)[column.astype(int)]
    grain = 1.0 + 0.14 * noise(rng, h, w, (60.0, 2.5))
    part[:] = colour
    shade(part, grain * tone * np.where(column % 1.0 < 1.0 / plank_px, 0.6, 1.0))


def door(c: Canvas, rng: np.random.Generator, x: float, z: float = 0.0) -> float:
    """Paint a door at ``x``; return its width."""
    wide, tall = 0.95, 2.1
    leaf = hue(
        rng.choice([25, 28, 210, 120, 0, 45]), rng.uniform(0.35, 0.6), rng.uniform(0.35, 0.7)
    )
    c.framed(x, z, x + wide, z + tall, darker(leaf, 0.55), leaf, 0.07)
    planks(c.part(x + 0.07, z + 0.02, x + wide - 0.07, z + tall - 0.07), rng, leaf, 9.0, 0.05)
    style = rng.integers(3)
    if style == 0:
        c.framed(x + 0.6, z + 1.15, x + 0.76, z + 1.9, darker(leaf, 0.5), (196, 214, 222), 0.02)
    elif style == 1:
        for low in (0.25, 1.15):
            c.framed(
                x + 0.2,
                z + low,
                x + 0.75,
                z + low + 0.7,
                darker(leaf, 0.7),
                darker(leaf, 1.12),
                0.04,
            )
    else:
        c.framed(x + 0.2, z + 1.2, x + 0.75, z + 1.9, darker(leaf, 0.5), (176, 204, 214), 0.03)
        c.line([(x + 0.25, z + 1.3), (x + 0.6, z + 1.85)], 0.05, (220, 232, 238))
    c.disc(x + 0.14, z + 1.02, 0.04, (212, 206, 190))
    c.rect(x + wide + 0.1, z + 1.5, x + wide + 0.32, z + 1.68, (236, 236, 230))
    c.rect(x + wide + 0.13, z + 1.55, x + wide + 0.29, z + 1.6, (60, 60, 70))
    return wide + 0.35


def poster(c: Canvas, rng: np.random.Generator, x: float, z: float = 0.0) -> float:
    """Paint a poster with a bold motif at ``x``; return its width."""
    wide, tall = rng.uniform(0.6, 1.1), rng.uniform(0.8, 1.15)
    low = z + rng.uniform(0.85, 1.05)
    base = rng.uniform(0, 360)
    paper, ink = (
        hue(base, rng.uniform(0.1, 0.75), 0.95),
        hue(base + rng.uniform(90, 270), 0.8, 0.75),
    )
    c.framed(x, low, x + wide, low + tall, (240, 238, 230), paper, 0.03)
    motif = rng.integers(5)
    mid = (x + wide / 2, low + 0.58 * tall)
    if motif == 0:
        for i, radius in enumerate((0.28, 0.19, 0.1)):
            c.disc(*mid, radius * wide / 0.7, ink if i % 2 == 0 else paper)
    elif motif == 1:
        for i in range(4):
            at = low + 0.25 * tall + 0.16 * tall * i
            c.rect(x + 0.08, at, x + wide - 0.08, at + 0.08 * tall, ink)
    elif motif == 2:
        c.polygon(
            [(x + 0.08, low + 0.25), (mid[0], low + tall - 0.1), (x + wide - 0.08, low + 0.25)], ink
        )
        c.disc(x + 0.75 * wide, low + 0.82 * tall, 0.07, (250, 210, 80))
    elif motif == 3:
        for i in range(3):
            for j in range(3):
                tone = hue(base + 70 * (i + j), 0.7, rng.uniform(0.4, 0.95))
                left, foot = x + 0.06 + i * (wide - 0.1) / 3, low + 0.2 * tall + j * 0.25 * tall
                c.rect(left, foot, left + (wide - 0.16) / 3, foot + 0.22 * tall, tone)
    else:
        c.rect(x + 0.03, low + 0.25 * tall, x + wide / 2, low + tall - 0.03, ink)
        c.disc(*mid, 0.2 * wide, (245, 245, 240))
    for i in range(2):
        c.rect(
            x + 0.08,
            low + 0.07 + 0.08 * i,
            x + wide - 0.1 - 0.15 * i,
            low + 0.11 + 0.08 * i,
            (70, 70, 80),
        )
    return wide


def painting(c: Canvas, rng: np.random.Generator, x: float, z: float = 0.0) -> float:
    """Paint a framed landscape or portrait at ``x``; return its width."""
    wide, tall = rng.uniform(0.8, 1.9), rng.uniform(0.8, 1.3)
    low = z + rng.uniform(0.75, 0.95)
    gold = hue(rng.uniform(34, 48), 0.6, rng.uniform(0.5, 0.85))
    sky = hue(
        rng.choice([25, 40, 200, 210, 220, 350]), rng.uniform(0.15, 0.5), rng.uniform(0.5, 0.95)
    )
    c.framed(x, low, x + wide, low + tall, gold, sky, 0.08)
    inner = c.part(x + 0.08, low + 0.08, x + wide - 0.08, low + tall - 0.08)
    h, w = inner.shape[:2]
    if rng.uniform() < 0.6:
        hills = noise(rng, 1, w, (1.0, w / 3.0))[0]
        for level, tone in ((0.45, 0.8), (0.65, 0.55), (0.85, 0.3)):
            colour = hue(rng.uniform(40, 150), rng.uniform(0.2, 0.55), tone)
            edge = h * (level + 0.18 * np.roll(hills, int(level * w)))
            inner[np.arange(h)[:, None] > edge[None]] = colour
    else:
        skin, coat = hue(25, 0.35, 0.8), hue(rng.uniform(0, 360), 0.6, 0.35)
        cv2.ellipse(inner, (w // 2, h), (w // 3, h // 2), 0, 180, 360, coat, -1, cv2.LINE_AA)
        cv2.ellipse(inner, (w // 2, h * 2 // 5), (w // 8, h // 6), 0, 0, 360, skin, -1, cv2.LINE_AA)
    return wide


def board(c: Canvas, rng: np.random.Generator, x: float, z: float = 0.0) -> float:
    """Paint a notice board with papers, or a whiteboard with writing; return its width."""
    wide, low, tall = rng.uniform(1.2, 1.8), z + 0.9, 1.05
    white = rng.uniform() < 0.4
    fill = (238, 242, 244) if white else (176, 132, 84)
    c.framed(x, low, x + wide, low + tall, (150, 150, 155) if white else (96, 66, 40), fill, 0.05)
    for _ in range(7):
        left, foot = x + rng.uniform(0.1, wide - 0.4), low + rng.uniform(0.1, 0.65)
        if white:
            end = left + rng.uniform(0.15, 0.35), foot + rng.uniform(-0.1, 0.25)
            c.line([(left, foot), end], 0.03, hue(rng.choice([0, 120, 220]), 0.9, 0.6))
        else:
            paper = hue(rng.uniform(0, 360), rng.uniform(0.0, 0.5), 0.95)
            c.rect(left, foot, left + 0.24, foot + rng.uniform(0.2, 0.32), paper)
    return wide


def window(c: Canvas, rng: np.random.Generator, x: float, z: float = 0.0) -> float:
    """Paint a window with sky and trees behind it; return its width."""
    wide, low, tall = rng.uniform(1.1, 1.7), z + 0.9, 1.25
    c.framed(x, low, x + wide, low + tall, (232, 230, 224), (206, 228, 246), 0.06)
    view = c.part(x + 0.06, low + 0.06, x + wide - 0.06, low + 0.55)
    edge = view.shape[0] * (0.35 + 0.3 * noise(rng, 1, view.shape[1], (1.0, 12.0))[0])
    view[np.arange(view.shape[0])[:, None] > edge[None]] = hue(rng.uniform(80, 130), 0.45, 0.5)
    c.rect(x + wide / 2 - 0.03, low, x + wide / 2 + 0.03, low + tall, (232, 230, 224))
    c.rect(x - 0.06, low - 0.07, x + wide + 0.06, low, (210, 206, 198))
    return wide


def radiator(c: Canvas, rng: np.random.Generator, x: float, z: float = 0.0) -> float:
    """Paint a radiator under a shelf of books; return its width."""
    wide = 1.1
    c.rect(x, z + 0.15, x + wide, z + 0.75, (222, 220, 212))
    for i in range(10):
        c.rect(x + 0.11 * i, z + 0.18, x + 0.11 * i + 0.04, z + 0.72, (160, 158, 150))
    c.rect(x - 0.05, z + 1.3, x + wide + 0.05, z + 1.35, (110, 76, 46))
    at = x
    while at < x + wide - 0.08:
        step, tall = rng.uniform(0.05, 0.1), rng.uniform(0.22, 0.34)
        c.rect(
            at,
            z + 1.35,
            at + step,
            z + 1.35 + tall,
            hue(rng.uniform(0, 360), 0.6, rng.uniform(0.35, 0.8)),
        )
        at += step
    return wide


def extinguisher(c: Canvas, rng: np.random.Generator, x: float, z: float = 0.0) -> float:
    """Paint a fire extinguisher under its sign; return its width."""
    c.rect(x + 0.05, z + 0.55, x + 0.25, z + 1.1, (196, 28, 26))
    c.rect(x + 0.1, z + 1.1, x + 0.2, z + 1.18, (30, 30, 30))
    c.rect(x + 0.08, z + 0.75, x + 0.22, z + 0.92, (238, 236, 226))
    c.rect(x, z + 1.5, x + 0.3, z + 1.8, hue(rng.choice([0, 130]), 0.85, 0.75))
    return 0.3


WallObject = Callable[[Canvas, np.random.Generator, float, float], float]
"""Paints an object on a canvas at x, z in metres, and returns its width in metres."""

INDOORS: tuple[WallObject, ...] = (
    door,
    poster,
    extinguisher,
    window,
    door,
    board,
    poster,
    radiator,
    door,
    poster,
)
GALLERY: tuple[WallObject, ...] = (painting, painting, door, painting, painting, window)
_MAX_WIDTH_M: dict[WallObject, float] = {
    door: 1.35,
    poster: 1.1,
    painting: 1.9,
    board: 1.8,
    window: 1.75,
    radiator: 1.15,
}
_MARGIN_M = 0.12


def interior(
    rng: np.random.Generator,
    length_m: float,
    height_m: float,
    per_m: float,
    objects: tuple[WallObject, ...] = INDOORS,
    gap_m: tuple[float, float] = (0.35, 1.0),
) -> np.ndarray:
    """Paint an indoor wall: sections of plaster, brick and wood, with objects on them."""
    c = Canvas(length_m, height_m, per_m, (225, 220, 205))
    at = 0.0
    while at < length_m:
        end = min(length_m, at + rng.uniform(3.0, 6.5))
        if length_m - end < 1.5:
            end = length_m
        _cover(c, rng, at, end)
        at = end
    c.rect(0.0, 0.0, length_m, 0.1, (66, 58, 52))
    deck: list[int] = []
    at = rng.uniform(0.2, 0.5)
    while at + 0.3 + _MARGIN_M < length_m:
        if not deck:  # a shuffled deck, so that each kind of object occurs regularly
            deck = rng.permutation(len(objects)).tolist()
        room = length_m - at - _MARGIN_M
        fitting = [k for k in deck if _MAX_WIDTH_M.get(objects[k], 0.3) <= room]
        if not fitting:
            extinguisher(c, rng, at, 0.0)
            break
        deck.remove(fitting[0])
        at += objects[fitting[0]](c, rng, at, 0.0) + rng.uniform(*gap_m)
    _light(c, 2.4)
    return c.image


def _cover(c: Canvas, rng: np.random.Generator, x0: float, x1: float) -> None:
    """Paint a section of an indoor wall with a random material."""
    kind = rng.choice(["paint", "two tone", "two tone", "brick", "wood", "dado"])
    part = c.part(x0, 0.0, x1, c.height_m)
    wall = hue(
        rng.choice([32, 42, 50, 80, 120, 200, 18]), rng.uniform(0.05, 0.2), rng.uniform(0.76, 0.92)
    )
    if kind == "brick":
        tone = hue(rng.uniform(8, 28), rng.uniform(0.4, 0.6), rng.uniform(0.5, 0.7))
        masonry(part, rng, tone, (0.11 * c.per_m, 0.3 * c.per_m))
        return
    if kind == "wood":
        planks(part, rng, hue(rng.uniform(22, 34), 0.5, rng.uniform(0.5, 0.7)), 0.22 * c.per_m)
        return
    plaster(part, rng, wall)
    strong = hue(
        rng.choice([0, 18, 35, 95, 150, 205, 225]), rng.uniform(0.25, 0.5), rng.uniform(0.4, 0.7)
    )
    if kind == "two tone":
        plaster(c.part(x0, 0.0, x1, 0.95), rng, strong)
        c.rect(x0, 0.95, x1, 1.0, darker(strong, 0.6))
    elif kind == "dado":
        planks(c.part(x0, 0.0, x1, 0.85), rng, hue(28, 0.5, 0.5), 0.16 * c.per_m)
        c.rect(x0, 0.85, x1, 0.92, hue(28, 0.5, 0.36))


def _light(c: Canvas, spacing_m: float) -> None:
    """Shade a wall as lit by lamps above: pools of light, dark edges at floor and ceiling."""
    h, w = c.image.shape[:2]
    z = (np.arange(h)[::-1] + 0.5) / c.per_m
    x = (np.arange(w) + 0.5) / c.per_m
    fall = 1.0 - 0.28 * np.exp(-z / 0.18) - 0.2 * np.exp(-(c.height_m - z) / 0.2)
    pool = 1.0 + 0.1 * np.cos(2.0 * math.pi * x / spacing_m)
    shade(c.image, np.multiply.outer(fall, pool).astype(np.float32))
