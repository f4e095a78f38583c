r"""Which pictures of a drive show a place seen before, told from sequences and without truth.

A single picture may look like another by chance; a whole stretch hardly does. Stretches are
compared as in SeqSLAM (Milford and Wyeth 2012): along lines of the matrix of differences,

.. math:: S_{ij} = \min_v \frac{1}{2w+1} \sum_{k=-w}^{w} \hat D_{i+k,\; j+\lfloor vk \rceil}

over ratios of speed :math:`v`. How low :math:`S` gets by chance is measured on the same drive: with
:math:`-v`, the other stretch backwards, which a camera that looks ahead never shows.
"""

from typing import NamedTuple

import cv2
import numpy as np
import torch

from neuroslam.config import ViewConfig
from neuroslam.view.preprocess import encode

HALF_LENGTH = 10
"""Key frames before and behind the one compared: :math:`w`."""

CHANCE = 0.01
"""Share of key frames that a backward stretch would be accepted for."""

_SPEED_RATIOS = (0.5, 0.67, 0.8, 1.0, 1.25, 1.5, 2.0)
_SIGNATURE = ViewConfig(
    template_width=40, template_height=24, patch_radius=4, shift_match=3, normalisation=0.0
)
_CLOSE = 5  # key frames: as exact as matches of stretches are


class Revisits(NamedTuple):
    """Pairs of key frames that show one place, and pairs that do not.

    Attributes:
        scores: :math:`S`, ``(n, n)``; the lower the more alike; ``inf`` within ``gap``.
        limit: Score below which two stretches show one place.
        doubt: Score above which they do not; between the two, who knows.
        gap: Key frames nearer than this in time are neighbours, not revisits.
        same: Pairs of one place, ``(m, 2)``: for each key frame the best, if it has one.
        other: As many pairs, or some, of two places.
    """

    scores: np.ndarray
    limit: float
    doubt: float
    gap: int
    same: np.ndarray
    other: np.ndarray

    @property
    def near(self) -> np.ndarray:
        """Say of each pair whether a match of the two is right, ``(n, n)``: give or take a bit."""
        return _spread(self.scores < self.limit)

    @property
    def unsure(self) -> np.ndarray:
        """Say of each pair whether nobody can tell, ``(n, n)``."""
        return _spread(self.scores <= self.doubt) & ~self.near


def find_revisits(pictures: np.ndarray, n_other: int = 2000) -> Revisits:
    """Find which key frames show the place of another.

    Args:
        pictures: Key frames in order, grey ``uint8``, ``(n, h, w)``, while the robot moves.
        n_other: How many pairs of two places to name.
    """
    apart = pairwise(np.stack([encode(p, fitting(_SIGNATURE, p.shape)).template for p in pictures]))
    n = len(apart)
    lag_means = np.array([np.diagonal(apart, lag).mean() for lag in range(n // 2)])
    unlike = 0.9 * np.median(apart)
    decorrelated = int(np.argmax(lag_means > unlike)) if (lag_means > unlike).any() else n // 2
    gap = min(max(3 * HALF_LENGTH, 2 * decorrelated), n // 3)
    spread = apart.std(axis=1, keepdims=True) + 1e-9
    relative = (apart - apart.mean(axis=1, keepdims=True)) / spread
    relative = (0.5 * (relative + relative.T)).astype(np.float32)
    lags = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    scores = _along_lines(relative, 1.0)
    scores[lags < gap] = np.inf
    backwards = _along_lines(relative, -1.0)
    backwards[lags < gap] = np.inf
    by_chance = backwards.min(axis=1)
    by_chance = by_chance[np.isfinite(by_chance)]
    limit, doubt = np.quantile(by_chance, (CHANCE, 0.5)) if len(by_chance) else (-np.inf, -np.inf)
    best = scores.argmin(axis=1)
    found = np.flatnonzero(scores[np.arange(n), best] < limit)
    same = np.stack([found, best[found]], axis=1)
    middling = np.median(scores[np.isfinite(scores)]) if np.isfinite(scores).any() else 0.0
    i, j = np.nonzero(np.triu(np.isfinite(scores) & (scores > middling)))
    some = np.linspace(0, len(i) - 1, min(n_other, len(i))).astype(int)
    other = np.stack([i[some], j[some]], axis=1)
    return Revisits(scores, float(limit), float(doubt), gap, same, other)


def pairwise(templates: np.ndarray, shift: int = 3) -> np.ndarray:
    """Return the mean difference of each two views, the smallest over shifts sideways.

    Args:
        templates: In [0, 1], ``(n, height, width)``.
        shift: Columns that one may be shifted by against the other.

    Returns:
        ``float32``, ``(n, n)``, symmetric.
    """
    grey = torch.from_numpy(np.rint(templates * 255).astype(np.float32))
    n, _, width = grey.shape
    best = torch.full((n, n), torch.inf)
    for by in range(shift + 1):
        left, right = grey[:, :, by:].reshape(n, -1), grey[:, :, : width - by].reshape(n, -1)
        means = torch.cdist(left, right, p=1.0) / (255.0 * left.shape[1])
        best = torch.minimum(best, torch.minimum(means, means.T))
    return best.numpy()


def fitting(config: ViewConfig, shape: tuple[int, ...]) -> ViewConfig:
    """Return the config with its template no larger than a picture of this shape."""
    width, height = min(config.template_width, shape[1]), min(config.template_height, shape[0])
    return config.model_copy(update={"template_width": width, "template_height": height})


def _spread(hits: np.ndarray) -> np.ndarray:
    return cv2.dilate(hits.astype(np.uint8), np.ones((2 * _CLOSE + 1,) * 2, np.uint8)) > 0


def _along_lines(relative: np.ndarray, sign: float) -> np.ndarray:
    n, w = len(relative), HALF_LENGTH
    margin = 2 * w
    padded = np.pad(relative, margin)  # zero: neither alike nor unlike
    best = np.full((n, n), np.inf, np.float32)
    for ratio in _SPEED_RATIOS:
        total = np.zeros((n, n), np.float32)
        for k in range(-w, w + 1):
            i, j = margin + k, margin + round(sign * ratio * k)
            total += padded[i : i + n, j : j + n]
        np.minimum(best, total / (2 * w + 1), out=best)
    return best
