"""Where two maps meet: pairs of experiences that are the same."""

from typing import NamedTuple, Self

import numpy as np

from neuroslam.types import Pose


class Pairs(NamedTuple):
    """Places of a partial map that look like places of a loaded one; arrays of one length.

    Attributes:
        partial: Experience of the partial map.
        loaded: Experience of the loaded map.
        turn_rad: Heading of the first minus heading of the second, as seen.
        error: How unlike they look: mean difference of the views, 0 is equal.
    """

    partial: np.ndarray
    loaded: np.ndarray
    turn_rad: np.ndarray
    error: np.ndarray

    @classmethod
    def of(cls, rows: list[tuple[int, int, float, float]]) -> Self:
        """Make them of a list of rows."""
        table = np.array(rows, dtype=np.float64).reshape(-1, 4)
        return cls(*table[:, :2].T.astype(np.int64), *table[:, 2:].T)

    def pick(self, which: np.ndarray | list[int] | slice) -> Self:
        """Return some of them, by number or by truth."""
        return type(self)(*(column[which] for column in self))


class Match(NamedTuple):
    """Where two maps meet.

    Attributes:
        loaded: Experience :math:`e_u` of the loaded map.
        partial: Experience :math:`e_z` of the partial map: the same place.
        turn_rad: Heading of :math:`e_z` minus heading of :math:`e_u`, as the views tell.
        error: Mean difference of the views.
        runner_up: That of the most similar view of any other place, where it was looked for.
        others: Further places that are the same, if any.
        onto: Where :math:`e_z` comes to lie, where that is known better than that it is
            :math:`e_u`.
    """

    loaded: int
    partial: int
    turn_rad: float = 0.0
    error: float = 0.0
    runner_up: float | None = None
    others: Pairs = Pairs.of([])
    onto: Pose | None = None

    @property
    def pairs(self) -> Pairs:
        """All places that are the same, the match first, each partial place once."""
        others = self.others.pick(self.others.partial != self.partial)
        first = Pairs.of([(self.partial, self.loaded, self.turn_rad, self.error)])
        return Pairs(*(np.concatenate(columns) for columns in zip(first, others, strict=True)))
