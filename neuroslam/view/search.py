r"""Exact search for the stored template nearest to a view, over all horizontal shifts.

A template is stored as bytes, column after column, so the columns that overlap at a shift are one
slice of a row, and ``cv2.batchDistance`` compares them in place. In a large memory most templates
are pruned without a comparison. If :math:`S = s\,m + r,\ 0 \le r < s`, is the sum of a block's
pixels,

.. math:: \sum_{i \in b} |x_i - y_i| \;\ge\; |S_x - S_y| \;\ge\; s\,|m_x - m_y| - (s - 1)

so the block means :math:`m`, one byte for about ten pixels, give a lower bound of the distance.
Only templates whose bound is below the best distance so far are compared, so the result is that of
a full comparison.
"""

import sys
from typing import NamedTuple, Self

import cv2
import numpy as np

from neuroslam.config import ViewConfig

PRUNE_FROM = 3000
"""Number of templates from which the bounds save time."""

_PROBES = 32
_MAX_BLOCKS = 64
_N_NEAREST = 16
_BATCH = 4096  # templates whose pixels stay in the cache over all shifts


class Nearest(NamedTuple):
    """Id of the nearest template (-1: none), sum of absolute differences, and shift."""

    id: int
    distance: int
    shift: int


_FARTHEST = Nearest(-1, sys.maxsize, 0)


class Geometry(NamedTuple):
    """Shifts and overlaps of the templates of one config; columns are counted from the left.

    Attributes:
        width: Columns of a template.
        height: Rows of a template.
        offsets: For each shift the first template column compared; in a panorama the roll.
        overlap: Number of columns compared.
        margin: First column of a forward query that is compared.
        panoramic: Whether the columns wrap around.
        block: Width and height of the blocks that bound the distance; (0, 0): no bounds.
        core: First and last (excluded) of the template columns compared at every shift.
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
        """Derive the shifts from a config."""
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
        """Number of pixels in a distance."""
        return self.overlap * self.height

    @property
    def n_blocks(self) -> int:
        """Number of blocks in the bound of a distance."""
        block_w, block_h = self.block
        return (self.core[1] - self.core[0]) // block_w * (self.height // block_h) if block_w else 0

    @property
    def n_block_bytes(self) -> int:
        """Number of bytes of the block means, padded to the processor's vector length."""
        return -(-self.n_blocks // 32) * 32


def _block_size(columns: int, rows: int) -> tuple[int, int]:
    """Choose the blocks that omit the fewest pixels, then the smallest and squarest."""
    best: tuple[int, ...] = ()
    size = (0, 0)
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
    """Return the mean of each block, rounded down.

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
    """Return the block means of a template, ``(width, height)``, for the search."""
    if not geometry.n_blocks:
        return np.empty(0, np.uint8)
    return np.asarray(block_means(template[None, slice(*geometry.core)], geometry)[0])


def find_nearest(
    pixels: np.ndarray,
    blocks: np.ndarray,
    query: np.ndarray,
    geometry: Geometry,
    limit: float = np.inf,
    hints: tuple[int, ...] = (),
) -> Nearest:
    """Find the template with the smallest sum of absolute differences, the first of equals.

    Args:
        pixels: Templates, ``uint8``, ``(n, width * height)``, column after column.
        blocks: Block means of the templates, ``(n, n_block_bytes)``.
        query: View, ``uint8``, ``(width, height)``.
        geometry: Shifts and overlaps of templates and query.
        limit: Largest distance of interest; beyond it the search may stop early.
        hints: Ids of templates that are likely near; they only save time.

    Returns:
        The nearest template; exact if its distance is at most ``limit``. Otherwise its distance is
        above ``limit``, but not always the smallest.
    """
    n = len(pixels)
    if n == 0:
        return Nearest(-1, 0, 0)
    if n < PRUNE_FROM or not geometry.n_blocks:
        return _compare(pixels, None, query, geometry)
    bounds = lower_bounds(blocks, query, geometry)
    probes = np.argpartition(bounds, _PROBES)[:_PROBES]
    probes = np.union1d(probes, [i for i in hints if 0 <= i < n]).astype(np.int64)
    best = _compare(pixels, probes, query, geometry)
    candidates = np.flatnonzero(bounds <= min(best.distance, limit))
    if len(candidates) > n // 3:
        return _compare(pixels, None, query, geometry)
    found = _compare(pixels, candidates, query, geometry) if len(candidates) else best
    return min(found, best, key=lambda nearest: (nearest.distance, nearest.id))


def lower_bounds(blocks: np.ndarray, query: np.ndarray, geometry: Geometry) -> np.ndarray:
    """Return a lower bound of the distance of each template over all shifts, ``int32 (n,)``."""
    first, last = geometry.core
    if geometry.panoramic:
        shifted = np.stack([np.roll(query, offset, axis=0) for offset in geometry.offsets])
    else:  # template column c lies over query column c - offset + margin
        starts = [first - offset + geometry.margin for offset in geometry.offsets]
        shifted = np.stack([query[start : start + last - first] for start in starts])
    means = block_means(shifted, geometry)
    sums, _ = _batch_distance(blocks, means)
    size = geometry.block[0] * geometry.block[1]
    return sums[:, 0] * np.int32(size) - np.int32((size - 1) * geometry.n_blocks)


def distances(pixels: np.ndarray, query: np.ndarray, geometry: Geometry) -> np.ndarray:
    """Return the sum of absolute differences of each template at each shift, ``(shifts, n)``."""
    return np.stack(
        [_batch_distance(over, part)[0][:, 0] for over, part in _overlaps(pixels, query, geometry)]
    )


def near_pairs(
    pixels: np.ndarray, query: np.ndarray, geometry: Geometry, slack: int, mask: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find all pairs of a template and a shift that are almost as near as the nearest pair.

    Args:
        pixels: As for :func:`find_nearest`.
        query: View, ``uint8``, ``(width, height)``.
        geometry: Shifts and overlaps of templates and query.
        slack: Largest excess over the smallest distance.
        mask: ``uint8``, ``(1, n)``: templates to compare, at least one; ``None``: all.

    Returns:
        For each pair: id of the template, index of the shift, distance.
    """
    k = min(_N_NEAREST, len(pixels))
    lists = [
        _batch_distance(part, over, k, mask) for over, part in _overlaps(pixels, query, geometry)
    ]
    sums = np.concatenate([found for found, _ in lists])
    near = sums <= sums[:, 0].min() + slack
    if near[:, -1].any() and k < len(pixels):  # a list may be too short
        sums = distances(pixels, query, geometry)
        if mask is not None:
            sums[:, mask[0] == 0] = np.iinfo(np.int32).max
        shifts, ids = np.nonzero(sums <= sums.min() + slack)
        return ids, shifts, sums[shifts, ids]
    shifts, _ = np.nonzero(near)
    return np.concatenate([ids for _, ids in lists])[near], shifts, sums[near]


def _compare(
    pixels: np.ndarray, ids: np.ndarray | None, query: np.ndarray, geometry: Geometry
) -> Nearest:
    """Find the nearest of some templates, or of all, in batches that fit into the cache."""
    best = _FARTHEST
    for first in range(0, len(pixels) if ids is None else len(ids), _BATCH):
        some = slice(first, first + _BATCH)
        part = pixels[some] if ids is None else pixels.take(ids[some], axis=0)
        found = _nearest_of(part, query, geometry)
        found = found._replace(id=int(first + found.id if ids is None else ids[first + found.id]))
        if found[1::-1] < best[1::-1]:
            best = found
    return best


def _nearest_of(pixels: np.ndarray, query: np.ndarray, geometry: Geometry) -> Nearest:
    best = _FARTHEST
    for shift, (over, part) in enumerate(_overlaps(pixels, query, geometry)):
        sums, ids = _batch_distance(part, over)
        found = Nearest(int(ids[0, 0]), int(sums[0, 0]), geometry.offsets[shift])
        if found[1::-1] < best[1::-1]:
            best = found
    return best


def _batch_distance(
    rows: np.ndarray, others: np.ndarray, k: int = 1, mask: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return, for each row, distances and indices of its ``k`` nearest, in rising order."""
    return cv2.batchDistance(rows, others, cv2.CV_32S, None, None, cv2.NORM_L1, k, mask)


def _overlaps(
    pixels: np.ndarray, query: np.ndarray, geometry: Geometry
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the compared columns of all templates and of the query, for each shift."""
    h = geometry.height
    if geometry.panoramic:
        rolled = [np.roll(query, offset, axis=0).reshape(1, -1) for offset in geometry.offsets]
        return [(pixels, part) for part in rolled]
    m = geometry.margin
    part = np.ascontiguousarray(query[m : m + geometry.overlap]).reshape(1, -1)
    return [(pixels[:, o * h : (o + geometry.overlap) * h], part) for o in geometry.offsets]
