"""Boundary, grid and place cells together: one animal, 32 animals, and many place cells."""

import numpy as np
import pytest
import torch

from benchmarks.timing import Row, cpu_ms
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

    def __init__(self, batch: int | None = None, arena: str = "circle2m") -> None:
        walk = roam(named_arena(arena), 8.0, np.random.default_rng(0), speed_m_s=0.18)
        senses = sense(walk, SenseNoise(), range(batch or 1), k=2)
        columns = (senses.speed_m_s, senses.heading_rad, senses.wall_m, senses.wall_bearing_rad)
        self.columns = [
            torch.from_numpy(np.ascontiguousarray(np.moveaxis(column, 1, 0))) for column in columns
        ]
        if batch is None:
            self.columns = [column[:, 0].contiguous() for column in self.columns]
        self.dt_s = senses.dt_s.tolist()
        self.cells = NavigationCells(BrainConfig(), batch=batch)
        self.at = 0

    def steps(self, n: int) -> None:
        for _ in range(n):
            i = self.at % len(self.dt_s)
            speed, heading, wall, bearing = (column[i] for column in self.columns)
            self.cells(speed, heading, self.dt_s[i], wall, bearing)
            self.at += 1

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


@torch.inference_mode()
def rows() -> list[Row]:
    found = []
    for arena in ("circle2m", "triangle"):
        rat = Rat(arena=arena)
        rat.steps(WARM)
        ms = cpu_ms(lambda rat=rat: rat.steps(TIMED), 1, 5) / TIMED
        s = ms * STEPS_30_MIN / 1e3
        size = f"30 min at 20 Hz, {arena}"
        found.append(Row("navigation cells, one animal", size, "-", "<= 10 s", f"{s:.1f} s"))
    rats = Rat(BATCH)
    rats.steps(WARM)
    ms = cpu_ms(lambda: rats.steps(TIMED // 4), 1, 5) / (TIMED // 4) / BATCH
    s = ms * STEPS_30_MIN / 1e3
    found.append(
        Row(f"the same, a batch of {BATCH}", "circle2m", "-", "<= 1 s an animal", f"{s:.2f} s")
    )
    for n in RECRUITED:
        rat = Rat()
        rat.steps(200)
        rat.recruit(n)
        rat.steps(200)
        ms = cpu_ms(lambda rat=rat: rat.steps(TIMED), 1, 5) / TIMED
        found.append(Row("a step", f"{n} place cells", "-", "-", f"{ms * 1e3:.0f} us"))
    return found


@pytest.mark.parametrize("batch", [None, BATCH])
def test_navigation_cells(benchmark, batch):
    torch.set_num_threads(1)
    rat = Rat(batch)
    with torch.inference_mode():
        rat.steps(500)
        benchmark(rat.steps, 20)
