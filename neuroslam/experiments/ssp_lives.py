"""Lives of SSP-SLAM in worlds of landmarks: several animals side by side, each in its own."""

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
"""Of what is said, so much is kept for figures and figures of merit."""
_PIECE = 2000  # steps that are seen at once: views of all of a long life do not fit into memory
TRIAL_SEEDS = (17612, 74607, 8272, 33433, 15456, 64938, 99741, 58916, 61899, 85406)
"""Of the ten trials that the authors of the reference program ran."""


class Life(NamedTuple):
    """What animals went through and said, at ``KEPT_HZ``.

    Attributes:
        time_s: ``(steps,)``.
        truth_m: ``(steps, animals, dimension)``.
        position_m: Where each believed to be, the same shape.
        error_m: ``(steps, animals)``.
        similarity_error: One minus the similarity of its vector to the true one's, the same shape.
        seen_s: For how long each has seen each landmark, ``(animals, landmarks)``.
    """

    time_s: np.ndarray
    truth_m: np.ndarray
    position_m: np.ndarray
    error_m: np.ndarray
    similarity_error: np.ndarray
    seen_s: np.ndarray

    @property
    def ate_m(self) -> np.ndarray:
        """Mean distance from the truth, of each animal."""
        return self.error_m.mean(0)


def pointers_of(world: LandmarkWorld, n_features: int, seed: int = 0) -> SemanticPointers:
    """Make the vocabulary of a world: names of landmarks, or what they are made of.

    Names alone are orthogonal; what is bound must be unitary.
    """
    said = [landmark.pointer for landmark in world.landmarks]
    words = sorted({w for s in said for w in s.replace("*", " ").replace("+", " ").split()})
    structured = any(not s.isidentifier() for s in said)
    how = "unitary" if structured or len(words) > n_features else "orthogonal"
    return SemanticPointers(words, n_features, seed, how)


def slam_in(config: SSPSLAMConfig, world: LandmarkWorld, batch: int = 1) -> SSPSLAM:
    """Make animals that can tell a world's landmarks apart."""
    n_features = 2 * _n_frequencies(config) + 1
    words = pointers_of(world, n_features, config.seed)
    keys = words.parse_all([landmark.pointer for landmark in world.landmarks])
    return SSPSLAM(config, keys, world.names, batch)


def _n_frequencies(config: SSPSLAMConfig) -> int:
    from neuroslam.spiking.space import SSPSpace

    return SSPSpace.from_config(config.space).n_frequencies


def views(worlds: Sequence[LandmarkWorld], position_m: np.ndarray) -> LandmarkView:
    """Return what animals see, each in its world, ``(steps, animals, dimension)``."""
    each = [world.observe(position_m[:, k]) for k, world in enumerate(worlds)]
    owner = each[0].box_landmark
    stacked = (np.stack(column, axis=1) for column in list(zip(*each, strict=True))[:4])
    return LandmarkView(*stacked, owner)


def live(slam: SSPSLAM, worlds: Sequence[LandmarkWorld], paths: Sequence[LandmarkPath]) -> Life:
    """Let animals go along their paths, from where these begin.

    Args:
        slam: Of as many animals.
        worlds: Of each.
        paths: Of each, of equal length.
    """
    truth, velocity, every = _ways(slam, paths)
    slam.start(torch.from_numpy(truth[0]))
    said, seen = [], np.zeros((len(paths), len(worlds[0].landmarks)))
    for begin in range(0, len(truth), _PIECE):
        part = slice(begin, begin + _PIECE)
        view = views(worlds, truth[part])
        seen += view.in_view.sum(0) * slam.config.time_step_s
        said.append(slam.run(velocity[part], view, every=every))
    whole = SSPStep(*(torch.cat(column) for column in zip(*said, strict=True)))
    return _life(slam, truth[every - 1 :: every], whole.position_m, whole.z, seen)


@torch.inference_mode()
def integrate(slam: SSPSLAM, paths: Sequence[LandmarkPath]) -> Life:
    """Let the path integrator alone go along paths; the rest of the animals sleeps."""
    truth, velocity, every = _ways(slam, paths)
    walk = slam.integrator
    walk.start(torch.from_numpy(truth[0]))
    said = []
    for k, v in enumerate(velocity.to(slam.pointers)):
        z = walk(v)
        if (k + 1) % every == 0:
            said.append((walk.position_m, z))
    position, z = (torch.stack(column) for column in zip(*said, strict=True))
    return _life(slam, truth[every - 1 :: every], position, z, np.zeros((len(paths), 0)))


def _ways(slam: SSPSLAM, paths: Sequence[LandmarkPath]) -> tuple[np.ndarray, torch.Tensor, int]:
    """True positions, velocities, and of how many steps one is kept."""
    dt = slam.config.time_step_s
    every = max(1, round(1.0 / (KEPT_HZ * dt)))
    paths = [path.resampled(dt) for path in paths]
    n = len(paths[0].position_m) // every * every
    truth = np.stack([path.position_m[:n] for path in paths], axis=1)
    velocity = np.stack([path.velocity_m_s[:n] for path in paths], axis=1)
    return truth, torch.from_numpy(velocity), every


def _life(
    slam: SSPSLAM, truth: np.ndarray, position: torch.Tensor, z: torch.Tensor, seen: np.ndarray
) -> Life:
    every = max(1, round(1.0 / (KEPT_HZ * slam.config.time_step_s)))
    with torch.inference_mode():
        true_z = slam.space.encode_fourier(torch.from_numpy(truth))
        alike = (1.0 + 2.0 * (z * true_z.conj()).real.sum(-1)) / slam.space.n_features
    where = position.double().numpy()
    time = (np.arange(len(truth)) + 1) * every * slam.config.time_step_s
    error = np.linalg.norm(where - truth, axis=-1)
    return Life(time, truth, where, error, 1.0 - alike.numpy(), seen)


def recalled(slam: SSPSLAM) -> np.ndarray:
    """Return where each animal's map has each landmark, ``(animals, landmarks, dimension)``."""
    with torch.inference_mode():
        z = slam.space.to_fourier(slam.map.read(slam.pointers))
        return slam.integrator.decoder(z).position_m.double().numpy()


def trials(data: Path | None, n: int, seconds: float) -> tuple[list[LandmarkPath], LandmarkWorld]:
    """Return paths and landmarks of the reference's trials, or random ones of the same kind.

    Args:
        data: Folder with ``inputs_T120_limit0.08.npz``; ``None``: random ones.
        n: How many paths, at most 10.
        seconds: How long.
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
