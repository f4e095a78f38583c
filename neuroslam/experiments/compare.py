"""Comparison of all methods on the same worlds, noise, seeds and frames."""

import time
from collections.abc import Callable, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from neuroslam.brain import NavigationBrain
from neuroslam.config import BrainConfig, build_config, merge_values, read_preset
from neuroslam.evaluation.trajectory import align
from neuroslam.experiments.boundary_cells import write_results
from neuroslam.figures.comparison import plot_comparison, plot_losses
from neuroslam.figures.style import save
from neuroslam.geometry import integrate_velocities
from neuroslam.runs.parallel import parallel_map
from neuroslam.sensors import open_source
from neuroslam.threads import limit_threads
from neuroslam.types import NO_EXPERIENCE, Frame, Pose

WORLDS = ("corridor", "ellipse")
SENSES = "noise=0.05&compass_deg=3&ranges=72&markers=12&landmark_reach=6"
"""Sensors of all drives; each method uses those that it has cells for."""

_NEURONS = {
    "time_step_s": 0.001,
    "space": {"n_rotations": 3, "n_scales": 3},
    "integrator": {"neurons": 300},
    "map": {"neurons": 1000, "voja_rate": 0.0, "pes_rate": 2.5e-4},
    "binding": "exact",
    "vector_neurons": 0,
}

METHODS: dict[str, dict[str, Any]] = {
    "RatSLAM": {"cells": "pose"},
    "competitive Hebb": {"cells": "place", "wall_memory": {"corrects": False}},
    "SLRB": {"cells": "place"},
    "SSP-SLAM, vectors": {"cells": "semantic"},
    "SSP-SLAM, rates": {"cells": "semantic", "semantic": {"tier": "rate", **_NEURONS}},
    "SSP-SLAM, spikes": {"cells": "semantic", "semantic": {"tier": "spiking", **_NEURONS}},
    "RatSLAM and SLRB": {"cells": "pose+place"},
    "full": {},
}
"""Name -> differences from the preset ``full``; landmarks come from a sensor only."""

LOSSES = {
    "nothing is lost": "",
    "camera dark for 60 s": "dark=70-130",
    "ranges gone for 60 s": "blind=70-130",
    "kidnapped by half a lap": "kidnapped=100:0.5",
}
_MARKED = "world:corridor?noise=0.05&compass_deg=3&markers=12&width=320&height=160"
LANDMARKS = {
    "true": ("landmark_reach=6&landmark_noise=0", ["given"]),
    "with noise": ("landmark_reach=6", ["given"]),
    "with noise, 10 % elsewhere": ("landmark_reach=6&outliers=0.1", ["given"]),
    "with noise, without names": ("landmark_reach=6&labels=0", ["given"]),
    "markers in pictures": ("", ["markers"]),
    "known views": ("", ["views"]),
}
"""Kind of landmarks -> options of the world, and ``semantic.landmarks`` of the brain."""

_TESTED = ("RatSLAM", "SLRB", "SSP-SLAM, vectors", "full")


class DriveResult(NamedTuple):
    """Accuracy and cost of a brain on a drive.

    Attributes:
        error_m: Error of each frame on the final map, after rigid alignment to the truth.
        places: Experiences of the map.
        bytes: Size of the state.
        cpu_ms: CPU time of one thread per frame.
    """

    error_m: np.ndarray
    places: int
    bytes: int
    cpu_ms: float

    @property
    def ate_m(self) -> float:
        """Absolute trajectory error (RMSE after rigid alignment)."""
        return float(np.sqrt(np.mean(self.error_m**2)))


class Drive(NamedTuple):
    """A drive for several brains.

    Attributes:
        source: Spec of the source.
        configs: Name of a brain -> its config.
    """

    source: str
    configs: Mapping[str, BrainConfig]


def run_drive(drive: Drive) -> tuple[float, dict[str, DriveResult]]:
    """Run brains on the same frames; return the ATE of odometry alone (m), and their results."""
    frames = list(open_source(drive.source))
    results = {name: run_brain(config, frames) for name, config in drive.configs.items()}
    return _rms(_errors_m(_dead_reckoned(frames), frames)), results


def compare(
    _data_folder: Path | None,
    out_folder: Path,
    worlds: Sequence[str] = WORLDS,
    seeds: Sequence[int] = (0, 1, 2),
    laps: float = 4.0,
    methods: Sequence[str] = tuple(METHODS),
    losses: Sequence[str] = tuple(LOSSES),
    jobs: int | None = None,
    ray: str | None = None,
) -> dict[str, Any]:
    """Compare all methods in rendered worlds, with all sensors and with a failing sensor.

    Args:
        _data_folder: Not used.
        out_folder: ``results.json``, ``comparison.png`` and ``losses.png`` are written there.
        worlds: Names of rendered worlds.
        seeds: Seed of the noise of each drive.
        laps: Laps of each drive; drives with a failing sensor are six laps of the first world.
        methods: Names in ``METHODS``.
        losses: Names in ``LOSSES``.
        jobs: As for :func:`neuroslam.runs.parallel.parallel_map`: drives in parallel.
        ray: As for :func:`neuroslam.runs.parallel.parallel_map`.

    Returns:
        The content of ``results.json``: ``rows``, one for each world and method, and ``losses``.
    """
    out = Path(out_folder)
    rows: list[dict[str, Any]] = []
    configs = {name: config_of(name) for name in methods}
    drives = [
        Drive(f"world:{world}?{SENSES}&laps={laps:g}&seed={seed}", configs)
        for world in worlds
        for seed in seeds
    ]
    driven = iter(parallel_map(run_drive, drives, jobs, ray))
    for world in worlds:
        alone, driven_results = zip(*islice(driven, len(seeds)), strict=True)
        results = {name: [of[name] for of in driven_results] for name in methods}
        rows.append(_row(world, "odometry alone", list(alone)))
        rows += [
            _row(
                world, name, [result.ate_m for result in each],
                places=round(np.mean([result.places for result in each])),
                kilobytes=round(np.mean([result.bytes for result in each]) / 1000.0),
                cpu_ms=float(np.median([result.cpu_ms for result in each])),
            )
            for name, each in results.items()
        ]  # fmt: skip
    tested = {name: configs[name] for name in _TESTED if name in methods}
    drives = [
        Drive(f"world:{worlds[0]}?{SENSES}&laps=6&seed={seeds[0]}&{LOSSES[loss]}", tested)
        for loss in losses
    ]
    lost = dict(zip(losses, parallel_map(run_drive, drives, jobs, ray), strict=True))
    curves = {
        loss: {name: result.error_m for name, result in each.items()}
        for loss, (_, each) in lost.items()
    }
    save(plot_comparison(rows), out / "comparison.png")
    if curves:
        save(plot_losses(curves, {name: LOSSES[name] for name in curves}), out / "losses.png")
    results = {"rows": rows, "losses": _lost(curves)}
    write_results(out, results)
    return results


def pixel_landmarks(
    _data_folder: Path | None,
    out_folder: Path,
    seeds: Sequence[int] = (0, 1, 2),
    laps: float = 4.0,
    jobs: int | None = None,
    ray: str | None = None,
) -> dict[str, Any]:
    """Compare landmarks measured by a sensor with landmarks detected in pictures.

    Args:
        _data_folder: Not used.
        out_folder: ``results.json`` is written there.
        seeds: Seed of the noise of each drive.
        laps: Laps of each drive.
        jobs: As for :func:`neuroslam.runs.parallel.parallel_map`: drives in parallel.
        ray: As for :func:`neuroslam.runs.parallel.parallel_map`.

    Returns:
        The content of ``results.json``: ``rows``, one for each kind of landmarks and set of cells.
    """
    rows, drives = [], []
    for kind, (options, landmarks) in LANDMARKS.items():
        # Known views need pose cells.
        some = ("pose+semantic",) if kind == "known views" else ("semantic", "pose+semantic")
        over = {"semantic": {"landmarks": landmarks}}
        full = merge_values(read_preset("full"), over)
        configs = {cells: build_config(full | {"cells": cells}, kind) for cells in some}
        drives += [
            Drive(f"{_MARKED}&laps={laps:g}&seed={seed}&{options}", configs) for seed in seeds
        ]
    driven = iter(parallel_map(run_drive, drives, jobs, ray))
    for kind in LANDMARKS:
        driven_results = [results for _, results in islice(driven, len(seeds))]
        rows += [
            _row(
                "corridor",
                cells,
                [results[cells].ate_m for results in driven_results],
                landmarks=kind,
            )
            for cells in driven_results[0]
        ]
    results = {"rows": rows}
    write_results(Path(out_folder), results)
    return results


def config_of(method: str) -> BrainConfig:
    """Return the config of a method: the preset ``full`` with the method's differences."""
    base = merge_values(read_preset("full"), {"semantic": {"landmarks": ["given"]}})
    return build_config(merge_values(base, METHODS[method]), method)


def run_brain(
    config: BrainConfig,
    frames: Sequence[Frame],
    prepare: Callable[[NavigationBrain], None] | None = None,
) -> DriveResult:
    """Run a brain on a drive; the CPU time is that of the brain only.

    Args:
        config: Of the brain.
        frames: Of the drive.
        prepare: Changes the brain before its first frame.
    """
    brain, at, cpu_s = NavigationBrain(config), [], 0.0
    if prepare is not None:
        prepare(brain)
    with limit_threads(1), torch.inference_mode():
        for frame in frames:
            begin = time.process_time()
            brain(frame)
            cpu_s += time.process_time() - begin
            at.append((brain.map.current, brain.map.offset))
    track = np.array([brain.place(experience, offset) for experience, offset in at])
    size = sum(value.numel() * value.element_size() for value in brain.state_dict().values())
    first = next(k for k, (experience, _) in enumerate(at) if experience != NO_EXPERIENCE)
    off = np.zeros(len(frames))
    off[first:] = _errors_m(track[first:], frames[first:])
    return DriveResult(off, brain.map.n, size, 1000.0 * cpu_s / len(frames))


def _errors_m(track: np.ndarray, frames: Sequence[Frame]) -> np.ndarray:
    truth = np.array([frame.truth[:2] for frame in frames if frame.truth is not None])
    moved = align(track[:, :2], truth, "rigid").apply(track[:, :2])
    return np.linalg.norm(moved - truth, axis=1)


def _dead_reckoned(frames: Sequence[Frame]) -> np.ndarray:
    times = np.array([frame.time_s for frame in frames])
    v, w = np.array([frame.velocity for frame in frames]).T
    return integrate_velocities(v, w, np.diff(times, prepend=times[0]), Pose(0.0, 0.0, 0.0))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _row(world: str, method: str, ates: list[float], **more: float | str) -> dict[str, Any]:
    return {
        "world": world,
        "method": method,
        "ate_m": float(np.mean(ates)),
        "ate_std_m": float(np.std(ates)),
        "ate_each_m": ates,
        **more,
    }


def _lost(curves: dict[str, dict[str, np.ndarray]]) -> list[dict[str, Any]]:
    """Return the errors of drives of six laps: of all frames, and of the last lap."""
    return [
        {
            "loss": loss,
            "method": method,
            "ate_m": _rms(error_m),
            "largest_error_m": float(error_m.max()),
            "ate_last_lap_m": _rms(error_m[-(len(error_m) // 6) :]),
        }
        for loss, each in curves.items()
        for method, error_m in each.items()
    ]
