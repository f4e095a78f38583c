r"""Inconsistency of a map, measured without ground truth.

A map should place frames that show the same place together, and the others apart:

.. math:: J = \frac{\operatorname{mean} \lVert p_i - p_j \rVert \text{ over revisits}}
                   {\operatorname{mean} \lVert p_i - p_j \rVert \text{ over the others}}

0 for a perfect map, 1 for a useless one: neither a map without loop closures nor a collapsed map is
consistent. Revisits come from sequences of pictures (:mod:`neuroslam.tuning.revisits`), not from
the brain whose map is scored.
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
    """The map that a config gives of a drive.

    Attributes:
        config: Config of the brain.
        inconsistency: :math:`J`; 0 is perfect, NaN without revisits.
        n_templates: Templates of the brain.
        n_experiences: Experiences of the map.
        n_links: Links of the map.
        track_xy: Position of each frame on the map, m, ``(n, 2)``.
    """

    config: BrainConfig
    inconsistency: float
    n_templates: int
    n_experiences: int
    n_links: int
    track_xy: np.ndarray


def map_frames(
    config: BrainConfig, frames: Iterable[Frame], views: Mapping[int, Encoded] | None = None
) -> tuple[NavigationBrain, dict[int, int]]:
    """Map frames with the views, pose cells and experience map of a config, without other cells.

    Args:
        config: Config of the brain.
        frames: Frames with pictures.
        views: Templates of a network by frame index, as bytes; a frame without one is left out.
            ``None`` for grey templates.

    Returns:
        The brain, and the experience of each frame by frame index.
    """
    sessions = config.sessions.model_copy(update={"kidnapped": "ignore"})
    alone = config.model_copy(update={"cells": ("pose",), "sessions": sessions, "max_gap_s": 1e9})
    current = -1

    def look_up(_image: np.ndarray) -> Encoded:
        if views is None or current not in views:
            raise BadFrame("the network made no template of it")
        return Encoded(views[current].template / 255.0, views[current].contrast)

    brain = NavigationBrain(alone, features=None if views is None else look_up)
    experiences: dict[int, int] = {}
    with torch.inference_mode():
        for frame in frames:
            current = frame.index
            try:
                experiences[frame.index] = brain(frame).experience
            except BadFrame:
                continue
    return brain, experiences


def score_map(
    config: BrainConfig,
    brain: NavigationBrain,
    experiences: dict[int, int],
    keys: np.ndarray,
    revisits: Revisits,
) -> Trial:
    """Measure the inconsistency of a brain's map.

    Args:
        config: Config that the trial names; its regions may be those of other pictures.
        brain: The brain after the drive.
        experiences: Experience of each frame, by frame index.
        keys: Frame indices of the key frames.
        revisits: Pairs of key frames.
    """
    poses = np.asarray(brain.map.poses)[:, :2]
    known = np.array(sorted(experiences))
    track = poses[[experiences[k] for k in known]]
    at = track[np.searchsorted(known, keys).clip(max=len(known) - 1)]
    if not len(revisits.same):
        return Trial(config, math.nan, brain.view.n, brain.map.n, brain.map.n_links, track)
    same = np.linalg.norm(at[revisits.same[:, 0]] - at[revisits.same[:, 1]], axis=1)
    other = np.linalg.norm(at[revisits.other[:, 0]] - at[revisits.other[:, 1]], axis=1)
    extent = float(other.mean())
    inconsistency = float(same.mean()) / extent if extent > 0 else 1.0
    return Trial(config, inconsistency, brain.view.n, brain.map.n, brain.map.n_links, track)


def best_of(trials: list[Trial]) -> Trial:
    """Return the smallest map among those about as consistent as the best."""
    limit = consistency_limit(min(trial.inconsistency for trial in trials))
    return min(
        (trial for trial in trials if trial.inconsistency <= limit),
        key=lambda trial: (trial.n_experiences, trial.inconsistency),
    )


def consistency_limit(inconsistency: float) -> float:
    """Return the largest inconsistency that counts as equal: 10 % or 0.005 above."""
    return max(1.1 * inconsistency, inconsistency + 0.005)
