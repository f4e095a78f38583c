"""The arena of a RatInABox ``Environment``."""

from typing import Any

import numpy as np

from neuroslam.errors import SourceError
from neuroslam.worlds.arena import Arena


def arena_of_environment(environment: Any) -> Arena:  # noqa: ANN401 - RatInABox is optional
    """Return boundary, holes and free-standing walls of a RatInABox environment as an arena.

    Args:
        environment: A ``ratinabox.Environment`` of two dimensions with solid boundaries.

    Raises:
        SourceError: If it is one-dimensional or periodic, or its outlines make no arena.

    Example:
        >>> from types import SimpleNamespace
        >>> box = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]
        >>> sides = [[box[k], box[(k + 1) % 4]] for k in range(4)]
        >>> inside = [[[0.5, 0.0], [0.5, 0.6]]]
        >>> made = SimpleNamespace(
        ...     dimensionality="2D", boundary_conditions="solid", boundary=box, holes=[],
        ...     walls=np.array(sides + inside),
        ... )
        >>> arena_of_environment(made).n_walls
        5
    """
    if environment.dimensionality != "2D" or environment.boundary_conditions != "solid":
        raise SourceError(
            f"environment: is {environment.dimensionality} with {environment.boundary_conditions} "
            "boundaries; expected 2D and solid ones"
        )
    boundary = np.asarray(environment.boundary, np.float64)
    holes = [np.asarray(hole, np.float64) for hole in environment.holes]
    sides = [np.stack([line, np.roll(line, -1, axis=0)], axis=1) for line in (boundary, *holes)]
    outline = np.concatenate(sides)
    both = np.concatenate([outline, outline[:, ::-1]])
    walls = [
        wall
        for wall in np.asarray(environment.walls, np.float64).reshape(-1, 2, 2)
        if not np.isclose(wall, both, rtol=0.0, atol=1e-9).all(axis=(1, 2)).any()
    ]
    return Arena(boundary, holes, walls, name="environment")
