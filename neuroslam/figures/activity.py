"""Figures of what a population is doing now: a sheet of boundary cells, a bump of place cells."""

import math
from collections.abc import Mapping

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from neuroslam.errors import counted
from neuroslam.figures.style import (
    ACTIVITY,
    LOOP,
    STYLE,
    WALL,
    legend_below,
    new_figure,
    write_title,
)

_DEGREES = (0, 90, 180, 270, 360)


def plot_sheet(
    layers: Mapping[str, np.ndarray],
    bearings_rad: np.ndarray,
    distances_m: np.ndarray,
    walls: np.ndarray,
    title: str,
    bearing: str = "bearing",
) -> Figure:
    """Draw layers of a sheet of boundary cells by preferred bearing and distance, on one scale.

    Args:
        layers: Name -> activity, ``(n_bearings, n_distances)``, not negative.
        bearings_rad: Preferred bearings, equally spaced from 0, ``(n_bearings,)``.
        distances_m: Preferred distances, rising, ``(n_distances,)``.
        walls: Distance (m) and bearing (rad) of the walls there are, ``(n, 2)``: circles.
        title: Title of the figure.
        bearing: Label of the bearings.
    """
    step = 360.0 / len(bearings_rad)
    bearings = np.degrees(bearings_rad)
    middle = (distances_m[1:] + distances_m[:-1]) / 2.0
    edges = np.concatenate([[0.0], middle, [2.0 * distances_m[-1] - middle[-1]]])
    highest = max(float(layer.max()) for layer in layers.values()) or 1.0
    with mpl.rc_context(STYLE):
        figure = new_figure(3.0 * len(layers) + 0.9, 3.6, title)
        panels = figure.subplots(1, len(layers), sharey=True, squeeze=False)[0]
        for axes, (name, layer) in zip(panels, layers.items(), strict=True):
            shown = axes.pcolormesh(
                np.append(bearings - step / 2.0, 360.0 - step / 2.0), edges, layer.T,
                cmap=ACTIVITY, vmin=0.0, vmax=highest, rasterized=True,
            )  # fmt: skip
            if len(walls):
                at = (np.degrees(walls[:, 1]) + step / 2.0) % 360.0 - step / 2.0
                axes.plot(at, walls[:, 0], "o", ms=9, mfc="none", mec=LOOP, mew=1.6, clip_on=False)
            axes.set(xlabel=f"{bearing} (degrees)", xticks=_DEGREES)
            axes.set_xlim(-step / 2.0, 360.0 - step / 2.0)
            axes.grid(visible=False)
            write_title(axes, name)
        panels[0].set_ylabel("distance (m)")
        panels[0].set_ylim(0.0, edges[-1])
        figure.colorbar(shown, ax=panels, label="activity (arbitrary unit)")
        if len(walls):
            panels[0].plot([], [], "o", ms=7, mfc="none", mec=LOOP, mew=1.6, label="wall as read")
            figure.legend(loc="outside lower right")
    return figure


def plot_bump(
    centres_m: np.ndarray, bump: np.ndarray, position_m: np.ndarray, centre_m: np.ndarray
) -> Figure:
    """Draw the bump of place cells: each at its centre, coloured by its share.

    Args:
        centres_m: Centres of the place cells, ``(n, 2)``.
        bump: Share of each, sum 1, ``(n,)``.
        position_m: Estimated position of the animal, ``(2,)``: a cross.
        centre_m: Centre of mass of the bump, ``(2,)``: a ring.
    """
    active = bump > 0.0
    with mpl.rc_context(STYLE):
        figure = new_figure(6.4, 5.8, "Bump of the place cells")
        axes = figure.subplots()
        axes.scatter(*centres_m[~active].T, s=14, color=WALL, zorder=2, label="silent cell")
        order = np.argsort(bump[active], kind="stable")  # the most active one on top
        shown = axes.scatter(
            *centres_m[active][order].T, c=bump[active][order], s=42, cmap=ACTIVITY, vmin=0.0,
            zorder=3,
        )  # fmt: skip
        figure.colorbar(shown, ax=axes, label="share of the activity")
        axes.plot(
            *centre_m, "o", ms=15, mfc="none", mec=LOOP, mew=1.8, zorder=5, label="centre of mass"
        )
        axes.plot(*position_m, "+", ms=13, mec=LOOP, mew=1.8, zorder=5, label="estimated position")
        axes.set(xlabel="x (m)", ylabel="y (m)")
        axes.set_aspect("equal", adjustable="datalim")
        axes.margins(0.05)
        apart_m = math.dist(centre_m.tolist(), position_m.tolist())
        write_title(axes, f"{counted(int(active.sum()), 'cell')} active", f"{apart_m:.3f} m apart")
        legend_below(axes, columns=3)
    return figure
