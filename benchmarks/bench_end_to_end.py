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
from neuroslam.sensors import open_source
from neuroslam.types import Frame, Motion, Velocity

SPACING_M = 0.1

SHARED = Path(__file__).resolve().parents[2] / "shared"
TRACK = SHARED / "data" / "circuit_launch" / "frames.tar"
PARITY = SHARED / "refs" / "ratslam" / "config_circuit_launch.ini"
DRIVES = {
    ("circuit_launch", "openratslam"): ("<= 0.06 Y", "C++ 0.119 Y"),
    ("usi_track1", "openratslam"): ("<= 0.125 Y", "C++ 0.254 Y"),
    ("circuit_launch", "rc_car"): ("<= 0.04 Y", ""),
    ("usi_track1", "rc_car"): ("<= 0.085 Y", ""),
}
"""Drive and preset -> target, and C++ OpenRatSLAM with the same pictures and parameters."""


def frame_ms(name: str, preset: str) -> float:
    """A frame of a whole drive, with the pictures in memory."""
    folder = SHARED / "refs" / "ratslam"
    parameters = folder / f"config_{name}.ini" if preset == "openratslam" else None
    config = resolve_config(preset, parameters)
    source = SHARED / "data" / name / "frames.tar"
    frames = list(open_source(source, config.frame_rate_hz, config.view.grey))

    def drive() -> None:
        brain = NavigationBrain(config)
        for frame in frames:
            brain(frame)

    return cpu_ms(drive, 1, 5) / len(frames)


def run_ms(config: BrainConfig, rounds: int = 5) -> float:
    """A frame of a run, from the pictures on the disk to the files."""
    found = []
    for _ in range(rounds):
        with tempfile.TemporaryDirectory() as out:
            summary = run(TRACK, out, config, tensorboard=False)
            found.append(1e3 * summary.cpu_seconds / summary.frames)
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
    brain.map.relocalise(0)
    return brain


def large_map_ms(n: int, relaxing: bool) -> float:
    """Drive on through a known map of n places; at rest, or while a loop is being relaxed."""
    brain = brain_that_knows(n)
    if relaxing:
        brain.map.move(Motion(0.5, 0.1, 1.0))
        brain.map.link(n - 1)
        brain.map.relocalise(0)
    shown = brain.view.templates["pixels"].numpy().reshape(n, 60, 10).transpose(0, 2, 1)
    count = 0

    def drive() -> None:
        nonlocal count
        picture = np.repeat(np.repeat(shown[count % n], 8, axis=0), 4, axis=1)
        brain(Frame(count, count / 20.0, picture, Velocity(20.0 * SPACING_M, 0.0)))
        count += 1

    return cpu_ms(drive, 60, 5)


def rows() -> list[Row]:
    found = []
    for relaxing, state, target in (
        (False, "at rest", ""), (True, "relaxing, 20 loops a frame", ">= 600 frames/s"),
    ):  # fmt: skip
        ms = large_map_ms(10_000, relaxing)
        size = f"map of 10 000 templates, {state}"
        found.append(Row("a frame", size, ms, target, "", f"{1e3 / ms:.0f} frames/s"))
    if TRACK.exists():
        for (name, preset), (target, beside) in DRIVES.items():
            ms = frame_ms(name, preset)
            size = f"{name}, `{preset}`, pictures in memory"
            found.append(Row("a frame", size, ms, target, beside, f"{1e3 / ms:.0f} frames/s"))
        ms = run_ms(resolve_config("rc_car"))
        size = "circuit_launch, `rc_car`, JPEG to files"
        found.append(Row("a frame of a run", size, ms, "", "", f"{1e3 / ms:.0f} frames/s"))
    return found


@pytest.mark.skipif(not TRACK.exists(), reason="no ../shared beside the checkout")
@pytest.mark.parametrize("preset", ["rc_car", "openratslam"])
def test_circuit_launch_end_to_end(benchmark, tmp_path, preset):
    config = resolve_config(preset, PARITY if preset == "openratslam" else None)
    benchmark.pedantic(
        lambda: run(TRACK, tmp_path / preset, config, tensorboard=False, overwrite=True), rounds=3
    )
