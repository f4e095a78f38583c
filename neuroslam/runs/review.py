"""Looking back at a run: its errors against the truth, and its figures."""

import textwrap
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import get_args

import numpy as np

from neuroslam.brain import NavigationBrain, load_brain
from neuroslam.errors import RunError, counted
from neuroslam.evaluation.trajectory import (
    AlignmentMode,
    ErrorStatistics,
    absolute_trajectory_error,
    associate,
    read_tum,
    relative_pose_error,
)
from neuroslam.figures.maps import plot_map, plot_pose_cells, plot_signals, save
from neuroslam.figures.places import plot_place_cells
from neuroslam.figures.style import plain_text, shortened
from neuroslam.runs.files import (
    RunPlan,
    odometry_track,
    read_frames,
    read_plan,
    read_trace,
    track_file,
    trajectory,
    true_poses,
)

_TITLE_WIDTH = 90  # letters


def evaluate(
    track: str | Path,
    truth: str | Path | None = None,
    align: AlignmentMode = "rigid",
    on_note: Callable[[str], None] | None = None,
) -> list[tuple[str, ErrorStatistics, str]]:
    """Compare a run, or any TUM file, with the true track.

    Args:
        track: Folder of a run, or a TUM file.
        truth: TUM file; a run of a source that knows its truth needs none.
        align: How the track is laid over the truth before it is compared.
        on_note: Called with what the errors leave out, if they do: frames without a true pose.

    Returns:
        Name of the error, its statistics, its unit.

    Raises:
        NeuroslamError: If a file is missing or damaged, or there is no truth to compare with.
    """
    track = Path(track)
    if align not in get_args(AlignmentMode):
        raise RunError(f"--align {align}: expected one of {', '.join(get_args(AlignmentMode))}")
    out = track if track.is_dir() else None
    found = read_tum(track if out is None else track_file(out))
    if truth is not None:
        true = read_tum(Path(truth))
        i, j = associate(found.times_s, true.times_s)
        estimate, reference = found.poses[i], true.poses[j]
    else:
        trace = None if out is None else read_trace(out, len(found.times_s))
        true_track = None if trace is None else true_poses(trace)
        if true_track is None:
            raise RunError(f"{track}: its source knows no truth; give one with --truth FILE")
        i, j = associate(found.times_s, trace["time_s"])  # a frame may be on no map
        estimate, reference = found.poses[i], true_track[j]
    if len(estimate) < 2:
        raise RunError(
            f"{track}: {len(estimate)} of its frames have a true pose of their time; expected two"
        )
    n_frames = len(found.times_s)
    if on_note is not None and len(estimate) < n_frames:
        on_note(
            f"{len(estimate)} of {counted(n_frames, 'frame')} have truth; the errors are theirs"
        )
    relative = relative_pose_error(estimate, reference)
    return [
        (
            "absolute (ATE)",
            absolute_trajectory_error(estimate[:, :2], reference[:, :2], align),
            "m",
        ),
        ("relative, a frame", relative.translation_m, "m"),
        ("relative, a frame", relative.rotation_rad, "rad"),
    ]


def plot(out: str | Path, to: str | Path) -> list[Path]:
    """Draw the figures of a run: map, cells at its end, recognition and counts over time.

    Of cells, views and walls those that the brain has are drawn.

    Returns:
        The files that were written.
    """
    out, to = Path(out), Path(to)
    plan, brain = read_plan(out), load_brain(out / "brain.safetensors")
    rows = brain.clock.frames_seen
    trace, frames = read_trace(out, rows), read_frames(out, rows)
    try:
        to.mkdir(parents=True, exist_ok=True)
        draw_map(brain, plan, trace, to / "map.png")
        figures = {"signals.png": plot_signals(frames, brain.config.view.threshold)}
        if brain.config.has("place"):
            cells, path = brain.navigation, trajectory(brain, trace)[:, :2]
            drawn = plot_place_cells(*cells.remembered(), cells.pose, path)
            figures = {"place_cells.png": drawn} | figures
        if brain.config.has("pose"):
            cells = brain.pose_cells
            drawn = plot_pose_cells(cells.activity.numpy(), cells.estimate)
            figures = {"pose_cells.png": drawn} | figures
        for name, figure in figures.items():
            save(figure, to / name)
    except OSError as error:
        raise RunError(f"{to}: cannot be written ({error.strerror or error})") from None
    return [to / name for name in ("map.png", *figures)]


def draw_map(
    brain: NavigationBrain, plan: RunPlan, trace: dict[str, np.ndarray], path: Path
) -> None:
    """Draw ``map.png`` of a run: in the coordinates of its CSVs, each session in its colour."""
    links, truth, log = brain.map.links, true_poses(trace), brain.sessions
    track = trajectory(brain, trace)[:, :2]
    on_map = np.isfinite(track[:, 0])
    names, number = _session_names(brain), {s.id: i for i, s in enumerate(log.sessions)}
    several = len(names) > 1
    alone = log.sessions and len(log.this_drive()) == 1
    whose = names[-1] if alone else plain_text(shortened(plan.name))
    made_by = np.array([number[one] for one in brain.map.experiences["session"].tolist()], np.int64)
    figure = plot_map(
        brain.map.poses,
        np.column_stack([links.source, links.target]),
        odometry_xy=odometry_track(brain.config, trace)[:, :2],
        track_xy=track[on_map],
        truth_xy=None if truth is None else truth[on_map, :2],
        current=brain.map.pose,
        landmarks=brain.landmarks_m,
        session=made_by if several else None,
        session_names=names if several else (),
        odometry_of=whose if several else "",
        title=_title(brain, plan, on_map),
    )
    save(figure, path)


def _title(brain: NavigationBrain, plan: RunPlan, on_map: np.ndarray) -> str:
    """Say what is on the map, and what is on others."""
    n, sources = len(on_map), dict.fromkeys(s.source for s in brain.sessions.sessions)
    title = f"{plan.name}: {counted(n, 'frame')}"
    if len(brain.sessions.sessions) > 1:
        named = ", ".join(shortened(source or "unknown source") for source in sources)
        title = f"{len(brain.sessions.sessions)} sessions on one map: {named}"
    title = textwrap.fill(title, _TITLE_WIDTH, max_lines=3, placeholder=" …")
    apart = n - int(on_map.sum())
    if brain.stored and apart:
        title += f"\n{apart:,} of {counted(n, 'frame')} are on maps that were not joined"
    elif brain.stored:
        stored = counted(len(brain.stored), "stored map")
        title += f"\n{stored} {'was' if len(brain.stored) == 1 else 'were'} not joined"
    return plain_text(title)


def _session_names(brain: NavigationBrain) -> list[str]:
    """Name sessions by their sources, and where one has several by their first frames too."""
    sessions = brain.sessions.sessions
    times = Counter(session.source for session in sessions)
    names = []
    for session in sessions:
        since = f" from frame {session.first_frame}" if times[session.source] > 1 else ""
        names.append(plain_text(shortened(session.source or "unknown source") + since))
    return names
