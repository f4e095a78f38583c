"""Parts of figures, drawn onto axes: a map, a robot, cells, a view, curves."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure, SubFigure
from matplotlib.markers import MarkerStyle
from matplotlib.path import Path as Outline
from matplotlib.ticker import MaxNLocator, StrMethodFormatter

from neuroslam.errors import MapError, counted
from neuroslam.evaluation.trajectory import (
    AlignmentMode,
    absolute_trajectory_error,
    align,
    path_length,
)
from neuroslam.figures.style import (
    ACTIVITY,
    INK,
    LANDMARK,
    LOOP,
    MAP,
    ODOMETRY,
    OTHER,
    ROBOT,
    SESSIONS,
    TRUTH,
    WALL,
    as_rgb,
    legend_below,
    write_title,
)
from neuroslam.mapping.tables import closes_loop
from neuroslam.types import Pose, PoseEstimate

_DART = Outline([(1.0, 0.0), (-0.8, 0.65), (-0.4, 0.0), (-0.8, -0.65), (1.0, 0.0)])


class _Truth(NamedTuple):
    # The truth in the coordinates of the map.
    xy: np.ndarray | None
    walls: np.ndarray
    label: str


def _align_truth(track: np.ndarray, truth: np.ndarray | None, walls: np.ndarray | None) -> _Truth:
    segments = np.empty((0, 2, 2)) if walls is None else np.asarray(walls).reshape(-1, 2, 2)
    if truth is None or not len(truth):
        return _Truth(None, segments, "")
    track, truth = np.asarray(track), np.asarray(truth)
    if len(track) != len(truth):
        raise ValueError(
            f"plot_map: truth_xy has {len(truth)} points and the track {len(track)}; "
            "give track_xy with a point for each of the truth"
        )
    known = np.isfinite(truth).all(axis=1)  # rows without a true position leave gaps
    if not known.any():
        return _Truth(None, segments, "")
    seen, true = track[known], truth[known]
    mode: AlignmentMode = "similarity"
    try:
        alignment = align(seen, true, mode)
    except MapError:  # a robot that stood still fixes no rotation, but there is still an error
        mode = "none"
        alignment = align(seen, true, mode)
    ate = absolute_trajectory_error(seen, true, mode).rmse
    how = mode if mode == "similarity" else "not aligned"
    walls_on_map = alignment.undo(segments.reshape(-1, 2)).reshape(-1, 2, 2)
    return _Truth(alignment.undo(truth), walls_on_map, f"truth: ATE {_metres(ate)} ({how})")


def draw_odometry(axes: Axes, xy: np.ndarray, whose: str = "", unit: str = "m") -> None:
    """Draw a dead-reckoned track ``(k, 2)``; the legend names its session, if given.

    Its length is written where the unit is metres: an arbitrary one has no length to state.
    """
    axes.plot(*xy.T, color=ODOMETRY, lw=1.1, label=f"odometry of {whose}" if whose else "odometry")
    _draw_ends(axes, xy)
    length = f" · {path_length(xy):,.1f} m" if unit == "m" else ""
    write_title(axes, "Odometry alone", counted(len(xy), "frame") + length)
    _metric(axes)


_SHORT, _FEW = 0.03, 30
"""Share of the extent of the map below which a loop closure is a dot too, if there are few."""


def draw_map(
    axes: Axes,
    poses: np.ndarray,
    links: np.ndarray,
    track: np.ndarray | None,
    truth: np.ndarray | None,
    walls: np.ndarray | None,
    current: Pose | None,
    landmarks: np.ndarray | None = None,
    session: np.ndarray | None = None,
    names: Sequence[str] = (),
    planned: np.ndarray | None = None,
) -> None:
    """Draw experiences, links, loop closures, landmarks, the robot, a path, and the truth."""
    poses, links = np.asarray(poses).reshape(-1, 3), np.asarray(links, np.int64).reshape(-1, 2)
    xy, is_loop = poses[:, :2], closes_loop(links[:, 0], links[:, 1])
    counts = ((len(xy), "experience"), (len(links), "link"), (int(is_loop.sum()), "loop closure"))
    write_title(axes, "Experience map", " · ".join(counted(*count) for count in counts))
    if not len(xy):
        axes.text(0.5, 0.5, "no experiences", transform=axes.transAxes, ha="center", va="center")
        axes.set(xticks=[], yticks=[])
        return
    true = _align_truth(xy if track is None else track, truth, walls)
    spots = np.empty((0, 2)) if landmarks is None else np.asarray(landmarks).reshape(-1, 2)
    if len(true.walls):
        lines = LineCollection([*true.walls], colors=WALL, lw=2.5, zorder=1, label="walls")
        axes.add_collection(lines)
    _draw_experiences(axes, xy, links[~is_loop], session, names)
    if is_loop.any():
        loops = xy[links[is_loop]]
        axes.add_collection(
            LineCollection([*loops], colors=LOOP, lw=1.3, zorder=4, label="loop closure")
        )
        length, extent = np.ptp(loops, axis=1).max(axis=1), np.ptp(xy, axis=0).max()
        short = loops[length < _SHORT * extent].mean(axis=1)  # hidden by its experiences
        if len(short) <= _FEW:
            axes.plot(*short.T, "o", color=LOOP, ms=4.0, mec="white", mew=0.5, zorder=7)
    if true.xy is not None:
        axes.plot(*true.xy.T, "--", color=TRUTH, lw=0.9, zorder=5, label=true.label)
    if len(spots):
        style: dict[str, Any] = {"ls": "none", "marker": "*", "ms": 10, "mfc": LANDMARK}
        axes.plot(*spots.T, zorder=6, label="landmarks", mec=INK, mew=0.5, **style)
    if planned is not None:
        course = np.asarray(planned)
        axes.plot(*course.T, color=OTHER, lw=4.0, alpha=0.8, zorder=5, label="planned path")
        axes.plot(*course[-1], "D", color=OTHER, ms=8, mec=INK, mew=0.8, zorder=8, label="goal")
        _draw_ends(axes, course, end=False)  # beside a goal, a start is that of the path
    else:
        _draw_ends(axes, xy, end=current is None)
    if current is not None:
        draw_robot(axes, current, "robot now")
    axes.autoscale_view()
    _metric(axes)


def draw_robot(axes: Axes, pose: Pose, label: str) -> None:
    """Draw the pose of a robot as a dart that points along its heading."""
    marker = MarkerStyle(_DART).rotated(rad=pose.theta_rad)
    style: dict[str, Any] = {"ls": "none", "marker": marker, "ms": 13, "mfc": ROBOT}
    style |= {"mec": INK, "mew": 0.8}
    axes.plot(*pose[:2], zorder=8, label=label, **style)


def _draw_experiences(
    axes: Axes,
    xy: np.ndarray,
    links: np.ndarray,
    session: np.ndarray | None,
    names: Sequence[str],
) -> None:
    """Draw experiences and the links between neighbours in time, in the colours of sessions."""
    owner = np.zeros(len(xy), np.int64) if session is None else np.asarray(session)
    link_owner = owner[links].max(axis=1)  # the later session made the link
    style: dict[str, Any] = {"ls": "none", "marker": "o", "mew": 0, "zorder": 3}
    style["ms"] = float(np.clip(50.0 / math.sqrt(max(1, len(xy))), 2.0, 4.5))
    for number, name in enumerate(names or ["experiences, links"]):
        colour, own = SESSIONS[number % len(SESSIONS)], xy[owner == number]
        lines = [*xy[links[link_owner == number]]]
        axes.add_collection(LineCollection(lines, colors=colour, lw=0.9, alpha=0.8, zorder=2))
        axes.plot(*own.T, color=colour, **style)
        label = name if len(own) else f"{name}: no experience of its own"
        axes.plot([], [], "-o", color=colour, lw=0.9, ms=4, label=label)


def _draw_ends(axes: Axes, xy: np.ndarray, end: bool = True) -> None:
    style: dict[str, Any] = {"ls": "none", "mec": INK, "mew": 1.4, "zorder": 7}
    if len(xy):
        # Larger than the end and above it: the two are often at one point.
        axes.plot(*xy[0], marker="o", ms=10, mfc="none", label="start", **style)
    if len(xy) and end:
        axes.plot(*xy[-1], marker="s", ms=4.5, mfc=INK, label="end", **style)


def draw_pose_cells(
    figure: Figure | SubFigure,
    axes: Sequence[Axes],
    activity: np.ndarray,
    estimate: PoseEstimate | None,
    injection: PoseEstimate | None,
) -> None:
    """Draw the activity summed over heading and summed over y, with a colour bar."""
    n_theta, n_y, n_x = activity.shape
    step = 360.0 / n_theta
    above, side = activity.sum(axis=0), activity.sum(axis=1)
    top = max(float(above.max()), float(side.max())) or 1.0
    for ax, layer, extent, vertical in (
        (axes[0], above, (-0.5, n_x - 0.5, -0.5, n_y - 0.5), "y (cells)"),
        (axes[1], side, (-0.5, n_x - 0.5, -step / 2, 360.0 - step / 2), "heading θ (°)"),
    ):
        picture = ax.imshow(
            layer, ACTIVITY, origin="lower", extent=extent, aspect="auto", vmin=0.0, vmax=top
        )
        ax.set(xlabel="x (cells)", ylabel=vertical)
        ax.xaxis.set_major_locator(MaxNLocator(6, integer=True))
        ax.yaxis.set_major_locator(MaxNLocator(6, integer=True))
        ax.grid(visible=False)
        ax.set_box_aspect(n_y / n_x)
    write_title(axes[0], "Pose cells", "summed over θ")
    write_title(axes[1], "Pose cells", "summed over y")
    axes[1].set_yticks(range(0, 360, 90))
    marks = ((injection, "o", "view injects here", 15), (estimate, "x", "estimate", 9))
    for mark, marker, label, size in marks:
        if mark is not None:
            style: dict[str, Any] = {"ls": "none", "marker": marker, "ms": size, "mew": 2.2}
            style["mfc"] = "none"
            axes[0].plot(mark.x, mark.y, mec=LOOP, label=label, **style)
            axes[1].plot(mark.x, mark.theta * step, mec=LOOP, **style)
    if axes[0].get_legend_handles_labels()[0]:
        legend_below(axes[0], columns=2)
    bar = figure.colorbar(picture, cax=axes[1].inset_axes((1.04, 0.0, 0.045, 1.0)))
    bar.set_label("share of all activity")
    bar.outline.set_visible(False)


def draw_frame(axes: Axes, image: np.ndarray) -> None:
    """Draw a camera picture, grey or RGB."""
    axes.imshow(as_rgb(image))
    write_title(axes, "Frame", f"{image.shape[1]} by {image.shape[0]} px")
    axes.set_axis_off()


def draw_template(axes: Axes, template: np.ndarray, error: float, template_id: int) -> None:
    """Draw a template and its match error."""
    top = 255 if template.dtype == np.uint8 else 1.0
    axes.imshow(template, "gray", vmin=0, vmax=top, interpolation="nearest")
    note = f"match error {error:.3f}" if error >= 0 else "the first view"
    write_title(axes, f"Template {template_id}", note)
    axes.set_axis_off()


def draw_signals(
    figure: Figure | SubFigure, frames: Mapping[str, np.ndarray], threshold: float | None
) -> None:
    """Draw match errors, where views were matched, and counts, over time."""
    has_views = bool(np.any(frames["n_templates"]))
    axes = figure.subplots(1 + has_views, 1, sharex=True, squeeze=False)[:, 0]
    if has_views:
        _draw_recognition(axes[0], frames, threshold)
    # The counts are often equal: a wide line, a line on it, and dashes on both.
    columns: tuple[tuple[str, str, float, Any], ...] = (
        ("n_links", "#56B4E9", 4.5, "-"), ("n_experiences", LOOP, 1.6, "-"),
        ("n_templates", INK, 1.6, (0, (3, 4))),
    )  # fmt: skip
    for name, colour, width, dash in columns[: 2 + has_views]:
        counts = np.asarray(frames[name])
        last = int(counts[-1]) if len(counts) else 0
        label = f"{last:,} {name[2:]}"
        axes[-1].plot(frames["time_s"], counts, color=colour, lw=width, ls=dash, label=label)
    axes[-1].set(xlabel="time (s)", ylabel="count")
    axes[-1].yaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    axes[-1].yaxis.set_major_locator(MaxNLocator("auto", steps=[1, 2, 2.5, 5, 10], integer=True))
    axes[-1].set_ylim(0, max(1.0, axes[-1].get_ylim()[1]))
    write_title(axes[-1], "Size of the map")
    _legend_above(axes[-1])


def _draw_recognition(
    axes: Axes, frames: Mapping[str, np.ndarray], threshold: float | None
) -> None:
    time = np.asarray(frames["time_s"], np.float64)
    error = np.asarray(frames["match_error"], np.float64)
    error = np.where(error < 0, np.nan, error)
    is_new = np.zeros(len(error), bool) if threshold is None else error > threshold
    size = float(np.clip(80.0 / math.sqrt(max(1, len(time))), 2.5, 6.0))
    dots: dict[str, Any] = {"ls": "none", "marker": ".", "ms": size, "mew": 0}
    axes.plot(time[~is_new], error[~is_new], color=MAP, label="known view", **dots)
    if threshold is not None:
        axes.plot(time[is_new], error[is_new], color=LOOP, label="new view", **dots)
        axes.axhline(threshold, color=INK, lw=0.9, ls="--", label=f"threshold {threshold:g}")
    axes.set(ylabel="match error\n(grey levels, 0 to 1)")
    axes.set_ylim(bottom=0.0)
    write_title(axes, "View matches")
    _legend_above(axes, markerscale=8.0 / size)


def _legend_above(axes: Axes, markerscale: float = 1.0) -> None:
    axes.margins(x=0.01)
    style: dict[str, Any] = {"columnspacing": 0.9, "handletextpad": 0.4, "fontsize": 8}
    style["handlelength"] = 1.1
    axes.legend(
        loc="lower right", bbox_to_anchor=(1.01, 0.98), ncols=3, markerscale=markerscale, **style
    )


def _metric(axes: Axes) -> None:
    axes.set(xlabel="x (m)", ylabel="y (m)")
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.06)
    seen = axes.dataLim.get_points() if axes.has_data() else np.zeros((2, 2))
    seen = np.where(np.isfinite(seen), seen, 0.0)
    if np.ptp(seen, axis=0).max() < 0.1:  # a single point has no extent
        axes.update_datalim(seen.mean(axis=0) + np.array([[-0.05, -0.05], [0.05, 0.05]]))
        axes.autoscale_view()
    labels = axes.get_legend_handles_labels()[1]
    many = 4 if len(labels) < 5 else 3
    legend_below(axes, columns=1 if max(map(len, labels), default=0) > 36 else many)


def _metres(distance: float) -> str:
    return f"{100.0 * distance:.1f} cm" if distance < 1.0 else f"{distance:.2f} m"
