r"""Residuals of a pose graph, and what follows from them: compiled steps of the online solver.

Residual :math:`r` of a link as in :mod:`~neuroslam.mapping.least_squares`. Links that end at a pose
are a list: entry ``2 link + side`` is a link, at its source (side 0) or target (1);
``first[pose]`` is the first entry of a pose, ``following[entry]`` the next, -1 none.
"""

import math

import numpy as np

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
def normal_equations(
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
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    r"""Return the equations of a Gauss-Newton step, in blocks of 3 by 3.

    .. math:: \Bigl(\sum w J^\top J + \lambda \operatorname{diag}\Bigr)\, \delta
              = -\sum w J^\top r

    for the poses that may move, while all others stay.

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
        Blocks of the diagonal, ``(m, 3, 3)``; right side, ``(m, 3)``; blocks above the diagonal,
        their places ``(blocks, 2)``, and the diagonal without damping, ``(m, 3)``.
    """
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
    return diagonal, slope, blocks[:n_blocks], ends[:n_blocks], strength
