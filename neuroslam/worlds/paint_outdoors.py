"""Paints facades, hedges, floors, ceilings, sky, plants and people from a seed."""

import math

import cv2
import numpy as np

from neuroslam.worlds.paint import (
    Canvas,
    Colour,
    darker,
    hue,
    masonry,
    noise,
    planks,
    plaster,
    shade,
)


def facade(
    rng: np.random.Generator,
    length_m: float,
    height_m: float,
    per_m: float,
    hall: Colour | None = None,
) -> np.ndarray:
    """Paint the front of a house or shop, or of a college hall of the colour ``hall``."""
    stone = hue(rng.uniform(34, 46), rng.uniform(0.15, 0.35), rng.uniform(0.62, 0.82))
    paint = hue(
        rng.choice([8, 30, 42, 52, 95, 190, 210, 350]),
        rng.uniform(0.08, 0.36),
        rng.uniform(0.68, 0.94),
    )
    brick = hue(rng.uniform(6, 26), rng.uniform(0.4, 0.62), rng.uniform(0.45, 0.68))
    kind = "stone" if hall else rng.choice(["paint", "paint", "brick", "brick", "stone"])
    base = hall or {"stone": stone, "paint": paint, "brick": brick}[kind]
    c = Canvas(length_m, height_m, per_m, base)
    if kind == "paint":
        plaster(c.image, rng, base, 0.08)
    elif kind == "brick":
        masonry(c.image, rng, base, (0.16 * per_m, 0.42 * per_m))
    else:
        masonry(c.image, rng, base, (0.4 * per_m, 0.9 * per_m), 0.12)

    trim = darker(base, 0.6) if rng.uniform() < 0.4 else (232, 228, 216)
    ground = min(3.2, height_m - 0.6)
    storeys = max(0, int((height_m - ground - 0.4) / 2.6))
    n = max(1, int(length_m / rng.uniform(1.9, 2.8)))
    pitch = length_m / n
    wide, tall = pitch * rng.uniform(0.38, 0.55), rng.uniform(1.3, 1.7)
    glass = hue(rng.uniform(190, 225), rng.uniform(0.15, 0.45), rng.uniform(0.25, 0.5))
    arched = bool(hall) or rng.uniform() < 0.25
    for storey in range(storeys):
        for i in range(n):
            _window(
                c,
                rng,
                (i + 0.5) * pitch,
                ground + 0.6 + 2.6 * storey,
                wide,
                tall,
                glass,
                trim,
                arched,
            )
    c.rect(0.0, height_m - 0.3, length_m, height_m, trim)
    c.rect(0.0, height_m - 0.36, length_m, height_m - 0.3, darker(trim, 0.5))
    if hall:  # a slate roof, as seen from the ground
        masonry(
            c.part(0.0, height_m - 1.0, length_m, height_m), rng, (88, 92, 102), (3.0, 5.0), 0.2
        )
        c.rect(0.0, height_m - 1.1, length_m, height_m - 1.0, trim)
    if hall:
        for i in range(n):
            _window(c, rng, (i + 0.5) * pitch, 0.8, wide, 2.0, glass, trim, True)
        _entrance(c, rng, rng.uniform(0.25, 0.75) * length_m, 1.9, 2.9, trim)
        c.rect(0.0, ground + 0.05, length_m, ground + 0.25, trim)
    elif rng.uniform() < 0.6:
        _shop(c, rng, length_m, ground)
    else:
        side = rng.integers(n)
        for i in range(n):
            if i == side:
                _entrance(c, rng, (i + 0.5) * pitch, 1.1, 2.2, trim)
            else:
                _window(c, rng, (i + 0.5) * pitch, 0.95, wide, tall, glass, trim, arched)
    c.rect(0.0, 0.0, length_m, 0.35, darker(base, 0.5))
    for x in (0.0, length_m - 0.12):
        c.rect(x, 0.0, x + 0.12, height_m, darker(base, 0.55))
    return c.image


def _window(
    c: Canvas,
    rng: np.random.Generator,
    x: float,
    z: float,
    wide: float,
    tall: float,
    glass: Colour,
    trim: Colour,
    arched: bool,
) -> None:
    half = wide / 2
    if arched:
        c.disc(x, z + tall, half + 0.1, trim)
    c.framed(
        x - half - 0.1, z - 0.08, x + half + 0.1, z + tall + 0.08 * (not arched), trim, glass, 0.1
    )
    if arched:
        c.disc(x, z + tall, half, glass)
        c.rect(x - half, z + 0.1, x + half, z + tall, glass)
    tone = rng.uniform()
    if tone < 0.3:
        c.rect(
            x - half,
            z + 0.5 * tall,
            x + half,
            z + tall - 0.02,
            hue(rng.uniform(20, 60), 0.25, 0.85),
        )
    elif tone < 0.5:
        c.polygon(
            [(x - half, z), (x - half, z + tall), (x - 0.1 * half, z + tall)], darker(glass, 1.5)
        )
    elif tone < 0.62:
        c.rect(x - half - 0.1, z - 0.3, x + half + 0.1, z - 0.05, (92, 58, 40))
        for _ in range(6):
            c.disc(
                x + rng.uniform(-half, half),
                z + 0.05,
                0.1,
                hue(rng.choice([0, 330, 50, 110]), 0.7, 0.75),
            )
    c.rect(x - 0.03, z, x + 0.03, z + tall, trim)
    c.rect(x - half, z + 0.55 * tall, x + half, z + 0.55 * tall + 0.05, trim)


def _entrance(
    c: Canvas, rng: np.random.Generator, x: float, wide: float, tall: float, trim: Colour
) -> None:
    leaf = hue(rng.choice([0, 25, 120, 215, 280]), rng.uniform(0.5, 0.8), rng.uniform(0.25, 0.55))
    c.rect(x - wide / 2 - 0.2, 0.0, x + wide / 2 + 0.2, tall + 0.25, trim)
    c.rect(x - wide / 2, 0.0, x + wide / 2, tall, leaf)
    c.rect(x - 0.02, 0.0, x + 0.02, tall, darker(leaf, 0.5))
    c.rect(x - wide / 2 + 0.1, tall - 0.5, x + wide / 2 - 0.1, tall - 0.1, (190, 205, 200))
    c.disc(x + 0.15, 1.05, 0.06, (220, 200, 120))


def _shop(c: Canvas, rng: np.random.Generator, length: float, ground: float) -> None:
    """Paint a shop: window with goods, door, sign with lettering, striped awning."""
    front = hue(rng.uniform(0, 360), rng.uniform(0.4, 0.8), rng.uniform(0.25, 0.65))
    c.rect(0.15, 0.0, length - 0.15, ground, front)
    at = 0.4 if rng.uniform() < 0.5 else length - 1.5
    c.rect(at, 0.05, at + 1.1, 2.2, darker(front, 0.55))
    c.rect(at + 0.15, 0.5, at + 0.95, 2.05, (150, 170, 176))
    left, right = (1.8, length - 0.4) if at < 1.0 else (0.4, length - 1.8)
    c.rect(left, 0.55, right, 2.25, hue(rng.uniform(35, 55), 0.3, rng.uniform(0.5, 0.85)))
    x = left + 0.15
    while x < right - 0.3:
        goods = hue(rng.uniform(0, 360), rng.uniform(0.3, 0.9), rng.uniform(0.3, 0.95))
        c.rect(x, 0.65, x + 0.3, 0.75 + rng.uniform(0.2, 1.2), goods)
        x += rng.uniform(0.4, 0.8)
    c.rect(0.15, ground - 0.65, length - 0.15, ground - 0.05, darker(front, 0.7))
    x = 0.25 * length
    while x < 0.75 * length:
        step = rng.uniform(0.15, 0.3)
        c.rect(x, ground - 0.5, x + step, ground - rng.uniform(0.15, 0.25), (244, 236, 208))
        x += step + 0.12
    if rng.uniform() < 0.6:
        stripe = hue(rng.uniform(0, 360), 0.75, 0.7)
        for i, x in enumerate(np.arange(left, right, 0.35)):
            c.rect(x, 2.0, min(x + 0.35, right), 2.55, stripe if i % 2 else (242, 238, 228))
        shade(c.part(left, 2.0, right, 2.12), 0.7)


def hedge(rng: np.random.Generator, length_m: float, height_m: float, per_m: float) -> np.ndarray:
    """Paint sections of clipped hedge, some with blossom, and of garden wall."""
    c = Canvas(length_m, height_m, per_m, (50, 80, 40))
    at = 0.0
    while at < length_m:
        end = min(length_m, at + rng.uniform(5.0, 12.0))
        part = c.part(at, 0.0, end, height_m)
        if part.size and rng.uniform() < 0.6:
            part[:] = hue(rng.uniform(75, 135), rng.uniform(0.4, 0.7), rng.uniform(0.3, 0.5))
            h, w = part.shape[:2]
            shade(
                part,
                1.0 + 0.5 * noise(rng, h, w, (4.0, 4.0)) + 0.2 * noise(rng, h, w, (20.0, 20.0)),
            )
            for _ in range(rng.choice([0, 0, 30, 60])):
                spot = at + rng.uniform(0, end - at), rng.uniform(0.3, height_m - 0.1)
                c.disc(*spot, rng.uniform(0.05, 0.12), hue(rng.choice([0, 320, 50]), 0.6, 0.9))
        elif part.size:
            tone = hue(rng.uniform(25, 45), rng.uniform(0.1, 0.3), rng.uniform(0.5, 0.7))
            masonry(part, rng, tone, (0.25 * per_m, 0.5 * per_m), 0.3)
            c.rect(at, height_m - 0.15, end, height_m, darker(tone, 1.2))
        at = end
    return c.image


def floor(
    rng: np.random.Generator, width_m: float, depth_m: float, per_m: float, kind: str
) -> Canvas:
    """Paint a floor or ground: ``carpet``, ``parquet``, ``tiles``, ``asphalt`` or ``grass``."""
    c = Canvas(width_m, depth_m, per_m, (120, 118, 112))
    h, w = c.image.shape[:2]
    if kind == "parquet":
        planks(c.image, rng, (168, 122, 78), 0.18 * per_m, 0.2)
    elif kind == "tiles":
        masonry(c.image, rng, (176, 170, 158), (0.6 * per_m, 0.6 * per_m), 0.1, staggered=False)
    else:
        colour, depth, grain = {
            "carpet": ((104, 112, 128), 0.14, 6.0),
            "asphalt": ((98, 98, 102), 0.16, 3.0),
            "grass": ((88, 128, 58), 0.3, 2.5),
        }[kind]
        c.image[:] = colour
        fine = rng.uniform(-1.0, 1.0, (h, w)).astype(np.float32)
        shade(c.image, 1.0 + depth * noise(rng, h, w, (grain, grain)) + 0.3 * depth * fine)
        shade(c.image, 1.0 + 0.12 * noise(rng, h, w, (4.0 * per_m, 4.0 * per_m)))
    return c


def lamps(rng: np.random.Generator, width_m: float, depth_m: float, per_m: float) -> Canvas:
    """Paint a ceiling of white panels with a square grid of lamps."""
    c = Canvas(width_m, depth_m, per_m, (205, 204, 198))
    masonry(c.image, rng, (205, 204, 198), (0.6 * per_m, 0.6 * per_m), 0.03, staggered=False)
    for x in np.arange(0.6, width_m, 2.4):
        for y in np.arange(0.6, depth_m, 2.4):
            c.rect(x, y, x + 0.6, y + 1.2, (255, 254, 244))
    return c


def sky(rng: np.random.Generator) -> np.ndarray:
    """Paint a panorama of the sky, ``(256, 1536, 3)``, from the horizon to 45 degrees above it."""
    h, w = 256, 1536
    up = np.linspace(1.0, 0.0, h)[:, None, None]
    image = (1.0 - up) * np.array([206, 222, 236.0]) + up * np.array([88, 142, 214.0])
    cloud = _around(rng, h, w, (70.0, 170.0))
    cloud = np.clip(2.4 * cloud - 0.35, 0.0, 0.9)[..., None]
    image = np.asarray(image * (1.0 - cloud) + 250.0 * cloud)
    for height, colour in ((30.0, (136, 158, 172)), (14.0, (92, 124, 98))):
        ridge = height * (1.0 + 0.6 * _around(rng, 1, w, (1.0, 60.0))[0])
        image[np.arange(h)[::-1, None] < ridge[None]] = colour
    return np.asarray(np.clip(image, 0, 255).astype(np.uint8))


def _around(rng: np.random.Generator, h: int, w: int, grain_px: tuple[float, float]) -> np.ndarray:
    """Return smooth noise that wraps around from the right to the left end."""
    lap = w // 6
    wide = noise(rng, h, w + lap, grain_px)
    blend = np.linspace(0.0, 1.0, lap, dtype=np.float32)
    wide[:, w:] = wide[:, w:] * (1.0 - blend) + wide[:, :lap] * blend
    return np.asarray(wide[:, lap:])


def _shrunk(image: np.ndarray) -> np.ndarray:
    """Shrink an RGBA image that was drawn at double size."""
    return cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)


def plant(rng: np.random.Generator) -> np.ndarray:
    """Paint a pot plant, ``uint8 (h, w, 4)``, 0.7 m wide and 1.5 m high."""
    image = np.zeros((300, 140, 4), dtype=np.uint8)
    green = rng.uniform(80, 140)
    for _ in range(26):
        angle, reach = rng.uniform(-1.1, 1.1), rng.uniform(80, 190)
        tip = (
            int(70 + reach * 0.36 * math.sin(angle) * 1.1),
            int(225 - reach * math.cos(0.7 * angle)),
        )
        tone = (*hue(green + rng.uniform(-15, 15), 0.65, rng.uniform(0.25, 0.62)), 255)
        cv2.line(image, (70, 232), tip, tone, 3, cv2.LINE_AA)
        cv2.ellipse(
            image, tip, (22, 9), math.degrees(angle) - 60 * np.sign(angle), 0, 360, tone, -1
        )
    pot = (*hue(rng.choice([15, 25, 200, 0]), rng.uniform(0.3, 0.7), rng.uniform(0.4, 0.75)), 255)
    shape = np.array([[40, 225], [100, 225], [90, 298], [50, 298]], dtype=np.int32)
    cv2.fillPoly(image, [shape], pot, cv2.LINE_AA)
    cv2.rectangle(image, (36, 222), (104, 236), (*darker(pot[:3], 0.8), 255), -1)
    return _shrunk(image)


def tree(rng: np.random.Generator) -> np.ndarray:
    """Paint a tree, ``uint8 (h, w, 4)``, whose width is two thirds of its height."""
    image = np.zeros((480, 320, 4), dtype=np.uint8)
    cv2.rectangle(image, (148, 250), (172, 479), (92, 70, 52, 255), -1)
    for dx in (-60, 50):
        cv2.line(image, (160, 330), (160 + dx, 230), (86, 64, 48, 255), 9, cv2.LINE_AA)
    green, tall = rng.uniform(65, 135), rng.uniform(0.85, 1.25)
    for i in range(90):
        angle, r = rng.uniform(0, 2 * math.pi), math.sqrt(rng.uniform()) * 110
        at = (int(160 + r * math.cos(angle)), int(165 + r * tall * math.sin(angle)))
        light = 0.3 + 0.3 * (i / 90) + 0.12 * (165 - at[1]) / 110
        tone = (*hue(green + rng.uniform(-14, 14), 0.6, min(max(light, 0.2), 0.8)), 255)
        cv2.circle(image, at, int(rng.uniform(16, 34)), tone, -1, cv2.LINE_AA)
    return _shrunk(image)


def person(rng: np.random.Generator) -> list[np.ndarray]:
    """Paint a pedestrian from the front in four phases of a stride, 0.8 m wide and 1.8 m high."""
    coat, legs = (hue(rng.uniform(0, 360), rng.uniform(0.3, 0.8), v) for v in (0.6, 0.3))
    skin = hue(rng.uniform(18, 30), rng.uniform(0.3, 0.65), rng.uniform(0.4, 0.9))
    hair = hue(rng.uniform(15, 45), 0.5, rng.uniform(0.1, 0.6))
    cycle = []
    for phase in range(4):
        image = np.zeros((432, 192, 4), dtype=np.uint8)
        swing = math.sin(phase * math.pi / 2)
        for side in (-1, 1):
            foot = (int(96 + 22 * side), int(424 - 22 * max(0.0, side * swing)))
            cv2.line(image, (96 + 16 * side, 235), foot, (*legs, 255), 30, cv2.LINE_AA)
            cv2.ellipse(image, foot, (17, 8), 0, 0, 360, (30, 28, 28, 255), -1, cv2.LINE_AA)
            hand = (int(96 + 56 * side), int(235 + 24 * side * swing))
            cv2.line(
                image, (96 + 40 * side, 105), hand, (*darker(coat, 0.85), 255), 22, cv2.LINE_AA
            )
            cv2.circle(image, hand, 11, (*skin, 255), -1, cv2.LINE_AA)
        body = np.array([[52, 92], [140, 92], [132, 250], [60, 250]], dtype=np.int32)
        cv2.fillPoly(image, [body], (*coat, 255), cv2.LINE_AA)
        cv2.ellipse(image, (96, 92), (44, 16), 0, 180, 360, (*coat, 255), -1, cv2.LINE_AA)
        cv2.rectangle(image, (86, 62), (106, 88), (*skin, 255), -1)
        cv2.ellipse(image, (96, 42), (24, 31), 0, 0, 360, (*skin, 255), -1, cv2.LINE_AA)
        cv2.ellipse(image, (96, 32), (27, 26), 0, 180, 360, (*hair, 255), -1, cv2.LINE_AA)
        for eye in (87, 105):
            cv2.circle(image, (eye, 43), 3, (30, 26, 24, 255), -1, cv2.LINE_AA)
        cycle.append(_shrunk(image))
    return cycle
