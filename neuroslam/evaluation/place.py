"""Quality of place recognition: precision, recall, average precision."""

from typing import NamedTuple

import numpy as np

from neuroslam.errors import MapError


class PrecisionRecall(NamedTuple):
    """A precision-recall curve: one point for each distinct distance, smallest first.

    Attributes:
        precision: Share of the accepted matches that are correct.
        recall: Share of all correct matches that are accepted.
        threshold: Largest distance of an accepted match.
    """

    precision: np.ndarray
    recall: np.ndarray
    threshold: np.ndarray


def precision_recall(
    distances: np.ndarray, right: np.ndarray, n_right: int | None = None
) -> PrecisionRecall:
    """Return precision and recall of matches for every threshold on their distance.

    Args:
        distances: Distance of each match; a smaller one is more certain.
        right: Whether the match is correct; same shape.
        n_right: Number of correct matches that exist, if more than those in ``right``.

    Raises:
        MapError: If no correct match exists, or the shapes differ.

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
        raise MapError(
            f"precision_recall: {n_right} correct matches exist, expected at least one; "
            "recall is not defined without"
        )
    order = np.argsort(distances, kind="stable")
    distances, hits = distances[order], np.cumsum(right[order])
    last = np.append(np.diff(distances) > 0, True)  # matches of equal distance go together
    accepted = np.arange(1, len(distances) + 1)[last]
    return PrecisionRecall(hits[last] / accepted, hits[last] / n_right, distances[last])


def average_precision(curve: PrecisionRecall) -> float:
    r"""Return the average precision: the sum of precision over the steps of recall.

    .. math:: AP = \sum_n (R_n - R_{n-1}) \, P_n

    Example:
        >>> curve = precision_recall(np.array([1.0, 2.0, 3.0]), np.array([True, False, True]))
        >>> round(average_precision(curve), 3)
        0.833
    """
    return float(np.sum(np.diff(curve.recall, prepend=0.0) * curve.precision))


def recall_at_full_precision(curve: PrecisionRecall) -> float:
    """Return the largest recall without a false match.

    Example:
        >>> curve = precision_recall(np.array([1.0, 2.0, 3.0]), np.array([True, False, True]))
        >>> recall_at_full_precision(curve)
        0.5
    """
    right = curve.recall[curve.precision == 1.0]
    return float(right.max()) if len(right) else 0.0
