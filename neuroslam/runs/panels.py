"""TensorBoard panels of boundary, grid and place cells, as an animal's own brain has the world."""

from typing import TYPE_CHECKING

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from neuroslam.evaluation.gridness import autocorrelogram, gridness
from neuroslam.evaluation.ratemap import Bins, rate_map
from neuroslam.figures.places import plot_place_cells
from neuroslam.figures.style import ACTIVITY, STYLE, new_figure

if TYPE_CHECKING:
    from neuroslam.brain import NavigationBrain

_BINS_A_FIELD = 10  # in the smallest spacing: finer ones stay unvisited for long
_LEAST_SAMPLES = 200
_SHOWN = 4  # cells, of as many modules
_MOST_SAMPLES = 100_000


class CellPanels:
    """Collects what the cells of a brain did, and draws it.

    Positions are those that the brain believes: nobody else knows where it is. Of a long life every
    other sample is dropped whenever there are too many.

    Args:
        every: Frames between two samples.
    """

    def __init__(self, every: int = 2) -> None:
        self.every = every
        self._seen = 0
        self._positions: list[np.ndarray] = []
        self._rates: list[np.ndarray] = []
        self._boundary: list[float] = []

    def note(self, brain: "NavigationBrain") -> None:
        """Take a sample, where one is due."""
        self._seen += 1
        if self._seen % self.every:
            return
        cells = brain.navigation
        self._positions.append(cells.oscillators.position_m.numpy(force=True).copy())
        self._rates.append(cells.grid.rates.flatten().half().numpy(force=True))
        self._boundary.append(float(cells.boundary.rates.max()))
        if len(self._positions) > _MOST_SAMPLES:
            self.every *= 2
            for kept in (self._positions, self._rates, self._boundary):
                del kept[1::2]

    def scalars(self, brain: "NavigationBrain") -> dict[str, float]:
        """Return the figures of now, by tag."""
        cells = brain.navigation
        return {
            "cells/place_cells": float(cells.place.n_cells),
            "cells/walls": float(cells.walls.n_walls),
            "cells/activated_boundary_cells": float(cells.familiarity.n_activated()),
            "cells/boundary_activity": float(cells.boundary.activity),
            "cells/doubt_s": float(cells.familiarity.doubt_s),
        }

    def draw(self, brain: "NavigationBrain") -> tuple[dict[str, Figure], dict[str, float]]:
        """Draw all panels; returns them, and the grid scores of the modules, by tag."""
        path = np.array(self._positions).reshape(-1, 2)
        cells = brain.navigation
        figures = {"cells/place_map": plot_place_cells(*cells.remembered(), cells.pose, path)}
        scores: dict[str, float] = {}
        if len(self._positions) >= _LEAST_SAMPLES:
            at = np.array(self._positions)
            figures["cells/boundary_response"] = self._draw_boundary(at)
            figures["cells/grid_rate_maps"], scores = self._draw_grid(brain, at)
        return figures, scores

    def _draw_grid(
        self, brain: "NavigationBrain", at: np.ndarray
    ) -> tuple[Figure, dict[str, float]]:
        config = brain.config.grid_cells
        bins = Bins.around(at, min(config.spacings_m) / _BINS_A_FIELD)
        rates = np.array(self._rates, dtype=np.float64)
        maps = rate_map(at, rates, bins)
        score = gridness(maps).reshape(-1, config.n_cells)
        told = {
            f"gridness/spacing_{spacing:.2f}_m": float(np.median(row[np.isfinite(row)]))
            for spacing, row in zip(config.spacings_m, score, strict=True)
            if np.isfinite(row).any()
        }
        shown = range(min(_SHOWN, len(config.spacings_m)))
        with mpl.rc_context(STYLE):
            figure = new_figure(3.0 * len(shown) + 0.4, 6.2, "Grid cells: firing, and correlation")
            axes = figure.subplots(2, len(shown), squeeze=False)
            for module, (fires, shifted) in zip(shown, axes.T, strict=True):
                one = maps[module * config.n_cells]
                fires.imshow(one, ACTIVITY, origin="lower", extent=bins.extent_m, vmin=0.0)
                fires.set_title(f"spacing {config.spacings_m[module]:.2f} m")
                fires.set(xlabel="x (m)", ylabel="y (m)" if module == 0 else "")
                r = autocorrelogram(one)
                y, x = (bins.bin_m * n / 2.0 for n in r.shape)
                shifted.imshow(
                    r, "RdBu_r", origin="lower", extent=(-x, x, -y, y), vmin=-1.0, vmax=1.0
                )
                shifted.set_title(f"grid score {score[module, 0]:.2f}")
                shifted.set(xlabel="shift in x (m)", ylabel="shift in y (m)" if module == 0 else "")
                for ax in (fires, shifted):
                    ax.set_aspect("equal")
                    ax.grid(visible=False)
        return figure, told

    def _draw_boundary(self, at: np.ndarray) -> Figure:
        with mpl.rc_context(STYLE):
            figure = new_figure(6.0, 5.4, "Where boundary cells respond")
            axes = figure.subplots()
            order = np.argsort(self._boundary, kind="stable")
            dots = axes.scatter(
                *at[order].T, c=np.array(self._boundary)[order], s=4, lw=0, cmap=ACTIVITY, vmin=0.0
            )
            figure.colorbar(dots, ax=axes, label="rate of the most active cell")
            axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
        return figure
