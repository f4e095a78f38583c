"""Panels of figures of several sessions: their layout, titles, marks and legends."""

import math
import textwrap
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from neuroslam.figures.style import INK, SESSIONS, new_figure

ORDINALS = ("first", "second", "third", "fourth", "fifth", "sixth")


def draw_ends(axes: Axes, first: np.ndarray, last: np.ndarray, colour: str) -> None:
    """Mark the first and the last points of a session, ``(k, 2)`` or ``(k, 3)``."""
    for kind, points in (("D", last), ("X", first)):
        for point in points:
            draw_mark(axes, point, kind, colour)


def draw_mark(axes: Axes, point: np.ndarray, kind: str, colour: str) -> None:
    """Draw a mark: kind ``X`` for the start of a session, ``D`` for its end."""
    axes.plot(
        *([value] for value in point), zorder=8 - 0.5 * (kind == "D"), **mark_style(kind, colour)
    )


def mark_style(kind: str, colour: str) -> dict[str, Any]:
    """Return the style of a mark: kind ``X`` for a start, ``D`` for an end."""
    # A loop ends where it starts: the marks differ so that both stay visible.
    style: dict[str, Any] = {"ls": "none", "marker": kind}
    if kind == "X":
        return style | {"ms": 7.5, "mfc": colour, "mec": INK, "mew": 0.8}
    return style | {"ms": 8.0, "mfc": "white", "mec": colour, "mew": 1.8}


def mark_handle(kind: str) -> Line2D:
    """Return the legend entry of a mark."""
    label = "start of a session" if kind == "X" else "end of a session"
    return Line2D([], [], label=label, **mark_style(kind, "#8c8c8c"))


def session_handles(sessions: Iterable[np.ndarray], names: Sequence[str] = ()) -> list[Line2D]:
    """Return legend entries of sessions: all that have names, or all that occur."""
    seen = sorted({int(number) for session in sessions for number in np.unique(session)})
    labels = dict(enumerate(names)) or {n: f"{ORDINALS[n]} session" for n in seen}
    style: dict[str, Any] = {"marker": "o", "ms": 5, "lw": 1.6}
    return [
        Line2D([], [], color=SESSIONS[n % len(SESSIONS)], label=label, **style)
        for n, label in labels.items()
    ]


def make_panels(
    n: int,
    columns: int,
    title: str | None,
    window: np.ndarray,
    width: float = 3.9,
    projection: str | None = None,
) -> tuple[Figure, list[Axes]]:
    """Make ``n`` panels; the height is provisional until :func:`finish` knows their text."""
    columns = min(n, columns)
    rows, wide = -(-n // columns), max(columns * width, 5.6)
    heading = textwrap.fill(title, int(wide / 0.115)) if title else None
    high = (wide / columns - 0.75) * float(window[1] / window[0]) + 1.0
    figure = new_figure(wide, rows * high + 1.0, heading)
    kind: dict[str, Any] = {} if projection is None else {"projection": projection}
    return figure, [figure.add_subplot(rows, columns, k + 1, **kind) for k in range(n)]


def finish(figure: Figure, key: list[Line2D], window: np.ndarray) -> Figure:
    """Write the legend below, then give the figure the height its panels need in their width."""
    widths = [0.075 * len(str(line.get_label())) + 0.6 for line in key]
    wide = figure.get_figwidth()
    columns = math.ceil(len(key) / max(1, math.ceil(sum(widths) / wide)))
    columns = max(1, min(columns, int(wide / max(widths, default=1.0))))
    if key:
        figure.legend(handles=key, loc="outside lower center", ncols=columns)
    figure.draw_without_rendering()
    axes = figure.axes[0]
    slot = axes.get_position(original=True).size * figure.get_size_inches()
    missing = slot[0] * window[1] / window[0] - slot[1]
    figure.set_figheight(figure.get_figheight() + missing * _grid_shape(axes)[0])
    for axes in figure.axes:
        if axes.name != "3d":
            axes.set_aspect("equal")  # after the height, which needs panels that fill their slots
    return figure


def _grid_shape(axes: Axes) -> tuple[int, int]:
    grid = axes.get_gridspec()
    assert grid is not None  # all panels come from add_subplot
    return grid.nrows, grid.ncols


def window_size(span: np.ndarray) -> np.ndarray:
    """Return the size of a panel for a map, in metres: with margin, and not too narrow."""
    wide, high = 1.14 * np.maximum(span, max(0.02 * float(span.max()), 0.1))
    return np.array([max(wide, high / 1.2), max(high, wide / 2)])


def set_window(axes: Axes, box: np.ndarray, window: np.ndarray) -> None:
    """Set the limits of the axes to the window, or as much as the box needs, around its middle."""
    half = 0.5 * window * max(1.0, float((1.14 * np.ptp(box, axis=0) / window).max()))
    low, high = box.mean(axis=0) - half, box.mean(axis=0) + half
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="x (m)", ylabel="y (m)")
    axes.xaxis.set_major_locator(MaxNLocator(6))
    axes.yaxis.set_major_locator(MaxNLocator(6))


def write_titles(axes: Axes, name: str, *notes: str) -> None:
    """Write a panel's title, and notes in smaller lines below."""
    figure = axes.get_figure(root=True)
    assert figure is not None  # all panels come from add_subplot
    wide = figure.get_figwidth() / _grid_shape(axes)[1] - 0.8
    lines = [line for text in notes for line in textwrap.wrap(text, int(wide / 0.058))]
    axes.set_title(textwrap.fill(name, int(wide / 0.088)), loc="left", pad=5.0 + 11.0 * len(lines))
    style: dict[str, Any] = {"xycoords": "axes fraction", "textcoords": "offset points"}
    style |= {"va": "bottom", "fontsize": 8, "annotation_clip": False}
    axes.annotate("\n".join(lines), (0.0, 1.0), (0, 4), **style)


def dot_size(n: int) -> float:
    """Return the size of the dots of ``n`` experiences."""
    return float(np.clip(50.0 / math.sqrt(max(1, n)), 2.0, 4.5))


def metres(distance: float) -> str:
    """Write a distance with three digits and its unit."""
    return f"{distance:.3g} m"


def need_parts(parts: Sequence[object], function: str, noun: str) -> None:
    """Raise ``ValueError`` if there is nothing to draw."""
    if not len(parts):
        raise ValueError(f"{function}: got no {noun}; give one or more")


def check_sessions(function: str, name: str, n: int, session: np.ndarray) -> np.ndarray:
    """Return session numbers of ``n`` points; raise ``ValueError`` if they do not match."""
    session = np.asarray(session, np.int64)
    if session.shape != (n,) or (n and not (0 <= session.min() <= session.max() < len(SESSIONS))):
        seen = f" from {session.min()} to {session.max()}" if session.size else ""
        raise ValueError(
            f"{function}: {name!r} has {n} points and {session.size} session numbers{seen}; "
            f"give each point a session from 0 to {len(SESSIONS) - 1}"
        )
    return session
