"""Tolerances of the alignment of two maps, in the scale of the maps."""

import math
from collections.abc import Sequence

import numpy as np

from neuroslam.config import BrainConfig
from neuroslam.mapping.experience import ExperienceMap
from neuroslam.mapping.overlap import Tolerance, pair_residuals_m
from neuroslam.state.match import Pairs

WINDOW = 3
"""n matches may span up to this many times n experiences, because some views are missed."""


def spacing_m(maps: Sequence[ExperienceMap], config: BrainConfig) -> float:
    """Return the distance of neighbours: the median link, or the size of an experience if larger.

    That size is ``create_threshold_cells`` of the pose cells.
    """
    cells = config.pose_cells
    place_m = cells.create_threshold_cells * cells.cell_size_m
    lengths = np.concatenate([one.links.distance_m for one in maps])
    return max(float(np.median(lengths)), place_m) if len(lengths) else place_m


def tolerance(maps: Sequence[ExperienceMap], config: BrainConfig) -> Tolerance:
    """Return the tolerances, from the size of an experience and the median length of a link."""
    cells, sessions = config.pose_cells, config.sessions
    return Tolerance(
        near_m=2.0 * WINDOW * sessions.confirm * spacing_m(maps, config),
        place_m=cells.create_threshold_cells * cells.cell_size_m,
        drift=sessions.drift,
        turn_rad=math.radians(sessions.turn_tolerance_deg),
    )


def elsewhere(of: ExperienceMap, experience: int, limits: Tolerance) -> np.ndarray:
    """Return which experiences are too far from one for their views to be similar by proximity."""
    poses = of.poses
    apart = np.linalg.norm((poses - poses[experience])[:, :2], axis=1)
    far: np.ndarray = apart > limits.near_m / (2.0 * WINDOW)
    return far


def far_off(
    pairs: Pairs, loaded: ExperienceMap, partial: ExperienceMap, limits: Tolerance
) -> tuple[np.ndarray, np.ndarray]:
    """Align two maps by the first pair; return the misfit of every pair and its limit.

    Odometry drifts in proportion to the path, so the limit grows with the paths on both maps.

    Returns:
        Distance of each pair after the alignment and the largest allowed distance, in metres.
    """
    path_m = partial.path_lengths_m(int(pairs.partial[0]))[pairs.partial]
    path_m = path_m + loaded.path_lengths_m(int(pairs.loaded[0]))[pairs.loaded]
    residuals_m = pair_residuals_m(pairs, partial.poses, loaded.poses)
    return residuals_m, limits.place_m + limits.drift * path_m
