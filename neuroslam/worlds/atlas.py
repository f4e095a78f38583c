"""Texture atlas: all surfaces of a world in one image, so that one lookup draws a frame.

A pixel of the frame may cover many texture pixels of a far wall; sampling a single one would
flicker. So a wall is stored at every pair of (horizontal, vertical) halvings, averaged beforehand
(a "rip-map"; Akenine-Moeller et al., Real-Time Rendering), and ground and ceiling at equal halvings
(a "mip-map"; Williams 1983).
"""

import cv2
import numpy as np

LEVELS_U = 7
LEVELS_V = 5
LEVELS_GROUND = 6
_WIDTH = 8192
_PAD = 2


class Atlas:
    """Packs textures on shelves of one image.

    Attributes:
        image: ``uint8 (h, w, 3)``.
        strip_origin: Column and row of each strip's first pixel, ``(n, LEVELS_U, LEVELS_V, 2)``.
        strip_scale: Pixels per metre along and up, ``(n, LEVELS_U, LEVELS_V, 2)``.
        strip_per_m: Pixels per metre at full size, ``(n,)``.
        ground: Column, row, columns and rows per full-size pixel, ``(LEVELS_GROUND, 4)``.
        ceiling: The same of the ceiling, or ``None``.
        sky: Column, row, width and height of the sky, or ``None``.
    """

    def __init__(
        self,
        strips: list[tuple[np.ndarray, float]],
        ground: np.ndarray,
        ceiling: np.ndarray | None,
        sky: np.ndarray | None,
    ) -> None:
        tiles: list[np.ndarray] = []
        for image, _ in strips:
            tiles += [_halved(image, u, v) for u in range(LEVELS_U) for v in range(LEVELS_V)]
        n_strip_tiles = len(tiles)
        for surface in (ground, ceiling):
            if surface is not None:
                tiles += [_halved(surface, level, level) for level in range(LEVELS_GROUND)]
        if sky is not None:
            tiles.append(sky)
        wrapped = len(tiles) - 1 if sky is not None else -1
        self.image, corners = _pack(tiles, wrapped)

        shape = (len(strips), LEVELS_U, LEVELS_V, 2)
        self.strip_origin = corners[:n_strip_tiles].reshape(shape).astype(np.float32)
        size = np.array([tile.shape[1::-1] for tile in tiles], dtype=np.float64)
        full = np.array([image.shape[1::-1] for image, _ in strips], dtype=np.float64)
        per_m = np.array([scale for _, scale in strips])
        scale = size[:n_strip_tiles].reshape(shape) / full[:, None, None]
        self.strip_scale = (scale * per_m[:, None, None, None]).astype(np.float32)
        self.strip_per_m = per_m.astype(np.float32)

        surfaces = []
        for i in range(n_strip_tiles, len(tiles) - (sky is not None), LEVELS_GROUND):
            part = slice(i, i + LEVELS_GROUND)
            surfaces.append(np.hstack([corners[part], size[part] / size[i]]).astype(np.float32))
        self.ground = surfaces[0]
        self.ceiling = surfaces[1] if ceiling is not None else None
        self.sky = None if sky is None else (*corners[-1].tolist(), *size[-1].tolist())


def halvings(image: np.ndarray) -> list[np.ndarray]:
    """Return an image at full, half, quarter ... size, down to four pixels."""
    levels = 1
    while min(image.shape[:2]) >> levels >= 4:
        levels += 1
    return [_halved(image, level, level) for level in range(levels)]


def _halved(image: np.ndarray, times_u: int, times_v: int) -> np.ndarray:
    size = (max(1, image.shape[1] >> times_u), max(1, image.shape[0] >> times_v))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def _pack(tiles: list[np.ndarray], wrapped: int) -> tuple[np.ndarray, np.ndarray]:
    """Put tiles on shelves, highest first; each with a margin of its edge, or wrapped around."""
    width = max(_WIDTH, max(tile.shape[1] for tile in tiles) + 2 * _PAD)
    corners = np.zeros((len(tiles), 2), dtype=np.int64)
    x = y = shelf = 0
    for i in sorted(range(len(tiles)), key=lambda k: -tiles[k].shape[0]):
        h, w = tiles[i].shape[0] + 2 * _PAD, tiles[i].shape[1] + 2 * _PAD
        if x + w > width:
            x, y, shelf = 0, y + shelf, 0
        corners[i] = x + _PAD, y + _PAD
        x, shelf = x + w, max(shelf, h)
    image = np.zeros((y + shelf, width, 3), dtype=np.uint8)
    for i, (tile, (left, top)) in enumerate(zip(tiles, corners, strict=True)):
        h, w = tile.shape[:2]
        side = cv2.BORDER_WRAP if i == wrapped else cv2.BORDER_REPLICATE
        wide = cv2.copyMakeBorder(tile, 0, 0, _PAD, _PAD, side)
        wide = cv2.copyMakeBorder(wide, _PAD, _PAD, 0, 0, cv2.BORDER_REPLICATE)
        image[top - _PAD : top + h + _PAD, left - _PAD : left + w + _PAD] = wide
    return image, corners
