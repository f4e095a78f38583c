"""What the experiments with rats share: their tracks, lives of navigation cells, and errors."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from neuroslam.cells.navigation import NavigationCells
from neuroslam.cells.navigation_state import NavigationEstimate
from neuroslam.config import BrainConfig
from neuroslam.evaluation.trajectory import absolute_trajectory_error
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

RATE_HZ = 20.0
WALLS = 2  # at most, that an animal feels at once: a corner's

Hook = Callable[[int, NavigationEstimate, NavigationCells], object]
"""Called after every step, with its number, what the cells say, and the cells."""


class Life(NamedTuple):
    """Navigation cells that lived through a walk, one for each seed of the noise.

    Attributes:
        walk: What truly happened.
        senses: What was sensed of it.
        estimate_m: Positions that the cells told, in the world, ``(seeds, steps, 2)``.
        lost: Whether they said that they were lost, ``(seeds, steps)``.
        cells: As they were at the end.
    """

    walk: Walk
    senses: Senses
    estimate_m: np.ndarray
    lost: np.ndarray
    cells: NavigationCells


class Errors(NamedTuple):
    """Errors of position in metres, one for each seed.

    Attributes:
        mean_m: Mean distance to the truth, as it is.
        rmse_m: Root mean square of it.
        aligned_m: Root mean square after rigid alignment, the field's usual ATE.
    """

    mean_m: np.ndarray
    rmse_m: np.ndarray
    aligned_m: np.ndarray


def read_track(data: Path, name: str, minutes: float = 30.0) -> Walk:
    """Read one of ``TRACKS`` at 20 Hz; a shorter recording is run to and fro, but Sargolini's.

    Args:
        data: Folder of the recordings.
        name: Of the track.
        minutes: How long.
    """
    walk = read_walk(data / TRACKS[name], rate_hz=RATE_HZ)
    return walk.lasting(min(minutes, walk.duration_s / 60) if name == "sargolini" else minutes)


def live(
    walk: Walk,
    seeds: Sequence[int],
    config: BrainConfig | None = None,
    noise: SenseNoise | None = None,
    hook: Hook | None = None,
) -> Life:
    """Let a batch of animals live through a walk, each with its own noise.

    Args:
        walk: In an arena.
        seeds: One for each animal.
        config: Of the cells; ``None``: the defaults.
        noise: Of the senses; ``None``: the defaults.
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

    cells = live_with(senses, config or BrainConfig(), note)
    return Life(walk, senses, np.moveaxis(estimate, 1, 0) + walk.positions[0], lost.T.copy(), cells)


def live_with(senses: Senses, config: BrainConfig, hook: Hook) -> NavigationCells:
    """Let navigation cells live through what was sensed; returns them as they are at the end."""
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


def path_integration(senses: Senses) -> np.ndarray:
    """Dead-reckon what was sensed, from the true start; ``(seeds, steps, 2)``."""
    steps = senses.speed_m_s * senses.dt_s
    heading = np.stack([np.cos(senses.heading_rad), np.sin(senses.heading_rad)], axis=-1)
    return senses.position_m[0] + np.cumsum(steps[..., None] * heading, axis=1)


def position_errors(estimate_m: np.ndarray, truth_m: np.ndarray) -> Errors:
    """Measure the errors of tracks, ``(seeds, steps, 2)``, against the truth, ``(steps, 2)``."""
    distance = np.linalg.norm(estimate_m - truth_m, axis=-1)
    aligned = [absolute_trajectory_error(one, truth_m, "rigid").rmse for one in estimate_m]
    return Errors(
        distance.mean(axis=1), np.sqrt(np.square(distance).mean(axis=1)), np.array(aligned)
    )
