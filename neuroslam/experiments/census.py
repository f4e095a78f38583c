"""A census of grid cells during a walk: rate maps, grid scores and fields at some times."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from neuroslam.cells.navigation import NavigationCells
from neuroslam.cells.navigation_state import NavigationEstimate
from neuroslam.config import BrainConfig
from neuroslam.evaluation.gridness import gridness
from neuroslam.evaluation.ratemap import Bins, RateMaps, field_activity, fields
from neuroslam.experiments.animals import arena_of, simulate
from neuroslam.figures.cells import Firing
from neuroslam.worlds.rodent import Walk
from neuroslam.worlds.senses import SenseNoise

ACTIVE_S = (1.0, 2.0, 4.0, 8.0, 16.0)
"""Activity, rate times seconds, from which on a field may count as activated."""

_PIECE = 1200  # steps whose rates are held before they are added to the maps


class Census(NamedTuple):
    """Grid cells at some time; arrays of seeds by modules by cells.

    Attributes:
        time_s: Time since the start.
        silent: Grid score of the map since the start, unvisited bins silent.
        skip: The same, unvisited bins left out.
        last: Grid score of the map since the previous census, unvisited bins silent.
        n_fields: Number of firing fields.
        n_active: Those whose activity since the start is one of ``ACTIVE_S`` at least; one axis
            more, for these.
        maps: Rate maps of the first seed, modules by cells, ``(m, c, n_y, n_x)``.
    """

    time_s: float
    silent: np.ndarray
    skip: np.ndarray
    last: np.ndarray
    n_fields: np.ndarray
    n_active: np.ndarray
    maps: np.ndarray


class CensusRecorder:
    """Recorder of rate maps of a batch of animals on one walk, with a census at some times.

    Args:
        walk: The true walk.
        times_s: Times of a census since the start, rising.
        shape: Number of seeds, modules, cells.
    """

    def __init__(self, walk: Walk, times_s: Sequence[float], shape: tuple[int, int, int]) -> None:
        self.walk, self.times_s, self.shape = walk, list(times_s), shape
        self.bins = arena_bins(walk)
        since = walk.times_s - walk.times_s[0]
        self.stops = np.searchsorted(since, np.array(times_s) - 1e-6).clip(max=len(since) - 1)
        self.total, self.recent = self._empty(), self._empty()
        self.held: list[np.ndarray] = []
        self.census: list[Census] = []

    def _empty(self) -> list[RateMaps]:
        return [RateMaps(self.bins, self.shape[1] * self.shape[2]) for _ in range(self.shape[0])]

    def add(self, step: int, rates: np.ndarray) -> None:
        """Add the rates at a step: as many numbers as seeds by modules by cells."""
        self.held.append(np.array(rates, np.float32).reshape(self.shape[0], -1))
        due = len(self.census) < len(self.stops) and step == self.stops[len(self.census)]
        if due or len(self.held) == _PIECE:
            at = self.walk.positions[step + 1 - len(self.held) : step + 1]
            for maps, fired in zip(self.recent, np.stack(self.held, axis=1), strict=True):
                maps.add(at, fired)
            self.held = []
        if due:
            self._take_census()

    def _take_census(self) -> None:
        self.total = [old + new for old, new in zip(self.total, self.recent, strict=True)]
        maps = np.stack([one.maps() for one in self.total])
        last = np.stack([one.maps() for one in self.recent]) if self.census else maps
        n_fields = np.stack([fields(one, self.bins.bin_m).n_fields for one in maps])
        n_active = np.stack([self._count_active(one) for one in zip(self.total, maps, strict=True)])
        silent, skip = gridness(maps, "silent"), gridness(maps, "skip")
        recent = gridness(last, "silent") if self.census else silent
        self.census.append(
            Census(
                self.times_s[len(self.census)],
                silent.reshape(self.shape),
                skip.reshape(self.shape),
                recent.reshape(self.shape),
                n_fields.reshape(self.shape),
                n_active.reshape(*self.shape, len(ACTIVE_S)),
                maps[0].reshape(*self.shape[1:], *self.bins.shape),
            )
        )
        self.recent = self._empty()

    def _count_active(self, one: tuple[RateMaps, np.ndarray]) -> np.ndarray:
        """Count the fields of each cell by their activity, ``(N, len(ACTIVE_S))``."""
        total, maps = one
        cell, activity = field_activity(maps, total.sums / self.walk.rate_hz, self.bins.bin_m)
        return np.stack(
            [np.bincount(cell[activity >= s], minlength=len(maps)) for s in ACTIVE_S], 1
        )


def arena_bins(walk: Walk) -> Bins:
    """Cover the arena of a walk with bins of 2.5 cm."""
    return Bins.around(np.reshape(arena_of(walk).bounds, (2, 2)).T)


def median(scores: np.ndarray) -> float:
    """Return the median over modules and cells, averaged over the seeds."""
    return float(np.mean(by_seed(scores)))


def by_seed(scores: np.ndarray) -> np.ndarray:
    """Return the median over modules and cells of each seed; NaN where no cell has a score."""
    rows = scores.reshape(len(scores), -1)
    known = np.any(np.isfinite(rows), axis=1)
    return np.array([np.nanmedian(r) if k else math.nan for r, k in zip(rows, known, strict=True)])


def simulate_grid(
    walk: Walk,
    seeds: Sequence[int],
    times_s: Sequence[float],
    config: BrainConfig | None = None,
    noise: SenseNoise | None = None,
    watch: Callable[[int, NavigationCells], object] | None = None,
) -> tuple[list[Census], np.ndarray]:
    """Simulate animals on a walk; return the census of their grid cells, and their errors.

    Args:
        walk: A walk in an arena.
        seeds: Seed of the noise of each animal.
        times_s: Times of the census.
        config: Config of the cells; ``None``: the defaults.
        noise: Noise of the senses; ``None``: the defaults.
        watch: Called after every step with its number and the cells.

    Returns:
        The census, and the errors of position in metres, ``(seeds, steps)``.
    """
    config = config or BrainConfig()
    shape = (len(seeds), len(config.grid_cells.spacings_m), config.grid_cells.n_cells)
    recorder = CensusRecorder(walk, times_s, shape)

    def hook(step: int, _here: NavigationEstimate, cells: NavigationCells) -> None:
        recorder.add(step, cells.grid.rates.numpy())
        if watch is not None:
            watch(step, cells)

    simulation = simulate(walk, seeds, config, noise, hook)
    return recorder.census, np.linalg.norm(simulation.estimate_m - walk.positions, axis=-1)


def median_cell(census: Census, module: int) -> int:
    """Return the cell of a module, of the first seed, with the median score."""
    scores = census.silent[0, module]
    known = np.flatnonzero(np.isfinite(scores))
    return int(known[np.argsort(scores[known])[len(known) // 2]]) if len(known) else 0


def map_of(walk: Walk, census: Census, module: int, cell: int, title: str) -> Firing:
    """Return the rate map of a cell of the first seed, with its score, for a figure."""
    note = f"score {census.silent[0, module, cell]:.2f}"
    rate_map = census.maps[module, cell]
    return Firing(title, note, rate_map, arena_bins(walk), arena_of(walk))
