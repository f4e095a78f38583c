r"""Memory of walls: remembered boundary vectors, and the correction of the position by them.

A wall tells where the animal is *perpendicular* to it, and nothing along it (Hardcastle et al.
2015). What is remembered of a stretch of wall is a boundary vector: where the animal was (the
anchor), the bearing and the distance of the wall from there. Position, errors of self-motion and
remembered distances have a common Gaussian belief (an extended Kalman filter over walls), so that a
wall seen early, while little had drifted, counts for more than one seen late, and the constant
errors of speed and compass are learnt from walls too.
"""

import math

import torch
from torch import Tensor

from neuroslam.cells.boundary_vectors import Wall, squared_mismatch, wall_innovation, wrap
from neuroslam.config import WallMemoryConfig
from neuroslam.errors import BadFrame
from neuroslam.state.mergeable import BufferModule, without_gradients
from neuroslam.state.tables import Scalars

OWN = 4
"""First rows of the covariance: position x and y, share of the speed too much, compass error."""

ACTIVE = 96
"""Walls, the nearest ones, whose errors are known to go together; more are kept besides."""

SAMPLE_S = 0.05
"""Time for which an error of speed or heading lasts; its effect does not depend on the rate."""

_OLD_S = 60.0  # memories at least so old say whether an animal knows its way
_ABREAST = 0.2  # of a stretch of wall: so near to where it was met that it must be there still
_ALIKE_RAD = math.radians(25.0)
_UNKNOWN_M2 = 1.0  # variance of a distance before it was measured


class WallMemory(BufferModule):
    """Remembered walls of an animal, and its belief about its own errors.

    :func:`~neuroslam.cells.boundary_vectors.wall_innovation` has the geometry. The state is
    complete: all remembered walls (``walls``, ``n_walls``), which of them are active
    (``active``), the covariance, the learnt errors of speed and compass (``errors``), and the
    motion since the last look.

    Args:
        config: Noise of motion and senses, what is one wall.
        batch: Number of animals side by side, or ``None`` for one.

    Example:
        >>> memory = WallMemory(WallMemoryConfig(period_s=0.0))
        >>> at, wall = torch.zeros(2), (torch.tensor([0.2]), torch.tensor([0.0]))
        >>> memory.look(at, *wall).tolist(), memory.n_walls.item()  # a new wall corrects nothing
        ([0.0, 0.0], 1)
        >>> moved = memory.move(torch.tensor(0.1), torch.tensor(0.0), dt_s=0.5)
        >>> memory.look(at + moved, *wall)[0].item() < 0  # the wall is as far as before
        True
    """

    walls: Tensor
    n_walls: Tensor
    active: Tensor
    covariance: Tensor
    errors: Tensor
    moved_m: Tensor
    squares_m2: Tensor
    scale: Tensor
    rejected: Tensor
    accepted: Tensor

    def __init__(self, config: WallMemoryConfig, batch: int | None = None) -> None:
        super().__init__()
        self.config = config
        self.batch = batch
        b, kind = batch or 1, {"dtype": torch.float64}
        self.register_buffer("walls", torch.zeros(b, 0, len(Wall._fields), **kind))
        self.register_buffer("n_walls", torch.zeros(b, dtype=torch.int64))
        self.register_buffer("active", torch.full((b, 0), -1))
        self.register_buffer("covariance", torch.zeros(b, OWN, OWN, **kind))
        self.register_buffer("errors", torch.zeros(b, 2, **kind))
        self.register_buffer("moved_m", torch.zeros(b, 2, **kind))
        self.register_buffer("squares_m2", torch.zeros(b, **kind))
        scale = torch.tensor([config.spread_m, math.radians(config.spread_deg)], **kind)
        self.register_buffer("scale", scale)  # within which a wall is one: m, rad
        self.register_buffer("rejected", torch.zeros(b, dtype=torch.bool))
        self.register_buffer("accepted", torch.zeros(b, dtype=torch.bool))
        self.since = Scalars(s=0.0, time_s=0.0)
        variances = [0.0, 0.0, config.speed_scale**2, math.radians(config.heading_slow_deg) ** 2]
        self.covariance[:] = torch.diag(torch.tensor(variances, **kind))
        self.register_load_state_dict_pre_hook(_take_sizes)

    @property
    def position_variance_m2(self) -> Tensor:
        """Covariance of the position, ``(batch or 1, 2, 2)``, as of the last look."""
        return self.covariance[:, :2, :2].clone()

    @property
    def expected_variance_m2(self) -> Tensor:
        """The same, with what the motion since then has added."""
        p, (lever, spread) = self.covariance, self._spreading()
        across = lever @ p[:, 2:4, :2]
        own = lever @ p[:, 2:4, 2:4] @ lever.mT
        added = torch.diag_embed(spread.unsqueeze(-1).expand(-1, 2))
        return p[:, :2, :2] + across + across.mT + own + added

    @property
    def is_due(self) -> bool:
        """Whether enough time went by since the last look for a new one to tell something."""
        return self.since.s >= self.config.period_s - 1e-9

    def remembered(self) -> list[Wall]:
        """Return all walls of each animal, as columns."""
        return [
            Wall(*rows[:n].unbind(-1))
            for rows, n in zip(self._up_to_date(), self.n_walls.tolist(), strict=True)
        ]

    @without_gradients
    def move(self, speed_m_s: Tensor, heading_rad: Tensor, dt_s: float) -> Tensor:
        """Return the displacement in the world, ``([batch,] 2)``, with the learnt errors taken off.

        Args:
            speed_m_s: Measured speed, ``([batch])``.
            heading_rad: Measured heading, ``([batch])``.
            dt_s: For how long.
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
    def look(
        self,
        position_m: Tensor,
        distance_m: Tensor,
        bearing_rad: Tensor,
        *,
        compass: bool = True,
        learns: Tensor | None = None,
    ) -> Tensor:
        """Take in the walls around; returns by how much the position is corrected.

        Args:
            position_m: Where the animal believes to be, ``([batch,] 2)``.
            distance_m: Distance to the foot of the perpendicular on each wall, nearest first,
                ``([batch,] n_walls)``; ``inf`` where there is none.
            bearing_rad: Its bearing in the world as measured: heading plus bearing from it.
            compass: The heading is measured, so its error stays bounded; else it is integrated.
            learns: Who remembers walls that are new, ``(batch or 1,)``; ``None``: all.

        Returns:
            Displacement in metres, ``([batch,] 2)``.
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
            position = self._meet(
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
        """Say whether what is felt speaks against where the animal believes to be, or for it.

        Against: a known wall was not where it should be since the last call, or one is not felt
        that must be near. For: a wall that was long known was where it should be.

        Args:
            position_m: Where the animals believe to be, ``(batch or 1, 2)``.
            distance_m: Distances to walls, ``(batch or 1, n_walls)``; ``inf`` for none.
            bearing_rad: Their bearings in the world, the same shape.
            sure_m: A nearer wall cannot be overlooked.

        Returns:
            Two truths for each animal, ``(batch or 1,)``.
        """
        against, speaks_for = self.rejected, self.accepted
        if self.active.shape[1]:
            at = self.active.clamp_min(0).unsqueeze(-1).expand(-1, -1, self.walls.shape[-1])
            wall = Wall(*self.walls.gather(1, at).unbind(-1))
            dx, dy = wall.x_m - position_m[:, :1], wall.y_m - position_m[:, 1:]
            nx, ny = wall.bearing_rad.cos(), wall.bearing_rad.sin()
            expected = wall.distance_m + dx * nx + dy * ny
            abreast = (dy * nx - dx * ny).abs() < _ABREAST * self.scale[0]
            old = self.since.time_s - wall.made_s > _OLD_S
            due = abreast & old & (self.active >= 0) & (expected > 0) & (expected < sure_m)
            slack = 0.5 * sure_m
            alike = (wrap(bearing_rad.unsqueeze(1) - wall.bearing_rad.unsqueeze(2)).abs()
                     < _ALIKE_RAD)  # fmt: skip
            near = (distance_m.unsqueeze(1) - expected.unsqueeze(2)).abs() < slack
            against = against | (due & ~(alike & near).any(-1)).any(-1)
        self.rejected = torch.zeros_like(self.rejected)
        self.accepted = torch.zeros_like(self.accepted)
        return against, speaks_for & ~against

    @without_gradients
    def observe_position(self, position_m: Tensor, seen_at_m: Tensor, sigma_m: float) -> Tensor:
        """Take in a position that something else tells, as a view does.

        Args:
            position_m: Where the animal believes to be, ``([batch,] 2)``.
            seen_at_m: Where it is said to be, the same shape.
            sigma_m: Error of that.

        Returns:
            The displacement that corrects the belief, ``([batch,] 2)``.
        """
        self._predict(compass=True)
        off = (seen_at_m - position_m).to(self.errors).reshape(-1, 2)
        p = self.covariance
        spread = p[:, :2, :2] + sigma_m**2 * torch.eye(2, dtype=p.dtype, device=p.device)
        gain = torch.linalg.solve(spread, p[:, :2, :]).mT
        change = (gain @ off.unsqueeze(-1)).squeeze(-1)
        self.covariance = p - gain @ p[:, :2, :]
        self._learn(change)
        correction = change[:, :2]
        return correction[0] if self.batch is None else correction

    @without_gradients
    def forget_position(self, sigma_m: float) -> None:
        """Say that the position is unknown but for ``sigma_m``, as after it was set anew."""
        fresh = self.covariance.clone()
        fresh[:, :2, :] = 0.0
        fresh[:, :, :2] = 0.0
        fresh[:, 0, 0] = fresh[:, 1, 1] = sigma_m**2
        self.covariance = fresh
        self.start_anew()

    def start_anew(self) -> None:
        """Forget the motion since the last look."""
        self.moved_m = torch.zeros_like(self.moved_m)
        self.squares_m2 = torch.zeros_like(self.squares_m2)
        self.since.s = 0.0

    def _predict(self, compass: bool) -> None:
        r"""Let the belief spread by the motion since the last look.

        .. math:: P \leftarrow F P F^\top + Q, \qquad
                  F = I + \Big[-\tfrac{d}{1 - s},\; d^\perp\Big]
                  \text{ from speed and compass error to position}

        with :math:`d` the way moved; :math:`Q` is what each sample's own errors add, taken alike
        along and across. The compass error decays in its time, or, if the heading is integrated,
        does not.
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
        self.start_anew()

    def _spreading(self) -> tuple[Tensor, Tensor]:
        """How errors of speed and compass move the position, and what each sample's own add."""
        c, d = self.config, self.moved_m
        lever = torch.stack(
            [d / (self.errors[:, :1] - 1.0), d.flip(-1) * d.new_tensor([1.0, -1.0])], dim=-1
        )
        share = 0.5 * (c.speed_factor**2 + math.radians(c.heading_white_deg) ** 2)
        added = 0.5 * c.speed_add_m_s**2 * SAMPLE_S * self.since.s
        return lever, share * self.squares_m2 + added

    def _meet(
        self,
        position: Tensor,
        distance: Tensor,
        bearing: Tensor,
        seen: Tensor,
        learns: Tensor | None,
        compass: bool,
    ) -> Tensor:
        """Correct by one wall for each animal that sees one."""
        c = self.config
        rows = torch.arange(len(position), device=position.device)
        bearing = bearing - self.errors[:, 1]
        slot, known = self._find(position, bearing)
        if not compass and bool((seen & known).any()):
            change = self._turn_by(position, bearing, slot, seen & known)
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
        self._learn(change)
        return position + change[:, :2]

    def _turn_by(self, position: Tensor, bearing: Tensor, slot: Tensor, use: Tensor) -> Tensor:
        r"""Learn the error of an integrated heading from the bearings of known walls.

        .. math:: \nu = \alpha - \alpha_m

        A wall is seen under the bearing it was remembered with, but for how it curves along the
        lever: at most by the lever over four times ``spread_m``.

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
        self._learn(change)
        return change

    def _learn(self, change: Tensor) -> None:
        """Change the learnt errors and the remembered distances."""
        self.errors = self.errors + change[:, 2:OWN]
        at = self.active.clamp_min(0)
        column = Wall._fields.index("distance_m")
        if at.shape[1]:
            more = change[:, OWN:].where(self.active >= 0, 0.0)
            walls = self.walls.clone()
            walls[..., column] = walls[..., column].scatter_add(1, at, more)
            self.walls = walls

    def _find(self, position: Tensor, bearing: Tensor) -> tuple[Tensor, Tensor]:
        """Find the active wall that each animal looks at: slot, and whether there is one."""
        if self.active.shape[1] == 0:
            none = torch.zeros(len(position), dtype=torch.int64, device=position.device)
            return none, none.bool()
        at = self.active.clamp_min(0).unsqueeze(-1).expand(-1, -1, self.walls.shape[-1])
        cost = self._unlike(self.walls.gather(1, at), position, bearing)
        least, slot = cost.where(self.active >= 0, math.inf).min(1)
        return slot, least < 1.0

    def _unlike(self, walls: Tensor, position: Tensor, bearing: Tensor) -> Tensor:
        return squared_mismatch(walls, position.unsqueeze(-2), bearing.unsqueeze(-1), self.scale)

    def _recall(
        self, position: Tensor, distance: Tensor, bearing: Tensor,
        slot: Tensor, known: Tensor, missing: Tensor, learns: Tensor | None,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        """Make active what is remembered of the walls that were not found, or remember them."""
        slot, known = slot.clone(), known.clone()
        for row in missing.nonzero()[:, 0].tolist():  # rare: a wall is new, or long not seen
            n = int(self.n_walls[row])
            stored = self.walls[row, :n]
            cost = self._unlike(stored, position[row], bearing[row])
            cost[self.active[row][self.active[row] >= 0]] = math.inf
            wall = int(cost.argmin()) if n else -1
            if n == 0 or cost[wall] >= 1.0:
                if learns is not None and not learns[row]:
                    continue
                wall = n
                new = [*position[row], bearing[row], distance[row]]
                rest = position.new_tensor([_UNKNOWN_M2, self.since.time_s])
                self._remember(row, torch.cat([torch.stack(new), rest]))
            slot[row], known[row] = self._activate(row, wall, position[row]), True
        return slot, known

    def _remember(self, row: int, wall: Tensor) -> None:
        n = int(self.n_walls[row])
        walls = self.walls
        if n == walls.shape[1]:
            walls = torch.cat([walls, walls.new_zeros(len(walls), max(16, n), walls.shape[2])], 1)
        else:
            walls = walls.clone()
        walls[row, n] = wall
        self.walls = walls
        self.n_walls = self.n_walls.clone()
        self.n_walls[row] += 1

    def _activate(self, row: int, wall: int, position: Tensor) -> int:
        """Give a wall a place in the covariance; the farthest one makes room."""
        free = (self.active[row] < 0).nonzero()
        width = self.active.shape[1]
        if len(free):
            slot = int(free[0])
        elif width < ACTIVE:
            slot = width
            more = min(max(16, width), ACTIVE - width)
            self.active = torch.nn.functional.pad(self.active, (0, more), value=-1)
            self.covariance = torch.nn.functional.pad(self.covariance, (0, more, 0, more))
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
        """Return the remembered walls with the variances that the covariance has of them."""
        walls = self.walls.clone()
        row, slot = (self.active >= 0).nonzero(as_tuple=True)
        own = self.covariance.diagonal(dim1=-2, dim2=-1)[:, OWN:]
        walls[row, self.active[row, slot], 4] = own[row, slot]
        return walls


def check_motion(speed_m_s: Tensor, heading_rad: Tensor) -> None:
    """Refuse speeds and headings that are not finite.

    Raises:
        BadFrame: If one is not.

    Example:
        >>> check_motion(torch.tensor(0.1), torch.tensor(float("nan")))
        Traceback (most recent call last):
        neuroslam.errors.BadFrame: motion: speed 0.1 m/s, heading nan rad; expected finite numbers
    """
    finite = speed_m_s.isfinite() & heading_rad.isfinite()
    if not bool(finite.all()):
        speeds, headings = torch.broadcast_tensors(speed_m_s, heading_rad)
        raise BadFrame(
            f"motion: speed {speeds[~finite][0].item():g} m/s, heading "
            f"{headings[~finite][0].item():g} rad; expected finite numbers"
        )


def _take_sizes(
    module: torch.nn.Module, state: dict[str, Tensor], prefix: str, *_unused: object
) -> None:
    for name in ("walls", "active", "covariance"):
        saved = state.get(prefix + name)
        if saved is not None and len(saved) == len(getattr(module, name)):
            setattr(module, name, getattr(module, name).new_empty(saved.shape))
