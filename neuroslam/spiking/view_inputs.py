"""Landmarks in view, prepared as inputs of SSP-SLAM."""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from neuroslam.worlds.landmarks import LandmarkView


def boxes_of(view: LandmarkView, n_landmarks: int) -> tuple[Tensor, Tensor]:
    """Return the boxes of each landmark, ``(landmarks, most boxes)``, and their shares by size."""
    owner = np.asarray(view.box_landmark)
    if np.array_equal(owner, np.arange(n_landmarks)):
        boxes = torch.arange(n_landmarks).unsqueeze(-1)
        return boxes, torch.ones(boxes.shape, dtype=torch.float64)
    size = np.asarray(view.high_m)[0, 0] - np.asarray(view.low_m)[0, 0]
    measure = np.where(size > 0, size, 1.0).prod(-1)
    most = max(1, int(np.bincount(owner, minlength=n_landmarks).max()))
    boxes, weight = np.zeros((n_landmarks, most), dtype=np.int64), np.zeros((n_landmarks, most))
    for landmark in range(n_landmarks):
        own = np.flatnonzero(owner == landmark)
        boxes[landmark, : len(own)], weight[landmark, : len(own)] = own, measure[own]
    return torch.from_numpy(boxes), torch.from_numpy(
        weight / weight.sum(-1, keepdims=True).clip(1e-12)
    )


def with_time(view: LandmarkView | None) -> LandmarkView | None:
    """Add a leading axis of one step to the arrays of a view."""
    return None if view is None else _each(view, lambda a: np.asarray(a)[None])


def cut(view: LandmarkView | None, part: slice) -> LandmarkView | None:
    """Return some steps of a view."""
    return None if view is None else _each(view, lambda a: a[part])


def _each(view: LandmarkView, change: Callable[[np.ndarray], np.ndarray]) -> LandmarkView:
    """Change the arrays that lead with time, not the owners of boxes."""
    changed = {f: change(getattr(view, f)) for f in view._fields if f != "box_landmark"}
    return view._replace(**changed)
