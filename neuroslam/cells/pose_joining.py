"""Movement of a session's pose cells on the torus when its map merges into another."""

import numpy as np

from neuroslam.config import BrainConfig
from neuroslam.geometry import TWO_PI, rotate_points
from neuroslam.state.join import MovedCells
from neuroslam.state.match import Match
from neuroslam.state.mergeable import State


def move_session(
    loaded: State, partial: State, match: Match, config: BrainConfig, name: str = "pose_cells"
) -> MovedCells:
    """Move bindings and experiences so that the matched experiences coincide on the torus.

    Args:
        loaded: State of the whole brain that is merged into.
        partial: State of the whole brain of the session that moves.
        match: Where the two maps meet.
        config: Of both; ``sessions.cells`` sets whether the session also rotates.
        name: Of the population that holds the bindings.
    """
    cells = config.pose_cells
    torus = (cells.n_xy, cells.n_xy, cells.n_theta)
    states = partial["map.experiences.cell"].numpy()
    bound = np.column_stack([partial[f"{name}.bindings.{axis}"] for axis in ("x", "y", "theta")])
    if config.sessions.cells == "none":
        return MovedCells(np.zeros(3), bound, states)
    poses = partial["map.experiences.pose"].numpy()
    views = partial["map.experiences.template"].numpy()
    pivot = states[match.partial]
    shift = loaded["map.experiences.cell"].numpy()[match.loaded] - pivot
    shift[2] += match.turn_rad * cells.n_theta / TWO_PI
    paths = view_paths = None
    if config.sessions.cells == "turn":
        angle = TWO_PI * pivot[2] / cells.n_theta - poses[match.partial, 2]
        paths = rotate_points((poses - poses[match.partial])[:, :2] / cells.cell_size_m, angle)
        first = np.full(len(bound), match.partial)
        first[views[::-1]] = np.arange(len(views))[::-1]  # the first experience with each view
        view_paths = paths[first]
    return MovedCells(
        shift % torus,
        moved_cells(bound, pivot, shift, torus, view_paths),
        moved_cells(states, pivot, shift, torus, paths),
    )


def moved_cells(
    cells: np.ndarray,
    pivot: np.ndarray,
    shift: np.ndarray,
    torus: tuple[int, int, int],
    paths: np.ndarray | None = None,
) -> np.ndarray:
    r"""Move pose-cell states on the torus so that the pivot coincides with another state.

    .. math:: P' = P + \Delta \pmod n, \qquad \Delta = P_u - P_z

    (Multisession RatSLAM, Eqs. 10 and 11; Eq. 10 is misprinted there.) If the two
    sessions started with different headings, displacements differ in direction too; with ``paths``
    they are rotated,

    .. math:: P' = P_u + R(\Delta_\theta)\,(P - P_z)_\text{unwrapped} \pmod n

    so that a robot that comes there in the other session has its activity there. The displacement
    from :math:`P_z` to :math:`P` is unwrapped to the value nearest to ``paths``.

    Args:
        cells: x, y, theta in cells, ``(n, 3)``.
        pivot: :math:`P_z`, ``(3,)``.
        shift: :math:`\Delta` in cells, ``(3,)``; any fraction.
        torus: ``(n_x, n_y, n_theta)``.
        paths: Displacements from the pivot on the map, in cells, ``(n, 2)``; ``None``: shift only.

    Example:
        >>> moved_cells(np.array([[20.5, 3.0, 1.0]]), None, np.array([1, 0, -2]), (21, 21, 36))
        array([[ 0.5,  3. , 35. ]])
    """
    n = np.array(torus, dtype=np.float64)
    moved = cells + shift
    if paths is not None:
        apart = cells[:, :2] - pivot[:2]
        apart = apart + n[:2] * np.round((paths - apart) / n[:2])
        turned = rotate_points(apart, TWO_PI * shift[2] / n[2])
        moved[:, :2] = pivot[:2] + shift[:2] + turned
    moved = moved % n
    return np.where(moved >= n, 0.0, moved)  # a tiny negative rounds up to n
