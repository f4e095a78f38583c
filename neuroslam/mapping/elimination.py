"""Sparse symmetric equations in blocks of 3 by 3: solved by elimination, in the order of degrees.

Unknowns are eliminated one by one, always one with fewest neighbours, which become neighbours of
each other. In a chain nothing is added, in a map of laps little.
"""

import numpy as np

from neuroslam.compiled import compiled


def factored(
    diagonal: np.ndarray, slope: np.ndarray, blocks: np.ndarray, ends: np.ndarray
) -> np.ndarray:
    """Solve block equations: the definition, by scipy's sparse factorisation.

    Args:
        diagonal: Blocks of the diagonal, shape ``(n, 3, 3)``.
        slope: Right side, ``(n, 3)``.
        blocks: Blocks beside the diagonal, ``(blocks, 3, 3)``, one for a pair of unknowns; their
            transposes are the other half.
        ends: Row and column of each.

    Returns:
        The solution, shape ``(n, 3)``.

    Example:
        >>> one = np.eye(3)[None]
        >>> factored(4.0 * one, np.ones((1, 3)), one[:0], np.zeros((0, 2), np.int64)).tolist()
        [[0.25, 0.25, 0.25]]
    """
    from scipy.sparse import csc_array  # slow to import, not always needed
    from scipy.sparse.linalg import splu

    n, inner = len(slope), np.arange(3)
    every = np.arange(n)
    values = np.concatenate([diagonal, blocks, blocks.transpose(0, 2, 1)])
    at = np.concatenate([np.stack([every, every], axis=1), ends, ends[:, ::-1]])
    rows = np.broadcast_to(3 * at[:, 0, None, None] + inner[:, None], values.shape)
    columns = np.broadcast_to(3 * at[:, 1, None, None] + inner, values.shape)
    places = rows.ravel(), columns.ravel()
    whole = csc_array((values.ravel(), places), shape=(3 * n, 3 * n))
    solution: np.ndarray = splu(whole).solve(slope.ravel())
    return solution.reshape(-1, 3)


@compiled
def _invert(blocks: np.ndarray, at: int) -> None:
    """Invert a symmetric positive definite block of 3 by 3 in place."""
    xx, xy, xt = blocks[at, 0, 0], blocks[at, 0, 1], blocks[at, 0, 2]
    yy, yt, tt = blocks[at, 1, 1], blocks[at, 1, 2], blocks[at, 2, 2]
    c00, c01, c02 = yy * tt - yt * yt, xt * yt - xy * tt, xy * yt - xt * yy
    c11, c12, c22 = xx * tt - xt * xt, xy * xt - xx * yt, xx * yy - xy * xy
    by = 1.0 / (xx * c00 + xy * c01 + xt * c02)
    blocks[at, 0, 0], blocks[at, 1, 1], blocks[at, 2, 2] = c00 * by, c11 * by, c22 * by
    blocks[at, 0, 1] = blocks[at, 1, 0] = c01 * by
    blocks[at, 0, 2] = blocks[at, 2, 0] = c02 * by
    blocks[at, 1, 2] = blocks[at, 2, 1] = c12 * by


@compiled
def _into_bucket(head: np.ndarray, near: np.ndarray, degree: int, i: int) -> None:
    """Put a pose first among those of this degree."""
    near[0, i], near[1, i] = -1, head[degree]
    if head[degree] >= 0:
        near[0, head[degree]] = i
    head[degree] = i


@compiled
def _out_of_bucket(head: np.ndarray, near: np.ndarray, degree: int, i: int) -> None:
    before, after = near[0, i], near[1, i]
    if before >= 0:
        near[1, before] = after
    else:
        head[degree] = after
    if after >= 0:
        near[0, after] = before


@compiled
def eliminate(
    diagonal: np.ndarray,
    slope: np.ndarray,
    blocks: np.ndarray,
    ends: np.ndarray,
) -> np.ndarray:
    """Solve as :func:`factored` does, by elimination; the arguments are overwritten."""
    n = slope.shape[0]
    n_blocks = ends.shape[0]
    first, following = np.full(n, -1), np.empty(2 * n_blocks, np.int64)
    degree, alive = np.zeros(n, np.int64), np.ones(n, np.bool_)
    for b in range(n_blocks):
        for side in range(2):  # lists of blocks: entry 2 b + side, as of links
            i = ends[b, side]
            following[2 * b + side], first[i] = first[i], 2 * b + side
            degree[i] += 1
    head, near = np.full(n + 1, -1), np.empty((2, n), np.int64)
    for i in range(n - 1, -1, -1):
        _into_bucket(head, near, int(degree[i]), i)
    order, n_kept, least = np.empty(n, np.int64), 0, 0
    kept_from, kept = np.empty(n + 1, np.int64), np.empty(2 * n_blocks + 1, np.int64)
    around, through = np.empty(n, np.int64), np.empty(n, np.int64)  # neighbours; their blocks
    owner, found = np.full(n, -1), np.empty(n, np.int64)
    share, weighed = np.empty((n, 3, 3)), np.empty((n, 3, 3))
    for turn in range(n):
        while head[least] < 0:
            least += 1
        v = head[least]
        _out_of_bucket(head, near, int(least), v)
        alive[v], order[turn], kept_from[turn] = False, v, n_kept
        _invert(diagonal, v)
        n_around, entry = 0, first[v]
        while entry >= 0:
            b = entry // 2
            other = ends[b, 1 - entry % 2]
            if alive[other]:
                around[n_around], through[n_around] = other, b
                for e in range(9):  # the block with v first
                    r, c = e // 3, e % 3
                    weighed[n_around, r, c] = blocks[b, c, r] if entry % 2 else blocks[b, r, c]
                for e in range(9):
                    r, c, more = e // 3, e % 3, 0.0
                    for k in range(3):
                        more += diagonal[v, r, k] * weighed[n_around, k, c]
                    share[n_around, r, c] = blocks[b, r, c] = more  # kept for the way back
                ends[b, 0], ends[b, 1] = v, other  # the lists of `other` skip it: v is gone
                n_around += 1
            entry = following[entry]
        if n_kept + n_around > kept.size:
            more = np.empty(2 * (n_kept + n_around), np.int64)
            for k in range(n_kept):
                more[k] = kept[k]
            kept = more
        for a in range(n_around):
            kept[n_kept] = through[a]
            n_kept += 1
        for a in range(n_around):
            i = around[a]
            for e in range(9):
                r, c, less = e // 3, e % 3, 0.0
                for k in range(3):
                    less += weighed[a, k, r] * share[a, k, c]
                diagonal[i, r, c] -= less
                if c == 0:
                    for k in range(3):
                        slope[i, r] -= share[a, k, r] * slope[v, k]
            _out_of_bucket(head, near, int(degree[i]), i)
            before, entry, n_alive = -1, first[i], 0
            while entry >= 0:  # what is eliminated leaves the list
                b, after = entry // 2, following[entry]
                other = ends[b, 0] if ends[b, 0] != i else ends[b, 1]
                if alive[other]:
                    owner[other], found[other] = i, b
                    n_alive += 1
                    before = entry
                elif before >= 0:
                    following[before] = after
                else:
                    first[i] = after
                entry = after
            degree[i] = n_alive
            for o in range(a + 1, n_around):
                j = around[o]
                if owner[j] == i:
                    b = found[j]
                else:
                    b = n_blocks
                    n_blocks += 1
                    if n_blocks > ends.shape[0]:
                        blocks, ends, following = _longer(blocks, ends, following)
                    ends[b, 0], ends[b, 1] = i, j
                    blocks[b] = 0.0
                    following[2 * b], first[i] = first[i], 2 * b
                    following[2 * b + 1], first[j] = first[j], 2 * b + 1
                    degree[i] += 1
                straight = ends[b, 0] == i
                for e in range(9):
                    r, c, less = e // 3, e % 3, 0.0
                    for k in range(3):
                        less += weighed[a, k, r] * share[o, k, c]
                    if straight:
                        blocks[b, r, c] -= less
                    else:
                        blocks[b, c, r] -= less
            _into_bucket(head, near, int(degree[i]), i)
            least = min(least, degree[i])
    kept_from[n] = n_kept
    solution = np.empty((n, 3))
    for turn in range(n - 1, -1, -1):
        v = order[turn]
        for r in range(3):
            x = 0.0
            for c in range(3):
                x += diagonal[v, r, c] * slope[v, c]
            for k in range(kept_from[turn], kept_from[turn + 1]):
                b = kept[k]
                j = ends[b, 1]
                for c in range(3):
                    x -= blocks[b, r, c] * solution[j, c]
            solution[v, r] = x
    return solution


@compiled
def _longer(
    blocks: np.ndarray, ends: np.ndarray, following: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return copies with twice the room."""
    n, room = ends.shape[0], 2 * ends.shape[0] + 16
    more = np.empty((room, 3, 3)), np.empty((room, 2), np.int64), np.empty(2 * room, np.int64)
    for b in range(n):  # loops compile in a third of the time of slices
        for e in range(9):
            more[0][b, e // 3, e % 3] = blocks[b, e // 3, e % 3]
        for side in range(2):
            more[1][b, side], more[2][2 * b + side] = ends[b, side], following[2 * b + side]
    return more
