"""Place cells on tracks of rats by all methods compared, and their estimates."""

import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import torch

from neuroslam.cells.boundary_vectors import Wall
from neuroslam.cells.navigation import NavigationCells
from neuroslam.cells.navigation_state import NavigationEstimate
from neuroslam.cells.pose import PoseCellNetwork
from neuroslam.config import BrainConfig, PoseCellConfig, WallMemoryConfig
from neuroslam.evaluation.ratemap import responding
from neuroslam.experiments.animals import WALLS, path_integration, read_track, run_cells
from neuroslam.figures.place_errors import Spread
from neuroslam.geometry import TWO_PI, rotate_points, wrap_angles
from neuroslam.types import Motion
from neuroslam.worlds.rodent import Walk
from neuroslam.worlds.senses import SenseNoise, Senses, sense

FULL, WEAK, EASY = "noise 1.0", "noise 0.3", "noise 1.0, bearings from the compass"
"""Conditions: noise of the senses."""

SLRB, HEBB, RATSLAM, PATH = "SLRB", "competitive Hebb", "RatSLAM", "path integration"

NO_WALLS = WallMemoryConfig(corrects=False)
"""Walls neither correct the position, nor detect that the animal is lost and stop learning."""

_COUNT_EVERY = 100  # steps between counts of place cells
_LOOK_EVERY = 80  # steps between records of all responses
_POSE_CELL_M = 0.06  # as the place cells, so that numbers of cells can be compared
_POSE_STEPS = 4  # samples summed to one motion of the pose cells: 5 Hz


class MethodResult(NamedTuple):
    """Estimates of a method on one track under one condition, for every seed.

    Attributes:
        track: Name of the track.
        condition: Noise of the senses.
        method: Name of the method.
        truth_m: True positions, ``(n, 2)``.
        minutes: Times, ``(n,)``.
        estimate_m: Integrated positions, ``(seeds, n, 2)``.
        winner_m: Centres of the winning cells, same shape; ``None`` for a method without cells.
        cells: Number of cells over time; ``None`` for a method without cells.
        more: Further values of the row.
    """

    track: str
    condition: str
    method: str
    truth_m: np.ndarray
    minutes: np.ndarray
    estimate_m: np.ndarray
    winner_m: np.ndarray | None = None
    cells: Spread | None = None
    more: Mapping[str, float] = {}


class PlaceCellLog:
    """Hook that records place cells of a batch of animals.

    Args:
        beside_wall: Whether an animal senses a wall, ``(batch, steps)``.
        start_m: True start; the estimates start at 0.
        early: Step at which the map of the first animal is recorded.
    """

    def __init__(self, beside_wall: np.ndarray, start_m: np.ndarray, early: int) -> None:
        self.beside_wall, self.start_m, self.early = beside_wall, start_m, early
        self.estimate = np.empty((*beside_wall.shape[::-1], 2))
        self.winner = np.empty_like(self.estimate)
        self.lost = np.empty(self.estimate.shape[:2], dtype=bool)
        self.counted: list[np.ndarray] = []
        self.count_steps: list[int] = []
        self.maps: list[tuple[np.ndarray, np.ndarray]] = []
        # Animal, and number of cells above half of the highest rate, beside a wall; by the grid
        # cells and the position, and by the grid cells alone.
        self.above: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
        self.looks: dict[int, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}

    def __call__(self, i: int, here: NavigationEstimate, cells: NavigationCells) -> None:
        """Record a step; a :data:`~neuroslam.experiments.animals.Hook`."""
        self.estimate[i], self.lost[i] = here.position_m.numpy(), here.lost.numpy()
        self.winner[i] = cells.place.centre_of(here.place).numpy()
        last = i == len(self.estimate) - 1
        if i % _COUNT_EVERY == 0 or last:
            self.counted.append(cells.place.n_cells.numpy().copy())
            self.count_steps.append(i)
        if i == self.early or last:
            centres, links = cells.place.graph()
            self.maps.append((centres.numpy() + self.start_m, links.numpy()))
        beside = np.flatnonzero(self.beside_wall[:, i])
        if i % _LOOK_EVERY == 0 and len(beside):
            self._look(i, here, cells, beside)

    def _look(
        self, i: int, here: NavigationEstimate, cells: NavigationCells, beside: np.ndarray
    ) -> None:
        grid = cells.grid.rates.flatten(-2)
        both = [cells.place.responses(grid, at).numpy() for at in (here.position_m, None)]
        for above, rates in zip(self.above, both, strict=True):
            above.append(np.column_stack([beside, responding(rates[beside])]))
        if beside[0] == 0:  # the first animal's, to draw
            n = int(cells.place.n_cells[0])
            centres = cells.place.centres_m[0, :n].numpy() + self.start_m
            self.looks[i] = centres, both[0][0, :n].copy(), both[1][0, :n].copy()

    def single(self, rows: slice) -> dict[str, float]:
        """Return how often exactly one cell responds beside a wall, and the mean number."""
        found = {}
        for name, above in zip(("", "_by_grid_alone"), self.above, strict=True):
            animal, n = np.concatenate([np.empty((0, 2), int), *above]).T
            n = n[(animal >= rows.start) & (animal < rows.stop)]
            found[f"one_cell_share{name}"] = float((n == 1).mean()) if len(n) else math.nan
            found[f"cells_above_half{name}"] = float(n.mean()) if len(n) else math.nan
        return found


def stacked(senses: Sequence[Senses]) -> Senses:
    """Stack animals on one walk into one batch, which is faster than one after the other.

    Args:
        senses: Senses on the same walk.
    """
    columns = ("speed_m_s", "heading_rad", "wall_m", "wall_bearing_rad")
    return senses[0]._replace(
        **{c: np.concatenate([getattr(s, c) for s in senses]) for c in columns}
    )


class PoseCellPath(NamedTuple):
    """Way of the packet of pose cells, in cells from where it started.

    Attributes:
        steps: Steps of the senses, ``(n,)``.
        cells: x, y and heading after them, unwrapped, ``(batch, n, 3)``.
        turned_rad: Angle from x of the cells to x of the world, ``(batch,)``.
    """

    steps: np.ndarray
    cells: np.ndarray
    turned_rad: np.ndarray

    def in_world(self, cells: np.ndarray) -> np.ndarray:
        """Return x and y of such a path in metres from the start, ``(batch, n, 2)``."""
        return rotate_points(_POSE_CELL_M * cells, self.turned_rad[:, None])


def pose_cells_alone(senses: Senses) -> PoseCellPath:
    """Run RatSLAM's pose cells on the sensed motion, at 5 Hz.

    Four samples are summed to one motion, which averages the noise of the heading. Without
    injection by views the torus may be small, as the estimate is unwrapped.
    """
    batch, steps = senses.speed_m_s.shape
    n = steps // _POSE_STEPS
    length = senses.speed_m_s * senses.dt_s
    moved = np.stack([length * np.cos(senses.heading_rad), length * np.sin(senses.heading_rad)], -1)
    moved = moved[:, : n * _POSE_STEPS].reshape(batch, n, _POSE_STEPS, 2).sum(axis=2)
    distance = np.linalg.norm(moved, axis=-1)
    heading = np.arctan2(moved[..., 1], moved[..., 0])
    turn = wrap_angles(np.diff(heading, axis=1, append=heading[:, -1:]))
    config = PoseCellConfig(n_xy=15, cell_size_m=_POSE_CELL_M)
    cells = PoseCellNetwork(config, batch=batch)
    estimates = np.empty((n + 1, batch, 3))
    with torch.inference_mode():
        estimates[0] = np.asarray(cells.estimate)
        for i, motion in enumerate(zip(distance.T, turn.T, strict=True)):
            v, w = (cast(Any, torch.from_numpy(np.ascontiguousarray(x))) for x in motion)
            estimates[i + 1] = np.asarray(cells.integrate(Motion(v, w, 1.0)))
    torus = np.array([config.n_xy, config.n_xy, config.n_theta])
    displacements = (np.diff(estimates, axis=0) + torus / 2) % torus - torus / 2
    path = np.cumsum(displacements, axis=0).transpose(1, 0, 2)
    turned = heading[:, 0] - TWO_PI * estimates[0, :, 2] / config.n_theta  # it starts along -x
    return PoseCellPath(np.arange(1, n + 1) * _POSE_STEPS - 1, path, turned)


def visited(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Number the cells of a track ``(n, k)``, whole numbers, in the order of their first visit.

    Returns:
        The cells, ``(m, k)``; step of each first visit, ``(m,)``; number at each step, ``(n,)``.

    Example:
        >>> visited(np.array([[2, 0], [1, 0], [2, 0]]))[1:]
        (array([0, 1]), array([0, 1, 0]))
    """
    distinct, first, number = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.argsort(order)
    return distinct[order], first[order], rank[number.reshape(-1)]


def links_of(numbers: np.ndarray) -> np.ndarray:
    """Return pairs of cells visited in succession, each once, ``(m, 2)``."""
    pairs = np.sort(np.column_stack([numbers[:-1], numbers[1:]]), axis=1)
    return np.unique(pairs[pairs[:, 0] != pairs[:, 1]], axis=0)


class TrackResult(NamedTuple):
    """Results of all methods on one track, and the data of its figures."""

    name: str
    walk: Walk
    results: list[MethodResult]
    logs: dict[str, PlaceCellLog]
    walls: Wall
    pose_maps: list[tuple[np.ndarray, np.ndarray]]
    early_min: float


def run_track(
    data: Path, name: str, minutes: float = 30.0, seeds: Sequence[int] = range(10)
) -> TrackResult:
    """Run all methods on one track under all conditions."""
    walk = read_track(data, name, minutes)
    look = partial(sense, walk, seeds=seeds, k=WALLS)
    senses = {
        FULL: look(SenseNoise()),
        WEAK: look(SenseNoise().scaled(0.3)),
        EASY: look(SenseNoise(), compass_free_bearings=True),
    }
    k, at_min = len(seeds), walk.times_s / 60.0 - walk.times_s[0] / 60.0
    early = int(np.searchsorted(at_min, min(5.0, at_min[-1] / 4)))
    results = [
        MethodResult(name, c, PATH, walk.positions, at_min, path_integration(senses[c]))
        for c in (FULL, WEAK)
    ]
    logs: dict[str, PlaceCellLog] = {}
    walls: Wall | None = None
    for method, conditions in ((SLRB, tuple(senses)), (HEBB, (FULL, WEAK))):
        some = stacked([senses[c] for c in conditions])
        log = PlaceCellLog(np.isfinite(some.wall_m[..., 0]), walk.positions[0], early)
        config = BrainConfig() if method == SLRB else BrainConfig(wall_memory=NO_WALLS)
        cells = run_cells(some, config, log)
        logs[method] = log
        if method == SLRB:
            walls = cells.walls.remembered()[0]
        for number, condition in enumerate(conditions):
            rows = slice(number * k, (number + 1) * k)
            estimate, winner = (
                x[:, rows].transpose(1, 0, 2) + walk.positions[0]
                for x in (log.estimate, log.winner)
            )
            counts = Spread(at_min[log.count_steps], np.array(log.counted).T[rows])
            more = log.single(rows) | {"lost_share": float(log.lost[:, rows].mean())}
            results.append(
                MethodResult(
                    name, condition, method, walk.positions, at_min, estimate, winner, counts, more
                )
            )
    path = pose_cells_alone(stacked([senses[FULL], senses[WEAK]]))
    for number, condition in enumerate((FULL, WEAK)):
        rows = slice(number * k, (number + 1) * k)
        own = PoseCellPath(path.steps, path.cells[rows], path.turned_rad[rows])
        results.append(_pose_cell_result(name, condition, walk, own))
    first = PoseCellPath(path.steps, path.cells[:1], path.turned_rad[:1])
    pose_maps = [_pose_map(first, walk, stop) for stop in (early, math.inf)]
    assert walls is not None  # SLRB has run
    return TrackResult(name, walk, results, logs, walls, pose_maps, float(at_min[early]))


def _pose_cell_result(name: str, condition: str, walk: Walk, path: PoseCellPath) -> MethodResult:
    steps = path.steps
    at_min = (walk.times_s[steps] - walk.times_s[0]) / 60.0
    nearest = np.round(path.cells).astype(int)
    firsts = [visited(one[:, :2])[1] for one in nearest]
    ends = np.append(np.arange(0, len(steps) - 1, _COUNT_EVERY // _POSE_STEPS), len(steps) - 1)
    counts = np.array([np.searchsorted(first, ends, side="right") for first in firsts])
    nearest[..., 2] %= PoseCellConfig().n_theta
    with_heading = np.mean([len(visited(one)[1]) for one in nearest])
    estimate, winner = (path.in_world(cells) + walk.positions[0] for cells in (path.cells, nearest))
    return MethodResult(
        name, condition, RATSLAM, walk.positions[steps], at_min, estimate, winner,
        Spread(at_min[ends], counts), {"cells_with_heading": float(with_heading)},
    )  # fmt: skip


def _pose_map(first: PoseCellPath, walk: Walk, stop: float) -> tuple[np.ndarray, np.ndarray]:
    until = first.steps <= stop
    cells, _, numbers = visited(np.round(first.cells[0, until, :2]).astype(int))
    return first.in_world(cells[None])[0] + walk.positions[0], links_of(numbers)
