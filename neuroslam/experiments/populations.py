"""What is lost without: the full brain, and the same with one population or correction less."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from neuroslam.brain import NavigationBrain
from neuroslam.config import build_config, merge_values, read_preset
from neuroslam.experiments.boundary_cells import write_results
from neuroslam.experiments.compare import run_brain
from neuroslam.figures.comparison import plot_without
from neuroslam.figures.style import save
from neuroslam.runs.parallel import parallel_map
from neuroslam.sensors import open_source
from neuroslam.state.population import Population
from neuroslam.types import Frame

WORLDS = ("corridor", "ellipse")
SENSES = (
    "width=64&height=40&noise=0.05&compass_deg=3&ranges=72&markers=12&landmark_reach=6"
    "&frames_per_lap=150"
)
EVERYTHING = "everything"


class Without(NamedTuple):
    """What a brain goes without.

    Attributes:
        cells: Its populations.
        over: What else differs from the preset ``full``.
        silence: Methods that a population has lost, by kind.
        compass: Whether its frames have a heading.
    """

    cells: str = "pose+place+semantic+head_direction"
    over: Mapping[str, Any] = {}
    silence: Mapping[str, Sequence[str]] = {}
    compass: bool = True


WITHOUT: dict[str, Without] = {
    EVERYTHING: Without(),
    "no pose cells": Without("place+semantic+head_direction"),
    "no place cells": Without("pose+semantic+head_direction"),
    "no semantic cells": Without("pose+place+head_direction"),
    "no head-direction cells": Without("pose+place+semantic"),
    "pose cells alone": Without("pose"),
    "no compass": Without(compass=False),
    "walls correct no one": Without(over={"wall_memory": {"corrects": False}}),
    "walls correct only place cells": Without(silence={"place": ["step"]}),
    "landmarks correct no one": Without(silence={"semantic": ["recall"]}),
    "no vetoes": Without(silence={"place": ["vetoes"]}),
    "pose cells follow no one": Without(silence={"pose": ["follow"]}),
}
"""Name -> what differs from the brain that has everything."""


class Told(NamedTuple):
    """A drive, and the names in ``WITHOUT`` of the brains that take it."""

    source: str
    names: Sequence[str]


def populations(
    _data_folder: Path | None,
    out_folder: Path,
    worlds: Sequence[str] = WORLDS,
    seeds: Sequence[int] = (0, 1, 2),
    laps: float = 2.0,
    names: Sequence[str] = tuple(WITHOUT),
    jobs: int | None = None,
    ray: str | None = None,
) -> dict[str, Any]:
    """Measure what the full brain loses without each population, sense and correction.

    Args:
        _data_folder: It needs none.
        out_folder: ``results.json`` and ``without.png`` are written there.
        worlds: Names of rendered worlds.
        seeds: Of the noise; one drive for each.
        laps: Of each drive.
        names: Of ``WITHOUT``.
        jobs: As for :func:`neuroslam.runs.parallel.parallel_map`: drives side by side.
        ray: The same.

    Returns:
        The content of ``results.json``: ``rows``, one for each world and name.
    """
    drives = [
        Told(f"world:{world}?{SENSES}&laps={laps:g}&seed={seed}", names)
        for world in worlds
        for seed in seeds
    ]
    errors = iter(parallel_map(drive, drives, jobs, ray))
    rows = []
    for world in worlds:
        of_seed = [next(errors) for _ in seeds]
        whole = np.array([each[names[0]] for each in of_seed])
        for name in names:
            ates = np.array([each[name] for each in of_seed])
            rows.append(
                {
                    "world": world,
                    "without": name,
                    "ate_m": float(ates.mean()),
                    "ate_each_m": ates.tolist(),
                    "worse_on": int((ates > whole).sum()),
                }
            )
    out = Path(out_folder)
    save(plot_without(rows), out / "without.png")
    return write_results(out, {"rows": rows})


def drive(what: Told) -> dict[str, float]:
    """Let brains take in the same frames; returns the error of each, RMS in m."""
    frames = list(open_source(what.source))
    return {name: error_of(WITHOUT[name], frames) for name in what.names}


def error_of(without: Without, frames: Sequence[Frame]) -> float:
    """Return the absolute trajectory error (m, laid rigidly) of a brain that goes without."""
    over = {"semantic": {"landmarks": ["given"]}, **without.over, "cells": without.cells}
    config = build_config(merge_values(read_preset("full"), over))
    if not without.compass:
        frames = [frame._replace(heading_rad=None) for frame in frames]
    return run_brain(config, frames, prepare=silencer(without.silence)).ate_m


def silencer(silence: Mapping[str, Sequence[str]]) -> Callable[[NavigationBrain], None]:
    """Return what takes from populations of a brain the methods by which they tell or follow."""

    def apply(brain: NavigationBrain) -> None:
        for kind, methods in silence.items():
            population = brain.populations[kind]
            for method in methods:
                setattr(population, method, _silent(population, method))

    return apply


def _silent(population: Population, method: str) -> Callable[..., None]:
    """Let a method do what it does and say nothing of it; who does not follow does nothing."""
    does = getattr(population, method)

    def silent(*given: object) -> None:
        if method != "follow":
            does(*given)

    return silent
