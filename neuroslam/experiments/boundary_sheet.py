"""Boundary cells in the loop against raw walls: errors with and without noisy beams, lesions."""

import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from neuroslam.cells.boundary_sheet import BoundarySheet
from neuroslam.config import BoundaryCellConfig, BrainConfig
from neuroslam.experiments.animals import (
    RATE_HZ,
    RECTANGLE,
    TRACKS,
    WALLS,
    arena_of,
    has_rectangle,
    position_errors,
    read_track,
    run_one,
)
from neuroslam.experiments.boundary_cells import write_results
from neuroslam.figures.place_errors import plot_errors
from neuroslam.figures.style import CURVES, save
from neuroslam.sensors.scan import walls_in_scan
from neuroslam.worlds.rodent import Walk
from neuroslam.worlds.senses import REACH_M, SenseNoise, Senses, sense

BEAMS = 180
BEAM_REACH_M = 5.0
BEAM_SIGMA_M = 0.03
OUTLIERS = 0.1
SCAN_EVERY = round(0.25 * RATE_HZ)
"""Steps between two scans: the period of the corrections by walls."""

_MAIN = ("raw walls", "boundary cells")

CONDITIONS: dict[str, dict[str, Any]] = {
    "raw walls": {},
    "boundary cells": {"wall_memory": {"senses": "boundary_cells"}},
    "tuning 3 x wider": {
        "wall_memory": {"senses": "boundary_cells"},
        "boundary_cells": {"sheet_sigma_bearing_rad": 0.45, "sigma_m": 0.072},
    },
    "no inhibition": {
        "wall_memory": {"senses": "boundary_cells"},
        "boundary_cells": {"sheet_inhibition": 0.0},
    },
    "cells silent": {"wall_memory": {"corrects": False}},
}
"""Condition -> sections of the config. Without responses no wall reaches memory: no correction."""


def boundary_cells_in_loop(
    data_folder: Path,
    out_folder: Path,
    minutes: float = 30.0,
    seeds: Sequence[int] = range(10),
    few_seeds: Sequence[int] = range(3),
    tracks: Sequence[str] | None = None,
) -> dict[str, Any]:
    """Compare positions with raw walls, with boundary cells, and with the cells impaired.

    Args:
        data_folder: Folder of the recordings.
        out_folder: ``results.json``, ``feet.png`` and ``noisy_beams.png`` are written there.
        minutes: Length of a walk.
        seeds: Seed of the noise of each animal.
        few_seeds: The same for walks with noisy beams, and with impaired cells.
        tracks: Names of tracks; ``None``: all of ``TRACKS``, and ``RECTANGLE`` if it is installed.

    Returns:
        The content of ``results.json``: ``rows``, one for each track, input and condition.
    """
    out, rows = Path(out_folder), []
    if tracks is None:
        tracks = (*TRACKS, RECTANGLE) if has_rectangle() else tuple(TRACKS)
    for name in tracks:
        walk = read_track(Path(data_folder), name, minutes)
        for condition in CONDITIONS:
            feet = sense(walk, SenseNoise(), seeds if condition in _MAIN else few_seeds, k=WALLS)
            rows.append({"track": name, "input": "feet", **run(feet, walk, condition)})
        motion = sense(walk, SenseNoise(), few_seeds, k=WALLS)
        scans = noisy_scans(walk, few_seeds)
        for condition in _MAIN:
            felt = with_scans(motion, scans, condition)
            row = run(felt, walk, condition, SCAN_EVERY)
            rows.append({"track": name, "input": "noisy beams", **row})
    for kind in ("feet", "noisy beams"):
        few = len(few_seeds) if kind == "feet" else None  # the same seeds for all conditions
        errors: dict[str, dict[str, np.ndarray]] = {}
        for row in rows:
            if row["input"] == kind:
                own = errors.setdefault(row["condition"], {})
                own[row["track"]] = np.array(row["errors_m"][:few])
        title = f"Boundary cells in the loop: walls as {kind}, {minutes:g} min"
        colours = dict(zip(CONDITIONS, CURVES, strict=False))
        figure = plot_errors(errors, title=title, colours=colours)
        save(figure, out / f"{kind.replace(' ', '_')}.png")
    return write_results(out, {"experiment": "boundary-cells", "minutes": minutes, "rows": rows})


def run(senses: Senses, walk: Walk, condition: str, every: int = 1) -> dict[str, Any]:
    """Run animals under a condition and return their errors in metres.

    Args:
        senses: Sensor data of the animals.
        walk: The true motion.
        condition: One of ``CONDITIONS``.
        every: Steps from one look at the walls to the next.
    """
    config = BrainConfig.model_validate(CONDITIONS[condition])
    animals, steps = senses.speed_m_s.shape
    estimate, lost_s, began = np.empty((animals, steps, 2)), np.empty(animals), time.process_time()
    for animal in range(animals):
        own = estimate[animal]

        def note(i: int, here: Any, _cells: Any, own: np.ndarray = own) -> None:  # noqa: ANN401
            own[i] = here.position_m.numpy()

        lost_s[animal] = run_one(senses, animal, config, note, every).now.lost_s
    each_ms = 1e3 * (time.process_time() - began) / (animals * steps)
    errors = position_errors(estimate + walk.positions[0], walk.positions)
    return {
        "condition": condition,
        "error_m": float(errors.mean_m.mean()),
        "errors_m": errors.mean_m.tolist(),
        "error_sd_m": float(errors.mean_m.std()),
        "ate_m": float(errors.aligned_m.mean()),
        "lost_s": float(lost_s.mean()),
        "step_cpu_ms": each_ms,
    }


def noisy_scans(walk: Walk, seeds: Sequence[int]) -> np.ndarray:
    """Scan at every correction: ranges with noise and outliers, ``(seeds, scans, BEAMS)``.

    A beam that is an outlier has a range evenly distributed up to its reach.
    """
    at = slice(SCAN_EVERY - 1, None, SCAN_EVERY)
    true = arena_of(walk).ranges(walk.positions[at], walk.headings_rad[at], BEAMS, BEAM_REACH_M)
    scans = np.empty((len(seeds), *true.shape))
    for i, seed in enumerate(seeds):
        rng = np.random.default_rng([seed, 1])
        scans[i] = np.maximum(true + BEAM_SIGMA_M * rng.standard_normal(true.shape), 0.0)
        wrong = rng.random(true.shape) < OUTLIERS
        scans[i][wrong] = rng.uniform(0.0, BEAM_REACH_M, int(wrong.sum()))
    return scans


def with_scans(motion: Senses, scans: np.ndarray, condition: str) -> Senses:
    """Return the senses with the walls that are found in the scans, the nearest ``WALLS``.

    :func:`walls_in_scan` has the noise of the beams as its tolerance; with its default it finds
    hardly any wall.
    """
    sheet = BoundarySheet(BoundaryCellConfig())
    raw = partial(walls_in_scan, reach_m=REACH_M, tolerance_m=BEAM_SIGMA_M)
    find = raw if condition == "raw walls" else sheet.walls_in_scan
    distance = np.full_like(motion.wall_m, np.inf)
    bearing = np.zeros_like(motion.wall_bearing_rad)
    for animal, own in enumerate(scans):
        for k, scan in enumerate(own):
            i = SCAN_EVERY * (k + 1) - 1
            walls = find(scan)
            walls = walls[walls[:, 0] <= REACH_M][:WALLS]
            distance[animal, i, : len(walls)] = walls[:, 0]
            bearing[animal, i, : len(walls)] = walls[:, 1]
    return motion._replace(wall_m=distance, wall_bearing_rad=bearing)
