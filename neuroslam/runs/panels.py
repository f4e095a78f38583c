"""TensorBoard panels that sample a population over time and draw the samples."""

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, cast

import matplotlib as mpl
import numpy as np
import torch
from matplotlib.figure import Figure

from neuroslam.cells.boundary_sheet import unwarp, warped_tuning
from neuroslam.cells.navigation import NavigationCells
from neuroslam.evaluation.gridness import MIN_SIDE_BINS, autocorrelogram, gridness
from neuroslam.evaluation.ratemap import Bins, rate_map
from neuroslam.figures.activity import plot_bump, plot_sheet
from neuroslam.figures.places import plot_place_cells
from neuroslam.figures.style import ACTIVITY, STYLE, new_figure, render
from neuroslam.runs.semantic_panels import SemanticPanels, known_landmarks
from neuroslam.spiking.semantic import SemanticCells
from neuroslam.state.population import Population
from neuroslam.types import Frame

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

_BINS_A_FIELD = 10  # of the smallest spacing: finer bins stay unvisited for long
_LEAST_SAMPLES = 200
_CELLS_SHOWN = 4  # one of each module
_MOST_SAMPLES = 100_000


class Panels(ABC):
    """Panels of one population, beyond its own scalars and images."""

    @abstractmethod
    def note(self, population: Population, frame: Frame) -> None:
        """Sample a frame; a brain that joins or starts a map replaces its populations."""

    @abstractmethod
    def write_scalars(self, frame: int) -> None:
        """Write curves."""

    @abstractmethod
    def write_figures(self, frame: int) -> None:
        """Write figures, whose cost grows with the length of a run."""

    @abstractmethod
    def close(self) -> None:
        """Stop watching."""


class NavigationPanels(Panels):
    """Draws rate maps of grid cells, boundary cells, and the map and the bump of place cells.

    Positions are those estimated by the brain. When a long run has too many samples, every other
    one is dropped.

    Args:
        writer: TensorBoard writer.
        every: Frames between two samples.
    """

    def __init__(self, writer: "SummaryWriter", every: int = 2) -> None:
        self.writer, self.every = writer, every
        self._cells: NavigationCells | None = None
        self._seen = 0
        self._positions: list[np.ndarray] = []
        self._rates: list[np.ndarray] = []
        self._boundary: list[float] = []
        self._felt: tuple[Frame, np.ndarray] | None = None  # the last walls, and the cells' rates

    def note(self, population: Population, frame: Frame) -> None:
        """Take a sample if one is due."""
        assert isinstance(population, NavigationCells)
        self._cells = population
        self._seen += 1
        scanned = population.sheet is not None and frame.ranges is not None
        if scanned or bool(population.boundary.activity > 0.0):
            self._felt = frame, population.boundary.rates.numpy(force=True).copy()
        if self._seen % self.every:
            return
        self._positions.append(population.oscillators.position_m.numpy(force=True).copy())
        self._rates.append(population.grid.rates.flatten().half().numpy(force=True))
        self._boundary.append(float(population.boundary.rates.max()))
        if len(self._positions) > _MOST_SAMPLES:
            self.every *= 2
            for kept in (self._positions, self._rates, self._boundary):
                del kept[1::2]

    def write_scalars(self, frame: int) -> None:
        """Write nothing: navigation cells have scalars of their own."""

    def write_figures(self, frame: int) -> None:
        """Draw all panels, and write the grid scores of the modules."""
        if self._cells is None:
            return
        figures, scores = self.draw(self._cells)
        for tag, drawn in figures.items():
            self.writer.add_image(tag, render(drawn), frame, dataformats="HWC")
        for tag, score in scores.items():
            self.writer.add_scalar(tag, score, frame)

    def close(self) -> None:
        """Do nothing: there is nothing to release."""

    def draw(self, cells: NavigationCells) -> tuple[dict[str, Figure], dict[str, float]]:
        """Return all figures, and the median grid score of each module, by tag."""
        path = np.array(self._positions).reshape(-1, 2)
        figures = {"cells/place_map": plot_place_cells(*cells.remembered(), cells.pose, path)}
        if int(cells.place.n_cells):
            figures["cells/place_bump"] = _draw_bump(cells)
        if self._felt is not None:
            figures["cells/boundary_cells"] = _draw_boundary_cells(cells, *self._felt)
        scores: dict[str, float] = {}
        if len(self._positions) >= _LEAST_SAMPLES:
            at = np.array(self._positions)
            figures["cells/boundary_response"] = self._draw_boundary(at)
            field_m = min(cells.config.grid_cells.spacings_m)
            bins = Bins.around(at, field_m / _BINS_A_FIELD)
            if min(bins.shape) >= MIN_SIDE_BINS:  # not a straight path
                figures["cells/grid_rate_maps"], scores = self._draw_grid(cells, at, bins)
        return figures, scores

    def _draw_grid(
        self, cells: NavigationCells, at: np.ndarray, bins: Bins
    ) -> tuple[Figure, dict[str, float]]:
        config = cells.config.grid_cells
        rates = np.array(self._rates, dtype=np.float64)
        maps = rate_map(at, rates, bins)
        score = gridness(maps).reshape(-1, config.n_cells)
        medians = {
            f"gridness/spacing_{spacing:.2f}_m": float(np.median(row[np.isfinite(row)]))
            for spacing, row in zip(config.spacings_m, score, strict=True)
            if np.isfinite(row).any()
        }
        shown = range(min(_CELLS_SHOWN, len(config.spacings_m)))
        with mpl.rc_context(STYLE):
            figure = new_figure(
                3.0 * len(shown) + 0.4, 6.2, "Grid cells: rate maps and autocorrelograms"
            )
            axes = figure.subplots(2, len(shown), squeeze=False)
            for module, (rate, correlation) in zip(shown, axes.T, strict=True):
                one = maps[module * config.n_cells]
                rate.imshow(one, ACTIVITY, origin="lower", extent=bins.extent_m, vmin=0.0)
                rate.set_title(f"spacing {config.spacings_m[module]:.2f} m")
                rate.set(xlabel="x (m)", ylabel="y (m)" if module == 0 else "")
                r = autocorrelogram(one)
                y, x = (bins.bin_m * n / 2.0 for n in r.shape)
                correlation.imshow(
                    r, "RdBu_r", origin="lower", extent=(-x, x, -y, y), vmin=-1.0, vmax=1.0
                )
                correlation.set_title(f"grid score {score[module, 0]:.2f}")
                correlation.set(
                    xlabel="shift in x (m)", ylabel="shift in y (m)" if module == 0 else ""
                )
                for ax in (rate, correlation):
                    ax.set_aspect("equal")
                    ax.grid(visible=False)
        return figure, medians

    def _draw_boundary(self, at: np.ndarray) -> Figure:
        with mpl.rc_context(STYLE):
            figure = new_figure(6.0, 5.4, "Rate of boundary cells by position")
            axes = figure.subplots()
            order = np.argsort(self._boundary, kind="stable")
            dots = axes.scatter(
                at[order, 0], at[order, 1], c=np.array(self._boundary)[order],
                s=4, lw=0, cmap=ACTIVITY, vmin=0.0,
            )  # fmt: skip
            figure.colorbar(dots, ax=axes, label="rate of the most active cell")
            axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
        return figure


def _draw_bump(cells: NavigationCells) -> Figure:
    position = cells.oscillators.position_m
    bump, centre = cells.place.bump(cells.grid.rates.flatten(-2), position)
    centres = cells.place.graph()[0]
    return plot_bump(*(part.numpy(force=True) for part in (centres, bump, position, centre)))


def _draw_boundary_cells(cells: NavigationCells, frame: Frame, rates: np.ndarray) -> Figure:
    """Draw the sheet, where it senses the walls, else the boundary cells of the paper."""
    sheet, title = cells.sheet, f"Boundary cells in frame {frame.index}"
    if sheet is None:
        axes = cells.boundary.preferred_rad, cells.boundary.preferred_m
        bearings, distances = (part.numpy(force=True) for part in axes)
        layers = {"rates": rates}
        return plot_sheet(layers, bearings, distances, np.empty((0, 2)), title, "bearing in world")
    with torch.inference_mode():
        if frame.walls is not None:
            felt = torch.from_numpy(np.asarray(frame.walls, dtype=np.float64)).reshape(-1, 2)
            axes = sheet.bearings_rad, sheet.warped_m
            tuned = warped_tuning(felt[:, 0], felt[:, 1], axes, sheet.config)
            clear = None
        else:
            tuned, clear = sheet.tuned_to_scan(cast(np.ndarray, frame.ranges)), sheet.clear_scan
        excitation, inhibition = sheet.interactions(tuned)
        response = sheet.interact(tuned)
        distance, bearing, _ = sheet.read(response, clear)
    layers = {
        "tuned to walls": tuned, "excitation": excitation, "inhibition": inhibition,
        "response": response,
    }  # fmt: skip
    inside = sheet.warped_m >= 0.0
    return plot_sheet(
        {name: layer[:, inside].numpy(force=True) for name, layer in layers.items()},
        sheet.bearings_rad.numpy(force=True),
        unwarp(sheet.warped_m[inside], sheet.config.beta_m).numpy(force=True),
        torch.stack([distance, bearing], dim=1).numpy(force=True),
        title,
        "bearing from heading",
    )


class LandmarkPanels(Panels):
    """Draws the recall of the semantic map and the spikes of SSP-SLAM.

    Args:
        writer: TensorBoard writer.
    """

    def __init__(self, writer: "SummaryWriter") -> None:
        self.writer = writer
        self._watched: tuple[SemanticCells, SemanticPanels] | None = None

    def note(self, population: Population, frame: Frame) -> None:
        """Watch the steps of SSP-SLAM of this population."""
        assert isinstance(population, SemanticCells)
        if self._watched is not None and self._watched[0] is population:
            return
        self.close()
        panels = SemanticPanels(population.slam, self.writer)
        population.watch = panels.note
        self._watched = population, panels

    def write_scalars(self, frame: int) -> None:
        """Write the scalars of the last step of SSP-SLAM."""
        if self._watched is not None:
            self._watched[1].write_scalars(frame)

    def write_figures(self, frame: int) -> None:
        """Draw the recall of the semantic map."""
        if self._watched is not None:
            cells, panels = self._watched
            panels.write_pictures(frame, known_landmarks(cells))

    def close(self) -> None:
        """Stop watching."""
        if self._watched is not None:
            self._watched[0].watch = None
            self._watched = None


PANELS: dict[str, type[NavigationPanels] | type[LandmarkPanels]] = {
    "place": NavigationPanels,
    "semantic": LandmarkPanels,
}
"""Panels of populations of the package; all others have their scalars and images only."""
