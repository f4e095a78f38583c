r"""How consistent a map is with itself, told without truth.

Pairs of frames that show one place should lie on one spot of the map, and the others should not:

.. math:: J = \frac{\operatorname{mean} \lVert p_i - p_j \rVert \text{ over revisits}}
                   {\operatorname{mean} \lVert p_i - p_j \rVert \text{ over the others}}

0 for a perfect map, 1 for one that tells nothing: neither a map without loops nor one that has
fallen into a heap is consistent. Revisits are found in sequences of pictures
(:mod:`neuroslam.tuning.revisits`), and not by the brain that is judged.
"""

import math
from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np
import torch

from neuroslam.brain import NavigationBrain
from neuroslam.config import BrainConfig
from neuroslam.errors import BadFrame
from neuroslam.tuning.revisits import Revisits
from neuroslam.types import Frame
from neuroslam.view.preprocess import Encoded


class Trial(NamedTuple):
    """What a config made of a drive.

    Attributes:
        config: Of the brain.
        inconsistency: :math:`J`; 0 is perfect, NaN where nothing was revisited.
        n_views: Views learnt.
        n_places: Places on the map.
        n_links: Links between them.
        track_xy: Where the map puts each frame, m, ``(n, 2)``.
    """

    config: BrainConfig
    inconsistency: float
    n_views: int
    n_places: int
    n_links: int
    track_xy: np.ndarray


def drive_through(
    config: BrainConfig, frames: Iterable[Frame], views: Mapping[int, Encoded] | None = None
) -> tuple[NavigationBrain, dict]:
    """Map frames with the views, pose cells and map of a config; nothing else.

    Args:
        config: Of the brain.
        frames: With pictures.
        views: Templates by the frames' indices, as bytes, where a network has made them; a frame
            without one is left out.

    Returns:
        The brain, and the place of each frame's index.
    """
    sessions = config.sessions.model_copy(update={"kidnapped": "ignore"})
    alone = config.model_copy(update={"cells": ("pose",), "sessions": sessions, "max_gap_s": 1e9})
    now = -1

    def look_up(_image: np.ndarray) -> Encoded:
        if now not in views:
            raise BadFrame("no template was made of it")
        return Encoded(views[now].template / 255.0, views[now].contrast)

    brain, places = NavigationBrain(alone, features=None if views is None else look_up), {}
    with torch.inference_mode():
        for frame in frames:
            now = frame.index
            try:
                places[frame.index] = brain(frame).experience
            except BadFrame:
                continue
    return brain, places


def judge(
    config: BrainConfig,
    brain: NavigationBrain,
    places: dict[int, int],
    keys: np.ndarray,
    revisits: Revisits,
) -> Trial:
    """Say how consistent the map is that a brain made.

    Args:
        config: What the trial is called by.
        brain: After the drive.
        places: Place of each frame.
        keys: Indices of the key frames.
        revisits: Pairs of them.
    """
    poses = np.asarray(brain.map.poses)[:, :2]
    known = np.array(sorted(places))
    track = poses[[places[k] for k in known]]
    at = track[np.searchsorted(known, keys).clip(max=len(known) - 1)]
    if not len(revisits.same):
        return Trial(config, math.nan, brain.view.n, brain.map.n, brain.map.n_links, track)
    same = np.linalg.norm(at[revisits.same[:, 0]] - at[revisits.same[:, 1]], axis=1)
    other = np.linalg.norm(at[revisits.other[:, 0]] - at[revisits.other[:, 1]], axis=1)
    whole = float(other.mean())
    off = float(same.mean()) / whole if whole > 0 else 1.0
    return Trial(config, off, brain.view.n, brain.map.n, brain.map.n_links, track)


def best_of(trials: list[Trial]) -> Trial:
    """Take the smallest map among those about as consistent as the best."""
    best = level_with(min(trial.inconsistency for trial in trials))
    return min(
        (trial for trial in trials if trial.inconsistency <= best),
        key=lambda trial: (trial.n_places, trial.inconsistency),
    )


def level_with(inconsistency: float) -> float:
    """Return up to where another map is about as consistent: 10 % worse, or 0.005."""
    return max(1.1 * inconsistency, inconsistency + 0.005)
