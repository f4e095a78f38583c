"""The demonstration: a drive through an embedded world, in two sessions of one brain."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from neuroslam.brain import load_brain
from neuroslam.config import BrainConfig
from neuroslam.errors import RunError
from neuroslam.plotting import plot_summary, save
from neuroslam.run_files import (
    odometry_track,
    read_frames,
    read_plan,
    read_trace,
    trajectory,
)
from neuroslam.runs import resume, run
from neuroslam.sensors import open_source
from neuroslam.types import StepResult

WORLD = "world:corridor?laps=2&noise=0.05&light=0.3&people=4"


def demo(
    out: str | Path,
    on_step: Callable[[StepResult], None] | None = None,
    on_start: Callable[[int | None], None] | None = None,
) -> list[tuple[str, str]]:
    """Map two laps of a corridor: one, save, reload, the other; and draw what came of it.

    Args:
        out: Folder for the files of the run and ``summary.png``; an earlier demo there is replaced.
        on_step: Called after each frame.
        on_start: Called before each session, with the frame at which it ends.

    Returns:
        What was measured, as names and figures to print.

    Raises:
        RunError: If the folder holds another run, or cannot be written.
    """
    out = Path(out)
    if (out / "frames.csv").exists() and read_plan(out).source != WORLD:
        raise RunError(f"{out}: holds a run of something else; take another folder")
    n_frames = open_source(WORLD).n_frames
    first = run(
        WORLD,
        out,
        BrainConfig(),
        stop=n_frames // 2,
        overwrite=True,
        on_step=on_step,
        on_start=on_start,
    )
    after_one_lap = first.counts
    summary = resume(out, on_step=on_step, on_start=on_start)
    draw_summary(out, out / "summary.png")
    figures = summary.to_dict()
    return [
        ("frames", f"{figures['frames']}"),
        ("frames/s", f"{figures['frames_per_s']:.0f}"),
        ("templates after one lap, after two", _both(after_one_lap, figures, "templates")),
        ("experiences after one lap, after two", _both(after_one_lap, figures, "experiences")),
        ("loop closures", f"{figures['loop_closures']}"),
        ("error of odometry alone (ATE)", f"{figures['odometry_ate_rmse_m']:.2f} m"),
        ("error of the map (ATE)", f"{figures['ate_rmse_m']:.2f} m"),
    ]


def draw_summary(out: str | Path, path: Path) -> None:
    """Draw a run on one sheet: odometry, map, cells, last view, counts over time."""
    out = Path(out)
    brain, trace, frames = load_brain(out / "brain.safetensors"), read_trace(out), read_frames(out)
    source = open_source(read_plan(out).source)
    last = next(iter(source.frames(int(frames["frame"][-1]))))
    links, cells = brain.map.links, brain.pose_cells
    truth = np.column_stack([trace["truth_x_m"], trace["truth_y_m"]])
    seen = int(frames["template"][-1])
    figure = plot_summary(
        brain.map.poses,
        np.column_stack([links.source, links.target]),
        frames,
        activity=cells.activity.numpy(),
        estimate=cells.estimate,
        image=last.image,
        template=brain.view.template_image(seen) if seen >= 0 else None,
        threshold=brain.config.view.threshold,
        odometry_xy=odometry_track(brain.config, trace)[:, :2],
        track_xy=trajectory(brain, trace)[:, :2],
        truth_xy=truth if np.isfinite(truth).all() else None,
        current=brain.map.pose,
        title=f"{source.name}: {len(trace['time_s'])} frames",
    )
    save(figure, path)


def _both(before: dict[str, int], after: dict[str, object], name: str) -> str:
    return f"{before[name]}, {after[name]}"
