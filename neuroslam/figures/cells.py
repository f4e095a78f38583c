"""Figures of animals in arenas: walls, boundary cells, rate maps of grid cells, their scores.

Plain arrays in, a matplotlib ``Figure`` out; :func:`neuroslam.figures.style.save` writes it.
"""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from neuroslam.evaluation.gridness import autocorrelogram
from neuroslam.evaluation.ratemap import Bins
from neuroslam.figures.style import (
    ACTIVITY,
    INK,
    LOOP,
    MAP,
    ODOMETRY,
    STYLE,
    new_figure,
    write_title,
)
from neuroslam.worlds.arena import Arena

ZONES = {"inhibition": "#f2f2f2", "attenuation": "#fbe3b0", "growth": "#b9e2d2"}
"""Zone of distances to a wall, from far to near -> colour."""
_CORRELATION = "RdBu_r"


class Approach(NamedTuple):
    """A path towards a wall or away from it, and the activity of boundary cells along it.

    Attributes:
        title: Description of the path.
        arena: Arena of the path.
        path_m: Positions, ``(t, 2)``.
        time_s: ``(t,)``.
        distance_m: Distance to the nearest wall, ``(t,)``.
        zone: Number of the zone in :data:`ZONES`, ``(t,)``.
        activity: Activity of all cells, in [0, 1], ``(t,)``.
        active: Share of the cells that fire, ``(t,)``.
        rates: Highest rate of the cells of each preferred bearing, ``(t, n_bearings)``.
    """

    title: str
    arena: Arena
    path_m: np.ndarray
    time_s: np.ndarray
    distance_m: np.ndarray
    zone: np.ndarray
    activity: np.ndarray
    active: np.ndarray
    rates: np.ndarray


class Firing(NamedTuple):
    """The rate map of a cell.

    Attributes:
        title: The cell.
        note: A note at the right of the title, such as its grid score.
        rate_map: ``(n_y, n_x)``; NaN where unvisited.
        bins: Bins of the map.
        arena: The arena.
        track_m: Path of the animal, ``(t, 2)``, or empty.
        places_m: Positions of the animal when the cell fired, ``(n, 2)``.
    """

    title: str
    note: str
    rate_map: np.ndarray
    bins: Bins
    arena: Arena
    track_m: np.ndarray = np.zeros((0, 2))
    places_m: np.ndarray = np.zeros((0, 2))


class Curve(NamedTuple):
    """A quantity over time; ``spread``, if given, is drawn as a band to either side."""

    x: np.ndarray
    y: np.ndarray
    colour: str
    dash: str = "-"
    spread: np.ndarray | None = None


def draw_arena(axes: Axes, arena: Arena) -> None:
    """Draw the outline of an arena, with equal axes in metres."""
    for line in arena.outlines:
        axes.plot(*line.T, color=INK, lw=1.4, zorder=4, solid_joinstyle="miter")
    x_min, x_max, y_min, y_max = arena.bounds
    pad = 0.03 * max(x_max - x_min, y_max - y_min)
    axes.set(
        xlim=(x_min - pad, x_max + pad),
        ylim=(y_min - pad, y_max + pad),
        xlabel="x (m)",
        ylabel="y (m)",
    )
    axes.set_aspect("equal", adjustable="box")


def draw_rate_map(axes: Axes, rate_map: np.ndarray, bins: Bins, arena: Arena) -> None:
    """Draw a rate map from 0 to its own peak; unvisited bins are white."""
    top = float(np.nanmax(rate_map)) if np.isfinite(rate_map).any() else 0.0
    axes.imshow(rate_map, ACTIVITY, origin="lower", extent=bins.extent_m, vmin=0.0, vmax=top or 1.0)
    draw_arena(axes, arena)
    axes.grid(visible=False)


def draw_autocorrelogram(axes: Axes, rate_map: np.ndarray, bin_m: float) -> None:
    """Draw the autocorrelogram of a rate map; shifts with too little overlap are white."""
    r = autocorrelogram(rate_map)
    y, x = (bin_m * n / 2.0 for n in r.shape)
    axes.imshow(r, _CORRELATION, origin="lower", extent=(-x, x, -y, y), vmin=-1.0, vmax=1.0)
    axes.set(xlabel="shift in x (m)", ylabel="shift in y (m)", aspect="equal")
    axes.grid(visible=False)


def plot_approaches(approaches: Sequence[Approach], title: str) -> Figure:
    """Draw paths towards walls and away from them, two in a row, with the boundary cells.

    Each has its path seen from above, and over time its distance to the nearest wall, the activity,
    and the rates by preferred bearing. Zones are shaded.

    Args:
        approaches: Paths and the activity along them.
        title: Title of the whole figure.

    Raises:
        ValueError: If there is no path.
    """
    _need("plot_approaches", approaches)
    rows = -(-len(approaches) // 2)
    with mpl.rc_context(STYLE):
        figure = new_figure(13.0, 3.9 * rows + 0.5, title)
        parts = figure.subfigures(rows, 2, wspace=0.03, hspace=0.03, squeeze=False).ravel()
        for part, approach in zip(parts, approaches, strict=False):
            _draw_approach(part, approach)
        key: list[Artist] = []
        key += [Patch(fc=colour, ec="#999999", label=zone) for zone, colour in ZONES.items()]
        key += [Line2D([], [], color=INK, lw=1.6, label="distance to the nearest wall")]
        key += [Line2D([], [], color=MAP, lw=1.8, label="activity of all cells")]
        key += [Line2D([], [], color=LOOP, lw=1.3, ls="--", label="share of the cells that fire")]
        figure.legend(handles=key, loc="outside lower center", ncols=6)
    return figure


def _draw_approach(part: SubFigure, approach: Approach) -> None:
    axes = part.subplot_mosaic(
        [["path", "distance"], ["path", "activity"], ["path", "rates"]],
        width_ratios=[1.0, 1.5],
        height_ratios=[1.0, 1.0, 1.3],
    )
    time = approach.time_s
    draw_arena(axes["path"], approach.arena)
    axes["path"].annotate(
        "",
        approach.path_m[-1],
        approach.path_m[0],
        arrowprops={"arrowstyle": "-|>", "color": LOOP, "lw": 2.0, "shrinkA": 0, "shrinkB": 0},
    )
    start: dict[str, Any] = {"ls": "none", "marker": "o", "ms": 6, "mfc": "white"}
    axes["path"].plot(*approach.path_m[0], zorder=7, mec=INK, mew=1.2, **start)
    write_title(axes["distance"], approach.title)
    axes["distance"].plot(time, approach.distance_m, color=INK, lw=1.6)
    axes["distance"].set(ylabel="distance (m)", ylim=(0.0, 1.05 * approach.distance_m.max()))
    axes["activity"].plot(time, approach.activity, color=MAP, lw=1.8)
    axes["activity"].plot(time, approach.active, color=LOOP, lw=1.3, ls="--")
    axes["activity"].set(ylabel="activity\nor share", ylim=(0.0, 0.8))
    edges = np.flatnonzero(np.diff(approach.zone)) + 1
    borders = [0, *edges.tolist(), len(time) - 1]
    colours = list(ZONES.values())
    for ax in (axes["distance"], axes["activity"]):
        for a, b in pairwise(borders):
            ax.axvspan(time[a], time[b], color=colours[approach.zone[a]], lw=0, zorder=0)
        ax.set_xlim(time[0], time[-1])
        ax.tick_params(labelbottom=False)
    n = approach.rates.shape[1]
    # From -180 degrees, so that a wall straight ahead is in the middle.
    picture = axes["rates"].imshow(
        np.roll(approach.rates, n // 2, axis=1).T,
        ACTIVITY,
        origin="lower",
        aspect="auto",
        extent=(time[0], time[-1], -180.0 - 180.0 / n, 180.0 - 180.0 / n),
        vmin=0.0,
        vmax=1.0,
    )
    axes["rates"].set(xlabel="time (s)", ylabel="preferred\nbearing (°)", yticks=(-90, 0, 90))
    axes["rates"].grid(visible=False)
    bar = part.colorbar(picture, ax=axes["rates"], pad=0.02, ticks=(0, 0.5, 1))
    bar.set_label("rate (1 at most)")
    bar.outline.set_visible(False)


def plot_firing_maps(rows: Sequence[Sequence[Firing]], title: str, unit: str) -> Figure:
    """Draw rate maps in rows, all with one colour scale.

    Args:
        rows: Rows of equal length, each of one arena.
        title: Title of the whole figure.
        unit: Quantity and unit of the rates, for the colour bar.

    Raises:
        ValueError: If there is no map.
    """
    _need("plot_firing_maps", rows)
    top = max(float(np.nanmax(cell.rate_map)) for row in rows for cell in row) or 1.0
    with mpl.rc_context(STYLE):
        figure = new_figure(2.9 * len(rows[0]) + 1.0, 3.0 * len(rows) + 0.6, title)
        axes = figure.subplots(len(rows), len(rows[0]), squeeze=False)
        for row, line in zip(rows, axes, strict=True):
            for cell, ax in zip(row, line, strict=True):
                draw_rate_map(ax, cell.rate_map, cell.bins, cell.arena)
                ax.images[0].set_clim(0.0, top)
                write_title(ax, cell.title, cell.note)
        _tidy(axes)
        bar = figure.colorbar(axes[0, 0].images[0], ax=axes, shrink=0.5, pad=0.01)
        bar.set_label(unit)
        bar.outline.set_visible(False)
    return figure


def plot_firing(cells: Sequence[Firing], title: str) -> Figure:
    """Draw cells side by side: firing on the track, rate map, autocorrelogram.

    Args:
        cells: The cells.
        title: Title of the whole figure.

    Raises:
        ValueError: If there is no cell.
    """
    _need("plot_firing", cells)
    with mpl.rc_context(STYLE):
        figure = new_figure(3.1 * len(cells) + 0.9, 9.6, title)
        axes = figure.subplots(3, len(cells), squeeze=False)
        for cell, (places, rates, shifted) in zip(cells, axes.T, strict=True):
            places.plot(*cell.track_m.T, color=ODOMETRY, lw=0.4, alpha=0.7)
            places.plot(*cell.places_m.T, ls="none", marker=".", ms=2.5, mew=0, color=LOOP)
            draw_arena(places, cell.arena)
            places.grid(visible=False)
            write_title(places, cell.title)
            draw_rate_map(rates, cell.rate_map, cell.bins, cell.arena)
            draw_autocorrelogram(shifted, cell.rate_map, cell.bins.bin_m)
            write_title(rates, "Rate map")
            write_title(shifted, "Autocorrelogram", cell.note)
        _bars(figure, axes[1:2], axes[2:3])
        key = [Line2D([], [], color=ODOMETRY, lw=1.2, label="track")]
        dot: dict[str, Any] = {"ls": "none", "marker": "o", "ms": 4, "mew": 0, "color": LOOP}
        key.append(Line2D([], [], label="positions where the cell fires", **dot))
        figure.legend(handles=key, loc="outside lower center", ncols=2)
    return figure


def plot_grids(rows: Mapping[str, Sequence[Firing]], title: str) -> Figure:
    """Draw rate maps, each beside its autocorrelogram, a row for each method.

    Args:
        rows: Method -> a cell at some times.
        title: Title of the whole figure.

    Raises:
        ValueError: If there is no row.
    """
    _need("plot_grids", rows)
    n = max(map(len, rows.values()))
    with mpl.rc_context(STYLE):
        figure = new_figure(2.05 * 2 * n + 1.2, 2.15 * len(rows) + 1.0, title)
        axes = figure.subplots(len(rows), 2 * n, squeeze=False)
        for (method, cells), line in zip(rows.items(), axes, strict=True):
            for cell, ax, shifted in zip(cells, line[::2], line[1::2], strict=True):
                draw_rate_map(ax, cell.rate_map, cell.bins, cell.arena)
                draw_autocorrelogram(shifted, cell.rate_map, cell.bins.bin_m)
                write_title(ax, cell.title)
                shifted.set_title(cell.note, fontweight="normal", fontsize=8.5)
            line[0].set_ylabel(f"{method}\ny (m)")
        for line in axes[:-1]:
            for ax in line:
                ax.set_xlabel("")
                ax.tick_params(labelbottom=False)
        for ax in axes[:, 1:].ravel():
            ax.set_ylabel("")
            ax.tick_params(labelleft=False)
        for ax in axes[-1, 1::2]:
            ax.set_xlabel("shift (m)")
        _bars(figure, axes, axes)
    return figure


def plot_encounters(
    positions_m: np.ndarray,
    activity: np.ndarray,
    stops: Mapping[str, int],
    arena: Arena,
    title: str,
) -> Figure:
    """Draw the positions where boundary cells were active up to some times, a panel for each.

    Args:
        positions_m: Positions of the animal, ``(t, 2)``.
        activity: Activity of its boundary cells, ``(t,)``.
        stops: Title of a panel -> the step up to which it shows.
        arena: The arena.
        title: Title of the whole figure.

    Raises:
        ValueError: If there is no time.
    """
    _need("plot_encounters", stops)
    with mpl.rc_context(STYLE):
        figure, axes = _panels(len(stops), 5, (2.5, 2.75), (0.9, 0.5), title)
        style: dict[str, Any] = {"s": 3.0, "lw": 0, "cmap": ACTIVITY, "vmin": 0.0, "vmax": 1.0}
        for (name, stop), ax in zip(stops.items(), axes.ravel(), strict=False):
            path, active = positions_m[:stop], activity[:stop] > 0.0
            ax.plot(*path.T, color="#d5d5d5", lw=0.4, zorder=1)
            ax.scatter(*path[active].T, c=activity[:stop][active], zorder=2, **style)
            draw_arena(ax, arena)
            ax.grid(visible=False)
            write_title(ax, *name.split("|"))
        _tidy(axes)
        colours = ScalarMappable(Normalize(0.0, 1.0), ACTIVITY)
        bar = figure.colorbar(colours, ax=axes, shrink=0.5, pad=0.01)
        bar.set_label("activity of boundary cells (1 at most)")
        bar.outline.set_visible(False)
    return figure


def plot_scores(panels: Mapping[str, Mapping[str, Curve]], time_label: str, title: str) -> Figure:
    """Draw grid scores over time, a panel for each arena or spacing; one legend for all.

    Args:
        panels: Title of a panel -> name -> curve.
        time_label: Label of the horizontal axis, with its unit.
        title: Title of the whole figure.

    Raises:
        ValueError: If there is no panel.
    """
    _need("plot_scores", panels)
    with mpl.rc_context(STYLE):
        figure, axes = _panels(len(panels), 3, (3.7, 3.1), (0.4, 0.9), title, share=True)
        key: dict[str, Line2D] = {}
        style: dict[str, Any] = {"lw": 1.7, "marker": "o", "ms": 3.5}
        for (name, curves), ax in zip(panels.items(), axes.ravel(), strict=False):
            for label, (x, y, colour, dash, spread) in curves.items():
                style |= {"color": colour, "ls": dash}
                key[label] = ax.plot(x, y, label=label, **style)[0]
                if spread is not None:
                    ax.fill_between(x, y - spread, y + spread, color=colour, alpha=0.15, lw=0)
            ax.axhline(0.0, color="#999999", lw=0.8)
            ax.set_xlabel(time_label)
            ax.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 3, 5, 6, 10]))
            write_title(ax, name)
        for ax in axes[:, 0]:
            ax.set_ylabel("grid score (-2 to 2)")
        wide = axes.shape[1]
        columns = len(key) if len(key) < 2 * wide else wide + 1
        figure.legend(handles=list(key.values()), loc="outside lower center", ncols=columns)
    return figure


def _panels(
    n: int,
    most_columns: int,
    panel_in: tuple[float, float],
    around_in: tuple[float, float],
    title: str,
    share: bool = False,
) -> tuple[Figure, np.ndarray]:
    """Make a figure with ``n`` panels in rows; the rest of the last row stays empty."""
    columns = min(most_columns, n)
    lines = -(-n // columns)
    width, height = panel_in[0] * columns + around_in[0], panel_in[1] * lines + around_in[1]
    figure = new_figure(width, height, title)
    axes = figure.subplots(lines, columns, sharex=share, sharey=share, squeeze=False)
    for ax in axes.ravel()[n:]:
        ax.set_axis_off()
    return figure, axes


def _tidy(axes: np.ndarray) -> None:
    """Label the axes at the left and at the bottom only."""
    for ax in axes[:-1].ravel():
        ax.set_xlabel("")
    for ax in axes[:, 1:].ravel():
        ax.set_ylabel("")


def _bars(figure: Figure, maps: np.ndarray, shifted: np.ndarray) -> None:
    """Put colour bars at the right: one for the rate maps, one for the autocorrelograms."""
    rates = ScalarMappable(Normalize(0.0, 1.0), ACTIVITY)
    correlation = ScalarMappable(Normalize(-1.0, 1.0), _CORRELATION)
    shrink = 0.8 if maps is not shifted else 0.35
    for scale, axes, label in (
        (rates, maps, "rate / peak rate of the map"),
        (correlation, shifted, "correlation"),
    ):
        bar = figure.colorbar(scale, ax=axes, shrink=shrink, pad=0.012, aspect=18)
        bar.set_label(label)
        bar.outline.set_visible(False)


def _need(function: str, parts: Sequence[object] | Mapping[str, object]) -> None:
    if not len(parts):
        raise ValueError(f"{function}: got nothing to draw, expected at least one part")
