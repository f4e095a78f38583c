r"""Sparse block solver for a part of a pose graph: its Gauss-Newton step, by elimination.

With the residual :math:`r` and weight :math:`w` of each link as in
:mod:`~neuroslam.mapping.least_squares`, the step of the poses that may move solves

.. math:: \Bigl(\sum w J^\top J + \lambda \operatorname{diag}\Bigr)\, \delta = -\sum w J^\top r,

while all other poses stay. The matrix has a block of 3 by 3 for each pose and each pair of poses
that a link joins. Poses are eliminated one by one, always one with fewest neighbours: the
neighbours of an eliminated pose become neighbours of each other. In a chain nothing is added; in a
map of laps little.
"""

import math

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from neuroslam import compiled as switch
from neuroslam.compiled import compiled
from neuroslam.geometry import TWO_PI

GROUND = 1e-12
"""Added to the diagonal, of its largest entry: holds what no link holds."""


@compiled
def residual(
    poses: np.ndarray,
    s: int,
    t: int,
    measured: np.ndarray,
    scale: np.ndarray,
    link: int,
    out: np.ndarray,
) -> float:
    """Write the residual of a link in standard deviations; return its square."""
    cos, sin = math.cos(poses[s, 2]), math.sin(poses[s, 2])
    dx, dy = poses[t, 0] - poses[s, 0], poses[t, 1] - poses[s, 1]
    turn = poses[t, 2] - poses[s, 2] - measured[link, 2]
    turn -= TWO_PI * np.floor((turn + math.pi) / TWO_PI)
    out[0] = (cos * dx + sin * dy - measured[link, 0]) * scale[link, 0]
    out[1] = (cos * dy - sin * dx - measured[link, 1]) * scale[link, 1]
    out[2] = turn * scale[link, 2]
    return out[0] * out[0] + out[1] * out[1] + out[2] * out[2]


@compiled
def jacobians(
    poses: np.ndarray, s: int, t: int, scale: np.ndarray, link: int, out: np.ndarray
) -> None:
    """Write the derivatives of a residual by its source and by its target, ``(2, 3, 3)``."""
    cos, sin = math.cos(poses[s, 2]), math.sin(poses[s, 2])
    dx, dy = poses[t, 0] - poses[s, 0], poses[t, 1] - poses[s, 1]
    by_x, by_y, by_turn = scale[link, 0], scale[link, 1], scale[link, 2]
    out[1, 0, 0], out[1, 0, 1], out[1, 0, 2] = cos * by_x, sin * by_x, 0.0
    out[1, 1, 0], out[1, 1, 1], out[1, 1, 2] = -sin * by_y, cos * by_y, 0.0
    out[1, 2, 0], out[1, 2, 1], out[1, 2, 2] = 0.0, 0.0, by_turn
    for a in range(3):
        for b in range(3):
            out[0, a, b] = -out[1, a, b]
    out[0, 0, 2] = (cos * dy - sin * dx) * by_x
    out[0, 1, 2] = (-cos * dx - sin * dy) * by_y


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
def robust_cost(
    poses: np.ndarray,
    links: np.ndarray,
    source: np.ndarray,
    target: np.ndarray,
    measured: np.ndarray,
    scale: np.ndarray,
    doubted: np.ndarray,
    gate: float,
    weights: np.ndarray,
) -> float:
    """Return the robust cost of some links, and write their weights.

    Args as of :class:`~neuroslam.mapping.incremental.IncrementalSolver`; ``doubted``: which links
    have a weight below 1 if they contradict the others.
    """
    cost, r = 0.0, np.empty(3)
    for k in range(links.size):
        link = int(links[k])
        s, t = int(source[link]), int(target[link])
        square = residual(poses, s, t, measured, scale, link, r)
        weights[link] = 1.0
        if doubted[link] and square > gate:
            weights[link] = (2.0 * gate / (gate + square)) ** 2
            square = gate * (3.0 * square - gate) / (square + gate)
        cost += square
    return cost


@compiled
def links_of(
    moving: np.ndarray, slot: np.ndarray, first: np.ndarray, following: np.ndarray, ends: np.ndarray
) -> np.ndarray:
    """Return the links that end at a moving pose, each once; lists of links as of the solver."""
    room = 0
    for i in moving:
        entry = first[i]
        while entry >= 0:
            room += 1
            entry = following[entry]
    links, n = np.empty(room, np.int64), 0
    for i in moving:
        entry = first[i]
        while entry >= 0:
            link, side = entry // 2, entry % 2
            if side == 0 or slot[ends[0, link]] < 0:  # else found at its source
                links[n] = link
                n += 1
            entry = following[entry]
    return links[:n]


@compiled
def poses_that_follow(
    poses: np.ndarray,
    moving: np.ndarray,
    slot: np.ndarray,
    first: np.ndarray,
    following: np.ndarray,
    ends: np.ndarray,
    weights: np.ndarray,
    measured: np.ndarray,
    scale: np.ndarray,
    tolerance: float,
) -> np.ndarray:
    """Return poses beside the moving ones that are to move too, and as many beyond them.

    A pose follows if a step of its own, all others held, exceeds the tolerance. With it come the
    poses around it, so that the moving part of the map doubles; the first pose never moves.
    """
    found, n = np.empty(poses.shape[0], np.int64), 0
    r, jacobian = np.empty(3), np.empty((2, 3, 3))
    slope, strength = np.empty(3), np.empty(3)
    for i in moving:
        outer = first[i]
        while outer >= 0:
            v = ends[1 - outer % 2, outer // 2]
            outer = following[outer]
            if v == 0 or slot[v] != -1:
                continue
            slope[:], strength[:] = 0.0, 0.0
            entry = first[v]
            while entry >= 0:
                link, side = int(entry // 2), entry % 2
                s, t = int(ends[0, link]), int(ends[1, link])
                residual(poses, s, t, measured, scale, link, r)
                jacobians(poses, s, t, scale, link, jacobian)
                for e in range(9):
                    a, c = e // 3, e % 3
                    slope[a] += weights[link] * jacobian[side, c, a] * r[c]
                    strength[a] += weights[link] * jacobian[side, c, a] ** 2
                entry = following[entry]
            follows = False
            for a in range(3):
                follows |= abs(slope[a]) > tolerance * strength[a]
            slot[v] = -3  # looked at
            if follows:
                slot[v] = -2
                found[n] = v
                n += 1
    done, most = 0, max(n, moving.size) if n else 0
    while done < n and n < most:
        outer = first[found[done]]
        while outer >= 0 and n < most:
            v = ends[1 - outer % 2, outer // 2]
            if v != 0 and (slot[v] == -1 or slot[v] == -3):
                slot[v] = -2
                found[n] = v
                n += 1
            outer = following[outer]
        done += 1
    for i in moving:
        outer = first[i]
        while outer >= 0:
            v = ends[1 - outer % 2, outer // 2]
            if slot[v] == -3:
                slot[v] = -1
            outer = following[outer]
    for k in range(n):
        slot[found[k]] = moving.size + k
    return found[:n]


@compiled
def mismatch_over_path(
    poses: np.ndarray,
    link: int,
    least_weight: float,
    first: np.ndarray,
    following: np.ndarray,
    ends: np.ndarray,
    weights: np.ndarray,
    measured: np.ndarray,
    scale: np.ndarray,
) -> float:
    r"""Return the squared residual of a link in standard deviations of the shortest path.

    The path between its ends, by links of at least some weight, has the covariance
    :math:`\sum_k R_k \Sigma_k R_k^\top` and turns by :math:`\sigma_k` about the target of each
    link k. The map knows its poses better than one path: a residual that is too large here is too
    large. 0 if no path leads from end to end.
    """
    source, goal = int(ends[0, link]), int(ends[1, link])
    by, queue, n = np.full(first.size, -1), np.empty(first.size, np.int64), 1
    queue[0], by[source] = source, -2
    done = 0
    while done < n and by[goal] == -1:
        entry = first[queue[done]]
        while entry >= 0:
            k, v = entry // 2, ends[1 - entry % 2, entry // 2]
            if by[v] == -1 and weights[k] >= least_weight and scale[k, 2] > 0.0:
                by[v] = entry
                queue[n] = v
                n += 1
            entry = following[entry]
        done += 1
    if by[goal] == -1:
        return 0.0
    covariance = np.zeros((1, 3, 3))
    at, entry, of_path, w = goal, 2 * link, False, 1.0
    while True:
        k = int(entry // 2)
        s, t = int(ends[0, k]), int(ends[1, k])
        cos, sin = math.cos(poses[s, 2]), math.sin(poses[s, 2])
        ahead, aside = 1.0 / (w * scale[k, 0] ** 2), 1.0 / (w * scale[k, 1] ** 2)
        covariance[0, 0, 0] += cos * cos * ahead + sin * sin * aside
        covariance[0, 1, 1] += sin * sin * ahead + cos * cos * aside
        covariance[0, 0, 1] += cos * sin * (ahead - aside)
        if of_path:
            turned = 1.0 / (w * scale[k, 2] ** 2)
            dx, dy = poses[t, 1] - poses[goal, 1], poses[goal, 0] - poses[t, 0]
            covariance[0, 0, 0] += turned * dx * dx
            covariance[0, 1, 1] += turned * dy * dy
            covariance[0, 0, 1] += turned * dx * dy
            covariance[0, 0, 2] += turned * dx
            covariance[0, 1, 2] += turned * dy
            covariance[0, 2, 2] += turned
            at = ends[entry % 2, k]
        if at == source:
            break
        entry, of_path = by[at], True
        w = weights[entry // 2]
    r = np.empty(3)
    residual(poses, source, goal, measured, scale, link, r)
    cos, sin = math.cos(poses[source, 2]), math.sin(poses[source, 2])
    ahead, aside, turn = r[0] / scale[link, 0], r[1] / scale[link, 1], 0.0
    if scale[link, 2] > 0.0:
        turn = r[2] / scale[link, 2]
        covariance[0, 2, 2] += 1.0 / scale[link, 2] ** 2
    else:
        covariance[0, 0, 2], covariance[0, 1, 2], covariance[0, 2, 2] = 0.0, 0.0, 1.0
    _invert(covariance, 0)
    r[0], r[1], r[2] = cos * ahead - sin * aside, sin * ahead + cos * aside, turn
    square = 0.0
    for a in range(3):
        for b in range(3):
            square += r[a] * covariance[0, a, b] * r[b]
    return square


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
def _eliminate(
    diagonal: np.ndarray,
    slope: np.ndarray,
    blocks: np.ndarray,
    ends: np.ndarray,
    n_blocks: int,
    first: np.ndarray,
    following: np.ndarray,
) -> np.ndarray:
    """Solve the block system; return the solution, shape ``(n, 3)``.

    Args:
        diagonal: Blocks of the poses, ``(n, 3, 3)``; overwritten, as are the others.
        slope: Right side, ``(n, 3)``.
        blocks: Blocks above it, of the pose ``ends[b, 0]`` (row) and ``ends[b, 1]`` (column).
        ends: Poses of each block, ``(blocks, 2)``; one block for a pair.
        n_blocks: Number of blocks in use.
        first: First entry of each pose's list of blocks, -1 for none; entry ``2 b + side`` is block
            b in the list of ``ends[b, side]``.
        following: Entry after each.
    """
    n = slope.shape[0]
    degree, alive = np.zeros(n, np.int64), np.ones(n, np.bool_)
    for b in range(n_blocks):
        for side in range(2):
            degree[ends[b, side]] += 1
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
            more[:n_kept] = kept[:n_kept]
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
    n = ends.shape[0]
    more = np.empty((2 * n, 3, 3)), np.empty((2 * n, 2), np.int64), np.empty(4 * n, np.int64)
    more[0][:n], more[1][:n], more[2][: 2 * n] = blocks, ends, following
    return more


@compiled
def _block_between(
    first: np.ndarray, following: np.ndarray, ends: np.ndarray, i: int, j: int
) -> int:
    """Return the block of two poses, -1 if there is none yet."""
    entry = first[i]
    while entry >= 0:
        if ends[entry // 2, 1 - entry % 2] == j:
            return int(entry // 2)
        entry = following[entry]
    return -1


@compiled
def eliminated_step(
    poses: np.ndarray,
    moving: np.ndarray,
    slot: np.ndarray,
    links: np.ndarray,
    weights: np.ndarray,
    source: np.ndarray,
    target: np.ndarray,
    measured: np.ndarray,
    scale: np.ndarray,
    damping: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the step; arguments and result of :func:`factored_step`."""
    n, n_blocks = moving.size, 0
    diagonal, slope = np.zeros((n, 3, 3)), np.zeros((n, 3))
    blocks, ends = np.empty((links.size + 16, 3, 3)), np.empty((links.size + 16, 2), np.int64)
    first, following = np.full(n, -1), np.empty(2 * links.size + 32, np.int64)
    r, jacobian = np.empty(3), np.empty((2, 3, 3))
    for k in range(links.size):
        link = int(links[k])
        s, t, w = int(source[link]), int(target[link]), weights[link]
        if w <= 0.0:
            continue
        residual(poses, s, t, measured, scale, link, r)
        jacobians(poses, s, t, scale, link, jacobian)
        i, j = int(slot[s]), int(slot[t])
        for side in range(2):
            at = j if side else i
            if at >= 0:
                for e in range(9):
                    a, b = e // 3, e % 3
                    if b == 0:
                        for c in range(3):
                            slope[at, a] -= w * jacobian[side, c, a] * r[c]
                    for c in range(3):
                        diagonal[at, a, b] += w * jacobian[side, c, a] * jacobian[side, c, b]
        if i >= 0 and j >= 0:
            block = _block_between(first, following, ends, i, j)
            if block < 0:
                block = n_blocks
                n_blocks += 1
                ends[block, 0], ends[block, 1] = i, j
                blocks[block] = 0.0
                following[2 * block], first[i] = first[i], 2 * block
                following[2 * block + 1], first[j] = first[j], 2 * block + 1
            straight = ends[block, 0] == i
            for e in range(9):
                a, b, more = e // 3, e % 3, 0.0
                for c in range(3):
                    more += w * jacobian[0, c, a] * jacobian[1, c, b]
                if straight:
                    blocks[block, a, b] += more
                else:
                    blocks[block, b, a] += more
    strength, largest = np.empty((n, 3)), 0.0
    for i in range(n):
        for a in range(3):
            strength[i, a] = diagonal[i, a, a]
            largest = max(largest, strength[i, a])
    for i in range(n):
        for a in range(3):
            diagonal[i, a, a] += damping * strength[i, a] + GROUND * max(largest, 1.0)
    return _eliminate(diagonal, slope, blocks, ends, n_blocks, first, following), strength


def factored_step(
    poses: np.ndarray,
    moving: np.ndarray,
    slot: np.ndarray,
    links: np.ndarray,
    weights: np.ndarray,
    source: np.ndarray,
    target: np.ndarray,
    measured: np.ndarray,
    scale: np.ndarray,
    damping: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the step of the poses that may move: the definition, by a sparse factorisation.

    Args:
        poses: x, y and heading, shape ``(n, 3)``.
        moving: Poses that may move, shape ``(m,)``.
        slot: For every pose its place in ``moving``, -1 for those that stay.
        links: Numbers of the links that end at a moving pose, each once.
        weights: Weight of every link.
        source: Pose at which each link begins.
        target: Pose at which it ends.
        measured: Displacement (m) and turn (rad) that it measured, shape ``(links, 3)``.
        scale: Inverse standard deviations of these; 0 for a turn that is not known.
        damping: Share of the diagonal that is added to it.

    Returns:
        The step, shape ``(m, 3)``, and the diagonal of the undamped matrix, of the same shape.

    Example:
        >>> ends, far = (np.array([0]), np.array([1])), np.array([[2.0, 0.0, 0.0]])
        >>> poses, slot, none = np.zeros((2, 3)), np.array([-1, 0]), np.array([0])
        >>> one = np.array([1]), slot, none, np.ones(1), *ends, far, np.ones((1, 3)), 0.0
        >>> bool(np.allclose(factored_step(poses, *one)[0], [[2.0, 0.0, 0.0]]))
        True
    """
    n, rows, columns, values, right = len(moving), [], [], [], np.zeros(3 * len(links))
    r, jacobian = np.empty(3), np.empty((2, 3, 3))
    for k, link in enumerate(links.tolist()):
        s, t, root = int(source[link]), int(target[link]), math.sqrt(max(weights[link], 0.0))
        residual.plain(poses, s, t, measured, scale, link, r)
        jacobians.plain(poses, s, t, scale, link, jacobian)
        right[3 * k : 3 * k + 3] = root * r
        for end, by in ((slot[s], jacobian[0]), (slot[t], jacobian[1])):
            if end >= 0:
                for a in range(3):
                    for b in range(3):
                        rows.append(3 * k + a)
                        columns.append(3 * end + b)
                        values.append(root * by[a, b])
    whole = sparse.csr_array((values, (rows, columns)), shape=(3 * len(links), 3 * n))
    normal = whole.T @ whole
    strength = normal.diagonal()
    ground = GROUND * max(strength.max(initial=0.0), 1.0)
    held = normal + sparse.diags_array(damping * strength + ground)
    step: np.ndarray = -splu(sparse.csc_array(held)).solve(whole.T @ right)
    return step.reshape(-1, 3), strength.reshape(-1, 3)


def step_of(
    *args: np.ndarray | float,
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the step, compiled where steps are; arguments and result of :func:`factored_step`."""
    step: tuple[np.ndarray, np.ndarray] = (
        eliminated_step(*args) if switch.ENABLED else factored_step(*args)  # type: ignore[arg-type]
    )
    return step
