"""Figures of methods side by side: their errors and costs, and their errors without a sensor."""

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from neuroslam.figures.style import (
    CURVES,
    INK,
    MAP,
    ODOMETRY,
    ROBOT,
    STYLE,
    legend_below,
    new_figure,
    write_decimals,
)

_LEAST_M = 0.01


def plot_comparison(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw the errors of methods, a panel for each world, and their CPU time.

    Args:
        rows: Rows of :func:`neuroslam.experiments.compare.compare`.
    """
    worlds = list(dict.fromkeys(row["world"] for row in rows))
    methods = list(dict.fromkeys(row["method"] for row in rows))[::-1]
    with mpl.rc_context(STYLE):
        title = "Accuracy of all methods on the same drives: the full brain and its parts"
        figure = new_figure(4.2 * (len(worlds) + 1), 0.42 * len(methods) + 1.8, title)
        axes = figure.subplots(1, len(worlds) + 1, sharey=True)
        for ax, world in zip(axes, worlds, strict=False):
            mine = {row["method"]: row for row in rows if row["world"] == world}
            for k, method in enumerate(methods):
                if method not in mine:
                    continue
                row = mine[method]
                colour = ROBOT if method == "full" else ODOMETRY if k == len(methods) - 1 else MAP
                ax.barh(k, row["ate_m"], color=colour, height=0.62, zorder=2)
                ax.plot(
                    row["ate_each_m"], [k] * len(row["ate_each_m"]), "o", ms=4, mfc="white",
                    mec=INK, zorder=3,
                )  # fmt: skip
                ax.annotate(
                    f"{row['ate_m']:.2f}", (max(row["ate_each_m"]), k), xytext=(6, 0),
                    textcoords="offset points", va="center", fontsize=8,
                )  # fmt: skip
            _logarithmic(ax)
            ax.set_xlabel("ATE, rigid alignment (m, RMSE)")
            ax.set_title(world)
        cost = axes[-1]
        for k, method in enumerate(methods):
            each = [row["cpu_ms"] for row in rows if row["method"] == method and "cpu_ms" in row]
            if each:
                cost.barh(k, np.mean(each), color=ROBOT if method == "full" else MAP, height=0.62)
                cost.annotate(
                    f"{np.mean(each):.2g}", (np.mean(each), k), xytext=(4, 0),
                    textcoords="offset points", va="center", fontsize=8,
                )  # fmt: skip
        _logarithmic(cost)
        cost.set_xlabel("CPU time per frame (ms)")
        cost.set_title("CPU time")
        axes[0].set_yticks(range(len(methods)), methods)
        figure.supxlabel("bars: mean over drives; circles: each drive", fontsize=8)
    return figure


def plot_without(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw errors of the full brain and of the same with something less, a panel for each world.

    Args:
        rows: Of :func:`neuroslam.experiments.populations.populations`.
    """
    worlds = list(dict.fromkeys(row["world"] for row in rows))
    names = list(dict.fromkeys(row["without"] for row in rows))[::-1]
    with mpl.rc_context(STYLE):
        title = "The full brain, and what it loses without a part"
        figure = new_figure(4.2 * len(worlds) + 1.8, 0.36 * len(names) + 1.6, title)
        axes = figure.subplots(1, len(worlds), sharex=True, sharey=True, squeeze=False)[0]
        for ax, world in zip(axes, worlds, strict=True):
            mine = [row for row in rows if row["world"] == world]
            for row in mine:
                k, each = names.index(row["without"]), row["ate_each_m"]
                ax.barh(k, row["ate_m"], color=MAP if k < len(names) - 1 else ROBOT, height=0.62)
                ax.plot(each, [k] * len(each), "o", ms=4, mfc="white", mec=INK, zorder=3)
                ax.annotate(
                    f"{row['ate_m']:.2f}", (max(*each, mine[0]["ate_m"]), k), xytext=(6, 0),
                    textcoords="offset points", va="center", fontsize=8,
                )  # fmt: skip
            ax.axvline(mine[0]["ate_m"], color=ROBOT, lw=1.0, ls="--", zorder=1)
            ax.set_xlim(0.0, 1.15 * max(max(row["ate_each_m"]) for row in rows))
            ax.set_xlabel("absolute trajectory error (m)")
            ax.set_title(world)
        axes[0].set_yticks(range(len(names)), names)
        figure.supxlabel("bars: mean over drives; circles: each drive", fontsize=8)
    return figure


def _logarithmic(ax: Axes) -> None:
    """Make the axis logarithmic with few, plain numbers, and leave room for labels of bars."""
    ax.set_xscale("log")
    low, high = ax.get_xlim()
    ax.set_xlim(low / 1.2, high * 1.7)
    ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
    ax.xaxis.set_major_formatter("{x:g}")
    ax.xaxis.set_minor_formatter(NullFormatter())


def plot_losses(
    curves: Mapping[str, Mapping[str, np.ndarray]],
    options: Mapping[str, str],
    frame_rate_hz: float = 10.0,
) -> Figure:
    """Draw the error over time, a panel for each sensor that fails for a while.

    Args:
        curves: Error (m) of each frame, by sensor and by method.
        options: Options of the world for each sensor; their times are shaded.
        frame_rate_hz: Frame rate.
    """
    with mpl.rc_context(STYLE):
        title = "Failure of a sensor: error on the final map after rigid alignment to the truth"
        figure = new_figure(9.0, 1.75 * len(curves) + 1.0, title)
        axes = figure.subplots(len(curves), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
        for ax, (loss, each) in zip(axes, curves.items(), strict=True):
            for k, (method, error) in enumerate(each.items()):
                full = method == "full"
                ax.plot(
                    np.arange(len(error)) / frame_rate_hz, np.maximum(error, _LEAST_M),
                    color=ROBOT if full else CURVES[(0, 2, 3)[k % 3]], lw=1.8 if full else 1.0,
                    zorder=4 if full else 3, label=method,
                )  # fmt: skip
            _shade(ax, options[loss])
            ax.set_yscale("log")
            ax.set_ylabel("error (m)")
            ax.set_title(loss)
        write_decimals(axes[-1].yaxis)
        axes[-1].set_xlabel("time (s)")
        legend_below(axes[-1], len(next(iter(curves.values()))))
    return figure


def _shade(ax: Axes, option: str) -> None:
    """Mark the time during which a sensor fails, or when the robot is kidnapped."""
    _, _, when = option.partition("=")
    if ":" in when:
        ax.axvline(float(when.split(":")[0]), color=INK, lw=1.0, ls="--", zorder=1)
    elif when:
        begin, end = map(float, when.split("-"))
        ax.axvspan(begin, end, color="0.9", zorder=0)
