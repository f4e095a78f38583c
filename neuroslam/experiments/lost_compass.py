"""A rat whose compass fails: head-direction and speed cells in place of measured self-motion."""

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from neuroslam.brain import NavigationBrain
from neuroslam.config import build_config, merge_values, read_preset
from neuroslam.errors import RunError
from neuroslam.experiments.boundary_cells import write_results
from neuroslam.figures.style import CURVES, INK, STYLE, new_figure, save, write_title
from neuroslam.geometry import wrap_angles
from neuroslam.runs.parallel import parallel_map
from neuroslam.threads import limit_threads
from neuroslam.types import Frame, Velocity
from neuroslam.worlds.senses import ArenaSource, open_arena

TURN_NOISE_DEG_S = 10.0
"""White noise of each turn rate, as in the experiment ``head-direction``."""

_CELLS = {"grid_cells": {"self_motion": "cells"}}
METHODS: dict[str, dict[str, Any]] = {
    "measured": {},
    "head-direction cells": {"cells": ["place", "head_direction"], **_CELLS},
    "head-direction and speed cells": {
        "cells": ["place", "head_direction", "speed"], "speed": {"noise_hz": 1.0}, **_CELLS,
    },
}  # fmt: skip
"""What moves the grid cells -> differences from the preset ``slrb``."""


def frames_without_compass(source: ArenaSource, lost_s: float, seed: int) -> Iterator[Frame]:
    """Yield the frames of an animal whose turn rates are measured, and whose compass fails.

    Args:
        source: Of the animal; its turn rates are replaced by true ones with white noise.
        lost_s: Time after which frames have no heading.
        seed: Of the noise.
    """
    senses = source.senses
    true = np.diff(senses.true_heading_rad, prepend=senses.true_heading_rad[0])
    rates = wrap_angles(true) / senses.dt_s
    noise = np.random.default_rng([seed, 77]).standard_normal(len(rates))
    rates = rates + math.radians(TURN_NOISE_DEG_S) * noise
    for frame, rate in zip(source, rates.tolist(), strict=True):
        assert frame.velocity is not None
        lost = frame.time_s >= lost_s
        yield frame._replace(
            velocity=Velocity(frame.velocity.v_m_s, rate),
            heading_rad=None if lost else frame.heading_rad,
        )


def lost_compass(
    _data_folder: Path | None,
    out_folder: Path,
    minutes: float = 6.0,
    lost_min: float = 2.0,
    seeds: Sequence[int] = (0, 1, 2, 3),
    arena: str = "square",
    jobs: int | None = None,
    ray: str | None = None,
) -> dict[str, Any]:
    """Measure the errors of position and heading before and after the compass fails.

    Args:
        _data_folder: Not used.
        out_folder: ``results.json`` and ``lost_compass.png`` are written there.
        minutes: Length of each walk.
        lost_min: When the compass fails.
        seeds: Seed of each walk and its noise.
        arena: Name of the arena.
        jobs: As for :func:`neuroslam.runs.parallel.parallel_map`.
        ray: As for :func:`neuroslam.runs.parallel.parallel_map`.

    Returns:
        The content of ``results.json``: a row for each method, with walls and without.

    Raises:
        RunError: If the compass fails before the first or after the last minute.
    """
    if not 1.0 <= lost_min <= minutes - 1.0:
        raise RunError(f"lost_min is {lost_min:g}; expected 1 to {minutes - 1.0:g}")
    drives = [
        (name, walls, f"arena:{arena}?minutes={minutes:g}&speed=0.2&seed={seed}", lost_min, seed)
        for walls in (True, False)
        for name in METHODS
        for seed in seeds
    ]
    errors = parallel_map(_drive, drives, jobs, ray)
    rows, curves, at = [], {}, 0
    for walls in (True, False):
        for name in METHODS:
            each = np.stack(errors[at : at + len(seeds)])  # animals, (position, heading), samples
            at += len(seeds)
            rows.append(_row(name, walls, each, minutes, lost_min))
            curves[walls, name] = each[:, 0].mean(axis=0)
    results = {"rows": rows}
    save(_plot(curves, minutes, lost_min), Path(out_folder) / "lost_compass.png")
    write_results(Path(out_folder), results)
    return results


def _drive(drive: tuple[str, bool, str, float, int]) -> np.ndarray:
    """Return the errors of position (m) and heading (rad) at every frame, ``(2, t)``."""
    name, walls, spec, lost_min, seed = drive
    values = merge_values(read_preset("slrb"), METHODS[name])
    values = merge_values(values, {"wall_memory": {"corrects": walls}})
    brain, source = NavigationBrain(build_config(values, name)), open_arena(spec)
    found, true = [], []
    with limit_threads(1):
        for frame in frames_without_compass(source, 60.0 * lost_min, seed):
            found.append(brain(frame).pose)
            true.append(frame.truth)
    pose, truth = np.array(found), np.array(true)
    off = pose[:, :2] - (truth[:, :2] - truth[0, :2])
    return np.stack([np.hypot(*off.T), np.abs(wrap_angles(pose[:, 2] - truth[:, 2]))])


def _row(
    name: str, walls: bool, errors: np.ndarray, minutes: float, lost_min: float
) -> dict[str, Any]:
    per_min = errors.shape[-1] / minutes
    before = slice(int((lost_min - 1.0) * per_min), int(lost_min * per_min))
    after, last = slice(before.stop, None), slice(int((minutes - 1.0) * per_min), None)
    rms = np.sqrt(np.square(errors).mean(axis=0))
    return {
        "self_motion": name,
        "walls_correct": walls,
        "error_before_m": float(errors[:, 0, before].mean()),
        "error_after_m": float(errors[:, 0, after].mean()),
        "error_last_minute_m": float(errors[:, 0, last].mean()),
        "error_last_minute_std_m": float(errors[:, 0, last].mean(axis=1).std()),
        "heading_before_deg": float(np.degrees(np.sqrt(np.square(rms[1, before]).mean()))),
        "heading_after_deg": float(np.degrees(np.sqrt(np.square(rms[1, after]).mean()))),
    }


def _plot(curves: Mapping[tuple[bool, str], np.ndarray], minutes: float, lost_min: float) -> Figure:
    with mpl.rc_context(STYLE):
        figure = new_figure(9.5, 3.9, "Position error of a rat whose compass fails")
        panels = figure.subplots(1, 2)
        for ax, walls in zip(panels, (True, False), strict=True):
            for name, colour in zip(METHODS, CURVES, strict=False):
                curve = 100.0 * curves[walls, name]
                time = np.linspace(0.0, minutes, len(curve))
                ax.plot(time, curve, color=colour, lw=1.2, label=name)
            ax.axvline(lost_min, color=INK, ls="--", lw=1.0, label="the compass fails")
            ax.set(xlabel="time (min)", ylabel="position error (cm)", xlim=(0.0, minutes))
            ax.set_ylim(0.0, None)
            write_title(ax, "Walls correct" if walls else "No correction by walls", "mean")
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=4)
    return figure
