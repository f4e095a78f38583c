"""Figures of maps, cells, views and curves: plain arrays in, a matplotlib ``Figure`` out.

One visual language: grey is odometry, blue the map, vermilion a loop closure, black dashes the
truth; a circle is the start, a square the end, an arrow the robot now. The colours are those of
M. Okabe and K. Ito's palette, which colour-blind readers can tell apart. pyplot is never touched.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib as mpl
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure, SubFigure
from matplotlib.markers import MarkerStyle
from matplotlib.path import Path as Outline
from matplotlib.ticker import MaxNLocator, StrMethodFormatter
from matplotlib.transforms import ScaledTranslation

from neuroslam import vision
from neuroslam.errors import MapError
from neuroslam.evaluation.trajectory import absolute_trajectory_error, align, path_length
from neuroslam.mapping.experience import closes_loop
from neuroslam.storage import write_atomically
from neuroslam.types import Pose, PoseEstimate

ODOMETRY, MAP, LOOP, TRUTH = "#8c8c8c", "#0072B2", "#D55E00", "#000000"
ROBOT, OTHER, INK, WALL = "#E69F00", "#009E73", "#222222", "#c9c9c9"
CURVES = (MAP, LOOP, OTHER, "#CC79A7", "#E69F00", "#56B4E9")
ACTIVITY = "viridis"

_STYLE = {
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.edgecolor": "#777777",
    "axes.linewidth": 0.8,
    "axes.labelcolor": INK,
    "text.color": INK,
    "xtick.color": "#555555",
    "ytick.color": "#555555",
    "grid.color": "#ececec",
    "grid.linewidth": 0.8,
    "axes.grid": True,
    "axes.axisbelow": True,
    "legend.frameon": False,
    "legend.handlelength": 1.6,
    "lines.solid_capstyle": "round",
    "image.interpolation": "nearest",
}
_DART = Outline([(1.0, 0.0), (-0.8, 0.65), (-0.4, 0.0), (-0.8, -0.65), (1.0, 0.0)])


def save(figure: Figure, path: Path, dpi: int = 150) -> None:
    """Write a figure as PNG, whole or not at all; equal figures give equal bytes."""
    with mpl.rc_context(_STYLE):
        write_atomically(
            Path(path),
            lambda file: figure.savefig(
                file, format="png", dpi=dpi, metadata={"Software": "neuroslam"}
            ),
        )


def render(figure: Figure, dpi: int = 100) -> np.ndarray:
    """Draw a figure into pixels: ``uint8``, ``(h, w, 3)``."""
    figure.set_dpi(dpi)
    with mpl.rc_context(_STYLE):
        figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())[..., :3].copy()


def plot_map(
    poses: np.ndarray,
    links: np.ndarray,
    *,
    odometry_xy: np.ndarray | None = None,
    track_xy: np.ndarray | None = None,
    truth_xy: np.ndarray | None = None,
    walls: np.ndarray | None = None,
    current: Pose | None = None,
    title: str | None = None,
) -> Figure:
    """Draw the experience map, beside the odometry it was made from.

    A link is a loop closure when it joins experiences that were both known before.
    With ``truth_xy`` the map is drawn where a similarity alignment to the truth puts it, and the
    legend gives the absolute trajectory error (RMSE).

    Args:
        poses: Experiences ``(n, 3)``: x, y in metres, heading in radians.
        links: Source and target of each link, ``(m, 2)``.
        odometry_xy: Dead-reckoned track ``(k, 2)``; gets a panel of its own.
        track_xy: Where the map puts the robot in each frame, ``(t, 2)``.
        truth_xy: Where it was in each frame, ``(t, 2)``; without ``track_xy``: at each experience.
        walls: Ends of wall segments in the frame of the truth, ``(w, 2, 2)``.
        current: Pose of the robot now, on the map: an arrow, which stands for the end.
        title: Heading of the whole figure.

    Raises:
        ValueError: If the truth has another length than the track.
    """
    with mpl.rc_context(_STYLE):
        figure = _figure(11.0 if odometry_xy is not None else 6.2, 5.6, title)
        axes = figure.subplots(1, 2 if odometry_xy is not None else 1, squeeze=False)[0]
        if odometry_xy is not None:
            _draw_odometry(axes[0], np.asarray(odometry_xy))
        _draw_map(axes[-1], poses, links, track_xy, truth_xy, walls, current)
    return figure


def plot_pose_cells(
    activity: np.ndarray,
    estimate: PoseEstimate | None = None,
    injection: PoseEstimate | None = None,
) -> Figure:
    """Draw the activity packet from above (summed over heading) and from the side (over y).

    Args:
        activity: ``(n_theta, n_y, n_x)``.
        estimate: Decoded centre of the packet, in cells: a cross.
        injection: Where the current view injects, in cells: a ring.
    """
    with mpl.rc_context(_STYLE):
        figure = _figure(9.0, 4.3, "Activity of the pose cells")
        axes = figure.subplots(1, 2)
        _draw_pose_cells(figure, axes, np.asarray(activity), estimate, injection)
    return figure


def plot_frame_and_template(
    image: np.ndarray, template: np.ndarray, error: float, template_id: int
) -> Figure:
    """Draw a frame above the stored view it was matched with.

    Args:
        image: ``uint8``, ``(h, w)`` grey or ``(h, w, 3)`` RGB.
        template: Grey, ``(h, w)``, ``uint8`` or in [0, 1].
        error: Mean absolute difference of the match; negative where there was none.
        template_id: Id of the template.
    """
    with mpl.rc_context(_STYLE):
        ratios = [image.shape[0] / image.shape[1], template.shape[0] / template.shape[1]]
        figure = _figure(4.6, 4.6 * sum(ratios) + 0.7, None)
        axes = figure.subplots(2, 1, height_ratios=ratios)
        _draw_frame(axes[0], image)
        _draw_template(axes[1], template, error, template_id)
    return figure


def plot_signals(frames: Mapping[str, np.ndarray], threshold: float | None = None) -> Figure:
    """Draw how well frames were recognised, and how the map grew, over time.

    Args:
        frames: The columns ``time_s``, ``match_error``, ``n_templates``, ``n_experiences`` and
            ``n_links`` of ``frames.csv``.
        threshold: Largest match error that counts as known.
    """
    with mpl.rc_context(_STYLE):
        figure = _figure(8.0, 4.8, None)
        _draw_signals(figure.subplots(2, 1, sharex=True), frames, threshold)
    return figure


def plot_precision_recall(curves: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> Figure:
    """Draw precision over recall, a curve for each method.

    Args:
        curves: Name -> (precision, recall), arrays of equal length, by threshold.
    """
    with mpl.rc_context(_STYLE):
        figure = _figure(5.6, 5.2, None)
        axes = figure.subplots()
        for number, (name, (precision, recall)) in enumerate(curves.items()):
            colour, dash = CURVES[number % len(CURVES)], ("-", "--", ":")[number // len(CURVES) % 3]
            axes.plot(recall, precision, dash, color=colour, lw=1.8, label=name, clip_on=False)
        axes.set(xlim=(0, 1), ylim=(0, 1), xlabel="recall", ylabel="precision", aspect="equal")
        _title(axes, "Recognised places", _count(len(curves), "method"))
        _legend_below(axes, columns=min(3, max(1, len(curves))))
    return figure


def contact_sheet(images: Sequence[np.ndarray], titles: Sequence[str]) -> Figure:
    """Draw equally sized pictures in rows, each under its title.

    Args:
        images: ``uint8``, all ``(h, w)`` grey or all ``(h, w, 3)`` RGB, of one size.
        titles: One for each picture.

    Raises:
        ValueError: If there are no pictures, or sizes or numbers differ.
    """
    shapes = {np.shape(image) for image in images}
    if len(shapes) != 1 or len(images) != len(titles):
        raise ValueError(
            f"contact_sheet: got {len(images)} images of shapes {sorted(shapes)} and "
            f"{len(titles)} titles; expected one shape, and a title for each"
        )
    stack = np.stack([_rgb(image) for image in images])
    n, height, width, _ = stack.shape
    columns = min(n, max(1, round(math.sqrt(n * 1.4 * (1.25 * height) / width))))
    rows = -(-n // columns)
    pad = max(2, round(0.22 * max(height, 0.35 * width)))  # room for a title above each picture
    tensor = torch.from_numpy(stack).permute(0, 3, 1, 2)
    sheet = vision.make_grid(tensor, nrow=columns, padding=pad, pad_value=255)
    sheet = sheet[:, : rows * (height + pad) + 2, pad - 2 : columns * (width + pad) + 2]
    with mpl.rc_context(_STYLE):
        scale = 10.0 / (columns * (width + pad))
        figure = _figure(10.0, max(1.0, scale * rows * (height + pad) + 0.1), None)
        axes = figure.subplots()
        axes.imshow(sheet.permute(1, 2, 0).numpy(), interpolation="nearest")
        axes.set_axis_off()
        for number, text in enumerate(titles):
            row, column = divmod(number, columns)
            x, y = 1.5 + column * (width + pad), pad - 0.5 + row * (height + pad)
            axes.text(x, y - 0.1 * pad, text, fontsize=8, va="bottom")
    return figure


def plot_summary(
    poses: np.ndarray,
    links: np.ndarray,
    frames: Mapping[str, np.ndarray],
    *,
    activity: np.ndarray | None = None,
    estimate: PoseEstimate | None = None,
    image: np.ndarray | None = None,
    template: np.ndarray | None = None,
    threshold: float | None = None,
    odometry_xy: np.ndarray | None = None,
    track_xy: np.ndarray | None = None,
    truth_xy: np.ndarray | None = None,
    walls: np.ndarray | None = None,
    current: Pose | None = None,
    title: str | None = None,
) -> Figure:
    """Draw a whole run on one sheet: odometry and map above; cells, last view and counts below.

    Everything means what it means in :func:`plot_map`, :func:`plot_pose_cells`,
    :func:`plot_frame_and_template` and :func:`plot_signals`; what is not given is left out.
    ``frames`` needs the column ``template`` too, where there is an image.
    """
    with mpl.rc_context(_STYLE):
        figure = _figure(14.0, 10.0, title)
        top, bottom = figure.subfigures(2, 1, height_ratios=[1.55, 1.0])
        axes = top.subplots(1, 2 if odometry_xy is not None else 1, squeeze=False)[0]
        if odometry_xy is not None:
            _draw_odometry(axes[0], np.asarray(odometry_xy))
        _draw_map(axes[-1], poses, links, track_xy, truth_xy, walls, current)
        widths = [1.75 * (activity is not None), 0.8 * (image is not None), 1.55]
        parts = bottom.subfigures(
            1, sum(w > 0 for w in widths), width_ratios=[w for w in widths if w]
        )
        parts = list(np.atleast_1d(parts))
        if activity is not None:
            part = parts.pop(0)
            _draw_pose_cells(part, part.subplots(1, 2), np.asarray(activity), estimate, None)
        if image is not None:
            axes = parts.pop(0).subplots(1 if template is None else 2, 1, squeeze=False)[:, 0]
            _draw_frame(axes[0], image)
            if template is not None:
                error, name = float(frames["match_error"][-1]), int(frames["template"][-1])
                _draw_template(axes[1], template, error, name)
        _draw_signals(parts.pop(0).subplots(2, 1, sharex=True), frames, threshold)
    return figure


class _Placed(NamedTuple):
    # The map, where the truth says it lies.
    poses: np.ndarray
    truth: np.ndarray | None
    current: Pose | None
    label: str


def _place(
    poses: np.ndarray,
    track: np.ndarray | None,
    truth: np.ndarray | None,
    current: Pose | None,
) -> _Placed:
    if truth is None or not len(truth):
        return _Placed(poses, None, current, "")
    track = poses[:, :2] if track is None else np.asarray(track)
    truth = np.asarray(truth)
    if len(track) != len(truth):
        raise ValueError(
            f"plot_map: truth_xy has {len(truth)} points and the track {len(track)}; "
            "give track_xy with a point for each of the truth"
        )
    try:
        motion, mode = align(track, truth, "similarity"), "similarity"
    except MapError:  # a robot that stood still: nothing to align, but there is still an error
        motion, mode = align(track, truth, "none"), "none"
    turn = math.atan2(motion.rotation[1, 0], motion.rotation[0, 0])
    ate = absolute_trajectory_error(track, truth, mode).rmse
    how = f"scale {motion.scale:.3g}" if mode == "similarity" else "not aligned"
    moved = np.column_stack([motion.apply(poses[:, :2]), poses[:, 2] + turn])
    if current is not None:
        x, y = motion.apply(np.array([current[:2]]))[0]
        current = Pose(float(x), float(y), current.theta_rad + turn)
    return _Placed(moved, truth, current, f"truth: ATE {_metres(ate)}, {how}")


def _draw_odometry(axes: Axes, xy: np.ndarray) -> None:
    axes.plot(*xy.T, color=ODOMETRY, lw=1.1, label="odometry")
    _draw_ends(axes, xy)
    _title(axes, "Odometry alone", f"{_count(len(xy), 'frame')} · {path_length(xy):,.1f} m")
    _metric(axes)


def _draw_map(
    axes: Axes,
    poses: np.ndarray,
    links: np.ndarray,
    track: np.ndarray | None,
    truth: np.ndarray | None,
    walls: np.ndarray | None,
    current: Pose | None,
) -> None:
    poses, links = np.asarray(poses).reshape(-1, 3), np.asarray(links, np.int64).reshape(-1, 2)
    poses, truth, current, truth_label = _place(poses, track, truth, current)
    xy = poses[:, :2]
    if walls is not None:
        segments = np.asarray(walls).reshape(-1, 2, 2)
        axes.add_collection(LineCollection(segments, colors=WALL, lw=2.5, zorder=1, label="walls"))
    is_loop = closes_loop(links[:, 0], links[:, 1])
    axes.add_collection(
        LineCollection(xy[links[~is_loop]], colors=MAP, lw=0.9, alpha=0.8, zorder=2)
    )
    dot = float(np.clip(50.0 / math.sqrt(max(1, len(xy))), 2.0, 4.5))
    axes.plot(*xy.T, ls="none", marker="o", ms=dot, mew=0, color=MAP, zorder=3)
    axes.plot([], [], "-o", color=MAP, lw=0.9, ms=4, label="experiences, links")
    if is_loop.any():
        axes.add_collection(
            LineCollection(xy[links[is_loop]], colors=LOOP, lw=1.3, zorder=4, label="loop closure")
        )
    if truth is not None:
        axes.plot(*truth.T, "--", color=TRUTH, lw=0.9, zorder=5, label=truth_label)
    _draw_ends(axes, xy, end=current is None)
    if current is not None:
        marker = MarkerStyle(_DART).rotated(rad=current.theta_rad)
        style = {"ls": "none", "marker": marker, "ms": 13, "mfc": ROBOT, "mec": INK, "mew": 0.8}
        axes.plot(*current[:2], zorder=8, label="robot now", **style)
    axes.autoscale_view()
    counts = ((len(xy), "experience"), (len(links), "link"), (int(is_loop.sum()), "loop closure"))
    _title(axes, "Experience map", " · ".join(_count(*count) for count in counts))
    _metric(axes)


def _draw_ends(axes: Axes, xy: np.ndarray, end: bool = True) -> None:
    style = {"ls": "none", "mec": INK, "mew": 1.4, "zorder": 7}
    if len(xy):
        axes.plot(*xy[0], marker="o", ms=8, mfc="white", label="start", **style)
    if len(xy) and end:
        axes.plot(*xy[-1], marker="s", ms=6.5, mfc=INK, label="end", **style)


def _draw_pose_cells(
    figure: Figure | SubFigure,
    axes: Sequence[Axes],
    activity: np.ndarray,
    estimate: PoseEstimate | None,
    injection: PoseEstimate | None,
) -> None:
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
    _title(axes[0], "Place", "summed over θ")
    _title(axes[1], "Heading", "summed over y")
    axes[1].set_yticks(range(0, 360, 90))
    marks = ((injection, "o", "view injects here", 15), (estimate, "x", "estimate", 9))
    for mark, marker, label, size in marks:
        if mark is not None:
            style = {"ls": "none", "marker": marker, "ms": size, "mew": 2.2, "mfc": "none"}
            axes[0].plot(mark.x, mark.y, mec=LOOP, label=label, **style)
            axes[1].plot(mark.x, mark.theta * step, mec=LOOP, **style)
    if axes[0].get_legend_handles_labels()[0]:
        _legend_below(axes[0], columns=2)
    bar = figure.colorbar(picture, cax=axes[1].inset_axes([1.04, 0.0, 0.045, 1.0]))
    bar.set_label("share of all activity")
    bar.outline.set_visible(False)


def _draw_frame(axes: Axes, image: np.ndarray) -> None:
    axes.imshow(_rgb(image))
    _title(axes, "Frame", f"{image.shape[1]} by {image.shape[0]} px")
    axes.set_axis_off()


def _draw_template(axes: Axes, template: np.ndarray, error: float, template_id: int) -> None:
    top = 255 if template.dtype == np.uint8 else 1.0
    axes.imshow(template, "gray", vmin=0, vmax=top, interpolation="nearest")
    said = f"match error {error:.3f}" if error >= 0 else "the first view"
    _title(axes, f"Template {template_id}", said)
    axes.set_axis_off()


def _draw_signals(
    axes: Sequence[Axes], frames: Mapping[str, np.ndarray], threshold: float | None
) -> None:
    time = np.asarray(frames["time_s"], np.float64)
    error = np.asarray(frames["match_error"], np.float64)
    error = np.where(error < 0, np.nan, error)
    is_new = np.zeros(len(error), bool) if threshold is None else error > threshold
    size = float(np.clip(80.0 / math.sqrt(max(1, len(time))), 2.5, 6.0))
    dots = {"ls": "none", "marker": ".", "ms": size, "mew": 0}
    axes[0].plot(time[~is_new], error[~is_new], color=MAP, label="known view", **dots)
    if threshold is not None:
        axes[0].plot(time[is_new], error[is_new], color=LOOP, label="new view", **dots)
        axes[0].axhline(threshold, color=INK, lw=0.9, ls="--", label=f"threshold {threshold:g}")
    axes[0].set(ylabel="match error")
    axes[0].set_ylim(bottom=0.0)
    _title(axes[0], "Recognition")
    for name, colour in (("n_links", LOOP), ("n_experiences", MAP), ("n_templates", OTHER)):
        counts = np.asarray(frames[name])
        last = int(counts[-1]) if len(counts) else 0
        axes[1].plot(time, counts, color=colour, lw=1.6, label=f"{last:,} {name[2:]}")
    axes[1].set(xlabel="time (s)", ylabel="count")
    axes[1].yaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    axes[1].set_ylim(bottom=0)
    _title(axes[1], "Memory")
    for ax in axes:
        ax.margins(x=0.01)
        style = {"columnspacing": 0.9, "handletextpad": 0.4, "handlelength": 1.1, "fontsize": 8}
        ax.legend(
            loc="lower right", bbox_to_anchor=(1.01, 0.98), ncols=3, markerscale=8.0 / size, **style
        )


def _figure(width_in: float, height_in: float, title: str | None) -> Figure:
    figure = Figure(figsize=(width_in, height_in), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    if title:
        figure.suptitle(title, fontsize=12, fontweight="bold")
    return figure


def _metric(axes: Axes) -> None:
    axes.set(xlabel="x (m)", ylabel="y (m)")
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.06)
    _legend_below(axes, columns=4 if len(axes.get_legend_handles_labels()[0]) < 5 else 3)


def _title(axes: Axes, name: str, counts: str = "") -> None:
    axes.set_title(name)
    axes.set_title(counts, loc="right", fontsize=8, fontweight="normal")


def _legend_below(axes: Axes, columns: int) -> None:
    under = axes.transAxes + ScaledTranslation(0, -0.42, axes.figure.dpi_scale_trans)  # inches
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, 0.0), bbox_transform=under, ncols=columns)


def _rgb(image: np.ndarray) -> np.ndarray:
    image = np.asarray(image)
    return np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image


def _count(n: int, noun: str) -> str:
    return f"{n:,} {noun}{'' if n == 1 else 's'}"


def _metres(distance: float) -> str:
    return f"{100.0 * distance:.1f} cm" if distance < 1.0 else f"{distance:.2f} m"
