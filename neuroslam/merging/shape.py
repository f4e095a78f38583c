r"""The test of shapes: the common path must look the same on both maps.

Loop closures do not show a wrong scale: a loop that is 1.5 times too large closes as well as a
right one, and the noise that the loops of a poor map do show excuses it in the test of the
residuals (:mod:`neuroslam.merging.consistency`). So the matched places :math:`x_i` of one map,
aligned rigidly with :math:`y_i` of the other, must have one shape,

.. math:: \sqrt{\tfrac1n \sum_i \lVert R x_i + t - y_i \rVert^2} \le \tfrac12 p + \sigma L

with :math:`p` the size of an experience and :math:`L` the RMS distance of the places from the mean
of their map, over both maps, so that the order of the maps does not matter. Maps that a wrong loop
closure has bent are not judged by it.
"""

import math

import numpy as np

from neuroslam.config import BrainConfig
from neuroslam.geometry import rotate_points
from neuroslam.mapping.experience import ExperienceMap
from neuroslam.state.match import Pairs

SHAPE = 0.25
"""Largest deviation of shapes, :math:`\\sigma`: pieces of a lap of one real drive deviate so."""

LEAST_EXTENT = 4.0
"""Extent of a common path from which its shape shows the odometry, in sizes of an experience."""


def misshapen(
    loaded: ExperienceMap,
    partial: ExperienceMap,
    pairs: Pairs,
    config: BrainConfig,
    *,
    shape: float = SHAPE,
    strict: bool = False,
) -> str:
    """Return why the common path shows that the odometry of a map is not to be relied on.

    Args:
        loaded: One map; it is not altered.
        partial: The other.
        pairs: Their matched places.
        config: Config of both.
        shape: Largest deviation of the shapes, as a share of the extent.
        strict: Do not let a path pass that is too short to show it.

    Returns:
        The reason; empty if the shapes agree, or the path is too short to show it.
    """
    cells = config.pose_cells
    size_m = cells.create_threshold_cells * cells.cell_size_m
    there, here = loaded.poses[pairs.loaded, :2], partial.poses[pairs.partial, :2]
    extent_m = math.hypot(_extent(there), _extent(here)) / math.sqrt(2.0)
    if extent_m < LEAST_EXTENT * size_m:
        if not strict:
            return ""
        return (
            f"the common path extends {extent_m:.1f} m (RMS); expected {LEAST_EXTENT * size_m:.1f} "
            "m, to see whether the odometry of both agrees; drive more of it"
        )
    limit_m = 0.5 * size_m + shape * extent_m
    rms_m = _apart(there, here)
    if rms_m <= limit_m:
        return ""
    return (
        f"the common path has another shape on the two maps: {rms_m:.2f} m apart (RMS) over "
        f"{extent_m:.1f} m; expected at most {limit_m:.2f} m: the odometry of one robot is wrong"
    )


def _extent(points: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum((points - points.mean(axis=0)) ** 2, axis=1))))


def _apart(there: np.ndarray, here: np.ndarray) -> float:
    """Return the RMS distance of points after their rigid alignment."""
    there, here = there - there.mean(axis=0), here - here.mean(axis=0)
    cross = (here[:, 0] * there[:, 1] - here[:, 1] * there[:, 0]).sum()
    moved = rotate_points(here, np.full(len(here), np.arctan2(cross, (here * there).sum())))
    return float(np.sqrt(np.mean(np.sum((moved - there) ** 2, axis=1))))
