"""Cells of this package as ``Neurons`` of RatInABox (George et al. 2024); extra ``rodent``.

An agent of RatInABox drives them, and its plots show them::

    cells = GridNeurons(agent)
    for _ in range(6000):
        agent.update(), cells.update()
    cells.plot_rate_map(chosen_neurons="4")

The rates are those of the package, scaled so that a cell's peak is ``max_fr``. What the cells know
of the animal is its motion (and the walls around it), not its position: ``update`` integrates the
path from the position at which they were made. The ground truth, ``evaluate_at="all"`` or
``pos=...``, is what cells at rest at a position fire.
"""

import copy
import math
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from neuroslam.cells.boundary import BoundaryCells, boundary_tuning
from neuroslam.cells.grid import LAHNGridCells
from neuroslam.cells.head_direction import HeadDirectionCells, HeadDirectionConfig, bump_at
from neuroslam.cells.oscillators import VelocityOscillators
from neuroslam.cells.place import CompetitiveHebbianPlaceCells, place_response
from neuroslam.config import BoundaryCellConfig, GridCellConfig, PlaceCellConfig
from neuroslam.errors import ConfigError
from neuroslam.geometry import wrap_angle
from neuroslam.threads import limit_threads
from neuroslam.types import Motion
from neuroslam.worlds.environment import arena_of_environment

try:
    from ratinabox.Neurons import Neurons  # pyright: ignore[reportMissingImports]
except ImportError as error:
    raise ConfigError(
        f"RatInABox cannot be imported ({error}); pip install neuroslam[rodent]"
    ) from None

Params = dict[str, Any]

_CHUNK = 2048  # positions of the ground truth at once
_WEAKEST = 1e-6  # peak below which a cell is silent in the environment


class CellsOfAgent(Neurons):
    """What the populations share: when to advance, the scale of the rates, and the ground truth.

    A subclass makes its cells, advances them by a step of the agent, and evaluates them at
    positions.
    """

    default_params: ClassVar[Params] = {"n": 1, "name": "cells", "config": None}
    n: int  # attributes that RatInABox makes of the parameters
    min_fr: float
    max_fr: float

    def __init__(self, Agent: Any, params: Params | None = None) -> None:  # noqa: N803, ANN401 - as RatInABox names it
        self.params = copy.deepcopy(__class__.default_params)
        self.params.update(params or {})
        super().__init__(Agent, self.params)
        self._time_s = float(Agent.t)
        self._at = np.array(Agent.pos, np.float64)
        self._now = np.zeros(self.n)

    def get_state(self, evaluate_at: str | None = "agent", **kwargs: Any) -> np.ndarray:  # noqa: ANN401
        """Return firing rates in Hz, ``(n, positions)``.

        Args:
            evaluate_at: ``agent``: of the agent now; ``all``: at every position of the
                environment; ``None``: at ``pos``.
            **kwargs: ``pos``, ``(positions, 2)``; ``head_direction``, a vector.
        """
        with limit_threads(1):  # fastest for so few cells
            rates = self._rates(evaluate_at, kwargs)
        return self.min_fr + (self.max_fr - self.min_fr) * rates

    def _rates(self, evaluate_at: str | None, kwargs: Params) -> np.ndarray:
        """Return rates as shares of the peak, ``(n, positions)``."""
        if evaluate_at == "agent":
            if self.Agent.t != self._time_s:
                position = np.array(self.Agent.pos, np.float64)
                self._now = self._advance(position, float(self.Agent.t) - self._time_s)
                self._at, self._time_s = position, float(self.Agent.t)
            return self._now[:, None]
        every = self.Agent.Environment.flattened_discrete_coords
        at = every if evaluate_at == "all" else np.reshape(kwargs["pos"], (-1, 2))
        chunks = range(0, len(at), _CHUNK)
        return np.concatenate([self._truth(at[k : k + _CHUNK], kwargs) for k in chunks]).T

    def _advance(self, position_m: np.ndarray, dt_s: float) -> np.ndarray:
        """Advance to a position of the agent; return the rates as shares of the peak, ``(n,)``."""
        raise NotImplementedError

    def _truth(self, positions_m: np.ndarray, kwargs: Params) -> np.ndarray:
        """Return the rates at rest at positions, as shares of the peak, ``(positions, n)``."""
        raise NotImplementedError


class BoundaryNeurons(CellsOfAgent):
    """:class:`~neuroslam.cells.boundary.BoundaryCells`: distance and bearing of the walls in reach.

    Cells are ordered by bearing, then by distance. Their common activity grows near a wall and
    falls farther off; the ground truth is their tuning at full activity.

    Args:
        Agent: The agent, in a solid environment of two dimensions.
        params: ``config``, a :class:`BoundaryCellConfig`; those of ``ratinabox.Neurons``.
    """

    default_params: ClassVar[Params] = {"name": "BoundaryNeurons", "config": None}

    def __init__(self, Agent: Any, params: Params | None = None) -> None:  # noqa: N803, ANN401
        params = {**copy.deepcopy(__class__.default_params), **(params or {})}
        config = params["config"] or BoundaryCellConfig()
        self.cells = BoundaryCells(config)
        self.arena = arena_of_environment(Agent.Environment)
        super().__init__(Agent, {**params, "n": config.n_bearings * config.n_distances})

    def _walls(self, positions_m: np.ndarray) -> tuple[Tensor, Tensor]:
        found = self.arena.walls_near(positions_m, self.cells.config.reach_m)
        distance_m, bearing_rad = (torch.from_numpy(part).float() for part in found)
        return distance_m, bearing_rad

    @torch.no_grad()
    def _advance(self, position_m: np.ndarray, dt_s: float) -> np.ndarray:
        distance_m, bearing_rad = self._walls(position_m[None])
        return self.cells(distance_m[0], bearing_rad[0], dt_s).flatten().numpy()

    @torch.no_grad()
    def _truth(self, positions_m: np.ndarray, kwargs: Params) -> np.ndarray:
        c = self.cells
        tuning = c.preferred_m, c.preferred_rad, c.sigma_m, c.beta_m, c.sigma_rad
        return boundary_tuning(*self._walls(positions_m), *tuning).flatten(-2).numpy()


class GridNeurons(CellsOfAgent):
    """:class:`~neuroslam.cells.grid.LAHNGridCells` on the oscillators that integrate the path.

    Cells are ordered by module; the scale of each is its largest rate in the environment.

    Args:
        Agent: The agent, in a solid environment of two dimensions.
        params: ``config``, a :class:`GridCellConfig`; those of ``ratinabox.Neurons``.
    """

    default_params: ClassVar[Params] = {"name": "GridNeurons", "config": None}

    def __init__(self, Agent: Any, params: Params | None = None) -> None:  # noqa: N803, ANN401
        params = {**copy.deepcopy(__class__.default_params), **(params or {})}
        config = params["config"] or GridCellConfig()
        arena_of_environment(Agent.Environment)  # what the cells cannot map is refused
        self.oscillators, self.cells = VelocityOscillators(config), LAHNGridCells(config)
        self.oscillators.place_at(torch.from_numpy(np.array(Agent.pos, np.float64)))
        self._peak = np.ones(self.cells.rates.numel())
        super().__init__(Agent, {**params, "n": self.cells.rates.numel()})
        with limit_threads(1):
            peak = self._rates("all", {}).max(axis=1)
        self._peak = np.where(peak > _WEAKEST, peak, np.inf)

    @torch.no_grad()
    def _advance(self, position_m: np.ndarray, dt_s: float) -> np.ndarray:
        phases = self.oscillators.shift(torch.from_numpy(position_m - self._at))
        return self.cells(phases).flatten().numpy() / self._peak

    @torch.no_grad()
    def _truth(self, positions_m: np.ndarray, kwargs: Params) -> np.ndarray:
        phases = self.oscillators.phases_at(torch.from_numpy(positions_m))
        return self.cells.settled(phases).flatten(-2).numpy() / self._peak


class PlaceNeurons(CellsOfAgent):
    """:class:`~neuroslam.cells.place.CompetitiveHebbianPlaceCells`, recruited while exploring.

    A cell that is not recruited yet fires at ``min_fr``; after ``n`` cells no more are recruited.

    Args:
        Agent: The agent, in a solid environment of two dimensions.
        params: ``n``, the most cells; ``config``, a :class:`PlaceCellConfig`; ``grid_config``, a
            :class:`GridCellConfig`; those of ``ratinabox.Neurons``.
    """

    default_params: ClassVar[Params] = {
        "n": 400,
        "name": "PlaceNeurons",
        "config": None,
        "grid_config": None,
    }

    def __init__(self, Agent: Any, params: Params | None = None) -> None:  # noqa: N803, ANN401
        params = {**copy.deepcopy(__class__.default_params), **(params or {})}
        config = params["config"] or PlaceCellConfig()
        arena_of_environment(Agent.Environment)
        grid = params["grid_config"] or GridCellConfig()
        self.oscillators, self.grid = VelocityOscillators(grid), LAHNGridCells(grid)
        self.oscillators.place_at(torch.from_numpy(np.array(Agent.pos, np.float64)))
        self.cells = CompetitiveHebbianPlaceCells(config, self.grid.rates.numel())
        super().__init__(Agent, params)

    @property
    def n_recruited(self) -> int:
        """Number of cells recruited so far."""
        return int(self.cells.n_cells)

    @torch.no_grad()
    def _advance(self, position_m: np.ndarray, dt_s: float) -> np.ndarray:
        step = torch.from_numpy(position_m - self._at)
        grid = self.grid(self.oscillators.shift(step)).flatten()
        learns = None if self.n_recruited < self.n else torch.tensor([False])
        self.cells(grid, self.oscillators.position_m, dt_s, learns=learns)
        rates = np.zeros(self.n)
        response = self.cells.responses(grid, self.oscillators.position_m)
        rates[: len(response)] = response.numpy()
        return rates

    @torch.no_grad()
    def _truth(self, positions_m: np.ndarray, kwargs: Params) -> np.ndarray:
        at, n, c = torch.from_numpy(positions_m), self.n_recruited, self.cells
        grid = self.grid.settled(self.oscillators.phases_at(at)).flatten(-2)
        grid = torch.nn.functional.normalize(grid, dim=-1)
        weights, centres = c.state_dict()["weights"][0, :n], c.centres_m[0, :n]
        away = (centres - at.unsqueeze(1)).square().sum(-1).to(grid)
        response = place_response(weights, away, grid, c.config.power, c.config.continuity_m)
        rates = np.zeros((len(at), self.n))
        rates[:, :n] = response.numpy()
        return rates


class HeadDirectionNeurons(CellsOfAgent):
    """:class:`~neuroslam.cells.head_direction.HeadDirectionCells`, which integrate turns.

    Args:
        Agent: The agent, in an environment of two dimensions.
        params: ``config``, a :class:`HeadDirectionConfig`; those of ``ratinabox.Neurons``.
    """

    default_params: ClassVar[Params] = {"name": "HeadDirectionNeurons", "config": None}

    def __init__(self, Agent: Any, params: Params | None = None) -> None:  # noqa: N803, ANN401
        params = {**copy.deepcopy(__class__.default_params), **(params or {})}
        if Agent.Environment.dimensionality != "2D":
            raise ConfigError(
                f"HeadDirectionNeurons: the environment is {Agent.Environment.dimensionality}; "
                "expected 2D"
            )
        self.cells = HeadDirectionCells(params["config"] or HeadDirectionConfig())
        self._facing = _angle(Agent.head_direction)
        self.cells.set_heading(self._facing)
        super().__init__(Agent, {**params, "n": self.cells.config.n})

    def _advance(self, position_m: np.ndarray, dt_s: float) -> np.ndarray:
        facing = _angle(self.Agent.head_direction)
        turn = wrap_angle(facing - self._facing)
        self._facing = facing
        self.cells.advance(Motion(0.0, turn / dt_s, dt_s))
        return self.cells.activity.numpy() / self.cells.ring.peak

    def _truth(self, positions_m: np.ndarray, kwargs: Params) -> np.ndarray:
        facing = _angle(kwargs.get("head_direction", self.Agent.head_direction))
        bump = bump_at(self.cells.ring, facing).numpy() / self.cells.ring.peak
        return np.tile(bump, (len(positions_m), 1))


def _angle(direction: Any) -> float:  # noqa: ANN401 - an agent that has not moved has none
    return 0.0 if direction is None else math.atan2(direction[1], direction[0])
