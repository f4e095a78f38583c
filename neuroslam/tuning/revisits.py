r"""Revisits of places in a drive, found by matching sequences of pictures, without ground truth.

A single picture may resemble another by chance, a sequence of pictures hardly does. Sequences are
compared as in SeqSLAM (Milford and Wyeth 2012): along lines of the difference matrix,

.. math:: S_{ij} = \min_v \frac{1}{2w+1} \sum_{k=-w}^{w} \hat D_{i+k,\; j+\lfloor vk \rceil}

over ratios of speed :math:`v`. The distribution of :math:`S` by chance is measured on the same
drive with :math:`-v`: sequences in reverse order, which a camera that looks ahead never records.
"""

from typing import NamedTuple

import cv2
import numpy as np
import torch

from neuroslam.config import ViewConfig
from neuroslam.view.preprocess import encode

HALF_LENGTH = 10
"""Key frames of a sequence before and after its middle: :math:`w`."""

CHANCE = 0.01
"""Share of key frames for which a reversed sequence would be accepted."""

_SPEED_RATIOS = (0.5, 0.67, 0.8, 1.0, 1.25, 1.5, 2.0)
_SIGNATURE = ViewConfig(
    template_width=40, template_height=24, patch_radius=4, shift_match=3, normalisation=0.0
)
_CLOSE = 5  # key frames: the accuracy of sequence matches


class Revisits(NamedTuple):
    """Pairs of key frames that show the same place, and pairs that do not.

    Attributes:
        scores: :math:`S`, ``(n, n)``; lower for more similar sequences; ``inf`` within ``gap``.
        limit: Score below which two sequences show the same place.
        doubt: Score above which they show two places; between the two it is not known.
        gap: Key frames nearer than this in time are neighbours, not revisits.
        same: Pairs of the same place, ``(m, 2)``, the earlier first: each key frame that has any,
            with its nearest revisit in time.
        other: Pairs of different places, ``(k, 2)``.
    """

    scores: np.ndarray
    limit: float
    doubt: float
    gap: int
    same: np.ndarray
    other: np.ndarray

    @property
    def near(self) -> np.ndarray:
        """Which pairs are correct matches, within the accuracy of sequences, ``(n, n)``."""
        return _dilated(self.scores < self.limit)

    @property
    def unsure(self) -> np.ndarray:
        """Which pairs are neither correct nor false with certainty, ``(n, n)``."""
        return np.logical_and(_dilated(self.scores <= self.doubt), ~self.near)


def find_revisits(pictures: np.ndarray, n_other: int = 2000) -> Revisits:
    """Find the pairs of key frames that show the same place.

    Args:
        pictures: Key frames in order of time, grey ``uint8``, ``(n, h, w)``, of a moving robot.
        n_other: Number of pairs of different places, at most.
    """
    templates = [encode(p, fitting(_SIGNATURE, p.shape)).template for p in pictures]
    differences = pairwise_differences(np.stack(templates))
    n = len(differences)
    lag_means = np.array([np.diagonal(differences, lag).mean() for lag in range(n // 2)])
    unlike = 0.9 * np.median(differences)
    decorrelated = int(np.argmax(lag_means > unlike)) if (lag_means > unlike).any() else n // 2
    gap = min(max(3 * HALF_LENGTH, 2 * decorrelated), n // 3)
    spread = differences.std(axis=1, keepdims=True) + 1e-9
    relative = (differences - differences.mean(axis=1, keepdims=True)) / spread
    relative = (0.5 * (relative + relative.T)).astype(np.float32)
    lags = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    scores = _along_lines(relative, 1.0)
    scores[lags < gap] = np.inf
    reversed_scores = _along_lines(relative, -1.0)
    reversed_scores[lags < gap] = np.inf
    by_chance = reversed_scores.min(axis=1)
    by_chance = by_chance[np.isfinite(by_chance)]
    limit, doubt = np.quantile(by_chance, (CHANCE, 0.5)) if len(by_chance) else (-np.inf, -np.inf)
    same = _nearest(scores, limit)
    median = np.median(scores[np.isfinite(scores)]) if np.isfinite(scores).any() else 0.0
    i, j = np.nonzero(np.triu(np.isfinite(scores) & (scores > median)))
    some = np.linspace(0, len(i) - 1, min(n_other, len(i))).astype(int)
    other = np.stack([i[some], j[some]], axis=1)
    return Revisits(scores, float(limit), float(doubt), gap, same, other)


def _nearest(scores: np.ndarray, limit: float) -> np.ndarray:
    """Return each key frame with the best match of its last visit before, ``(m, 2)``."""
    pairs = []
    for i, row in enumerate(scores):
        before = np.flatnonzero(row[:i] < limit)
        if len(before):
            first = max(0, before[-1] - 2 * _CLOSE)
            pairs.append((first + int(row[first : before[-1] + 1].argmin()), i))
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def pairwise_differences(templates: np.ndarray, shift: int = 3) -> np.ndarray:
    """Return the mean difference of every two templates, the smallest over horizontal shifts.

    Args:
        templates: In [0, 1], ``(n, height, width)``.
        shift: Largest shift of one against the other, in columns.

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


def differences_of(templates: np.ndarray, pairs: np.ndarray, shift: int) -> np.ndarray:
    """Return the mean difference of pairs of templates, the smallest over horizontal shifts.

    Args:
        templates: In [0, 1], ``(n, height, width)``.
        pairs: Positions of two templates each, ``(m, 2)``.
        shift: Largest shift of one against the other, in columns.
    """
    a, b = templates[pairs[:, 0]], templates[pairs[:, 1]]
    width = templates.shape[2]
    best = np.full(len(pairs), np.inf)
    for by in range(-shift, shift + 1):
        left, right = (
            a[:, :, max(0, by) : width + min(0, by)],
            b[:, :, max(0, -by) : width - max(0, by)],
        )
        np.minimum(best, np.abs(left - right).mean(axis=(1, 2)), out=best)
    return best


def fitting(config: ViewConfig, shape: tuple[int, ...]) -> ViewConfig:
    """Return the config with its template limited to the size of a picture.

    Templates of gradients are not limited: their cells are made from an enlarged picture.
    """
    if config.orientations:
        return config
    width, height = min(config.template_width, shape[1]), min(config.template_height, shape[0])
    return config.model_copy(update={"template_width": width, "template_height": height})


def _dilated(matches: np.ndarray) -> np.ndarray:
    square = np.ones((2 * _CLOSE + 1,) * 2, np.uint8)
    return np.asarray(cv2.dilate(matches.astype(np.uint8), square) > 0)


def _along_lines(relative: np.ndarray, sign: float) -> np.ndarray:
    n, w = len(relative), HALF_LENGTH
    margin = 2 * w
    padded = np.pad(relative, margin)  # 0 is the mean difference
    best = np.full((n, n), np.inf, np.float32)
    for ratio in _SPEED_RATIOS:
        total = np.zeros((n, n), np.float32)
        for k in range(-w, w + 1):
            i, j = margin + k, margin + round(sign * ratio * k)
            total += padded[i : i + n, j : j + n]
        np.minimum(best, total / (2 * w + 1), out=best)
    return best
