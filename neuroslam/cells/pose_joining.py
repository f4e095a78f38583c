"""Movement of a session's pose cells on the torus when its map merges into another."""

import numpy as np

from neuroslam.cells.attractor import moved_cells
from neuroslam.config import BrainConfig
from neuroslam.geometry import TWO_PI, rotate_points
from neuroslam.state.join import MovedCells
from neuroslam.state.match import Match
from neuroslam.state.mergeable import State


def move_session(loaded: State, partial: State, match: Match, config: BrainConfig) -> MovedCells:
    """Move bindings and experiences so that the matched experiences coincide on the torus.

    Args:
        loaded: State of the whole brain that is merged into.
        partial: State of the whole brain of the session that moves.
        match: Where the two maps meet.
        config: Of both; ``sessions.cells`` sets whether the session also rotates.
    """
    cells = config.pose_cells
    torus = (cells.n_xy, cells.n_xy, cells.n_theta)
    states = partial["map.experiences.cell"].numpy()
    bound = np.column_stack(
        [partial[f"pose_cells.bindings.{name}"] for name in ("x", "y", "theta")]
    )
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
