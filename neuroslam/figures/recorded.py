"""Figures of recorded activity: each population's cells, and a raster of all of them.

A :class:`~neuroslam.state.activity.ActivityLog` in, a matplotlib ``Figure`` out;
:func:`neuroslam.figures.style.save` writes it.
"""

import math
import textwrap
from typing import Any, NamedTuple, cast

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.projections.polar import PolarAxes
from matplotlib.ticker import MaxNLocator

from neuroslam.errors import counted
from neuroslam.evaluation.directions import head_direction_tuning
from neuroslam.evaluation.gridness import MIN_SIDE_BINS, autocorrelogram, gridness
from neuroslam.evaluation.ratemap import Bins, RateMaps
from neuroslam.figures.style import ACTIVITY, INK, MAP, STYLE, new_figure, write_title
from neuroslam.state.activity import ActivityLog

_CORRELATION = "RdBu_r"
_BINS = 40  # along the longer side of a map, about
_HEADINGS, _SPEEDS = 36, 8
_COLUMNS, _ROWS = 1200, 160  # of a panel of the raster, at most
_PANELS = ("rate map", "autocorrelogram", "heading", "speed")


class CellMaps(NamedTuple):
    """Measures of some cells of a population.

    Attributes:
        bins: Bins of the maps.
        maps: Rate maps, ``(n, n_y, n_x)``; NaN where the animal never was.
        scores: Grid score of each, ``(n,)``; NaN where there is none.
        headings_rad: Centres of the heading bins, ``(k,)``.
        by_heading: Mean rate in each, ``(n, k)``.
        lengths: Mean vector lengths of those curves, ``(n,)``.
        speeds_m_s: Centres of the speed bins, ``(s,)``.
        by_speed: Mean rate in each, ``(n, s)``.
        speed_scores: Pearson's correlation of rate and speed, ``(n,)``.
    """

    bins: Bins
    maps: np.ndarray
    scores: np.ndarray
    headings_rad: np.ndarray
    by_heading: np.ndarray
    lengths: np.ndarray
    speeds_m_s: np.ndarray
    by_speed: np.ndarray
    speed_scores: np.ndarray


def chosen_cells(rates: np.ndarray, most: int) -> np.ndarray:
    """Choose cells evenly among those that were active, ``(n,)``.

    Example:
        >>> chosen_cells(np.array([[0.0, 1.0, 0.0, 2.0, 3.0]]), most=2).tolist()
        [1, 4]
    """
    active = np.flatnonzero(rates.max(axis=0, initial=0.0) > 0.0)
    if len(active) <= most:
        return active
    return active[np.linspace(0, len(active) - 1, most).round().astype(int)]


def measure_cells(log: ActivityLog, name: str, cells: np.ndarray) -> CellMaps:
    """Measure how some cells of a population respond to place, heading and speed.

    Samples without a position or heading are left out. Maps have about 40 bins along the longer
    side and are smoothed by 1.5 bins; gaps between visited bins of up to two bins are filled by
    that smoothing. Speeds above the 98th percentile are left out.

    Args:
        log: The record.
        name: Of the population.
        cells: Numbers of the cells, ``(n,)``.

    Raises:
        ConfigError: If there is no such population.
    """
    rates, at = log[name][:, cells].astype(np.float64), log.position_m
    there = np.isfinite(at).all(axis=1)
    at, placed = at[there], rates[there]
    span = float(np.ptp(at, axis=0).max()) if len(at) else 1.0
    bin_m = max(0.005 * math.ceil(span / _BINS / 0.005), 0.005)
    bins = Bins.around(at if len(at) else np.zeros((1, 2)), bin_m)
    gathered = RateMaps(bins, len(cells))
    gathered.add(at, placed)
    maps = gathered.maps(closing_bins=1)
    large = min(bins.shape) >= MIN_SIDE_BINS
    scores = gridness(maps) if large and len(cells) else np.full(len(cells), np.nan)
    turned = np.isfinite(log.heading_rad)
    tuned = head_direction_tuning(log.heading_rad[turned], rates[turned], _HEADINGS)
    speed = np.abs(log.speed_m_s.astype(np.float64))
    top = float(np.percentile(speed, 98)) if len(speed) else 0.0
    edges = np.linspace(0.0, top or 1.0, _SPEEDS + 1)
    column, usual = np.digitize(speed, edges[1:-1]), speed <= edges[-1]
    by_speed = np.stack([
        rates[usual & (column == k)].mean(axis=0) if (usual & (column == k)).any()
        else np.full(len(cells), np.nan)
        for k in range(_SPEEDS)
    ], axis=1)  # fmt: skip
    return CellMaps(
        bins, maps, scores, tuned.bins_rad, tuned.curves, tuned.length,
        0.5 * (edges[1:] + edges[:-1]), by_speed, _correlations(speed[usual], rates[usual]),
    )  # fmt: skip


def plot_population(log: ActivityLog, name: str, most: int = 6, note: str = "") -> Figure:
    """Draw cells of a population: rate map, autocorrelogram, tuning to heading and to speed.

    Each cell has its own colour scale and axes; cells are chosen evenly among the active ones.

    Args:
        log: The record.
        name: Of the population.
        most: Largest number of cells.
        note: Second line of the title: how the activity was obtained.

    Raises:
        ConfigError: If there is no such population.
        ValueError: If no cell was active.
    """
    rates = log[name]
    cells = chosen_cells(rates, most)
    if not len(cells):
        raise ValueError(f"plot_population: no cell of {name!r} was ever active; nothing to draw")
    measured = measure_cells(log, name, cells)
    n_active = int((rates.max(axis=0) > 0.0).sum())
    title = (
        f"{_plain(name)} cells: {len(cells)} of {counted(rates.shape[1], 'cell')}, "
        f"evenly chosen among the {n_active} active"
    )
    unit = _unit(log, name)
    with mpl.rc_context(STYLE):
        width_in, height_in = max(2.6 * len(cells) + 0.9, 6.0), 11.0
        lines = [
            *textwrap.wrap(title, int(8.5 * width_in)),
            *textwrap.wrap(note, int(10 * width_in)),
        ]
        figure = new_figure(width_in, height_in, None, constrained=False)
        figure.suptitle("\n".join(lines), fontsize=11, fontweight="bold", y=1.0 - 0.15 / height_in)
        figure.subplots_adjust(
            left=0.8 / width_in, right=1.0 - 0.25 / width_in, wspace=0.35,
            bottom=1.25 / height_in, top=1.0 - (0.65 + 0.2 * len(lines)) / height_in, hspace=0.8,
        )  # fmt: skip
        axes = np.array([
            [
                figure.add_subplot(
                    4, len(cells), row * len(cells) + k + 1,
                    projection="polar" if row == 2 else None,
                )
                for k in range(len(cells))
            ]
            for row in range(4)
        ])  # fmt: skip
        for k, cell in enumerate(cells.tolist()):
            write_title(axes[0, k], f"Cell {cell}\n", _tuned_to(log, name, cell))
            _draw_map(axes[0, k], measured, k)
            _draw_correlation(axes[1, k], measured, k)
            _draw_heading(axes[2, k], measured, k)
            _draw_speed(axes[3, k], measured, k)
        for ax in axes[[0, 1, 3], 1:].ravel():
            ax.set_ylabel("")
        axes[3, 0].set_ylabel(unit)
        figure.text(
            0.5, 0.12 / height_in,
            f"maps: from 0 (dark) to the peak of each cell (yellow), {unit}; white: never visited\n"
            "autocorrelograms: from -1 (blue) to 1 (red) · headings: the rim is the peak of the "
            "curve\nL: mean vector length · r: correlation with speed",
            fontsize=8, ha="center", va="bottom",
        )  # fmt: skip
    return figure


def plot_raster(log: ActivityLog, note: str = "") -> Figure:
    """Draw the activity of all cells of all populations over time, a panel for each.

    Cells are sorted by what they are tuned to, else by number. Each panel has its own colours,
    which end at the 99.5th percentile of the activity: a few strong samples do not hide the rest.

    Args:
        log: The record.
        note: Second line of the title.

    Raises:
        ValueError: If the record has no population with a cell, or no sample.
    """
    names = [name for name in log.names if log[name].size]
    if not names:
        raise ValueError("plot_raster: the record has no activity; nothing to draw")
    minutes = log.time_s[-1] - log.time_s[0] > 180.0
    time = (log.time_s - log.time_s[0]) / (60.0 if minutes else 1.0)
    title = f"Activity of all cells, {counted(log.n_samples, 'sample')}"
    with mpl.rc_context(STYLE):
        lines = [title, *textwrap.wrap(note, 90)]
        figure = new_figure(11.0, 1.75 * len(names) + 0.9, "\n".join(lines))
        panels = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
        for name, ax in zip(names, panels, strict=True):
            order, by = _order(log, name)
            table = log[name][:, order].T
            shown = _pooled(_pooled(table, _COLUMNS, axis=1), _ROWS, axis=0)
            some = table[table > 0.0]
            top = float(np.percentile(some, 99.5)) if len(some) else 1.0
            picture = ax.imshow(
                shown, ACTIVITY, origin="lower", aspect="auto", vmin=0.0, vmax=top,
                extent=(float(time[0]), float(time[-1]), 0.0, float(len(table))),
            )  # fmt: skip
            ax.set(ylabel="cell")
            ax.grid(visible=False)
            write_title(ax, f"{_plain(name)}: {counted(len(table), 'cell')}, sorted by {by}")
            bar = figure.colorbar(picture, ax=ax, pad=0.01, extend="max")
            bar.set_label(_unit(log, name))
            bar.outline.set_visible(False)
        panels[-1].set_xlabel("time (min)" if minutes else "time (s)")
    return figure


def _draw_map(axes: Axes, measured: CellMaps, k: int) -> None:
    shown = measured.maps[k]
    top = float(np.nanmax(shown)) if np.isfinite(shown).any() else 0.0
    axes.imshow(
        shown, ACTIVITY, origin="lower", extent=measured.bins.extent_m, vmin=0.0, vmax=top or 1.0
    )
    axes.set(xlabel=f"x (m)    peak {top:.2g}", ylabel="y (m)", aspect="equal")
    axes.xaxis.set_major_locator(MaxNLocator(3, steps=[1, 2, 5, 10]))
    axes.grid(visible=False)


def _draw_correlation(axes: Axes, measured: CellMaps, k: int) -> None:
    if min(measured.bins.shape) < MIN_SIDE_BINS:
        axes.set_axis_off()
        axes.text(0.5, 0.5, "map too narrow", ha="center", transform=axes.transAxes)
        return
    r, bin_m = autocorrelogram(measured.maps[k]), measured.bins.bin_m
    y, x = (bin_m * n / 2.0 for n in r.shape)
    axes.imshow(r, _CORRELATION, origin="lower", extent=(-x, x, -y, y), vmin=-1.0, vmax=1.0)
    axes.set(xlabel="shift in x (m)", ylabel="shift in y (m)", aspect="equal")
    axes.xaxis.set_major_locator(MaxNLocator(3, steps=[1, 2, 5, 10]))
    axes.grid(visible=False)
    score = measured.scores[k]
    write_title(axes, "", f"grid score {score:.2f}" if np.isfinite(score) else "no grid score")


def _draw_heading(axes: Axes, measured: CellMaps, k: int) -> None:
    polar, curve = cast(PolarAxes, axes), np.nan_to_num(measured.by_heading[k])
    angle = np.append(measured.headings_rad, measured.headings_rad[0])
    polar.plot(angle, np.append(curve, curve[0]), color=MAP, lw=1.4)
    polar.fill(angle, np.append(curve, curve[0]), color=MAP, alpha=0.2, lw=0)
    top = float(curve.max())
    polar.set_ylim(0.0, top or 1.0)
    polar.set_yticks([top or 1.0], [])
    polar.set_xticks(np.radians([0, 90, 180, 270]), ["0°", "90°", "180°", "270°"])
    length = measured.lengths[k]
    said = f"L {length:.2f}, peak {top:.2g}" if np.isfinite(length) else "silent"
    polar.set_title(said, loc="center", fontsize=8, fontweight="normal")


def _draw_speed(axes: Axes, measured: CellMaps, k: int) -> None:
    curve = measured.by_speed[k]
    axes.plot(measured.speeds_m_s, curve, color=MAP, marker="o", ms=3, lw=1.3)
    top = float(np.nanmax(curve)) if np.isfinite(curve).any() else 0.0
    axes.set(xlabel="speed (m/s)", ylim=(0.0, 1.15 * top or 1.0))
    axes.set_xlim(0.0, None)
    score = measured.speed_scores[k]
    write_title(axes, "", f"r {score:.2f}" if np.isfinite(score) else "")
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(colors=INK)


def _correlations(speed: np.ndarray, rates: np.ndarray) -> np.ndarray:
    off, each = speed - speed.mean() if len(speed) else speed, rates - rates.mean(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        r: np.ndarray = off @ each / np.sqrt((off**2).sum() * (each**2).sum(axis=0))
    return r


def _pooled(table: np.ndarray, most: int, axis: int) -> np.ndarray:
    """Take the largest value of equal parts along an axis, at most so many parts.

    Example:
        >>> _pooled(np.array([[1, 5, 2, 3]]), 2, axis=1).tolist()
        [[5, 3]]
    """
    n = table.shape[axis]
    if n <= most:
        return table
    return np.maximum.reduceat(table, np.arange(most) * n // most, axis=axis)


def _order(log: ActivityLog, name: str) -> tuple[np.ndarray, str]:
    """Return the order of the cells in a raster, and what it is by."""
    n = log[name].shape[1]
    for column, values in log.cells.get(name, {}).items():
        if len(values) == n and values.ndim == 1 and not column.startswith("centre"):
            return np.argsort(values, kind="stable"), _plain(_split(column)[0]).lower()
    return np.arange(n), "number"


def _tuned_to(log: ActivityLog, name: str, cell: int) -> str:
    """Describe what a cell is tuned to, from the properties that were recorded."""
    said = []
    for column, values in log.cells.get(name, {}).items():
        label, unit = _split(column)
        if cell >= len(values) or label.startswith("centre") or values.dtype.kind not in "fiu":
            continue
        value = float(values[cell])
        if unit == "rad":
            said.append(f"{math.degrees(value) % 360.0:.0f}°")
        elif unit == "m":
            said.append(f"{100.0 * value:.3g} cm")
        else:
            said.append(f"{value:.3g} {unit}")
    return ", ".join(said[:2])


def _split(column: str) -> tuple[str, str]:
    label, _, unit = column.rpartition("_")
    return (label, unit) if label else (column, "")


def _plain(name: str) -> str:
    return name.replace("_", " ").capitalize()


def _unit(log: ActivityLog, name: str) -> str:
    unit: Any = log.units[name]
    return "activity (arbitrary unit)" if unit == "1" else f"rate ({unit})"
