"""Figures of mapping in several sessions: maps before and after a merge, and what it cost.

A colour is a session, a cross its start, a diamond its end, a red ring the match that joins two
maps. Plain arrays in, a matplotlib ``Figure`` out; :func:`neuroslam.figures.maps.save` writes it.
"""

import math
import textwrap
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.art3d import Line3DCollection

from neuroslam.errors import counted
from neuroslam.evaluation.trajectory import path_length
from neuroslam.figures.style import INK, ROBOT, SESSIONS, STYLE, TRUTH, new_figure

ORDINALS = ("first", "second", "third", "fourth", "fifth", "sixth")
MATCH, REFERENCE, SHADOW = "#DD1122", "#7B3FA0", "#c2c2c2"
_NO_POINTS = np.zeros((0, 2))
_RING = {"ls": "none", "marker": "o", "ms": 12, "mfc": "none", "mec": MATCH, "mew": 2.0}


class Stage(NamedTuple):
    """A map at one moment of a run in several sessions.

    Attributes:
        title: What the moment is.
        poses: Experiences ``(n, 3)``: x, y in metres, heading in radians.
        links: Source and target of each link, ``(m, 2)``.
        session: Which session made each experience, ``(n,)``, from 0.
        merge_points: Where two maps match, ``(k, 2)``, in metres: red rings.
        starts: Experiences where a session began: crosses.
        ends: Experiences where a session ended: diamonds.
        others: Maps not linked to this one yet, each in coordinates of its own.
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
    """Where the experiences of a map are bound on the torus of the pose cells.

    Attributes:
        title: What is bound.
        cells: x, y, theta of each binding, in cells, ``(n, 3)``, in the order they were made.
        session: Which session made each, ``(n,)``, from 0.
        matched: Packets that the match of the two maps is about, ``(k, 3)``, in cells: red.
    """

    title: str
    cells: np.ndarray
    session: np.ndarray
    matched: np.ndarray = np.zeros((0, 3))


def plot_stages(
    stages: Sequence[Stage], title: str | None = None, names: Sequence[str] = ()
) -> Figure:
    """Draw how maps of several sessions became one, a panel for each stage.

    All panels have one scale, but one with unlinked maps shows as much as it needs. Such a map has
    coordinates of its own; where it would lie over the first map it is drawn beside it, and the
    panel says how far it was moved.

    Args:
        stages: In the order of time; three in a row.
        title: Heading of the whole figure.
        names: Of all sessions, for the legend; without, those that are seen are numbered there.

    Raises:
        ValueError: If there is no stage, or sessions do not fit the experiences.
    """
    _need(stages, "plot_stages", "stage")
    for part in (part for stage in stages for part in (stage, *stage.others)):
        _check("plot_stages", part.title, len(_poses(part)), part.session)
    shifts = [_shifts(stage) for stage in stages]
    boxes = [
        _box([_extent(s), *(_extent(o) + move for o, move in zip(s.others, moves, strict=True))])
        for s, moves in zip(stages, shifts, strict=True)
    ]
    whole = [box for box, stage in zip(boxes, stages, strict=True) if not stage.others] or boxes
    window = _window(np.max([np.ptp(box, axis=0) for box in whole], axis=0))
    with mpl.rc_context(STYLE):
        figure, panels = _grid(len(stages), 3, title, window)
        for axes, stage, moves, box in zip(panels, stages, shifts, boxes, strict=True):
            for part, move in zip((stage, *stage.others), ([0.0, 0.0], *moves), strict=True):
                _draw_stage(axes, part, np.asarray(move))
            _say(axes, stage.title, _counts(stage), *_moved(stage, moves))
            _frame(axes, box, window)
        parts = [part for stage in stages for part in (stage, *stage.others)]
        key = _session_key((part.session for part in parts), names)
        marks = [any(len(p.starts) for p in parts), any(len(p.ends) for p in parts)]
        key += [_mark(kind) for kind, seen in zip("XD", marks, strict=True) if seen]
        if any(len(part.merge_points) for part in parts):
            key.append(Line2D([], [], label="merge point", **(_RING | {"ms": 9})))
        return _finish(figure, key, window)


def plot_bindings(
    groups: Sequence[Bindings], torus: tuple[int, int, int], title: str | None = None
) -> Figure:
    """Draw where experiences are bound on the torus of the pose cells, a panel for each group.

    Bindings made one after the other are joined where they are near (an eighth of the torus),
    never across the edge where the torus closes. Grey dots on the floor are their x and y.

    Args:
        groups: For instance before and after the shift onto the matched packet.
        torus: Cells in x, y and theta.
        title: Heading of the whole figure.

    Raises:
        ValueError: If there is no group, or sessions do not fit the bindings.
    """
    _need(groups, "plot_bindings", "group")
    size = np.asarray(torus, np.float64)
    with mpl.rc_context(STYLE):
        columns = 2 if len(groups) in (2, 4) else 3
        window = np.array([1.0, 0.87])
        solid = {"width": 4.4, "projection": "3d"}
        figure, panels = _grid(len(groups), columns, title, window, **solid)
        right = 1.0 - 0.45 / figure.get_figwidth()  # the layout leaves no room for the label of θ
        figure.get_layout_engine().set(rect=(0.0, 0.0, right, 1.0))
        for axes, group in zip(panels, groups, strict=True):
            cells = np.asarray(group.cells, np.float64).reshape(-1, 3)
            session = _check("plot_bindings", group.title, len(cells), group.session)
            _draw_bindings(axes, cells, session, np.asarray(group.matched).reshape(-1, 3), size)
            _say(axes, group.title, counted(len(cells), "binding"))
        key = _session_key(group.session for group in groups)
        key += [_mark("X"), _mark("D")]
        if any(len(group.matched) for group in groups):
            key.append(Line2D([], [], label="match", **(_RING | {"ms": 9})))
        shadow = {"ls": "none", "marker": "o", "ms": 3, "color": SHADOW}
        key.append(Line2D([], [], label="shadow on θ = 0", **shadow))
        return _finish(figure, key, window)


def plot_overlay(
    reference_xy: np.ndarray,
    aligned_xy: np.ndarray,
    rmse_m: float,
    fraction: float,
    title: str | None = None,
    reference_links: np.ndarray | None = None,
    aligned_links: np.ndarray | None = None,
) -> Figure:
    """Draw a merged map, aligned, over the map of a single session.

    Args:
        reference_xy: Experiences of the single session ``(n, 2)``, in metres: purple.
        aligned_xy: Experiences of the merged map ``(k, 2)``, moved onto the reference: orange.
        rmse_m: What the alignment left over, in metres.
        fraction: The same as a share of the diagonal of the reference.
        title: Heading; the error stands below it.
        reference_links: Source and target of each link ``(m, 2)``; without: points alone.
        aligned_links: The same for the merged map.
    """
    maps = [np.asarray(xy, np.float64).reshape(-1, 2) for xy in (reference_xy, aligned_xy)]
    looks = (
        {"color": REFERENCE, "lw": 3.6, "ms": 7.0, "marker": "o", "mew": 0},
        {"color": ROBOT, "lw": 1.3, "ms": 3.2, "marker": "o", "mew": 0},
    )
    with mpl.rc_context(STYLE):
        box = _box(maps)
        window = _window(np.ptp(box, axis=0))
        figure, (axes,) = _grid(1, 1, None, window, width=6.2)
        joined = (reference_links, aligned_links)
        for level, (xy, links, look) in enumerate(zip(maps, joined, looks, strict=True), start=2):
            if links is None:
                look["ls"] = "none"
            else:
                lines = xy[np.asarray(links, np.int64).reshape(-1, 2)]
                wide = LineCollection(lines, colors=look["color"], lw=look["lw"], zorder=level)
                axes.add_collection(wide)
            dot = {"ms": look["ms"] * _dot(len(xy)) / 4.5, "ls": "none"}
            axes.plot(*xy.T, zorder=level, **(look | dot))
        _frame(axes, box, window)
        error = f"RMSE {_metres(rmse_m)} ({100.0 * fraction:.3g} % of the diagonal)"
        _say(axes, title or "Merged map over the single session", error)
        names = ("single session", "merged map, aligned")
        pairs = zip(names, looks, strict=True)
        key = [Line2D([], [], label=name, **look) for name, look in pairs]
        return _finish(figure, key, window)


def plot_accuracy(
    rows: Sequence[tuple[str, np.ndarray, np.ndarray, float, Sequence[tuple[int, int]]]],
    title: str | None = None,
) -> Figure:
    """Draw tracks against the truth, a panel for each way of mapping, all with the same axes.

    Args:
        rows: Name; track ``(n, 2)`` aligned to the truth, and truth ``(n, 2)``, in metres; absolute
            trajectory error (RMSE) in metres; first frame and frame after the last of each session.
        title: Heading of the whole figure.

    Raises:
        ValueError: If there is no row, a truth has another length than its track, or there are too
            many sessions.
    """
    _need(rows, "plot_accuracy", "row")
    for name, track, truth, _, ranges in rows:
        _check("plot_accuracy", name, len(ranges), np.arange(len(ranges)))
        if len(track) != len(truth):
            raise ValueError(
                f"plot_accuracy: {name!r} has {len(track)} points and {len(truth)} of truth; "
                "give a truth for each point"
            )
    dashes = {"ls": (0, (4, 3)), "color": TRUTH, "lw": 1.0}
    with mpl.rc_context(STYLE):
        box = _box([np.asarray(xy) for row in rows for xy in row[1:3]])
        window = _window(np.ptp(box, axis=0))
        columns = 2 if len(rows) in (2, 4) else 3
        figure, panels = _grid(len(rows), columns, title, window, width=4.8)
        for axes, (name, track, truth, ate_m, ranges) in zip(panels, rows, strict=True):
            metres = 0.0
            for number, (first, stop) in enumerate(ranges):
                part, true = np.asarray(track)[first:stop], np.asarray(truth)[first:stop]
                axes.plot(*part.T, color=SESSIONS[number], lw=1.8, zorder=3)
                axes.plot(*true.T, zorder=4, **dashes)
                _draw_ends(axes, part[:1], part[-1:], SESSIONS[number])
                metres += path_length(true)
            said = (counted(len(track), "frame"), counted(len(ranges), "session"))
            _say(axes, f"{name}: ATE {_metres(ate_m)}", " · ".join((*said, f"{metres:,.1f} m")))
            _frame(axes, box, window)
        key = _session_key((np.arange(max(len(row[4]) for row in rows)),))
        key += [_mark("X"), _mark("D")]
        key.append(Line2D([], [], label="truth", **dashes))
        return _finish(figure, key, window)


def _poses(stage: Stage) -> np.ndarray:
    return np.asarray(stage.poses, np.float64).reshape(-1, 3)


def _extent(stage: Stage) -> np.ndarray:
    return np.vstack([_poses(stage)[:, :2], np.asarray(stage.merge_points).reshape(-1, 2)])


def _box(parts: Iterable[np.ndarray]) -> np.ndarray:
    """Find the lower and the upper corner of all points, ``(2, 2)``."""
    points = np.vstack([*parts, _NO_POINTS])
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return np.zeros((2, 2))
    return np.stack([points.min(axis=0), points.max(axis=0)])


def _shifts(stage: Stage) -> list[np.ndarray]:
    """Move each unlinked map right or down, whichever keeps the picture compact, if it must."""
    taken, moves = _box([_extent(stage)]), []
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
    said = []
    for other, (right, up) in zip(stage.others, moves, strict=True):
        way = f", moved {right:.3g} m right" if right else f", moved {-up:.3g} m down"
        said.append(f"{other.title}: own coordinates{way if right or up else ''}")
    return said


def _draw_stage(axes: Axes, stage: Stage, move: np.ndarray) -> None:
    xy, links = _poses(stage)[:, :2] + move, np.asarray(stage.links, np.int64).reshape(-1, 2)
    session = np.asarray(stage.session, np.int64)
    maker = session[links].max(axis=1) if len(links) else session[:0]  # the later one made it
    for number in np.unique(session):
        colour, level = SESSIONS[number], 2 + 0.1 * number
        lines = LineCollection(xy[links[maker == number]], colors=colour, lw=1.0, zorder=level)
        axes.add_collection(lines)
        style = {"ls": "none", "marker": "o", "mew": 0, "color": colour, "ms": _dot(len(xy))}
        axes.plot(*xy[session == number].T, zorder=level, **style)
    for kind, nodes in (("D", stage.ends), ("X", stage.starts)):
        for node in nodes:
            _draw_mark(axes, xy[node], kind, SESSIONS[session[node]])
    points = np.asarray(stage.merge_points, np.float64).reshape(-1, 2) + move
    if len(points):
        axes.plot(*points.T, zorder=9, **_RING)


def _draw_bindings(
    axes: Axes, cells: np.ndarray, session: np.ndarray, matched: np.ndarray, size: np.ndarray
) -> None:
    style = {"ls": "none", "marker": "o", "mew": 0}
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
        _draw_ends(axes, cells[mine][:1], cells[mine][-1:], colour)
    if len(matched):
        axes.plot(*matched.T, zorder=9, **_RING)
    axes.computed_zorder = False
    axes.set(xlim=(0, size[0]), ylim=(0, size[1]), zlim=(0, size[2]))
    axes.set_xlabel("x (cells)", labelpad=2)
    axes.set_ylabel("y (cells)", labelpad=2)
    axes.set_zlabel("θ (cells)")
    axes.view_init(elev=22, azim=-58)
    axes.set_box_aspect((1.0, 1.0, 0.8), zoom=1.1)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_major_locator(MaxNLocator(5, integer=True))
        axis.set_pane_color("#fafafa")
        axis._axinfo["grid"].update(color="#e4e4e4", linewidth=0.6)


def _draw_ends(axes: Axes, first: np.ndarray, last: np.ndarray, colour: str) -> None:
    for kind, points in (("D", last), ("X", first)):
        for point in points:
            _draw_mark(axes, point, kind, colour)


def _draw_mark(axes: Axes, point: np.ndarray, kind: str, colour: str) -> None:
    axes.plot(*([value] for value in point), zorder=8 - 0.5 * (kind == "D"), **_look(kind, colour))


def _look(kind: str, colour: str) -> dict:
    style = {"ls": "none", "marker": kind}  # a loop ends where it starts: both stay in sight
    if kind == "X":
        return style | {"ms": 7.5, "mfc": colour, "mec": INK, "mew": 0.8}
    return style | {"ms": 8.0, "mfc": "white", "mec": colour, "mew": 1.8}


def _mark(kind: str) -> Line2D:
    label = "start of a session" if kind == "X" else "end of a session"
    return Line2D([], [], label=label, **_look(kind, "#8c8c8c"))


def _session_key(sessions: Iterable[np.ndarray], names: Sequence[str] = ()) -> list[Line2D]:
    seen = sorted({int(number) for session in sessions for number in np.unique(session)})
    labels = dict(enumerate(names)) or {n: f"{ORDINALS[n]} session" for n in seen}
    style = {"marker": "o", "ms": 5, "lw": 1.6}
    return [
        Line2D([], [], color=SESSIONS[n % len(SESSIONS)], label=label, **style)
        for n, label in labels.items()
    ]


def _grid(
    n: int,
    columns: int,
    title: str | None,
    window: np.ndarray,
    width: float = 3.9,
    projection: str | None = None,
) -> tuple[Figure, list[Axes]]:
    """Make ``n`` panels; the height is a guess, until :func:`_finish` knows their text."""
    columns = min(n, columns)
    rows, wide = -(-n // columns), max(columns * width, 5.6)
    heading = textwrap.fill(title, int(wide / 0.115)) if title else None
    high = (wide / columns - 0.75) * float(window[1] / window[0]) + 1.0
    figure = new_figure(wide, rows * high + 1.0, heading)
    kind = {} if projection is None else {"projection": projection}
    return figure, [figure.add_subplot(rows, columns, k + 1, **kind) for k in range(n)]


def _finish(figure: Figure, key: list[Line2D], window: np.ndarray) -> Figure:
    """Write the legend below, then give the figure the height its panels need in their width."""
    widths, wide = [0.075 * len(line.get_label()) + 0.6 for line in key], figure.get_figwidth()
    columns = math.ceil(len(key) / max(1, math.ceil(sum(widths) / wide)))
    columns = max(1, min(columns, int(wide / max(widths, default=1.0))))
    if key:
        figure.legend(handles=key, loc="outside lower center", ncols=columns)
    figure.draw_without_rendering()
    axes = figure.axes[0]
    slot = axes.get_position(original=True).size * figure.get_size_inches()
    missing = slot[0] * window[1] / window[0] - slot[1]
    figure.set_figheight(figure.get_figheight() + missing * axes.get_gridspec().nrows)
    for axes in figure.axes:
        if axes.name != "3d":
            axes.set_aspect("equal")  # only now: a panel that fills its place tells its margins
    return figure


def _window(span: np.ndarray) -> np.ndarray:
    """Give a map its margin and a panel that is neither a strip nor a tower, in metres."""
    wide, high = 1.14 * np.maximum(span, max(0.02 * float(span.max()), 0.1))
    return np.array([max(wide, high / 1.2), max(high, wide / 2)])


def _frame(axes: Axes, box: np.ndarray, window: np.ndarray) -> None:
    """Show the window, or as much as it takes, around the middle."""
    half = 0.5 * window * max(1.0, float((1.14 * np.ptp(box, axis=0) / window).max()))
    low, high = box.mean(axis=0) - half, box.mean(axis=0) + half
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="x (m)", ylabel="y (m)")
    axes.xaxis.set_major_locator(MaxNLocator(6))
    axes.yaxis.set_major_locator(MaxNLocator(6))


def _say(axes: Axes, name: str, *said: str) -> None:
    """Write what is seen, and how much of it in smaller lines below."""
    wide = axes.figure.get_figwidth() / axes.get_gridspec().ncols - 0.8
    lines = [line for text in said for line in textwrap.wrap(text, int(wide / 0.058))]
    axes.set_title(textwrap.fill(name, int(wide / 0.088)), loc="left", pad=5.0 + 11.0 * len(lines))
    place = {"xycoords": "axes fraction", "textcoords": "offset points", "va": "bottom"}
    axes.annotate("\n".join(lines), (0.0, 1.0), (0, 4), fontsize=8, annotation_clip=False, **place)


def _dot(n: int) -> float:
    return float(np.clip(50.0 / math.sqrt(max(1, n)), 2.0, 4.5))


def _metres(distance: float) -> str:
    return f"{distance:.3g} m"


def _need(parts: Sequence, who: str, noun: str) -> None:
    if not len(parts):
        raise ValueError(f"{who}: got no {noun}; give one or more")


def _check(who: str, name: str, n: int, session: np.ndarray) -> np.ndarray:
    session = np.asarray(session, np.int64)
    if session.shape != (n,) or (n and not (0 <= session.min() <= session.max() < len(SESSIONS))):
        seen = f" from {session.min()} to {session.max()}" if session.size else ""
        raise ValueError(
            f"{who}: {name!r} has {n} points and {session.size} session numbers{seen}; "
            f"give each point a session from 0 to {len(SESSIONS) - 1}"
        )
    return session
