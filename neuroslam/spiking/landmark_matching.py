"""Alignment of two maps whose experiences are landmarks, by those that both know by name."""

import numpy as np

from neuroslam.config import BrainConfig
from neuroslam.geometry import move_points, wrap_angles
from neuroslam.spiking.landmark_frames import shared_frames
from neuroslam.spiking.sightings import NAMED
from neuroslam.state.match import Match, Pairs
from neuroslam.state.mergeable import State
from neuroslam.types import Pose

Columns = dict[str, np.ndarray]
"""Columns of confirmed landmarks, by name: kind, number, experience, place_m."""


def match_landmarks(
    states: tuple[State, State],
    known: tuple[Columns, Columns],
    maps: tuple[np.ndarray, np.ndarray],
    config: BrainConfig,
) -> tuple[Match | None, str]:
    """Find the alignment of two maps by the named landmarks of both sessions.

    Args:
        states: Of the semantic cells of the loaded session and of the partial one.
        known: Their landmarks.
        maps: Poses of their experiences, ``(n, 3)`` each.
        config: Of both.

    Returns:
        The match, or ``None``; and a sentence on how it was found, or why not.
    """
    places = [_experiences_by_name(columns) for columns in known]
    both = sorted(places[0].keys() & places[1].keys())
    confirm, same_m = config.sessions.confirm, config.semantic.same_m
    frames = shared_frames(*states, confirm, same_m)
    if frames is None:
        return None, (
            f"{len(both)} landmarks with a name are known to both maps; at least {confirm} of "
            f"them, and most, must agree within {same_m:g} m on the alignment of the maps"
        )
    start, onto = frames
    theirs, ours = (np.array([table[key][1] for key in both]) for table in places)
    away = np.linalg.norm(move_points(ours, start, onto) - theirs, axis=1)
    ids = np.array([(places[1][key][0], places[0][key][0]) for key in both])
    # An experience made at an outlier is not where its landmark is until it is visited again.
    stale = [
        np.linalg.norm(poses[ids[:, column], :2] - landmarks, axis=1) > same_m
        for poses, column, landmarks in ((maps[1], 0, ours), (maps[0], 1, theirs))
    ]
    same = (away <= same_m) & ~stale[0] & ~stale[1]
    if not same.any():
        return None, (
            f"{len(both)} landmarks with a name are known to both maps; none is at an experience "
            "of both that is where the landmark is"
        )
    ids = ids[same]
    headings = maps[1][ids[:, 0], 2] + onto.theta_rad
    turns = wrap_angles(headings - maps[0][ids[:, 1], 2])
    pairs = Pairs(ids[:, 0], ids[:, 1], turns, away[same])
    best = int(np.argmin(pairs.error))
    z = int(pairs.partial[best])
    x, y = move_points(maps[1][z, :2], start, onto).tolist()
    match = Match(
        int(pairs.loaded[best]),
        z,
        float(turns[best]),
        others=pairs,
        onto=Pose(x, y, float(wrap_angles(headings[best]))),
    )
    return match, f"{len(ids)} of {len(both)} landmarks with a name align"


def _experiences_by_name(known: Columns) -> dict[int, tuple[int, np.ndarray]]:
    """Return experience and position of each named landmark that is an experience."""
    rows = (known["kind"] == NAMED) & (known["experience"] >= 0)
    each = zip(known["number"][rows].tolist(), known["experience"][rows].tolist(),
               known["place_m"][rows], strict=True)  # fmt: skip
    return {number: (experience, place) for number, experience, place in each}
