r"""Online pose-graph solver: robust, and at work only where the map moves.

It minimises the cost of :mod:`~neuroslam.mapping.least_squares`. A link that may be wrong counts
with dynamic covariance scaling (Agarwal et al. 2013): its squared residual
:math:`\chi^2 = \lVert r \rVert^2` above :math:`\Phi` has the weight and the cost

.. math:: w = \Bigl(\frac{2 \Phi}{\Phi + \chi^2}\Bigr)^2, \qquad
          \rho = \Phi\, \frac{3 \chi^2 - \Phi}{\chi^2 + \Phi} < 3 \Phi.

Weights follow from poses, so that poses and links are the whole state.

A new link wakes the poses at its ends. The poses that move take Gauss-Newton steps while all others
stay. A pose beside them that would then move by more than the tolerance joins them, with as many
around it as move already, until no other would. A new link that contradicts the map is believed if
the map with it, and with the rejected links that agree with it, costs less than the map without.
It is tried if one path between its ends would allow it, or if enough links agree with it, and at
most :data:`TRIALS` are tried in an update.
"""

from typing import NamedTuple

import numpy as np

from neuroslam import compiled as switch
from neuroslam.errors import MapError
from neuroslam.geometry import wrap_angles
from neuroslam.mapping.elimination import eliminate, factored
from neuroslam.mapping.pose_graph import (
    links_of,
    mismatch_over_path,
    normal_equations,
    poses_that_follow,
    robust_cost,
)
from neuroslam.mapping.tables import Links, closes_loop

GATE = 16.266236196238129 / 3.0
r""":math:`\Phi`. One correct link in a thousand has a squared residual above :math:`3 \Phi`,
the quantile of :math:`\chi^2_3`."""

REJECTED = 0.25
r"""Weight below which a link counts as rejected: that of :math:`\chi^2 = 3 \Phi`."""

AGREES = 0.0025
r"""Weight above which a rejected link agrees with another: that of :math:`\chi^2 = 39 \Phi`."""

GROUPS = tuple(int(3 * 1.5**k) for k in range(20))
"""Numbers of links that agree with each other at which they are tried against the map again."""

TRIALS = 2
"""Largest number of trials of one update; a link that is not tried stays rejected for now."""

TOLERANCE = 3e-4
"""Movement (m, rad) that a pose beside the moving part of the map is spared."""

LINEAR = 0.03
"""Step (m, rad) after which the problem counts as linear: the next would be far smaller."""

SOLVED = 1e-6
"""Step (m, rad) at which the whole map is solved."""

ROUNDS = 60
"""Largest number of steps of one solution."""

LEAST_GAIN = 1e-8
"""Relative decrease of the cost below which iteration ends."""


NONE = np.zeros(0, np.int64)


class UpdateReport(NamedTuple):
    """Report of an update.

    Attributes:
        moved: Poses that could move, each once.
        largest: Largest step of the last round, m or rad.
        rounds: Number of linear systems solved.
    """

    moved: np.ndarray
    largest: float
    rounds: int


class IncrementalSolver:
    r"""Keeps a growing pose graph consistent; poses belong to the caller.

    Args:
        source: Pose at which each link begins, ``int64``, shape ``(links,)``.
        target: Pose at which it ends.
        distance_m: Distance from source to target.
        heading_rad: Direction of the target, relative to the source's heading.
        facing_rad: Heading of the target relative to the source's; NaN where it is unknown.
        sigma_m: Standard deviation of a link's position.
        sigma_rad: Standard deviation of its facing.
        doubted: Which links may be wrong, boolean; none by default.
        tolerance: Movement (m, rad) that a pose beside the moving part of the map is spared.
        gate: :math:`\Phi`.

    Example:
        >>> link = [np.array([v]) for v in (0, 1, 1.0, 0.0, 0.0)]
        >>> solver = IncrementalSolver(*link)
        >>> poses = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
        >>> solver.solve(poses).rounds, poses[1].round(6).tolist()
        (2, [1.0, 0.0, 0.0])
    """

    def __init__(
        self,
        source: np.ndarray,
        target: np.ndarray,
        distance_m: np.ndarray,
        heading_rad: np.ndarray,
        facing_rad: np.ndarray,
        *,
        sigma_m: float = 1.0,
        sigma_rad: float = 1.0,
        doubted: np.ndarray | None = None,
        tolerance: float = TOLERANCE,
        gate: float = GATE,
    ) -> None:
        self.tolerance, self.gate, self.n = tolerance, gate, 0
        self._sigma = sigma_m, sigma_rad
        self._ends = np.empty((2, 0), np.int64)
        self._measured, self._scale = np.empty((0, 3)), np.empty((0, 3))
        self._doubted, self._weights = np.empty(0, np.bool_), np.empty(0)
        self._following = np.empty(0, np.int64)
        self._again: list[int] = []
        self._first, self._slot = np.empty(0, np.int64), np.empty(0, np.int64)
        doubts = np.zeros(len(source), np.bool_) if doubted is None else doubted
        columns = source, target, distance_m, heading_rad, facing_rad, doubts
        for row in zip(*(column.tolist() for column in columns), strict=True):
            self.add_link(*row)

    @property
    def weights(self) -> np.ndarray:
        """Weight of every link in (0, 1], at the last solution that moved an end; a copy."""
        return self._weights[: self.n].copy()

    def add_link(
        self,
        source: int,
        target: int,
        distance_m: float,
        heading_rad: float,
        facing_rad: float,
        doubted: bool = False,
        scale: tuple[float, float, float] | None = None,
    ) -> None:
        """Add one link; arguments as of the class.

        ``scale`` are the inverse standard deviations of its displacement, ahead and to the left,
        and of its turn, if not those of the class.
        """
        if self.n == self._weights.size:
            self._make_room(max(64, 2 * self.n))
        self._make_poses(max(source, target) + 1)
        k, self.n = self.n, self.n + 1
        known = facing_rad == facing_rad
        by = scale or (1.0 / self._sigma[0], 1.0 / self._sigma[0], 1.0 / self._sigma[1])
        self._measured[k] = (
            distance_m * np.cos(heading_rad),
            distance_m * np.sin(heading_rad),
            facing_rad if known else 0.0,
        )
        self._scale[k] = by[0], by[1], by[2] if known else 0.0
        self._ends[:, k], self._doubted[k], self._weights[k] = (source, target), doubted, 1.0
        for side, end in enumerate((source, target)):
            self._following[2 * k + side], self._first[end] = self._first[end], 2 * k + side

    def measure_again(
        self, link: int, distance_m: float, heading_rad: float, facing_rad: float
    ) -> None:
        """Replace the measurement of a link; the next update moves its ends.

        Example:
            >>> solver = IncrementalSolver(*(np.array([v]) for v in (0, 1, 1.0, 0.0, 0.0)))
            >>> solver.measure_again(0, 3.0, 0.0, 0.0)
            >>> poses = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
            >>> solver.update(poses, 1).rounds, poses[1].round(6).tolist()
            (2, [3.0, 0.0, 0.0])
        """
        known = facing_rad == facing_rad
        ahead, left = distance_m * np.cos(heading_rad), distance_m * np.sin(heading_rad)
        self._measured[link] = ahead, left, facing_rad if known else 0.0
        self._again.append(link)

    def solve(self, poses: np.ndarray) -> UpdateReport:
        """Solve the whole map in place: all poses but the first may move."""
        self.weigh(poses)
        report = self._settle(poses, np.arange(1, len(poses)), NONE, SOLVED)
        tried: set[int] = set()
        for link in self._rejected().tolist():
            if link not in tried and self._weights[link] < REJECTED:
                agreeing = self._agreeing(poses, link)
                tried.update(agreeing.tolist())
                if len(agreeing) >= GROUPS[0]:  # fewer were tried when they were new
                    self._reconsider(poses, agreeing)
        return report

    def weigh(self, poses: np.ndarray) -> None:
        """Write the weights of all links at these poses."""
        self._check(poses)
        self._weigh(poses, np.arange(self.n))

    def update(self, poses: np.ndarray, since: int) -> UpdateReport:
        """Take in the links from number ``since`` on; move poses in place.

        Args:
            poses: x, y in metres and heading in radians, shape ``(n, 3)``.
            since: Number of links of the last update.
        """
        self._check(poses)
        new = np.append(np.array(self._again, np.int64), np.arange(since, self.n))
        self._again.clear()
        self._weigh(poses, new)
        contested = new[self._weights[new] < REJECTED]
        agreed = new[self._weights[new] >= REJECTED]
        report = self._settle(poses, np.unique(self._ends[:, agreed]), NONE)
        trials = 0
        for link in contested.tolist():
            if trials == TRIALS or self._weights[link] >= REJECTED:
                continue
            agreeing = self._agreeing(poses, link)
            if len(agreeing) in GROUPS or self._possible(poses, link):
                trials += 1
                tried = self._reconsider(poses, agreeing)
                moved = np.union1d(report.moved, tried.moved)
                report = UpdateReport(moved, tried.largest, report.rounds + tried.rounds)
        return report

    def _check(self, poses: np.ndarray) -> None:
        if len(self._first) > len(poses):
            raise MapError(
                f"IncrementalSolver: links end at poses up to {len(self._first) - 1}, "
                f"expected at most {len(poses) - 1}"
            )
        self._make_poses(len(poses))

    def _columns(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        return self._ends[0], self._ends[1], self._measured, self._scale

    def _weigh(self, poses: np.ndarray, links: np.ndarray) -> float:
        """Write the weights of these links; return their cost."""
        return robust_cost(poses, links, *self._columns(), self._doubted, self.gate, self._weights)

    def _settle(
        self, poses: np.ndarray, seeds: np.ndarray, forced: np.ndarray, enough: float = LINEAR
    ) -> UpdateReport:
        """Move the seeds, and what follows them, until a step is small enough.

        ``forced`` links are not doubted meanwhile.
        """
        doubted, slot = self._doubted[forced].copy(), self._slot
        self._doubted[forced] = False
        moving = seeds[seeds > 0]
        slot[moving] = np.arange(len(moving))
        lists = self._first, self._following, self._ends
        links = links_of(moving, slot, *lists)
        cost, damping, largest, rounds = self._weigh(poses, links), 0.0, 0.0, 0
        while len(moving) and rounds < ROUNDS:
            rounds += 1
            args = moving, slot, links, self._weights, *self._columns(), damping
            *equations, _ = normal_equations(poses, *args)
            step = eliminate(*equations) if switch.ENABLED else factored(*equations)
            before = poses[moving]
            poses[moving] = before + step
            lower = self._weigh(poses, links)
            if not lower <= cost * (1.0 + 1e-9) + 1e-12:
                poses[moving] = before
                self._weigh(poses, links)
                damping = max(10.0 * damping, 1e-4)
                if damping > 1e8:
                    break
                continue
            damping = 0.1 * damping if damping > 1e-6 else 0.0
            largest = float(np.abs(step).max())
            more = poses_that_follow(
                poses, moving, slot, *lists, self._weights, self._measured, self._scale,
                self.tolerance,
            )  # fmt: skip
            if len(more):
                moving = np.concatenate([moving, more])
                links = links_of(moving, slot, *lists)
                cost = self._weigh(poses, links)
                continue
            if largest <= enough or cost - lower <= LEAST_GAIN * cost:
                break
            cost = lower
        slot[moving] = -1
        poses[moving, 2] = wrap_angles(poses[moving, 2])
        self._doubted[forced] = doubted
        self._weigh(poses, links)
        return UpdateReport(moving, largest, rounds)

    def _reconsider(self, poses: np.ndarray, forced: np.ndarray) -> UpdateReport:
        """Believe rejected links for a trial; keep the cheaper map."""
        before = poses.copy()
        first = self._settle(poses, np.unique(self._ends[:, forced]), forced)
        then = self._settle(poses, first.moved, NONE)
        self._slot[then.moved] = 0
        links = links_of(then.moved, self._slot, self._first, self._following, self._ends)
        self._slot[then.moved] = -1
        with_it, without = self._weigh(poses, links), self._weigh(before, links)
        rounds = first.rounds + then.rounds
        if with_it < without:
            self._weigh(poses, links)
            return UpdateReport(then.moved, then.largest, rounds)
        poses[:] = before
        return UpdateReport(NONE, 0.0, rounds)

    def _possible(self, poses: np.ndarray, link: int) -> bool:
        """Return whether a link could be right, were the map no better than one path through it."""
        lists = self._first, self._following, self._ends
        columns = self._weights, self._measured, self._scale
        return mismatch_over_path(poses, link, REJECTED, *lists, *columns) <= 3.0 * self.gate

    def _rejected(self) -> np.ndarray:
        found: np.ndarray = np.flatnonzero(self._weights[: self.n] < REJECTED)
        return found

    def _agreeing(self, poses: np.ndarray, link: int) -> np.ndarray:
        """Return a link and the rejected ones that agree with it, directly or through others."""
        group, left, others = [link], [link], self._rejected()
        others = others[others != link]
        while left and len(others):
            agrees = self._satisfied(poses, left.pop(), others)
            left += others[agrees].tolist()
            group += others[agrees].tolist()
            others = others[~agrees]
        return np.sort(np.array(group))

    def _satisfied(self, poses: np.ndarray, link: int, others: np.ndarray) -> np.ndarray:
        """Return which other links would be satisfied if a link moved its target's side rigidly."""
        s, t = self._ends[:, link]
        turn = 0.0  # as far as is known
        if self._scale[link, 2]:
            turn = poses[s, 2] + self._measured[link, 2] - poses[t, 2]
        ends, n = poses[self._ends[1, others]], len(others)
        ends[:, :2] = _turned(ends[:, :2] - poses[t, :2], turn)
        ends[:, :2] += poses[s, :2] + _turned(self._measured[link, :2], poses[s, 2])
        ends[:, 2] += turn
        pairs = np.concatenate([poses[self._ends[0, others]], ends])
        weights, every = np.empty(n), np.arange(n)
        columns = every, every, every + n, self._measured[others], self._scale[others]
        robust_cost(pairs, *columns, np.ones(n, np.bool_), self.gate, weights)
        satisfied: np.ndarray = weights >= AGREES
        return satisfied

    def _make_poses(self, n: int) -> None:
        if n > len(self._first):
            more = np.full(n - len(self._first), -1)
            self._first = np.concatenate([self._first, more])
            self._slot = np.concatenate([self._slot, more])

    def _make_room(self, capacity: int) -> None:
        n = self.n
        for name, shape in (
            ("_measured", (capacity, 3)),
            ("_scale", (capacity, 3)),
            ("_doubted", (capacity,)),
            ("_weights", (capacity,)),
        ):
            old = getattr(self, name)
            new = np.zeros(shape, old.dtype)
            new[:n] = old[:n]
            setattr(self, name, new)
        ends, following = np.zeros((2, capacity), np.int64), np.zeros(2 * capacity, np.int64)
        ends[:, :n], following[: 2 * n] = self._ends[:, :n], self._following[: 2 * n]
        self._ends, self._following = ends, following


def _turned(vectors: np.ndarray, by_rad: float) -> np.ndarray:
    cos, sin = np.cos(by_rad), np.sin(by_rad)
    turned: np.ndarray = vectors @ np.array([[cos, sin], [-sin, cos]])
    return turned


def link_weights(poses: np.ndarray, links: Links, sigma_m: float, sigma_rad: float) -> np.ndarray:
    """Return the weight that each link of a map has at these poses, shape ``(links,)``.

    1 for links that close no loop; below :data:`REJECTED` for those that contradict the map.

    Example:
        >>> ends = np.array([0, 1, 1]), np.array([1, 2, 0])
        >>> apart = np.array([1.0, 1.0, 9.0]), np.zeros(3), np.zeros(3)
        >>> links = Links(*ends, *apart, duration_s=np.ones(3))
        >>> poses = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
        >>> (link_weights(poses, links, 0.1, 0.1) < REJECTED).tolist()
        [False, False, True]
    """
    doubted = closes_loop(links.source, links.target)
    solver = IncrementalSolver(*links[:5], sigma_m=sigma_m, sigma_rad=sigma_rad, doubted=doubted)
    solver.weigh(poses)
    return solver.weights
