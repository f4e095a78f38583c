r"""Memory of walls: remembered boundary vectors, and the correction of the position by them.

A wall measures the position *perpendicular* to it, and nothing along it (Hardcastle et al. 2015).
The memory of a wall segment is a boundary vector: the position of the animal (the anchor), and
bearing and distance of the wall from there. An extended Kalman filter estimates the position, the
errors of self-motion and the remembered distances together: a wall sensed early, before much drift,
weighs more than one sensed late, and the constant errors of speed and compass are learnt too.
"""

import math
from typing import cast

import numpy as np
import torch
from torch import Tensor

from neuroslam.cells import wall_table
from neuroslam.cells.boundary_vectors import Wall, wall_innovation, wrap
from neuroslam.cells.wall_table import OWN, WallTable
from neuroslam.compiled import compiled
from neuroslam.config import BrainConfig, WallMemoryConfig
from neuroslam.geometry import TWO_PI
from neuroslam.state.mergeable import Arrays, without_gradients

SAMPLE_S = 0.05
"""Correlation time of random errors of speed and heading, whatever the frame rate."""

_OLD_S = 60.0  # only memories older than this tell whether the animal is lost
_CHANCE = 0.565  # share of the walls sensed where they are that a lost animal meets by chance
_SURELY = 0.99  # largest probability of detection that is assumed
_PRIOR, _ALL_PRIOR = 2.0, 4.0  # comparisons that the shares of a wall and of all begin with
_ABREAST = 0.2  # share of a segment within which the wall must still be sensed
_ALIKE_RAD = math.radians(25.0)

# Numbers of the config that the compiled steps take.
_SHARE, _ADDED, _SLOW_S, _SLOW_RAD2, _SIGMA2, _SIGMA_RAD, _GATE2, _WIDTH2, _FOUR_SPREADS = range(9)
_UNKNOWN_M2 = wall_table.UNKNOWN_M2
_DONE, _NEEDS_ROW, _NEEDS_SLOT = -1, 0, 1  # of :func:`correct_step`


@compiled
def absence_weight(due: float, met: float, all_due: float, all_met: float) -> float:
    r"""Return how strongly the absence of a wall contradicts the position, 0 to 1.

    .. math:: w = \frac{\Lambda(h)}{\Lambda(0.99)}, \qquad
              \Lambda(h) = \ln \frac{1 - c h}{1 - h}, \qquad h = \frac{m + 2 g}{n + 2}

    the log-likelihood ratio of not sensing the wall: a lost animal senses it with probability
    :math:`c h`, by chance, one that is not lost with :math:`h`. That was learnt in the first minute
    of the wall, in which drift is small: :math:`m` of :math:`n` comparisons, and :math:`g` of all
    walls. A wall that was read wrongly from one noisy scan is never sensed again, and says nothing.

    Args:
        due: :math:`n`, comparisons at which the wall should have been sensed.
        met: :math:`m`, those at which it was.
        all_due: The same of all walls.
        all_met: The same of all walls.

    Example:
        >>> absence_weight(8, 8, 100, 100), round(absence_weight(4, 0, 100, 80), 3)
        (1.0, 0.039)
    """
    of_all = (all_met + _ALL_PRIOR) / (all_due + _ALL_PRIOR)
    share = min((met + _PRIOR * of_all) / (due + _PRIOR), _SURELY)
    most = math.log((1.0 - _CHANCE * _SURELY) / (1.0 - _SURELY))
    return math.log((1.0 - _CHANCE * share) / (1.0 - share)) / most


@compiled
def _wrapped(angle_rad: float) -> float:
    """Do as :func:`~neuroslam.cells.boundary_vectors.wrap`."""
    return (angle_rad + math.pi) % TWO_PI - math.pi


@compiled
def move_step(
    speed_m_s: float, heading_rad: float, dt_s: float,
    errors: np.ndarray, moved_m: np.ndarray, squares_m2: np.ndarray,
) -> tuple[float, float]:  # fmt: skip
    """Do as :meth:`WallMemory.move` for one animal, in place; return the displacement."""
    length = speed_m_s * (dt_s - dt_s * errors[0, 0])
    heading = heading_rad - errors[0, 1]
    dx, dy = length * math.cos(heading), length * math.sin(heading)
    moved_m[0, 0] += dx
    moved_m[0, 1] += dy
    if dt_s > 0.0:
        squares_m2[0] += length * length * (SAMPLE_S / dt_s)
    return dx, dy


@compiled
def predict_step(
    since_s: float, compass: bool, numbers: np.ndarray,
    covariance: np.ndarray, errors: np.ndarray, moved_m: np.ndarray, squares_m2: np.ndarray,
) -> None:  # fmt: skip
    """Do as ``WallMemory._predict`` for one animal, in place; all but the time."""
    p, n = covariance[0], covariance.shape[1]
    dx, dy = moved_m[0, 0], moved_m[0, 1]
    a, b = dx / (errors[0, 0] - 1.0), dy / (errors[0, 0] - 1.0)
    spread = numbers[_SHARE] * squares_m2[0] + numbers[_ADDED] * since_s
    for j in range(n):
        p[0, j] += a * p[2, j] + dy * p[3, j]
        p[1, j] += b * p[2, j] - dx * p[3, j]
    for i in range(n):
        p[i, 0] += p[i, 2] * a + p[i, 3] * dy
        p[i, 1] += p[i, 2] * b - p[i, 3] * dx
    p[0, 0] += spread
    p[1, 1] += spread
    stays = math.exp(-since_s / numbers[_SLOW_S])
    if compass:
        for j in range(n):
            p[3, j] *= stays
        for i in range(n):
            p[i, 3] *= stays
        errors[0, 1] *= stays
    p[3, 3] += numbers[_SLOW_RAD2] * (1.0 - stays * stays)
    moved_m[0, 0] = moved_m[0, 1] = squares_m2[0] = 0.0


@compiled
def _apply_step(
    change: np.ndarray, errors: np.ndarray, walls: np.ndarray, active: np.ndarray
) -> None:
    """Do as ``WallMemory._apply_change`` for one animal, in place."""
    errors[0, 0] += change[2]
    errors[0, 1] += change[3]
    for slot in range(active.shape[1]):
        if active[0, slot] >= 0:
            walls[0, active[0, slot], 3] += change[OWN + slot]


@compiled
def _mismatch(
    walls: np.ndarray, k: int, x_m: float, y_m: float, bearing_rad: float, scale: np.ndarray
) -> float:
    """Do as :func:`~neuroslam.cells.boundary_vectors.squared_mismatch` for one wall."""
    dx, dy = walls[0, k, 0] - x_m, walls[0, k, 1] - y_m
    turn = _wrapped(walls[0, k, 2] - bearing_rad) / scale[1]
    return (dx * dx + dy * dy) / (scale[0] * scale[0]) + turn * turn


@compiled
def _recalled(
    x_m: float, y_m: float, distance_m: float, bearing_rad: float,
    learns: bool, time_s: float, most: int, walls: np.ndarray, n_walls: np.ndarray,
    active: np.ndarray, covariance: np.ndarray, scale: np.ndarray,
) -> tuple[int, int]:  # fmt: skip
    """Do as ``WallTable._recall``; return the slot, and which table must grow first."""
    n, wall, least = n_walls[0], -1, np.inf
    for k in range(n):
        cost, is_active = _mismatch(walls, k, x_m, y_m, bearing_rad, scale), False
        for slot in range(active.shape[1]):
            is_active |= active[0, slot] == k
        if not is_active and cost < least:
            wall, least = k, cost
    new = least >= 1.0
    if new and not learns:
        return -1, _DONE
    if new and n == walls.shape[1]:
        return -1, _NEEDS_ROW
    free, width = -1, active.shape[1]
    for slot in range(width):
        if active[0, slot] < 0:
            free = slot
            break
    if free < 0 and width < most:
        return -1, _NEEDS_SLOT
    if new:
        wall = n
        walls[0, wall, 0], walls[0, wall, 1] = x_m, y_m
        walls[0, wall, 2], walls[0, wall, 3] = bearing_rad, distance_m
        walls[0, wall, 4], walls[0, wall, 5] = _UNKNOWN_M2, time_s
        walls[0, wall, 6] = walls[0, wall, 7] = 0.0
        n_walls[0] = n + 1
    if free < 0:
        farthest = -1.0
        for slot in range(width):
            dx, dy = walls[0, active[0, slot], 0] - x_m, walls[0, active[0, slot], 1] - y_m
            if dx * dx + dy * dy > farthest:
                free, farthest = slot, dx * dx + dy * dy
        for slot in range(width):
            walls[0, active[0, slot], 4] = covariance[0, OWN + slot, OWN + slot]
    for j in range(covariance.shape[1]):
        covariance[0, OWN + free, j] = covariance[0, j, OWN + free] = 0.0
    covariance[0, OWN + free, OWN + free] = walls[0, wall, 4]
    active[0, free] = wall
    return free, _DONE


@compiled
def _correct(
    residual: float, variance: float, n: int, moves: np.ndarray, change: np.ndarray,
    p: np.ndarray, errors: np.ndarray, walls: np.ndarray, active: np.ndarray,
    position_m: np.ndarray,
) -> None:  # fmt: skip
    """Correct state and covariance, in place, by a residual whose covariance is ``moves``."""
    for j in range(n):
        change[j] = moves[j] / variance
    for i in range(n):
        for j in range(n):
            p[i, j] -= change[i] * moves[j]
    for j in range(n):
        change[j] *= residual
    _apply_step(change, errors, walls, active)
    position_m[0] += change[0]
    position_m[1] += change[1]


@compiled
def correct_step(
    first: int, position_m: np.ndarray, distance_m: np.ndarray, bearing_rad: np.ndarray,
    compass: bool, learns: bool, time_s: float, most: int, numbers: np.ndarray,
    walls: np.ndarray, n_walls: np.ndarray, active: np.ndarray, covariance: np.ndarray,
    errors: np.ndarray, scale: np.ndarray, rejected: np.ndarray, accepted: np.ndarray,
) -> tuple[int, int]:  # fmt: skip
    """Do as ``WallMemory._correct_by_wall`` for the walls of one animal, in place.

    ``first`` is the number of the first wall of those at ``distance_m`` and ``bearing_rad`` in the
    world; ``position_m``, ``(2,)``, is corrected; ``most`` is the largest number of active walls.

    Returns:
        Number of the wall at which a table must grow, and which one; the step continues there.
    """
    p, n = covariance[0], covariance.shape[1]
    change, moves = np.empty(n), np.empty(n)
    for w in range(first, distance_m.shape[0]):
        distance = distance_m[w]
        if not np.isfinite(distance):
            break
        x, y = position_m[0], position_m[1]
        bearing = bearing_rad[w] - errors[0, 1]
        slot, least = 0, np.inf
        for k in range(active.shape[1]):
            if active[0, k] >= 0:
                cost = _mismatch(walls, active[0, k], x, y, bearing, scale)
                if cost < least:
                    slot, least = k, cost
        if least >= 1.0:
            slot, needs = _recalled(
                x, y, distance, bearing, learns, time_s, most, walls, n_walls, active, covariance,
                scale,
            )  # fmt: skip
            if needs != _DONE:
                return w, needs
            if slot < 0:
                continue
        elif not compass:
            wall = active[0, slot]
            half = _wrapped(bearing - walls[0, wall, 2]) / 2
            middle = walls[0, wall, 2] + half
            nx, ny = math.cos(middle) / math.cos(half), math.sin(middle) / math.cos(half)
            lever = (walls[0, wall, 1] - y) * nx - (walls[0, wall, 0] - x) * ny
            share = lever / numbers[_FOUR_SPREADS]
            variance = p[3, 3] + numbers[_WIDTH2] + share * share
            turn = _wrapped(bearing - walls[0, wall, 2])
            for j in range(n):
                moves[j] = p[3, j]
            _correct(turn, variance, n, moves, change, p, errors, walls, active, position_m)
            x, y, bearing = position_m[0], position_m[1], bearing - change[3]
        wall, row = active[0, slot], OWN + slot
        half = _wrapped(bearing - walls[0, wall, 2]) / 2
        middle = walls[0, wall, 2] + half
        nx, ny = math.cos(middle) / math.cos(half), math.sin(middle) / math.cos(half)
        dx, dy = walls[0, wall, 0] - x, walls[0, wall, 1] - y
        off = distance - walls[0, wall, 3] - dx * nx - dy * ny
        half = 0.5 * (dy * nx - dx * ny)
        for j in range(n):
            moves[j] = p[row, j] - nx * p[0, j] - ny * p[1, j] - half * p[3, j]
        white = half * numbers[_SIGMA_RAD]
        variance = (
            moves[row] - nx * moves[0] - ny * moves[1] - half * moves[3]
            + numbers[_SIGMA2] + white * white
        )  # fmt: skip
        if not off * off < numbers[_GATE2] * variance:
            rejected[0] = True
            continue
        if time_s - walls[0, wall, 5] > _OLD_S:
            accepted[0] = True
        _correct(off, variance, n, moves, change, p, errors, walls, active, position_m)
    return -1, _DONE


@compiled
def evidence_step(
    position_m: np.ndarray, distance_m: np.ndarray, bearing_rad: np.ndarray, sure_m: float,
    time_s: float, walls: np.ndarray, n_walls: np.ndarray, active: np.ndarray, scale: np.ndarray,
    rejected: np.ndarray, accepted: np.ndarray, errors: np.ndarray,
) -> tuple[float, bool]:  # fmt: skip
    """Do as :meth:`WallMemory.evidence` for one animal; bearings have the compass error yet."""
    against = 1.0 if rejected[0] else 0.0
    all_due = all_met = 0.0
    for k in range(n_walls[0]):
        all_due += walls[0, k, 6]
        all_met += walls[0, k, 7]
    for slot in range(active.shape[1]):
        k = active[0, slot]
        if k < 0:
            continue
        dx, dy = walls[0, k, 0] - position_m[0], walls[0, k, 1] - position_m[1]
        nx, ny = math.cos(walls[0, k, 2]), math.sin(walls[0, k, 2])
        expected = walls[0, k, 3] + dx * nx + dy * ny
        if not abs(dy * nx - dx * ny) < _ABREAST * scale[0] or not 0.0 < expected < sure_m:
            continue
        met = False
        for w in range(distance_m.shape[0]):
            turn = _wrapped(bearing_rad[w] - errors[0, 1] - walls[0, k, 2])
            met |= abs(turn) < _ALIKE_RAD and abs(distance_m[w] - expected) < 0.5 * sure_m
        if time_s - walls[0, k, 5] <= _OLD_S:
            walls[0, k, 6] += 1.0
            walls[0, k, 7] += 1.0 if met else 0.0
        elif not met:
            weight = absence_weight(walls[0, k, 6], walls[0, k, 7], all_due, all_met)
            against = max(against, weight)
    supports = accepted[0] and against < 1.0
    rejected[0] = accepted[0] = False
    return against, supports


def walls_around(
    wall: Wall, position_m: Tensor, config: BrainConfig, most: int = 3
) -> tuple[Tensor, Tensor]:
    """Return the remembered walls that an animal would sense at some positions.

    Of all segments with a similar bearing (within 25°) the one remembered nearest counts; a segment
    extends ``wall_memory.spread_m`` to either side of where it was sensed.

    Args:
        wall: All remembered segments, as columns ``(w,)``.
        position_m: Positions, ``(t, 2)``.
        config: Of the brain.
        most: Largest number of walls at a position.

    Returns:
        Distances and bearings in the world, ``(t, most)``; ``inf`` and 0 where there is none.
    """
    n = len(position_m)
    found = position_m.new_full((n, most), math.inf), position_m.new_zeros(n, most)
    if not len(wall.x_m):
        return found
    dx, dy = wall.x_m - position_m[:, :1], wall.y_m - position_m[:, 1:]
    nx, ny = wall.bearing_rad.cos(), wall.bearing_rad.sin()
    distance = wall.distance_m + dx * nx + dy * ny
    abreast = (dy * nx - dx * ny).abs() <= config.wall_memory.spread_m
    reach = config.boundary_cells.reach_m
    free = abreast & (distance >= 0.0) & (distance <= reach)
    away, rows = dx.square() + dy.square(), torch.arange(n, device=position_m.device)
    for k in range(most):
        best = away.where(free, math.inf).argmin(1)
        there = free[rows, best]
        found[0][:, k] = distance[rows, best].where(there, math.inf)
        found[1][:, k] = wall.bearing_rad[best].where(there, 0.0)
        apart = wrap(wall.bearing_rad - wall.bearing_rad[best].unsqueeze(1)).abs()
        free = free & (apart > _ALIKE_RAD) & there.unsqueeze(1)
    return found


class WallMemory(WallTable):
    """Remembered walls of an animal, its position error, and the errors of its self-motion.

    :func:`~neuroslam.cells.boundary_vectors.wall_innovation` has the geometry. State: that
    of :class:`~neuroslam.cells.wall_table.WallTable`, the learnt errors of speed and compass
    (``errors``), and the motion since the last correction.

    Args:
        config: Noise of motion and senses, extent of a wall segment.
        batch: Number of animals side by side, or ``None`` for one.

    Example:
        >>> memory = WallMemory(WallMemoryConfig(period_s=0.0))
        >>> at, wall = torch.zeros(2), (torch.tensor([0.2]), torch.tensor([0.0]))
        >>> memory.update_from_walls(at, *wall).tolist(), memory.n_walls.item()  # a new wall
        ([0.0, 0.0], 1)
        >>> moved = memory.move(torch.tensor(0.1), torch.tensor(0.0), dt_s=0.5)
        >>> memory.update_from_walls(at + moved, *wall)[0].item() < 0  # as far as before
        True
    """

    errors: Tensor
    moved_m: Tensor
    squares_m2: Tensor
    rejected: Tensor
    accepted: Tensor

    def __init__(self, config: WallMemoryConfig, batch: int | None = None) -> None:
        super().__init__(batch)
        self.config = config
        b, kind = batch or 1, torch.float64
        self.register_buffer("errors", torch.zeros(b, 2, dtype=kind))
        self.register_buffer("moved_m", torch.zeros(b, 2, dtype=kind))
        self.register_buffer("squares_m2", torch.zeros(b, dtype=kind))
        scale = torch.tensor([config.spread_m, math.radians(config.spread_deg)], dtype=kind)
        self.register_buffer("scale", scale)
        self.register_buffer("rejected", torch.zeros(b, dtype=torch.bool))
        self.register_buffer("accepted", torch.zeros(b, dtype=torch.bool))
        variances = [0.0, 0.0, config.speed_scale**2, math.radians(config.heading_slow_deg) ** 2]
        self.covariance[:] = torch.diag(torch.tensor(variances, dtype=kind))
        c, sigma_rad = config, math.radians(config.sigma_deg)
        share = 0.5 * (c.speed_factor**2 + math.radians(c.heading_white_deg) ** 2)
        added, slow_rad = 0.5 * c.speed_add_m_s**2 * SAMPLE_S, math.radians(c.heading_slow_deg)
        self._numbers = np.array([
            share, added, c.heading_slow_s, slow_rad**2, c.sigma_m**2, sigma_rad, c.gate**2,
            (2.0 * sigma_rad) ** 2, 4.0 * c.spread_m,
        ])  # fmt: skip

    @property
    def position_variance_m2(self) -> Tensor:
        """Covariance of the position, ``(batch or 1, 2, 2)``, at the last correction."""
        return self.covariance[:, :2, :2].clone()

    @property
    def expected_variance_m2(self) -> Tensor:
        """Covariance of the position now, grown by the motion since the last correction."""
        p, (lever, spread) = self.covariance, self._spreading()
        across = lever @ p[:, 2:4, :2]
        own = lever @ p[:, 2:4, 2:4] @ lever.mT
        added = torch.diag_embed(spread.unsqueeze(-1).expand(-1, 2))
        return p[:, :2, :2] + across + across.mT + own + added

    @property
    def is_due(self) -> bool:
        """Whether ``period_s`` has passed since the last correction, so that errors differ."""
        return self.since.s >= self.config.period_s - 1e-9

    @without_gradients
    def move(self, speed_m_s: Tensor, heading_rad: Tensor, dt_s: float) -> Tensor:
        """Return the displacement in the world, ``([batch,] 2)``, less the learnt errors.

        Args:
            speed_m_s: Measured speed, ``([batch])``.
            heading_rad: Measured heading, ``([batch])``.
            dt_s: Duration of the motion.
        """
        speed_m_s, heading_rad = speed_m_s.to(self.errors), heading_rad.to(self.errors)
        scale, compass = self.errors.unbind(-1)
        length = speed_m_s * (dt_s - dt_s * scale)
        step = torch.view_as_real(torch.polar(length, heading_rad - compass))
        self.moved_m = self.moved_m + step
        if dt_s > 0.0:
            self.squares_m2 = self.squares_m2 + length * length * (SAMPLE_S / dt_s)
        self.since.s += dt_s
        self.since.time_s += dt_s
        return step if self.batch is not None else step[0]

    @without_gradients
    def update_from_walls(
        self,
        position_m: Tensor,
        distance_m: Tensor,
        bearing_rad: Tensor,
        *,
        compass: bool = True,
        learns: Tensor | None = None,
    ) -> Tensor:
        """Correct the position by the walls in sight, and remember new ones.

        Args:
            position_m: Estimated position, ``([batch,] 2)``.
            distance_m: Distance to the foot of the perpendicular on each wall, nearest first,
                ``([batch,] n_walls)``; ``inf`` where there is none.
            bearing_rad: Its bearing in the world: measured heading plus bearing relative to it.
            compass: Whether the heading is measured, with a bounded error; else it is integrated.
            learns: Which animals remember new walls, ``(batch or 1,)``; ``None``: all.

        Returns:
            Correction of the position in metres, ``([batch,] 2)``.
        """
        one = self.batch is None
        position = (position_m[None] if one else position_m).to(self.errors)
        if not self.is_due or not bool(distance_m.isfinite().any()):
            return torch.zeros_like(position[0] if one else position)
        distance = (distance_m[None] if one else distance_m).to(self.errors)
        bearing = (bearing_rad[None] if one else bearing_rad).to(self.errors)
        self._predict(compass)
        start = position
        for wall in range(distance.shape[-1]):
            seen = distance[:, wall].isfinite()
            if not bool(seen.any()):
                break
            position = self._correct_by_wall(
                position,
                distance[:, wall].where(seen, 0.0),
                bearing[:, wall],
                seen,
                learns,
                compass,
            )
        correction = position - start
        return correction[0] if one else correction

    @without_gradients
    def evidence(
        self, position_m: Tensor, distance_m: Tensor, bearing_rad: Tensor, sure_m: float
    ) -> tuple[Tensor, Tensor]:
        """Return whether the walls contradict the estimated position, and whether they support it.

        Against: since the last call a known wall was rejected by the gate (1), or a wall that must
        be near is not sensed (:func:`absence_weight`). For: a wall known for long was where it
        should be. Walls known for less than a minute are neither: how often they are sensed where
        they should be is learnt from them.

        Args:
            position_m: Estimated positions, ``(batch or 1, 2)``.
            distance_m: Distances to walls, ``(batch or 1, n_walls)``; ``inf`` for none.
            bearing_rad: Their bearings in the world, the same shape.
            sure_m: Distance within which a wall is always sensed.

        Returns:
            Against, 0 to 1, and for, boolean, ``(batch or 1,)`` each.
        """
        against, supports = self.rejected.to(self.errors), self.accepted
        if self.active.shape[1]:
            at = self.active.clamp_min(0).unsqueeze(-1).expand(-1, -1, self.walls.shape[-1])
            wall = Wall(*self.walls.gather(1, at).unbind(-1))
            dx, dy = wall.x_m - position_m[:, :1], wall.y_m - position_m[:, 1:]
            nx, ny = wall.bearing_rad.cos(), wall.bearing_rad.sin()
            expected = wall.distance_m + dx * nx + dy * ny
            abreast = (dy * nx - dx * ny).abs() < _ABREAST * self.scale[0]
            old = self.since.time_s - wall.made_s > _OLD_S
            due = abreast & (self.active >= 0) & (expected > 0) & (expected < sure_m)
            slack = 0.5 * sure_m
            alike = (wrap(bearing_rad.unsqueeze(1) - wall.bearing_rad.unsqueeze(2)).abs()
                     < _ALIKE_RAD)  # fmt: skip
            near = (distance_m.unsqueeze(1) - expected.unsqueeze(2)).abs() < slack
            met = (alike & near).any(-1)
            weight = self._absence_weight(wall)
            against = torch.maximum(against, weight.where(due & old & ~met, 0.0).amax(-1))
            counts = torch.stack([due & ~old, due & ~old & met], -1).to(self.walls)
            walls = self.walls.clone()
            walls[..., 6:8].scatter_add_(1, at[..., :2], counts)
            self.walls = walls
        self.rejected = torch.zeros_like(self.rejected)
        self.accepted = torch.zeros_like(self.accepted)
        return against, supports & (against < 1.0)

    def _absence_weight(self, wall: Wall) -> Tensor:
        """Do as :func:`absence_weight` for the active walls of all animals."""
        in_use = torch.arange(self.walls.shape[1], device=self.walls.device) < self.n_walls[:, None]
        totals = (self.walls[..., 6:8] * in_use.unsqueeze(-1)).sum(1, keepdim=True)
        of_all = (totals[..., 1] + _ALL_PRIOR) / (totals[..., 0] + _ALL_PRIOR)
        share = ((wall.met + _PRIOR * of_all) / (wall.due + _PRIOR)).clamp_max(_SURELY)
        most = math.log((1.0 - _CHANCE * _SURELY) / (1.0 - _SURELY))
        return ((1.0 - _CHANCE * share) / (1.0 - share)).log() / most

    @without_gradients
    def observe_position(self, position_m: Tensor, measured_m: Tensor, sigma_m: float) -> Tensor:
        """Correct the position by a measurement of it, as by a view.

        Args:
            position_m: Estimated position, ``([batch,] 2)``.
            measured_m: Measured position, the same shape.
            sigma_m: Standard deviation of the measurement.

        Returns:
            Correction of the position, ``([batch,] 2)``.
        """
        self._predict(compass=True)
        off = (measured_m - position_m).to(self.errors).reshape(-1, 2)
        p = self.covariance
        spread = p[:, :2, :2] + sigma_m**2 * torch.eye(2, dtype=p.dtype, device=p.device)
        gain = torch.linalg.solve(spread, p[:, :2, :]).mT
        change = (gain @ off.unsqueeze(-1)).squeeze(-1)
        self.covariance = p - gain @ p[:, :2, :]
        self._apply_change(change)
        correction = change[:, :2]
        return correction[0] if self.batch is None else correction

    @without_gradients
    def forget_position(self, sigma_m: float) -> None:
        """Set the standard deviation of the position to ``sigma_m``, as after relocalisation."""
        fresh = self.covariance.clone()
        fresh[:, :2, :] = 0.0
        fresh[:, :, :2] = 0.0
        fresh[:, 0, 0] = fresh[:, 1, 1] = sigma_m**2
        self.covariance = fresh
        self.reset_motion()

    def move_compiled(
        self, speed_m_s: float, heading_rad: float, dt_s: float
    ) -> tuple[float, float]:
        """Do as :meth:`move` for one animal, in place; return the displacement."""
        arrays = cast(Arrays, self.arrays())
        since = self.since.__dict__
        since["s"] += dt_s
        since["time_s"] += dt_s
        return move_step(speed_m_s, heading_rad, dt_s, *arrays[4:7])

    def update_compiled(
        self, position_m: np.ndarray, distance_m: np.ndarray, bearing_rad: np.ndarray,
        *, compass: bool, learns: bool,
    ) -> None:  # fmt: skip
        """Do as :meth:`update_from_walls` for one animal that is due; correct the position.

        Args:
            position_m: Estimated position, ``(2,)``; corrected in place.
            distance_m: Distances, ``(n,)``, the first finite.
            bearing_rad: Bearings in the world, ``(n,)``.
            compass: Whether the heading is measured.
            learns: Whether new walls are remembered.
        """
        walls, n_walls, active, covariance, errors, moved, squares, scale, rejected, accepted = (
            cast(Arrays, self.arrays())
        )
        predict_step(self.since.s, compass, self._numbers, covariance, errors, moved, squares)
        self.since.s = 0.0
        first, needs = 0, _DONE
        while first >= 0:
            if needs == _NEEDS_ROW:
                self._add_rows()
            elif needs == _NEEDS_SLOT:
                self._add_slots()
            walls, n_walls, active, covariance, *_ = cast(Arrays, self.arrays())
            first, needs = correct_step(
                first, position_m, distance_m, bearing_rad, compass, learns, self.since.time_s,
                wall_table.ACTIVE, self._numbers, walls, n_walls, active, covariance, errors, scale,
                rejected, accepted,
            )  # fmt: skip

    def evidence_compiled(
        self, position_m: np.ndarray, distance_m: np.ndarray, bearing_rad: np.ndarray, sure_m: float
    ) -> tuple[float, bool, float]:
        """Do as :meth:`evidence` for one animal, by bearings not less the compass error.

        Returns:
            Against and for, and the compass error.
        """
        walls, n_walls, active, _, errors, _, _, scale, rejected, accepted = cast(
            Arrays, self.arrays()
        )
        against, supports = evidence_step(
            position_m, distance_m, bearing_rad, sure_m, self.since.time_s, walls, n_walls, active,
            scale, rejected, accepted, errors,
        )  # fmt: skip
        return against, supports, errors[0, 1]

    def reset_motion(self) -> None:
        """Reset the motion since the last correction."""
        self.moved_m = torch.zeros_like(self.moved_m)
        self.squares_m2 = torch.zeros_like(self.squares_m2)
        self.since.s = 0.0

    def _predict(self, compass: bool) -> None:
        r"""Predict the covariance after the motion since the last correction.

        .. math:: P \leftarrow F P F^\top + Q, \qquad
                  F = I + \Big[-\tfrac{d}{1 - s},\; d^\perp\Big]
                  \text{ from speed and compass error to position}

        with :math:`d` the displacement; :math:`Q` is the covariance of the random errors, taken
        as isotropic. The compass error decays with its correlation time; that of an integrated
        heading does not decay.
        """
        c, p = self.config, self.covariance  # edited in place: it is the largest part by far
        dt_s = self.since.s
        lever, spread = self._spreading()
        p[:, :2, :] += lever @ p[:, 2:4, :]
        p[:, :, :2] += p[:, :, 2:4] @ lever.mT
        p[:, 0, 0] += spread
        p[:, 1, 1] += spread
        stays = math.exp(-dt_s / c.heading_slow_s)
        if compass:
            p[:, 3, :] *= stays
            p[:, :, 3] *= stays
            self.errors = self.errors * self.errors.new_tensor([1.0, stays])
        p[:, 3, 3] += math.radians(c.heading_slow_deg) ** 2 * (1.0 - stays * stays)
        self.reset_motion()

    def _spreading(self) -> tuple[Tensor, Tensor]:
        """Return the derivative of position by speed and compass error, and the added variance."""
        c, d = self.config, self.moved_m
        lever = torch.stack(
            [d / (self.errors[:, :1] - 1.0), d.flip(-1) * d.new_tensor([1.0, -1.0])], dim=-1
        )
        share = 0.5 * (c.speed_factor**2 + math.radians(c.heading_white_deg) ** 2)
        added = 0.5 * c.speed_add_m_s**2 * SAMPLE_S * self.since.s
        return lever, share * self.squares_m2 + added

    def _correct_by_wall(
        self,
        position: Tensor,
        distance: Tensor,
        bearing: Tensor,
        seen: Tensor,
        learns: Tensor | None,
        compass: bool,
    ) -> Tensor:
        """Correct the position by one wall for each animal that senses one."""
        c = self.config
        rows = torch.arange(len(position), device=position.device)
        bearing = bearing - self.errors[:, 1]
        slot, known = self._find(position, bearing)
        if not compass and bool((seen & known).any()):
            change = self._correct_heading(position, bearing, slot, seen & known)
            position, bearing = position + change[:, :2], bearing - change[:, 3]
        missing = seen & ~known
        if bool(missing.any()):
            slot, known = self._recall(position, distance, bearing, slot, known, missing, learns)
        use = seen & known
        if not bool(use.any()):
            return position
        wall = Wall(*self.walls[rows, self.active[rows, slot].clamp_min(0)].unbind(-1))
        off, normal, lever = wall_innovation(position, distance, bearing, wall)
        p = self.covariance
        half = 0.5 * lever
        moves = (
            p[rows, OWN + slot] - normal[:, :1] * p[:, 0] - normal[:, 1:] * p[:, 1]
            - half.unsqueeze(-1) * p[:, 3]
        )  # fmt: skip
        variance = (
            moves[rows, OWN + slot] - normal[:, 0] * moves[:, 0] - normal[:, 1] * moves[:, 1]
            - half * moves[:, 3] + c.sigma_m**2 + (half * math.radians(c.sigma_deg)).square()
        )  # fmt: skip
        fits = off.square() < c.gate**2 * variance
        old = self.since.time_s - wall.made_s > _OLD_S
        self.rejected = self.rejected | (use & ~fits)
        self.accepted = self.accepted | (use & fits & old)
        use = use & fits
        gain = (moves / variance.unsqueeze(-1)).where(use.unsqueeze(-1), 0.0)
        change = gain * off.unsqueeze(-1)
        torch.baddbmm(p, gain.unsqueeze(-1), moves.unsqueeze(-2), alpha=-1.0, out=p)
        self._apply_change(change)
        return position + change[:, :2]

    def _correct_heading(
        self, position: Tensor, bearing: Tensor, slot: Tensor, use: Tensor
    ) -> Tensor:
        r"""Learn the error of an integrated heading from the bearings of known walls.

        .. math:: \nu = \alpha - \alpha_m

        A straight wall has the bearing that was remembered; a curved one differs at most by the
        lever over four times ``spread_m``.

        Returns:
            The change of position, errors and distances, ``(batch, n)``.
        """
        rows = torch.arange(len(position), device=position.device)
        wall = Wall(*self.walls[rows, self.active[rows, slot].clamp_min(0)].unbind(-1))
        _, _, lever = wall_innovation(position, torch.zeros_like(bearing), bearing, wall)
        c, p = self.config, self.covariance
        width = 2.0 * math.radians(c.sigma_deg)
        variance = p[:, 3, 3] + width**2 + (lever / (4.0 * c.spread_m)).square()
        gain = (p[:, 3] / variance.unsqueeze(-1)).where(use.unsqueeze(-1), 0.0)
        change = gain * wrap(bearing - wall.bearing_rad).unsqueeze(-1)
        heading = p[:, 3].clone()
        torch.baddbmm(p, gain.unsqueeze(-1), heading.unsqueeze(-2), alpha=-1.0, out=p)
        self._apply_change(change)
        return change

    def _apply_change(self, change: Tensor) -> None:
        """Apply a change of the state to the learnt errors and the remembered distances."""
        self.errors = self.errors + change[:, 2:OWN]
        at = self.active.clamp_min(0)
        column = Wall._fields.index("distance_m")
        if at.shape[1]:
            more = change[:, OWN:].where(self.active >= 0, 0.0)
            walls = self.walls.clone()
            walls[..., column] = walls[..., column].scatter_add(1, at, more)
            self.walls = walls
