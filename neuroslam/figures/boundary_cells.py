"""Figure of boundary cells by preferred bearing and distance: which of them are active."""

from collections.abc import Sequence
from typing import NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from neuroslam.figures.style import ACTIVITY, LOOP, STYLE, new_figure, write_title


class ActiveCells(NamedTuple):
    """Boundary cells at some moments of a path.

    Attributes:
        title: Description of the path.
        moments: Title of each moment.
        rates: Rates then, ``(moments, n_bearings, n_distances)``, in [0, 1].
    """

    title: str
    moments: tuple[str, ...]
    rates: np.ndarray


def plot_active_cells(
    paths: Sequence[ActiveCells],
    bearings_rad: np.ndarray,
    distances_m: np.ndarray,
    fires: float,
    title: str,
) -> Figure:
    """Draw the cells of a population on rings of preferred distance, a column for each path.

    A cell is a field at its preferred bearing in the world, outwards with its preferred distance;
    cells that fire have an outline, and are counted.

    Args:
        paths: Cells at moments of paths; equally many of each.
        bearings_rad: Preferred bearings, ``(n_bearings,)``, evenly over the full turn.
        distances_m: Preferred distances, ``(n_distances,)``, evenly.
        fires: Rate above which a cell counts as firing.
        title: Title of the whole figure.

    Raises:
        ValueError: If there is no path.
    """
    if not paths:
        raise ValueError("plot_active_cells: expected at least one path")
    rows = len(paths[0].moments)
    half_rad, half_cm = np.pi / len(bearings_rad), 50.0 * float(distances_m[1] - distances_m[0])
    edges = (
        np.append(bearings_rad, bearings_rad[0] + 2.0 * np.pi) - half_rad,
        np.append(100.0 * distances_m - half_cm, 100.0 * distances_m[-1] + half_cm),
    )
    with mpl.rc_context(STYLE):
        figure = new_figure(2.1 * len(paths) + 1.0, 2.35 * rows + 0.6, title)
        axes = figure.subplots(rows, len(paths), squeeze=False, subplot_kw={"projection": "polar"})
        norm = Normalize(0.0, 1.0)
        for row, path in zip(axes.T, paths, strict=True):
            for ax, moment, rates in zip(row, path.moments, path.rates, strict=True):
                ax.pcolormesh(*edges, rates.T, cmap=ACTIVITY, norm=norm, ec="#dddddd", lw=0.2)
                k, d = np.nonzero(rates > fires)
                at = {"width": 2.0 * half_rad, "bottom": 100.0 * distances_m[d] - half_cm}
                ax.bar(bearings_rad[k], 2.0 * half_cm, **at, fc="none", ec=LOOP, lw=0.9)
                ax.set(yticks=100.0 * distances_m[[-1]], xticks=np.arange(4) * np.pi / 2)
                ax.set_yticklabels([f"{100.0 * distances_m[-1]:.0f} cm"], color="white", fontsize=7)
                ax.set_rlabel_position(225)
                ax.grid(visible=False)
                write_title(ax, f"{path.title}, {moment}", f"{int((rates > fires).sum())} fire")
        bar = ScalarMappable(norm, ACTIVITY)
        figure.colorbar(bar, ax=axes, shrink=0.5, label="rate (1 at most)")
    return figure
