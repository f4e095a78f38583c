"""Dead reckoning of SSP-SLAM's oscillators along KITTI 00, plainly and as on a chip."""

from pathlib import Path
from typing import Any

import numpy as np
import torch

from neuroslam.config.semantic import NeuronConfig, PathIntegratorConfig, SSPSpaceConfig
from neuroslam.experiments.boundary_cells import write_results
from neuroslam.figures.maps import save
from neuroslam.figures.spikes import Run, plot_dead_reckoning
from neuroslam.spiking.path_integrator import PathIntegrator
from neuroslam.spiking.quantise import quantised
from neuroslam.spiking.space import SSPSpace
from neuroslam.worlds.landmark_paths import LandmarkPath, read_kitti

PAPER_NEURONS = 90_000
SPACE = SSPSpaceConfig(dimension=3, n_rotations=3, n_scales=3, length_scale_m=0.3)


def ssp_kitti(
    data_folder: Path,
    out_folder: Path,
    seconds: float = 60.0,
    budgets: tuple[int, ...] = (PAPER_NEURONS, PAPER_NEURONS // 10),
) -> dict[str, Any]:
    """Integrate the velocity along a KITTI sequence in three dimensions (Fig. 11).

    The sequence of 471 s is gone through in less: neurons represent a range of speeds, and a path
    in a box of side 1.8 that takes minutes would be hardly faster than their drift.

    Args:
        data_folder: With KITTI 00's poses and times.
        out_folder: ``results.json`` and ``reckoning.png`` are written there.
        seconds: In which the whole sequence is gone through.
        budgets: Neurons in all.

    Returns:
        The content of ``results.json``: ``rows``, one for each integrator.
    """
    out = Path(out_folder)
    path = _in_time(read_kitti(data_folder, time_step_s=0.05), seconds)
    rows, runs, truth = [], [], None
    for budget in budgets:
        for chip in (False, True):
            life = _reckon(path, budget, chip)
            label = f"{'quantised' if chip else 'plain'}, {budget // 1000}k neurons"
            runs.append(life._replace(label=label))
            rows.append(
                {
                    "integrator": label,
                    "neurons": budget,
                    "rmse": float(np.sqrt((life.error_m**2).mean())),
                    "rmse_m": float(np.sqrt((life.error_m**2).mean()) * path.metres),
                    "rmse_last_tenth": float(
                        np.sqrt((life.error_m[-len(life.error_m) // 10 :] ** 2).mean())
                    ),
                    "probability_of_truth": float(life.probability.mean()),
                }
            )
    every = round(0.1 / path.time_step_s)
    at = path.position_m[every - 1 :: every]
    truth = Run("truth", path.time_s[every - 1 :: every], at, np.zeros(len(at)))
    title = f"KITTI 00, dead reckoning in three dimensions (1 m here is {path.metres:.0f} m there)"
    save(plot_dead_reckoning(truth, runs, title), out / "reckoning.png")
    return write_results(out, {"seconds": seconds, "metres_per_unit": path.metres, "rows": rows})


def _in_time(path: LandmarkPath, seconds: float, time_step_s: float = 1e-3) -> LandmarkPath:
    """Go through a path in another time."""
    quicker = path.time_s[-1] / seconds
    return path._replace(time_step_s=path.time_step_s / quicker).resampled(time_step_s)


@torch.inference_mode()
def _reckon(path: LandmarkPath, budget: int, chip: bool) -> Run:
    space = SSPSpace.from_config(SPACE)
    speed = float(np.linalg.norm(path.velocity_m_s, axis=-1).max())
    config = PathIntegratorConfig(
        neurons=budget // space.n_frequencies, max_speed_m_s=round(1.05 * speed, 2)
    )
    neurons = NeuronConfig(model="stepped_lif" if chip else "lif")
    walk = PathIntegrator(space, config, neurons, path.time_step_s)
    if chip:
        walk = quantised(walk)
    walk.start(torch.from_numpy(path.position_m[:1]))
    every = round(0.1 / path.time_step_s)
    where, likely = [], []
    for k, v in enumerate(torch.from_numpy(path.velocity_m_s[:, None]).float()):
        z = walk(v)
        if (k + 1) % every == 0:
            at = torch.from_numpy(path.position_m[k][None]).float()
            where.append(walk.position_m[0].numpy().copy())
            best = float(walk.decoder.similarity(z, walk.position_m))
            likely.append(max(0.0, float(walk.decoder.similarity(z, at))) / max(best, 1e-6))
    where = np.array(where, dtype=np.float64)
    truth = path.position_m[every - 1 :: every][: len(where)]
    error = np.linalg.norm(where - truth, axis=-1)
    time = path.time_s[every - 1 :: every][: len(where)]
    return Run("", time, where, error, np.clip(np.array(likely), 0.0, 1.0))
