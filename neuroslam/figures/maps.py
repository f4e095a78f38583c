"""Whole figures of maps, cells, views and signals: arrays in, a matplotlib ``Figure`` out.

:mod:`neuroslam.figures.style` defines the colours and their meaning. pyplot is not used.
"""

import math
from collections.abc import Mapping, Sequence

import matplotlib as mpl
import numpy as np
import torch
from matplotlib.figure import Figure

from neuroslam.errors import counted
from neuroslam.figures.parts import (
    draw_frame,
    draw_map,
    draw_odometry,
    draw_pose_cells,
    draw_signals,
    draw_template,
)
from neuroslam.figures.style import (
    ACTIVITY,
    CURVES,
    STYLE,
    as_rgb,
    legend_below,
    new_figure,
    write_title,
)
from neuroslam.types import Pose, PoseEstimate
from neuroslam.view import vision


def plot_map(
    poses: np.ndarray,
    links: np.ndarray,
    *,
    odometry_xy: np.ndarray | None = None,
    track_xy: np.ndarray | None = None,
    truth_xy: np.ndarray | None = None,
    walls: np.ndarray | None = None,
    current: Pose | None = None,
    landmarks: np.ndarray | None = None,
    session: np.ndarray | None = None,
    session_names: Sequence[str] = (),
    odometry_of: str = "",
    planned: np.ndarray | None = None,
    title: str | None = None,
    unit: str = "m",
) -> Figure:
    """Draw the experience map, beside dead reckoning by its odometry.

    A link is a loop closure when it joins experiences that both existed before it. The map is in
    its own coordinates. ``truth_xy`` and the walls are drawn after a similarity alignment to the
    track; the legend gives the absolute trajectory error (RMSE after that alignment, in metres of
    the truth).

    Args:
        poses: Experiences ``(n, 3)``: x, y in metres, heading in radians.
        links: Source and target of each link, ``(m, 2)``.
        odometry_xy: Dead-reckoned track ``(k, 2)``; gets a panel of its own.
        track_xy: Position of the robot on the map in each frame, ``(t, 2)``.
        truth_xy: True position in each frame, ``(t, 2)``; without ``track_xy``: of each experience.
        walls: Ends of wall segments in the frame of the truth, ``(w, 2, 2)``.
        current: Pose of the robot now, on the map: an arrow, in place of the mark of the end.
        landmarks: Positions of landmarks on the map, ``(l, 2)``: stars.
        session: Number of the session that made each experience, ``(n,)``, from 0: its colour.
        session_names: Names of the sessions, for the legend; colours repeat after six.
        odometry_of: Name of the session of the odometry, for the legend.
        planned: Positions of a planned path, ``(p, 2)``; its start and goal are marked then, and
            not the first and last experience.
        title: Title of the whole figure.
        unit: Unit of the axes: a map by one camera alone has an arbitrary one.

    Raises:
        ValueError: If the truth and the track differ in length.
    """
    with mpl.rc_context(STYLE):
        tall = 5.6 + 0.19 * len(session_names)  # a line of the legend for each
        figure = new_figure(11.0 if odometry_xy is not None else 6.2, tall, title)
        axes = figure.subplots(1, 2 if odometry_xy is not None else 1, squeeze=False)[0]
        if odometry_xy is not None:
            draw_odometry(axes[0], np.asarray(odometry_xy), odometry_of, unit)
        draw_map(
            axes[-1], poses, links, track_xy, truth_xy, walls, current, landmarks, session,
            session_names, planned,
        )  # fmt: skip
        for panel in axes:
            panel.set(xlabel=f"x ({unit})", ylabel=f"y ({unit})")
    return figure


def plot_pose_cells(
    activity: np.ndarray,
    estimate: PoseEstimate | None = None,
    injection: PoseEstimate | None = None,
) -> Figure:
    """Draw the activity packet, summed over heading and summed over y.

    Args:
        activity: Activity of the pose cells, ``(n_theta, n_y, n_x)``.
        estimate: Decoded centre of the packet, in cells: a cross.
        injection: Centre of the injection by the current view, in cells: a ring.
    """
    with mpl.rc_context(STYLE):
        figure = new_figure(9.0, 4.3, "Activity of the pose cells")
        axes = figure.subplots(1, 2)
        draw_pose_cells(figure, axes, np.asarray(activity), estimate, injection)
    return figure


def plot_activity(layers: np.ndarray | tuple[np.ndarray, ...], title: str) -> Figure:
    """Draw the activity of a population: layers of cells side by side, or a picture.

    Args:
        layers: Activity ``(h, w)`` in any unit, or several of them; or ``uint8``, ``(h, w, 3)``.
        title: Name of the population.
    """
    layers = layers if isinstance(layers, tuple) else (layers,)
    with mpl.rc_context(STYLE):
        figure = new_figure(4.6 * len(layers) + 0.4, 4.2, title)
        for ax, layer in zip(
            figure.subplots(1, len(layers), squeeze=False)[0], layers, strict=True
        ):
            shown = ax.imshow(layer, ACTIVITY, origin="lower", aspect="auto")
            ax.set(xlabel="cell", ylabel="cell")
            ax.grid(visible=False)
            if layer.ndim == 2:
                figure.colorbar(shown, ax=ax, label="activity (arbitrary unit)")
    return figure


def plot_frame_and_template(
    image: np.ndarray, template: np.ndarray, error: float, template_id: int
) -> Figure:
    """Draw a frame above the template that it matched.

    Args:
        image: ``uint8``, ``(h, w)`` grey or ``(h, w, 3)`` RGB.
        template: Grey, ``(h, w)``, ``uint8`` or in [0, 1].
        error: Match error, a mean absolute difference; negative without a match.
        template_id: Id of the template.
    """
    with mpl.rc_context(STYLE):
        ratios = [image.shape[0] / image.shape[1], template.shape[0] / template.shape[1]]
        figure = new_figure(4.6, 4.6 * sum(ratios) + 0.7, None)
        axes = figure.subplots(2, 1, height_ratios=ratios)
        draw_frame(axes[0], image)
        draw_template(axes[1], template, error, template_id)
    return figure


def plot_signals(frames: Mapping[str, np.ndarray], threshold: float | None = None) -> Figure:
    """Draw the match errors of views, where there are any, and the size of the map over time.

    Args:
        frames: The columns ``time_s``, ``match_error``, ``n_templates``, ``n_experiences`` and
            ``n_links`` of ``frames.csv``.
        threshold: Largest match error of a known view.
    """
    with mpl.rc_context(STYLE):
        figure = new_figure(8.0, 4.8 if np.any(frames["n_templates"]) else 2.7, None)
        draw_signals(figure, frames, threshold)
    return figure


def plot_precision_recall(curves: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> Figure:
    """Draw precision over recall, a curve for each method.

    Args:
        curves: Name -> (precision, recall), arrays of equal length, by threshold.
    """
    with mpl.rc_context(STYLE):
        figure = new_figure(5.6, 5.2, None)
        axes = figure.subplots()
        for number, (name, (precision, recall)) in enumerate(curves.items()):
            colour, dash = CURVES[number % len(CURVES)], ("-", "--", ":")[number // len(CURVES) % 3]
            axes.plot(recall, precision, dash, color=colour, lw=1.8, label=name, clip_on=False)
        axes.set(xlim=(0, 1), ylim=(0, 1), xlabel="recall", ylabel="precision", aspect="equal")
        write_title(axes, "Place recognition", counted(len(curves), "method"))
        longest = max(map(len, curves), default=1)
        legend_below(axes, columns=max(1, min(3, len(curves), 66 // longest)))
    return figure


def contact_sheet(images: Sequence[np.ndarray], titles: Sequence[str]) -> Figure:
    """Draw pictures of equal size in rows, each below its title.

    Args:
        images: ``uint8``, all ``(h, w)`` grey or all ``(h, w, 3)`` RGB.
        titles: A title for each picture.

    Raises:
        ValueError: If there are no pictures, their sizes differ, or the titles do not match them.
    """
    shapes = {np.shape(image) for image in images}
    if len(shapes) != 1 or len(images) != len(titles):
        raise ValueError(
            f"contact_sheet: got {len(images)} images of shapes {sorted(shapes)} and "
            f"{len(titles)} titles; expected one shape, and a title for each"
        )
    stack = np.stack([as_rgb(image) for image in images])
    n, height, width, _ = stack.shape
    columns = min(n, max(1, round(math.sqrt(n * 1.4 * (1.25 * height) / width))))
    rows = -(-n // columns)
    pad = max(2, round(0.22 * max(height, 0.35 * width)))  # room for a title above each picture
    tensor = torch.from_numpy(stack).permute(0, 3, 1, 2)
    sheet = vision.make_grid(tensor, nrow=columns, padding=pad, pad_value=255)
    sheet = sheet[:, : rows * (height + pad) + 2, pad - 2 : columns * (width + pad) + 2]
    with mpl.rc_context(STYLE):
        scale = 10.0 / (columns * (width + pad))
        figure = new_figure(10.0, max(1.0, scale * rows * (height + pad) + 0.1), None)
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
    """Draw a run on one sheet: odometry and map above; cells, last view and counts below.

    The arguments are those of :func:`plot_map`, :func:`plot_pose_cells`,
    :func:`plot_frame_and_template` and :func:`plot_signals`; panels without data are left out.
    With an image, ``frames`` needs the column ``template`` too.
    """
    with mpl.rc_context(STYLE):
        figure = new_figure(14.0, 10.0, title)
        top, bottom = figure.subfigures(2, 1, height_ratios=[1.55, 1.0], squeeze=False).ravel()
        axes = top.subplots(1, 2 if odometry_xy is not None else 1, squeeze=False)[0]
        if odometry_xy is not None:
            draw_odometry(axes[0], np.asarray(odometry_xy))
        draw_map(axes[-1], poses, links, track_xy, truth_xy, walls, current)
        widths = [1.75 * (activity is not None), 0.8 * (image is not None), 1.55]
        widths = [width for width in widths if width]
        parts = list(bottom.subfigures(1, len(widths), width_ratios=widths, squeeze=False)[0])
        if activity is not None:
            part = parts.pop(0)
            draw_pose_cells(part, part.subplots(1, 2), np.asarray(activity), estimate, None)
        if image is not None:
            axes = parts.pop(0).subplots(1 if template is None else 2, 1, squeeze=False)[:, 0]
            draw_frame(axes[0], image)
            if template is not None:
                error, name = float(frames["match_error"][-1]), int(frames["template"][-1])
                draw_template(axes[1], template, error, name)
        draw_signals(parts.pop(0), frames, threshold)
    return figure
