"""Boundary, grid and place cells together: one animal, 32 animals, and many place cells."""

import statistics
import time
from collections.abc import Callable

import numpy as np
import pytest
import torch

from benchmarks.timing import Row, cpu_ms
from neuroslam import compiled
from neuroslam.cells.navigation import NavigationCells
from neuroslam.config import BrainConfig
from neuroslam.worlds.arena import named_arena
from neuroslam.worlds.rodent import roam
from neuroslam.worlds.senses import SenseNoise, sense

STEPS_30_MIN = 36_000
BATCH = 32
RECRUITED = (500, 5_000, 50_000)
WARM, TIMED = 4_000, 2_000


class Rat:
    """Cells and what they sense, step by step; a walk at the speed of a foraging rat."""

    def __init__(
        self, batch: int | None = None, arena: str = "circle2m", walls_by: str = "walls"
    ) -> None:
        walk = roam(named_arena(arena), 8.0, np.random.default_rng(0), speed_m_s=0.18)
        senses = sense(walk, SenseNoise(), range(batch or 1), k=2)
        columns = (senses.speed_m_s, senses.heading_rad, senses.wall_m, senses.wall_bearing_rad)
        self.columns = [
            torch.from_numpy(np.ascontiguousarray(np.moveaxis(column, 1, 0))) for column in columns
        ]
        if batch is None:
            self.columns = [column[:, 0].contiguous() for column in self.columns]
        self.dt_s = senses.dt_s.tolist()
        config = BrainConfig(wall_memory={"senses": walls_by})
        self.cells = NavigationCells(config, batch=batch)
        self.at = 0
        self.recorded: list[np.ndarray] = []

    def steps(self, n: int) -> None:
        for _ in range(n):
            i = self.at % len(self.dt_s)
            speed, heading, wall, bearing = (column[i] for column in self.columns)
            self.cells(speed, heading, self.dt_s[i], wall, bearing)
            self.at += 1

    def recorded_steps(self, n: int) -> None:
        """Do as :meth:`steps`, and record the rates of all cells in every step."""
        self.recorded.clear()
        for _ in range(n):
            self.steps(1)
            self.recorded.append(self.cells.rates)

    def recruit(self, n: int) -> None:
        """Give it so many place cells, on a lattice around where it is."""
        side = int(np.ceil(np.sqrt(n)))
        grid = np.stack(np.meshgrid(*2 * [np.arange(side) - side / 2]), axis=-1).reshape(-1, 2)
        state = self.cells.state_dict()
        weights = torch.randn(1, n, state["place.weights"].shape[2])
        kept = state["place.n_cells"].item()
        more = {
            "place.weights": torch.nn.functional.normalize(weights, dim=-1),
            "place.centres_m": torch.from_numpy(0.07 * grid[None, :n]),
            "place.visits": torch.ones(1, n, dtype=torch.int64),
            "place.time_s": torch.ones(1, n, dtype=torch.float64),
            "place.neighbours": torch.full((1, n, 12), -1),
        }
        assert kept <= n
        state |= more | {"place.n_cells": torch.tensor([n])}
        state["place.landmarks_m"] = torch.full_like(state["place.landmarks_m"], 1e6)
        state["place.window"] = torch.arange(state["place.window"].shape[1])[None]
        self.cells.load_state_dict(state)


def without_and_with(make: Callable[[], Callable[[int], None]]) -> tuple[float, float]:
    """Median CPU seconds of 30 minutes without and with compiled steps, in turns."""
    runs, times = {}, {False: [], True: []}
    for enabled in times:
        compiled.ENABLED = enabled
        runs[enabled] = make()
        runs[enabled](WARM)
    for _ in range(5):
        for enabled, run in runs.items():
            compiled.ENABLED = enabled
            began = time.process_time()
            run(TIMED)
            times[enabled].append((time.process_time() - began) * STEPS_30_MIN / TIMED)
    return statistics.median(times[False]), statistics.median(times[True])


@torch.inference_mode()
def rows() -> list[Row]:
    found = []
    for what, make, target in (
        ("circle2m", lambda: Rat().steps, "<= 1.5 s"),
        ("triangle", lambda: Rat(arena="triangle").steps, "<= 1.5 s"),
        ("circle2m, rates recorded", lambda: Rat().recorded_steps, "<= 2 s"),
        ("circle2m, walls by cells", lambda: Rat(walls_by="boundary_cells").steps, ""),
    ):
        off, on = without_and_with(make)
        beside = f"not compiled {off:.1f} s"
        size = f"30 min, {what}"
        found.append(Row("navigation cells, one animal", size, 1e3 * on, target, beside))
    rats = Rat(BATCH)
    rats.steps(WARM)
    ms = cpu_ms(lambda: rats.steps(TIMED // 4), 1, 5) / (TIMED // 4) / BATCH
    s = ms * STEPS_30_MIN / 1e3
    found.append(Row(f"the same, one of a batch of {BATCH}", "30 min, circle2m", 1e3 * s, "<= 1 s"))
    for n in RECRUITED:
        rat = Rat()
        rat.steps(200)
        rat.recruit(n)
        rat.steps(200)
        ms = cpu_ms(lambda rat=rat: rat.steps(TIMED), 1, 5) / TIMED
        found.append(Row("navigation cells, a step", f"{n} place cells", ms))
    return found


@pytest.mark.parametrize("batch", [None, BATCH])
def test_navigation_cells(benchmark, batch):
    torch.set_num_threads(1)
    rat = Rat(batch)
    with torch.inference_mode():
        rat.steps(500)
        benchmark(rat.steps, 20)
