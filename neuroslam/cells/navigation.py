"""SLRB: boundary cells, grid cells and place cells composed; motion and walls in, a place out."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from neuroslam.cells.boundary import BoundaryCells, check_walls
from neuroslam.cells.familiarity import Familiarity
from neuroslam.cells.grid import LAHNGridCells
from neuroslam.cells.oscillators import VelocityOscillators
from neuroslam.cells.place import CompetitiveHebbianPlaceCells
from neuroslam.cells.walls import WallMemory, check_motion
from neuroslam.config import BrainConfig
from neuroslam.population import Running
from neuroslam.storage import Scalars

FAMILIARITY_PERIOD_S = 0.5
"""Time between looks at whether a place is what it was."""


class Whereabouts(NamedTuple):
    """What the navigation cells say after a step.

    Attributes:
        position_m: Position since the start, ``([batch,] 2)``.
        correction_m: By how much walls corrected it just now, ``([batch,] 2)``.
        place: Number of the place cell that wins, ``([batch])``.
        recruited: Whether that cell is new.
        lost: Whether walls contradict what is known of the place, ``([batch])``.
    """

    position_m: Tensor
    correction_m: Tensor
    place: Tensor
    recruited: Tensor
    lost: Tensor


class NavigationCells(Running):
    """Boundary, grid and place cells of an animal that knows its motion and the walls around.

    Self-motion turns the oscillators' phases, whose pattern the grid cells tell; walls correct the
    phases of all modules by one displacement; place cells compete for the grid's pattern. Who is
    lost goes on by self-motion, and learns nothing until it knows where it is.

    Args:
        config: Of the brain; the sections ``boundary_cells``, ``grid_cells``, ``place_cells`` and
            ``wall_memory`` are used.
        batch: Number of animals side by side, or ``None`` for one.

    Example:
        >>> cells = NavigationCells(BrainConfig())
        >>> none = torch.empty(0)
        >>> here = cells(torch.tensor(0.2), torch.tensor(0.0), 0.5, none, none)
        >>> [round(x, 6) for x in here.position_m.tolist()], here.place.item()
        ([0.1, 0.0], 0)
    """

    def __init__(self, config: BrainConfig, batch: int | None = None) -> None:
        super().__init__()
        self.config = config
        self.batch = batch
        self.boundary = BoundaryCells(config.boundary_cells, batch)
        self.oscillators = VelocityOscillators(config.grid_cells, batch)
        self.grid = LAHNGridCells(config.grid_cells, batch)
        self.place = CompetitiveHebbianPlaceCells(
            config.place_cells, self.grid.rates.shape[-2:].numel(), batch
        )
        self.walls = WallMemory(config.wall_memory, batch)
        self.familiarity = Familiarity(
            config.boundary_cells, config.wall_memory.lost_after_s, batch
        )
        self.now = Scalars(since_s=0.0, someone_lost=0)

    def forward(
        self,
        speed_m_s: Tensor,
        heading_rad: Tensor,
        dt_s: float,
        wall_m: Tensor,
        wall_bearing_rad: Tensor,
        *,
        compass: bool = True,
    ) -> Whereabouts:
        """Take in a step of motion and the walls at its end.

        Args:
            speed_m_s: Measured speed, ``([batch])``.
            heading_rad: Measured heading in the world, ``([batch])``.
            dt_s: For how long.
            wall_m: Distance to the foot of the perpendicular on each wall,
                ``([batch,] n_walls)``, nearest first; ``inf`` where there is none.
            wall_bearing_rad: Its bearing relative to the heading, the same shape.
            compass: The heading is measured; else it is integrated from turns.

        Raises:
            BadFrame: If a number is not finite or a distance negative; nothing has changed then.
        """
        bearing = wall_bearing_rad + heading_rad.unsqueeze(-1)
        total = float((speed_m_s + heading_rad + bearing.sum(-1)).sum())
        nearest = float(wall_m.min()) if wall_m.numel() else math.inf
        if not math.isfinite(total) or not nearest >= 0.0:
            check_motion(speed_m_s, heading_rad)
            check_walls(wall_m, wall_bearing_rad)
        memory, oscillators, now = self.walls, self.oscillators, self.now
        lost = self.familiarity.lost
        learns = ~lost if now.someone_lost else None
        if nearest <= self.config.boundary_cells.reach_m:
            self.boundary.respond(wall_m, bearing, dt_s)
        else:
            self.boundary.rest()
        step = memory.move(speed_m_s, heading_rad, dt_s)
        correction = torch.zeros_like(step)
        if nearest < math.inf and memory.is_due and self.config.wall_memory.corrects:
            believed = oscillators.decode() + step
            correction = memory.look(believed, wall_m, bearing, compass=compass, learns=learns)
            step = step + correction
        grid = self.grid(oscillators.shift(step))
        place = self.place(grid.flatten(-2), oscillators.position_m, dt_s, learns=learns)
        now.since_s += dt_s
        if now.since_s >= FAMILIARITY_PERIOD_S:
            felt = (wall_m, bearing) if self.batch is not None else (wall_m[None], bearing[None])
            lost = self.familiarity(
                self.place.winner, felt[0], felt[1] - memory.errors[:, 1:], now.since_s
            )
            now.since_s, now.someone_lost = 0.0, int(lost.any())
        return Whereabouts(
            oscillators.position_m,
            correction,
            place.winner,
            place.recruited,
            lost if self.batch is not None else lost[0],
        )
