"""Golden traces: what every set of populations does on short drives, frozen to the last bit.

``golden_traces.json`` holds, for each drive, the SHA-256 of every table that a run writes and of
every population's state, and a few plain figures. On a machine whose arithmetic rounds as the one
that wrote them (``arithmetic``), every digest must be equal; on any other, where the last bits of a
product differ, the figures must. A change of behaviour changes the file, in a commit that says why:
``python tests/brain/test_golden_traces.py`` rewrites it.
"""

import hashlib
import json
import math
import tempfile
from collections.abc import Iterable
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from llvmlite.binding import get_host_cpu_name

from neuroslam.brain import NavigationBrain
from neuroslam.config import build_config, merge_values, read_preset
from neuroslam.evaluation.trajectory import Track, write_tum
from neuroslam.merging import find_match
from neuroslam.runs.files import RowWriter, experiences_csv, links_csv
from neuroslam.runs.reading import read_trace, trajectory
from neuroslam.sensors import open_source
from neuroslam.sensors.scan import walls_in_scan

GOLDEN = Path(__file__).with_name("golden_traces.json")
SETS = [
    "pose", "place", "semantic", "pose+place", "pose+semantic", "place+semantic",
    "pose+place+semantic",
]  # fmt: skip
WORLD = (
    "world:corridor?width=64&height=40&noise=0.03&compass_deg=2&ranges=72&markers=12"
    "&landmark_reach=6&frames_per_lap=150&outliers=0.05"
)
NOT_COMPARED = ("sessions.text", "clock.after_gap_s")
"""Session ids follow from the whole config; the other is no longer part of a state, nor are pose
cells of a brain that does not use them."""

ROUNDING = 1e-5
"""Metres, parts of a turn: a path of some metres in single precision, 2e-7 m a step, added up."""


def arithmetic() -> str:
    """Tell machines apart that round differently in what the drives use."""
    draw = torch.Generator().manual_seed(0)
    a = torch.rand(96, 96, generator=draw, dtype=torch.float64)
    parts = [
        (a @ a).numpy(),
        (a.float() @ a.float()).numpy(),
        torch.nn.functional.conv2d(a[None, None].float(), a[None, None, :7, :7].float()).numpy(),
        torch.linalg.solve(a, a[:, 0]).numpy(),
        torch.fft.fft(a).numpy(),
        a.exp().sin().sum(0).numpy(),
        np.linalg.svd(a.numpy())[1],
        cv2.resize((255 * a.numpy()).astype(np.uint8), (31, 17), interpolation=cv2.INTER_AREA),
    ]
    digest = hashlib.sha256()
    for part in parts:
        digest.update(np.ascontiguousarray(part))
    digest.update(get_host_cpu_name().encode())  # compiled steps use what the processor has
    return digest.hexdigest()


@cache
def frames_of(options: str) -> tuple:
    """Frames of a drive that has everything: pictures, ranges, posts, compass, odometry."""
    return tuple(open_source(f"{WORLD}&{options}").frames())


def with_walls(frames: tuple) -> list:
    """Some frames know walls in place of ranges, some have no compass, some no picture."""
    changed = []
    for i, frame in enumerate(frames):
        if i % 7 == 3:
            frame = frame._replace(walls=walls_in_scan(frame.ranges, 1.5), ranges=None)
        if 40 <= i < 55:
            frame = frame._replace(heading_rad=None)
        if 60 <= i < 66:
            frame = frame._replace(image=None)
        changed.append(frame)
    return changed


def with_gap(frames: tuple, at: int, gap_s: float) -> list:
    """From one frame on, time is later."""
    return [f if i < at else f._replace(time_s=f.time_s + gap_s) for i, f in enumerate(frames)]


def brain_of(cells: str, **over) -> NavigationBrain:
    sections = {
        "cells": cells,
        "sessions": {"after_gap": "new_map", "confirm": 3},
        "semantic": {"landmarks": ["given", "markers", "views"]},
        **over,
    }
    return NavigationBrain(build_config(merge_values(read_preset("full"), sections)))


def drive(brain: NavigationBrain, frames: Iterable, out: Path) -> dict:
    """Let a brain take frames; returns digests of its tables and state, and plain figures."""
    brain.about = ("golden", "", "")
    with torch.inference_mode(), RowWriter.create(out) as rows:
        for frame in frames:
            rows.write(brain(frame), frame, brain)
    trace = read_trace(out, min_rows=0)
    track = trajectory(brain, trace)
    on_map = np.isfinite(track[:, 0])
    write_tum(out / "trajectory.tum", Track(trace["time_s"][on_map], track[on_map]))
    tables = {
        "frames.csv": (out / "frames.csv").read_text(),
        "trajectory.tum": (out / "trajectory.tum").read_text(),
        **tables_of(brain),
    }
    return {
        "digests": {n: hashlib.sha256(t.encode()).hexdigest() for n, t in tables.items()}
        | state_digests(brain),
        "figures": figures_of(brain),
    }


def tables_of(brain: NavigationBrain) -> dict[str, str]:
    tables = {"experiences.csv": experiences_csv(brain), "links.csv": links_csv(brain.map.links)}
    for population in brain.populations.values():
        tables |= population.tables()
    return tables


def state_digests(brain: NavigationBrain) -> dict[str, str]:
    """One digest a population: a difference is seen where it begins."""
    digests: dict[str, hashlib._Hash] = {}
    for name, tensor in sorted(brain.state_dict().items()):
        unused = "pose_cells." in name and "pose" not in brain.config.cells
        if unused or name.endswith((*NOT_COMPARED, "session")):
            continue
        part = digests.setdefault(f"state.{name.split('.')[0]}", hashlib.sha256())
        part.update(f"{name} {tensor.dtype} {tuple(tensor.shape)};".encode())
        part.update(np.ascontiguousarray(tensor.numpy(force=True)))
    return {name: digest.hexdigest() for name, digest in digests.items()}


def figures_of(brain: NavigationBrain) -> dict[str, float]:
    x, y, heading = brain.map.pose
    return {
        "views": brain.view.n,
        "experiences": brain.map.n,
        "links": brain.map.n_links,
        "stored maps": len(brain.stored),
        "sessions": len(brain.sessions.sessions),
        "merges": len(brain.sessions.merges),
        "x_m": x,
        "y_m": y,
        "cos": math.cos(heading),
        "sin": math.sin(heading),
    }


def a_life(cells: str, out: Path) -> dict:
    """Several drives of one brain: a first session, then another that knows its map."""
    first = brain_of(cells)
    traces = {"first": drive(first, with_walls(frames_of("laps=1.2")), out / "first")}
    second = brain_of(cells)
    second.store(first)
    later = frames_of("laps=1&start=0.4&seed=1&kidnapped=5:0.35&dark=8-9")
    later = with_gap(later, 110, 5.0)
    traces["second, with a stored map, kidnapped, after a gap"] = drive(
        second, later, out / "second"
    )
    other = brain_of(cells)
    traces["another, landmarks without names"] = drive(
        other, frames_of("laps=0.9&start=0.2&seed=2&labels=0"), out / "other"
    )
    fork = brain_of(cells)
    fork.load_state_dict(first.state_dict())
    for frame in frames_of("laps=0.2&start=0.2&seed=3"):
        fork(frame._replace(time_s=frame.time_s + first.clock.time_s + 0.1))
    traces["merge"] = merged(first, other)
    traces["merge of a map and what became of it"] = merged(first, fork)
    return traces


def merged(loaded: NavigationBrain, partial: NavigationBrain) -> dict:
    match = find_match(loaded, partial).match
    both = None if match is None else loaded.merge(partial, match)[0]
    if both is None:
        return {"digests": {}, "figures": {"merged": 0}}
    tables = {n: hashlib.sha256(t.encode()).hexdigest() for n, t in tables_of(both).items()}
    return {"digests": state_digests(both) | tables, "figures": figures_of(both)}


def a_plain_life(out: Path) -> dict:
    """The defaults: a camera alone, visual odometry, relaxation of the paper."""
    brain = NavigationBrain(build_config({}))
    frames = [
        f._replace(velocity=None, ranges=None, landmarks=None, heading_rad=None)
        for f in frames_of("laps=1.5")
    ]
    return {"defaults": drive(brain, frames, out / "plain")}


LIVES = {cells: lambda out, cells=cells: a_life(cells, out) for cells in SETS}
LIVES["defaults"] = a_plain_life


@pytest.mark.parametrize("life", LIVES)
def test_what_a_brain_does_is_what_it_did(life, tmp_path):
    golden = json.loads(GOLDEN.read_text())
    now = LIVES[life](tmp_path)
    same_machine = golden["arithmetic"] == arithmetic()
    for name, before in golden["lives"][life].items():
        if same_machine:
            differ = [k for k, v in before["digests"].items() if now[name]["digests"].get(k) != v]
            assert differ == [], f"{life}, {name}"
        assert now[name]["figures"] == pytest.approx(before["figures"], abs=ROUNDING), name


def write_anew() -> None:
    with tempfile.TemporaryDirectory() as folder:
        lives = {name: life(Path(folder) / str(i)) for i, (name, life) in enumerate(LIVES.items())}
    GOLDEN.write_text(json.dumps({"arithmetic": arithmetic(), "lives": lives}, indent=1) + "\n")


if __name__ == "__main__":
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    write_anew()
