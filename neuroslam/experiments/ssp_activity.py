"""Activity of the neurons of SSP-SLAM along a rat's path: grid cells and other populations."""

from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neuroslam.config.semantic import (
    PathIntegratorConfig,
    SemanticMapConfig,
    SSPSLAMConfig,
    SSPSpaceConfig,
)
from neuroslam.errors import SourceError, SpaceError
from neuroslam.evaluation.gridness import gridness
from neuroslam.evaluation.ratemap import Bins, RateMaps
from neuroslam.experiments.boundary_cells import write_results
from neuroslam.experiments.ssp_simulation import slam_in, views
from neuroslam.figures.spikes import Headings, Spikes, plot_rasters, plot_signals, plot_spikes
from neuroslam.figures.style import save
from neuroslam.spiking.populations import VectorPopulation
from neuroslam.spiking.slam import SSPSLAM, SSPStep
from neuroslam.worlds.landmark_paths import LandmarkPath, path_of_walk
from neuroslam.worlds.landmarks import LandmarkWorld, random_world
from neuroslam.worlds.rodent import read_walk

_BIN_M = 0.05
_PIECE = 1000
_HEADINGS = 16
_RASTER_S = 1.0
_PER_RASTER = 120  # neurons

OURS = PathIntegratorConfig(neurons=640, max_speed_m_s=1.5)
REFERENCE = OURS.model_copy(
    update={
        "neurons": 500,
        "tau_s": 0.05,
        "amplitude_range": (0.0, 2.0**0.5),
        "decoder_noise": 0.1,
        "coupling": "none",
    }
)
CONDITIONS = {
    "ours, corrected": (OURS, True),
    "ours, path integration": (OURS, False),
    "reference's oscillators, corrected": (REFERENCE, True),
    "reference's oscillators, path integration": (REFERENCE, False),
}
"""Name -> oscillators, and whether the map corrects them."""


class ActivityLog:
    """Recorder of spikes: rate maps of grid cells, and all spikes of a few neurons."""

    def __init__(self, slam: SSPSLAM, path: LandmarkPath, bins: Bins) -> None:
        self.slam, self.path = slam, path
        self.maps = RateMaps(bins, grid_cells(slam).n_neurons)
        self.half: np.ndarray = np.empty(0)  # grid scores of the first half of the path
        self.spikes: dict[str, list[np.ndarray]] = {p: [] for p in populations(slam)}
        self.errors: list[float] = []
        self.signals: list[tuple[float, float, float]] = []
        self._fired: list[np.ndarray] = []

    def __call__(self, step: int, result: SSPStep) -> None:
        """Record a step."""
        fired = {name: array.spikes for name, array in populations(self.slam).items()}
        self._fired.append(fired["grid cells"][0, 0].numpy().astype(bool))
        for name, kept in self.spikes.items():
            kept.append(_some(fired[name]).numpy().astype(bool))
        at = self.path.position_m[step]
        self.errors.append(float(np.linalg.norm(result.position_m[0].numpy() - at)))
        self.signals.append(
            (float(result.agreement[0]), float(result.gate[0]), float(result.recall[0]))
        )
        n, whole = step + 1, len(self.path.position_m)
        if n % _PIECE == 0 or n == whole:
            rate = np.stack(self._fired) / self.path.time_step_s
            self.maps.add(self.path.position_m[n - len(rate) : n], rate)
            self._fired = []
        if not len(self.half) and n >= whole / 2:
            self.half = gridness(self.maps.maps())


def grid_cells(slam: SSPSLAM) -> VectorPopulation:
    """Return the grid cells of SSP-SLAM.

    Raises:
        SpaceError: If it has none.
    """
    if slam.grid is None:
        raise SpaceError("ssp_activity: this SSP-SLAM has no grid cells; set grid_neurons above 0")
    return slam.grid


def populations(slam: SSPSLAM) -> dict[str, Any]:
    """Return the recorded arrays of neurons by name."""
    vectors = slam.vectors
    if vectors is None:
        raise SpaceError("ssp_activity: no object-vector cells; set vector_neurons above 0")
    return {
        "grid cells": grid_cells(slam).neurons,
        "object-vector cells": vectors.neurons,
        "memory": slam.map.memory,
        "oscillators": slam.integrator.neurons,
    }


def _some(spikes: torch.Tensor) -> torch.Tensor:
    """Return spikes of a few neurons, evenly over all groups."""
    flat = spikes[:, 0].flatten()
    return flat[torch.linspace(0, len(flat) - 1, _PER_RASTER).long()]


def ssp_activity(
    data_folder: Path, out_folder: Path, seconds: float = 150.0, grid_neurons: int = 450
) -> dict[str, Any]:
    """Record neurons along a rat's path, with and without corrections by the map (Fig. 7).

    The path is that of Sargolini et al. in RatInABox, if installed, else the one in the data.

    Args:
        data_folder: Folder of recordings of rats.
        out_folder: ``results.json``, ``spikes.png``, ``rasters.png`` and ``gate.png`` are written
            there.
        seconds: Duration; 150 in the paper.
        grid_neurons: Number of grid cells.

    Returns:
        The content of ``results.json``: ``rows``, one for each condition.
    """
    out = Path(out_folder)
    path, source = rat_path(data_folder, seconds)
    world = random_world(10, seed=3)
    bins = Bins.around(np.array([[-0.9, -0.9], [0.9, 0.9]]), _BIN_M)
    rows, logs = [], {}
    for name, (oscillators, corrected) in CONDITIONS.items():
        slam = slam_in(_config(oscillators, corrected, grid_neurons), world)
        log = logs[name] = ActivityLog(slam, path, bins)
        _walk(slam, world, path, log)
        score = gridness(log.maps.maps())
        error = np.array(log.errors)
        rows.append(
            {
                "life": name,
                "gridness_median_half": _median(log.half),
                "gridness_median": _median(score),
                "cells_scored": int(np.isfinite(score).sum()),
                "ate_m": float(error.mean()),
                "error_last_10_s_m": float(error[-round(10 / path.time_step_s) :].mean()),
            }
        )
    _draw(logs, world, path, out)
    return write_results(out, {"path": source, "seconds": seconds, "rows": rows})


def rat_path(data_folder: Path, seconds: float) -> tuple[LandmarkPath, str]:
    """Return a rat's path in a box, and the name of its recording."""
    spec = find_spec("ratinabox")
    file = Path(data_folder) / "sargolini2006_circle1m.npz"
    if spec is not None and spec.origin is not None:
        packaged = Path(spec.origin).parent / "data" / "sargolini.npz"
        file = packaged if packaged.is_file() else file
    if not file.is_file():
        raise SourceError(
            f"{file}: no such recording; install neuroslam[rodent], or give its folder with --data"
        )
    walk = read_walk(file, rate_hz=50.0)
    return path_of_walk(walk).first(seconds), file.name


def _config(oscillators: PathIntegratorConfig, corrected: bool, grid_neurons: int) -> SSPSLAMConfig:
    more: dict[str, Any] = {} if corrected else {"gain": 0.0, "relocalise_after_s": 0.0}
    return SSPSLAMConfig(
        space=SSPSpaceConfig(length_scale_m=0.15),
        integrator=oscillators,
        map=SemanticMapConfig(voja_rate=5e-4),
        binding="exact",
        grid_neurons=grid_neurons,
        **more,
    )


def _walk(slam: SSPSLAM, world: LandmarkWorld, path: LandmarkPath, log: ActivityLog) -> None:
    slam.start(torch.from_numpy(path.position_m[:1]))
    slam.run(
        torch.from_numpy(path.velocity_m_s[:, None]),
        views([world], path.position_m[:, None]),
        log,
        every=1000,
    )


def _median(scores: np.ndarray) -> float:
    scores = scores[np.isfinite(scores)]
    return float(np.median(scores)) if len(scores) else float("nan")


def _draw(
    logs: dict[str, ActivityLog], world: LandmarkWorld, path: LandmarkPath, out: Path
) -> None:
    """Draw spikes on the path as the paper's Fig. 7 does, rasters, and the gate."""
    at, dt = path.position_m, path.time_step_s
    landmarks = np.array([m.position_m for m in world.landmarks])
    fine = at[:: max(1, round(0.02 / dt))]
    on, off = (logs[f"ours, {k}"] for k in ("corrected", "path integration"))
    scores = gridness(on.maps.maps())
    cells = np.linspace(0, grid_cells(on.slam).n_neurons - 1, _PER_RASTER).astype(int)
    best = int(np.nanargmax(np.where(np.isfinite(scores[cells]), scores[cells], -2.0)))
    rows: list[list[Spikes | Headings]] = []
    for log, label in ((on, "Grid cell, corrected"), (off, "Grid cell, not corrected")):
        fired = np.stack(log.spikes["grid cells"])[:, best]
        score = gridness(log.maps.maps())[cells[best]]
        half = fired[: len(fired) // 2]
        rows.append(
            [
                Spikes(label, "first half", fine, at[: len(half)][half]),
                Spikes("The same cell", f"whole path, grid score {score:.2f}", fine, at[fired]),
            ]
        )
    ours = logs["ours, corrected"]
    for name, title in (("object-vector cells", "Object-vector cell"), ("memory", "Memory neuron")):
        spikes = np.stack(ours.spikes[name])
        k = int(np.argsort(spikes.sum(0))[int(0.9 * spikes.shape[1])])
        rows[0 if name.startswith("object") else 1].append(
            Spikes(title, f"{spikes[:, k].sum()} spikes", fine, at[spikes[:, k]], landmarks)
        )
    spikes = np.stack(ours.spikes["oscillators"])
    velocity = path.velocity_m_s
    moving = np.linalg.norm(velocity, axis=-1) > 0.05
    heading = np.arctan2(velocity[:, 1], velocity[:, 0]) % (2 * np.pi)
    bins = np.minimum((heading / (2 * np.pi) * _HEADINGS).astype(int), _HEADINGS - 1)
    time = np.bincount(bins[moving], minlength=_HEADINGS) * dt
    rates = np.stack(
        [np.bincount(bins[moving], s[moving], _HEADINGS) / time.clip(dt) for s in spikes.T]
    )
    k = int(
        np.argmax(np.abs((rates * np.exp(2j * np.pi * np.arange(_HEADINGS) / _HEADINGS)).sum(1)))
    )
    some = spikes[:, k].nonzero()[0]
    rows[0].append(Spikes("Oscillator neuron", f"{len(some)} spikes", fine, at[some[:4000]]))
    rows[1].append(Headings("Rate (Hz) by heading", rates[k]))
    title = "Spikes of neurons along a rat's path (dots: spikes, crosses: landmarks)"
    save(plot_spikes(rows, title), out / "spikes.png")
    n = round(_RASTER_S / dt)
    begin = int(np.argmax(np.array(ours.signals)[:, 2] > 0.5))
    save(
        plot_rasters(
            {name: np.stack(s[begin : begin + n]) for name, s in ours.spikes.items()},
            dt,
            begin * dt,
            "Spikes of four populations as a known landmark comes into view",
        ),
        out / "rasters.png",
    )
    signals = np.array(ours.signals)[:: max(1, round(0.01 / dt))]
    names = ("agreement", "gate", "recall")
    save(
        plot_signals(
            np.arange(len(signals)) * 0.01,
            {name: signals[:, i] for i, name in enumerate(names)},
            "Loop closures: agreement of map and path integration, gate, recall (arbitrary units)",
        ),
        out / "gate.png",
    )
