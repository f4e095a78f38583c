"""Localisation by SSP-SLAM: its tiers beside path integration alone, and in three dimensions."""

from pathlib import Path
from typing import Any

import numpy as np

from neuroslam.config.semantic import PathIntegratorConfig, SSPSLAMConfig, SSPSpaceConfig
from neuroslam.experiments.boundary_cells import write_results
from neuroslam.experiments.ssp_lives import (
    Life,
    integrate,
    live,
    recalled,
    slam_in,
    trials,
)
from neuroslam.figures.maps import save
from neuroslam.figures.spikes import plot_3d, plot_errors, plot_trials
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
"""Oscillators as in the reference program: decoders for a whole disc, none knows another."""

_ALGEBRAIC = {"tier": "algebraic", "time_step_s": 0.01}
CONFIGS: dict[str, SSPSLAMConfig] = {
    "algebraic": SSPSLAMConfig(**_ALGEBRAIC),
    "algebraic, phase noise 0.3": SSPSLAMConfig(
        **_ALGEBRAIC, integrator=PathIntegratorConfig(phase_noise_rad=0.3)
    ),
    "rate": SSPSLAMConfig(tier="rate", integrator=PathIntegratorConfig(neurons=640)),
    "spiking": SSPSLAMConfig(integrator=PathIntegratorConfig(neurons=640)),
    "spiking, exact binding": SSPSLAMConfig(
        binding="exact", integrator=PathIntegratorConfig(neurons=1000)
    ),
    "spiking, reference's oscillators": SSPSLAMConfig(integrator=REFERENCE),
}
"""What is compared, each with its path integrator alone."""


def ssp_localisation(
    data_folder: Path | None,
    out_folder: Path,
    seconds: float = 120.0,
    n_trials: int = 10,
    methods: tuple[str, ...] = tuple(CONFIGS),
) -> dict[str, Any]:
    """Localise in ten trials with the same landmarks, and in ten with others (Figs. 8 and 9).

    Args:
        data_folder: With the reference's paths and landmarks; ``None``: random ones like them.
        out_folder: ``results.json``, ``errors.png`` and ``paths.png`` are written there.
        seconds: How long; the paper has 120.
        n_trials: How many.
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
    rows, lives, truth = [], {}, _landmarks(worlds)
    for method in methods:
        alone = integrate(slam_in(CONFIGS[method], world, batch=len(paths)), paths)
        slam = slam_in(CONFIGS[method], world, batch=len(worlds))
        life = live(slam, worlds, paths * len(sets))
        lives |= {f"{method}: path integration": alone, f"{method}: SLAM": life}
        rows.append(_row(method, "none", slam.integrator.n_neurons, alone, slice(None)))
        wrong = np.linalg.norm(recalled(slam) - truth, axis=-1)
        early = alone.error_m[alone.time_s <= _EARLY_S].mean(0)
        for k, name in enumerate(sets):
            part = slice(k * len(paths), (k + 1) * len(paths))
            known = wrong[part][life.seen_s[part] > 1.0]
            worse = life.error_m[life.time_s <= _EARLY_S][:, part].mean(0) - early
            more = {
                "recall_error_mean_m": float(known.mean()),
                "recall_error_max_m": float(known.max()),
                "early_worse_than_path_integration_m": float(worse.max()),
            }
            rows.append(_row(method, name, slam.n_neurons, life, part) | more)
    _figures(lives, worlds, paths, methods, out)
    return write_results(out, {"seconds": seconds, "trials": len(paths), "rows": rows})


def _landmarks(worlds: list[LandmarkWorld]) -> np.ndarray:
    return np.array([[landmark.position_m for landmark in world.landmarks] for world in worlds])


def _row(method: str, landmarks: str, neurons: int, life: Life, part: slice) -> dict[str, Any]:
    ate = life.ate_m[part]
    name = "path integration" if landmarks == "none" else "SLAM"
    step = life.time_s[1] - life.time_s[0]
    return {
        "method": method,
        "what": name,
        "landmarks": landmarks,
        "neurons": neurons,
        "ate_mean_m": float(ate.mean()),
        "ate_sd_m": float(ate.std(ddof=1)) if len(ate) > 1 else 0.0,
        "ate_worst_m": float(ate.max()),
        "integrated_rmse_m_s": float(np.sqrt((life.error_m[:, part] ** 2).mean(1)).sum() * step),
        "early_ate_m": float(life.error_m[life.time_s <= _EARLY_S][:, part].mean()),
        "similarity_error": float(life.similarity_error[:, part].mean()),
        "paper_ate_mean_m": PAPER[name][0],
        "paper_ate_sd_m": PAPER[name][1],
    }


def _figures(
    lives: dict[str, Life],
    worlds: list[LandmarkWorld],
    paths: list[LandmarkPath],
    methods: tuple[str, ...],
    out: Path,
) -> None:
    shown = [m for m in methods if m.startswith("spiking")] or list(methods)
    pairs = [f"{m}: {c}" for m in shown for c in ("path integration", "SLAM")]
    first = lives[pairs[0]]
    panels = {
        "similarity error (1 - cosine)": {n: lives[n].similarity_error for n in pairs},
        "distance error (m)": {n: lives[n].error_m for n in pairs},
    }
    title = f"Localisation in {len(worlds)} trials: mean, 10th to 90th percentile"
    save(plot_errors(first.time_s, panels, title), out / "errors.png")
    method = shown[-1]
    n = len(paths)
    drawn = {}
    for k in range(min(n, 10)):
        both = {c: lives[f"{method}: {c}"] for c in ("SLAM", "path integration")}
        head = (
            f"Trial {k + 1}|{both['SLAM'].ate_m[k]:.3f} / {both['path integration'].ate_m[k]:.3f} m"
        )
        drawn[head] = (
            first.truth_m[:, k],
            _landmarks(worlds)[k],
            {c: life.position_m[:, k] for c, life in both.items()},
        )
    what = f"Paths, {method}: ATE of SLAM / path integration"
    save(plot_trials(drawn, what), out / "paths.png")


def ssp_3d(
    _data_folder: Path | None,
    out_folder: Path,
    seconds: float = 60.0,
    neurons: int = 400,
    n_trials: int = 3,
) -> dict[str, Any]:
    """Localise in three dimensions (Fig. 10): nothing is different but the space.

    Args:
        _data_folder: None is needed.
        out_folder: ``results.json`` and ``path.png`` are written there.
        seconds: How long.
        neurons: Of each oscillator.
        n_trials: How many.

    Returns:
        The content of ``results.json``: ``rows``, one for each method.
    """
    out = Path(out_folder)
    paths = [
        band_limited_path(max(seconds, 60.0), 0.08, 3, seed=k, time_step_s=0.01).first(seconds)
        for k in range(n_trials)
    ]
    fastest = max(np.linalg.norm(path.velocity_m_s, axis=-1).max() for path in paths)
    # Ten landmarks in a cube are seldom in view; the paper does not say from how far they are.
    worlds = [random_world(10, 3, seed=10 + k, view_radius_m=0.4) for k in range(n_trials)]
    space = SSPSpaceConfig(dimension=3, n_rotations=3, n_scales=3)
    rows, ways = [], {}
    for tier, more in (("algebraic", _ALGEBRAIC), ("spiking", {"binding": "exact"})):
        config = SSPSLAMConfig(
            space=space,
            integrator=PathIntegratorConfig(neurons=neurons, max_speed_m_s=1.05 * fastest),
            **more,
        )
        for name in ("path integration", "SLAM"):
            slam = slam_in(config, worlds[0], batch=n_trials)
            life = live(slam, worlds, paths) if name == "SLAM" else integrate(slam, paths)
            rows.append(
                {
                    "tier": tier,
                    "what": name,
                    "neurons": (slam if name == "SLAM" else slam.integrator).n_neurons,
                    "ate_mean_m": float(life.ate_m.mean()),
                    "rmse_m": float(np.sqrt((life.error_m**2).mean())),
                    "rmse_last_10_s_m": float(
                        np.sqrt((life.error_m[life.time_s > seconds - 10] ** 2).mean())
                    ),
                }
            )
            if tier == "spiking":
                ways[f"{name}: ATE {life.ate_m[0]:.3f} m"] = life.position_m[:, 0]
    landmarks = _landmarks(worlds)[0]
    title = f"Spiking SLAM in three dimensions, {rows[-1]['neurons']} neurons"
    save(plot_3d(life.truth_m[:, 0], ways, landmarks, title), out / "path.png")
    return write_results(out, {"seconds": seconds, "trials": n_trials, "rows": rows})
