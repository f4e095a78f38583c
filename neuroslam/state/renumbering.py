"""How ids change when a map forgets experiences and templates."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor


class Renumbering(NamedTuple):
    """Ids after some experiences have become part of others, and some templates were dropped.

    Rows that are kept stay in order, so that a larger id is still a later one.

    Attributes:
        views: Id of every template from now on; of one that is dropped that of the experience
            which its own has become part of, ``(n_views,)``; -1: none.
        experiences: Id of every experience from now on, or of that which it is part of,
            ``(n_experiences,)``.
        kept_views: Templates that are kept, in order.
        kept_experiences: Experiences that are kept, in order.
        relative: Pose of every experience in the frame of that which it is part of, x ahead and y
            to the left in metres and heading in radians, ``(n_experiences, 3)``; 0 for those kept.
    """

    views: np.ndarray
    experiences: np.ndarray
    kept_views: np.ndarray
    kept_experiences: np.ndarray
    relative: np.ndarray

    def rows_of_views(self, column: Tensor) -> Tensor:
        """Return the rows of a column with one for each template, the last ones without yet."""
        return _rows(column, self.kept_views)

    def rows_of_experiences(self, column: Tensor) -> Tensor:
        """Return the rows of a column with one for each experience, the last ones without yet."""
        return _rows(column, self.kept_experiences)

    def view(self, number: int) -> int:
        """Return the id of a template from now on; negative ones stay."""
        return number if number < 0 else int(self.views[number])

    def experience(self, number: int) -> int:
        """Return the id of an experience from now on; negative ones stay."""
        return number if number < 0 else int(self.experiences[number])


def _rows(column: Tensor, kept: np.ndarray) -> Tensor:
    return column[torch.from_numpy(kept[kept < len(column)])]


def summed_rows(column: Tensor, ids: np.ndarray, n: int) -> Tensor:
    """Add up the rows that have the same id now; rows without one are dropped.

    Args:
        column: Sums or counts, one row for each old id; later ids may have none yet.
        ids: New id of every old one, -1: none.
        n: Number of new ids.

    Example:
        >>> summed_rows(torch.tensor([1, 2, 4]), np.array([0, 0, -1]), 1).tolist()
        [3]
    """
    ids = ids[: len(column)]
    known = ids >= 0
    length = min(n, int(ids.max(initial=-1)) + 1)
    to = torch.from_numpy(ids[known])
    return column.new_zeros((length, *column.shape[1:])).index_add(
        0, to, column[: len(ids)][torch.from_numpy(known)]
    )
