"""Heights of a map and of the frames of a run, where a population measures them."""

from pathlib import Path

import numpy as np

from neuroslam.brain import NavigationBrain
from neuroslam.errors import RunError
from neuroslam.mapping.heights import Rises
from neuroslam.runs.reading import experiences_of, read_frames

_HEIGHT, _ABOVE = "z_m", "rise_m"
"""Columns of ``experiences.csv``, and of ``frames.csv``: above the frame's experience."""


def map_heights(brain: NavigationBrain) -> np.ndarray | None:
    """Return the height of every experience in metres, ``(n,)``; ``None``: it is not measured."""
    for population in brain.populations.values():
        columns = population.experience_columns()
        if _HEIGHT in columns:
            return np.array(columns[_HEIGHT], dtype=np.float64)
    return None


def map_rises(brain: NavigationBrain) -> Rises | None:
    """Return the rises that the heights of a map are of; ``None``: they are not measured."""
    if "pose_3d" not in brain.populations:
        return None
    return brain.pose_3d.measured_rises


def rises_of_links(brain: NavigationBrain, heights_m: np.ndarray) -> np.ndarray:
    """Return the measured rise of every link, ``(links,)``; else that of the map.

    Args:
        brain: Its map has the links.
        heights_m: Of its experiences.
    """
    links = brain.map.links
    found = heights_m[links.target] - heights_m[links.source]
    rises = map_rises(brain)
    if rises is not None:
        measured = {}
        for s, t, rise in zip(*(column.tolist() for column in rises), strict=True):
            measured[t, s], measured[s, t] = -rise, rise
        pairs = zip(links.source.tolist(), links.target.tolist(), strict=True)
        for i, pair in enumerate(pairs):
            found[i] = measured.get(pair, found[i])
    return np.asarray(found)


def frame_heights(
    brain: NavigationBrain, trace: dict[str, np.ndarray], out: str | Path
) -> np.ndarray | None:
    """Return the height of every frame on the final map: that of its experience, and above it.

    Args:
        brain: Its largest map.
        trace: Of the run.
        out: Folder with its ``frames.csv``.

    Returns:
        Metres, ``(frames,)``, NaN where a frame is on no joined map; ``None`` if the brain or the
        run has no heights.
    """
    heights = map_heights(brain)
    if heights is None:
        return None
    try:
        above = read_frames(out, len(trace["time_s"])).get(_ABOVE)
    except RunError:
        return None
    if above is None:  # a run of an earlier version
        return None
    experience, _ = experiences_of(brain, trace)
    first = np.isin(trace["session"], [s.id for s in brain.sessions.sessions])
    at = np.where(first & (trace["number"] < 0), 0.0, np.nan)
    known = experience >= 0
    at[known] = heights[experience[known]]
    return np.asarray(at + above)
