r"""Sparse pose-graph optimisation: the map whose links agree best, and which loops to disbelieve.

A link from :math:`s` to :math:`t` measures :math:`z = (d\cos h, d\sin h, f)`: distance, heading and
facing of the target as seen from the source. Its residual, in units of its standard deviations, is

.. math:: r = \begin{pmatrix} (R(\theta_s)^\top (p_t - p_s) - z_{xy}) / \sigma_m \\
          \operatorname{wrap}(\theta_t - \theta_s - f) / \sigma_{rad} \end{pmatrix}

and the map sought is the one of least :math:`\sum w \lVert r \rVert^2`.
"""

from typing import NamedTuple, Self

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu
from scipy.special import chdtri

from neuroslam.errors import MapError
from neuroslam.geometry import wrap_angles

FIRST_TRIED = 16
"""Doubtful links that are tried at first."""

GROWTH = 1.5
"""Every later stage tries so many times more of them."""

ROUNDS = 10
"""Times that a stage judges its links at most; it ends when the verdicts stay the same."""

MAPS_SAMPLED = 32
"""Maps that are drawn to learn how uncertain the map is."""

FALSE_ALARM = 0.01
"""Share of the right links that the gate turns away."""


LEAST_GAIN = 1e-9
"""A step that lowers the cost by a smaller share of it is the last."""


class LeastSquaresReport(NamedTuple):
    r"""How :func:`solve_pose_graph` went.

    Attributes:
        iterations: Linear systems solved for a step.
        cost: :math:`\sum w \lVert r \rVert^2` at the end.
        weights: :math:`w` of every link, shape ``(links,)``; 0 where it was disbelieved.
        converged: The last step was below the tolerance, or gained next to nothing.
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
        return self._make(field[which] for field in self)


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
    doubtful: np.ndarray | None = None,
    max_iterations: int = 100,
    tolerance: float = 1e-6,
    seed: int = 0,
) -> tuple[np.ndarray, LeastSquaresReport]:
    r"""Find the poses that agree best with all links; the first pose stays where it is.

    Levenberg-Marquardt on the sparse normal equations. Where links are ``doubtful``, they are
    admitted by degrees: the most confident first (of equals, those whose ends the map knows best),
    1.5 times more in every round. One is believed while
    :math:`r^\top (I + \Sigma)^{-1} r` is below the 99 % point of :math:`\chi^2`, with
    :math:`\Sigma` the covariance that its residual has for the uncertainty of the map itself,
    estimated from sampled maps. So a link is judged by the better ones before it, a loose map is
    generous, and every round judges all of them anew.

    Args:
        poses: Where to begin, x, y in metres and heading in radians, shape ``(n, 3)``.
        source: Pose at which each link begins, shape ``(links,)``.
        target: Pose at which it ends.
        distance_m: Distance from source to target.
        heading_rad: Direction of the target, relative to the source's heading.
        facing_rad: Heading of the target relative to the source's; NaN where it is unknown, then
            the link says only where the target is.
        sigma_m: Standard deviation of a link's position, one or one a link.
        sigma_rad: Standard deviation of its facing.
        confidence: Weight of each link in [0, 1], and for doubtful ones the order of admission.
        doubtful: Which links may be disbelieved, boolean; none by default.
        max_iterations: Steps of the final solution, and of each round of admission.
        tolerance: Largest step (m, rad) that counts as standing still.
        seed: Seed of the sampled maps.

    Returns:
        The poses, headings in [-pi, pi), shape ``(n, 3)``, and the report.

    Raises:
        MapError: If a link ends outside the map, or a number is not finite.

    Example:
        >>> heap = np.zeros((4, 3))  # four poses on one spot, a quarter turn apart
        >>> heap[:, 2] = [0.0, np.pi / 2, np.pi, 3 * np.pi / 2]
        >>> turn = np.full(4, np.pi / 2)
        >>> solved, report = solve_pose_graph(
        ...     heap, np.arange(4), np.array([1, 2, 3, 0]), np.ones(4), np.zeros(4), turn
        ... )
        >>> solved[2, :2].round(6).tolist(), round(report.cost, 9)
        ([1.0, 1.0], 0.0)
    """
    poses = np.array(poses, dtype=np.float64)
    with np.errstate(invalid="ignore"):  # _check says which link is infinite
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
    if doubtful is not None and doubtful.any():
        poses, weights, steps = _admit(poses, links, weights, doubtful, max_iterations, seed)
    believed = weights > 0
    poses, cost, last_steps, converged = _minimise(
        poses, links.pick(believed), weights[believed], max_iterations, tolerance
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
    seen = np.stack([cos * dx + sin * dy, cos * dy - sin * dx, turn], axis=1) - links.measured
    seen[:, 2] = wrap_angles(seen[:, 2])
    return seen * links.scale


def _jacobian(poses: np.ndarray, links: _Links) -> sparse.csr_array:
    """Derivative of the residuals, ``(3 links, 3 n)``; the columns of the first pose are zero."""
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
    return sparse.csr_array((values.ravel(), (rows.ravel(), columns.ravel())), shape=shape)


def _factor(normal: sparse.csc_array, damping: float) -> SuperLU:
    """Factorise the damped normal equations.

    The tiny constant on the diagonal holds still what no link holds: the first pose, and parts of
    the map that are not connected to it.
    """
    diagonal = normal.diagonal()
    held = normal + sparse.diags_array(damping * diagonal + 1e-12 * max(diagonal.max(), 1.0))
    return splu(
        sparse.csc_array(held),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )


def _turn_then_place(poses: np.ndarray, links: _Links) -> np.ndarray:
    """Solve for the headings alone, then for the places: two linear problems, a good beginning."""
    n = len(poses)
    ends = np.concatenate([links.source, links.target])
    rows = np.tile(np.arange(len(links.source)), 2)
    signs = np.repeat([-1.0, 1.0], len(links.source)) * (ends > 0)
    difference = sparse.csr_array((signs, (rows, ends)), shape=(len(links.source), n))
    seen_from, seen = poses[links.source], links.measured

    def least(values: np.ndarray, scale: np.ndarray) -> np.ndarray:
        scaled = sparse.diags_array(scale) @ difference
        return _factor(scaled.T @ scaled, 0.0).solve(scaled.T @ (values.T * scale).T)

    # sought as corrections of the poses, so that whole turns and the first pose stay as they are
    turn = wrap_angles(seen[:, 2] - poses[links.target, 2] + seen_from[:, 2])
    theta = poses[:, 2] + least(turn, links.scale[:, 2])
    cos, sin = np.cos(theta[links.source]), np.sin(theta[links.source])
    away = np.stack([cos * seen[:, 0] - sin * seen[:, 1], sin * seen[:, 0] + cos * seen[:, 1]], 1)
    away -= poses[links.target, :2] - seen_from[:, :2]
    places = poses[:, :2] + least(away, links.scale[:, 0])
    return np.column_stack([places, theta])


def _minimise(
    poses: np.ndarray, links: _Links, weights: np.ndarray, max_iterations: int, tolerance: float
) -> tuple[np.ndarray, float, int, bool]:
    """Levenberg-Marquardt; returns poses, cost, steps and whether it came to an end."""
    links = links._replace(scale=links.scale * np.sqrt(weights)[:, None])
    if not len(links.source):
        return poses, 0.0, 0, True
    poses, residuals, cost = min(
        (_weighed(start, links) for start in (poses, _turn_then_place(poses, links))),
        key=lambda weighed: weighed[2],
    )
    damping, steps, converged = 1e-9, 0, False
    while not converged and steps < max_iterations:
        jacobian = _jacobian(poses, links)
        normal, slope = jacobian.T @ jacobian, jacobian.T @ residuals.ravel()
        worse = True
        while worse and not converged and steps < max_iterations:
            steps += 1
            step = _factor(normal, damping).solve(slope).reshape(-1, 3)
            moved = _weighed(poses - step, links)
            gain = cost - moved[2]
            worse = not gain >= 0.0
            converged = bool(np.abs(step).max() <= tolerance) or 0.0 <= gain <= LEAST_GAIN * cost
            damping = 10.0 * damping if worse else max(0.1 * damping, 1e-12)
        if not worse:
            poses, residuals, cost = moved
    return poses, cost, steps, converged


def _weighed(poses: np.ndarray, links: _Links) -> tuple[np.ndarray, np.ndarray, float]:
    residuals = _residuals(poses, links)
    return poses, residuals, float(np.vdot(residuals, residuals))


def _admit(
    poses: np.ndarray,
    links: _Links,
    confidence: np.ndarray,
    doubtful: np.ndarray,
    max_iterations: int,
    seed: int,
) -> tuple[np.ndarray, np.ndarray, int]:
    """Admit doubtful links by degrees; returns poses, weights (0: disbelieved) and steps."""
    generator = np.random.default_rng(seed)
    weights = np.where(doubtful, 0.0, confidence)
    gate = chdtri(2.0 + (links.scale[:, 2] > 0), FALSE_ALARM)
    candidates = np.flatnonzero(doubtful)
    steps, n_tried = 0, 0
    while n_tried < len(candidates):
        n_tried = min(int(GROWTH * n_tried) + FIRST_TRIED, len(candidates))
        for _ in range(ROUNDS):
            spread = _sampled_covariance(poses, links, weights, candidates, generator)
            looseness = np.trace(spread, axis1=1, axis2=2)
            order = np.lexsort([looseness, -confidence[candidates]])[:n_tried]
            tried = candidates[order]
            residuals = _residuals(poses, links.pick(tried))[..., None]
            surprise = residuals * np.linalg.solve(spread[order] + np.eye(3), residuals)
            believed = surprise.sum(axis=(1, 2)) < gate[tried]
            before = weights.copy()
            weights[candidates] = 0.0
            weights[tried[believed]] = confidence[tried[believed]]
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
    r"""Covariance of the wanted residuals for the uncertainty of the map, ``(wanted, 3, 3)``.

    With :math:`H = J^\top J`, :math:`x = H^{-1} J^\top \epsilon` of white :math:`\epsilon` has
    covariance :math:`H^{-1}`: a few draws cost one factorisation, however many links ask.
    """
    believed = links.pick(weights > 0)
    believed.scale[:] *= np.sqrt(weights[weights > 0])[:, None]
    jacobian = _jacobian(poses, believed)
    white = generator.standard_normal((jacobian.shape[0], MAPS_SAMPLED))
    maps = _factor(jacobian.T @ jacobian, 0.0).solve(jacobian.T @ white)
    drawn = (_jacobian(poses, links.pick(wanted)) @ maps).reshape(-1, 3, MAPS_SAMPLED)
    return drawn @ drawn.transpose(0, 2, 1) / MAPS_SAMPLED
