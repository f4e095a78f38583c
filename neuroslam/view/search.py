r"""Exact search for the stored template nearest to a view, over all horizontal shifts.

A template is kept as bytes, column after column, so the columns that overlap at a shift are one
slice of a row, and ``cv2.batchDistance`` runs over them where they lie. In large memories most
templates are never looked at. With pixels of a block summed to :math:`S = s\,m + r,\ 0 \le r < s`,

.. math:: \sum_{i \in b} |x_i - y_i| \;\ge\; |S_x - S_y| \;\ge\; s\,|m_x - m_y| - (s - 1)

so the block means :math:`m` alone, one byte for some ten pixels, give a lower bound of the
distance. Only templates whose bound is below the best distance found are compared, so the answer
is that of comparing all.
"""

from typing import NamedTuple, Self

import cv2
import numpy as np

from neuroslam.config import ViewConfig

PRUNE_FROM = 3000
"""Templates from which on the bounds are worth their cost."""

_PROBES = 32
_MAX_BLOCKS = 64
_LISTED = 16
_AT_ONCE = 4096  # templates whose pixels stay in the cache over all shifts


class Nearest(NamedTuple):
    """The nearest template: its id (-1: none), the sum of absolute differences, the shift."""

    id: int
    distance: int
    shift: int


class Geometry(NamedTuple):
    """What shifting means for templates of one config; columns are counted from the left.

    Attributes:
        width: Columns of a template.
        height: Rows of a template.
        offsets: First template column that is compared, for each shift; a roll in a panorama.
        overlap: Columns that are compared.
        margin: First column of a forward query that is compared.
        panoramic: Whether columns go round.
        block: Width and height of the blocks that bound the distance; (0, 0): no bounds.
        core: Template columns that every shift compares, from and to.
    """

    width: int
    height: int
    offsets: tuple[int, ...]
    overlap: int
    margin: int
    panoramic: bool
    block: tuple[int, int]
    core: tuple[int, int]

    @classmethod
    def of(cls, config: ViewConfig) -> Self:
        """Work out the shifts of a config."""
        width, height, s = config.template_width, config.template_height, config.shift_match
        if config.panoramic:
            offsets = tuple(range(0, width, config.shift_step))
            core, margin = (0, width), 0
        else:
            offsets = tuple(range(0, 2 * s + 1, config.shift_step))
            core, margin = (2 * s, width - 2 * s), s
        block = _block_size(max(0, core[1] - core[0]), height)
        return cls(
            width, height, offsets, width - 2 * margin, margin, config.panoramic, block, core
        )

    @property
    def n_pixels(self) -> int:
        """Pixels that a distance sums over."""
        return self.overlap * self.height

    @property
    def n_blocks(self) -> int:
        """Blocks that bound a distance."""
        block_w, block_h = self.block
        return (self.core[1] - self.core[0]) // block_w * (self.height // block_h) if block_w else 0

    @property
    def n_block_bytes(self) -> int:
        """Bytes that hold the block means: padded to where vectors of the processor end."""
        return -(-self.n_blocks // 32) * 32


def _block_size(columns: int, rows: int) -> tuple[int, int]:
    """Choose the blocks that leave out the fewest pixels, then the smallest and squarest."""
    best, size = (), (0, 0)
    for block_w in range(1, columns + 1):
        for block_h in range(1, rows + 1):
            across, down = columns // block_w, rows // block_h
            if across * down <= _MAX_BLOCKS:
                lost = columns * rows - across * down * block_w * block_h
                score = (lost // (columns + rows), block_w * block_h, abs(block_w - block_h))
                if not best or score < best:
                    best, size = score, (block_w, block_h)
    return size


def block_means(columns: np.ndarray, geometry: Geometry) -> np.ndarray:
    """Mean of each block, rounded down.

    Args:
        columns: Templates as ``uint8``, ``(n, core columns, height)``.
        geometry: Size of the blocks.

    Returns:
        ``uint8``, ``(n, n_block_bytes)``, zero from ``n_blocks`` on.
    """
    block_w, block_h = geometry.block
    across, down = columns.shape[1] // block_w, geometry.height // block_h
    blocks = columns[:, : across * block_w, : down * block_h]
    sums = blocks.reshape(len(columns), across, block_w, down, block_h).sum((2, 4), np.uint32)
    means = np.zeros((len(columns), geometry.n_block_bytes), np.uint8)
    means[:, : geometry.n_blocks] = (sums // (block_w * block_h)).reshape(len(columns), -1)
    return means


def template_blocks(template: np.ndarray, geometry: Geometry) -> np.ndarray:
    """Return the block means that a template is found by; ``template`` is ``(width, height)``."""
    if not geometry.n_blocks:
        return np.empty(0, np.uint8)
    return block_means(template[None, slice(*geometry.core)], geometry)[0]


def find_nearest(
    pixels: np.ndarray,
    blocks: np.ndarray,
    query: np.ndarray,
    geometry: Geometry,
    limit: float = np.inf,
    hints: tuple[int, ...] = (),
) -> Nearest:
    """Find the template with the smallest sum of absolute differences; of equals, the first.

    Args:
        pixels: Templates, ``uint8``, ``(n, width * height)``, column after column.
        blocks: Their block means, ``(n, n_block_bytes)``.
        query: View, ``uint8``, ``(width, height)``.
        geometry: Of both.
        limit: What is farther need not be the nearest, only farther: the search may stop.
        hints: Templates that are likely near; they only make it faster.

    Returns:
        The nearest; exact if its distance is at most ``limit``.
    """
    n = len(pixels)
    if n == 0:
        return Nearest(-1, 0, 0)
    if n < PRUNE_FROM or not geometry.n_blocks:
        return _among(pixels, None, query, geometry)
    bounds = lower_bounds(blocks, query, geometry)
    probes = np.argpartition(bounds, _PROBES)[:_PROBES]
    probes = np.union1d(probes, [i for i in hints if 0 <= i < n]).astype(np.int64)
    best = _among(pixels, probes, query, geometry)
    left = np.flatnonzero(bounds <= min(best.distance, limit))
    if len(left) > n // 3:
        return _among(pixels, None, query, geometry)
    found = _among(pixels, left, query, geometry) if len(left) else best
    return min(found, best, key=lambda nearest: (nearest.distance, nearest.id))


def lower_bounds(blocks: np.ndarray, query: np.ndarray, geometry: Geometry) -> np.ndarray:
    """Bound the distance of every template from below, over all shifts; ``int32``, ``(n,)``."""
    first, last = geometry.core
    if geometry.panoramic:
        shifted = np.stack([np.roll(query, offset, axis=0) for offset in geometry.offsets])
    else:  # template column c lies over query column c - offset + margin
        shifted = np.stack(
            [query[slice(first - o + geometry.margin, last - o + geometry.margin)]
             for o in geometry.offsets]
        )  # fmt: skip
    means = block_means(shifted, geometry)
    apart, _ = _batch_distance(blocks, means)
    size = geometry.block[0] * geometry.block[1]
    return apart[:, 0] * np.int32(size) - np.int32((size - 1) * geometry.n_blocks)


def distances(pixels: np.ndarray, query: np.ndarray, geometry: Geometry) -> np.ndarray:
    """Sum of absolute differences of every template at every shift; ``int32``, ``(shifts, n)``."""
    return np.stack(
        [_batch_distance(over, part)[0][:, 0] for over, part in _overlaps(pixels, query, geometry)]
    )


def near_pairs(
    pixels: np.ndarray, query: np.ndarray, geometry: Geometry, slack: int, mask: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find all templates and shifts that are nearly as near as the nearest.

    Args:
        pixels: As for :func:`find_nearest`.
        query: View, ``uint8``, ``(width, height)``.
        geometry: Of both.
        slack: Sum of absolute differences that one may be farther.
        mask: ``uint8``, ``(1, n)``: templates to look at, at least one; ``None``: all.

    Returns:
        Template, index of the shift, and distance, of each pair.
    """
    k = min(_LISTED, len(pixels))
    lists = [
        _batch_distance(part, over, k, mask) for over, part in _overlaps(pixels, query, geometry)
    ]
    apart = np.concatenate([listed for listed, _ in lists])
    near = apart <= apart[:, 0].min() + slack
    if near[:, -1].any() and k < len(pixels):  # a list may end too early
        apart = distances(pixels, query, geometry)
        if mask is not None:
            apart[:, mask[0] == 0] = np.iinfo(np.int32).max
        shifts, ids = np.nonzero(apart <= apart.min() + slack)
        return ids, shifts, apart[shifts, ids]
    shifts, _ = np.nonzero(near)
    return np.concatenate([ids for _, ids in lists])[near], shifts, apart[near]


def _among(
    pixels: np.ndarray, ids: np.ndarray | None, query: np.ndarray, geometry: Geometry
) -> Nearest:
    """Compare with these templates, or all; a part at a time, that they stay in the cache."""
    best: Nearest | None = None
    for first in range(0, len(pixels) if ids is None else len(ids), _AT_ONCE):
        some = slice(first, first + _AT_ONCE)
        part = pixels[some] if ids is None else pixels.take(ids[some], axis=0)
        found = _nearest_of(part, query, geometry)
        found = found._replace(id=int(first + found.id if ids is None else ids[first + found.id]))
        if best is None or found[1::-1] < best[1::-1]:
            best = found
    return best


def _nearest_of(pixels: np.ndarray, query: np.ndarray, geometry: Geometry) -> Nearest:
    best: Nearest | None = None
    for shift, (over, part) in enumerate(_overlaps(pixels, query, geometry)):
        apart, at = _batch_distance(part, over)
        found = Nearest(int(at[0, 0]), int(apart[0, 0]), geometry.offsets[shift])
        if best is None or found[1::-1] < best[1::-1]:
            best = found
    return best


def _batch_distance(
    these: np.ndarray, those: np.ndarray, k: int = 1, mask: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """For each of these rows, the ``k`` nearest of those: distances, rising, and numbers."""
    return cv2.batchDistance(these, those, cv2.CV_32S, None, None, cv2.NORM_L1, k, mask)


def _overlaps(
    pixels: np.ndarray, query: np.ndarray, geometry: Geometry
) -> list[tuple[np.ndarray, np.ndarray]]:
    """What is compared at each shift: columns of all templates, and of the query."""
    h = geometry.height
    if geometry.panoramic:
        rolled = [np.roll(query, offset, axis=0).reshape(1, -1) for offset in geometry.offsets]
        return [(pixels, part) for part in rolled]
    m = geometry.margin
    part = np.ascontiguousarray(query[m : m + geometry.overlap]).reshape(1, -1)
    return [(pixels[:, o * h : (o + geometry.overlap) * h], part) for o in geometry.offsets]
