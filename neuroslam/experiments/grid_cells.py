"""Grid scores of grid cells in arenas of three shapes, and of a grid cell recorded in a rat.

The score at a time is that of the rate map since the start. The results have both treatments of
unvisited bins of a map, see :func:`neuroslam.evaluation.gridness.gridness`.
"""

import math
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from neuroslam.config import BrainConfig, GridCellConfig
from neuroslam.errors import SourceError
from neuroslam.evaluation.gridness import gridness
from neuroslam.evaluation.ratemap import spike_map
from neuroslam.experiments.animals import TRACKS, arena_of, read_track
from neuroslam.experiments.boundary_cells import write_results
from neuroslam.experiments.census import (
    Census,
    arena_bins,
    by_seed,
    map_of,
    median,
    median_cell,
    simulate_grid,
)
from neuroslam.figures.cells import Curve, Firing, plot_firing, plot_scores
from neuroslam.figures.style import CURVES, MAP, TRUTH, save
from neuroslam.worlds.rodent import Walk, read_walk

PAPER_TABLE_1 = {
    "triangle": (0.25, 0.32, 0.38, 0.45, 0.55, 0.56, 0.68, 0.69, 0.74, 0.73, 0.74, 0.74),
    "pentagon": (0.24, 0.35, 0.41, 0.51, 0.62, 0.68, 0.72, 0.75, 0.78, 0.78, 0.78, 0.78),
    "nonagon": (0.20, 0.34, 0.40, 0.49, 0.58, 0.71, 0.80, 0.84, 0.86, 0.84, 0.85, 0.85),
}
"""Scores at 30, 60, ..., 360 s."""

_SHOWN = 1  # module of the cells that are drawn, with a spacing of 0.46 m


def grid_scores(
    data_folder: Path,
    out_folder: Path,
    minutes: float = 6.0,
    n_seeds: int = 5,
    grid: GridCellConfig | None = None,
) -> dict[str, Any]:
    """Score grid cells in a triangle, a pentagon and a nonagon over time (Table 1, Fig. 5).

    Args:
        data_folder: Holds the simulated tracks, and the recording with a grid cell's spikes.
        out_folder: ``results.json``, ``scores.png`` and ``firing.png`` are written there.
        minutes: Duration; 6 in the paper.
        n_seeds: Number of animals, which differ in their noise.
        grid: Modules of grid cells, two or more; ``None``: the defaults.

    Returns:
        The content of ``results.json``: ``rows``, one for each arena and time.
    """
    data, out, grid = Path(data_folder), Path(out_folder), grid or GridCellConfig()
    times = [30.0 * k for k in range(1, 1 + round(2 * minutes))]
    rows, by_module, panels, cells = [], [], {}, []
    for name, paper in PAPER_TABLE_1.items():
        walk = read_track(data, name, minutes)
        fired: list[np.ndarray] = []
        census, _ = simulate_grid(
            walk,
            range(n_seeds),
            times,
            BrainConfig(grid_cells=grid),
            watch=lambda _, c, fired=fired: fired.append(c.grid.rates[0, _SHOWN].numpy().copy()),
        )
        rows += [
            {
                "arena": name,
                "time_s": c.time_s,
                "gridness_silent": median(c.silent),
                "gridness_skip": median(c.skip),
                "paper": printed,
                "sd_over_seeds": float(by_seed(c.silent).std()),
                "cells_scored_share": float(np.isfinite(c.silent).mean()),
            }
            for c, printed in zip(census, _padded(paper, len(times)), strict=True)
        ]
        by_module += [
            {
                "arena": name,
                "spacing_m": spacing,
                "time_s": census[-1].time_s,
                "gridness_silent": median(census[-1].silent[:, m]),
                "gridness_skip": median(census[-1].skip[:, m]),
            }
            for m, spacing in enumerate(grid.spacings_m)
        ]
        panels[name.capitalize()] = _table_1_curves(census, times, paper)
        cells.append(_show(walk, census[-1], np.stack(fired), name.capitalize()))
    recorded, row = recorded_cell(data)
    save(
        plot_scores(panels, "time (s)", "Grid scores during the exploration of an arena"),
        out / "scores.png",
    )
    title = "Firing of a grid cell in each arena, and of one recorded in a rat (right)"
    save(plot_firing([*cells, recorded], title), out / "firing.png")
    return write_results(
        out,
        {
            "experiment": "grid-scores",
            "seeds": n_seeds,
            "gridness_silent": "unvisited bins as silent, as opexebo and BNT; median over cells",
            "gridness_skip": "unvisited bins left out, as Eq. 13 of the paper",
            "rows": rows,
            "by_module": by_module,
            "recorded_cell": row,
            "directions": count_directions(data, minutes, grid),
            "directions_note": "hexagons come from the 60 degrees between six directions: with "
            "12 or 36 the network learns maps that are not hexagonal",
        },
    )


def _padded(values: Sequence[float], n: int) -> list[float]:
    return [*values[:n], *[math.nan] * (n - len(values))]


def _table_1_curves(
    census: list[Census], times: list[float], paper: Sequence[float]
) -> dict[str, Curve]:
    x = np.array(times)
    silent = np.array([by_seed(c.silent) for c in census])
    skip = np.array([by_seed(c.skip) for c in census])
    return {
        "ours, unvisited bins silent": Curve(x, silent.mean(1), MAP, "-", silent.std(1)),
        "ours, unvisited bins left out": Curve(x, skip.mean(1), CURVES[5], "-", skip.std(1)),
        "paper": Curve(x[: len(paper)], np.array(paper[: len(x)]), TRUTH, "--"),
    }


def _show(walk: Walk, census: Census, rates: np.ndarray, title: str) -> Firing:
    """Return the median cell of the drawn module, with rates ``(steps, cells)``, for a figure."""
    cell = median_cell(census, _SHOWN)
    fires = rates[:, cell] > 0.5 * rates[:, cell].max()
    firing = map_of(walk, census, _SHOWN, cell, title)
    return firing._replace(track_m=walk.positions, places_m=walk.positions[fires])


def recorded_cell(data: Path) -> tuple[Firing, dict[str, Any]]:
    """Score the recorded grid cell; return its rate map for a figure, and its row.

    Raises:
        SourceError: If the recording has no spikes.
    """
    walk = read_walk(data / TRACKS["sargolini"])
    spikes = walk.spikes_s
    if spikes is None:
        raise SourceError(f"{TRACKS['sargolini']}: has no spikes_s; expected times of spikes")
    bins = arena_bins(walk)
    rate_map = spike_map(walk.positions, walk.times_s, spikes, bins)
    silent, skip = float(gridness(rate_map, "silent")), float(gridness(rate_map, "skip"))
    at = [np.interp(spikes, walk.times_s, axis) for axis in walk.positions.T]
    note = f"score {silent:.2f}"
    firing = Firing(
        "Recorded", note, rate_map, bins, arena_of(walk), walk.positions, np.column_stack(at)
    )
    return firing, {
        "recording": TRACKS["sargolini"],
        "spikes": len(spikes),
        "gridness_silent": silent,
        "gridness_skip": skip,
        "opexebo_on_a_map_of_its_own": 0.67,
    }


def count_directions(data: Path, minutes: float, grid: GridCellConfig) -> list[dict[str, Any]]:
    """Score grid cells of 6, 12 and 36 directions by their coupling, in the pentagon, one seed."""
    walk, rows = read_track(data, "pentagon", minutes), []
    for directions, lateral in product((6, 12, 36), ("learned", "kernel", "both")):
        other = {"directions": directions, "lateral": lateral}
        config = BrainConfig(grid_cells=grid.model_copy(update=other))
        (census,), _ = simulate_grid(walk, [0], [walk.duration_s], config)
        silent, skip = by_seed(census.silent[0]), by_seed(census.skip[0])
        rows.append(
            {
                **other,
                "gridness_silent": median(census.silent),
                "gridness_skip": median(census.skip),
                "lowest_module": float(np.nanmin(silent)),
                "highest_module": float(np.nanmax(silent)),
                "highest_module_skip": float(np.nanmax(skip)),
            }
        )
    return rows
