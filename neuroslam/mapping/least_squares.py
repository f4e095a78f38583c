r"""Sparse pose-graph optimisation, with rejection of false loop closures.

A link from :math:`s` to :math:`t` measures :math:`z = (d\cos h, d\sin h, f)`: distance, heading and
facing of the target as seen from the source. Its residual, in units of its standard deviations, is

.. math:: r = \begin{pmatrix} (R(\theta_s)^\top (p_t - p_s) - z_{xy}) / \sigma_m \\
          \operatorname{wrap}(\theta_t - \theta_s - f) / \sigma_{rad} \end{pmatrix}

and the solution minimises :math:`\sum w \lVert r \rVert^2`.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np

from neuroslam import compiled as switch
from neuroslam.errors import MapError
from neuroslam.geometry import wrap_angles
from neuroslam.mapping.elimination import eliminate
from neuroslam.mapping.pose_graph import GROUND, normal_equations

if TYPE_CHECKING:
    from scipy.sparse import csr_array
    from scipy.sparse.linalg import SuperLU

FIRST_TRIED = 16
"""Rejectable links that the first stage tests."""

GROWTH = 1.5
"""Factor by which each later stage tests more of them."""

ROUNDS = 10
"""Largest number of rounds of a stage; it ends when no link changes between in and out."""

MAPS_SAMPLED = 32
"""Samples of the map from which its covariance is estimated."""

FALSE_ALARM = 0.01
"""Share of correct links that the gate rejects."""


LEAST_GAIN = 1e-9
"""Relative decrease of the cost below which iteration ends."""


class LeastSquaresReport(NamedTuple):
    r"""Report of :func:`solve_pose_graph`.

    Attributes:
        iterations: Number of linear systems solved.
        cost: :math:`\sum w \lVert r \rVert^2` at the end.
        weights: :math:`w` of every link, shape ``(links,)``; 0 where it was rejected.
        converged: The last step was below the tolerance, or lowered the cost by next to nothing.
    """

    iterations: int
    cost: float
    weights: np.ndarray
    converged: bool


class _Links(NamedTuple):
    source: np.ndarray
    target: np.ndarray
    measured: np.ndarray  # (links, 3): dx_m, dy_m, facing_rad
    scale: np.ndarray  # (links, 3): 1 / sigma; 0 for a facing that was not measured

    def pick(self, which: np.ndarray) -> Self:
        return type(self)(*(field[which] for field in self))


def solve_pose_graph(
    poses: np.ndarray,
    source: np.ndarray,
    target: np.ndarray,
    distance_m: np.ndarray,
    heading_rad: np.ndarray,
    facing_rad: np.ndarray,
    *,
    sigma_m: float | np.ndarray = 1.0,
    sigma_rad: float | np.ndarray = 1.0,
    confidence: np.ndarray | None = None,
    rejectable: np.ndarray | None = None,
    max_iterations: int = 100,
    tolerance: float = 1e-6,
    seed: int = 0,
) -> tuple[np.ndarray, LeastSquaresReport]:
    r"""Find the poses that minimise the residuals of all links; the first pose is fixed.

    Levenberg-Marquardt on the sparse normal equations. Links that are ``rejectable`` are added in
    stages: the most confident first (of equals, those whose ends are best known), 1.5 times more
    in every stage. A link is an inlier while
    :math:`r^\top (I + \Sigma)^{-1} r` is below the 99 % point of :math:`\chi^2`, with
    :math:`\Sigma` the covariance of its residual that follows from the uncertainty of the map,
    estimated from sampled maps. So a link is tested against the more confident ones, an uncertain
    map tolerates larger residuals, and every round tests all links again.

    Args:
        poses: Initial poses, x, y in metres and heading in radians, shape ``(n, 3)``.
        source: Pose at which each link begins, shape ``(links,)``.
        target: Pose at which it ends.
        distance_m: Distance from source to target.
        heading_rad: Direction of the target, relative to the source's heading.
        facing_rad: Heading of the target relative to the source's; NaN where it is unknown, then
            the link constrains the position of the target only.
        sigma_m: Standard deviation of a link's position, one number or one for each link.
        sigma_rad: Standard deviation of its facing.
        confidence: Weight of each link in [0, 1]; rejectable links are added in its order.
        rejectable: Which links may be rejected, boolean; none by default.
        max_iterations: Largest number of steps of the final solution, and of each round.
        tolerance: Largest step (m, rad) of a solution that has converged.
        seed: Seed of the sampled maps.

    Returns:
        The poses, headings in [-pi, pi), shape ``(n, 3)``, and the report.

    Raises:
        MapError: If a link ends outside the map, or a number is not finite.

    Example:
        >>> start = np.zeros((4, 3))  # four poses at one position, a quarter turn apart
        >>> start[:, 2] = [0.0, np.pi / 2, np.pi, 3 * np.pi / 2]
        >>> turn = np.full(4, np.pi / 2)
        >>> solved, report = solve_pose_graph(
        ...     start, np.arange(4), np.array([1, 2, 3, 0]), np.ones(4), np.zeros(4), turn
        ... )
        >>> solved[2, :2].round(6).tolist(), round(report.cost, 9)
        ([1.0, 1.0], 0.0)
    """
    poses = np.array(poses, dtype=np.float64)
    with np.errstate(invalid="ignore"):  # _check names the link that is not finite
        ahead, aside = distance_m * np.cos(heading_rad), distance_m * np.sin(heading_rad)
    measured = np.stack([ahead, aside, facing_rad], axis=1)
    links = _Links(source, target, measured, np.empty_like(measured))
    links.scale[:, :2] = np.reshape(1.0 / np.asarray(sigma_m, dtype=np.float64), (-1, 1))
    links.scale[:, 2] = 1.0 / np.asarray(sigma_rad, dtype=np.float64)
    unknown = np.isnan(facing_rad)
    links.scale[unknown, 2] = links.measured[unknown, 2] = 0.0
    _check(poses, links)
    weights = np.ones(len(source)) if confidence is None else np.array(confidence, dtype=np.float64)
    steps = 0
    if rejectable is not None and rejectable.any():
        poses, weights, steps = _select_inliers(
            poses, links, weights, rejectable, max_iterations, seed
        )
    inlier = weights > 0
    poses, cost, last_steps, converged = _minimise(
        poses, links.pick(inlier), weights[inlier], max_iterations, tolerance
    )
    poses[1:, 2] = wrap_angles(poses[1:, 2])
    return poses, LeastSquaresReport(steps + last_steps, cost, weights, converged)


def _check(poses: np.ndarray, links: _Links) -> None:
    ends = np.concatenate([links.source, links.target])
    if len(ends) and not 0 <= ends.min() <= ends.max() < len(poses):
        raise MapError(
            f"solve_pose_graph: links end at poses {ends.min()} to {ends.max()}, "
            f"expected 0 to {len(poses) - 1}"
        )
    for name, values in (("pose", poses), ("link", links.measured), ("link's sigma", links.scale)):
        bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
        if len(bad):
            raise MapError(
                f"solve_pose_graph: {name} {bad[0]} is {values[bad[0]]}, expected finite numbers"
            )


def _residuals(poses: np.ndarray, links: _Links) -> np.ndarray:
    theta = poses[links.source, 2]
    cos, sin = np.cos(theta), np.sin(theta)
    dx, dy, turn = (poses[links.target] - poses[links.source]).T
    off = np.stack([cos * dx + sin * dy, cos * dy - sin * dx, turn], axis=1) - links.measured
    off[:, 2] = wrap_angles(off[:, 2])
    residuals: np.ndarray = off * links.scale
    return residuals


def _jacobian(poses: np.ndarray, links: _Links) -> "csr_array":
    """Return the derivative of the residuals, ``(3 links, 3 n)``; zero for the first pose."""
    from scipy.sparse import csr_array  # slow to import, not always needed

    theta = poses[links.source, 2]
    dx, dy = (poses[links.target, :2] - poses[links.source, :2]).T
    by_x, by_y, by_turn = links.scale.T
    cos, sin = np.cos(theta), np.sin(theta)
    values = np.stack(
        [  # each row: x, y, theta of the source, then x, y of the target (theta in the last row)
            [-cos * by_x, -sin * by_x, (cos * dy - sin * dx) * by_x, cos * by_x, sin * by_x],
            [sin * by_y, -cos * by_y, (-cos * dx - sin * dy) * by_y, -sin * by_y, cos * by_y],
        ]
    )
    at_source, at_target = 3 * links.source, 3 * links.target
    columns = np.stack([at_source, at_source + 1, at_source + 2, at_target, at_target + 1])
    rows = 3 * np.arange(len(links.source))
    values = np.concatenate([values.reshape(10, -1), [-by_turn, by_turn]])
    columns = np.concatenate([columns, columns, [at_source + 2, at_target + 2]])
    rows = np.concatenate(
        [np.tile(rows, (5, 1)), np.tile(rows + 1, (5, 1)), np.tile(rows + 2, (2, 1))]
    )
    values[columns < 3] = 0.0
    shape = (3 * len(links.source), 3 * len(poses))
    return csr_array((values.ravel(), (rows.ravel(), columns.ravel())), shape=shape)


def _factor(normal: Any, damping: float) -> "SuperLU":  # noqa: ANN401 - scipy's products are untyped
    """Factorise the damped normal equations, a sparse matrix.

    The tiny constant on the diagonal fixes what no link fixes: the first pose, and parts of the map
    that are not connected to it.
    """
    from scipy.sparse import csc_array, diags_array
    from scipy.sparse.linalg import splu

    diagonal = normal.diagonal()
    held = normal + diags_array(damping * diagonal + 1e-12 * max(diagonal.max(), 1.0))
    return splu(
        csc_array(held),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )


def _solved(normal: Any, right: np.ndarray) -> np.ndarray:  # noqa: ANN401
    """Solve sparse normal equations of one number a pose, with up to three right sides."""
    if not switch.ENABLED:
        solution: np.ndarray = _factor(normal, 0.0).solve(right)
        return solution
    from scipy.sparse import triu

    n, columns = len(right), right.reshape(len(right), -1)
    upper, diagonal = triu(normal, 1).tocoo(), normal.diagonal()
    diagonal = diagonal + GROUND * max(diagonal.max(), 1.0)
    slope = np.zeros((n, 3))
    slope[:, : columns.shape[1]] = columns
    ends = np.stack([upper.row, upper.col], axis=1).astype(np.int64)
    found = eliminate(
        diagonal[:, None, None] * np.eye(3), slope, upper.data[:, None, None] * np.eye(3), ends
    )
    return found[:, : columns.shape[1]].reshape(right.shape)


def _headings_then_positions(poses: np.ndarray, links: _Links) -> np.ndarray:
    """Solve for the headings, then for the positions: two linear problems, a good initial guess."""
    from scipy.sparse import csr_array, diags_array

    n = len(poses)
    ends = np.concatenate([links.source, links.target])
    rows = np.tile(np.arange(len(links.source)), 2)
    signs = np.repeat([-1.0, 1.0], len(links.source)) * (ends > 0)
    difference = csr_array((signs, (rows, ends)), shape=(len(links.source), n))
    start, measured = poses[links.source], links.measured

    def least(values: np.ndarray, scale: np.ndarray) -> np.ndarray:
        scaled = diags_array(scale) @ difference
        right = scaled.T @ (values.T * scale).T
        return _solved(scaled.T @ scaled, right)

    # Solved as corrections of the poses, so that whole turns and the first pose stay.
    turn = wrap_angles(measured[:, 2] - poses[links.target, 2] + start[:, 2])
    theta = poses[:, 2] + least(turn, links.scale[:, 2])
    cos, sin = np.cos(theta[links.source]), np.sin(theta[links.source])
    ahead, aside = measured[:, 0], measured[:, 1]
    away = np.stack([cos * ahead - sin * aside, sin * ahead + cos * aside], 1)
    away -= poses[links.target, :2] - start[:, :2]
    positions = poses[:, :2] + least(away, links.scale[:, 0])
    return np.column_stack([positions, theta])


def _minimise(
    poses: np.ndarray, links: _Links, weights: np.ndarray, max_iterations: int, tolerance: float
) -> tuple[np.ndarray, float, int, bool]:
    """Run Levenberg-Marquardt; return poses, cost, number of steps, and whether it converged."""
    links = links._replace(scale=links.scale * np.sqrt(weights)[:, None])
    if not len(links.source):
        return poses, 0.0, 0, True
    poses, residuals, cost = min(
        (_evaluated(start, links) for start in (poses, _headings_then_positions(poses, links))),
        key=lambda evaluated: evaluated[2],
    )
    damping, steps, converged = 1e-9, 0, False
    while not converged and steps < max_iterations:
        step_of = _steps(poses, links, residuals)
        worse, moved = True, (poses, residuals, cost)
        while worse and not converged and steps < max_iterations:
            steps += 1
            step = step_of(damping)
            moved = _evaluated(poses + step, links)
            gain = cost - moved[2]
            worse = not gain >= 0.0
            converged = bool(np.abs(step).max() <= tolerance) or 0.0 <= gain <= LEAST_GAIN * cost
            damping = 10.0 * damping if worse else max(0.1 * damping, 1e-12)
        if not worse:
            poses, residuals, cost = moved
    return poses, cost, steps, converged


def _steps(
    poses: np.ndarray, links: _Links, residuals: np.ndarray
) -> Callable[[float], np.ndarray]:
    """Return the damped Gauss-Newton step from these poses, a function of the damping.

    By compiled elimination, a twentieth of the time of the definition: scipy's factorisation.
    """
    source, target, measured, scale = links
    n, every = len(poses), np.arange(len(source))

    def eliminated(damping: float) -> np.ndarray:
        *equations, _ = normal_equations(
            poses, np.arange(1, n), np.arange(-1, n - 1), every, np.ones(len(source)),
            source, target, measured, scale, damping,
        )  # fmt: skip
        return np.vstack([np.zeros((1, 3)), eliminate(*equations)])

    if switch.ENABLED and n > 1 and not (source == target).any():
        return eliminated
    jacobian = _jacobian(poses, links)
    normal, slope = jacobian.T @ jacobian, jacobian.T @ residuals.ravel()
    return lambda damping: -_factor(normal, damping).solve(slope).reshape(-1, 3)


def _evaluated(poses: np.ndarray, links: _Links) -> tuple[np.ndarray, np.ndarray, float]:
    residuals = _residuals(poses, links)
    return poses, residuals, float(np.vdot(residuals, residuals))


def _select_inliers(
    poses: np.ndarray,
    links: _Links,
    confidence: np.ndarray,
    rejectable: np.ndarray,
    max_iterations: int,
    seed: int,
) -> tuple[np.ndarray, np.ndarray, int]:
    """Add rejectable links in stages; return poses, weights (0: rejected) and number of steps."""
    from scipy.special import chdtri

    generator = np.random.default_rng(seed)
    weights = np.where(rejectable, 0.0, confidence)
    gate = chdtri(2.0 + (links.scale[:, 2] > 0), FALSE_ALARM)
    candidates = np.flatnonzero(rejectable)
    steps, n_tested = 0, 0
    while n_tested < len(candidates):
        n_tested = min(int(GROWTH * n_tested) + FIRST_TRIED, len(candidates))
        for _ in range(ROUNDS):
            covariance = _sampled_covariance(poses, links, weights, candidates, generator)
            variance = np.trace(covariance, axis1=1, axis2=2)
            order = np.lexsort([variance, -confidence[candidates]])[:n_tested]
            tested = candidates[order]
            residuals = _residuals(poses, links.pick(tested))[..., None]
            squares = residuals * np.linalg.solve(covariance[order] + np.eye(3), residuals)
            inlier = squares.sum(axis=(1, 2)) < gate[tested]
            before = weights.copy()
            weights[candidates] = 0.0
            weights[tested[inlier]] = confidence[tested[inlier]]
            if np.array_equal(weights, before):
                break
            chosen = weights > 0
            poses, _, used, _ = _minimise(
                poses, links.pick(chosen), weights[chosen], max_iterations, 1e-3
            )
            steps += used
    return poses, weights, steps


def _sampled_covariance(
    poses: np.ndarray,
    links: _Links,
    weights: np.ndarray,
    wanted: np.ndarray,
    generator: np.random.Generator,
) -> np.ndarray:
    r"""Return the covariance of some residuals due to the uncertainty of the map.

    With :math:`H = J^\top J`, :math:`x = H^{-1} J^\top \epsilon` of white :math:`\epsilon` has
    covariance :math:`H^{-1}`: a few samples cost one factorisation for any number of links.

    Returns:
        Shape ``(wanted, 3, 3)``.
    """
    inliers = links.pick(weights > 0)
    inliers.scale[:] *= np.sqrt(weights[weights > 0])[:, None]
    jacobian = _jacobian(poses, inliers)
    white = generator.standard_normal((3 * len(inliers.source), MAPS_SAMPLED))
    maps = _factor(jacobian.T @ jacobian, 0.0).solve(jacobian.T @ white)
    samples = (_jacobian(poses, links.pick(wanted)) @ maps).reshape(-1, 3, MAPS_SAMPLED)
    covariance: np.ndarray = samples @ samples.transpose(0, 2, 1) / MAPS_SAMPLED
    return covariance
