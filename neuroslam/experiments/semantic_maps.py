"""Questions to the semantic maps of runs in rendered worlds: names, attributes and areas."""

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from neuroslam.brain import load_brain
from neuroslam.config import BrainConfig, build_config, merge_values, read_preset
from neuroslam.errors import RunError
from neuroslam.evaluation.trajectory import align
from neuroslam.experiments.boundary_cells import write_results
from neuroslam.runs.ask import AskedMap
from neuroslam.runs.merge import merge_runs
from neuroslam.runs.parallel import parallel_map
from neuroslam.runs.reading import read_trace, trajectory, true_poses
from neuroslam.runs.run import resume, run
from neuroslam.sensors.landmarks import LandmarkWords
from neuroslam.spiking.extents import area_share, length_share
from neuroslam.spiking.semantic import SemanticCells
from neuroslam.worlds.landmarks import COLOURS
from neuroslam.worlds.posts import words_of_posts
from neuroslam.worlds.world import open_world

WORLDS = ("corridor", "ellipse")
CELLS = ("semantic", "pose+semantic")
STAGES = ("half, saved", "resumed", "merged")
_SENSES = (
    "width=64&height=40&noise=0.03&compass_deg=2&landmark_reach=6&frames_per_lap=150&outliers=0.05"
)
WALLS = {"LONG_WALL": (0, 1, 2), "SHORT_WALL": (4, 5)}
REGION = ("HALL", (1, 3, 5, 7))
"""Walls and a region whose corners are posts, in a file of words for every map."""
_BOXES = 4  # asked of each map
_RIGHT_M = 1.0  # a landmark is right if it is recalled within this distance
_EDGE_M = 0.5  # posts nearer to the edge of a box may be in either answer


class Trial(NamedTuple):
    """A semantic map to make: seed and cells; world and posts follow from the seed."""

    seed: int
    cells: str

    @property
    def world(self) -> str:
        """Source of its sessions, without laps, start and seed."""
        posts = 8 + self.seed % 5
        return f"world:{WORLDS[self.seed // 2 % 2]}?{_SENSES}&markers={posts}"


def semantic_maps(
    _data_folder: Path | None,
    out_folder: Path,
    maps: int = 100,
    first_seed: int = 100,
    jobs: int | None = None,
    ray: str | None = None,
) -> dict[str, Any]:
    """Make semantic maps by ``run``, ``resume`` and ``merge``, and score their answers.

    Each map is asked at three stages, each time from its file: after half of a session; after the
    rest, resumed; merged into it, a second session with another start and other noise. For each
    landmark on the map: where it is, and what is at its true position; for each colour, which
    landmarks have it; and what is in four boxes, with two walls and a region whose corners are
    landmarks. Landmarks, walls and regions within 0.5 m of the edge of a box may be in the answer
    or not. True positions are moved into the frame of the map
    by rigid alignment of the trajectory.

    Args:
        _data_folder: Not used.
        out_folder: ``results.json`` is written there.
        maps: Number of maps; world, posts, cells and noise follow from their seeds.
        first_seed: Seed of the first; the others follow.
        jobs: As for :func:`neuroslam.runs.parallel.parallel_map`: maps in parallel.
        ray: As for :func:`neuroslam.runs.parallel.parallel_map`.

    Returns:
        The content of ``results.json``: ``rows``, one for each stage, and ``each``, with the
        counts of every map.
    """
    trials = [Trial(seed, CELLS[seed % 2]) for seed in range(first_seed, first_seed + maps)]
    each = parallel_map(score, trials, jobs, ray)
    rows = [
        _row(stage, [scores[stage] for scores in each if stage in scores], len(each))
        for stage in STAGES
    ]
    return write_results(Path(out_folder), {"rows": rows, "each": each})


def _row(stage: str, scores: Sequence[Mapping[str, float]], n: int) -> dict[str, Any]:
    whole = [score for score in scores if score["named"] == score["landmarks"]]
    areas = [score for score in scores if score["areas_right"] == score["areas"]]
    total = {key: sum(score[key] for score in scores) for key in scores[0]} if scores else {}
    return {
        "stage": stage,
        "maps": f"{len(scores)} of {n}",
        "landmarks": total.get("landmarks", 0),
        "posts_not_mapped": total.get("not_mapped", 0),
        "named_rightly": total.get("named", 0),
        "maps_with_all_named": len(whole),
        "largest_error_m": max((score["error_m"] for score in scores), default=0.0),
        "areas_right": f"{total.get('areas_right', 0)} of {total.get('areas', 0)}",
        "maps_with_all_areas": len(areas),
        "attributes_right": f"{total.get('attributes_right', 0)} of {total.get('attributes', 0)}",
    }


def score(trial: Trial) -> dict[str, dict[str, float]]:
    """Make the maps of a trial, and score their answers.

    Returns:
        Stage -> counts; a refused merge has no entry.
    """
    config = _config(trial.cells)
    with tempfile.TemporaryDirectory() as name:
        first, second, merged = (Path(name) / folder for folder in ("first", "second", "merged"))
        areas = Path(name) / "areas.csv"
        rows = [f"wall,{wall},GREY * WALL,{_spaced(at)}" for wall, at in WALLS.items()]
        rows.append(f"region,{REGION[0]},WHITE * ROOM,{_spaced(REGION[1])}")
        areas.write_text("\n".join(["kind,name,words,corners", *rows, ""]))
        source = f"{trial.world}&laps=1.3&seed={2 * trial.seed}"
        run(source, first, config, landmarks=areas, stop=100, tensorboard=False)
        scores = {STAGES[0]: score_map(first, trial)}
        resume(first, tensorboard=False)
        scores[STAGES[1]] = score_map(first, trial)
        source = f"{trial.world}&laps=1.3&start=0.5&seed={2 * trial.seed + 1}"
        run(source, second, config, landmarks=areas, tensorboard=False)
        if merge_runs(first, second, merged)[0] is not None:
            scores[STAGES[2]] = score_map(merged, trial)
    return scores


def _spaced(numbers: Sequence[int]) -> str:
    return " ".join(map(str, numbers))


def _config(cells: str) -> BrainConfig:
    over = {"cells": cells, "semantic": {"landmarks": ["given"]}, "sessions": {"confirm": 3}}
    return build_config(merge_values(read_preset("full"), over))


def score_map(folder: Path, trial: Trial) -> dict[str, float]:
    """Ask the map of a run all questions, and count the right answers."""
    asked = AskedMap(folder)
    cells = asked.cells
    if not isinstance(cells, SemanticCells):
        raise TypeError("score_map: expected the map of a run")
    true_m = true_places(folder, trial)
    table = words_of_posts(len(true_m))
    known = cells.landmarks()
    mapped = sorted(known["number"][known["kind"] == 0].tolist())
    names = {table[number].name for number in mapped}
    named, errors = 0, []
    for number in mapped:
        name, (x, y) = table[number].name, true_m[number]
        there = asked.ask(f"where is {name}").found
        here = asked.ask(f"what is at {x:.6f},{y:.6f}", _RIGHT_M).found
        error = float(np.hypot(*(np.array(there[0].position_m) - (x, y)))) if there else np.inf
        errors.append(error)
        named += error <= _RIGHT_M and bool(here) and here[0].name == name
    attributes = 0
    for colour in COLOURS:
        has = {table[k].name for k in mapped if colour in table[k].words.split()}
        if has:
            attributes += {one.name for one in asked.ask(f"which are {colour}").found} == has
    right = sum(_box_is_right(asked, box, true_m, mapped, table) for box in _boxes(true_m, trial))
    colours = {table[k].words.split()[0] for k in mapped}
    return {
        "landmarks": len(names),
        "not_mapped": len(true_m) - len(names),
        "named": named,
        "error_m": max(errors, default=0.0),
        "areas": _BOXES,
        "areas_right": right,
        "attributes": len(colours),
        "attributes_right": attributes,
    }


def true_places(folder: Path, trial: Trial) -> np.ndarray:
    """Return the true positions of all posts in the frame of the map of a run, ``(n, 2)``."""
    trace = read_trace(folder)
    truth = true_poses(trace)
    brain = load_brain(folder / "brain.safetensors")
    track = trajectory(brain, trace)
    on_map = np.isfinite(track[:, 0])
    if truth is None:
        raise RunError(f"{folder}: its source has no true poses")
    fit = align(track[on_map, :2], truth[on_map, :2], "rigid")
    return fit.undo(open_world(trial.world).posts_m)


def _boxes(true_m: np.ndarray, trial: Trial) -> list[np.ndarray]:
    """Draw boxes around random posts, of 3 to 8 m a side, ``(2, 2)`` each: lower, upper corner."""
    draw = np.random.default_rng([trial.seed, 7])
    boxes = []
    for _ in range(_BOXES):
        middle = true_m[draw.integers(len(true_m))] + draw.uniform(-1.0, 1.0, 2)
        half = draw.uniform(1.5, 4.0, 2)
        boxes.append(np.stack([middle - half, middle + half]))
    return boxes


def _box_is_right(
    asked: AskedMap,
    box: np.ndarray,
    true_m: np.ndarray,
    mapped: Sequence[int],
    table: Sequence[LandmarkWords],
) -> bool:
    """Return whether the answer has all that is in a box, and nothing that is outside."""
    numbers = ",".join(f"{x:.6f}" for x in box.ravel())
    found = {one.name for one in asked.ask(f"what is in {numbers}").found}
    edge = np.array([[_EDGE_M], [-_EDGE_M]])
    inner, outer = box + edge, box - edge
    shapes = {table[k].name: true_m[[k]] for k in mapped}
    for name, corners in WALLS.items():
        if set(corners) <= set(mapped):
            shapes[name] = true_m[list(corners)]
    region = true_m[list(REGION[1])] if set(REGION[1]) <= set(mapped) else None
    must = {name for name, points in shapes.items() if _touches(points, inner)}
    may = {name for name, points in shapes.items() if _touches(points, outer)}
    if region is not None:
        must |= {REGION[0]} if area_share(region, *inner) > 0.0 else set()
        may |= {REGION[0]} if area_share(region, *outer) > 0.0 else set()
    return must <= found <= may


def _touches(points_m: np.ndarray, box: np.ndarray) -> bool:
    """Return whether a point, or a line through points, ``(n, 2)``, is partly in a box."""
    if len(points_m) == 1:
        return bool(((points_m[0] >= box[0]) & (points_m[0] <= box[1])).all())
    return length_share(points_m, *box) > 0.0
