"""Which template tells places apart in these pictures, and how near two views of one place are."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from neuroslam.config import ViewConfig
from neuroslam.tuning.revisits import Revisits, pairwise
from neuroslam.view.preprocess import encode

_LAGS = 200


class ViewScore(NamedTuple):
    """How well single views tell places apart.

    Attributes:
        config: Of the template.
        precision: Of recognising each key frame among all earlier ones, ``(n,)``, the surest first.
        recall: Share of the revisits that are recognised until there, ``(n,)``.
        threshold: Difference up to there, ``(n,)``.
        average_precision: Area below precision over recall.
        neighbours: Differences of key frames in a row, ``(m,)``.
        revisits: Of two views of one place, ``(m,)``.
        others: Of two views of two places, ``(m,)``.
        growth: Median difference of key frames, by how many they are apart, from 1 on.
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
        """Return for how many key frames a view is below a difference, 1 or more."""
        beyond = np.flatnonzero(self.growth > threshold)
        return 1 + int(beyond[0]) if len(beyond) else len(self.growth)


def score_views(templates: np.ndarray, config: ViewConfig, revisits: Revisits) -> ViewScore:
    """Recognise each key frame among all others and compare with what stretches say.

    Args:
        templates: Of the key frames, in [0, 1], ``(n, template_height, template_width)``.
        config: Of the templates; its threshold is not used.
        revisits: Which key frames show one place.
    """
    apart = pairwise(templates, config.shift_match)
    n, near = len(apart), revisits.near
    known = near.any(axis=1)
    far = np.abs(np.subtract.outer(np.arange(n), np.arange(n))) >= revisits.gap
    nearest = np.where(far, apart, np.inf).argmin(axis=1)
    smallest = np.where(far, apart, np.inf)[np.arange(n), nearest]
    right = near[np.arange(n), nearest]
    order = np.argsort(smallest, kind="stable")
    sure = np.isfinite(smallest) & ~revisits.unsure[np.arange(n), nearest]
    order = order[sure[order]]
    hits = np.cumsum(right[order])
    precision = hits / np.arange(1, len(order) + 1)
    recall = hits / max(1, int(known.sum()))
    gained = np.diff(recall, prepend=0.0)
    return ViewScore(
        config,
        precision,
        recall,
        smallest[order],
        float((precision * gained).sum()),
        np.diagonal(apart, 1).copy(),
        apart[revisits.same[:, 0], revisits.same[:, 1]],
        apart[revisits.other[:, 0], revisits.other[:, 1]],
        np.array([np.median(np.diagonal(apart, lag)) for lag in range(1, min(n, _LAGS))]),
    )


def best_view(
    pictures: np.ndarray, configs: Iterable[ViewConfig], revisits: Revisits
) -> list[ViewScore]:
    """Score templates of grey, the best first; of equals the one given first.

    Args:
        pictures: Key frames, as for :func:`~neuroslam.tuning.revisits.find_revisits`.
        configs: Of the templates.
        revisits: Which key frames show one place.
    """
    scores = [
        score_views(np.stack([encode(p, config).template for p in pictures]), config, revisits)
        for config in configs
    ]
    return sorted(scores, key=lambda score: -round(score.average_precision, 3))
