"""Localisation by the tiers of SSP-SLAM and by path integration alone, in the plane and in 3D."""

from pathlib import Path
from typing import Any

import numpy as np

from neuroslam.config.semantic import PathIntegratorConfig, SSPSLAMConfig, SSPSpaceConfig
from neuroslam.experiments.boundary_cells import write_results
from neuroslam.experiments.ssp_simulation import (
    Simulation,
    integrate,
    recalled,
    simulate,
    slam_in,
    trials,
)
from neuroslam.figures.spikes import plot_3d, plot_errors, plot_trials
from neuroslam.figures.style import save
from neuroslam.worlds.landmark_paths import LandmarkPath, band_limited_path
from neuroslam.worlds.landmarks import LandmarkWorld, random_world

PAPER = {"SLAM": (0.0529, 0.0315), "path integration": (0.7876, 0.2958)}
"""Absolute trajectory error and its spread, about 480 000 neurons."""
_EARLY_S = 30.0

REFERENCE = PathIntegratorConfig(
    neurons=500,
    tau_s=0.05,
    amplitude_range=(0.0, 2.0**0.5),
    decoder_noise=0.1,
    coupling="none",
    max_speed_m_s=0.4,
)
"""Oscillators as in the reference program: decoders for a whole disc, no coupling."""

_ALGEBRAIC: dict[str, Any] = {"tier": "algebraic", "time_step_s": 0.01}
CONFIGS: dict[str, SSPSLAMConfig] = {
    "algebraic": SSPSLAMConfig(**_ALGEBRAIC),
    "algebraic, phase noise 0.3": SSPSLAMConfig(
        **_ALGEBRAIC, integrator=PathIntegratorConfig(phase_noise_rad=0.3)
    ),
    "rate": SSPSLAMConfig(tier="rate", integrator=PathIntegratorConfig(neurons=640)),
    "spiking": SSPSLAMConfig(integrator=PathIntegratorConfig(neurons=640)),
    "spiking, velocity in neurons": SSPSLAMConfig(
        integrator=PathIntegratorConfig(neurons=640, velocity_neurons=500)
    ),
    "quantised": SSPSLAMConfig(quantised=True, integrator=PathIntegratorConfig(neurons=640)),
    "quantised, velocity in neurons": SSPSLAMConfig(
        quantised=True, integrator=PathIntegratorConfig(neurons=640, velocity_neurons=500)
    ),
    "spiking, exact binding": SSPSLAMConfig(
        binding="exact", integrator=PathIntegratorConfig(neurons=1000)
    ),
    "spiking, reference's oscillators": SSPSLAMConfig(integrator=REFERENCE),
}
"""Name -> config; each is compared with its path integrator alone."""


def ssp_localisation(
    data_folder: Path | None,
    out_folder: Path,
    seconds: float = 120.0,
    n_trials: int = 10,
    methods: tuple[str, ...] = tuple(CONFIGS),
) -> dict[str, Any]:
    """Localise in ten trials with the same landmarks, and in ten with others (Figs. 8 and 9).

    Args:
        data_folder: Folder of the reference's paths and landmarks; ``None``: random ones.
        out_folder: ``results.json``, ``errors.png`` and ``paths.png`` are written there.
        seconds: Duration; 120 in the paper.
        n_trials: Number of trials.
        methods: Names in :data:`CONFIGS`.

    Returns:
        The content of ``results.json``: ``rows``, one for each method and set of landmarks.
    """
    out = Path(out_folder)
    paths, world = trials(data_folder, n_trials, seconds)
    sets = {
        "the same": [world] * len(paths),
        "each its own": [random_world(10, seed=100 + k) for k in range(len(paths))],
    }
    worlds = [w for each in sets.values() for w in each]
    rows, truth = [], _landmarks(worlds)
    simulations: dict[str, Simulation] = {}
    for method in methods:
        alone = integrate(slam_in(CONFIGS[method], world, batch=len(paths)), paths)
        slam = slam_in(CONFIGS[method], world, batch=len(worlds))
        simulation = simulate(slam, worlds, paths * len(sets))
        simulations |= {f"{method}: path integration": alone, f"{method}: SLAM": simulation}
        rows.append(_row(method, "none", slam.integrator.n_neurons, alone, slice(None)))
        wrong = np.linalg.norm(recalled(slam) - truth, axis=-1)
        early = alone.error_m[alone.time_s <= _EARLY_S].mean(0)
        for k, name in enumerate(sets):
            part = slice(k * len(paths), (k + 1) * len(paths))
            known = wrong[part][simulation.seen_s[part] > 1.0]
            worse = simulation.error_m[simulation.time_s <= _EARLY_S][:, part].mean(0) - early
            more = {
                "recall_error_mean_m": float(known.mean()),
                "recall_error_max_m": float(known.max()),
                "early_worse_than_path_integration_m": float(worse.max()),
            }
            rows.append(_row(method, name, slam.n_neurons, simulation, part) | more)
    _figures(simulations, worlds, paths, methods, out)
    return write_results(out, {"seconds": seconds, "trials": len(paths), "rows": rows})


def _landmarks(worlds: list[LandmarkWorld]) -> np.ndarray:
    return np.array([[landmark.position_m for landmark in world.landmarks] for world in worlds])


def _row(
    method: str, landmarks: str, neurons: int, simulation: Simulation, part: slice
) -> dict[str, Any]:
    ate = simulation.ate_m[part]
    name = "path integration" if landmarks == "none" else "SLAM"
    step = simulation.time_s[1] - simulation.time_s[0]
    return {
        "method": method,
        "what": name,
        "landmarks": landmarks,
        "neurons": neurons,
        "ate_mean_m": float(ate.mean()),
        "ate_sd_m": float(ate.std(ddof=1)) if len(ate) > 1 else 0.0,
        "ate_worst_m": float(ate.max()),
        "integrated_rmse_m_s": float(
            np.sqrt((simulation.error_m[:, part] ** 2).mean(1)).sum() * step
        ),
        "early_ate_m": float(simulation.error_m[simulation.time_s <= _EARLY_S][:, part].mean()),
        "similarity_error": float(simulation.similarity_error[:, part].mean()),
        "paper_ate_mean_m": PAPER[name][0],
        "paper_ate_sd_m": PAPER[name][1],
    }


def _figures(
    simulations: dict[str, Simulation],
    worlds: list[LandmarkWorld],
    paths: list[LandmarkPath],
    methods: tuple[str, ...],
    out: Path,
) -> None:
    shown = [m for m in methods if m.startswith("spiking")] or list(methods)
    pairs = [f"{m}: {c}" for m in shown for c in ("path integration", "SLAM")]
    first = simulations[pairs[0]]
    panels = {
        "similarity error (1 - cosine)": {n: simulations[n].similarity_error for n in pairs},
        "distance error (m)": {n: simulations[n].error_m for n in pairs},
    }
    title = f"Localisation error in {len(worlds)} trials: mean, 10th to 90th percentile"
    save(plot_errors(first.time_s, panels, title), out / "errors.png")
    method = shown[-1]
    n = len(paths)
    drawn = {}
    for k in range(min(n, 10)):
        both = {c: simulations[f"{method}: {c}"] for c in ("SLAM", "path integration")}
        head = (
            f"Trial {k + 1}|{both['SLAM'].ate_m[k]:.3f} / {both['path integration'].ate_m[k]:.3f} m"
        )
        drawn[head] = (
            first.truth_m[:, k],
            _landmarks(worlds)[k],
            {c: simulation.position_m[:, k] for c, simulation in both.items()},
        )
    title = f"True and estimated paths, {method}; mean error of SLAM / path integration"
    save(plot_trials(drawn, title), out / "paths.png")


def ssp_3d(
    _data_folder: Path | None,
    out_folder: Path,
    seconds: float = 60.0,
    neurons: int = 400,
    n_trials: int = 3,
) -> dict[str, Any]:
    """Localise in three dimensions (Fig. 10); only the space differs.

    Args:
        _data_folder: Not used.
        out_folder: ``results.json`` and ``path.png`` are written there.
        seconds: Duration.
        neurons: Neurons of each oscillator.
        n_trials: Number of trials.

    Returns:
        The content of ``results.json``: ``rows``, one for each method.
    """
    out = Path(out_folder)
    paths = [
        band_limited_path(max(seconds, 60.0), 0.08, 3, seed=k, time_step_s=0.01).first(seconds)
        for k in range(n_trials)
    ]
    fastest = max(float(np.linalg.norm(path.velocity_m_s, axis=-1).max()) for path in paths)
    # The paper does not give the view radius; ten landmarks in a cube are seldom in view.
    worlds = [random_world(10, 3, seed=10 + k, view_radius_m=0.4) for k in range(n_trials)]
    space = SSPSpaceConfig(dimension=3, n_rotations=3, n_scales=3)
    rows, paths_by_name = [], {}
    tiers: dict[str, dict[str, Any]] = {"algebraic": _ALGEBRAIC, "spiking": {"binding": "exact"}}
    for tier, more in tiers.items():
        config = SSPSLAMConfig(
            space=space,
            integrator=PathIntegratorConfig(neurons=neurons, max_speed_m_s=1.05 * fastest),
            **more,
        )
        for name in ("path integration", "SLAM"):
            slam = slam_in(config, worlds[0], batch=n_trials)
            simulation = simulate(slam, worlds, paths) if name == "SLAM" else integrate(slam, paths)
            rows.append(
                {
                    "tier": tier,
                    "what": name,
                    "neurons": (slam if name == "SLAM" else slam.integrator).n_neurons,
                    "ate_mean_m": float(simulation.ate_m.mean()),
                    "rmse_m": float(np.sqrt((simulation.error_m**2).mean())),
                    "rmse_last_10_s_m": float(
                        np.sqrt((simulation.error_m[simulation.time_s > seconds - 10] ** 2).mean())
                    ),
                }
            )
            if tier == "spiking":
                paths_by_name[f"{name}: mean error {simulation.ate_m[0]:.3f} m"] = (
                    simulation.position_m[:, 0]
                )
    landmarks = _landmarks(worlds)[0]
    title = f"True and estimated path in three dimensions, {rows[-1]['neurons']} spiking neurons"
    save(plot_3d(simulation.truth_m[:, 0], paths_by_name, landmarks, title), out / "path.png")
    return write_results(out, {"seconds": seconds, "trials": n_trials, "rows": rows})
