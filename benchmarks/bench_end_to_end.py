"""Whole runs, recorder off: from pictures on the disk to the files of a run."""

import statistics
import tempfile
from pathlib import Path

import numpy as np
import pytest

from benchmarks.timing import Row, cpu_ms
from neuroslam.config import BrainConfig
from neuroslam.runs import resolve_config, run
from neuroslam.types import Frame

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


def large_map_frames_per_cpu_s(n_templates: int = 10_000) -> float:
    """Frames/s of a brain that knows 10 000 views of its world and sees them again."""
    from neuroslam.brain import NavigationBrain

    rng = np.random.default_rng(0)
    config = BrainConfig(view={"threshold": 0.02, "shift_match": 5}, max_gap_s=1e9)
    brain = NavigationBrain(config)
    panorama = rng.integers(0, 256, (10, 60 + n_templates), dtype=np.uint8)
    panorama = np.repeat(np.repeat(panorama, 6, axis=0), 2, axis=1)

    def frame(i: int) -> Frame:
        at = (2 * 7 * i) % (2 * n_templates)
        return Frame(i, i / 20.0, np.ascontiguousarray(panorama[:, at : at + 120]), (0.5, 0.0))

    from neuroslam.types import Velocity

    count = 0
    while brain.view.n < n_templates and count < 4 * n_templates:
        brain(frame(count)._replace(velocity=Velocity(0.5, 0.01)))
        count += 1

    def one() -> None:
        nonlocal count
        brain(frame(count)._replace(velocity=Velocity(0.5, 0.01)))
        count += 1

    return 1e3 / cpu_ms(one, 100, 5), brain.view.n


def rows() -> list[Row]:
    found = []
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
