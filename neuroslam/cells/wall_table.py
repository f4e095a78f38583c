"""Table of remembered walls, and the active ones that have a row in the covariance."""

import math

import torch
from torch import Tensor

from neuroslam.cells.boundary_vectors import Wall, squared_mismatch
from neuroslam.state.mergeable import BufferModule
from neuroslam.state.tables import Scalars

OWN = 4
"""First rows of the covariance: x and y of the position, relative error of speed, compass error."""

ACTIVE = 96
"""Largest number of walls, the nearest ones, with a row in the covariance; others are stored."""

UNKNOWN_M2 = 1.0
"""Variance of a distance before it was measured."""

_COLUMNS_BEFORE = 6  # of walls in brains that were saved without ``due`` and ``met``


class Since(Scalars):
    """Time since the last correction by walls (``s``), and since the session began (``time_s``)."""

    s: float
    time_s: float

    def __init__(self) -> None:
        super().__init__(s=0.0, time_s=0.0)


class WallTable(BufferModule):
    """Remembered walls of each animal; the base of :class:`~neuroslam.cells.walls.WallMemory`.

    State: all walls (``walls``, ``n_walls``), the numbers of the active ones (``active``; -1: a
    free slot), and the covariance, which has a row for each slot after the first ``OWN`` rows.

    Args:
        batch: Number of animals side by side, or ``None`` for one.
    """

    walls: Tensor
    n_walls: Tensor
    active: Tensor
    covariance: Tensor
    scale: Tensor
    """Distance (m) and difference of bearing (rad) within which two walls are the same."""

    def __init__(self, batch: int | None = None) -> None:
        super().__init__()
        self.batch = batch
        b, kind = batch or 1, torch.float64
        self.register_buffer("walls", torch.zeros(b, 0, len(Wall._fields), dtype=kind))
        self.register_buffer("n_walls", torch.zeros(b, dtype=torch.int64))
        self.register_buffer("active", torch.full((b, 0), -1))
        self.register_buffer("covariance", torch.zeros(b, OWN, OWN, dtype=kind))
        self.since = Since()
        self.register_load_state_dict_pre_hook(_take_sizes)

    def remembered(self) -> list[Wall]:
        """Return all walls of each animal, as columns."""
        return [
            Wall(*rows[:n].unbind(-1))
            for rows, n in zip(self._up_to_date(), self.n_walls.tolist(), strict=True)
        ]

    def _find(self, position: Tensor, bearing: Tensor) -> tuple[Tensor, Tensor]:
        """Find the active wall that each animal senses: its slot, and whether there is one."""
        if self.active.shape[1] == 0:
            none = torch.zeros(len(position), dtype=torch.int64, device=position.device)
            return none, none.bool()
        at = self.active.clamp_min(0).unsqueeze(-1).expand(-1, -1, self.walls.shape[-1])
        cost = self._mismatch(self.walls.gather(1, at), position, bearing)
        least, slot = cost.where(self.active >= 0, math.inf).min(1)
        return slot, least < 1.0

    def _mismatch(self, walls: Tensor, position: Tensor, bearing: Tensor) -> Tensor:
        return squared_mismatch(walls, position.unsqueeze(-2), bearing.unsqueeze(-1), self.scale)

    def _recall(
        self, position: Tensor, distance: Tensor, bearing: Tensor,
        slot: Tensor, known: Tensor, missing: Tensor, learns: Tensor | None,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        """Activate remembered walls that were not among the active ones, or store new ones."""
        slot, known = slot.clone(), known.clone()
        for row in missing.nonzero()[
            :, 0
        ].tolist():  # rare: a wall is new, or was not sensed for long
            n = int(self.n_walls[row])
            stored = self.walls[row, :n]
            cost = self._mismatch(stored, position[row], bearing[row])
            cost[self.active[row][self.active[row] >= 0]] = math.inf
            wall = int(cost.argmin()) if n else -1
            if n == 0 or cost[wall] >= 1.0:
                if learns is not None and not learns[row]:
                    continue
                wall = n
                new = [*position[row], bearing[row], distance[row]]
                rest = position.new_tensor([UNKNOWN_M2, self.since.time_s, 0.0, 0.0])
                self._remember(row, torch.cat([torch.stack(new), rest]))
            slot[row], known[row] = self._activate(row, wall, position[row]), True
        return slot, known

    def _remember(self, row: int, wall: Tensor) -> None:
        n = int(self.n_walls[row])
        if n == self.walls.shape[1]:
            self._add_rows()
        walls = self.walls.clone()
        walls[row, n] = wall
        self.walls = walls
        self.n_walls = self.n_walls.clone()
        self.n_walls[row] += 1

    def _add_rows(self) -> None:
        walls = self.walls
        more = walls.new_zeros(len(walls), max(16, walls.shape[1]), walls.shape[2])
        self.walls = torch.cat([walls, more], 1)

    def _add_slots(self) -> None:
        width = self.active.shape[1]
        more = min(max(16, width), ACTIVE - width)
        self.active = torch.nn.functional.pad(self.active, (0, more), value=-1)
        self.covariance = torch.nn.functional.pad(self.covariance, (0, more, 0, more))

    def _activate(self, row: int, wall: int, position: Tensor) -> int:
        """Give a wall a row in the covariance; if there is none left, that of the farthest wall."""
        free = (self.active[row] < 0).nonzero()
        width = self.active.shape[1]
        if len(free):
            slot = int(free[0])
        elif width < ACTIVE:
            slot = width
            self._add_slots()
        else:
            anchors = self.walls[row, self.active[row], :2]
            slot = int((anchors - position).square().sum(-1).argmax())
            self.walls = self._up_to_date()
        covariance, active = self.covariance, self.active.clone()
        covariance[row, OWN + slot, :] = 0.0
        covariance[row, :, OWN + slot] = 0.0
        covariance[row, OWN + slot, OWN + slot] = self.walls[row, wall, 4]
        active[row, slot] = wall
        self.active = active
        return slot

    def _up_to_date(self) -> Tensor:
        """Return the walls with the variances of the active ones taken from the covariance."""
        walls = self.walls.clone()
        row, slot = (self.active >= 0).nonzero(as_tuple=True)
        own = self.covariance.diagonal(dim1=-2, dim2=-1)[:, OWN:]
        walls[row, self.active[row, slot], 4] = own[row, slot]
        return walls


def _take_sizes(
    module: torch.nn.Module, state: dict[str, Tensor], prefix: str, *_unused: object
) -> None:
    walls = state.get(prefix + "walls")
    if walls is not None and walls.dim() == 3 and walls.shape[-1] == _COLUMNS_BEFORE:
        state[prefix + "walls"] = torch.nn.functional.pad(
            walls, (0, len(Wall._fields) - _COLUMNS_BEFORE)
        )
    for name in ("walls", "active", "covariance"):
        saved = state.get(prefix + name)
        if saved is not None and len(saved) == len(getattr(module, name)):
            setattr(module, name, getattr(module, name).new_empty(saved.shape))
