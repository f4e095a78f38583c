"""The figures of a run."""

import textwrap
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
from matplotlib.figure import Figure

from neuroslam.brain import NavigationBrain, load_brain
from neuroslam.cells.navigation import NavigationCells
from neuroslam.cells.pose import PoseCellNetwork
from neuroslam.errors import RunError, counted
from neuroslam.figures.maps import plot_activity, plot_map, plot_pose_cells, plot_signals
from neuroslam.figures.places import plot_place_cells
from neuroslam.figures.style import plain_text, readable_source, save, shortened
from neuroslam.geometry import move_points
from neuroslam.runs.cells import activity_of, draw_cells
from neuroslam.runs.files import RunPlan, brain_file
from neuroslam.runs.reading import (
    length_unit,
    moved_onto,
    odometry_track,
    read_frames,
    read_plan,
    read_trace,
    trajectory,
    true_poses,
)
from neuroslam.state.answers import pictures_of
from neuroslam.types import Pose, PoseEstimate

_TITLE_WIDTH = 90  # characters


def plot(out: str | Path, to: str | Path) -> list[Path]:
    """Draw the figures of a run: map, cells, activity, view matches and counts over time.

    Only cells, views and walls that the brain has are drawn. The cells of an animal have rate maps,
    autocorrelograms and tuning curves, and a raster: as recorded, or computed along its path.

    Returns:
        The files that were written.
    """
    out, to = Path(out), Path(to)
    plan, brain = read_plan(out), load_brain(brain_file(out))
    rows = brain.clock.frames_seen
    trace, frames = read_trace(out, rows), read_frames(out, rows)
    try:
        to.mkdir(parents=True, exist_ok=True)
        draw_map(brain, plan, trace, to / "map.png", length_unit(out))
        brain = brain.largest
        path = trajectory(brain, trace)
        path = path[np.isfinite(path[:, 0])]
        figures: dict[str, Figure] = {}
        for kind, population in brain.populations.items():
            if kind in _DRAWN:
                figures |= _DRAWN[kind](population, path)
            else:
                for tag, picture in pictures_of(population).items():
                    name = f"{tag.replace('/', '_')}.png"
                    if name in {"map.png", "signals.png", *figures}:
                        raise TypeError(
                            f"{type(population).__name__}.images(): {tag!r} would be drawn as "
                            f"{name}, which is another figure; rename"
                        )
                    figures[name] = plot_activity(picture, tag)
        log, note = activity_of(out, brain, trace)
        if log is not None:
            figures |= draw_cells(log, note)
        figures["signals.png"] = plot_signals(frames, brain.config.view.threshold)
        for name, figure in figures.items():
            save(figure, to / name)
    except OSError as error:
        raise RunError(f"{to}: cannot be written ({error.strerror or error})") from None
    return [to / name for name in ("map.png", *figures)]


def _draw_pose_cells(cells: PoseCellNetwork, _path: np.ndarray) -> dict[str, Figure]:
    return {
        "pose_cells.png": plot_pose_cells(
            cells.activity.numpy(), cast(PoseEstimate, cells.estimate)
        )
    }


def _draw_place_cells(cells: NavigationCells, path: np.ndarray) -> dict[str, Figure]:
    """Draw the path where the cells are: the map has coordinates of its own."""
    track = move_points(path[:, :2], Pose(*path[-1]), cells.pose) if len(path) else path[:, :2]
    return {"place_cells.png": plot_place_cells(*cells.remembered(), cells.pose, track)}


_DRAWN: dict[str, Callable[[Any, np.ndarray], dict[str, Figure]]] = {
    "pose": _draw_pose_cells,
    "place": _draw_place_cells,
    "semantic": lambda _cells, _path: {},  # landmarks are drawn on the map
}
"""Figures of populations of the package; of all others the images are drawn."""


def draw_map(
    brain: NavigationBrain,
    plan: RunPlan,
    trace: dict[str, np.ndarray],
    path: Path,
    unit: str = "m",
) -> None:
    """Draw ``map.png`` of a run in the coordinates of its CSVs, one colour per session.

    Of several maps of the drive the largest is drawn.
    """
    present, brain = brain, brain.largest
    links, truth, log = brain.map.links, true_poses(trace), brain.sessions
    poses = trajectory(brain, trace)
    track = poses[:, :2]
    on_map = np.isfinite(track[:, 0])
    odometry = moved_onto(odometry_track(brain.config, trace), poses)
    names, number = _session_names(brain), {s.id: i for i, s in enumerate(log.sessions)}
    several = len(names) > 1
    alone = log.sessions and len(log.this_drive()) == 1
    whose = names[-1] if alone else plain_text(shortened(readable_source(plan.name)))
    made_by = np.array([number[one] for one in brain.map.experiences["session"].tolist()], np.int64)
    figure = plot_map(
        brain.map.poses,
        np.column_stack([links.source, links.target]),
        odometry_xy=odometry[:, :2],
        track_xy=track[on_map],
        truth_xy=None if truth is None else truth[on_map, :2],
        current=brain.map.pose if brain is present else None,
        landmarks=brain.landmarks_m,
        session=made_by if several else None,
        session_names=names if several else (),
        odometry_of=whose if several else "",
        title=_title(brain, plan, on_map, len(present.stored)),
        unit=unit,
    )
    save(figure, path)


def _title(brain: NavigationBrain, plan: RunPlan, on_map: np.ndarray, n_stored: int) -> str:
    """Return the title: source, frames, sessions, and frames on maps that were not joined."""
    n, sources = len(on_map), dict.fromkeys(s.source for s in brain.sessions.sessions)
    title = f"{readable_source(plan.name)}: {counted(n, 'frame')}"
    if len(brain.sessions.sessions) > 1:
        named = ", ".join(
            shortened(readable_source(source or "unknown source")) for source in sources
        )
        title = f"{len(brain.sessions.sessions)} sessions on one map: {named}"
    title = textwrap.fill(plain_text(title), _TITLE_WIDTH, max_lines=3, placeholder=" …")
    apart = n - int(on_map.sum())
    if n_stored and apart:
        title += f"\n{apart:,} of {counted(n, 'frame')} are on maps that were not joined"
    elif n_stored:
        stored = counted(n_stored, "stored map")
        title += f"\n{stored} {'was' if n_stored == 1 else 'were'} not joined"
    return title


def _session_names(brain: NavigationBrain) -> list[str]:
    """Name sessions by source, and by first frame too if a source has several."""
    sessions = brain.sessions.sessions
    times = Counter(session.source for session in sessions)
    names = []
    for session in sessions:
        since = f" from frame {session.first_frame}" if times[session.source] > 1 else ""
        names.append(
            plain_text(shortened(readable_source(session.source or "unknown source")) + since)
        )
    return names
