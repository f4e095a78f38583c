"""Grid cells that learn while their animal explores: grid scores over time, from random weights.

The score of a rate map over the path rises with the coverage of the arena, whatever the network
learns. So the weights are scored alone too: by the rates at positions all over a square.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.figure import Figure

from neuroslam.cells.grid import LAHNGridCells, lahn_drive
from neuroslam.cells.navigation import NavigationCells
from neuroslam.cells.navigation_state import NavigationEstimate
from neuroslam.cells.oscillators import VelocityOscillators
from neuroslam.config import BrainConfig
from neuroslam.errors import counted
from neuroslam.evaluation.gridness import gridness
from neuroslam.evaluation.ratemap import RateMaps
from neuroslam.experiments.animals import WALLS, read_track, run_one
from neuroslam.experiments.boundary_cells import write_results
from neuroslam.experiments.census import arena_bins, by_seed, median
from neuroslam.figures.cells import Curve, plot_scores
from neuroslam.figures.style import CURVES, LOOP, MAP, ODOMETRY, TRUTH, save
from neuroslam.worlds.rodent import Walk
from neuroslam.worlds.senses import SenseNoise, sense

CONDITIONS: dict[str, dict[str, Any]] = {
    "random, learns": {"development_steps": 0, "learns_online": True},
    "developed, learns": {"learns_online": True},
    "developed, fixed": {},
    "random, fixed": {"development_steps": 0},
    "random, learns 100 x faster": {
        "development_steps": 0,
        "learns_online": True,
        "online_share": 1.0,
    },
}
"""Weights at the start, and what they do -> settings of ``grid_cells``.

Developed weights learnt at random positions before.
"""

_STYLES = {
    "random, learns": (LOOP, "-"),
    "developed, learns": (MAP, "-"),
    "developed, fixed": (TRUTH, "--"),
    "random, fixed": (ODOMETRY, ":"),
    "random, learns 100 x faster": (CURVES[3], "-."),
}
_TIMES_S = (2.0, 10.0, 30.0, 60.0, 120.0, 300.0, 600.0, 900.0, 1200.0, 1500.0, 1800.0)
_BIN_M, _SIDE_M = 0.025, 2.0


class Scores(NamedTuple):
    """Grid scores of one animal at some times, ``(times, modules, cells)``.

    Attributes:
        weights: Of the network with the weights of that time, over a square; 0: no score.
        path: Of the rate map over the true positions since the start.
    """

    weights: np.ndarray
    path: np.ndarray


def grid_learning(
    data_folder: Path,
    out_folder: Path,
    minutes: float = 30.0,
    seeds: Sequence[int] = range(3),
    track: str = "hafting",
) -> dict[str, Any]:
    """Score grid cells over time that learn while the animal explores, and that do not.

    Args:
        data_folder: Folder of the recordings.
        out_folder: ``results.json`` and ``grid_learning.png`` are written there.
        minutes: Length of the walk.
        seeds: Seed of the noise, and of the random weights, of each animal.
        track: Name of the track.

    Returns:
        The content of ``results.json``: ``rows``, one for each condition and time.
    """
    out, walk = Path(out_folder), read_track(Path(data_folder), track, minutes)
    times = [t for t in _TIMES_S if t <= 60.0 * minutes]
    scores = {name: [score(walk, seed, times, name) for seed in seeds] for name in CONDITIONS}
    rows = [
        {
            "condition": name,
            "time_s": time_s,
            "gridness_of_weights": median(np.array([one.weights[k] for one in each])),
            "gridness_of_path": median(np.array([one.path[k] for one in each])),
            "sd_over_seeds": float(by_seed(np.array([one.path[k] for one in each])).std()),
        }
        for name, each in scores.items()
        for k, time_s in enumerate(times)
    ]
    save(_plot(scores, np.array(times), track), out / "grid_learning.png")
    reached = {
        name: next(
            (r["time_s"] for r in rows if r["condition"] == name and r["gridness_of_path"] >= 1.0),
            None,
        )
        for name in CONDITIONS
    }
    results = {
        "experiment": "grid-learning",
        "seeds": len(seeds),
        "track": track,
        "path_reaches_1_at_s": reached,
        "rows": rows,
    }
    return write_results(out, results)


def score(walk: Walk, seed: int, times_s: Sequence[float], condition: str) -> Scores:
    """Let an animal explore under a condition, and score its grid cells at some times."""
    config = BrainConfig.model_validate({"grid_cells": {**CONDITIONS[condition], "seed": seed}})
    since = walk.times_s - walk.times_s[0]
    steps = {min(int(np.searchsorted(since, t - 1e-6)), len(since) - 1) for t in times_s}
    c, bins = config.grid_cells, arena_bins(walk)
    shape = len(c.spacings_m), c.n_cells
    maps, fired = RateMaps(bins, shape[0] * shape[1]), list[np.ndarray]()
    scores: list[tuple[np.ndarray, np.ndarray]] = []

    def hook(step: int, _here: NavigationEstimate, cells: NavigationCells) -> None:
        fired.append(cells.grid.rates.numpy().flatten())
        if step in steps:
            maps.add(walk.positions[step + 1 - len(fired) : step + 1], np.stack(fired))
            fired.clear()
            path = gridness(maps.maps()).reshape(shape)
            scores.append((gridness(network_maps(cells.grid)), path))

    run_one(sense(walk, SenseNoise(), [seed], k=WALLS), 0, config, hook)
    return Scores(*np.nan_to_num(np.array(scores)).swapaxes(0, 1))


def network_maps(cells: LAHNGridCells, side_m: float = _SIDE_M) -> np.ndarray:
    """Return rate maps of a network at positions all over a square, ``(modules, cells, n, n)``."""
    n = round(side_m / _BIN_M)
    middle = (torch.arange(n, dtype=torch.float64) + 0.5) * _BIN_M - 0.5 * side_m
    at = torch.stack([middle.repeat(n), middle.repeat_interleave(n)], dim=-1)
    q, _, _, bias = cells.weights
    with torch.inference_mode():
        inputs = VelocityOscillators(cells.config, n * n).place_at(at).flatten(-2).to(bias)
        rates = (torch.einsum("smi,mci->smc", inputs, q) - bias).clamp_min(0.0)
        rates = (lahn_drive(inputs, rates, q, cells.coupling) - bias).clamp_min(0.0)
    return rates.permute(1, 2, 0).reshape(*rates.shape[1:], n, n).double().numpy()


def _plot(scores: dict[str, list[Scores]], times_s: np.ndarray, track: str) -> Figure:
    panels: dict[str, dict[str, Curve]] = {}
    for title, of in (("Weights alone", "weights"), ("Rate map since the start", "path")):
        panels[title] = {}
        for name, each in scores.items():
            by_time = np.stack([getattr(one, of) for one in each], axis=1)
            values = np.array([by_seed(now) for now in by_time])
            spread = values.std(1) if len(each) > 1 else None
            panels[title][name] = Curve(times_s / 60.0, values.mean(1), *_STYLES[name], spread)
    n = counted(len(next(iter(scores.values()))), "animal")
    title = f"Grid scores while grid cells learn: {track}, {n}"
    return plot_scores(panels, "time (min)", title)
