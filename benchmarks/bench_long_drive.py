"""A drive of a million frames in one region, under a cap of the map: memory and time per frame.

``python -m benchmarks.bench_long_drive`` drives laps of a painted circuit whose map needs more
experiences than the cap, with closures by views and by sequences, each in a process of its own, and
prints the table of docs/memory.md; ``--draw FILE`` draws the figure.
"""

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import torch

from benchmarks.bench_memory import MIB, resident_bytes
from neuroslam.brain import NavigationBrain
from neuroslam.config import BrainConfig
from neuroslam.figures.style import CURVES, STYLE, new_figure, save
from neuroslam.threads import limit_threads
from neuroslam.types import Frame, Velocity

FRAMES, EVERY = 1_000_000, 10_000
LAP = 4000  # frames
STEP_PX, WIDTH, HEIGHT = 4, 48, 24
CAP = 1000
MODES = ("view", "sequence")


def circuit() -> Iterator[Frame]:
    """Frames of laps of a painted circuit, with noise in pictures and odometry."""
    rng = np.random.default_rng(0)
    length = LAP * STEP_PX
    layers = [
        np.kron(rng.integers(0, 256, (HEIGHT // size, length // size)), np.ones((size, size)))
        for size in (2, 4, 8)
    ]
    wall = np.mean(layers, axis=0)
    wall = np.concatenate([wall, wall[:, :WIDTH]], axis=1)
    noises = rng.normal(0.0, 6.0, (64, HEIGHT, WIDTH))
    for index in count():
        left = index % LAP * STEP_PX
        seen = wall[:, left : left + WIDTH] + noises[rng.integers(64)]
        turn = 2.0 * np.pi / LAP * 20.0
        velocity = Velocity(rng.normal(2.0, 0.1), turn + rng.normal(0.0, 0.02))
        yield Frame(index, index / 20.0, np.clip(seen, 0, 255).astype(np.uint8), velocity)


def config(mode: str, cap: int) -> BrainConfig:
    return BrainConfig(
        view={"template_width": 24, "template_height": 12, "threshold": 0.06, "shift_match": 2},
        map={"closure": mode, "loops": 5, "max_experiences": cap},
        sessions={"kidnapped": "ignore"},
    )


def drive(mode: str, frames: int, cap: int) -> list[dict[str, Any]]:
    """Drive, and note memory, time and the size of the map every so many frames."""
    brain, rows = NavigationBrain(config(mode, cap)), []
    with limit_threads(), torch.inference_mode():
        before = time.process_time()
        for frame in circuit():
            result = brain(frame)
            if (frame.index + 1) % EVERY == 0:
                now = time.process_time()
                rows.append(
                    {
                        "mode": mode,
                        "frames": frame.index + 1,
                        "resident_bytes": resident_bytes(),
                        "ms_per_frame": 1e3 * (now - before) / EVERY,
                        "experiences": result.n_experiences,
                        "templates": result.n_templates,
                        "links": result.n_links,
                        "forgotten": brain.map.forgotten.n,
                    }
                )
                print(json.dumps(rows[-1]), flush=True)
                before = time.process_time()
            if frame.index + 1 == frames:
                return rows
    raise AssertionError("the circuit has no end")


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Draw memory, time per frame and the size of the map over frames."""
    panels = (
        ("Memory", "resident memory (MiB)", lambda r: r["resident_bytes"] / MIB),
        ("Time", "CPU time per frame (ms)", lambda r: r["ms_per_frame"]),
        ("Map", "experiences", lambda r: r["experiences"]),
    )
    with mpl.rc_context(STYLE):
        figure = new_figure(11.0, 3.6, "A long drive under a cap on experiences")
        axes = figure.subplots(1, 3)
        for axis, (title, label, value) in zip(axes, panels, strict=True):
            for mode, colour in zip(MODES, CURVES, strict=False):
                own = [row for row in rows if row["mode"] == mode]
                axis.plot(
                    [row["frames"] / 1e6 for row in own], [value(row) for row in own],
                    color=colour, lw=1.2, label=f"closure by {mode}",
                )  # fmt: skip
            axis.set(xlabel="frames (million)", ylabel=label, title=title)
            axis.set_ylim(0, 1.15 * max(value(row) for row in rows))
        axes[0].legend(loc="lower right")
        save(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--mode", choices=MODES)
    parser.add_argument("--frames", type=int, default=FRAMES)
    parser.add_argument("--cap", type=int, default=CAP)
    parser.add_argument("--rows", type=Path, help="rows of an earlier run, to draw again")
    parser.add_argument("--draw", type=Path)
    given = parser.parse_args()
    if given.mode:
        drive(given.mode, given.frames, given.cap)
        return
    if given.rows:
        text = given.rows.read_text()
    else:
        command = [sys.executable, "-m", "benchmarks.bench_long_drive"]
        sizes = ["--frames", str(given.frames), "--cap", str(given.cap)]
        text = "".join(
            subprocess.run(
                [*command, "--mode", mode, *sizes], stdout=subprocess.PIPE, text=True, check=True
            ).stdout
            for mode in MODES
        )
    rows = [json.loads(line) for line in text.splitlines()]
    for row in rows:
        if row["frames"] in (10_000, 100_000, 500_000, given.frames):
            print(
                f"| {row['mode']} | {row['frames']} | {row['resident_bytes'] / MIB:.1f} | "
                f"{row['ms_per_frame']:.2f} | {row['experiences']} | {row['templates']} | "
                f"{row['links']} | {row['forgotten']} |"
            )
    if given.draw:
        draw(rows, given.draw)


if __name__ == "__main__":
    main()
