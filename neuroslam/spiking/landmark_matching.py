"""Where do two maps meet that have landmarks for places? By those that have the same name."""

import math
from typing import TYPE_CHECKING

import numpy as np

from neuroslam.merging.merge import Match
from neuroslam.geometry import wrap_angles
from neuroslam.mapping.overlap import Pairs
from neuroslam.spiking.landmark_frames import shared_frames
from neuroslam.spiking.semantic import SemanticCells
from neuroslam.spiking.sightings import NAMED
from neuroslam.types import Pose

if TYPE_CHECKING:
    from neuroslam.brain.brain import NavigationBrain


def match_landmarks(
    loaded: "NavigationBrain", partial: "NavigationBrain"
) -> tuple[Match | None, str]:
    """Look for how the landmarks that two animals know lie on each other.

    Args:
        loaded: One brain whose landmarks are the places of its map; it is not altered.
        partial: The other; it is not altered.

    Returns:
        Where the maps meet, or ``None``; and how that was found, or why not, for a reader.
    """
    known = [_places_of(brain.semantic) for brain in (loaded, partial)]
    both = sorted(known[0].keys() & known[1].keys())
    confirm, same_m = partial.config.sessions.confirm, partial.config.semantic.same_m
    frames = shared_frames(
        loaded.semantic.state_dict(), partial.semantic.state_dict(), confirm, same_m
    )
    if frames is None:
        return None, (
            f"{len(both)} landmarks with a name are known to both maps; at least {confirm} of "
            f"them, and most, must agree within {same_m:g} m on how the maps lie"
        )
    start, onto = frames
    c, s = math.cos(onto.theta_rad), math.sin(onto.theta_rad)
    way = np.array([[c, s], [-s, c]])

    def moved(points_m: np.ndarray) -> np.ndarray:
        return (points_m - np.array(start[:2])) @ way + np.array(onto[:2])

    ours = np.array([known[1][key][1] for key in both])
    theirs = np.array([known[0][key][1] for key in both])
    away = np.linalg.norm(moved(ours) - theirs, axis=1)
    same = away <= same_m
    ids = np.array([(known[1][key][0], known[0][key][0]) for key in both])[same]
    poses = partial.map.poses, loaded.map.poses
    headings = poses[0][ids[:, 0], 2] + onto.theta_rad
    turns = wrap_angles(headings - poses[1][ids[:, 1], 2])
    pairs = Pairs(ids[:, 0], ids[:, 1], turns, away[same])
    best = int(np.argmin(pairs.error))
    z = int(pairs.partial[best])
    x, y = moved(poses[0][z : z + 1, :2])[0].tolist()
    match = Match(
        int(pairs.loaded[best]),
        z,
        float(turns[best]),
        others=pairs,
        onto=Pose(x, y, float(wrap_angles(headings[best]))),
    )
    return match, f"{len(ids)} of {len(both)} landmarks with a name lie on each other"


def _places_of(cells: SemanticCells) -> dict[int, tuple[int, np.ndarray]]:
    """Experience and place of each named landmark that is a place of the map."""
    known = cells.landmarks()
    rows = (known["kind"] == NAMED) & (known["experience"] >= 0)
    each = zip(known["number"][rows].tolist(), known["experience"][rows].tolist(),
               known["place_m"][rows], strict=True)  # fmt: skip
    return {number: (experience, place) for number, experience, place in each}
