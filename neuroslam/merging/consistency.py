r"""Consistency of two maps with their matched pairs: a test of the residuals.

The links of both maps and the pairs, links of length 0, are one pose graph. Solved with robust
least squares, it costs more than the two maps alone,

.. math:: \Delta = C_{lp} - C_l - C_p

which follows :math:`\chi^2` with :math:`m = 3(n - 1)` degrees of freedom for :math:`n` right
pairs: the first pair fixes the alignment. The standard deviations of a link of length :math:`d`
and heading change :math:`f` are :math:`s\,k\,(0.025\,d + 0.015\,\bar d)` and
:math:`s\,k\,(0.05\,|f| + 0.005)`, with the median length :math:`\bar d`,
:math:`k` = ``sessions.residual_factor``, and :math:`s` the noise of the odometry that the loop
closures of the two maps themselves show,

.. math:: s^2 = \max\left(1, \frac{\nu + C_l + C_p}{\nu + \nu_l + \nu_p}\right)

with :math:`\nu_l, \nu_p` the degrees of freedom of their loops, and :math:`\nu = 12`. As the noise
is an estimate, :math:`\Delta / m` is compared with the quantile of
:math:`F(m, \nu + \nu_l + \nu_p)` that right pairs exceed at the rate ``sessions.false_alarm``.
"""

import math
from typing import NamedTuple

import numpy as np

from neuroslam.config import BrainConfig
from neuroslam.errors import counted
from neuroslam.geometry import move_points, wrap_angles
from neuroslam.mapping.experience import ExperienceMap
from neuroslam.mapping.least_squares import solve_pose_graph
from neuroslam.mapping.overlap import n_places
from neuroslam.mapping.tables import Links
from neuroslam.merging.distinctness import CHANCE, Distinctness, distinctness
from neuroslam.merging.mapped import Mapped
from neuroslam.merging.shape import misshapen
from neuroslam.state.match import Pairs
from neuroslam.types import Pose

PRIOR_FREEDOM = 12
"""Weight of the prior noise of odometry, in degrees of freedom."""

COLLAPSED = 64.0
"""Cost of a degree of freedom above which a map contradicts its own odometry: 8 sigma."""

MANY_LOOPS = 0.1
"""Loops of an experience from which that is more than a single wrong loop: such a map has
collapsed. Fewer are counted as places that look alike."""

VIEW_SIGMA_RAD = math.radians(10.0)
"""Standard deviation of the heading at which a view is recognised."""

LEAST_TURN_DEG = 45.0
"""Range of headings that agreeing pairs must have: along a straight aisle places repeat."""

LEAST_SHARE = 1.0 / 6.0
"""Share of the experiences on the common path that must match: else they look different."""

SAME_HEADING_RAD = math.radians(20.0)
"""Largest difference of heading on a common path."""

ITERATIONS = 30


class Consistency(NamedTuple):
    """Result of the test.

    Attributes:
        loaded: Solved poses of the loaded experiences, ``(n, 3)``.
        partial: Those of the partial experiences in the same frame, ``(m, 3)``.
        inlier: Which pairs agree with the solution.
        excess: Rise of the cost by the pairs.
        allowed: Value that it exceeds for right pairs at the rate ``sessions.false_alarm``.
        noise: Noise of the odometry, :math:`s`.
        own: Cost of a degree of freedom of the loaded and of the partial map at :math:`s = 1`.
    """

    loaded: np.ndarray
    partial: np.ndarray
    inlier: np.ndarray
    excess: float
    allowed: float
    noise: float
    own: tuple[float, float]

    def turn_deg(self, pairs: Pairs) -> float:
        """Return the range of headings along the agreeing pairs, in degrees."""
        along = np.unique(pairs.partial[self.inlier])
        headings = np.unwrap(self.partial[along, 2])
        return float(np.degrees(np.ptp(headings))) if len(headings) else 0.0


def check_consistency(
    loaded: ExperienceMap,
    partial: ExperienceMap,
    pairs: Pairs,
    config: BrainConfig,
    *,
    robust: bool,
) -> Consistency:
    """Solve the pose graph of two maps and their pairs, and test the rise of its cost.

    Args:
        loaded: One map; it is not altered.
        partial: The other; it is not altered.
        pairs: Matched pairs, at least one.
        config: Config of both.
        robust: Leave out pairs that disagree with the others.
    """
    factor = config.sessions.residual_factor
    sigmas = [link_sigmas(one.links, factor) for one in (loaded, partial)]
    costs = [_own_cost(one, sigma) for one, sigma in zip((loaded, partial), sigmas, strict=True)]
    freedom = [3 * max(one.n_links - one.n + 1, 0) for one in (loaded, partial)]
    square = max(1.0, (PRIOR_FREEDOM + sum(costs)) / (PRIOR_FREEDOM + sum(freedom)))
    noise = math.sqrt(square)
    poses, links, ends = _joined(loaded, partial, pairs)
    cells = config.pose_cells
    at_pairs = np.ones(len(pairs.partial))
    position_m = 0.5 * cells.create_threshold_cells * cells.cell_size_m
    sigma_m = np.concatenate([*(noise * s[0] for s in sigmas), position_m * at_pairs])
    sigma_rad = np.concatenate([*(noise * s[1] for s in sigmas), VIEW_SIGMA_RAD * at_pairs])
    rejectable = np.arange(len(sigma_m)) >= len(sigma_m) - len(at_pairs)
    solved, report = solve_pose_graph(
        poses,
        *ends,
        *links,
        sigma_m=sigma_m,
        sigma_rad=sigma_rad,
        rejectable=rejectable if robust else None,
        max_iterations=ITERATIONS,
    )
    from scipy.special import fdtri  # slow to import, not always needed

    inlier = report.weights[rejectable] > 0
    n_free, rate = max(3 * (int(inlier.sum()) - 1), 1), config.sessions.false_alarm
    return Consistency(
        solved[: loaded.n],
        solved[loaded.n :],
        inlier,
        report.cost - sum(costs) / square,
        n_free * float(fdtri(n_free, PRIOR_FREEDOM + sum(freedom), 1.0 - rate)),
        noise,
        (costs[0] / max(freedom[0], 1), costs[1] / max(freedom[1], 1)),
    )


def link_sigmas(links: Links, factor: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the standard deviations of the position and heading of links, in m and rad.

    Args:
        links: Links of one map.
        factor: ``sessions.residual_factor``.
    """
    d = links.distance_m
    typical_m = float(np.median(d)) if len(d) else 1.0
    turn = np.abs(wrap_angles(links.facing_rad))
    floor_m = 1e-3 * factor  # links of a robot that stands still
    return factor * (0.025 * d + 0.015 * typical_m) + floor_m, factor * (0.05 * turn + 0.005)


def _own_cost(of: ExperienceMap, sigmas: tuple[np.ndarray, np.ndarray]) -> float:
    if not of.n_links:
        return 0.0
    _, report = solve_pose_graph(
        of.poses, *of.links[:5], sigma_m=sigmas[0], sigma_rad=sigmas[1], max_iterations=ITERATIONS
    )
    return report.cost


def solve_alone(of: ExperienceMap, config: BrainConfig) -> tuple[np.ndarray, int]:
    """Solve a map without the loop closures that its odometry contradicts.

    Args:
        of: The map; it is not altered.
        config: Its config.

    Returns:
        Poses, ``(n, 3)``, and the number of loop closures that were left out.
    """
    if not of.n_links:
        return of.poses, 0
    links = of.links
    loops = np.abs(links.target - links.source) != 1
    sigma_m, sigma_rad = link_sigmas(links, config.sessions.residual_factor)
    solved, report = solve_pose_graph(
        of.poses,
        *links[:5],
        sigma_m=sigma_m,
        sigma_rad=sigma_rad,
        rejectable=loops,
        max_iterations=ITERATIONS,
    )
    return solved, int((report.weights[loops] == 0.0).sum())


def _joined(
    loaded: ExperienceMap, partial: ExperienceMap, pairs: Pairs
) -> tuple[np.ndarray, tuple[np.ndarray, ...], tuple[np.ndarray, np.ndarray]]:
    """Return poses, measurements and ends of the joint pose graph; the pairs are its last links."""
    best = int(np.argmin(pairs.error))
    onto, pivot = loaded.poses[pairs.loaded[best]], partial.poses[pairs.partial[best]]
    onto[2] += pairs.turn_rad[best]
    theirs = partial.poses
    xy_m = move_points(theirs[:, :2], Pose(*pivot.tolist()), Pose(*onto.tolist()))
    theta = wrap_angles(theirs[:, 2] - pivot[2] + onto[2])
    a, b = loaded.links, partial.links
    zero = np.zeros(len(pairs.partial))
    measured = zip(a[2:5], b[2:5], (zero, zero, pairs.turn_rad), strict=True)
    return (
        np.vstack([loaded.poses, np.column_stack([xy_m, theta])]),
        tuple(np.concatenate(columns) for columns in measured),
        (
            np.concatenate([a.source, b.source + loaded.n, pairs.loaded]),
            np.concatenate([a.target, b.target + loaded.n, pairs.partial + loaded.n]),
        ),
    )


def weakness(loaded: Mapped, partial: Mapped, pairs: Pairs, result: Consistency) -> str:
    """Return why the evidence for an alignment is too weak, and what helps; empty if it is not.

    Args:
        loaded: One brain.
        partial: The other, whose config sets ``sessions.confirm``.
        pairs: Matched pairs of distinct views.
        result: Their test.
    """
    confirm = partial.config.sessions.confirm
    maps = ("first", loaded.map), ("second", partial.map)
    contradicted = 0
    for (name, one), cost in zip(maps, result.own, strict=True):
        loops = one.n_links - one.n + 1
        contradicted += solve_alone(one, partial.config)[1] if cost > COLLAPSED else 0
        if loops >= MANY_LOOPS * one.n and cost > COLLAPSED:
            return (
                f"the loop closures of the {name} map contradict its odometry, with a residual of "
                f"{math.sqrt(cost):.0f} standard deviations: its views match at several places; "
                f"make it with view.threshold below {partial.config.view.threshold:g}"
            )
    kept = pairs.pick(result.inlier)
    places = n_places(kept)
    if places < confirm or 2 * len(kept.partial) <= len(pairs.partial):
        return (
            f"{len(kept.partial)} of {counted(len(pairs.partial), 'experience')} matched by view "
            f"agree with the odometry of both maps; expected {confirm} (--confirm) and more than "
            "half; drive more of the common path in both sessions"
        )
    n_views = count_views(loaded.map, partial.map, kept)
    if n_views < confirm:
        return (
            f"{counted(len(kept.partial), 'experience')} matched, but only by "
            f"{counted(n_views, 'view')}; expected {confirm} (--confirm); make both maps with a "
            f"smaller view.threshold (now {partial.config.view.threshold:g})"
        )
    turn_deg = result.turn_deg(pairs)
    if turn_deg < LEAST_TURN_DEG:
        return (
            f"{counted(len(kept.partial), 'experience')} matched by view, but along a path that "
            f"turns by {turn_deg:.0f} degrees only; expected {LEAST_TURN_DEG:g}, because places "
            "along a straight path repeat; drive through a bend in both sessions"
        )
    on_path = common_path(result, partial.config) | np.isin(np.arange(partial.map.n), kept.partial)
    share = len(np.unique(kept.partial)) / int(on_path.sum())
    within = n_places(kept.pick(kept.error <= partial.config.view.threshold))
    if share < LEAST_SHARE:
        return (
            f"{share:.0%} of the {int(on_path.sum())} experiences on the common path match by "
            f"view, {within} of them within view.threshold; expected {LEAST_SHARE:.0%}: the paths "
            "have one shape, but look different; drive more of the common path in both sessions"
        )
    if partial.config.sessions.coincidence < 1.0:
        solved = result.loaded, result.partial
        found = distinctness(loaded, partial, solved, kept, contradicted)
        if found.coincidence > partial.config.sessions.coincidence:
            # Maps of other scales do not lie on each other: one place seems to be several.
            bent = misshapen(loaded.map, partial.map, kept, partial.config)
            return bent or _not_distinct(found, partial.config)
    return inconsistency(result)


def _not_distinct(found: Distinctness, config: BrainConfig) -> str:
    """Return why matched places may be others that look the same, and what helps."""
    few = found.alike < CHANCE * found.places + 1.0
    cause = (
        "too few places are known to say how rare such views are; drive more of the common path, "
        "and of other places, in both sessions"
        if few
        else f"{found.alike:.0f} of {counted(found.places, 'place')} look like another one, the "
        "building repeats itself; if the maps are known to be of one building, and to meet where "
        "it does not repeat, raise --set sessions.coincidence"
    )
    return (
        f"{counted(found.matched, 'place')} matched by view, but with a probability of "
        f"{found.coincidence:.1%} they are others that look the same; expected at most "
        f"{config.sessions.coincidence:.1%}: {cause}"
    )


def count_views(loaded: ExperienceMap, partial: ExperienceMap, pairs: Pairs) -> int:
    """Count the templates by which pairs were matched, on the map that has fewer of them."""
    ends = (loaded, pairs.loaded), (partial, pairs.partial)
    return min(len(np.unique(one.experiences["template"].numpy()[ids])) for one, ids in ends)


def common_path(result: Consistency, config: BrainConfig) -> np.ndarray:
    """Return which partial experiences lie on the path of the loaded map, after the solution.

    They have a loaded experience within the size of an experience, at most 20 degrees away.
    """
    from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

    cells = config.pose_cells
    place_m = cells.create_threshold_cells * cells.cell_size_m
    near = cKDTree(result.loaded[:, :2]).query_ball_point(result.partial[:, :2], place_m)
    return np.array(
        [
            bool((np.abs(wrap_angles(result.loaded[ids, 2] - theta)) < SAME_HEADING_RAD).any())
            for ids, theta in zip(near, result.partial[:, 2], strict=True)
        ],
        dtype=bool,
    )


def inconsistency(result: Consistency) -> str:
    """Return by how much the residuals of a merged map are too large; empty if they are not."""
    if result.excess <= result.allowed:
        return ""
    return (
        f"the merged map is inconsistent: its pairs raise the squared residuals of the links by "
        f"{result.excess:.1f} variances; expected at most {result.allowed:.1f}; if the odometry is "
        "worse than its loop closures show, raise --set sessions.residual_factor"
    )
