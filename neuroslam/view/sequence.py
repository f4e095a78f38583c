r"""Match a sequence of frames with the stored templates, as SeqSLAM does.

One frame of a corridor resembles many templates; ten frames in a row resemble one stretch of the
path. The match errors of the last :math:`L` frames with all templates form a matrix, and a drive
along a known path is a straight line in it, whose slope is the ratio of the two speeds (M. Milford,
G. Wyeth, "SeqSLAM: visual route-based navigation for sunny summer days and stormy winter nights",
ICRA 2012). Columns may stand for templates or experiences; neighbours along the path must be
neighbours in the matrix.

SeqSLAM divides each error by the spread of the errors within ten templates of it. Here the whole
row is standardised: where a robot is slow, ten templates show one place, and their spread is noise.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch

from neuroslam.compiled import compiled, plain_array, runs_compiled
from neuroslam.errors import ConfigError, MapError
from neuroslam.state.join import Join
from neuroslam.state.mergeable import Mergeable, State
from neuroslam.state.renumbering import Renumbering
from neuroslam.state.tables import GrowingTable, Scalars
from neuroslam.types import NO_TEMPLATE

SPEED_RATIOS = (0.6, 0.8, 1.0, 1.25, 1.6)
"""Usual speed ratios: templates passed per frame."""


class SequenceMatch(NamedTuple):
    """Template that ends the best matching sequence.

    Attributes:
        template: Its column; ``NO_TEMPLATE`` if no sequence can be compared.
        score: Mean standardised match error along the sequence: -2 is two standard deviations
            below the mean error of a frame; infinite without a template.
        runner_up: Best score of a template that is not near this one; infinite without one.
        ratio: Runner-up score over score, in [0, 1]: near 1, another place matches as well.
    """

    template: int
    score: float
    runner_up: float
    ratio: float


NO_SEQUENCE = SequenceMatch(NO_TEMPLATE, np.inf, np.inf, 1.0)


def standardised(errors: np.ndarray) -> np.ndarray:
    r"""Express match errors in standard deviations from their mean.

    .. math:: z_j = (d_j - \bar d) / \sigma_d

    Args:
        errors: Match errors of a frame, ``(n,)``; NaN: not compared.

    Returns:
        ``(n,)``; 0 where all errors are equal, NaN where not compared.

    Example:
        >>> standardised(np.array([0.1, 0.1, 0.4, np.nan])).round(2).tolist()
        [-0.71, -0.71, 1.41, nan]
    """
    known = errors[~np.isnan(errors)]
    if not len(known):
        return errors.astype(np.float64)
    spread = float(known.std())
    return np.asarray((errors - known.mean()) / (spread if spread > 1e-12 else 1.0))


def line_offsets(length: int, ratios: Sequence[float]) -> np.ndarray:
    """Return how many columns back the frames of each line are, ``int64 (ratios, length)``.

    Example:
        >>> line_offsets(4, (0.5, 1.0, -1.0)).tolist()
        [[0, 1, 1, 2], [0, 1, 2, 3], [0, -1, -2, -3]]
    """
    back = np.outer(np.asarray(ratios, np.float64), np.arange(length))
    return np.floor(back + 0.5).astype(np.int64)


def sequence_scores(rows: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    r"""Score every template as the end of a sequence of the last frames.

    .. math:: S_j = \min_v \frac{1}{|K|} \sum_{k \in K} z_{t-k,\; j - [v k]}

    over the speed ratios :math:`v`; :math:`K` are the lags whose entry is known. A line of which
    less than half of the known frames lie on known entries is not compared.

    Args:
        rows: Standardised match errors, ``(L, n)``, the newest frame first; NaN: not known.
        offsets: :math:`[v k]`, from :func:`line_offsets`, ``(ratios, L)``.

    Returns:
        Scores, ``(n,)``, the smaller the better; infinite where no line can be compared.

    Example:
        >>> rows = np.array([[0.0, 0.0, -2.0, 0.0], [0.0, -2.0, 0.0, 0.0], [-1.0, 0.0, 0.0, -3.0]])
        >>> sequence_scores(rows, line_offsets(3, (1.0,))).round(2).tolist()
        [inf, 0.0, -1.67, 0.0]
    """
    length, n = rows.shape
    least = 0.5 * (~np.isnan(rows)).any(axis=1).sum()
    scores = np.full(n, np.inf)
    for back in offsets:
        columns = np.arange(n) - back[:, None]
        inside = (columns >= 0) & (columns < n)
        errors = np.where(inside, rows[np.arange(length)[:, None], columns.clip(0, n - 1)], np.nan)
        known = (~np.isnan(errors)).sum(axis=0)
        compared = (known > 0) & (known >= least)
        mean = np.nansum(errors, axis=0) / np.maximum(known, 1)
        scores = np.where(compared, np.minimum(scores, mean), scores)
    return scores


@compiled
def sequence_step(
    recent: np.ndarray, n: int, newest: int, offsets: np.ndarray, errors: np.ndarray
) -> np.ndarray:
    """Store the errors of a frame in a ring, and return :func:`sequence_scores`.

    Args:
        recent: Ring of standardised errors, ``(>= n, L)``: column ``newest`` is overwritten.
        n: Number of templates.
        newest: Place of this frame in the ring; the frame before it is one place back.
        offsets: See :func:`sequence_scores`.
        errors: Match errors of this frame, ``(n,)``.
    """
    length = recent.shape[1]
    total, square, n_known = 0.0, 0.0, 0
    for j in range(n):
        if not np.isnan(errors[j]):
            total += errors[j]
            n_known += 1
    mean = total / max(n_known, 1)
    for j in range(n):
        if not np.isnan(errors[j]):
            square += (errors[j] - mean) * (errors[j] - mean)
    spread = np.sqrt(square / max(n_known, 1))
    if spread <= 1e-12:
        spread = 1.0
    for j in range(n):
        recent[j, newest] = (errors[j] - mean) / spread

    least = 0.0
    for k in range(length):
        for j in range(n):
            if not np.isnan(recent[j, k]):
                least += 0.5
                break
    scores = np.full(n, np.inf)
    for line in range(offsets.shape[0]):
        for j in range(n):
            total, n_known = 0.0, 0
            for k in range(length):
                column = j - offsets[line, k]
                if 0 <= column < n:
                    error = recent[column, (newest - k) % length]
                    if not np.isnan(error):
                        total += error
                        n_known += 1
            if n_known > 0 and n_known >= least:
                scores[j] = min(scores[j], total / n_known)
    return scores


def best_sequence(scores: np.ndarray, near: int | np.ndarray = 5) -> SequenceMatch:
    """Find the template with the best score, and the runner-up that is not near it.

    Args:
        scores: From :func:`sequence_scores`.
        near: Columns at either side of the best that are no runner-up; or a mask ``(n,)`` of the
            templates that are near the best one, for columns that are not in the order of a path.

    Example:
        >>> best_sequence(np.array([-1.0, -2.0, -1.5, -0.5]), near=1)
        SequenceMatch(template=1, score=-2.0, runner_up=-0.5, ratio=0.25)
    """
    if not len(scores) or not np.isfinite(scores).any():
        return NO_SEQUENCE
    best = int(scores.argmin())
    far = np.abs(np.arange(len(scores)) - best) > near if isinstance(near, int) else ~near
    runner_up = float(scores.min(where=far, initial=np.inf))
    score = float(scores[best])
    ratio = 1.0  # for a template that is no better than the mean of all
    if score < 0.0:
        ratio = max(0.0, runner_up / score) if np.isfinite(runner_up) else 0.0
    return SequenceMatch(best, score, runner_up, ratio)


class _Ring(Scalars):
    """Place of the newest frame in the ring."""

    newest: int


class SequenceMatcher(Mergeable):
    """Keeps the match errors of the last frames; :func:`sequence_scores` has the mathematics.

    Templates are numbered along the path and may be added at any time: their errors with earlier
    frames are unknown and are left out. A merge renumbers templates, so it clears the memory.

    Args:
        length: Number of frames in a sequence.
        ratios: Speed ratios: templates passed per frame; negative: the path driven backwards.
        near: See :func:`best_sequence`.

    Raises:
        ConfigError: If there are no frames or no ratios.

    Example:
        >>> matcher = SequenceMatcher(length=3, ratios=(1.0,), near=1)
        >>> for error in np.array([[0.1, 0.3, 0.4, 0.1], [0.3, 0.1, 0.4, 0.4]]):
        ...     match = matcher(error)
        >>> match.template, round(match.score, 2)
        (1, -1.3)
    """

    def __init__(
        self, length: int = 10, ratios: Sequence[float] = SPEED_RATIOS, near: int = 5
    ) -> None:
        super().__init__()
        if length < 1 or not len(ratios) or not np.isfinite(ratios).all():
            raise ConfigError(
                f"SequenceMatcher: length {length}, ratios {tuple(ratios)}; expected a length of "
                "at least 1 and finite ratios"
            )
        self.length, self.near = length, near
        self.offsets = line_offsets(length, ratios)
        self.state = _Ring(newest=0)
        self.recent = GrowingTable({"errors": ((length,), torch.float64)})

    def forward(self, errors: np.ndarray) -> SequenceMatch:
        """Add the match errors of a frame, and match the sequence that ends with it.

        Args:
            errors: With every template, ``(n,)``, at least as many as in the last call; NaN: not
                compared. All NaN for a frame without a view.

        Raises:
            MapError: If there are fewer templates than before.
        """
        return best_sequence(self.scores(errors), self.near)

    def scores(self, errors: np.ndarray) -> np.ndarray:
        """Add the match errors of a frame, as :meth:`forward`; return all scores, ``(n,)``.

        Raises:
            MapError: If there are fewer templates than before.
        """
        n = len(errors)
        if n < self.recent.n:
            raise MapError(
                f"SequenceMatcher: {n} match errors, {self.recent.n} before; call forget() when "
                "the templates have changed"
            )
        while self.recent.n < n:
            self.recent.append(errors=torch.full((self.length,), torch.nan, dtype=torch.float64))
        self.state.newest = newest = (self.state.newest + 1) % self.length
        storage = self.recent.storage()["errors"]
        if runs_compiled(storage):
            values = plain_array(np.asarray(errors, np.float64))
            return sequence_step(storage.numpy(), n, newest, self.offsets, values)
        z = torch.from_numpy(standardised(np.asarray(errors, np.float64)))
        self.recent["errors"][:, newest] = z.to(storage.device)
        rows = self.recent["errors"].numpy(force=True).T
        return sequence_scores(rows[(newest - np.arange(self.length)) % self.length], self.offsets)

    def forget(self) -> None:
        """Clear the memory: the templates have changed, or the robot was kidnapped."""
        self.recent.replace(errors=self.recent["errors"][:0])

    def renumber(self, change: Renumbering) -> None:
        """Clear the memory: templates have other numbers."""
        self.forget()

    def merged(self, loaded: State, partial: State, join: Join) -> State:
        """Clear the memory: a merge renumbers templates."""
        return {
            name: value if name.startswith("state.") else value[:0]
            for name, value in partial.items()
        }
