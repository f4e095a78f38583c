"""How far two maps may disagree on how they lie, in the scale of the maps themselves."""

import math
from collections.abc import Sequence

import numpy as np

from neuroslam.config import BrainConfig
from neuroslam.mapping.experience import ExperienceMap
from neuroslam.mapping.overlap import Tolerance, pair_residuals_m
from neuroslam.state.match import Pairs

WINDOW = 3
"""A match of n places may have passed this many times n others: some views are missed."""


def tolerance(maps: Sequence[ExperienceMap], config: BrainConfig) -> Tolerance:
    """Set what still agrees, by the size of a place and the usual way between two."""
    cells, sessions = config.pose_cells, config.sessions
    place_m = cells.create_threshold_cells * cells.cell_size_m
    lengths = np.concatenate([one.links.distance_m for one in maps])
    spacing_m = float(np.median(lengths)) if len(lengths) else place_m
    return Tolerance(
        near_m=2.0 * WINDOW * sessions.confirm * max(spacing_m, place_m),
        place_m=place_m,
        drift=sessions.drift,
        turn_rad=math.radians(sessions.turn_tolerance_deg),
    )


def elsewhere(of: ExperienceMap, experience: int, limits: Tolerance) -> np.ndarray:
    """Tell which experiences are too far from one to look like it because they are near."""
    poses = of.poses
    apart = np.linalg.norm((poses - poses[experience])[:, :2], axis=1)
    far: np.ndarray = apart > limits.near_m / (2.0 * WINDOW)
    return far


def far_off(
    pairs: Pairs, loaded: ExperienceMap, partial: ExperienceMap, limits: Tolerance
) -> tuple[np.ndarray, np.ndarray]:
    """Lay one map on the other by the first pair: how far off are the others, and how far may they?

    Odometry may be off by a share of the way, so what is far by either map may be off by more.

    Returns:
        Metres by which each pair is off, and by which it may be.
    """
    way_m = partial.path_lengths_m(int(pairs.partial[0]))[pairs.partial]
    way_m = way_m + loaded.path_lengths_m(int(pairs.loaded[0]))[pairs.loaded]
    residuals_m = pair_residuals_m(pairs, partial.poses, loaded.poses)
    return residuals_m, limits.place_m + limits.drift * way_m
