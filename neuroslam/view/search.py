r"""Exact search for the stored template nearest to a view, over all horizontal shifts.

A template is stored as bytes, column after column, so the columns that overlap at a shift are one
slice of a row, and ``cv2.batchDistance`` compares them in place. In a large memory most templates
are pruned without a comparison. If :math:`S = s\,m + r,\ 0 \le r < s`, is the sum of a block's
pixels,

.. math:: \sum_{i \in b} |x_i - y_i| \;\ge\; |S_x - S_y| \;\ge\; s\,|m_x - m_y| - (s - 1)

so the block means :math:`m`, one byte for about ten pixels, give a lower bound of the distance.
Only templates whose bound is below the best distance so far are compared, so the result is that of
a full comparison.

The compiled search bounds several shifts at a time: where the block means of a view lie in
:math:`[l, h]` over some shifts, the mean :math:`m` of a template differs from each of them by
:math:`\max(l, m) - \min(m, h)` or more. It bounds every template by 16 coarse blocks and groups of
shifts, then what is left by the fine blocks and groups, and then shift by shift.
"""

import math
import sys
from functools import lru_cache
from typing import NamedTuple, Self

import cv2
import numpy as np
from torch import Tensor

from neuroslam.compiled import compiled, runs_compiled
from neuroslam.config import ViewConfig

PRUNE_FROM = 3000
"""Number of templates from which the bounds save time."""

_PROBES = 32
_MAX_BLOCKS = 64
_N_NEAREST = 16
_BATCH = 4096  # templates whose pixels stay in the cache over all shifts
_GROUP, _MAX_GROUPS = 3, 6  # shifts that one bound of the compiled search covers, unless many
_N_COARSE = 16  # coarse blocks
_TILE = 512  # templates whose coarse block means lie side by side
_LEFT_OUT = 65535  # bound of a template behind the gate; the others' are at most 64 * 255


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
        block = _block_size(max(0, core[1] - core[0]), height, _MAX_BLOCKS)
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


def _block_size(columns: int, rows: int, most: int) -> tuple[int, int]:
    """Choose the blocks that omit the fewest pixels, then the smallest and squarest."""
    best: tuple[int, ...] = ()
    size = (0, 0)
    for block_w in range(1, columns + 1):
        for block_h in range(1, rows + 1):
            across, down = columns // block_w, rows // block_h
            if across * down <= most:
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
    if runs_compiled():
        plan = plan_of(geometry)
        out = np.empty((len(geometry.offsets), len(pixels)), np.int32)
        pixels, query = np.ascontiguousarray(pixels), np.ascontiguousarray(query)
        distances_step(pixels, query.reshape(-1), *plan[:2], geometry.n_pixels, out)
        return out
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


class Plan(NamedTuple):
    """Where the compared parts start at each shift, for the compiled search.

    The view stands twice in a row, so that a rolled panorama is one slice of it.

    Attributes:
        in_view: First pixel of the doubled view that is compared, per shift.
        in_template: First pixel of a template that is compared, per shift.
        core: First column of the doubled view over which the blocks lie, per shift.
        sizes: Compared pixels, shifts in a group, number of groups; and of the fine and the coarse
            blocks width, height, number across and down.
    """

    in_view: np.ndarray
    in_template: np.ndarray
    core: np.ndarray
    sizes: np.ndarray


class Coarse:
    """Coarse block means of the templates of a memory: they follow from it and are never saved.

    Attributes:
        tiles: ``uint8``, ``(tiles, 16, 512)``: of each block the means of 512 templates in a row,
            so that one instruction bounds many.
        n: Number of templates whose means are in ``tiles``.
        source: Tensor of the templates that they were computed from.
    """

    def __init__(self) -> None:
        self.tiles = np.zeros((0, _N_COARSE, _TILE), np.uint8)
        self.n = 0
        self.source: Tensor | None = None

    def of(self, pixels: Tensor, n: int, geometry: Geometry) -> np.ndarray:
        """Return the tiles of the first ``n`` templates, after adding those that are new."""
        if pixels is not self.source or n < self.n:
            self.source, self.n = pixels, 0  # loaded, merged, or moved as it grew
        if self.n < n:
            n_tiles = -(-n // _TILE)
            if n_tiles > len(self.tiles):
                tiles = np.zeros((max(n_tiles, 2 * len(self.tiles)), _N_COARSE, _TILE), np.uint8)
                tiles[: len(self.tiles)] = self.tiles
                self.tiles = tiles
            sizes = plan_of(geometry).sizes
            coarse_step(
                pixels.numpy(), self.n, n, geometry.core[0], geometry.height, sizes[7:], self.tiles
            )
            self.n = n
        return self.tiles


def limit_of(n: int, limit: float) -> float:
    """Return the limit that :func:`find_nearest` observes among ``n`` templates: none if few."""
    return limit if n >= PRUNE_FROM else math.inf


@lru_cache(maxsize=16)
def plan_of(geometry: Geometry) -> Plan:
    """Derive the places of the compared parts, all ``int64``.

    Example:
        >>> config = ViewConfig(template_width=8, template_height=2, shift_match=1)
        >>> plan_of(Geometry.of(config)).in_template.tolist()
        [0, 2, 4]
    """
    g = geometry
    offsets = np.array(g.offsets, np.int64)
    columns, n_shifts = max(0, g.core[1] - g.core[0]), len(offsets)
    group = max(_GROUP, -(-n_shifts // _MAX_GROUPS))
    sizes = [g.n_pixels, group, -(-n_shifts // group)]
    for block_w, block_h in (g.block, _block_size(columns, g.height, _N_COARSE)):
        across, down = (columns // block_w, g.height // block_h) if block_w else (0, 0)
        sizes += [block_w, block_h, across, down]
    sizes = np.array(sizes, np.int64)
    if g.panoramic:
        first = g.width - offsets
        return Plan(first * g.height, 0 * offsets, first, sizes)
    in_view = np.full_like(offsets, g.margin * g.height)
    return Plan(in_view, offsets * g.height, g.core[0] - offsets + g.margin, sizes)


@compiled
def nearest_step(
    view: np.ndarray,
    pixels: np.ndarray,
    blocks: np.ndarray,
    values: np.ndarray,
    means: np.ndarray,
    tiles: np.ndarray,
    n: int,
    in_view: np.ndarray,
    in_template: np.ndarray,
    core: np.ndarray,
    sizes: np.ndarray,
    gate: float,
    limit: float,
    hint: int,
) -> tuple[int, float, int]:
    """Find the nearest template: :func:`find_nearest`, or in full precision, or behind a gate.

    Args:
        view: In [0, 1], ``float64``, ``(height, width)``.
        pixels: Templates, ``uint8``, ``(>= n, width * height)``, column after column.
        blocks: Block means of the templates, ``uint8``, ``(>= n, n_block_bytes)``.
        values: Templates in full precision, ``float64``, as ``pixels``; no rows: compare bytes.
        means: Mean of each template, ``float64``, ``(>= n,)``; empty: no gate.
        tiles: See :class:`Coarse`.
        n: Number of templates.
        in_view: See :class:`Plan`.
        in_template: See :class:`Plan`.
        core: See :class:`Plan`.
        sizes: See :class:`Plan`.
        gate: Largest difference of the means of view and template.
        limit: Largest distance of interest, in levels.
        hint: Id of a template that is likely near, as is the next; it only saves time.

    Returns:
        Id (-1: none behind the gate), distance in levels, and index of the shift; the first id, and
        then the first shift, of equally near ones. As in :func:`find_nearest` the distance is not
        always the smallest if it is above ``limit``.
    """
    height, width = view.shape
    half, n_pixels, n_shifts = height * width, sizes[0], in_view.shape[0]
    exact, gated = values.shape[0] > 0, means.shape[0] > 0
    grey, levels = np.empty(2 * half), np.empty(2 * half, np.uint8)
    _to_columns(view, grey, levels)
    for at in range(half):
        grey[half + at], levels[half + at] = grey[at], levels[at]
    mean = 0.0
    for at in range(half):
        mean += grey[at] if exact else np.float64(levels[at])
    mean /= half if exact else half * 255.0
    slack = 0.0  # by how much a distance of bytes may exceed that of full precision
    if exact:
        slack = 1.0 + 0.5 * n_pixels
        for at in range(in_view[0], in_view[0] + n_pixels):
            slack += abs(grey[at] * 255.0 - levels[at])

    in_group, n_groups, fine, coarse = sizes[1], sizes[2], sizes[3:7], sizes[7:]
    low, high = _block_ranges(levels, height, core, in_group, n_groups, fine, blocks.shape[1])
    coarse_low, coarse_high = _block_ranges(
        levels, height, core, in_group, n_groups, coarse, tiles.shape[1]
    )
    bounds = _coarse_bounds(tiles, n, n_groups, coarse_low, coarse_high)

    stretch = max(64, n // _PROBES + 1)
    order = np.empty(_PROBES + 3, np.int64)  # ids that are compared first
    n_first, lowest, at_lowest = 1, _LEFT_OUT, -1
    for i in (hint, hint + 1):
        if 0 <= i < n and not (gated and abs(means[i] - mean) > gate):
            order[n_first] = i
            n_first += 1
    for first in range(0, n, stretch):
        least, at = _LEFT_OUT, -1
        for i in range(first, min(first + stretch, n)):
            if gated and abs(means[i] - mean) > gate:
                bounds[i] = _LEFT_OUT
            elif bounds[i] < least:
                least, at = np.int64(bounds[i]), i
        if at >= 0:
            order[n_first] = at
            n_first += 1
            if least < lowest:
                lowest, at_lowest = least, at
    if at_lowest < 0:
        return -1, 0.0, 0
    order[0] = hint if n_first > 1 and order[1] == hint else at_lowest

    best, best_id, best_shift = math.inf, -1, 0
    cap, most, most_coarse = math.inf, _LEFT_OUT - 1, _LEFT_OUT - 1  # distance, bounds of interest
    near = np.empty(n_groups, np.int64)
    for turn in range(-n_first, n):
        if turn == 1 - n_first:  # the distance of one template is known, whatever the limit
            cap = limit
            most = _largest_bound(min(best + slack, cap), fine)
            most_coarse = _largest_bound(min(best + slack, cap), coarse)
        i = order[n_first + turn] if turn < 0 else turn
        if bounds[i] > most_coarse:
            continue
        n_near = 0
        for group in range(n_groups):
            near[n_near] = group
            n_near += _outside(blocks, i, low, high, group) <= most
        for k in range(n_near):
            for shift in range(near[k] * in_group, min((near[k] + 1) * in_group, n_shifts)):
                if _outside(blocks, i, low, high, n_groups + shift) > most:
                    continue
                here, there = in_view[shift], in_template[shift]
                distance = _byte_distance(levels, here, pixels, i, there, n_pixels)
                if distance > min(best + slack, cap):
                    continue
                if exact:
                    distance = 255.0 * _distance(grey, here, values, i, there, n_pixels)
                before = i < best_id or (i == best_id and shift < best_shift)
                if distance < best or (distance == best and before):
                    best, best_id, best_shift = distance, i, shift
                    most = _largest_bound(min(best + slack, cap), fine)
                    most_coarse = _largest_bound(min(best + slack, cap), coarse)
    return best_id, best, best_shift


@compiled
def learn_step(
    view: np.ndarray,
    i: int,
    pixels: np.ndarray,
    blocks: np.ndarray,
    values: np.ndarray,
    core: int,
    fine: np.ndarray,
) -> float:
    """Write a view as a template into row ``i`` of the arrays of :func:`nearest_step`.

    Returns:
        The mean of its bytes, in levels.
    """
    height, width = view.shape
    grey, levels = np.empty(height * width), np.empty(height * width, np.uint8)
    _to_columns(view, grey, levels)
    total = 0.0
    for at in range(height * width):
        pixels[i, at] = levels[at]
        total += levels[at]
        if values.shape[0] > 0:
            values[i, at] = grey[at]
    _write_blocks(_block_columns(levels, height, fine), core, fine, blocks, i)
    return total / (height * width)


@compiled
def _to_columns(view: np.ndarray, grey: np.ndarray, levels: np.ndarray) -> None:
    """Write a view column after column, and rounded to bytes."""
    height, width = view.shape
    for column in range(width):
        for row in range(height):
            grey[column * height + row] = view[row, column]
    for at in range(height * width):
        levels[at] = np.uint8(np.rint(grey[at] * 255.0))


@compiled
def _outside(means: np.ndarray, i: int, low: np.ndarray, high: np.ndarray, node: int) -> int:
    """Return by how much the block means of a template lie outside their ranges, in all."""
    total = np.uint16(0)
    for k in range(means.shape[1]):
        outside = np.uint8(max(means[i, k], low[node, k]) - min(means[i, k], high[node, k]))
        total = np.uint16(total + np.uint16(outside))
    return int(total)


@compiled
def _byte_distance(
    view: np.ndarray, here: int, pixels: np.ndarray, i: int, there: int, n: int
) -> float:
    """Return the sum of absolute differences; in 32 bits it is an instruction of processors."""
    first, second = view[here : here + n], pixels[i, there : there + n]
    total = np.int32(0)
    for k in range(n):
        apart = np.int32(np.int32(first[k]) - np.int32(second[k]))
        total = np.int32(total + np.int32(abs(apart)))
    return np.float64(total)


@compiled
def _distance(view: np.ndarray, here: int, values: np.ndarray, i: int, there: int, n: int) -> float:
    """Return the sum of absolute differences, in four parts, which the processor adds at once."""
    first, second = view[here : here + n], values[i, there : there + n]
    a = b = c = d = 0.0
    for k in range(n // 4):
        a += abs(first[4 * k] - second[4 * k])
        b += abs(first[4 * k + 1] - second[4 * k + 1])
        c += abs(first[4 * k + 2] - second[4 * k + 2])
        d += abs(first[4 * k + 3] - second[4 * k + 3])
    for k in range(n // 4 * 4, n):
        a += abs(first[k] - second[k])
    return (a + b) + (c + d)


@compiled
def _largest_bound(reach: float, grid: np.ndarray) -> int:
    """Return the largest sum of differences of block means at which a distance is in reach."""
    size, n_blocks = grid[0] * grid[1], grid[2] * grid[3]
    return int((reach + (size - 1) * n_blocks) / size) if n_blocks else _LEFT_OUT - 1


@compiled
def _coarse_bounds(
    tiles: np.ndarray, n: int, n_groups: int, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """Return by how much the coarse means of each template are outside, in the nearest group."""
    bounds = np.empty(n, np.uint16)
    sums = np.empty(_TILE, np.uint16)
    for tile in range((n + _TILE - 1) // _TILE):
        part = bounds[tile * _TILE : (tile + 1) * _TILE]
        for k in range(part.shape[0]):
            part[k] = _LEFT_OUT - 1
        for group in range(n_groups):
            for k in range(_TILE):
                sums[k] = 0
            for block in range(tiles.shape[1]):
                _add_outside(tiles[tile, block], low[group, block], high[group, block], sums)
            for k in range(part.shape[0]):
                part[k] = min(part[k], sums[k])
    return bounds


@compiled
def _add_outside(means: np.ndarray, low: int, high: int, sums: np.ndarray) -> None:
    for k in range(means.shape[0]):
        outside = np.uint8(max(means[k], low) - min(means[k], high))
        sums[k] = np.uint16(sums[k] + np.uint16(outside))


@compiled
def coarse_step(
    pixels: np.ndarray,
    first: int,
    last: int,
    core: int,
    height: int,
    coarse: np.ndarray,
    tiles: np.ndarray,
) -> None:
    """Write the coarse block means of the templates ``first <= i < last``: see :class:`Coarse`."""
    means = np.zeros((1, tiles.shape[1]), np.uint8)
    for i in range(first, last):
        _write_blocks(_block_columns(pixels[i], height, coarse), core, coarse, means, 0)
        for block in range(tiles.shape[1]):
            tiles[i // _TILE, block, i % _TILE] = means[0, block]


@compiled
def _block_ranges(
    levels: np.ndarray,
    height: int,
    core: np.ndarray,
    in_group: int,
    n_groups: int,
    grid: np.ndarray,
    n_bytes: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and largest block means of a view, over groups of shifts and at each."""
    n_shifts = core.shape[0]
    low = np.zeros((n_groups + n_shifts, n_bytes), np.uint8)
    high = np.zeros((n_groups + n_shifts, n_bytes), np.uint8)
    for group in range(n_groups):
        for block in range(grid[2] * grid[3]):
            low[group, block] = 255
    if n_bytes == 0:
        return low, high
    sums = _block_columns(levels, height, grid)
    for shift in range(n_shifts):
        node, group = n_groups + shift, shift // in_group
        _write_blocks(sums, core[shift], grid, high, node)
        for block in range(grid[2] * grid[3]):
            low[node, block] = high[node, block]
            low[group, block] = min(low[group, block], low[node, block])
            high[group, block] = max(high[group, block], low[node, block])
    return low, high


@compiled
def _block_columns(levels: np.ndarray, height: int, grid: np.ndarray) -> np.ndarray:
    """Return the sum of the pixels of each column in each row of blocks."""
    n_columns = levels.shape[0] // height
    sums = np.zeros((n_columns, grid[3]), np.int64)
    for column in range(n_columns):
        for block in range(grid[3]):
            for row in range(block * grid[1], (block + 1) * grid[1]):
                sums[column, block] += levels[column * height + row]
    return sums


@compiled
def _write_blocks(sums: np.ndarray, core: int, grid: np.ndarray, out: np.ndarray, i: int) -> None:
    """Write the means of the blocks that start at a column into a row, as :func:`block_means`."""
    for k in range(grid[2]):
        for block in range(grid[3]):
            total, first = 0, core + k * grid[0]
            for column in range(first, first + grid[0]):
                total += sums[column, block]
            out[i, k * grid[3] + block] = np.uint8(total // (grid[0] * grid[1]))


@compiled
def distances_step(
    pixels: np.ndarray,
    query: np.ndarray,
    in_view: np.ndarray,
    in_template: np.ndarray,
    n_pixels: int,
    out: np.ndarray,
) -> None:
    """Write :func:`distances` into ``out``.

    Args:
        pixels: Templates, ``uint8``, ``(n, width * height)``.
        query: View, ``uint8``, ``(width * height,)``.
        in_view: See :class:`Plan`.
        in_template: See :class:`Plan`.
        n_pixels: Number of pixels in a distance.
        out: ``int32``, ``(shifts, n)``.
    """
    twice = np.concatenate((query, query))
    for shift in range(in_view.shape[0]):
        for i in range(pixels.shape[0]):
            here, there = in_view[shift], in_template[shift]
            out[shift, i] = _byte_distance(twice, here, pixels, i, there, n_pixels)
