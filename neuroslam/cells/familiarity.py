"""Familiarity: the walls known at each place cell, and whether the present ones contradict them."""

from collections.abc import Sequence
from typing import NamedTuple, cast

import numpy as np
import torch
from torch import Tensor

from neuroslam.compiled import compiled
from neuroslam.config import BoundaryCellConfig
from neuroslam.geometry import TWO_PI
from neuroslam.state.mergeable import Arrays, BufferModule, without_gradients

SURE = 0.6
"""Share of the reach within which a wall is always sensed."""

_NEVER, _ALWAYS = 0.02, 0.98
_SLACK_BINS = 2  # tolerance of bearing, in boundary cells
_FAMILIAR_S = 1.0
_MOST = 5.0  # largest doubt, as a multiple of that of a lost animal
_FORGIVES = 0.15  # weight of agreement against that of contradiction
_DOUBTFUL = 0.5  # contradiction from which on walls are not learnt


class Felt(NamedTuple):
    """Walls sensed, by bearing bin: any within reach, and near ones; ``(batch, n)`` each."""

    any: Tensor
    near: Tensor


def felt_walls(distance_m: Tensor, bearing_rad: Tensor, reach_m: float, n_bearings: int) -> Felt:
    """Sort walls into bins of bearing.

    Args:
        distance_m: ``(batch, n_walls)``; ``inf`` for none.
        bearing_rad: In the world, the same shape.
        reach_m: Largest distance at which a wall is sensed.
        n_bearings: Number of bins over the full turn.

    Example:
        >>> felt = felt_walls(torch.tensor([[0.2, 0.1]]), torch.tensor([[0.0, 3.14]]), 0.3, 4)
        >>> felt.any.tolist(), felt.near.tolist()
        ([[1.0, 0.0, 1.0, 0.0]], [[0.0, 0.0, 1.0, 0.0]])
    """
    bins = (bearing_rad * (n_bearings / TWO_PI)).round().long().remainder(n_bearings)
    none = distance_m.new_zeros(len(distance_m), n_bearings)
    return Felt(
        none.scatter_reduce(1, bins, (distance_m < reach_m).to(none), "amax"),
        none.scatter_reduce(1, bins, (distance_m < SURE * reach_m).to(none), "amax"),
    )


@compiled
def compare_step(
    winner: int, distance_m: np.ndarray, bearing_rad: np.ndarray, error_rad: float,
    against: float, supports: bool, dt_s: float, reach_m: float, lost_after_s: float,
    felt_s: np.ndarray, time_s: np.ndarray, doubt_s: np.ndarray, lost: np.ndarray,
    slack: np.ndarray,
) -> None:  # fmt: skip
    """Do as :meth:`Familiarity.forward` for one animal, in place.

    The walls' bearings are those in the world, and have the compass error ``error_rad`` yet.
    """
    n, cell = slack.shape[0], max(winner, 0)
    felt = np.zeros((2, n), np.float32)
    for w in range(distance_m.shape[0]):
        k = round((bearing_rad[w] - error_rad) * (n / TWO_PI)) % n
        away = np.float32(distance_m[w])
        if away < np.float32(reach_m):
            felt[0, k] = 1.0
        if away < np.float32(SURE * reach_m):
            felt[1, k] = 1.0
    time = time_s[0, cell]
    total = max(time, np.float32(1e-9))
    differs = False
    for i in range(n):
        ever = around = np.float32(0.0)
        for k in range(n):
            ever += felt_s[0, cell, 0, k] / total * slack[k, i]
            around += felt[0, k] * slack[k, i]
        differs |= felt[1, i] > 0.0 and ever < np.float32(_NEVER)
        always = felt_s[0, cell, 1, i] / total
        differs |= always > np.float32(_ALWAYS) and around == 0.0
    differs &= time > np.float32(_FAMILIAR_S) and winner >= 0
    contradicted = np.float32(max(against, 1.0 if differs else 0.0))
    agrees = (np.float32(1.0) - contradicted) * np.float32(supports)
    doubt = doubt_s[0] + np.float32(dt_s) * (contradicted - np.float32(_FORGIVES) * agrees)
    doubt_s[0] = min(max(doubt, np.float32(0.0)), np.float32(_MOST * lost_after_s))
    lost[0] = doubt_s[0] > (0.0 if lost[0] else np.float32(lost_after_s))
    if winner >= 0 and contradicted < np.float32(_DOUBTFUL) and not lost[0]:
        time_s[0, cell] += np.float32(dt_s)
        for side in range(2):
            for k in range(n):
                felt_s[0, cell, side, k] += felt[side, k] * np.float32(dt_s)


class Familiarity(BufferModule):
    r"""Learns which walls are sensed at each place cell, and detects contradictions.

    Walls contradict if one is near where none ever was, or missing where one always was, or not
    where it was remembered: the doubt ``doubt_s`` grows by the time, times the weight of a wall's
    absence (:func:`~neuroslam.cells.walls.absence_weight`). It decreases, more slowly,
    while a wall known for long is where it should be, for many walls fit by chance. Without known
    or sensed walls it stays. An animal is ``lost`` from when its doubt exceeds ``lost_after_s``
    until it is 0. State: seconds of each place cell with each bearing (``felt_s``) and in all
    (``time_s``); the doubt.

    Args:
        config: Of the boundary cells.
        lost_after_s: Doubt of an animal that is lost.
        batch: Number of animals side by side, or ``None`` for one.
    """

    felt_s: Tensor
    time_s: Tensor
    doubt_s: Tensor
    lost: Tensor
    slack: Tensor

    def __init__(
        self, config: BoundaryCellConfig, lost_after_s: float, batch: int | None = None
    ) -> None:
        super().__init__()
        self.config = config
        self.lost_after_s = lost_after_s
        self.batch = batch
        b, n = batch or 1, config.n_bearings
        self.register_buffer("felt_s", torch.zeros(b, 64, 2, n))
        self.register_buffer("time_s", torch.zeros(b, 64))
        self.register_buffer("doubt_s", torch.zeros(b))
        self.register_buffer("lost", torch.zeros(b, dtype=torch.bool))
        apart = (torch.arange(n)[:, None] - torch.arange(n)).abs()
        near = torch.minimum(apart, n - apart) <= _SLACK_BINS
        self.register_buffer("slack", near.float(), persistent=False)
        self.register_load_state_dict_pre_hook(_take_capacity)

    @without_gradients
    def forward(
        self,
        winner: Tensor,
        distance_m: Tensor,
        bearing_rad: Tensor,
        evidence: tuple[Tensor, Tensor],
        dt_s: float,
    ) -> Tensor:
        """Compare the walls with those known at the place cell; return which animals are lost.

        Args:
            winner: Number of the winning place cell, ``(batch or 1,)``; -1 for none.
            distance_m: Distances to walls, ``(batch or 1, n_walls)``; ``inf`` for none.
            bearing_rad: Their bearings in the world, the same shape.
            evidence: Against and for the estimated position, of
                :meth:`~neuroslam.cells.walls.WallMemory.evidence`.
            dt_s: Time since the last call.
        """
        self._make_room(int(winner.max()))
        c = self.config
        felt = felt_walls(distance_m.to(self.felt_s), bearing_rad, c.reach_m, c.n_bearings)
        rows, cell = torch.arange(len(winner), device=winner.device), winner.clamp_min(0)
        time = self.time_s[rows, cell]
        share = self.felt_s[rows, cell] / time.clamp_min(1e-9)[:, None, None]
        ever, always = share.unbind(1)
        new = (felt.near * ((ever @ self.slack) < _NEVER)).amax(-1)
        missing = ((always > _ALWAYS) * ((felt.any @ self.slack) == 0)).amax(-1)
        known = (time > _FAMILIAR_S) & (winner >= 0)
        against, supports = evidence
        differs = (torch.maximum(new, missing) > 0) & known
        contradicted = torch.maximum(against.to(time), differs.to(time))
        agrees = (1.0 - contradicted) * supports.to(time)
        doubt = self.doubt_s + dt_s * (contradicted - _FORGIVES * agrees)
        self.doubt_s = doubt.clamp(0.0, _MOST * self.lost_after_s)
        self.lost = torch.where(
            self.lost,
            self.doubt_s > 0.0,
            self.doubt_s > self.lost_after_s,
        )
        sure = ((contradicted < _DOUBTFUL) & (winner >= 0) & ~self.lost).to(time) * dt_s
        self.time_s[rows, cell] = time + sure
        self.felt_s[rows, cell] += torch.stack(felt, dim=1) * sure[:, None, None]
        return self.lost

    @property
    def is_lost(self) -> bool:
        """Whether one animal is lost."""
        return bool(self.lost[0])

    def compare_compiled(
        self, winner: int, distance_m: np.ndarray, bearing_rad: np.ndarray, error_rad: float,
        evidence: Sequence[float], dt_s: float,
    ) -> None:  # fmt: skip
        """Do as :meth:`forward` for one animal, by bearings not less the compass error."""
        self._make_room(winner)
        against, supports = float(evidence[0]), bool(evidence[1])
        compare_step(
            winner, distance_m, bearing_rad, error_rad, against, supports, dt_s,
            self.config.reach_m, self.lost_after_s, *cast(Arrays, self.arrays()),
        )  # fmt: skip

    def n_activated(self) -> Tensor:
        """Count, for each animal, pairs of a place cell and a boundary cell active at it."""
        return (self.felt_s[:, :, 0] > 0).sum((1, 2))

    def reset_doubt(self) -> None:
        """Reset the doubt: the position is known again."""
        self.doubt_s, self.lost = torch.zeros_like(self.doubt_s), torch.zeros_like(self.lost)

    def _make_room(self, cell: int) -> None:
        if cell >= self.time_s.shape[1]:
            more = max(self.time_s.shape[1], cell + 1 - self.time_s.shape[1])
            self.time_s = torch.nn.functional.pad(self.time_s, (0, more))
            self.felt_s = torch.nn.functional.pad(self.felt_s, (0, 0, 0, 0, 0, more))


def _take_capacity(
    module: torch.nn.Module, state: dict[str, Tensor], prefix: str, *_unused: object
) -> None:
    for name in ("felt_s", "time_s"):
        saved = state.get(prefix + name)
        if saved is not None and len(saved) == len(getattr(module, name)):
            setattr(module, name, getattr(module, name).new_empty(saved.shape))
