"""Figures of place cells: maps of places, responses, paths in an arena, curves with bands.

Blue is the map that walls correct, black dashes the truth;
:mod:`neuroslam.figures.style` has the rest.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from neuroslam.evaluation.trajectory import path_length
from neuroslam.figures.cells import draw_arena
from neuroslam.figures.style import (
    ACTIVITY,
    CURVES,
    INK,
    LOOP,
    MAP,
    ODOMETRY,
    STYLE,
    TRUTH,
    counted,
    draw_robot,
    legend_below,
    new_figure,
    write_title,
)
from neuroslam.types import Pose
from neuroslam.worlds.arena import Arena

_ABOVE = 0.5  # share of the strongest response, above which a cell counts as responding
_MARK = {"color": INK, "lw": 1.2, "ls": ":", "zorder": 4}
_PANEL_IN = 3.4  # width of an arena
_SHARED = {"ls": (0, (4, 3)), "color": TRUTH, "lw": 0.9}


class PlaceMap(NamedTuple):
    """Places and how they hang together.

    Attributes:
        name: What made it, and when.
        centres_m: In the frame of the arena, ``(n, 2)``.
        links: Two places each, ``(m, 2)``.
    """

    name: str
    centres_m: np.ndarray
    links: np.ndarray


class PathTold(NamedTuple):
    """Where somebody believed to be.

    Attributes:
        name: Who.
        path_m: ``(n, 2)``, where the truth has as many points.
        walls_m: Feet of the perpendiculars on remembered walls, ``(w, 2)``; ``None``: not told.
    """

    name: str
    path_m: np.ndarray
    walls_m: np.ndarray | None = None


class Response(NamedTuple):
    """How all place cells respond at one instant.

    Attributes:
        name: Of which network.
        centres_m: ``(n, 2)``.
        rates: ``(n,)``, not negative.
        position_m: Where the animal truly is, ``(2,)``.
    """

    name: str
    centres_m: np.ndarray
    rates: np.ndarray
    position_m: np.ndarray


class Spread(NamedTuple):
    """What repetitions gave over time, ``(repetitions, n)`` each, at times in minutes ``(n,)``."""

    minutes: np.ndarray
    values: np.ndarray


def plot_place_maps(
    maps: Sequence[Sequence[PlaceMap]], arena: Arena, truth_m: np.ndarray, title: str | None = None
) -> Figure:
    """Draw maps of places in rows: a dot is a place, a line joins those active in succession.

    Args:
        maps: Rows of equal length.
        arena: Around all of them.
        truth_m: True path, ``(n, 2)``: a faint line.
        title: Heading of the whole figure.

    Raises:
        ValueError: If there is none, or rows differ in length.
    """
    if not maps or len({len(row) for row in maps}) != 1 or not maps[0]:
        raise ValueError("plot_place_maps: expected rows of maps, all of one length")
    boxes = [one.centres_m for row in maps for one in row]
    with mpl.rc_context(STYLE):
        figure, panels = _panels(arena, boxes, len(maps), len(maps[0]), title)
        for axes, one in zip(panels, (one for row in maps for one in row), strict=True):
            axes.plot(*truth_m.T, color="#dddddd", lw=0.4, zorder=1)
            _draw_places(axes, one.centres_m, one.links)
            write_title(axes, one.name, counted(len(one.centres_m), "place"))
        key = [
            Line2D([], [], color=MAP, marker="o", ms=3.5, lw=0.8, label="places, links"),
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
    """Draw place cells, the links between them and walls, where an animal believes them to be.

    Args:
        centres_m: Of the place cells, ``(n, 2)``.
        links: Two places each, ``(m, 2)``.
        walls_m: A point of each remembered stretch of wall, ``(w, 2)``.
        here: Where the animal is now.
        path_m: Where it was, ``(k, 2)``: a faint line.
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
            style = {"ls": "none", "marker": "s", "ms": 3.5, "color": LOOP, "zorder": 4}
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
    told: Sequence[PathTold], arena: Arena, truth_m: np.ndarray, title: str | None = None
) -> Figure:
    """Draw believed paths over the true one, a panel each, with their mean errors.

    Remembered walls are where they were remembered to be: the foot of each perpendicular.

    Args:
        told: One panel each.
        arena: Around all of them.
        truth_m: True path, ``(n, 2)``.
        title: Heading of the whole figure.

    Raises:
        ValueError: If there is none, or one has another length than the truth.
    """
    for one in told:
        if len(one.path_m) != len(truth_m):
            raise ValueError(
                f"plot_paths: {one.name!r} has {len(one.path_m)} points, the truth {len(truth_m)}; "
                "expected as many"
            )
    if not told:
        raise ValueError("plot_paths: expected at least one path")
    marks = {"ls": "none", "marker": "+", "ms": 5, "mew": 1.2, "color": LOOP}
    with mpl.rc_context(STYLE):
        figure, panels = _panels(arena, [one.path_m for one in told], 1, len(told), title)
        for axes, one in zip(panels, told, strict=True):
            colour = colour_of(one.name)
            axes.plot(*one.path_m.T, color=colour, lw=0.7, alpha=0.9, zorder=2)
            axes.plot(*truth_m.T, zorder=3, **_SHARED)
            error = np.linalg.norm(one.path_m - truth_m, axis=1).mean()
            said = f"mean error {100 * error:.1f} cm"
            if one.walls_m is not None:
                axes.plot(*one.walls_m.T, zorder=5, **marks)
                said += f" · {counted(len(one.walls_m), 'wall memory').replace('ys', 'ies')}"
            write_title(axes, one.name, said)
        key = [Line2D([], [], lw=1.6, color=colour_of(one.name), label=one.name) for one in told]
        key.append(Line2D([], [], label=f"truth, {path_length(truth_m):,.0f} m", **_SHARED))
        if any(one.walls_m is not None for one in told):
            key.append(Line2D([], [], label="remembered wall", **marks))
        figure.legend(handles=key, loc="outside lower center", ncols=len(key))
    return figure


def plot_responses(responses: Sequence[Response], arena: Arena, title: str | None = None) -> Figure:
    """Draw the responses of all place cells at one instant; those above half are ringed.

    Args:
        responses: One panel each; each is shown as a share of its strongest.
        arena: Around all of them.
        title: Heading of the whole figure.

    Raises:
        ValueError: If there is none.
    """
    if not responses:
        raise ValueError("plot_responses: expected at least one response")
    boxes = [one.centres_m for one in responses]
    with mpl.rc_context(STYLE):
        figure, panels = _panels(arena, boxes, 1, len(responses), title, aside_in=1.0)
        for axes, one in zip(panels, responses, strict=True):
            share = one.rates / max(float(one.rates.max()), 1e-30)
            order = share.argsort()  # the strong ones on top
            picture = axes.scatter(
                *one.centres_m[order].T, c=share[order], s=26, cmap=ACTIVITY, vmin=0, vmax=1,
                lw=0, zorder=3,
            )  # fmt: skip
            strong = one.centres_m[share > _ABOVE]
            axes.scatter(*strong.T, s=90, facecolors="none", edgecolors=LOOP, lw=1.6, zorder=5)
            axes.plot(*one.position_m, marker="x", ms=8, mew=2, color=INK, ls="none", zorder=6)
            write_title(axes, one.name, f"{counted(len(strong), 'cell')} above half")
        figure.colorbar(picture, ax=panels, shrink=0.9, label="share of the strongest response")
        key = [
            Line2D([], [], ls="none", marker="o", ms=9, mfc="none", mec=LOOP, mew=1.6,
                   label="above half of the strongest"),
            Line2D([], [], ls="none", marker="x", ms=8, mew=2, color=INK, label="true position"),
        ]  # fmt: skip
        figure.legend(handles=key, loc="outside lower center", ncols=2)
    return figure


def plot_growth(
    cells: Mapping[str, Spread],
    errors_m: Mapping[str, Spread],
    marks_m: Mapping[str, float] | None = None,
    title: str | None = None,
) -> Figure:
    """Draw numbers of place cells, and errors of position, over time.

    A line is the mean over repetitions, the band one standard deviation to each side.

    Args:
        cells: Name -> numbers.
        errors_m: Name -> errors in metres.
        marks_m: Name -> error that something else had: a dotted line.
        title: Heading of the whole figure.

    Raises:
        ValueError: If there are no curves.
    """
    if not cells or not errors_m:
        raise ValueError("plot_growth: expected curves of cells and of errors")
    with mpl.rc_context(STYLE):
        figure = new_figure(11.0, 4.6, title)
        left, right = figure.subplots(1, 2)
        for axes, curves, scale in ((left, cells, 1.0), (right, errors_m, 100.0)):
            for name, spread in curves.items():
                draw_band(axes, spread.minutes, scale * spread.values, name)
            axes.set(xlabel="time (min)")
            axes.set_ylim(bottom=0)
            axes.set_xlim(0, max(float(spread.minutes[-1]) for spread in cells.values()))
        for mark in (marks_m or {}).values():
            right.axhline(100.0 * mark, **_MARK)
        left.set(ylabel="cells")
        right.set(ylabel="error of position (cm)")
        n = len(next(iter(cells.values())).values)
        write_title(left, "Places recruited", f"mean and sd of {counted(n, 'seed')}")
        write_title(right, "Error over time", "mean and sd, not aligned")
        names = list(dict.fromkeys([*cells, *errors_m]))
        key = [Line2D([], [], label=name, **_line(name)) for name in names]
        key += _marks(marks_m)
        figure.legend(handles=key, loc="outside lower center", ncols=len(key))
    return figure


def plot_errors(
    errors_m: Mapping[str, Mapping[str, np.ndarray]],
    marks_m: Mapping[str, float] | None = None,
    title: str | None = None,
) -> Figure:
    """Draw the errors of several methods on several tracks as bars.

    Args:
        errors_m: Method -> track -> errors in metres, one for each seed: mean and sd are drawn.
        marks_m: Name -> error that something else had: a dotted line.
        title: Heading of the whole figure.

    Raises:
        ValueError: If there are no errors.
    """
    if not errors_m:
        raise ValueError("plot_errors: expected at least one method")
    tracks = list(dict.fromkeys(track for values in errors_m.values() for track in values))
    wide = 0.8 / len(errors_m)
    with mpl.rc_context(STYLE):
        figure = new_figure(max(7.0, 1.8 * len(tracks) + 1.5), 4.2, title)
        axes = figure.subplots()
        for number, (method, values) in enumerate(errors_m.items()):
            at = [tracks.index(track) + (number + 0.5) * wide - 0.4 for track in values]
            mean = [100.0 * np.mean(seeds) for seeds in values.values()]
            sd = [100.0 * np.std(seeds) for seeds in values.values()]
            look = {"ecolor": INK, "error_kw": {"lw": 1.0}, "capsize": 2, "zorder": 3}
            axes.bar(at, mean, 0.92 * wide, yerr=sd, color=colour_of(method), label=method, **look)
        for mark in (marks_m or {}).values():
            axes.axhline(100.0 * mark, **_MARK)
        axes.set_xticks(range(len(tracks)), tracks)
        axes.grid(visible=False, axis="x")
        axes.set(ylabel="mean error of position (cm)")
        write_title(axes, "Not aligned", "bars: mean over seeds; whiskers: sd")
        key = [Patch(color=colour_of(method), label=method) for method in errors_m]
        key += _marks(marks_m)
        figure.legend(handles=key, loc="outside lower center", ncols=len(key))
    return figure


def plot_sweep(
    thresholds_m: Sequence[float],
    winner_m: Sequence[np.ndarray],
    integrator_m: Sequence[np.ndarray],
    cells: Sequence[np.ndarray],
    title: str | None = None,
) -> Figure:
    """Draw the errors for distances between place cells as boxes, and how many cells there are.

    A box spans the quartiles, its line is the median, its dot the mean; whiskers go from 5 to 95 %.

    Args:
        thresholds_m: Least distances between place cells.
        winner_m: For each, the distances from the winning cell's centre to the truth.
        integrator_m: For each, the distances from the decoded position to the truth.
        cells: For each, the number of place cells of each seed.
        title: Heading of the whole figure.

    Raises:
        ValueError: If the lengths differ.
    """
    if not len(thresholds_m) == len(winner_m) == len(integrator_m) == len(cells) > 0:
        raise ValueError("plot_sweep: expected errors and cells for each threshold")
    with mpl.rc_context(STYLE):
        figure = new_figure(11.0, 4.6, title)
        left, right = figure.subplots(1, 2, width_ratios=[1.6, 1.0])
        at = np.arange(len(thresholds_m))
        kinds = (("winning place cell", winner_m, MAP), ("integrator", integrator_m, ODOMETRY))
        for shift, (_, errors, colour) in zip((-0.2, 0.2), kinds, strict=True):
            left.boxplot(
                [100.0 * e for e in errors], positions=at + shift, widths=0.32, whis=(5, 95),
                showfliers=False, showmeans=True, patch_artist=True,
                boxprops={"facecolor": colour, "alpha": 0.55, "edgecolor": INK},
                medianprops={"color": INK, "lw": 1.4},
                meanprops={"marker": "o", "mfc": "white", "mec": INK, "ms": 4},
            )  # fmt: skip
        names = [f"{100 * r:g}" for r in thresholds_m]
        left.set_xticks(at, names)
        left.set(ylabel="error of position (cm)")
        left.set_ylim(bottom=0)
        write_title(left, "Error", "box: quartiles; whiskers: 5 and 95 %; dot: mean")
        mean, sd = ([f(n) for n in cells] for f in (np.mean, np.std))
        right.bar(at, mean, 0.6, yerr=sd, color=MAP, capsize=2, error_kw={"lw": 1.0}, zorder=3)
        right.set_xticks(at, names)
        right.set(ylabel="place cells at the end")
        write_title(right, "Places", f"mean and sd of {counted(len(cells[0]), 'seed')}")
        for axes in (left, right):
            axes.grid(visible=False, axis="x")
            axes.set(xlabel="least distance between place cells (cm)")
        key = [Patch(fc=colour, alpha=0.55, ec=INK, label=name) for name, _, colour in kinds]
        figure.legend(handles=key, loc="outside lower center", ncols=2)
    return figure


METHODS = {
    "SLRB": MAP,
    "competitive Hebb": LOOP,
    "RatSLAM": CURVES[2],
    "path integration": ODOMETRY,
}
"""Method -> its colour, the same in all figures."""


def colour_of(name: str) -> str:
    """Return the colour of a method, by how its name begins; any other is pink.

    Example:
        >>> colour_of("SLRB, winner") == METHODS["SLRB"]
        True
    """
    return next((c for method, c in METHODS.items() if name.startswith(method)), CURVES[3])


def draw_band(axes: Axes, at: np.ndarray, values: np.ndarray, name: str) -> None:
    """Draw the mean of ``(repetitions, n)`` as a line, and one standard deviation as a band."""
    mean, sd = values.mean(axis=0), values.std(axis=0)
    axes.fill_between(at, mean - sd, mean + sd, color=colour_of(name), alpha=0.15, lw=0, zorder=2)
    axes.plot(at, mean, label=name, zorder=3, **_line(name))


def _line(name: str) -> dict[str, Any]:
    """Say how a method's line looks: RatSLAM's, which hides another where it is alike, dashed."""
    dash = (0, (4, 2)) if name.startswith("RatSLAM") else "-"
    return {"color": colour_of(name), "lw": 1.8, "ls": dash}


def _marks(marks_m: Mapping[str, float] | None) -> list[Line2D]:
    return [
        Line2D([], [], label=f"{name}: {100.0 * mark:.1f} cm", **_MARK)
        for name, mark in (marks_m or {}).items()
    ]


def _draw_places(axes: Axes, centres: np.ndarray, links: np.ndarray) -> None:
    lines = centres[links] if len(links) else np.empty((0, 2, 2))
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
    """Make panels with the arena in them, all with the same axes, wide enough for all points."""
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
