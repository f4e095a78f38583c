"""Figures of mapping in several sessions: maps before and after a merge, and their accuracy.

A colour is a session, a cross its start, a diamond its end, a red ring the match that joins two
maps. Plain arrays in, a matplotlib ``Figure`` out; :func:`neuroslam.figures.style.save` writes it.
"""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Line3DCollection

from neuroslam.errors import counted
from neuroslam.evaluation.trajectory import path_length
from neuroslam.figures.session_panels import (
    check_sessions,
    dot_size,
    draw_ends,
    draw_mark,
    finish,
    make_panels,
    mark_handle,
    metres,
    need_parts,
    session_handles,
    set_window,
    window_size,
    write_titles,
)
from neuroslam.figures.style import ROBOT, SESSIONS, STYLE, TRUTH

MATCH, REFERENCE, SHADOW = "#DD1122", "#7B3FA0", "#c2c2c2"
_NO_POINTS = np.zeros((0, 2))
_RING: dict[str, Any] = {
    "ls": "none",
    "marker": "o",
    "ms": 12,
    "mfc": "none",
    "mec": MATCH,
    "mew": 2.0,
}
_SMALL_RING: dict[str, Any] = {**_RING, "ms": 9}


class Stage(NamedTuple):
    """A map at one moment of a run in several sessions.

    Attributes:
        title: Description of the moment.
        poses: Experiences ``(n, 3)``: x, y in metres, heading in radians.
        links: Source and target of each link, ``(m, 2)``.
        session: Number of the session that made each experience, ``(n,)``, from 0.
        merge_points: Positions where two maps match, ``(k, 2)``, in metres: red rings.
        starts: Experiences where a session began: crosses.
        ends: Experiences where a session ended: diamonds.
        others: Maps not linked to this one yet, each in its own coordinates.
    """

    title: str
    poses: np.ndarray
    links: np.ndarray
    session: np.ndarray
    merge_points: np.ndarray = _NO_POINTS
    starts: Sequence[int] = ()
    ends: Sequence[int] = ()
    others: tuple["Stage", ...] = ()


class Bindings(NamedTuple):
    """The bindings of a map's experiences to the torus of the pose cells.

    Attributes:
        title: Description of the map.
        cells: x, y, theta of each binding, in cells, ``(n, 3)``, in the order of creation.
        session: Number of the session that made each, ``(n,)``, from 0.
        matched: Bindings of the matched experiences of two maps, ``(k, 3)``, in cells: red.
    """

    title: str
    cells: np.ndarray
    session: np.ndarray
    matched: np.ndarray = np.zeros((0, 3))


def plot_stages(
    stages: Sequence[Stage], title: str | None = None, names: Sequence[str] = ()
) -> Figure:
    """Draw the merging of maps of several sessions, a panel for each stage.

    All panels have the same scale, except where unlinked maps need more room. An unlinked map has
    its own coordinates; where it would overlap the first map it is drawn beside it, and the panel
    states the displacement.

    Args:
        stages: Stages in order of time; three in a row.
        title: Title of the whole figure.
        names: Names of all sessions, for the legend; without, the sessions drawn are numbered.

    Raises:
        ValueError: If there is no stage, or session numbers do not match the experiences.
    """
    need_parts(stages, "plot_stages", "stage")
    for part in (part for stage in stages for part in (stage, *stage.others)):
        check_sessions("plot_stages", part.title, len(_poses(part)), part.session)
    shifts = [_shifts(stage) for stage in stages]
    boxes = [
        _box([_extent(s), *(_extent(o) + move for o, move in zip(s.others, moves, strict=True))])
        for s, moves in zip(stages, shifts, strict=True)
    ]
    whole = [box for box, stage in zip(boxes, stages, strict=True) if not stage.others] or boxes
    window = window_size(np.max([np.ptp(box, axis=0) for box in whole], axis=0))
    with mpl.rc_context(STYLE):
        figure, panels = make_panels(len(stages), 3, title, window)
        for axes, stage, moves, box in zip(panels, stages, shifts, boxes, strict=True):
            for part, move in zip((stage, *stage.others), ([0.0, 0.0], *moves), strict=True):
                _draw_stage(axes, part, np.asarray(move))
            write_titles(axes, stage.title, _counts(stage), *_moved(stage, moves))
            set_window(axes, box, window)
        parts = [part for stage in stages for part in (stage, *stage.others)]
        key = session_handles((part.session for part in parts), names)
        marks = [any(len(p.starts) for p in parts), any(len(p.ends) for p in parts)]
        key += [mark_handle(kind) for kind, seen in zip("XD", marks, strict=True) if seen]
        if any(len(part.merge_points) for part in parts):
            key.append(Line2D([], [], label="merge point", **_SMALL_RING))
        return finish(figure, key, window)


def plot_bindings(
    groups: Sequence[Bindings], torus: tuple[int, int, int], title: str | None = None
) -> Figure:
    """Draw the bindings of experiences to the torus of the pose cells, a panel for each group.

    Successive bindings are joined by a line if they are near (an eighth of the torus), never across
    the edge where the torus closes. Grey dots on the floor are their x and y.

    Args:
        groups: Bindings, such as before and after the shift onto the matched packet.
        torus: Number of cells in x, y and theta.
        title: Title of the whole figure.

    Raises:
        ValueError: If there is no group, or session numbers do not match the bindings.
    """
    need_parts(groups, "plot_bindings", "group")
    size = np.asarray(torus, np.float64)
    with mpl.rc_context(STYLE):
        columns = 2 if len(groups) in (2, 4) else 3
        window = np.array([1.0, 0.87])
        figure, panels = make_panels(
            len(groups), columns, title, window, width=4.4, projection="3d"
        )
        right = 1.0 - 0.45 / figure.get_figwidth()  # the layout leaves no room for the label of θ
        engine = figure.get_layout_engine()
        if isinstance(engine, ConstrainedLayoutEngine):
            engine.set(rect=(0.0, 0.0, right, 1.0))
        for axes, group in zip(panels, groups, strict=True):
            assert isinstance(axes, Axes3D)  # by the projection
            cells = np.asarray(group.cells, np.float64).reshape(-1, 3)
            session = check_sessions("plot_bindings", group.title, len(cells), group.session)
            _draw_bindings(axes, cells, session, np.asarray(group.matched).reshape(-1, 3), size)
            write_titles(axes, group.title, counted(len(cells), "binding"))
        key = session_handles(group.session for group in groups)
        key += [mark_handle("X"), mark_handle("D")]
        if any(len(group.matched) for group in groups):
            key.append(Line2D([], [], label="match", **_SMALL_RING))
        shadow: dict[str, Any] = {"ls": "none", "marker": "o", "ms": 3, "color": SHADOW}
        key.append(Line2D([], [], label="x and y, drawn at θ = 0", **shadow))
        return finish(figure, key, window)


def plot_overlay(
    reference_xy: np.ndarray,
    aligned_xy: np.ndarray,
    rmse_m: float,
    fraction: float,
    title: str | None = None,
    reference_links: np.ndarray | None = None,
    aligned_links: np.ndarray | None = None,
    names: tuple[str, str] = ("single session", "merged map, aligned"),
) -> Figure:
    """Draw a map, aligned, over another: a merged map over that of a single session.

    Args:
        reference_xy: Experiences of the single session ``(n, 2)``, in metres: purple.
        aligned_xy: Experiences of the merged map ``(k, 2)``, moved onto the reference: orange.
        rmse_m: RMSE after the alignment, in metres.
        fraction: RMSE as a fraction of the diagonal of the reference.
        title: Title; the error stands below it.
        reference_links: Source and target of each link ``(m, 2)``; without: points only.
        aligned_links: The same for the merged map.
        names: Names of both for the legend.
    """
    maps = [np.asarray(xy, np.float64).reshape(-1, 2) for xy in (reference_xy, aligned_xy)]
    looks: tuple[dict[str, Any], ...] = (
        {"color": REFERENCE, "lw": 3.6, "ms": 7.0, "marker": "o", "mew": 0},
        {"color": ROBOT, "lw": 1.3, "ms": 3.2, "marker": "o", "mew": 0},
    )
    with mpl.rc_context(STYLE):
        box = _box(maps)
        window = window_size(np.ptp(box, axis=0))
        figure, (axes,) = make_panels(1, 1, None, window, width=6.2)
        both_links = (reference_links, aligned_links)
        parts = zip(maps, both_links, looks, strict=True)
        for level, (xy, links, look) in enumerate(parts, start=2):
            if links is None:
                look["ls"] = "none"
            else:
                lines = [*xy[np.asarray(links, np.int64).reshape(-1, 2)]]
                wide = LineCollection(lines, colors=look["color"], lw=look["lw"], zorder=level)
                axes.add_collection(wide)
            dot = {"ms": look["ms"] * dot_size(len(xy)) / 4.5, "ls": "none"}
            axes.plot(*xy.T, zorder=level, **(look | dot))
        set_window(axes, box, window)
        error = f"RMSE {metres(rmse_m)} ({100.0 * fraction:.3g} % of the diagonal)"
        write_titles(axes, title or "Merged map over the single session", error)
        pairs = zip(names, looks, strict=True)
        key = [Line2D([], [], label=name, **look) for name, look in pairs]
        return finish(figure, key, window)


def plot_accuracy(
    rows: Sequence[tuple[str, np.ndarray, np.ndarray, float, Sequence[tuple[int, int]]]],
    title: str | None = None,
) -> Figure:
    """Draw tracks against the truth, a panel for each method of mapping, all with the same axes.

    Args:
        rows: Name; track ``(n, 2)`` aligned to the truth, and truth ``(n, 2)``, in metres; absolute
            trajectory error (RMSE) in metres; first frame and frame after the last of each session.
        title: Title of the whole figure.

    Raises:
        ValueError: If there is no row, a truth and its track differ in length, or there are too
            many sessions.
    """
    need_parts(rows, "plot_accuracy", "row")
    for name, track, truth, _, ranges in rows:
        check_sessions("plot_accuracy", name, len(ranges), np.arange(len(ranges)))
        if len(track) != len(truth):
            raise ValueError(
                f"plot_accuracy: {name!r} has {len(track)} points and {len(truth)} of truth; "
                "give a truth for each point"
            )
    dashes: dict[str, Any] = {"ls": (0, (4, 3)), "color": TRUTH, "lw": 1.0}
    with mpl.rc_context(STYLE):
        box = _box([np.asarray(xy) for row in rows for xy in row[1:3]])
        window = window_size(np.ptp(box, axis=0))
        columns = 2 if len(rows) in (2, 4) else 3
        figure, panels = make_panels(len(rows), columns, title, window, width=4.8)
        for axes, (name, track, truth, ate_m, ranges) in zip(panels, rows, strict=True):
            length_m = 0.0
            for number, (first, stop) in enumerate(ranges):
                part, true = np.asarray(track)[first:stop], np.asarray(truth)[first:stop]
                axes.plot(*part.T, color=SESSIONS[number], lw=1.8, zorder=3)
                axes.plot(*true.T, zorder=4, **dashes)
                draw_ends(axes, part[:1], part[-1:], SESSIONS[number])
                length_m += path_length(true)
            notes = (counted(len(track), "frame"), counted(len(ranges), "session"))
            title_of = f"{name}: ATE {metres(ate_m)}"
            write_titles(axes, title_of, " · ".join((*notes, f"{length_m:,.1f} m")))
            set_window(axes, box, window)
        key = session_handles((np.arange(max(len(row[4]) for row in rows)),))
        key += [mark_handle("X"), mark_handle("D")]
        key.append(Line2D([], [], label="truth", **dashes))
        return finish(figure, key, window)


def _poses(stage: Stage) -> np.ndarray:
    return np.asarray(stage.poses, np.float64).reshape(-1, 3)


def _extent(stage: Stage) -> np.ndarray:
    return np.vstack([_poses(stage)[:, :2], np.asarray(stage.merge_points).reshape(-1, 2)])


def _box(parts: Iterable[np.ndarray]) -> np.ndarray:
    """Return the lower and the upper corner of all points, ``(2, 2)``."""
    points = np.vstack([*parts, _NO_POINTS])
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return np.zeros((2, 2))
    return np.stack([points.min(axis=0), points.max(axis=0)])


def _shifts(stage: Stage) -> list[np.ndarray]:
    """Return displacements of unlinked maps, right or down, so that no maps overlap."""
    taken = _box([_extent(stage)])
    moves: list[np.ndarray] = []
    for other in stage.others:
        box, move = _box([_extent(other)]), np.zeros(2)
        gap = 0.1 * max(np.ptp(taken, axis=0).max(), np.ptp(box, axis=0).max())
        if (box[0] < taken[1] + gap / 2).all() and (box[1] > taken[0] - gap / 2).all():
            right = np.array([taken[1, 0] + gap - box[0, 0], 0.0])
            down = np.array([0.0, taken[0, 1] - gap - box[1, 1]])
            move = min(
                (right, down), key=lambda m: float(np.ptp(_box([taken, box + m]), axis=0).max())
            )
        moves.append(move)
        taken = _box([taken, box + move])
    return moves


def _counts(stage: Stage) -> str:
    if not stage.others:
        return f"{counted(len(stage.session), 'experience')} · {counted(len(stage.links), 'link')}"
    parts = (stage, *stage.others)
    nodes = " + ".join(f"{len(part.session):,}" for part in parts)
    return f"{nodes} experiences · {' + '.join(f'{len(p.links):,}' for p in parts)} links"


def _moved(stage: Stage, moves: Sequence[np.ndarray]) -> list[str]:
    notes = []
    for other, (right, up) in zip(stage.others, moves, strict=True):
        move = f", moved {right:.3g} m right" if right else f", moved {-up:.3g} m down"
        notes.append(f"{other.title}: own coordinates{move if right or up else ''}")
    return notes


def _draw_stage(axes: Axes, stage: Stage, move: np.ndarray) -> None:
    xy, links = _poses(stage)[:, :2] + move, np.asarray(stage.links, np.int64).reshape(-1, 2)
    session = np.asarray(stage.session, np.int64)
    link_session = session[links].max(axis=1) if len(links) else session[:0]  # the later one's
    style: dict[str, Any] = {"ls": "none", "marker": "o", "mew": 0, "ms": dot_size(len(xy))}
    for number in np.unique(session):
        colour, level = SESSIONS[number], 2 + 0.1 * number
        lines = [*xy[links[link_session == number]]]
        axes.add_collection(LineCollection(lines, colors=colour, lw=1.0, zorder=level))
        axes.plot(*xy[session == number].T, zorder=level, color=colour, **style)
    for kind, nodes in (("D", stage.ends), ("X", stage.starts)):
        for node in nodes:
            draw_mark(axes, xy[node], kind, SESSIONS[session[node]])
    points = np.asarray(stage.merge_points, np.float64).reshape(-1, 2) + move
    if len(points):
        axes.plot(*points.T, zorder=9, **_RING)


def _draw_bindings(
    axes: Axes3D, cells: np.ndarray, session: np.ndarray, matched: np.ndarray, size: np.ndarray
) -> None:
    style: dict[str, Any] = {"ls": "none", "marker": "o", "mew": 0}
    axes.plot(*cells[:, :2].T, np.zeros(len(cells)), ms=1.6, color=SHADOW, zorder=1, **style)
    near = (np.abs(np.diff(cells, axis=0)) <= np.maximum(2.0, size / 8)).all(axis=1)
    near &= session[1:] == session[:-1]
    steps = np.stack([cells[:-1], cells[1:]], axis=1)
    for number in np.unique(session):
        mine, colour = session == number, SESSIONS[number]
        joined = steps[near & mine[1:]]
        if len(joined):
            axes.add_collection3d(Line3DCollection(joined, colors=colour, lw=0.8, alpha=0.7))
        axes.plot(*cells[mine].T, ms=2.6, color=colour, zorder=3, **style)
        draw_ends(axes, cells[mine][:1], cells[mine][-1:], colour)
    if len(matched):
        axes.plot(*matched.T, zorder=9, **_RING)
    axes.computed_zorder = False
    axes.set(xlim=(0, size[0]), ylim=(0, size[1]), zlim=(0, size[2]))
    axes.set_xlabel("x (cells)", labelpad=2)
    axes.set_ylabel("y (cells)", labelpad=2)
    axes.set_zlabel("θ (cells)")
    axes.view_init(elev=22, azim=-58)
    solid: Any = axes  # matplotlib's annotations lack what follows
    solid.set_box_aspect((1.0, 1.0, 0.8), zoom=1.1)
    for axis in (solid.xaxis, solid.yaxis, solid.zaxis):
        axis.set_major_locator(MaxNLocator(5, integer=True))
        axis.set_pane_color("#fafafa")
        axis._axinfo["grid"].update(color="#e4e4e4", linewidth=0.6)
