r"""RatSLAM's relaxation of the map: sequential, but computed without a Python loop over links.

One loop visits the links in the order of their source, then of their number, and each visit moves
both ends by a share of the link's error, in opposite directions [MW08, Eq. 8]:

.. math:: \theta_s \leftarrow \theta_s + \alpha\, e,\quad \theta_t \leftarrow \theta_t - \alpha\, e,
          \qquad e = \operatorname{wrap}(\theta_t - \theta_s - f)

and likewise for x and y, where the error is :math:`p_t - p_s - d\,(\cos, \sin)(\theta_s + h)`.
A visit is linear in the values before it. If the values that poses pass through are numbered, two
new ones a visit, a loop is one sparse lower triangular system, the same for x, y and heading:

.. math:: \begin{pmatrix} s' \\ t' \end{pmatrix} = \begin{pmatrix} 1-\alpha & \alpha \\
          \alpha & 1-\alpha \end{pmatrix} \begin{pmatrix} s \\ t \end{pmatrix}
          + \alpha\,c \begin{pmatrix} -1 \\ 1 \end{pmatrix}

with :math:`c` the displacement or heading change that the link measures.
"""

from typing import Any

import numpy as np
import torch

try:  # not public, but unchanged since 2008; _runs_in_order checks what is needed of it
    from scipy.sparse._sparsetools import csr_matvec, csr_matvecs
except ImportError:  # pragma: no cover
    csr_matvec: Any = None
    csr_matvecs: Any = None

from neuroslam.geometry import TWO_PI, wrap_angles


def relax_sequentially(
    poses: np.ndarray,
    source: np.ndarray,
    target: np.ndarray,
    distance_m: np.ndarray,
    heading_rad: np.ndarray,
    facing_rad: np.ndarray,
    loops: int,
    correction: float,
) -> np.ndarray:
    """Relax link by link: the definition, slow; :class:`Relaxation` gives the same.

    Args as of :class:`Relaxation` and :meth:`Relaxation.run`. Return the poses.

    Example:
        >>> poses = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
        >>> link = [np.array([v]) for v in (0, 1, 1.0, 0.0, 0.0)]
        >>> relax_sequentially(poses, *link, loops=1, correction=0.5)[:, 0].tolist()
        [0.5, 1.5]
    """
    poses = np.array(poses, dtype=np.float64)
    for _ in range(loops):
        for k in np.argsort(source, kind="stable"):
            s, t = source[k], target[k]
            bearing = poses[s, 2] + heading_rad[k]
            away = distance_m[k] * np.array([np.cos(bearing), np.sin(bearing)])
            error = correction * (poses[t, :2] - poses[s, :2] - away)
            poses[s, :2] += error
            poses[t, :2] -= error
            if not np.isnan(facing_rad[k]):
                turn = correction * wrap_angles(poses[t, 2] - poses[s, 2] - facing_rad[k])
                poses[s, 2] += turn
                poses[t, 2] -= turn
    poses[:, 2] = wrap_angles(poses[:, 2])
    return poses


def _substitute(
    rows: np.ndarray, columns: np.ndarray, shares: np.ndarray, values: np.ndarray, n: int
) -> None:
    """Add to ``values[n:]``, row after row, the sparse product with all ``values`` before the row.

    scipy's product adds to its output row after row. If the output is its own input, each row
    reads the rows before it: forward substitution, twice as fast as SuperLU's and without a
    factorisation.
    """
    if not IN_ORDER:
        for i, (first, second) in enumerate(columns.reshape(-1, 2)):
            values[n + i] += shares[2 * i] * values[first] + shares[2 * i + 1] * values[second]
        return
    flat, n_rows = values.reshape(-1), len(rows) - 1
    if values.ndim == 1:
        csr_matvec(n_rows, len(values), rows, columns, shares, flat, flat[n:])
    else:
        n_in, width = values.shape
        csr_matvecs(n_rows, n_in, width, rows, columns, shares, flat, flat[width * n :])


def _runs_in_order() -> bool:
    """Return whether this scipy's products substitute forward if output and input are one."""
    if csr_matvec is None or csr_matvecs is None:
        return False
    rows, columns = np.array([0, 1, 2], np.int32), np.array([0, 1], np.int32)
    one, two = np.array([1.0, 0.0, 0.0]), np.array([[1.0, 3.0], [0.0, 0.0], [0.0, 0.0]])
    csr_matvec(2, 3, rows, columns, np.full(2, 2.0), one, one[1:])
    csr_matvecs(2, 3, 2, rows, columns, np.full(2, 2.0), two.ravel(), two.ravel()[2:])
    return bool(one.tolist() == [1, 2, 4] and two.tolist() == [[1, 3], [2, 6], [4, 12]])


_CHECK_EVERY = 20
"""Loops between two checks for convergence; the last loop is always checked."""

IN_ORDER = _runs_in_order()
"""Whether this scipy substitutes forward; if not, :class:`Relaxation` is slower, not different."""


class Relaxation:
    """Relaxes the poses of a map with a fixed set of links; prepared once, run often.

    Args:
        source: Pose at which each link begins, ``int64``, shape ``(links,)``.
        target: Pose at which it ends; never its source.
        distance_m: Distance from source to target.
        heading_rad: Direction of the target, relative to the source's heading.
        facing_rad: Heading of the target relative to the source's; NaN where it is unknown, then
            the link moves positions only.
        n: Number of poses.

    Example:
        >>> poses = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
        >>> relaxation = Relaxation(*(np.array([v]) for v in (0, 1, 1.0, 0.0, 0.0)), n=2)
        >>> poses, moved = relaxation.run(poses, loops=1, correction=0.5)
        >>> poses[:, 0].tolist(), moved
        ([0.5, 1.5], 0.5)
    """

    def __init__(
        self,
        source: np.ndarray,
        target: np.ndarray,
        distance_m: np.ndarray,
        heading_rad: np.ndarray,
        facing_rad: np.ndarray,
        n: int,
    ) -> None:
        order = np.argsort(source, kind="stable")
        self._source, self._target = source[order], target[order]
        self._distance_m = distance_m[order]
        self._heading_rad = heading_rad[order]
        self._knows_facing = ~np.isnan(facing_rad[order])
        self._facing_rad = np.where(self._knows_facing, facing_rad[order], 0.0)
        self._n = n
        self._correction = np.nan
        self._theta, self._xy = np.empty(n + 2 * len(source)), np.empty((n + 2 * len(source), 2))
        # Value i of a loop is pose i as it was at the start; n + 2k and n + 2k + 1 are the ends of
        # the k-th visited link after the visit. found: the values that the visit finds.
        visits = np.stack([self._source, self._target], axis=1).ravel()
        by_pose = np.argsort(visits, kind="stable")
        sorted_visits = visits[by_pose]
        found = np.empty(len(visits), dtype=np.int32)
        found[by_pose[1:]] = n + by_pose[:-1]
        first = np.ones(len(visits), dtype=bool)
        first[1:] = sorted_visits[1:] != sorted_visits[:-1]
        found[by_pose[first]] = sorted_visits[first]
        self._found_source, self._found_target = found[0::2].copy(), found[1::2].copy()
        self._columns = np.repeat(found.reshape(-1, 2), 2, axis=0).ravel()
        self._rows = np.arange(0, 2 * len(visits) + 1, 2, dtype=np.int32)
        self._last = np.arange(n)
        last = np.ones(len(visits), dtype=bool)
        last[:-1] = first[1:]
        self._last[sorted_visits[last]] = n + by_pose[last]

    def run(
        self, poses: np.ndarray, loops: int, correction: float, tolerance: float = 0.0
    ) -> tuple[np.ndarray, float]:
        """Relax until the map has converged, at most ``loops`` times.

        Links that contradict each other never stop correcting: each undoes what the other did. So
        the map has converged if no pose moves over a whole loop.

        Args:
            poses: x, y in metres and heading in radians, shape ``(n, 3)``; not altered.
            loops: Largest number of loops.
            correction: Share of its error by which a link moves each of its ends, in (0, 0.5].
            tolerance: The map has converged if no pose moved farther (m, rad) in a loop.

        Returns:
            The poses, headings in [-pi, pi), and the largest movement of a pose in the last loop (m
            or rad; 0 without loops or links).
        """
        n, n_links = self._n, len(self._source)
        moved = 0.0
        if loops == 0 or n_links == 0:
            return np.array(poses, dtype=np.float64), moved
        if correction != self._correction:
            self._set_correction(correction)
        theta, xy = self._theta[:n], self._xy[:n]
        theta[:], xy[:] = poses[:, 2], poses[:, :2]
        facing = self._unwrapped_facing(theta[self._source], theta[self._target])
        for left in range(loops - 1, -1, -1):
            facing, new_theta, new_xy = self._loop(self._theta, self._xy, facing)
            if left % _CHECK_EVERY == 0:  # a check costs a quarter of a loop of a small map
                moved = float(max(np.abs(new_theta - theta).max(), np.abs(new_xy - xy).max()))
            theta[:], xy[:] = new_theta, new_xy
            if left % _CHECK_EVERY == 0 and moved <= tolerance:
                break
        theta -= TWO_PI * np.floor((theta + np.pi) / TWO_PI)
        return np.column_stack([xy, theta]), moved

    def _loop(
        self, theta: np.ndarray, xy: np.ndarray, facing: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compute the values of one loop; return the facings used, new headings and positions."""
        facing = self._turn(theta, facing)
        bearing = theta.take(self._found_source)
        bearing += self._heading_rad
        away = torch.from_numpy(bearing)  # its cos and sin are thrice as fast as numpy's
        new = xy[self._n :].reshape(-1, 2, 2)
        for axis, along in enumerate((torch.cos(away), torch.sin(away))):
            offset = along.numpy()
            offset *= self._offset_m
            new[:, 1, axis] = offset
            np.negative(offset, out=new[:, 0, axis])
        _substitute(self._rows, self._columns, self._shares, xy, self._n)
        return facing, theta.take(self._last), xy.take(self._last, axis=0)

    def _turn(self, theta: np.ndarray, facing: np.ndarray) -> np.ndarray:
        """Correct the headings of one loop in place; return the unwrapped facings used.

        Whether an error must be wrapped is known only when its link is visited. The loop first
        uses the whole turns of the loop before; if an error exceeds half a turn, it is computed
        again with the right turns. Each pass settles at least one more link, so this ends.
        """
        new = theta[self._n :].reshape(-1, 2)
        while True:
            np.multiply(self._correction, facing, out=new[:, 1])
            np.negative(new[:, 1], out=new[:, 0])
            _substitute(self._rows, self._columns, self._facing_shares, theta, self._n)
            error = theta.take(self._found_target) - theta.take(self._found_source)
            error -= facing
            if error.max() < np.pi and error.min() >= -np.pi:
                return facing
            corrected = self._unwrapped_facing(
                theta.take(self._found_source), theta.take(self._found_target)
            )
            if np.array_equal(corrected, facing, equal_nan=True):
                return facing
            facing = corrected

    def _unwrapped_facing(self, source_rad: np.ndarray, target_rad: np.ndarray) -> np.ndarray:
        """Return facings plus the whole turns that wrap their errors to [-pi, pi); 0 if unknown."""
        error = target_rad - source_rad - self._facing_rad
        turned = self._facing_rad + TWO_PI * np.floor((error + np.pi) / TWO_PI)
        return np.where(self._knows_facing, turned, 0.0)

    def _set_correction(self, correction: float) -> None:
        """Prepare the coefficients of a visit and the offsets, which depend on the correction."""
        stay, go = 1.0 - correction, correction
        self._correction = correction
        self._shares = np.tile([stay, go, go, stay], len(self._source))
        self._facing_shares = self._shares
        if not self._knows_facing.all():
            self._facing_shares = self._shares.copy()
            self._facing_shares.reshape(-1, 4)[~self._knows_facing] = [1.0, 0.0, 0.0, 1.0]
        self._offset_m = correction * self._distance_m
