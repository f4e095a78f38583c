r"""RatSLAM's relaxation of the map, link by link.

One loop visits the links in the order of their source, then of their number, and each visit moves
both ends by a share of the link's error, in opposite directions (multisession RatSLAM, Eq. 8, which
moves all at once and has the wrong sign for links that end at an experience):

.. math:: \theta_s \leftarrow \theta_s + \alpha\, e,\quad \theta_t \leftarrow \theta_t - \alpha\, e,
          \qquad e = \operatorname{wrap}(\theta_t - \theta_s - f)

and likewise for x and y, where the error is :math:`p_t - p_s - d\,(\cos, \sin)(\theta_s + h)`.

A visit that alters no bit of its ends alters none the next time, unless another link has moved an
end: such links are passed over, and the map is the same to the last bit. Where most of the map
moves, no link is passed over, and a loop turns poses while the one before it moves them.
"""

import math

import numpy as np

from neuroslam import compiled as switch
from neuroslam.compiled import compiled
from neuroslam.geometry import TWO_PI, wrap_angle, wrap_angles


def relax_sequentially(
    poses: np.ndarray,
    source: np.ndarray,
    target: np.ndarray,
    distance_m: np.ndarray,
    heading_rad: np.ndarray,
    facing_rad: np.ndarray,
    correction: float,
) -> np.ndarray:
    """Relax once: the definition, slow; :class:`Relaxation` gives the same.

    Args as of :class:`Relaxation` and :meth:`Relaxation.run`. Return the poses.

    Example:
        >>> poses = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
        >>> link = [np.array([v]) for v in (0, 1, 1.0, 0.0, 0.0)]
        >>> relax_sequentially(poses, *link, correction=0.5)[:, 0].tolist()
        [0.5, 1.5]
    """
    x, y, theta = np.array(poses, dtype=np.float64).T.tolist()
    columns = (source, target, distance_m, heading_rad, facing_rad)
    order = np.argsort(source, kind="stable")
    for s, t, distance, heading, facing in zip(*(c[order].tolist() for c in columns), strict=True):
        bearing = theta[s] + heading
        error_x = correction * (x[t] - x[s] - distance * math.cos(bearing))
        error_y = correction * (y[t] - y[s] - distance * math.sin(bearing))
        x[s], x[t], y[s], y[t] = x[s] + error_x, x[t] - error_x, y[s] + error_y, y[t] - error_y
        if not math.isnan(facing):
            turn = correction * wrap_angle(theta[t] - theta[s] - facing)
            theta[s], theta[t] = theta[s] + turn, theta[t] - turn
    return np.column_stack([x, y, wrap_angles(np.array(theta))])


CHECK_EVERY = 20
"""Loops between two checks for convergence; the last loop is always checked."""

DENSE = 0.3
"""Share of links that alter their ends, above which a loop visits all links: that is cheaper."""


COUNT_EVERY = 8
"""Checks after which the links that alter an end are counted again, where all are visited."""


@compiled
def _differ(a: float, b: float) -> bool:
    """Return whether two numbers differ in a bit; a number that is none differs from itself."""
    return a != b or (a == 0.0 and math.copysign(1.0, a) != math.copysign(1.0, b))


@compiled
def _copy(into: np.ndarray, values: np.ndarray) -> None:
    """Copy poses; an assignment of slices would take three seconds to compile."""
    for i in range(values.shape[0]):
        for axis in range(values.shape[1]):
            into[i, axis] = values[i, axis]


@compiled
def _turned(turn: float) -> float:
    """Wrap an angle; rarely anything to do, and then a division."""
    if not -math.pi <= turn < math.pi:
        turn -= TWO_PI * np.floor((turn + math.pi) / TWO_PI)
    return turn


@compiled
def _displacements(
    bearing: np.ndarray, distance: np.ndarray, along_x: np.ndarray, along_y: np.ndarray
) -> None:
    r"""Compute :math:`d \cos b` and :math:`d \sin b` of all links, four times as fast as libm.

    Without a branch, so that it is vectorised: :math:`b` is reduced to
    :math:`|r| \le \pi/4` by the nearest multiple of :math:`\pi/2` (in two parts, Cody and Waite),
    and the Taylor series, below :math:`10^{-17}` from the function there, is summed.
    """
    for k in range(bearing.size):
        turns = np.floor(bearing[k] * (2.0 / math.pi) + 0.5)
        r = bearing[k] - turns * 1.57079632673412561417  # 33 bits of pi / 2
        r = r - turns * 6.07710050650619224932e-11  # and the rest
        z = r * r
        s = 1.0 / 6227020800.0 - z / 1307674368000.0 + z * z / 355687428096000.0
        s = -1.0 / 5040.0 + z * (1.0 / 362880.0 + z * (-1.0 / 39916800.0 + z * s))
        s = r + r * z * (-1.0 / 6.0 + z * (1.0 / 120.0 + z * s))
        c = -1.0 / 87178291200.0 + z / 20922789888000.0 - z * z / 6402373705728000.0
        c = 1.0 / 40320.0 + z * (-1.0 / 3628800.0 + z * (1.0 / 479001600.0 + z * c))
        c = 1.0 - 0.5 * z + z * z * (1.0 / 24.0 + z * (-1.0 / 720.0 + z * c))
        half = np.floor(0.5 * turns)
        odd = turns - 2.0 * half  # cosine and sine change places
        sign = 1.0 - 2.0 * (half - 2.0 * np.floor(0.5 * half))
        along_x[k] = distance[k] * sign * ((1.0 - odd) * c - odd * s)
        along_y[k] = distance[k] * sign * ((1.0 - odd) * s + odd * c)


@compiled
def _fused_loops(
    pose: np.ndarray,
    source: np.ndarray,
    target: np.ndarray,
    distance_m: np.ndarray,
    heading_rad: np.ndarray,
    facing_rad: np.ndarray,
    loops: int,
    correction: float,
) -> None:
    """Relax in place, all links in every loop.

    Headings do not depend on positions: the positions of a loop and the headings of the next are
    done in one pass, so that neither waits for the other. The last target, most often the next
    source, is kept out of memory.
    """
    n_links = source.size
    bearing, along_x, along_y = np.empty(n_links), np.zeros(n_links), np.zeros(n_links)
    for loop in range(loops + 1):
        turns, moves = loop < loops, loop > 0
        if moves:
            _displacements(bearing, distance_m, along_x, along_y)
        last = source[0]
        x, y, theta = pose[last, 0], pose[last, 1], pose[last, 2]
        for k in range(n_links):
            s, t, facing = source[k], target[k], facing_rad[k]
            if s != last:
                x, y, theta = pose[s, 0], pose[s, 1], pose[s, 2]
            to_x, to_y, to_theta = pose[t, 0], pose[t, 1], pose[t, 2]
            if moves:
                error_x = correction * (to_x - x - along_x[k])
                error_y = correction * (to_y - y - along_y[k])
                pose[s, 0], pose[s, 1] = x + error_x, y + error_y
                to_x, to_y = to_x - error_x, to_y - error_y
            if turns:
                bearing[k] = theta + heading_rad[k]
                if facing == facing:  # known
                    turn = correction * _turned(to_theta - theta - facing)
                    pose[s, 2] = theta + turn
                    to_theta = to_theta - turn
            pose[t, 0], pose[t, 1], pose[t, 2] = to_x, to_y, to_theta
            x, y, theta, last = to_x, to_y, to_theta, t


@compiled
def links_at_poses(
    source: np.ndarray, target: np.ndarray, n: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """List the links of every pose; those that begin there follow each other.

    Returns:
        First link that begins at each pose, ``(n + 1,)``; first entry of each pose in the list of
        links that end there, ``(n + 1,)``; and that list, ``(links,)``.
    """
    first, ending = np.zeros(n + 1, np.int64), np.zeros(n + 1, np.int64)
    for k in range(source.size):
        first[source[k] + 1] += 1
        ending[target[k] + 1] += 1
    for i in range(n):
        first[i + 1] += first[i]
        ending[i + 1] += ending[i]
    which, at = np.empty(source.size, np.int64), ending.copy()
    for k in range(source.size):
        which[at[target[k]]] = k
        at[target[k]] += 1
    return first, ending, which


@compiled
def _mark(
    due: np.ndarray, i: int, first: np.ndarray, ending: np.ndarray, which: np.ndarray
) -> None:
    """Mark the links of a pose that has changed as due."""
    for k in range(first[i], first[i + 1]):
        due[k] = 1
    for j in range(ending[i], ending[i + 1]):
        due[which[j]] = 1


@compiled
def _tracked_loop(
    pose: np.ndarray,
    due: np.ndarray,
    along: np.ndarray,
    first: np.ndarray,
    ending: np.ndarray,
    which: np.ndarray,
    source: np.ndarray,
    target: np.ndarray,
    distance_m: np.ndarray,
    heading_rad: np.ndarray,
    facing_rad: np.ndarray,
    correction: float,
) -> int:
    """Relax once in place, links only that can alter something; return how many altered an end.

    A visit marks the links of the ends that it altered, its own among them: a later one is due in
    this loop, an earlier one in the next. Arguments as of :func:`relax`.
    """
    n_links, n_turned, altered = source.size, 0, 0
    of_position, of_heading = due[0], due[1]
    words = due.view(np.uint64)  # eight links at a time, of which most often none is due
    turned, bearing = np.empty(n_links, np.int64), np.empty(n_links)
    distance, along_x, along_y = np.empty(n_links), np.empty(n_links), np.empty(n_links)
    for word in range(words.shape[1]):
        if words[1, word] == 0:
            continue
        for k in range(8 * word, min(8 * word + 8, n_links)):
            if of_heading[k] == 0:
                continue
            of_heading[k] = 0
            s, t, facing = source[k], target[k], facing_rad[k]
            theta, to_theta = pose[s, 2], pose[t, 2]
            turned[n_turned], distance[n_turned] = k, distance_m[k]
            bearing[n_turned] = theta + heading_rad[k]
            n_turned += 1
            if facing == facing:  # known
                turn = correction * _turned(to_theta - theta - facing)
                pose[s, 2], pose[t, 2] = theta + turn, to_theta - turn
                if _differ(pose[s, 2], theta):
                    _mark(of_heading, s, first, ending, which)
                    altered += 1
                if _differ(pose[t, 2], to_theta):
                    _mark(of_heading, t, first, ending, which)
    _displacements(bearing[:n_turned], distance[:n_turned], along_x[:n_turned], along_y[:n_turned])
    for j in range(n_turned):
        k = turned[j]
        if _differ(along_x[j], along[0, k]) or _differ(along_y[j], along[1, k]):
            along[0, k], along[1, k] = along_x[j], along_y[j]
            of_position[k] = 1
    for word in range(words.shape[1]):
        if words[0, word] == 0:
            continue
        for k in range(8 * word, min(8 * word + 8, n_links)):
            if of_position[k] == 0:
                continue
            of_position[k] = 0
            s, t = source[k], target[k]
            x, y, to_x, to_y = pose[s, 0], pose[s, 1], pose[t, 0], pose[t, 1]
            error_x = correction * (to_x - x - along[0, k])
            error_y = correction * (to_y - y - along[1, k])
            pose[s, 0], pose[s, 1] = x + error_x, y + error_y
            pose[t, 0], pose[t, 1] = to_x - error_x, to_y - error_y
            if _differ(pose[s, 0], x) or _differ(pose[s, 1], y):
                _mark(of_position, s, first, ending, which)
                altered += 1
            if _differ(pose[t, 0], to_x) or _differ(pose[t, 1], to_y):
                _mark(of_position, t, first, ending, which)
    return altered


@compiled
def relax(
    poses: np.ndarray,
    pose: np.ndarray,
    due: np.ndarray,
    along: np.ndarray,
    counts: np.ndarray,
    first: np.ndarray,
    ending: np.ndarray,
    which: np.ndarray,
    source: np.ndarray,
    target: np.ndarray,
    distance_m: np.ndarray,
    heading_rad: np.ndarray,
    facing_rad: np.ndarray,
    loops: int,
    correction: float,
    tolerance: float,
) -> float:
    """Relax in place, links in the order of visits; return the largest movement of the last loop.

    ``poses``, ``loops``, ``correction`` and ``tolerance`` are those of :meth:`Relaxation.run`, the
    links those of :class:`Relaxation` in the order of visits, and ``first``, ``ending`` and
    ``which`` the result of :func:`links_at_poses`. The rest is state: ``pose``, the poses at the
    end of the last call, headings not wrapped; ``due``, shape ``(2, links or more)``, whether the
    position and the heading of an end of each link were altered since its last visit; ``along``,
    shape ``(2, links)``, the displacement of each link at its last visit; ``counts``, how many
    altered an end in the last loop that counted them, and for how many checks that holds where all
    links are visited.
    """
    n, n_links, moved, loop = poses.shape[0], source.size, 0.0, 0
    for i in range(n):
        if _differ(pose[i, 0], poses[i, 0]) or _differ(pose[i, 1], poses[i, 1]):
            _mark(due[0], i, first, ending, which)
        if _differ(pose[i, 2], poses[i, 2]):
            _mark(due[1], i, first, ending, which)
    before = np.empty(pose.shape)
    _copy(pose, poses)
    while loop < loops:
        left = (loops - 1 - loop) % CHECK_EVERY  # loops until the next that is checked
        dense = counts[0] > 2 * DENSE * n_links
        if left > 0 and dense:
            args = source, target, distance_m, heading_rad, facing_rad
            _fused_loops(pose, *args, left, correction)
            due[:, :n_links] = 1
            loop += left
            left = 0
        if left == 0:
            _copy(before, pose)
        if dense and counts[1] > 0:
            args = source, target, distance_m, heading_rad, facing_rad
            _fused_loops(pose, *args, 1, correction)
            due[:, :n_links] = 1
            counts[1] -= 1
        else:
            counts[0] = _tracked_loop(
                pose, due, along, first, ending, which,
                source, target, distance_m, heading_rad, facing_rad, correction,
            )  # fmt: skip
            counts[1] = COUNT_EVERY - 1
        loop += 1
        if left == 0:
            moved = 0.0
            for i in range(n):
                moved = max(moved, abs(pose[i, 0] - before[i, 0]))
                moved = max(moved, abs(pose[i, 1] - before[i, 1]))
                moved = max(moved, abs(_turned(pose[i, 2] - before[i, 2])))
            if moved <= tolerance:
                break
    for i in range(n):
        poses[i, 0], poses[i, 1] = pose[i, 0], pose[i, 1]
        poses[i, 2] = pose[i, 2] - TWO_PI * np.floor((pose[i, 2] + math.pi) / TWO_PI)
    return moved


class Relaxation:
    """Relaxes the poses of a map with a fixed set of links.

    Args:
        source: Pose at which each link begins, ``int64``, shape ``(links,)``.
        target: Pose at which it ends; never its source.
        distance_m: Distance from source to target.
        heading_rad: Direction of the target, relative to the source's heading.
        facing_rad: Heading of the target relative to the source's; NaN where it is unknown, then
            the link moves positions only.

    Example:
        >>> poses = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
        >>> relaxation = Relaxation(*(np.array([v]) for v in (0, 1, 1.0, 0.0, 0.0)))
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
    ) -> None:
        order = np.argsort(source, kind="stable")
        self._links = (
            source[order].astype(np.uint64),  # without a sign: no check for counting from the end
            target[order].astype(np.uint64),
            distance_m[order],
            heading_rad[order],
            facing_rad[order],
        )
        self._numbers = order  # of the links as they were given
        self._pose = np.full((0, 3), np.nan)  # of no pose: all differ
        self._due = np.ones((2, 8 * -(-len(order) // 8)), np.uint8)
        self._along = np.full((2, len(order)), np.nan)
        self._counts = np.array([2 * len(order), 0])
        self._lists: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None

    def add_link(
        self, source: int, target: int, distance_m: float, heading_rad: float, facing_rad: float
    ) -> None:
        """Add one link, the newest; arguments as above.

        Example:
            >>> relaxation = Relaxation(*(np.array([v]) for v in (0, 1, 1.0, 0.0, 0.0)))
            >>> relaxation.add_link(1, 2, 1.0, 0.0, 0.0)
            >>> relaxation.run(np.zeros((3, 3)), loops=1, correction=0.5)[0][:, 0].tolist()
            [-0.5, -0.25, 0.75]
        """
        n = len(self._numbers)
        at = int(np.searchsorted(self._links[0], np.uint64(source), side="right"))
        new = (np.uint64(source), np.uint64(target), distance_m, heading_rad, facing_rad)
        columns = [np.insert(c, at, v) for c, v in zip(self._links, new, strict=True)]
        self._links = columns[0], columns[1], columns[2], columns[3], columns[4]
        self._numbers = np.insert(self._numbers, at, n)
        self._along = np.insert(self._along, at, np.nan, axis=1)
        due = np.zeros((2, 8 * -(-(n + 1) // 8)), np.uint8)
        due[:, : n + 1] = np.insert(self._due[:, :n], at, 1, axis=1)
        self._due, self._lists = due, None

    def measure_again(
        self, number: int, distance_m: float, heading_rad: float, facing_rad: float
    ) -> None:
        """Replace the measurement of a link, by its number in the order in which links were given.

        Example:
            >>> relaxation = Relaxation(*(np.array([v]) for v in (0, 1, 1.0, 0.0, 0.0)))
            >>> relaxation.measure_again(0, 3.0, 0.0, 0.0)
            >>> relaxation.run(np.zeros((2, 3)), loops=1, correction=0.5)[0][:, 0].tolist()
            [-1.5, 1.5]
        """
        at = int(np.flatnonzero(self._numbers == number)[0])
        for column, value in zip(
            self._links[2:], (distance_m, heading_rad, facing_rad), strict=True
        ):
            column[at] = value
        self._due[:, at] = 1

    def _make_room(self, n: int) -> None:
        """Keep the state of the poses that there were before; others have changed."""
        more = n - len(self._pose)
        if more:
            self._pose = np.concatenate([self._pose, np.full((more, 3), np.nan)])
            self._lists = None

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
        moved = 0.0
        if loops == 0 or not len(self._links[0]):
            return np.array(poses, dtype=np.float64), moved
        if not switch.ENABLED:
            for left in range(loops - 1, -1, -1):
                before, poses = poses, relax_sequentially(poses, *self._links, correction)
                if left % CHECK_EVERY == 0:
                    away = poses - before
                    moved = float(max(np.abs(away[:, :2]).max(), np.abs(wrap_angles(away)).max()))
                    if moved <= tolerance:
                        break
            return poses, moved
        solved = np.array(poses, dtype=np.float64, order="C")
        self._make_room(len(solved))
        if self._lists is None:
            self._lists = links_at_poses(*self._links[:2], len(solved))
        state = self._pose, self._due, self._along, self._counts, *self._lists
        return solved, relax(solved, *state, *self._links, loops, correction, tolerance)
