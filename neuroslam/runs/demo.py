"""The demo: a drive through a rendered world, in two sessions that are merged into one map."""

from collections.abc import Callable
from pathlib import Path
from typing import cast

import numpy as np

from neuroslam.brain import load_brain
from neuroslam.config import BrainConfig
from neuroslam.errors import RunError
from neuroslam.figures.maps import plot_summary
from neuroslam.figures.sessions import Stage, plot_stages
from neuroslam.figures.style import readable_source, save
from neuroslam.figures.views import template_picture
from neuroslam.runs.files import brain_file, require_free
from neuroslam.runs.reading import (
    moved_onto,
    odometry_track,
    read_frames,
    read_plan,
    read_trace,
    trajectory,
)
from neuroslam.runs.results import RunSummary
from neuroslam.runs.run import run
from neuroslam.sensors import open_source
from neuroslam.types import PoseEstimate, StepResult

WORLD = "world:corridor?laps=2&noise=0.05&light=0.3&people=4"
FIRST_STOP, SECOND_START = 240, 290
"""Frames, of a lap of 340: the first session ends before the start of the second."""


def demo(
    out: str | Path,
    on_step: Callable[[StepResult], None] | None = None,
    on_start: Callable[[int | None], None] | None = None,
) -> list[tuple[str, str]]:
    """Map a corridor in two sessions, the second from an unknown start, and draw the map.

    Args:
        out: Folder for the runs ``first`` and ``second``, ``summary.png`` and ``sessions.png``; an
            earlier demo there is replaced.
        on_step: Called after each frame.
        on_start: Called before each session, with the frame at which it ends.

    Returns:
        Name and figure of each measured quantity, to print.

    Raises:
        RunError: If the folder holds another run, or cannot be written.
        KeyboardInterrupt: If a session is interrupted; its run is saved.
    """
    out = Path(out)
    for folder in (out, out / "first", out / "second"):
        if (folder / "frames.csv").exists() and read_plan(folder).source != WORLD:
            raise RunError(f"{folder}: holds a run of another source; choose another folder")
    require_free(out, WORLD, overwrite=True)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunError(f"{out}: cannot be written ({error.strerror or error})") from None
    parts: list[RunSummary] = []
    for name, start, stop, maps in (
        ("first", 0, FIRST_STOP, ()),
        ("second", SECOND_START, None, (out / "first",)),
    ):
        parts.append(
            run(
                WORLD, out / name, BrainConfig(), maps=maps, start=start, stop=stop,
                overwrite=True, on_step=on_step, on_start=on_start,
            )
        )  # fmt: skip
        if parts[-1].interrupted:  # figures of half a session would mislead
            raise KeyboardInterrupt
    draw_summary(out / "second", out / "summary.png")
    _draw_sessions(out, parts[1])
    first, second = (part.to_dict() for part in parts)
    rows = [
        ("frames, first session and second", f"{first['frames']}, {second['frames']}"),
        ("frames/s", f"{second['frames_per_s']:.0f}"),
        ("experiences of the first session", f"{first['experiences']}"),
    ]
    for report in parts[1].merges:
        n = report["counts"]["experiences"]
        rows.append((f"merged at frame {report['at_frame']}, experiences before",
                     f"{n['loaded']} + {n['partial']}"))  # fmt: skip
        rows.append(("experiences after the merge", f"{n['merged']}"))
    return [
        *rows,
        ("experiences at the end", f"{second['experiences']}"),
        ("loop closures", f"{second['loop_closures']}"),
        ("ATE of odometry alone (rigid)", f"{second['odometry_ate_rmse_m']:.2f} m"),
        ("ATE of the map (rigid)", f"{second['ate_rmse_m']:.2f} m"),
    ]


def _draw_sessions(out: Path, summary: RunSummary) -> None:
    """Draw the map of the first session beside the merged map."""
    brains = [load_brain(out / name / "brain.safetensors") for name in ("first", "second")]
    sessions = [brain.sessions.now.id for brain in brains]
    matched = [report["match"]["loaded_experience"] for report in summary.merges]
    panels = []
    for title, brain, points in (
        ("after the first session", brains[0], []),
        ("after the second session, merged", brains[1], matched),
    ):
        links, table = brain.map.links, brain.map.experiences
        panels.append(
            Stage(
                title,
                brain.map.poses,
                np.column_stack([links.source, links.target]),
                np.array([sessions.index(session) for session in table["session"].tolist()]),
                brain.map.poses[points, :2],
            )
        )
    save(plot_stages(panels, "Two sessions, one map"), out / "sessions.png")


def draw_summary(out: str | Path, path: Path) -> None:
    """Draw a run on one sheet: odometry, map, cells, last view, counts over time."""
    out = Path(out)
    brain, trace, frames = load_brain(brain_file(out)), read_trace(out), read_frames(out)
    source = open_source(read_plan(out).source)
    last = next(iter(source.frames(int(frames["frame"][-1]))))
    links, cells = brain.map.links, brain.pose_cells
    truth = np.column_stack([trace["truth_x_m"], trace["truth_y_m"]])
    track = trajectory(brain, trace)[:, :2]
    on = np.isfinite(track[:, 0])
    seen = int(frames["template"][-1])
    figure = plot_summary(
        brain.map.poses,
        np.column_stack([links.source, links.target]),
        frames,
        activity=cells.activity.numpy(),
        estimate=cast(PoseEstimate, cells.estimate),
        image=last.image,
        template=template_picture(brain.view, seen) if seen >= 0 else None,
        threshold=brain.config.view.threshold,
        odometry_xy=moved_onto(odometry_track(brain.config, trace), track)[:, :2],
        track_xy=track[on],
        truth_xy=truth[on] if np.isfinite(truth).all() else None,
        current=brain.map.pose,
        title=f"{readable_source(source.name)}: {len(trace['time_s'])} frames",
    )
    save(figure, path)
