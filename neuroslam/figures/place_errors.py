"""Figures of place cells over time and parameters: numbers of cells, position errors, sweeps."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from neuroslam.errors import counted
from neuroslam.figures.style import CURVES, INK, LOOP, MAP, ODOMETRY, STYLE, new_figure, write_title

_MARK: dict[str, Any] = {"color": INK, "lw": 1.2, "ls": ":", "zorder": 4}

METHODS = {
    "SLRB": MAP,
    "competitive Hebb": LOOP,
    "RatSLAM": CURVES[2],
    "path integration": ODOMETRY,
}
"""Method -> its colour, the same in all figures."""


def colour_of(name: str) -> str:
    """Return the colour of a method, by the beginning of its name; other methods are pink.

    Example:
        >>> colour_of("SLRB, winner") == METHODS["SLRB"]
        True
    """
    return next((c for method, c in METHODS.items() if name.startswith(method)), CURVES[3])


class Spread(NamedTuple):
    """Values of repetitions over time, ``(repetitions, n)``, at times in minutes, ``(n,)``."""

    minutes: np.ndarray
    values: np.ndarray


def plot_growth(
    cells: Mapping[str, Spread],
    errors_m: Mapping[str, Spread],
    marks_m: Mapping[str, float] | None = None,
    title: str | None = None,
) -> Figure:
    """Draw numbers of place cells, and errors of position, over time.

    A line is the mean over repetitions, the band one standard deviation to each side.

    Args:
        cells: Method -> numbers of place cells.
        errors_m: Method -> errors in metres.
        marks_m: Name -> error of a reference: a dotted line.
        title: Title of the whole figure.

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
        left.set(ylabel="number of place cells")
        right.set(ylabel="position error (cm)")
        n = len(next(iter(cells.values())).values)
        write_title(left, "Place cells recruited", f"mean and sd of {counted(n, 'seed')}")
        write_title(right, "Position error", "mean and sd, not aligned")
        names = list(dict.fromkeys([*cells, *errors_m]))
        key = [Line2D([], [], label=name, **_line(name)) for name in names]
        key += _marks(marks_m)
        figure.legend(handles=key, loc="outside lower center", ncols=len(key))
    return figure


def plot_errors(
    errors_m: Mapping[str, Mapping[str, np.ndarray]],
    marks_m: Mapping[str, float] | None = None,
    title: str | None = None,
    colours: Mapping[str, str] | None = None,
) -> Figure:
    """Draw the errors of several methods on several tracks as bars.

    Args:
        errors_m: Method -> track -> errors in metres, one for each seed; bars have mean and sd.
        marks_m: Name -> error of a reference: a dotted line.
        title: Title of the whole figure.
        colours: Method -> colour; :func:`colour_of` if not given.

    Raises:
        ValueError: If there are no errors.
    """
    if not errors_m:
        raise ValueError("plot_errors: expected at least one method")
    tracks = list(dict.fromkeys(track for values in errors_m.values() for track in values))
    wide = 0.8 / len(errors_m)
    chosen = colours or {method: colour_of(method) for method in errors_m}
    with mpl.rc_context(STYLE):
        figure = new_figure(max(7.0, 1.8 * len(tracks) + 1.5), 4.2, title)
        axes = figure.subplots()
        for number, (method, values) in enumerate(errors_m.items()):
            at = [tracks.index(track) + (number + 0.5) * wide - 0.4 for track in values]
            mean = [100.0 * np.mean(seeds) for seeds in values.values()]
            sd = [100.0 * np.std(seeds) for seeds in values.values()]
            look: dict[str, Any] = {"ecolor": INK, "error_kw": {"lw": 1.0}, "capsize": 2}
            look["zorder"] = 3
            axes.bar(at, mean, 0.92 * wide, yerr=sd, color=chosen[method], label=method, **look)
        for mark in (marks_m or {}).values():
            axes.axhline(100.0 * mark, **_MARK)
        axes.set_xticks(range(len(tracks)), tracks)
        axes.grid(visible=False, axis="x")
        axes.set(ylabel="mean position error (cm)")
        write_title(axes, "Position error, not aligned", "bars: mean over seeds; whiskers: sd")
        key: list[Artist] = [Patch(color=chosen[method], label=method) for method in errors_m]
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
    """Draw errors as boxes over the least distance between place cells, and numbers of cells.

    A box spans the quartiles, its line is the median, its dot the mean; whiskers go from 5 to 95 %.

    Args:
        thresholds_m: Least distances between place cells.
        winner_m: For each, the distances from the winning cell's centre to the truth.
        integrator_m: For each, the distances from the integrated position to the truth.
        cells: For each, the number of place cells of each seed.
        title: Title of the whole figure.

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
        left.set(ylabel="position error (cm)")
        left.set_ylim(bottom=0)
        write_title(left, "Position error", "box: quartiles; whiskers: 5 and 95 %; dot: mean")
        mean, sd = [np.mean(n) for n in cells], [np.std(n) for n in cells]
        right.bar(at, mean, 0.6, yerr=sd, color=MAP, capsize=2, error_kw={"lw": 1.0}, zorder=3)
        right.set_xticks(at, names)
        right.set(ylabel="number of place cells at the end")
        write_title(right, "Place cells", f"mean and sd of {counted(len(cells[0]), 'seed')}")
        for axes in (left, right):
            axes.grid(visible=False, axis="x")
            axes.set(xlabel="least distance between place cells (cm)")
        key = [Patch(fc=colour, alpha=0.55, ec=INK, label=name) for name, _, colour in kinds]
        figure.legend(handles=key, loc="outside lower center", ncols=2)
    return figure


def draw_band(axes: Axes, at: np.ndarray, values: np.ndarray, name: str) -> None:
    """Draw the mean of ``(repetitions, n)`` as a line, and one standard deviation as a band."""
    mean, sd = values.mean(axis=0), values.std(axis=0)
    axes.fill_between(at, mean - sd, mean + sd, color=colour_of(name), alpha=0.15, lw=0, zorder=2)
    axes.plot(at, mean, label=name, zorder=3, **_line(name))


def _line(name: str) -> dict[str, Any]:
    """Return the style of a method's line; RatSLAM's is dashed, as it may hide an equal one."""
    dash = (0, (4, 2)) if name.startswith("RatSLAM") else "-"
    return {"color": colour_of(name), "lw": 1.8, "ls": dash}


def _marks(marks_m: Mapping[str, float] | None) -> list[Line2D]:
    return [
        Line2D([], [], label=f"{name}: {100.0 * mark:.1f} cm", **_MARK)
        for name, mark in (marks_m or {}).items()
    ]
