"""What each frame of a run had to pass to come to a known experience, from the run's files."""

import math

import numpy as np

from neuroslam.geometry import TWO_PI
from neuroslam.mapping.actions import nearest_bound_of_arrays
from neuroslam.report.reading import FinishedRun
from neuroslam.types import NO_TEMPLATE


def cells_apart(run: FinishedRun) -> np.ndarray | None:
    """Return how far the pose cells were from where the matched view of each frame was learnt.

    Args:
        run: A run that pose cells lead; after a merge its experiences are others than it had.

    Returns:
        Distance to the nearest experience with that view, in cells, ``(frames,)``; NaN where the
        view matched none. ``None`` if the run has no frames, has joined a map, or is led by other
        cells.
    """
    brain, frames = run.brain, run.frames
    began = [session.began for session in brain.sessions.sessions]
    if not len(run.actions) or brain.leader.kind != "pose" or brain.sessions.merges or began[1:]:
        return None
    cells, table = brain.config.pose_cells, brain.map.experiences
    torus = (cells.n_xy, cells.n_xy, cells.n_theta)
    bound, templates = table["cell"].numpy(), table["template"].numpy()
    theta = frames["pose_theta"] - frames["relative_heading_rad"] * cells.n_theta / TWO_PI
    before = np.concatenate([[0], frames["n_experiences"][:-1]]).astype(int)
    known = np.concatenate([[0], frames["n_templates"][:-1]]).astype(int)
    apart = np.full(len(run.actions), np.nan)
    for row, template in enumerate(frames["template"].astype(int).tolist()):
        if not NO_TEMPLATE < template < known[row]:
            continue
        n = before[row]
        now = (frames["pose_x"][row], frames["pose_y"][row], theta[row])
        square = nearest_bound_of_arrays(bound[:n], templates[:n], template, now, torus)[1]
        if math.isfinite(square):
            apart[row] = math.sqrt(square)
    return apart
