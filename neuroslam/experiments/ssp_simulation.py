"""Simulation of SSP-SLAM in worlds of landmarks: a batch of animals, each in its own world."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from neuroslam.config.semantic import SSPSLAMConfig
from neuroslam.spiking.pointers import SemanticPointers
from neuroslam.spiking.slam import SSPSLAM, SSPStep
from neuroslam.worlds.landmark_paths import LandmarkPath, band_limited_path
from neuroslam.worlds.landmarks import LandmarkView, LandmarkWorld, make_world, point

KEPT_HZ = 100
"""Rate of the estimates that are kept for figures and errors."""
_PIECE = 2000  # steps whose views are computed at once: those of a long path do not fit into memory
TRIAL_SEEDS = (17612, 74607, 8272, 33433, 15456, 64938, 99741, 58916, 61899, 85406)
"""Seeds of the ten trials of the reference program's authors."""


class Simulation(NamedTuple):
    """True and estimated positions of animals, at ``KEPT_HZ``.

    Attributes:
        time_s: ``(steps,)``.
        truth_m: ``(steps, animals, dimension)``.
        position_m: Estimated positions, same shape.
        error_m: ``(steps, animals)``.
        similarity_error: One minus the similarity to the true vector, same shape.
        seen_s: Time for which each landmark was in view, ``(animals, landmarks)``.
    """

    time_s: np.ndarray
    truth_m: np.ndarray
    position_m: np.ndarray
    error_m: np.ndarray
    similarity_error: np.ndarray
    seen_s: np.ndarray

    @property
    def ate_m(self) -> np.ndarray:
        """Mean distance to the truth of each animal, which the paper calls ATE."""
        return np.asarray(self.error_m.mean(0))


def pointers_of(world: LandmarkWorld, n_features: int, seed: int = 0) -> SemanticPointers:
    """Return the vocabulary of a world: names of landmarks, or the words of their pointers.

    Names are orthogonal; words that are bound must be unitary.
    """
    pointers = [landmark.pointer for landmark in world.landmarks]
    words = sorted({w for s in pointers for w in s.replace("*", " ").replace("+", " ").split()})
    structured = any(not pointer.isidentifier() for pointer in pointers)
    unitary = structured or len(words) > n_features
    return SemanticPointers(words, n_features, seed, "unitary" if unitary else "orthogonal")


def slam_in(config: SSPSLAMConfig, world: LandmarkWorld, batch: int = 1) -> SSPSLAM:
    """Return a batch of animals with the pointers of a world's landmarks."""
    n_features = 2 * _n_frequencies(config) + 1
    words = pointers_of(world, n_features, config.seed)
    keys = words.parse_all([landmark.pointer for landmark in world.landmarks])
    return SSPSLAM(config, keys, world.names, batch)


def _n_frequencies(config: SSPSLAMConfig) -> int:
    from neuroslam.spiking.space import SSPSpace

    return SSPSpace.from_config(config.space).n_frequencies


def views(worlds: Sequence[LandmarkWorld], position_m: np.ndarray) -> LandmarkView:
    """Return the views of animals, each in its world, at ``(steps, animals, dimension)``."""
    each = [world.observe(position_m[:, k]) for k, world in enumerate(worlds)]
    return LandmarkView(
        np.stack([view.in_view for view in each], axis=1),
        np.stack([view.distance_m for view in each], axis=1),
        np.stack([view.low_m for view in each], axis=1),
        np.stack([view.high_m for view in each], axis=1),
        each[0].box_landmark,
    )


def simulate(
    slam: SSPSLAM, worlds: Sequence[LandmarkWorld], paths: Sequence[LandmarkPath]
) -> Simulation:
    """Run animals along their paths, from the true start.

    Args:
        slam: A batch of animals.
        worlds: World of each animal.
        paths: Path of each animal, of equal length.
    """
    truth, velocity, every = _sampled_paths(slam, paths)
    slam.start(torch.from_numpy(truth[0]))
    steps, seen = [], np.zeros((len(paths), len(worlds[0].landmarks)))
    for begin in range(0, len(truth), _PIECE):
        part = slice(begin, begin + _PIECE)
        view = views(worlds, truth[part])
        seen += view.in_view.sum(0) * slam.config.time_step_s
        steps.append(slam.run(velocity[part], view, every=every))
    whole = SSPStep(*(torch.cat(column) for column in zip(*steps, strict=True)))
    return _simulation(slam, truth[every - 1 :: every], whole.position_m, whole.z, seen)


@torch.inference_mode()
def integrate(slam: SSPSLAM, paths: Sequence[LandmarkPath]) -> Simulation:
    """Run only the path integrators along paths."""
    truth, velocity, every = _sampled_paths(slam, paths)
    walk = slam.integrator
    walk.start(torch.from_numpy(truth[0]))
    steps = []
    for k, v in enumerate(velocity.to(slam.pointers)):
        z = walk(v)
        if (k + 1) % every == 0:
            steps.append((walk.position_m, z))
    position, z = (torch.stack(column) for column in zip(*steps, strict=True))
    return _simulation(slam, truth[every - 1 :: every], position, z, np.zeros((len(paths), 0)))


def _sampled_paths(
    slam: SSPSLAM, paths: Sequence[LandmarkPath]
) -> tuple[np.ndarray, torch.Tensor, int]:
    """Return true positions, velocities, and the number of steps for each one kept."""
    dt = slam.config.time_step_s
    every = max(1, round(1.0 / (KEPT_HZ * dt)))
    paths = [path.resampled(dt) for path in paths]
    n = len(paths[0].position_m) // every * every
    truth = np.stack([path.position_m[:n] for path in paths], axis=1)
    velocity = np.stack([path.velocity_m_s[:n] for path in paths], axis=1)
    return truth, torch.from_numpy(velocity), every


def _simulation(
    slam: SSPSLAM, truth: np.ndarray, position: torch.Tensor, z: torch.Tensor, seen: np.ndarray
) -> Simulation:
    every = max(1, round(1.0 / (KEPT_HZ * slam.config.time_step_s)))
    with torch.inference_mode():
        true_z = slam.space.encode_fourier(torch.from_numpy(truth))
        alike = (1.0 + 2.0 * (z * true_z.conj()).real.sum(-1)) / slam.space.n_features
    where = position.double().numpy()
    time = (np.arange(len(truth)) + 1) * every * slam.config.time_step_s
    error = np.linalg.norm(where - truth, axis=-1)
    return Simulation(time, truth, where, error, 1.0 - alike.numpy(), seen)


def recalled(slam: SSPSLAM) -> np.ndarray:
    """Return the landmarks' positions on the animals' maps, ``(animals, landmarks, dimension)``."""
    with torch.inference_mode():
        z = slam.space.to_fourier(slam.map.read(slam.pointers))
        return np.asarray(slam.integrator.decoder(z).position_m.double())


def trials(data: Path | None, n: int, seconds: float) -> tuple[list[LandmarkPath], LandmarkWorld]:
    """Return paths and landmarks of the reference's trials, or random ones of the same kind.

    Args:
        data: Folder with ``inputs_T120_limit0.08.npz``; ``None``: random ones.
        n: Number of paths, at most 10.
        seconds: Duration.
    """
    if data is None:
        paths = [band_limited_path(120.0, 0.08, seed=k, time_step_s=0.01) for k in range(n)]
        at = np.random.default_rng(0).uniform(-0.9, 0.9, (10, 2))
    else:
        with np.load(Path(data) / "inputs_T120_limit0.08.npz") as stored:
            paths = [
                LandmarkPath(0.01, stored[f"path_seed{seed}"].astype(np.float64))
                for seed in TRIAL_SEEDS[:n]
            ]
            at = stored["obj_locs"]
    world = make_world([point(f"L{k}", x) for k, x in enumerate(at)])
    return [path.first(seconds) for path in paths], world
