r"""Forgetting: which experiences a map can do without, and the graph without them.

An experience that is forgotten becomes part of another one: its links lead to that one from now on,
so that the graph stays connected and loops stay loops. (M. Milford, G. Wyeth, "Persistent
navigation and mapping using a biologically inspired SLAM system", IJRR 29, 2010, prune an
experience map likewise; what is used least goes first as in M. Labbe, F. Michaud,
"Appearance-based loop closure detection for online large-scale and long-term operation", IEEE
T-RO 29, 2013.) With :math:`T_{ij}`
the pose of :math:`j` in the frame of :math:`i` on the map, and :math:`L_{st}` the measured
displacement of a link, a link between experiences that are part of :math:`u` and :math:`v` becomes

.. math:: L_{uv} = T_{us}\, L_{st}\, T_{vt}^{-1}

which leaves its residual what it was.
"""

import numpy as np

from neuroslam.geometry import compose_poses, relative_poses, wrap_angles
from neuroslam.mapping.tables import Links

STRAIN = 3.0
"""Metres of distance that a metre of residual counts for, in the choice of a neighbour."""


SPARSE = 1.0
"""Half-lives of use that twice the distance to the nearest neighbour counts for."""


def contract_links(links: Links, poses: np.ndarray, root: np.ndarray) -> Links:
    """Lead the links of forgotten experiences to those that they have become part of.

    Links within one experience are left out, and so is a second link between two; ids are the old
    ones. The equation is at the top of this module.

    Args:
        links: Links of the map.
        poses: Poses of all experiences, ``(n, 3)``.
        root: Experience that each is part of from now on, itself if it is kept, ``(n,)``.

    Example:
        >>> poses = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [3.0, 0.0, 0.0]])
        >>> measured = np.array([1.0, 2.0]), np.zeros(2), np.zeros(2), np.array([1.0, 2.0])
        >>> chain = Links(np.array([0, 1]), np.array([1, 2]), *measured)
        >>> [column.tolist() for column in contract_links(chain, poses, np.array([0, 0, 2]))]
        [[0], [2], [3.0], [0.0], [0.0], [3.0]]
    """
    relative = relative_poses(poses[root], poses)
    source, target = root[links.source], root[links.target]
    moved = (source != links.source) | (target != links.target)
    distance, heading, facing = (column.copy() for column in links[2:5])
    duration = links.duration_s.astype(np.float64)
    s, t, unknown = links.source[moved], links.target[moved], np.isnan(facing[moved])
    turn = np.where(unknown, poses[t, 2] - poses[s, 2], facing[moved])
    x, y = (distance[moved] * f(heading[moved]) for f in (np.cos, np.sin))
    end = compose_poses(relative[s], np.column_stack([x, y, turn]))
    back = relative_poses(relative[t], np.zeros_like(end))
    between = compose_poses(end, back)
    length, before = np.hypot(between[:, 0], between[:, 1]), distance[moved]
    duration[moved] *= np.where(before > 0.0, length / np.where(before > 0.0, before, 1.0), 1.0)
    distance[moved], heading[moved] = length, np.arctan2(between[:, 1], between[:, 0])
    facing[moved] = np.where(unknown, np.nan, wrap_angles(between[:, 2]))
    low, high = np.minimum(source, target), np.maximum(source, target)
    key = (high << 32) | low
    first = np.zeros(len(key), dtype=bool)
    # A link that was measured as it is comes before one that leads elsewhere now.
    order = np.lexsort((np.arange(len(key)), moved, key))
    first[order] = np.append(True, np.diff(key[order]) != 0)[: len(order)]
    kept = first & (source != target)
    columns = source, target, distance, heading, facing, duration
    return Links(*(column[kept] for column in columns))


def roots(into: np.ndarray) -> np.ndarray:
    """Follow every experience to the one that is kept.

    Example:
        >>> roots(np.array([0, 0, 1, 3])).tolist()
        [0, 0, 0, 3]
    """
    found = into.copy()
    while True:
        further = found[found]
        if (further == found).all():
            return found
        found = further


def least_used(
    use: np.ndarray, links: Links, poses: np.ndarray, protected: np.ndarray, count: int
) -> np.ndarray:
    """Choose experiences to forget, and the neighbour that each becomes part of.

    The least used come first, the oldest of equals; where experiences are twice as far apart, they
    count as used a half-life later, so that a region larger than the cap is kept as a coarse map
    and not in part. In one call no two of them are neighbours, as far as that is possible: a path
    that is not used any more loses every second experience, then every second of the rest.

    Args:
        use: Logarithm of the use of every experience, in half-lives, ``(n,)``.
        links: Links of the map.
        poses: Poses of all experiences, ``(n, 3)``.
        protected: Experiences that are not forgotten, ``bool``, ``(n,)``.
        count: How many to forget.

    Returns:
        The experience that each is part of from now on, itself if it is kept, ``(n,)``.

    Example:
        >>> poses = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [3.0, 0.0, 0.0]])
        >>> measured = np.array([1.0, 2.0]), np.zeros(2), np.zeros(2), np.array([1.0, 2.0])
        >>> chain = Links(np.array([0, 1]), np.array([1, 2]), *measured)
        >>> least_used(np.array([2.0, 1.0, 3.0]), chain, poses, np.zeros(3, dtype=bool), 1).tolist()
        [0, 0, 2]
    """
    n = len(use)
    apart = poses[links.target] - poses[links.source]
    far = np.hypot(apart[:, 0], apart[:, 1])
    bearing = poses[links.source, 2] + links.heading_rad
    strain = np.hypot(
        apart[:, 0] - links.distance_m * np.cos(bearing),
        apart[:, 1] - links.distance_m * np.sin(bearing),
    )
    cost = np.concatenate([far + STRAIN * strain] * 2)
    ends = np.concatenate([links.source, links.target])
    others = np.concatenate([links.target, links.source])
    order = np.lexsort((cost, ends))
    others, starts = others[order], np.searchsorted(ends[order], np.arange(n + 1))
    into, beside = np.arange(n), np.zeros(n, dtype=bool)
    shortest = np.full(n, np.inf)
    np.minimum.at(shortest, ends, np.concatenate([far, far]))
    spacing = np.where(np.isfinite(shortest), np.maximum(shortest, 1e-9), 1e9)
    candidates = np.flatnonzero(~protected)
    # Rounded, so that those of an even path are equals, of which the oldest comes first.
    worth = np.round(use + SPARSE * np.log2(spacing), 1)[candidates]
    candidates = candidates[np.argsort(worth, kind="stable")].tolist()
    left = count
    for strict in (True, False):
        for k in candidates:
            if not left:
                break
            if into[k] != k or (strict and beside[k]):
                continue
            near = others[starts[k] : starts[k + 1]].tolist()
            for other in near:
                if strict and into[other] != other:
                    continue
                root = other
                while into[root] != root:
                    root = int(into[root])
                if root != k:
                    into[k], beside[near] = root, True
                    left -= 1
                    break
    return roots(into)
