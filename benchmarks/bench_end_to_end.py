"""Whole runs, recorder off: from pictures on the disk to the files of a run."""

import statistics
import tempfile
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.bench_view_search import memory, places
from benchmarks.timing import Row, cpu_ms
from neuroslam.brain import NavigationBrain
from neuroslam.config import BrainConfig
from neuroslam.runs.run import resolve_config, run
from neuroslam.types import Frame, Motion, Velocity

SPACING_M = 0.1

SHARED = Path(__file__).resolve().parents[2] / "shared"
TRACK = SHARED / "data" / "circuit_launch" / "frames.tar"
PARITY = SHARED / "refs" / "ratslam" / "config_circuit_launch.ini"


def frames_per_cpu_s(config: BrainConfig, rounds: int = 5) -> float:
    found = []
    for _ in range(rounds):
        with tempfile.TemporaryDirectory() as out:
            summary = run(TRACK, out, config, tensorboard=False)
            found.append(summary.frames / summary.cpu_seconds)
    return statistics.median(found)


def brain_that_knows(n: int) -> NavigationBrain:
    """A brain after a long drive: n views, each of a place of its own, in one chain at rest."""
    config = BrainConfig(
        odometry={"use": "given"},
        view={"shift_match": 5, "normalisation": 0.0},
        pose_cells={"inject_after": 0},
        sessions={"kidnapped": "ignore"},  # from stretch to stretch of these places the view jumps
    )
    brain = NavigationBrain(config)
    known = memory(places(n), config.view)
    brain.view.load_state_dict(known.state_dict())
    along = np.arange(n) * SPACING_M / config.pose_cells.cell_size_m
    cells = torch.from_numpy(np.stack([along % 21, np.full(n, 10.0), np.zeros(n)], axis=1))
    brain.pose_cells.bindings.replace(
        x=cells[:, 0], y=cells[:, 1], theta=cells[:, 2], decay=torch.ones(n)
    )
    poses = torch.zeros(n, 3, dtype=torch.float64)
    poses[:, 0] = torch.arange(n) * SPACING_M
    ids = torch.arange(n)
    brain.map.experiences.replace(
        pose=poses, cell=cells, template=ids, first_frame=ids, session=0 * ids, number=ids
    )
    one = torch.ones(n - 1, dtype=torch.float64)
    brain.map.links_table.replace(
        source=ids[:-1], target=ids[1:], distance_m=SPACING_M * one, heading_rad=0 * one,
        facing_rad=0 * one, duration_s=one,
    )  # fmt: skip
    brain.map.set(0)
    return brain


def large_map_frames_per_cpu_s(n: int, relaxing: bool) -> float:
    """Drive on through a known map of n places; at rest, or while a loop is being relaxed."""
    brain = brain_that_knows(n)
    if relaxing:
        brain.map.move(Motion(0.5, 0.1, 1.0))
        brain.map.link(n - 1)
        brain.map.set(0)
    shown = brain.view.templates["pixels"].numpy().reshape(n, 60, 10).transpose(0, 2, 1)
    count = 0

    def drive() -> None:
        nonlocal count
        picture = np.repeat(np.repeat(shown[count % n], 8, axis=0), 4, axis=1)
        brain(Frame(count, count / 20.0, picture, Velocity(20.0 * SPACING_M, 0.0)))
        count += 1

    return 1e3 / cpu_ms(drive, 60, 5)


def rows() -> list[Row]:
    found = []
    for relaxing, state in ((False, "at rest"), (True, "relaxing, 20 loops a frame")):
        rate = large_map_frames_per_cpu_s(10_000, relaxing)
        size = f"map of 10 000 templates, {state}"
        found.append(
            Row("end to end", size, "~15 frames/s", ">= 150 frames/s", f"{rate:.0f} frames/s")
        )
    if TRACK.exists():
        for name, config in (
            ("rc_car", resolve_config("rc_car")),
            ("openratslam, its parameters", resolve_config("openratslam", PARITY)),
        ):
            rate = frames_per_cpu_s(config)
            size = f"circuit_launch, 1000 frames, {name}"
            found.append(
                Row("end to end", size, "639 frames/s", ">= 900 frames/s", f"{rate:.0f} frames/s")
            )
    return found


@pytest.mark.skipif(not TRACK.exists(), reason="no ../shared beside the checkout")
@pytest.mark.parametrize("preset", ["rc_car", "openratslam"])
def test_circuit_launch_end_to_end(benchmark, tmp_path, preset):
    config = resolve_config(preset, PARITY if preset == "openratslam" else None)
    benchmark.pedantic(
        lambda: run(TRACK, tmp_path / preset, config, tensorboard=False, overwrite=True), rounds=3
    )
