"""Matched pairs of experiences of two maps, grouped by the alignment that they agree on."""

from typing import NamedTuple

import numpy as np

from neuroslam.geometry import rotate_points, wrap_angles
from neuroslam.state.match import Pairs


class Tolerance(NamedTuple):
    """Differences at which two matched pairs still agree on an alignment.

    Attributes:
        near_m: Pairs farther apart than this are not compared: odometry drifts too much.
        place_m: Distance allowed between two experiences with the same view.
        drift: Error of odometry allowed, as a share of the distance between two pairs.
        turn_rad: Difference of rotation allowed.
    """

    near_m: float
    place_m: float
    drift: float
    turn_rad: float


def agreeing(
    pairs: Pairs, partial_poses: np.ndarray, loaded_poses: np.ndarray, tolerance: Tolerance
) -> list[np.ndarray]:
    r"""Group the pairs that agree with each other on the alignment of two maps.

    Pairs :math:`(z_i, u_i)` and :math:`(z_j, u_j)` agree if the displacement from :math:`z_i` to
    :math:`z_j` is that from :math:`u_i` to :math:`u_j`,

    .. math:: \lVert R(-\phi_i)(z_j - z_i) - R(-\psi_i)(u_j - u_i) \rVert
              \le \epsilon + \delta \lVert z_j - z_i \rVert

    with :math:`\phi_i` the heading at :math:`z_i` and :math:`\psi_i` that at :math:`u_i` plus
    the heading difference of the views; and if both imply the same rotation. Only pairs within
    ``near_m`` are compared, for odometry drifts over longer distances. A group contains each
    partial experience once, in the order of ``pairs``.

    Args:
        pairs: Matched pairs; an experience may be in several.
        partial_poses: x, y in metres and heading in radians, ``(n, 3)``.
        loaded_poses: The same of the loaded map, ``(m, 3)``.
        tolerance: Differences allowed.

    Returns:
        Indices of the pairs of each group, the group with most experiences first.

    Example:
        >>> line = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]])
        >>> seen = Pairs.of([(0, 1, 0, 0.01), (1, 2, 0, 0.01), (2, 3, 0, 0.01), (3, 0, 0, 0.01)])
        >>> [g.tolist() for g in agreeing(seen, line, line, Tolerance(5.0, 0.3, 0.1, 0.5))]
        [[0, 1, 2], [3]]
    """
    n = len(pairs.partial)
    if n == 0:
        return []
    from scipy.sparse import coo_array  # slow to import, not always needed
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

    z, u = partial_poses[pairs.partial], loaded_poses[pairs.loaded]
    i, j = cKDTree(z[:, :2]).query_pairs(tolerance.near_m, output_type="ndarray").T
    apart = np.linalg.norm(z[j, :2] - z[i, :2], axis=1)
    allowed = tolerance.place_m + tolerance.drift * apart
    facing = u[:, 2] + pairs.turn_rad  # heading of the partial experience, in the loaded map
    there = _seen_from(z[i], z[i, 2], z[j])
    here = _seen_from(u[i], facing[i], u[j])
    turn = np.abs(wrap_angles((facing - z[:, 2])[i] - (facing - z[:, 2])[j]))
    agree = np.linalg.norm(there - here, axis=1) <= allowed
    # From the other end too: a wrong heading shows only from its own experience.
    there, here = _seen_from(z[j], z[j, 2], z[i]), _seen_from(u[j], facing[j], u[i])
    agree &= np.linalg.norm(there - here, axis=1) <= allowed
    agree &= (turn <= tolerance.turn_rad) & (pairs.partial[i] != pairs.partial[j])
    i, j = i[agree], j[agree]
    joined = coo_array((np.ones(len(i)), (i, j)), shape=(n, n))
    _, label = connected_components(joined, directed=False)
    support = np.bincount(i, minlength=n) + np.bincount(j, minlength=n)
    # For a partial experience keep, in a group, the pair with most support, then least error.
    order = np.lexsort((np.arange(n), pairs.error, -support, pairs.partial, label))
    first = np.ones(n, dtype=bool)
    first[1:] = (np.diff(label[order]) != 0) | (np.diff(pairs.partial[order]) != 0)
    kept = np.sort(order[first])
    groups = [kept[label[kept] == name] for name in np.unique(label)]
    return sorted(groups, key=lambda group: (-n_places(pairs.pick(group)), group[0]))


def pair_residuals_m(
    pairs: Pairs, partial_poses: np.ndarray, loaded_poses: np.ndarray
) -> np.ndarray:
    """Align two maps by the first pair; return the distance between the ends of each pair, metres.

    Args:
        pairs: At least one.
        partial_poses: x, y in metres and heading in radians, ``(n, 3)``.
        loaded_poses: The same of the loaded map, ``(m, 3)``.

    Example:
        >>> line = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
        >>> pair_residuals_m(Pairs.of([(0, 0, 0, 0), (1, 2, 0, 0)]), line, line).tolist()
        [0.0, 1.0]
    """
    z, u = partial_poses[pairs.partial], loaded_poses[pairs.loaded]
    facing = np.full(len(z), u[0, 2] + pairs.turn_rad[0])
    there = _seen_from(z[:1], np.full(len(z), z[0, 2]), z)
    distances: np.ndarray = np.linalg.norm(there - _seen_from(u[:1], facing, u), axis=1)
    return distances


def n_places(pairs: Pairs) -> int:
    """Count the pairs with distinct experiences on both maps: standing still confirms nothing."""
    return min(len(np.unique(pairs.partial)), len(np.unique(pairs.loaded)))


def _seen_from(here: np.ndarray, heading_rad: np.ndarray, there: np.ndarray) -> np.ndarray:
    return rotate_points((there - here)[:, :2], -heading_rad)
