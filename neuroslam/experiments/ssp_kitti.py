"""Dead reckoning by SSP-SLAM's oscillators along KITTI, in floating point and quantised."""

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neuroslam.config.semantic import NeuronConfig, PathIntegratorConfig, SSPSpaceConfig
from neuroslam.experiments.boundary_cells import write_results
from neuroslam.figures.spikes import Run, plot_dead_reckoning
from neuroslam.figures.style import save
from neuroslam.spiking.path_integrator import PathIntegrator
from neuroslam.spiking.quantise import quantised
from neuroslam.spiking.rounding import WEIGHT_BITS
from neuroslam.spiking.space import SSPSpace
from neuroslam.worlds.landmark_paths import LandmarkPath, read_kitti

PAPER_NEURONS = 90_000
VELOCITY_NEURONS = 500
"""Neurons of the velocity where it is not exact; they come on top of the budget."""
SPACE = SSPSpaceConfig(dimension=3, n_rotations=3, n_scales=3, length_scale_m=0.3)


def ssp_kitti(
    data_folder: Path,
    out_folder: Path,
    seconds: float = 60.0,
    budgets: tuple[int, ...] = (PAPER_NEURONS, PAPER_NEURONS // 10),
    sequence: str = "00",
) -> dict[str, Any]:
    """Integrate the velocity along a KITTI sequence in three dimensions (Fig. 11).

    The sequence (00 lasts 471 s) is compressed in time: neurons represent a range of speeds, and in
    a box of side 1.8 the speed of the original would be hardly above their drift.

    Args:
        data_folder: Folder of the poses and times; see
            :func:`~neuroslam.worlds.landmark_paths.kitti_files`.
        out_folder: ``results.json`` and ``reckoning.png`` are written there.
        seconds: Duration of the whole sequence after compression.
        budgets: Total numbers of neurons of the oscillators; each with the exact velocity, and with
            that of ``VELOCITY_NEURONS`` further neurons.
        sequence: Number of the sequence, 00 to 10: those whose true poses are published.

    Returns:
        The content of ``results.json``: ``rows``, one for each integrator.
    """
    out = Path(out_folder)
    path = _in_time(read_kitti(data_folder, sequence, time_step_s=0.05), seconds)
    rows, runs = [], []
    for budget in budgets:
        for chip, velocity in product((False, True), (0, VELOCITY_NEURONS)):
            run, probability = _reckon(path, budget, chip, velocity)
            label = f"{'quantised' if chip else 'plain'}, {budget // 1000}k neurons"
            label += ", velocity in neurons" if velocity else ""
            runs.append(run._replace(label=label, paired=velocity > 0))
            rows.append(
                {
                    "integrator": label,
                    "neurons": budget + velocity,
                    "velocity_neurons": velocity,
                    "rmse": float(np.sqrt((run.error_m**2).mean())),
                    "rmse_m": float(np.sqrt((run.error_m**2).mean()) * path.metres),
                    "rmse_last_tenth": float(
                        np.sqrt((run.error_m[-len(run.error_m) // 10 :] ** 2).mean())
                    ),
                    "probability_of_truth": float(probability.mean()),
                }
            )
    every = round(0.1 / path.time_step_s)
    at = path.position_m[every - 1 :: every]
    truth = Run("truth", path.time_s[every - 1 :: every], at, np.zeros(len(at)))
    title = (
        f"Dead reckoning on KITTI {sequence} in three dimensions "
        f"(1 m is {path.metres:.0f} m of KITTI)"
    )
    save(plot_dead_reckoning(truth, runs, title), out / "reckoning.png")
    about = {"sequence": sequence, "seconds": seconds, "metres_per_unit": path.metres}
    return write_results(out, {**about, "rows": rows})


def _in_time(path: LandmarkPath, seconds: float, time_step_s: float = 1e-3) -> LandmarkPath:
    """Compress a path in time."""
    speed_up = path.time_s[-1] / seconds
    return path._replace(time_step_s=path.time_step_s / speed_up).resampled(time_step_s)


@torch.inference_mode()
def _reckon(
    path: LandmarkPath, budget: int, chip: bool, velocity_neurons: int
) -> tuple[Run, np.ndarray]:
    space = SSPSpace.from_config(SPACE)
    speed = float(np.linalg.norm(path.velocity_m_s, axis=-1).max())
    config = PathIntegratorConfig(
        neurons=budget // space.n_frequencies,
        max_speed_m_s=round(1.05 * speed, 2),
        velocity_neurons=velocity_neurons,
    )
    chip_neurons = NeuronConfig(model="stepped_lif", weight_bits=WEIGHT_BITS)
    neurons = chip_neurons if chip else NeuronConfig()
    integrator = PathIntegrator(space, config, neurons, path.time_step_s)
    if chip:
        integrator = quantised(integrator)
    integrator.start(torch.from_numpy(path.position_m[:1]))
    every = round(0.1 / path.time_step_s)
    positions, probabilities = [], []
    for k, v in enumerate(torch.from_numpy(path.velocity_m_s[:, None]).float()):
        z = integrator(v)
        if (k + 1) % every == 0:
            at = torch.from_numpy(path.position_m[k][None]).float()
            positions.append(integrator.position_m[0].numpy().copy())
            best = float(integrator.decoder.similarity(z, integrator.position_m))
            probabilities.append(
                max(0.0, float(integrator.decoder.similarity(z, at))) / max(best, 1e-6)
            )
    estimate = np.array(positions, dtype=np.float64)
    truth = path.position_m[every - 1 :: every][: len(estimate)]
    error = np.linalg.norm(estimate - truth, axis=-1)
    time = path.time_s[every - 1 :: every][: len(estimate)]
    probability = np.clip(np.array(probabilities), 0.0, 1.0)
    return Run("", time, estimate, error, probability), probability
