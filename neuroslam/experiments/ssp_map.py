"""Queries of a semantic map: by name, by attribute, by area, by vector."""

from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from neuroslam.config.semantic import (
    PathIntegratorConfig,
    SemanticMapConfig,
    SSPSLAMConfig,
    SSPSpaceConfig,
)
from neuroslam.experiments.boundary_cells import write_results
from neuroslam.experiments.ssp_simulation import pointers_of, recalled, simulate, slam_in, views
from neuroslam.figures.landmarks import Query, plot_area, plot_posterior, plot_queries, plot_vectors
from neuroslam.figures.style import save
from neuroslam.spiking import queries
from neuroslam.spiking.decoding import probability
from neuroslam.spiking.slam import SSPSLAM, SSPStep
from neuroslam.worlds.landmark_paths import LandmarkPath, band_limited_path
from neuroslam.worlds.landmarks import LandmarkWorld, paper_world, random_world

_GRID = 81  # points a side of a similarity map
_RIGHT_M = 0.05
_SEEN_S = 1.0
_KEPT = 50  # steps between two records of the vectors


def ssp_map(
    _data_folder: Path | None,
    out_folder: Path,
    seconds: float = 60.0,
    tier: Literal["algebraic", "rate", "spiking"] = "spiking",
    n_random_maps: int = 100,
    random_seconds: float = 120.0,
) -> dict[str, Any]:
    """Map the paper's world, answer the paper's queries, and count answers in random worlds.

    Args:
        _data_folder: Not used.
        out_folder: ``results.json``, ``queries.png``, ``vectors.png``, ``area.png``,
            ``whole_map.png`` and ``posterior.png`` are written there (Figs. 3 to 6, and 1).
        seconds: Duration of the walk; 60 in the paper.
        tier: Tier of the map that is drawn; random maps are algebraic.
        n_random_maps: Number of random maps.
        random_seconds: Duration of the walk in each of them.

    Returns:
        The content of ``results.json``: ``rows``, one for each query.
    """
    out, world = Path(out_folder), paper_world()
    path = band_limited_path(seconds, 0.06, seed=4, time_step_s=0.01, reach_m=0.95)
    space = SSPSpaceConfig(n_rotations=5, n_scales=5, reach_m=1.2)
    config = SSPSLAMConfig(
        tier=tier,
        time_step_s=0.01 if tier == "algebraic" else 1e-3,
        space=space,
        integrator=PathIntegratorConfig(neurons=400),
        map=SemanticMapConfig(neurons=1000, intercept=0.3, voja_rate=0.0),
        places=True,
        binding="exact",
        vector_neurons=0,  # a wall reaches farther than object-vector cells do
    )
    slam = slam_in(config, world)
    snapshots, vectors = _watched(slam, world, path)
    rows = _answers(slam, world, path, out)
    _vectors(slam, world, vectors, out)
    save(
        plot_posterior(world, path.position_m, snapshots, "Belief about the animal's position"),
        out / "posterior.png",
    )
    rows += count_right(n_random_maps, seconds=random_seconds)
    return write_results(
        out, {"seconds": seconds, "tier": tier, "neurons": slam.n_neurons, "rows": rows}
    )


def similarity_map(slam: SSPSLAM, z: torch.Tensor, points: int = _GRID) -> np.ndarray:
    """Return the similarity of a vector with each position of the plane, ``(n_y, n_x)``."""
    low, high = slam.space.bounds_m.T
    x, y = (torch.linspace(float(a), float(b), points) for a, b in zip(low, high, strict=True))
    at = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1).to(low)
    with torch.inference_mode():
        return (
            slam.space.similarity(slam.space.from_fourier(z), at.reshape(-1, 2))
            .reshape(points, points)
            .numpy(force=True)
        )


def _watched(
    slam: SSPSLAM, world: LandmarkWorld, path: LandmarkPath
) -> tuple[dict[str, tuple[np.ndarray, np.ndarray]], dict[str, Any]]:
    """Run along a path; return beliefs at four times, and the vectors to landmarks over time."""
    path = path.resampled(slam.config.time_step_s)
    n, dt = len(path.position_m), path.time_step_s
    shown = {round(n * share) - 1 for share in (0.05, 0.35, 0.65, 1.0)}
    every = max(1, round(_KEPT * 1e-3 / dt))
    snapshots: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    kept: list[tuple[int, torch.Tensor]] = []
    cell = float((slam.space.bounds_m[0, 1] - slam.space.bounds_m[0, 0]) / (_GRID - 1)) ** 2

    def watch(step: int, step_result: SSPStep) -> None:
        if step in shown:
            alike = torch.from_numpy(similarity_map(slam, step_result.z[0])).flatten()
            density, _ = probability(alike, cell)
            snapshots[f"{(step + 1) * dt:.0f} s"] = (
                density.reshape(_GRID, _GRID).numpy(),
                path.position_m[step],
            )
        if step % every == every - 1:
            kept.append((step, queries.vectors_to(slam, step_result.z[0])))

    slam.start(torch.from_numpy(path.position_m[:1]))
    view = views([world], path.position_m[:, None])
    slam.run(torch.from_numpy(path.velocity_m_s[:, None]), view, watch)
    steps = np.array([step for step, _ in kept])
    return snapshots, {
        "time_s": (steps + 1) * dt,
        "truth_m": path.position_m[steps],
        "z": torch.stack([z for _, z in kept]),
        "first_s": np.where(view.in_view[:, 0].any(0), view.in_view[:, 0].argmax(0) * dt, np.inf),
        "seen_s": view.in_view[:, 0].sum(0) * dt,
    }


def _answers(
    slam: SSPSLAM, world: LandmarkWorld, path: LandmarkPath, out: Path
) -> list[dict[str, Any]]:
    """Query landmarks, attributes, walls and an area."""
    words = pointers_of(world, slam.space.n_features, slam.config.seed)
    asked = {
        "BLUE * TRIANGLE": ["BLUE_TRIANGLE"],
        "BLUE * (SQUARE + TRIANGLE)": ["BLUE_SQUARE", "BLUE_TRIANGLE"],
        "(BLUE + ORANGE) * TRIANGLE": ["BLUE_TRIANGLE", "ORANGE_TRIANGLE"],
        "WALL": ["WALL"],
    }
    rows, drawn = [], []
    for query, names in asked.items():
        z = queries.recall(slam, words.parse(query))
        drawn.append(Query(query, similarity_map(slam, z), names))
        truth = np.stack([world.named(name).position_m for name in names])
        if world.named(names[0]).is_point:
            found = queries.places_in(slam.space, z).position_m.numpy(force=True)
            far = np.linalg.norm(found[:, None] - truth, axis=-1)
            error = far.min(0) if len(found) else np.full(len(truth), np.inf)
            rows.append({"question": query, "places": len(found), "error_m": float(error.max())})
        else:
            region = torch.from_numpy(world.named(names[0]).boxes_m)
            phi = slam.space.region_fourier(region[:, 0], region[:, 1])
            size = torch.from_numpy((region[:, 1] - region[:, 0]).prod(-1).numpy())
            true = (phi * size.unsqueeze(-1).to(phi.real)).sum(0)
            alike = (z * true.conj()).real.sum() / (z.abs().square().sum().sqrt() * _norm(true))
            rows.append({"question": query, "similarity": float(alike)})
    title = f"Answers of a map to queries, {slam.config.tier} tier, {slam.n_neurons} neurons"
    save(plot_queries(world, path.position_m, drawn, title), out / "queries.png")
    low, high = np.array([-0.45, -0.45]), np.array([0.9, 0.5])
    amounts = queries.what(slam, low.tolist(), high.tolist())
    save(
        plot_area(world, low, high, amounts, "Query of an area: landmarks that it contains"),
        out / "area.png",
    )
    for name, amount in amounts.items():
        rows.append({"question": f"area: {name}", "amount": amount})
    whole = queries.whole_map(slam)
    parts = []
    for landmark in world.landmarks:
        key = words.parse(landmark.pointer)
        z = slam.space.to_fourier(
            torch.fft.irfft(
                torch.fft.rfft(whole) * torch.fft.rfft(key).conj(), n=slam.space.n_features
            )
        )
        parts.append(Query(landmark.pointer, similarity_map(slam, z), [landmark.name]))
    title = "The whole map as one vector, unbound by the pointer of each landmark"
    save(plot_queries(world, None, parts, title), out / "whole_map.png")
    return rows


def _norm(z: torch.Tensor) -> torch.Tensor:
    return z.abs().square().sum().sqrt()


def _vectors(slam: SSPSLAM, world: LandmarkWorld, kept: dict[str, Any], out: Path) -> None:
    """Draw the vectors to point landmarks and their errors."""
    points = [k for k, landmark in enumerate(world.landmarks) if landmark.is_point]
    names = [world.names[k] for k in points]
    alike, far, arrows = {}, {}, {}
    for k, name in zip(points, names, strict=True):
        z = kept["z"][:, k]
        truth = world.landmarks[k].position_m - kept["truth_m"]
        with torch.inference_mode():
            true = slam.space.encode_fourier(torch.from_numpy(truth))
            size = z.abs().square().mean(-1).sqrt().clamp_min(1e-6)
            alike[name] = (1.0 - (z * true.conj()).real.mean(-1) / size).numpy(force=True)
            there = _beyond(slam, z)
        far[name] = np.linalg.norm(there - truth, axis=-1)
        arrows[name] = there[-1]
    where = recalled(slam)[0]
    figure = plot_vectors(
        world,
        slam.integrator.position_m[0].numpy(force=True),
        {name: where[k] for k, name in zip(points, names, strict=True)},
        arrows,
        kept["time_s"],
        alike,
        far,
        {name: float(kept["first_s"][k]) for k, name in zip(points, names, strict=True)},
        "Vectors to landmarks, and their errors over time",
    )
    save(figure, out / "vectors.png")


def _beyond(slam: SSPSLAM, z: torch.Tensor) -> np.ndarray:
    """Decode displacements, which reach twice as far as positions."""
    from neuroslam.spiking.decoding import PositionDecoder
    from neuroslam.spiking.space import SSPSpace

    space = slam.space
    wide = SSPSpace(space.frequencies, space.length_scale_m.tolist(), 2.0 * space.bounds_m)
    return PositionDecoder(wide)(z).position_m.numpy(force=True)


def count_right(
    n_maps: int, noise_rad: float = 0.0, seconds: float = 120.0
) -> list[dict[str, Any]]:
    """Count correct answers in random maps: ten landmarks of five colours and five shapes each.

    The answer to an attribute is correct if it has as many positions as landmarks that were in view
    for a second, each within 5 cm. The answer to an area is correct if it is so for all of those
    landmarks.

    Args:
        n_maps: Number of maps, in one batch.
        noise_rad: Standard deviation of the phase noise.
        seconds: Duration of the exploration of each.
    """
    if n_maps < 1:
        return []
    worlds = [_named_alike(random_world(10, seed=k, view_radius_m=0.3)) for k in range(n_maps)]
    config = SSPSLAMConfig(
        tier="algebraic",
        time_step_s=0.01,
        space=SSPSpaceConfig(n_rotations=5, n_scales=5),
        integrator=PathIntegratorConfig(phase_noise_rad=noise_rad),
        places=True,
    )
    paths = [
        band_limited_path(seconds, 0.08, seed=1000 + k, time_step_s=0.01) for k in range(n_maps)
    ]
    slam = slam_in(config, worlds[0], n_maps)
    simulation = simulate(slam, worlds, paths)
    seen = simulation.seen_s > _SEEN_S
    truth = np.array([[m.position_m for m in world.landmarks] for world in worlds])
    wrong = np.linalg.norm(recalled(slam) - truth, axis=-1)
    names = [m.pointer for m in worlds[0].landmarks]
    attributes = sorted({word for name in names for word in name.split(" * ")})
    draw = np.random.default_rng(0)
    right: dict[str, list[bool]] = {
        "attribute": [], "area, memory of places": [], "area, places recalled": [],
    }  # fmt: skip
    for k in range(n_maps):
        found_all = []
        for word in attributes:
            mine = np.array([word in name for name in names]) & seen[k]
            if mine.any():
                z = queries.recall(slam, slam.pointers[mine].sum(0), k)
                at = queries.places_in(slam.space, z).position_m.numpy(force=True)
                far = np.linalg.norm(at[:, None] - truth[k, mine], axis=-1)
                found_all.append(len(at) == mine.sum() and bool((far.min(0) <= _RIGHT_M).all()))
        right["attribute"].append(all(found_all))
        middle, half = draw.uniform(-0.5, 0.5, 2), draw.uniform(0.25, 0.45, 2)
        low, high = middle - half, middle + half
        box = low.tolist(), high.tolist()
        inside = ((truth[k] >= low) & (truth[k] <= high)).all(-1)
        amounts = np.array(list(queries.what(slam, *box, k).values()))
        right["area, memory of places"].append(bool(((amounts > 0.5) == inside)[seen[k]].all()))
        recalled_names = queries.landmarks_in(slam, *box, k)
        within = np.array([name in recalled_names for name in slam.names])
        right["area, places recalled"].append(bool((within == inside)[seen[k]].all()))
    rows = [
        {"question": f"{what}, random maps", "maps": n_maps, "right": int(np.sum(answers))}
        for what, answers in right.items()
    ]
    known = wrong[seen]
    return [
        *rows,
        {
            "question": "landmark, random maps",
            "landmarks": int(seen.sum()),
            "right": int((known <= _RIGHT_M).sum()),
            "error_m": float(known.max()),
        },
    ]


def _named_alike(world: LandmarkWorld) -> LandmarkWorld:
    """Give the landmarks of each world the same ten pairs of colours and shapes."""
    pairs = random_world(10, seed=0, attributes=True).landmarks
    return world._replace(
        landmarks=tuple(
            mine._replace(name=pair.name, pointer=pair.pointer)
            for mine, pair in zip(world.landmarks, pairs, strict=True)
        )
    )
