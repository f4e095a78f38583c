"""Drift of odometry by profiles, flow, both fused, and wheels, on worlds and on real drives."""

import csv
import time
from collections.abc import Callable, Iterator, Sequence
from math import atan, degrees
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from neuroslam.config import OdometryConfig
from neuroslam.errors import RunError
from neuroslam.experiments.boundary_cells import write_results
from neuroslam.figures.style import CURVES, STYLE, new_figure, save
from neuroslam.geometry import wrap_angle
from neuroslam.odometry.flow import FlowOdometry
from neuroslam.odometry.visual import VisualOdometry
from neuroslam.sensors import open_source
from neuroslam.sensors.source import Source
from neuroslam.threads import limit_threads
from neuroslam.types import Frame, Velocity
from neuroslam.worlds.world import WorldSource

METHODS = ("profiles", "flow", "fused", "wheels")
MADE_ON = ("corridor", "ellipse")
"""Worlds on which the settings of the flow were made."""
HELD_OUT = ("town", "district", "figure_eight")
DRIVES = ("usi_day1", "usi_day2", "usi_track1")


class Motions(NamedTuple):
    """What each method measured.

    Attributes:
        dt_s: Time of each frame since the one before, ``(n,)``.
        measured: Speed and turn rate by each method, ``(methods, n, 2)``.
        ms: CPU time a frame of each method.
        truth: Speed and turn rate, ``(n, 2)``; ``None``: not known.
    """

    dt_s: np.ndarray
    measured: np.ndarray
    ms: np.ndarray
    truth: np.ndarray | None


def odometry_drift(
    data_folder: Path | None,
    out_folder: Path,
    worlds: Sequence[str] = (*MADE_ON, *HELD_OUT),
    drives: Sequence[str] = DRIVES,
    frames: int | None = None,
) -> dict[str, Any]:
    """Measure odometry by all methods on rendered worlds, and on real drives by their laps.

    The scale of the speed of the profiles is fitted to the truth, which a robot cannot do. Height
    and tilt of a world's camera are known; those of a drive's are not.

    Args:
        data_folder: Holds the folders of the drives; ``None``: worlds only.
        out_folder: ``results.json`` and ``odometry_drift.png`` are written there.
        worlds: Names of rendered worlds.
        drives: Folders of drives, each with ``frames.tar`` and ``laps.csv``.
        frames: Frames of each source; all if not given.

    Returns:
        The content of ``results.json``: a row for each source and method.

    Raises:
        RunError: If a drive lacks one of its files.
    """
    rows: list[dict[str, Any]] = []
    with limit_threads(1):
        for world in worlds:
            rows += _rows_of_world(world, measure(open_source(f"world:{world}?noise=0.05"), frames))
        for drive in drives if data_folder is not None else ():
            folder = Path(data_folder or ".") / drive
            if not (folder / "laps.csv").is_file() or not (folder / "frames.tar").is_file():
                raise RunError(f"{folder}: expected frames.tar and laps.csv")
            motions = measure(open_source(folder / "frames.tar"), frames)
            rows += _rows_of_drive(drive, motions, read_laps(folder / "laps.csv"))
    save(_plot(rows), Path(out_folder) / "odometry_drift.png")
    results = {"rows": rows}
    write_results(Path(out_folder), results)
    return results


def measure(source: Source, stop: int | None = None) -> Motions:
    """Measure the motion from picture to picture by each method; wheels are those of the source."""
    tilt_deg, height_m, fov_deg = 0.0, None, 90.0
    if isinstance(source, WorldSource):
        camera = source.camera
        fov_deg, height_m = camera.fov_deg, camera.camera_height_m
        lower = (camera.horizon - 0.5) * camera.height / (0.5 * camera.width)
        tilt_deg = -degrees(atan(lower))
    config = OdometryConfig(
        method="flow", fov_deg=fov_deg, camera_height_m=height_m, camera_tilt_deg=tilt_deg
    )
    profiles, flow, fused = VisualOdometry(config), FlowOdometry(config), FlowOdometry(config)
    methods: tuple[Callable[[Frame, float], Velocity], ...] = (
        lambda frame, dt: profiles(_image(frame), dt),
        lambda frame, dt: flow(_image(frame), dt),
        lambda frame, dt: fused(_image(frame), dt, frame.velocity),
        lambda frame, _: frame.velocity or Velocity(np.nan, np.nan),
    )
    before: Frame | None = None
    found, took, times, truth = [], [], [], []
    for frame in source.frames(0, stop):
        if before is None:
            dt = source.frame(1).time_s - frame.time_s if isinstance(source, WorldSource) else 0.05
        else:
            dt = frame.time_s - before.time_s
        both, costs = [], []
        for method in methods:
            begin = time.process_time()
            both.append(method(frame, dt))
            costs.append(1e3 * (time.process_time() - begin))
        times.append(dt)
        found.append(both)
        took.append(costs)
        if frame.truth is not None:
            one = frame.truth if before is None or before.truth is None else before.truth
            dx, dy = frame.truth.x_m - one.x_m, frame.truth.y_m - one.y_m
            turn = wrap_angle(frame.truth.theta_rad - one.theta_rad)
            truth.append((np.hypot(dx, dy) / dt, turn / dt))
        before = frame
    kept = slice(1, None)  # the first picture shows no motion
    return Motions(
        np.array(times)[kept],
        np.array(found).transpose(1, 0, 2)[:, kept],
        np.median(np.array(took)[kept], axis=0),
        np.array(truth)[kept] if truth else None,
    )


def read_laps(path: Path) -> np.ndarray:
    """Return how many laps were driven at each frame, from columns ``lap`` and ``phase``."""
    with path.open(newline="") as file:
        return np.array([int(row["lap"]) + float(row["phase"]) for row in csv.DictReader(file)])


def _image(frame: Frame) -> np.ndarray:
    assert frame.image is not None
    return frame.image


def _rows_of_world(world: str, motions: Motions) -> Iterator[dict[str, Any]]:
    dt, truth = motions.dt_s, motions.truth
    assert truth is not None
    turned, driven = np.abs(truth[:, 1] * dt).sum(), (truth[:, 0] * dt).sum()
    for k, method in enumerate(METHODS):
        speed, turn = motions.measured[k].T
        if np.isnan(speed).any():  # a world without wheels
            continue
        if method == "profiles":
            speed = speed * (speed @ truth[:, 0]) / max(speed @ speed, 1e-12)
        off_turn, off_speed = (turn - truth[:, 1]) * dt, speed - truth[:, 0]
        yield {
            "source": world,
            "held_out": world not in MADE_ON,
            "method": method,
            "turn_rms_deg": degrees(np.sqrt(np.square(off_turn).mean())),
            "turned_deg": degrees(turned),
            "turn_drift_deg": degrees(off_turn.sum()),
            "speed_rms_percent": 100.0 * np.sqrt(np.square(off_speed).mean()) / truth[:, 0].mean(),
            "distance_drift_percent": 100.0 * (off_speed * dt).sum() / driven,
            "ms": float(motions.ms[k]),
        }


def _rows_of_drive(drive: str, motions: Motions, laps: np.ndarray) -> Iterator[dict[str, Any]]:
    """Yield how much turn and length of whole laps vary: of one track they are the same."""
    laps = laps[1 : len(motions.dt_s) + 1]
    whole = np.arange(np.ceil(laps[0]), np.floor(laps.max()) + 1)
    begins = np.array([int(np.argmax(laps >= lap)) for lap in whole])
    if len(begins) < 3:
        return
    for k, method in enumerate(METHODS[:2]):
        moved = np.add.reduceat(motions.measured[k] * motions.dt_s[:, None], begins)[:-1]
        length, turn = moved.T
        yield {
            "source": drive,
            "held_out": True,
            "method": method,
            "laps": len(length),
            "turn_of_a_lap_deg": degrees(turn.mean()),
            "turn_varies_percent": 100.0 * turn.std() / abs(turn.mean()),
            "length_varies_percent": 100.0 * length.std() / abs(length.mean()),
            "ms": float(motions.ms[k]),
        }


def _plot(rows: Sequence[dict[str, Any]]) -> Figure:
    panels = (
        ("Turn, worlds", "turn_rms_deg", "error of a frame, rms (degrees)"),
        ("Speed, worlds", "speed_rms_percent", "error of a frame, rms (% of the mean)"),
        ("Turn, drives", "turn_varies_percent", "standard deviation over laps (%)"),
    )
    panels = tuple(panel for panel in panels if any(panel[1] in row for row in rows))
    with mpl.rc_context(STYLE):
        figure = new_figure(4.6 * len(panels), 4.0, "Errors of odometry by four methods")
        for ax, (title, key, label) in zip(
            figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True
        ):
            own = [row for row in rows if key in row]
            sources = list(dict.fromkeys(row["source"] for row in own))
            methods = [m for m in METHODS if any(row["method"] == m for row in own)]
            width = 0.8 / len(methods)
            for k, method in enumerate(methods):
                bars = [row for row in own if row["method"] == method]
                at = [sources.index(row["source"]) + width * (k + 0.5) - 0.4 for row in bars]
                colour = CURVES[METHODS.index(method)]
                ax.bar(at, [row[key] for row in bars], width, color=colour, label=method)
            ax.set(title=title, ylabel=label)
            ax.set_xticks(range(len(sources)), [s.replace("_", " ") for s in sources], fontsize=8)
            ax.grid(visible=False, axis="x")
        handles, labels = figure.axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(METHODS))
    return figure
