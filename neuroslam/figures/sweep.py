"""The figure of a parameter sweep: errors and counts over the parameters varied."""

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, MaxNLocator, NullFormatter

from neuroslam.errors import counted
from neuroslam.figures.style import CURVES, ODOMETRY, STYLE, new_figure

_PANELS = {
    "ate_rmse_m": "absolute trajectory error (m)",
    "templates": "templates",
    "experiences": "experiences",
    "loop_closures": "loop closures",
    "place_cells": "place cells",
}
_DASHES = ("-", "--", ":", "-.")
_LOG_RATIO = 4.0  # largest value over the smallest from which the axis is logarithmic


def plot_sweep(rows: Sequence[Mapping[str, Any]], varied: Sequence[str]) -> Figure:
    """Draw errors and counts of runs over the first parameter varied; a line for each other value.

    Lines go through means over seeds, dots are single runs. Failed runs are left out.

    Args:
        rows: Rows of :func:`neuroslam.runs.sweep.sweep`.
        varied: Keys of the parameters varied, and ``source`` if sources were; without the seed.

    Raises:
        ValueError: If no run succeeded.
    """
    done = [row for row in rows if "experiences" in row]
    if not done:
        raise ValueError(f"plot_sweep: got {len(rows)} rows, expected one of a run that succeeded")
    keys = [key for key in varied if len({str(row[key]) for row in rows}) > 1]
    across = next((key for key in keys if key != "source"), "source")
    rest = [key for key in keys if key != across]
    places, labels = _places([row[across] for row in rows])
    lines: dict[str, list[Mapping[str, Any]]] = {}
    for row in done:
        lines.setdefault(", ".join(_named(key, row[key]) for key in rest), []).append(row)
    panels = [key for key in _PANELS if any(row.get(key) for row in done)] or ["experiences"]
    columns = 2 if len(panels) in (2, 4) else min(3, len(panels))
    down = -(-len(panels) // columns)
    title = f"{', '.join(keys) or 'seed'} varied: {counted(len(done), 'run')}"
    if len(done) < len(rows):
        title += f", {len(rows) - len(done)} failed"
    with mpl.rc_context(STYLE):
        wide = max(6.0, 4.4 * columns)
        figure = new_figure(wide, 3.0 * down + 0.9, title)
        every = figure.subplots(down, columns, squeeze=False).ravel()
        for axes, key in zip(every, panels, strict=False):
            if key == "ate_rmse_m":
                odometry = _Line(done, "odometry_ate_rmse_m", ODOMETRY, "-", 1.2, 0.0, 0.4)
                _draw(axes, odometry, across, places, labels is None)
            for number, group in enumerate(lines.values()):
                aside = (number + 1) / (len(lines) + 1) - 0.5
                colour, dash = _look(number)
                # Earlier lines are wider, so that lines of equal values stay visible.
                lw = 1.6 + 1.4 * min(4, len(lines) - 1 - number) * (labels is None)
                line = _Line(group, key, colour, dash, lw, aside, 0.35 / (len(lines) + 1))
                _draw(axes, line, across, places, labels is None)
            axes.set(
                ylabel=_PANELS[key], xlabel=across, ylim=(0.0, max(1.06 * axes.get_ylim()[1], 1e-3))
            )
            axes.yaxis.set_major_locator(MaxNLocator(6, integer=key != "ate_rmse_m"))
            _number(axes, places, labels)
        for axes in every[len(panels) :]:
            axes.set_axis_off()
        handles = _legend(list(lines), "ate_rmse_m" in panels)
        if len(handles) > 1:
            longest = max(0.075 * len(str(line.get_label())) + 0.6 for line in handles)
            ncols = max(1, min(len(handles), int(wide / longest)))
            figure.legend(handles=handles, loc="outside lower center", ncols=ncols)
            figure.set_figheight(figure.get_figheight() + 0.2 * -(-len(handles) // ncols))
    return figure


class _Line(NamedTuple):
    rows: Sequence[Mapping[str, Any]]
    key: str
    colour: str
    dash: str
    width: float
    aside: float  # offset from the position of a named value, from -0.5 to 0.5
    half: float  # half the width of the mean there


def _look(number: int) -> tuple[str, str]:
    return CURVES[number % len(CURVES)], _DASHES[number // len(CURVES) % len(_DASHES)]


def _places(values: Sequence[Any]) -> tuple[dict[str, float], list[str] | None]:
    """Return the position of each value on the axis, and labels where values are no numbers."""
    distinct = {str(value): value for value in values}
    numbers = [isinstance(v, int | float) and not isinstance(v, bool) for v in distinct.values()]
    if all(numbers):
        return {text: float(value) for text, value in distinct.items()}, None
    return {text: float(k) for k, text in enumerate(distinct)}, list(distinct)


def _number(axes: Axes, places: Mapping[str, float], labels: list[str] | None) -> None:
    if labels is not None:
        shown = [textwrap.shorten(Path(label).name, 60, placeholder=" …") for label in labels]
        shown = [textwrap.fill(label, 22, break_on_hyphens=False) for label in shown]
        crowded = max(map(len, shown)) * len(shown) > 40
        axes.set_xticks(range(len(shown)), shown, rotation=20 if crowded else 0,
                        ha="right" if crowded else "center")  # fmt: skip
        axes.set_xlim(-0.5, len(labels) - 0.5)
        return
    ticks = sorted(places.values())
    if ticks[0] > 0 and ticks[-1] / ticks[0] >= _LOG_RATIO:
        axes.set_xscale("log")
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.xaxis.set_minor_locator(FixedLocator([]))
    if len(ticks) <= 8:
        axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])


def _draw(axes: Axes, line: _Line, across: str, places: Mapping[str, float], numbers: bool) -> None:
    """Draw the mean at each value, joined where values are numbers, and a dot for each run."""
    found: dict[float, list[float]] = {}
    for row in line.rows:
        if line.key in row:
            found.setdefault(places[str(row[across])], []).append(row[line.key])
    where = sorted(found)
    means = [float(np.mean(found[x])) for x in where]
    look: dict[str, Any] = {"color": line.colour, "lw": line.width, "zorder": 3}
    if numbers:
        axes.plot(where, means, line.dash, **look)
    else:
        for x, mean in zip(where, means, strict=True):
            axes.plot(
                [x + line.aside - line.half, x + line.aside + line.half], [mean, mean], **look
            )
    aside = 0.0 if numbers else line.aside
    axes.plot(
        [x + aside for x in where for _ in found[x]], [y for x in where for y in found[x]],
        "o", color=line.colour, ms=3 + line.width, alpha=0.75, mew=0, zorder=3,
    )  # fmt: skip


def _legend(names: Sequence[str], odometry: bool) -> list[Line2D]:
    handles = []
    for number, name in enumerate(names):
        colour, dash = _look(number)
        label = textwrap.shorten(name or "map", 80, placeholder=" …")
        handles.append(Line2D([], [], color=colour, ls=dash, lw=1.8, marker="o", ms=4, label=label))
    if odometry:
        handles.append(Line2D([], [], color=ODOMETRY, marker="o", ms=4, label="odometry alone"))
    return handles


def _named(key: str, value: object) -> str:
    if key == "source":
        return Path(str(value)).name
    return f"{key.rpartition('.')[2].replace('_', ' ')} {value}"
