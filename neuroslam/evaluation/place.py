"""How well places are recognised: precision, recall, average precision."""

from typing import NamedTuple

import numpy as np

from neuroslam.errors import MapError


class PrecisionRecall(NamedTuple):
    """A curve over the threshold: one point for each distinct distance, nearest first.

    Attributes:
        precision: Share of the answers within the threshold that are right.
        recall: Share of all right answers that are within the threshold.
        threshold: Distance up to which an answer is given.
    """

    precision: np.ndarray
    recall: np.ndarray
    threshold: np.ndarray


def precision_recall(
    distances: np.ndarray, right: np.ndarray, n_right: int | None = None
) -> PrecisionRecall:
    """Trace precision over recall while the threshold on a distance grows.

    Args:
        distances: Distance of each answer; smaller is surer.
        right: Whether it is right; same shape.
        n_right: How many right answers there are to find, if more than those given.

    Raises:
        MapError: If there is nothing to find, or the shapes differ.

    Example:
        >>> curve = precision_recall(np.array([1.0, 2.0, 3.0]), np.array([True, False, True]))
        >>> curve.precision.round(3).tolist(), curve.recall.tolist()
        ([1.0, 0.5, 0.667], [0.5, 0.5, 1.0])
    """
    distances, right = np.ravel(distances), np.ravel(right).astype(bool)
    if distances.shape != right.shape:
        raise MapError(
            f"precision_recall: {distances.size} distances and {right.size} labels; "
            "expected a label for each distance"
        )
    n_right = int(right.sum()) if n_right is None else n_right
    if n_right < 1:
        raise MapError("precision_recall: no right answer to find; recall has no meaning")
    order = np.argsort(distances, kind="stable")
    distances, hits = distances[order], np.cumsum(right[order])
    last = np.append(np.diff(distances) > 0, True)  # equally near answers are given together
    answers = np.arange(1, len(distances) + 1)[last]
    return PrecisionRecall(hits[last] / answers, hits[last] / n_right, distances[last])


def average_precision(curve: PrecisionRecall) -> float:
    r"""Sum precision over the steps of recall.

    .. math:: AP = \sum_n (R_n - R_{n-1}) \, P_n

    Example:
        >>> curve = precision_recall(np.array([1.0, 2.0, 3.0]), np.array([True, False, True]))
        >>> round(average_precision(curve), 3)
        0.833
    """
    return float(np.sum(np.diff(curve.recall, prepend=0.0) * curve.precision))


def recall_at_full_precision(curve: PrecisionRecall) -> float:
    """Return the largest recall that is reached without one wrong answer.

    Example:
        >>> curve = precision_recall(np.array([1.0, 2.0, 3.0]), np.array([True, False, True]))
        >>> recall_at_full_precision(curve)
        0.5
    """
    right = curve.recall[curve.precision == 1.0]
    return float(right.max()) if len(right) else 0.0
