"""Figures of place cells in an arena: their centres and links, responses, and estimated paths.

Blue is the map that walls correct, black dashes the truth;
:mod:`neuroslam.figures.style` defines the other colours.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from neuroslam.errors import counted
from neuroslam.evaluation.trajectory import path_length
from neuroslam.figures.cells import draw_arena
from neuroslam.figures.parts import draw_robot
from neuroslam.figures.place_errors import colour_of
from neuroslam.figures.style import (
    ACTIVITY,
    INK,
    LOOP,
    MAP,
    ODOMETRY,
    STYLE,
    TRUTH,
    legend_below,
    new_figure,
    write_title,
)
from neuroslam.types import Pose
from neuroslam.worlds.arena import Arena

_ABOVE = 0.5  # share of the highest rate above which a cell is ringed
_PANEL_IN = 3.4  # width of an arena
_SHARED: dict[str, Any] = {"ls": (0, (4, 3)), "color": TRUTH, "lw": 0.9}


class PlaceMap(NamedTuple):
    """A map of place cells and the links between them.

    Attributes:
        name: Method and time.
        centres_m: Centres of the place cells in the frame of the arena, ``(n, 2)``.
        links: Pairs of place cells, ``(m, 2)``.
    """

    name: str
    centres_m: np.ndarray
    links: np.ndarray


class EstimatedPath(NamedTuple):
    """A path estimated by a method.

    Attributes:
        name: The method.
        path_m: Positions at the times of the true path, ``(n, 2)``.
        walls_m: Feet of the perpendiculars on remembered walls, ``(w, 2)``; ``None``: unknown.
    """

    name: str
    path_m: np.ndarray
    walls_m: np.ndarray | None = None


class Response(NamedTuple):
    """The rates of all place cells at one instant.

    Attributes:
        name: The network.
        centres_m: Centres of the cells, ``(n, 2)``.
        rates: Rates of the cells, ``(n,)``, not negative.
        position_m: True position of the animal, ``(2,)``.
    """

    name: str
    centres_m: np.ndarray
    rates: np.ndarray
    position_m: np.ndarray


def plot_place_maps(
    maps: Sequence[Sequence[PlaceMap]], arena: Arena, truth_m: np.ndarray, title: str | None = None
) -> Figure:
    """Draw maps of place cells in rows: dots are centres, lines join cells active in succession.

    Args:
        maps: Rows of equal length.
        arena: Arena of all maps.
        truth_m: True path, ``(n, 2)``: a faint line.
        title: Title of the whole figure.

    Raises:
        ValueError: If there is no map, or rows differ in length.
    """
    if not maps or len({len(row) for row in maps}) != 1 or not maps[0]:
        raise ValueError("plot_place_maps: expected rows of maps, all of one length")
    boxes = [one.centres_m for row in maps for one in row]
    with mpl.rc_context(STYLE):
        figure, panels = _panels(arena, boxes, len(maps), len(maps[0]), title)
        for axes, one in zip(panels, (one for row in maps for one in row), strict=True):
            axes.plot(*truth_m.T, color="#dddddd", lw=0.4, zorder=1)
            _draw_places(axes, one.centres_m, one.links)
            write_title(axes, one.name, counted(len(one.centres_m), "cell"))
        key = [
            Line2D([], [], color=MAP, marker="o", ms=3.5, lw=0.8, label="cells, links"),
            Line2D([], [], color="#cccccc", lw=1.2, label="true path"),
        ]
        figure.legend(handles=key, loc="outside lower center", ncols=2)
    return figure


def plot_place_cells(
    centres_m: np.ndarray,
    links: np.ndarray,
    walls_m: np.ndarray,
    here: Pose,
    path_m: np.ndarray,
) -> Figure:
    """Draw place cells, the links between them and remembered walls, as the animal estimates them.

    Args:
        centres_m: Centres of the place cells, ``(n, 2)``.
        links: Pairs of place cells, ``(m, 2)``.
        walls_m: A point of each remembered part of a wall, ``(w, 2)``.
        here: Estimated pose of the animal now.
        path_m: Estimated path, ``(k, 2)``: a faint line.
    """
    with mpl.rc_context(STYLE):
        figure = new_figure(6.0, 6.0, None)
        axes = figure.subplots()
        axes.plot(*path_m.T, color=ODOMETRY, lw=0.4, alpha=0.5, zorder=1, label="path")
        _draw_places(axes, centres_m, links)
        axes.plot(
            [], [], "o-", color=MAP, ms=4, lw=0.8, label=counted(len(centres_m), "place cell")
        )
        if len(walls_m):
            style: dict[str, Any] = {"ls": "none", "marker": "s", "ms": 3.5, "color": LOOP}
            style["zorder"] = 4
            axes.plot(
                *walls_m.T, label=f"remembered wall, in {counted(len(walls_m), 'part')}", **style
            )
        draw_robot(axes, here, "the animal now")
        axes.set(xlabel="x (m)", ylabel="y (m)")
        axes.set_aspect("equal", adjustable="datalim")
        axes.margins(0.05)
        write_title(axes, "Place cells, and walls as remembered" if len(walls_m) else "Place cells")
        legend_below(axes, columns=2)
    return figure


def plot_paths(
    estimates: Sequence[EstimatedPath],
    arena: Arena,
    truth_m: np.ndarray,
    title: str | None = None,
) -> Figure:
    """Draw estimated paths over the true one, a panel each, with their mean errors.

    A remembered wall is drawn at the foot of its perpendicular.

    Args:
        estimates: Estimated paths, a panel each.
        arena: Arena of all paths.
        truth_m: True path, ``(n, 2)``.
        title: Title of the whole figure.

    Raises:
        ValueError: If there is no path, or its length differs from that of the truth.
    """
    for one in estimates:
        if len(one.path_m) != len(truth_m):
            raise ValueError(
                f"plot_paths: {one.name!r} has {len(one.path_m)} points, the truth {len(truth_m)}; "
                "expected as many"
            )
    if not estimates:
        raise ValueError("plot_paths: got no path, expected at least one")
    marks: dict[str, Any] = {"ls": "none", "marker": "+", "ms": 5, "mew": 1.2, "color": LOOP}
    with mpl.rc_context(STYLE):
        paths = [one.path_m for one in estimates]
        figure, panels = _panels(arena, paths, 1, len(estimates), title)
        for axes, one in zip(panels, estimates, strict=True):
            colour = colour_of(one.name)
            axes.plot(*one.path_m.T, color=colour, lw=0.7, alpha=0.9, zorder=2)
            axes.plot(*truth_m.T, zorder=3, **_SHARED)
            error = np.linalg.norm(one.path_m - truth_m, axis=1).mean()
            note = f"mean error {100 * error:.1f} cm"
            if one.walls_m is not None:
                axes.plot(*one.walls_m.T, zorder=5, **marks)
                note += f" · {counted(len(one.walls_m), 'wall memory').replace('ys', 'ies')}"
            write_title(axes, one.name, note)
        key = [
            Line2D([], [], lw=1.6, color=colour_of(one.name), label=one.name) for one in estimates
        ]
        key.append(Line2D([], [], label=f"truth, {path_length(truth_m):,.0f} m", **_SHARED))
        if any(one.walls_m is not None for one in estimates):
            key.append(Line2D([], [], label="remembered wall", **marks))
        figure.legend(handles=key, loc="outside lower center", ncols=len(key))
    return figure


def plot_responses(responses: Sequence[Response], arena: Arena, title: str | None = None) -> Figure:
    """Draw the rates of all place cells at one instant; cells above half the peak are ringed.

    Args:
        responses: Rates, a panel each, drawn relative to the highest.
        arena: Arena of all panels.
        title: Title of the whole figure.

    Raises:
        ValueError: If there is no response.
    """
    if not responses:
        raise ValueError("plot_responses: got no response, expected at least one")
    boxes = [one.centres_m for one in responses]
    with mpl.rc_context(STYLE):
        figure, panels = _panels(arena, boxes, 1, len(responses), title, aside_in=1.0)
        for axes, one in zip(panels, responses, strict=True):
            share = one.rates / max(float(one.rates.max()), 1e-30)
            order = share.argsort()  # high rates on top
            axes.scatter(
                *one.centres_m[order].T, c=share[order], s=26, cmap=ACTIVITY, vmin=0, vmax=1,
                lw=0, zorder=3,
            )  # fmt: skip
            strong = one.centres_m[share > _ABOVE]
            axes.scatter(*strong.T, s=90, facecolors="none", edgecolors=LOOP, lw=1.6, zorder=5)
            axes.plot(*one.position_m, marker="x", ms=8, mew=2, color=INK, ls="none", zorder=6)
            write_title(axes, one.name, f"{counted(len(strong), 'cell')} above half")
        scale = ScalarMappable(Normalize(0.0, 1.0), ACTIVITY)
        figure.colorbar(scale, ax=panels, shrink=0.9, label="rate / highest rate")
        key = [
            Line2D([], [], ls="none", marker="o", ms=9, mfc="none", mec=LOOP, mew=1.6,
                   label="above half of the highest rate"),
            Line2D([], [], ls="none", marker="x", ms=8, mew=2, color=INK, label="true position"),
        ]  # fmt: skip
        figure.legend(handles=key, loc="outside lower center", ncols=2)
    return figure


def _draw_places(axes: Axes, centres: np.ndarray, links: np.ndarray) -> None:
    lines = [*centres[links]] if len(links) else []
    axes.add_collection(LineCollection(lines, colors=MAP, lw=0.5, alpha=0.45, zorder=2))
    dot = float(np.clip(50.0 / math.sqrt(max(1, len(centres))), 1.8, 4.5))
    axes.plot(*centres.T, ls="none", marker="o", ms=dot, mew=0, color=MAP, zorder=3)


def _panels(
    arena: Arena,
    points: Sequence[np.ndarray],
    rows: int,
    columns: int,
    title: str | None,
    aside_in: float = 0.0,
) -> tuple[Figure, list[Axes]]:
    """Make panels of the arena, all with the same axes, which contain all points."""
    x_min, x_max, y_min, y_max = arena.bounds
    everything = np.vstack([[[x_min, y_min], [x_max, y_max]], *points])
    low, high = everything.min(axis=0), everything.max(axis=0)
    pad = 0.04 * float((high - low).max())
    low, high = low - pad, high + pad
    tall = _PANEL_IN * float((high - low)[1] / (high - low)[0])
    size = columns * (_PANEL_IN + 0.85) + aside_in, rows * (tall + 0.78) + 0.8
    figure = new_figure(*size, title)
    panels = list(figure.subplots(rows, columns, squeeze=False).flat)
    for axes in panels:
        draw_arena(axes, arena)
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        axes.xaxis.set_major_locator(MaxNLocator(5))
        axes.yaxis.set_major_locator(MaxNLocator(5))
    return figure, panels
