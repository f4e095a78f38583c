"""Memory of lives of 100 000 frames under a fixed cap, while the map is still and as it grows.

``python -m benchmarks.bench_memory`` prints the tables of docs/memory.md. Each life is a process of
its own, whose data (heap and anonymous maps, RLIMIT_DATA) cannot become larger than the cap.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from neuroslam.brain import NavigationBrain
from neuroslam.config import BrainConfig
from neuroslam.runs.run import resolve_config, run
from neuroslam.sensors import open_source
from neuroslam.threads import limit_threads
from neuroslam.types import Frame, StepResult, Velocity

MIB = 2**20
CAP_BYTES = 768 * MIB
FRAMES = 100_000
EVERY = 1000  # frames between two samples
LAP = 340  # frames
STEP_PX = 2  # of the wall, each frame
LOOK = "width=64&height=32&grey=true"  # cheap to draw
LIVES = {
    "still": "brain alone, laps of one corridor",
    "growing": "brain alone, along a wall without end",
    "full": "brain alone, laps, preset full",
    "run": "run with its files, laps",
    "events": "the same with TensorBoard",
}


def resident_bytes() -> int:
    """Resident memory of this process."""
    with open("/proc/self/status") as status:
        line = next(line for line in status if line.startswith("VmRSS:"))
    return int(line.split()[1]) * 1024


class Samples:
    """Notes memory and the size of the map every so many frames."""

    def __init__(self) -> None:
        self.rows: list[tuple[int, int, int, int, int]] = []

    def __call__(self, result: StepResult) -> None:
        seen = result.frame + 1
        if seen % EVERY == 0:
            sizes = (result.n_templates, result.n_experiences, result.n_links)
            self.rows.append((seen, resident_bytes(), *sizes))


def endless_wall() -> Iterator[Frame]:
    """Frames of a drive along a wall that is painted at random, and nowhere twice."""
    width, height = 64, 32
    painted = np.zeros((height, 0), np.uint8)
    for index in count():
        left = STEP_PX * index % width
        if left == 0:
            rng = np.random.default_rng(STEP_PX * index // width)
            coarse = rng.integers(0, 255, (4, width // 8), np.uint8)
            block = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
            painted = np.hstack([painted[:, -width:], block])
        if painted.shape[1] == 2 * width:
            seen = np.ascontiguousarray(painted[:, left : left + width])
            yield Frame(index - width // STEP_PX, index / 10.0, seen, Velocity(1.0, 0.0))


def live(config: BrainConfig, frames: Iterator[Frame], n: int, samples: Samples) -> dict[str, Any]:
    """Let a brain take in n frames."""
    brain = NavigationBrain(config)
    with limit_threads(), torch.inference_mode():
        for frame, _ in zip(frames, range(n), strict=False):
            samples(brain(frame))
    state = brain.state_dict()

    def bytes_each(part: str, n: int) -> float:
        own = [value for name, value in state.items() if name.startswith(part)]
        return sum(value.numel() * value.element_size() for value in own) / max(1, n)

    return {
        "state_bytes_templates": bytes_each("view.templates.", brain.view.n),
        "state_bytes_places": bytes_each("map.", brain.map.n),
        "state_bytes_bindings": bytes_each("pose_cells.bindings.", brain.view.n),
    }


def life(name: str, n: int) -> dict[str, Any]:
    """Live one of ``LIVES`` in this process, which can take no more data than the cap."""
    resource.setrlimit(resource.RLIMIT_DATA, (CAP_BYTES, CAP_BYTES))
    samples, laps = Samples(), n // LAP + 2
    source = f"world:corridor?laps={laps}&{LOOK}"
    more: dict[str, Any] = {}
    if name in ("still", "growing"):
        frames = endless_wall() if name == "growing" else iter(open_source(source).frames())
        more = live(BrainConfig(), frames, n, samples)
    elif name == "full":
        senses = f"{source}&ranges=36&markers=12&landmark_reach=6&compass_deg=3"
        more = live(resolve_config("full"), iter(open_source(senses).frames()), n, samples)
    else:
        with tempfile.TemporaryDirectory() as out:
            run(source, out, stop=n, tensorboard=name == "events", on_step=samples)
            files = [path for path in Path(out).rglob("*") if path.is_file()]
            more = {"disk_bytes": sum(path.stat().st_size for path in files)}
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return {"life": name, "peak_bytes": peak, "samples": samples.rows, **more}


def in_child(name: str, n: int) -> dict[str, Any]:
    """Live it in a process of its own."""
    arguments = [
        sys.executable,
        "-m",
        "benchmarks.bench_memory",
        "--life",
        name,
        "--frames",
        str(n),
    ]
    done = subprocess.run(arguments, capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def slope(x: np.ndarray, y: np.ndarray) -> float:
    """Least-squares slope, 0 where x stands still."""
    return float(np.polyfit(x, y, 1)[0]) if np.ptp(x) else 0.0


def lines(told: dict[str, Any]) -> Iterator[str]:
    """Lay out a life as a line of the table, and one of figures."""
    table = np.array(told["samples"], dtype=np.float64)
    seen, bytes_ = table[:, 0], table[:, 1]
    marks = [int(k * seen[-1] / 100_000) for k in (1_000, 10_000, 50_000, 100_000)]
    at = [bytes_[min(np.searchsorted(seen, mark), len(seen) - 1)] / MIB for mark in marks]
    late = seen > 0.2 * seen[-1]
    cells = [LIVES[told["life"]], *(f"{value:.1f}" for value in at)]
    cells += [f"{slope(seen[late], bytes_[late]):+.2f}", f"{told['peak_bytes'] / MIB:.0f}"]
    cells += [f"{int(value)}" for value in table[-1, 2:]]
    yield f"| {' | '.join(cells)} |"
    if told["life"] == "growing":
        for name, column in (("templates", 2), ("places", 3)):
            per = slope(table[late, column], bytes_[late])
            yield (
                f"{name}: {told[f'state_bytes_{name}']:.0f} bytes of state; resident "
                f"memory grows by {per:.0f} bytes for each"
            )
    if "disk_bytes" in told:
        yield f"files of {told['life']}: {told['disk_bytes'] / MIB:.1f} MiB"


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--life", choices=LIVES)
    parser.add_argument("--only", choices=LIVES, nargs="*", default=list(LIVES))
    parser.add_argument("--frames", type=int, default=FRAMES)
    parser.add_argument("--save", type=Path)
    given = parser.parse_args()
    if given.life:
        print(json.dumps(life(given.life, given.frames)))
        return
    found = []
    for name in given.only:
        found.append(in_child(name, given.frames))
        print("\n".join(lines(found[-1])), flush=True)
        if given.save:
            given.save.write_text(json.dumps(found))


if __name__ == "__main__":
    main()
