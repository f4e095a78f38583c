"""Common parts of the experiments with rats: tracks, simulation of navigation cells, errors."""

from collections.abc import Callable, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from neuroslam.cells.navigation import NavigationCells
from neuroslam.cells.navigation_state import NavigationEstimate
from neuroslam.config import BrainConfig
from neuroslam.errors import ConfigError, MapError
from neuroslam.evaluation.trajectory import absolute_trajectory_error
from neuroslam.worlds.arena import Arena
from neuroslam.worlds.rodent import Walk, read_walk
from neuroslam.worlds.senses import SenseNoise, Senses, sense

TRACKS = {
    "triangle": "simulated_triangle.npz",
    "pentagon": "simulated_pentagon.npz",
    "nonagon": "simulated_nonagon.npz",
    "hafting": "hafting2005_circle2m.npz",
    "sargolini": "sargolini2006_circle1m.npz",
}
"""Name -> recording: RatInABox agents in polygons, and two real rats in circles."""

RECTANGLE = "tanni"
"""A rat in a rectangle of 2.5 x 3.5 m (Tanni et al. 2022), which RatInABox brings along."""

RATE_HZ = 20.0
_EDGE_M = 0.01  # nearest that a rat comes to the wall of the rectangle
WALLS = 2  # that an animal senses at once, at most: those of a corner

Hook = Callable[[int, NavigationEstimate, NavigationCells], object]
"""Called after every step with its number, the estimate, and the cells."""


class Simulation(NamedTuple):
    """A simulation of navigation cells on a walk, one animal for each seed of the noise.

    Attributes:
        walk: The true motion.
        senses: The sensor data.
        estimate_m: Estimated positions in the world, ``(seeds, steps, 2)``.
        lost: Whether the animal is lost, ``(seeds, steps)``.
        cells: The cells at the end.
    """

    walk: Walk
    senses: Senses
    estimate_m: np.ndarray
    lost: np.ndarray
    cells: NavigationCells


def arena_of(walk: Walk) -> Arena:
    """Return the arena of a walk.

    Raises:
        MapError: If the walk has none.
    """
    if walk.arena is None:
        raise MapError("walk: has no arena; read a recording with vertices or arena_radius")
    return walk.arena


class Errors(NamedTuple):
    """Errors of position in metres, one for each seed.

    Attributes:
        mean_m: Mean distance to the truth, without alignment.
        rmse_m: RMSE without alignment.
        aligned_m: RMSE after rigid alignment (ATE).
    """

    mean_m: np.ndarray
    rmse_m: np.ndarray
    aligned_m: np.ndarray


def read_track(data: Path, name: str, minutes: float = 30.0) -> Walk:
    """Read one of ``TRACKS``, or ``RECTANGLE``, at 20 Hz; a short recording is run to and fro.

    Args:
        data: Folder of the recordings.
        name: Name of the track.
        minutes: Duration; at most that of the recording for ``sargolini``.

    Raises:
        ConfigError: If RatInABox, which has the recording ``RECTANGLE``, is not installed.
    """
    if name == RECTANGLE:
        return _rat_in_a_rectangle().lasting(minutes)
    walk = read_walk(data / TRACKS[name], rate_hz=RATE_HZ)
    return walk.lasting(min(minutes, walk.duration_s / 60) if name == "sargolini" else minutes)


def has_rectangle() -> bool:
    """Return whether the recording ``RECTANGLE`` is installed, with the extra ``rodent``."""
    return find_spec("ratinabox") is not None


def _rat_in_a_rectangle() -> Walk:
    found = find_spec("ratinabox")
    if found is None or found.origin is None:
        raise ConfigError(f"{RECTANGLE}: comes with RatInABox; pip install neuroslam[rodent]")
    walk = read_walk(Path(found.origin).parent / "data" / f"{RECTANGLE}.npz", rate_hz=RATE_HZ)
    # Of a camera above: the head leans over the wall by up to 4 cm.
    inside = walk.positions.clip([_EDGE_M, _EDGE_M], [3.5 - _EDGE_M, 2.5 - _EDGE_M])
    arena = Arena([(0.0, 0.0), (3.5, 0.0), (3.5, 2.5), (0.0, 2.5)], name=RECTANGLE)
    return Walk.along(RECTANGLE, walk.times_s, inside, arena)


def simulate(
    walk: Walk,
    seeds: Sequence[int],
    config: BrainConfig | None = None,
    noise: SenseNoise | None = None,
    hook: Hook | None = None,
) -> Simulation:
    """Simulate a batch of animals on a walk, each with its own noise.

    Args:
        walk: A walk in an arena.
        seeds: Seed of the noise of each animal.
        config: Config of the cells; ``None``: the defaults.
        noise: Noise of the senses; ``None``: the defaults.
        hook: Called after every step.
    """
    senses = sense(walk, noise or SenseNoise(), seeds, k=WALLS)
    steps = len(senses.time_s)
    estimate = np.empty((steps, len(seeds), 2))
    lost = np.empty((steps, len(seeds)), dtype=bool)

    def note(i: int, here: NavigationEstimate, cells: NavigationCells) -> None:
        estimate[i], lost[i] = here.position_m.numpy(), here.lost.numpy()
        if hook is not None:
            hook(i, here, cells)

    cells = run_cells(senses, config or BrainConfig(), note)
    return Simulation(
        walk, senses, np.moveaxis(estimate, 1, 0) + walk.positions[0], lost.T.copy(), cells
    )


def run_cells(senses: Senses, config: BrainConfig, hook: Hook) -> NavigationCells:
    """Run navigation cells on sensor data and return them in their final state."""
    cells = NavigationCells(config, batch=len(senses.speed_m_s))
    columns = [
        torch.from_numpy(np.ascontiguousarray(np.moveaxis(column, 1, 0)))
        for column in (senses.speed_m_s, senses.heading_rad, senses.wall_m, senses.wall_bearing_rad)
    ]
    with torch.inference_mode():
        for i, dt_s in enumerate(senses.dt_s.tolist()):
            speed, heading, wall, bearing = (column[i] for column in columns)
            hook(i, cells(speed, heading, dt_s, wall, bearing), cells)
    return cells


def run_one(
    senses: Senses, animal: int, config: BrainConfig, hook: Hook, every: int = 1
) -> NavigationCells:
    """Run the cells of one animal of several, by compiled steps; return them in their final state.

    Args:
        senses: Sensor data.
        animal: Its row.
        config: Of the brain.
        hook: Called after every step.
        every: Walls are looked for at every ``every``-th step, not at the others.
    """
    cells = NavigationCells(config)
    columns = [
        torch.from_numpy(np.ascontiguousarray(column[animal]))
        for column in (senses.speed_m_s, senses.heading_rad, senses.wall_m, senses.wall_bearing_rad)
    ]
    with torch.inference_mode():
        for i, (dt_s, *felt) in enumerate(zip(senses.dt_s.tolist(), *columns, strict=True)):
            speed, heading, wall, bearing = felt
            sensed = (i + 1) % every == 0
            hook(i, cells(speed, heading, dt_s, wall, bearing, sensed=sensed), cells)
    return cells


def path_integration(senses: Senses) -> np.ndarray:
    """Return dead-reckoned positions from the true start, ``(seeds, steps, 2)``."""
    steps = senses.speed_m_s * senses.dt_s
    heading = np.stack([np.cos(senses.heading_rad), np.sin(senses.heading_rad)], axis=-1)
    return np.asarray(senses.position_m[0] + np.cumsum(steps[..., None] * heading, axis=1))


def position_errors(estimate_m: np.ndarray, truth_m: np.ndarray) -> Errors:
    """Return the errors of tracks, ``(seeds, steps, 2)``, against the truth, ``(steps, 2)``."""
    distance = np.linalg.norm(estimate_m - truth_m, axis=-1)
    aligned = [absolute_trajectory_error(one, truth_m, "rigid").rmse for one in estimate_m]
    return Errors(
        distance.mean(axis=1), np.sqrt(np.square(distance).mean(axis=1)), np.array(aligned)
    )
