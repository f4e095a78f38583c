"""Scores of templates: how well they separate places, and differences within a place."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from neuroslam.config import ViewConfig
from neuroslam.tuning.revisits import Revisits, pairwise_differences
from neuroslam.view.preprocess import encode

_LAGS = 200


class ViewScore(NamedTuple):
    """Place recognition by single templates.

    Attributes:
        config: Config of the template.
        precision: Share of correct matches of key frames up to a threshold, ``(n,)``.
        recall: Share of the revisits that are matched up to it, ``(n,)``.
        threshold: Rising thresholds on the difference, ``(n,)``.
        average_precision: Area below precision over recall.
        neighbours: Differences of successive key frames, ``(m,)``.
        revisits: Differences of two views of the same place, ``(m,)``.
        others: Differences of views of two places, ``(m,)``.
        growth: Median difference of key frames by their distance in key frames, from 1.
    """

    config: ViewConfig
    precision: np.ndarray
    recall: np.ndarray
    threshold: np.ndarray
    average_precision: float
    neighbours: np.ndarray
    revisits: np.ndarray
    others: np.ndarray
    growth: np.ndarray

    def lasts(self, threshold: float) -> int:
        """Return for how many key frames the difference to a view stays below a threshold."""
        beyond = np.flatnonzero(self.growth > threshold)
        return 1 + int(beyond[0]) if len(beyond) else len(self.growth)


def score_views(templates: np.ndarray, config: ViewConfig, revisits: Revisits) -> ViewScore:
    """Match each key frame with all others and compare with the revisits found by sequences.

    Args:
        templates: Templates of the key frames, in [0, 1], ``(n, height, width)``.
        config: Config of the templates; its threshold is not used.
        revisits: Pairs of key frames that show the same place.
    """
    differences = pairwise_differences(templates, config.shift_match)
    n, near = len(differences), revisits.near
    known = near.any(axis=1)
    far = np.abs(np.subtract.outer(np.arange(n), np.arange(n))) >= revisits.gap
    nearest = np.where(far, differences, np.inf).argmin(axis=1)
    smallest = np.where(far, differences, np.inf)[np.arange(n), nearest]
    correct = near[np.arange(n), nearest]
    order = np.argsort(smallest, kind="stable")
    certain = np.isfinite(smallest) & ~revisits.unsure[np.arange(n), nearest]
    order = order[certain[order]]
    hits = np.cumsum(correct[order])
    precision = hits / np.arange(1, len(order) + 1)
    recall = hits / max(1, int(known.sum()))
    gained = np.diff(recall, prepend=0.0)
    return ViewScore(
        config,
        precision,
        recall,
        smallest[order],
        float((precision * gained).sum()),
        np.diagonal(differences, 1).copy(),
        differences[revisits.same[:, 0], revisits.same[:, 1]],
        differences[revisits.other[:, 0], revisits.other[:, 1]],
        np.array([np.median(np.diagonal(differences, lag)) for lag in range(1, min(n, _LAGS))]),
    )


def best_view(
    pictures: np.ndarray, configs: Iterable[ViewConfig], revisits: Revisits
) -> list[ViewScore]:
    """Score grey templates of several configs, best first; equal scores keep their order.

    Args:
        pictures: Key frames, as for :func:`~neuroslam.tuning.revisits.find_revisits`.
        configs: Configs of the templates.
        revisits: Pairs of key frames that show the same place.
    """
    scores = [
        score_views(np.stack([encode(p, config).template for p in pictures]), config, revisits)
        for config in configs
    ]
    return sorted(scores, key=lambda score: -round(score.average_precision, 3))
