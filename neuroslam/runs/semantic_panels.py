"""TensorBoard panels of SSP-SLAM: rates, rasters, gate, similarity, recall of the map."""

from collections import deque
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from neuroslam.figures.landmarks import Query, plot_queries
from neuroslam.figures.spikes import plot_rasters
from neuroslam.spiking.ensemble import NeuronArray
from neuroslam.spiking.semantic import SemanticCells
from neuroslam.spiking.slam import SSPSLAM, SSPStep
from neuroslam.worlds.landmarks import LandmarkWorld, point

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

_SHOWN = 100  # neurons per population
_QUERIED = 7  # landmarks
_RASTER_STEPS = 500
_GRID = 61
_MARGIN = 1.5  # drawn around landmarks and animal, in length scales


class SemanticPanels:
    """Writes the state of SSP-SLAM: a ``watch`` of :meth:`~neuroslam.spiking.slam.SSPSLAM.run`.

    Of a batch the first animal is shown. A caller with another clock uses :meth:`note` as the
    ``watch``, and calls :meth:`write_scalars` and :meth:`write_pictures` when they are due.

    Args:
        slam: The system to watch.
        writer: TensorBoard writer.
        world: World whose landmarks are queried and drawn; ``None``: no queries.
        every: Steps between two scalars; images have ten times this interval.
    """

    def __init__(
        self,
        slam: SSPSLAM,
        writer: "SummaryWriter",
        world: LandmarkWorld | None = None,
        every: int = 100,
    ) -> None:
        self.slam, self.writer, self.world, self.every = slam, writer, world, every
        self._last: SSPStep | None = None
        self._arrays = {
            name.removesuffix(".neurons"): part
            for name, part in slam.named_modules()
            if isinstance(part, NeuronArray)
        }
        self._fired = {name: deque[np.ndarray](maxlen=_RASTER_STEPS) for name in self._arrays}

    def __call__(self, step: int, result: SSPStep) -> None:
        """Note a step, and write what is due; steps count the animal's own time over all calls."""
        self.note(step, result)
        now = self._steps()
        if now % self.every == 0:
            self.write_scalars(now)
        if now % (10 * self.every) == 0:
            query = None if self.world is None else _query_of(self.slam, self.world)
            self.write_pictures(now, query)

    def note(self, _step: int, result: SSPStep) -> None:
        """Note a step without writing."""
        self._last = result
        for name, part in self._arrays.items():
            flat = part.spikes[:, 0].flatten()
            shown = flat[torch.linspace(0, len(flat) - 1, min(_SHOWN, len(flat))).long()]
            self._fired[name].append(shown.numpy(force=True))

    def write_scalars(self, at: int) -> None:
        """Write the scalars of the last step, and the mean rates; nothing before the first step.

        Args:
            at: Step of the event.
        """
        last = self._last
        if last is None:
            return
        values = {"recall": last.recall, "agreement": last.agreement, "gate": last.gate}
        for name, value in values.items():
            self.writer.add_scalar(f"ssp/{name}", float(value[0]), at)
        self.writer.add_scalar("ssp/lost", float(last.lost[0]), at)
        dt = self.slam.config.time_step_s
        for name, fired in self._fired.items():
            rates = np.mean(fired, axis=0) / dt
            self.writer.add_scalar(f"ssp_rate_hz/{name}", float(rates.mean()), at)
            self.writer.add_histogram(f"ssp_rates_hz/{name}", rates, at)

    def write_pictures(self, at: int, query: "LandmarkQuery | None" = None) -> None:
        """Draw the spikes of the last steps, and the recall of the map.

        Args:
            at: Step of the event.
            query: Landmarks to recall; ``None``: none.
        """
        dt = self.slam.config.time_step_s
        if self._last is not None and self._fired:
            shown = {name: np.stack(fired) > 0 for name, fired in self._fired.items()}
            steps = len(next(iter(shown.values())))
            start_s = (self._steps() - steps) * dt
            title = f"Spikes of the last {steps * dt:g} s"
            self.writer.add_figure("ssp/spikes", plot_rasters(shown, dt, start_s, title), at)
        if query is not None and self.slam.space.dimension == 2:
            with torch.inference_mode():
                self.writer.add_figure("ssp/map", _plot_recall(self.slam, query), at)

    def _steps(self) -> int:
        return round(float(self.slam.time_s) / self.slam.config.time_step_s)


class LandmarkQuery(NamedTuple):
    """Landmarks whose positions a map recalls.

    Attributes:
        world: World of the landmarks; similarities are drawn within its bounds.
        names: Names of landmarks.
        pointers: Their semantic pointers, ``(n, n_key)``.
    """

    world: LandmarkWorld
    names: Sequence[str]
    pointers: Tensor


def known_landmarks(cells: SemanticCells) -> LandmarkQuery:
    """Return the landmarks seen most often, at their recalled positions."""
    table = cells.landmarks()
    rows = np.flatnonzero(cells.known.confirmed().numpy(force=True))
    order = np.sort(np.argsort(-table["seen"], kind="stable")[:_QUERIED])
    names, positions = [str(name) for name in table["name"][order]], table["place_m"][order]
    around = np.vstack([positions, [cells.pose[:2]]])
    space = cells.slam.space
    margin = _MARGIN * float(space.length_scale_m.max())
    limits = space.bounds_m.numpy(force=True)
    low = np.maximum(around.min(0) - margin, limits[:, 0])
    high = np.minimum(around.max(0) + margin, limits[:, 1])
    landmarks = tuple(point(name, at) for name, at in zip(names, positions, strict=True))
    world = LandmarkWorld(landmarks, np.column_stack([low, high]), view_radius_m=0.0)
    return LandmarkQuery(world, names, cells.slam.pointers[torch.from_numpy(rows[order])])


def _query_of(slam: SSPSLAM, world: LandmarkWorld) -> LandmarkQuery:
    return LandmarkQuery(world, slam.names[:_QUERIED], slam.pointers[:_QUERIED])


def _plot_recall(slam: SSPSLAM, query: LandmarkQuery) -> Figure:
    (x0, x1), (y0, y1) = query.world.bounds_m
    x, y = torch.linspace(x0, x1, _GRID), torch.linspace(y0, y1, _GRID)
    at = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1).reshape(-1, 2)
    here = slam.space.similarity(slam.space.from_fourier(slam.integrator.z)[0], at)
    queries = [Query("the animal", here.reshape(_GRID, _GRID).numpy(force=True), [])]
    if query.names:
        phi = slam.map.read(query.pointers)[0]
        similarity = slam.space.similarity(phi, at).reshape(len(phi), _GRID, _GRID)
        queries += [
            Query(name, picture.numpy(force=True), [name])
            for name, picture in zip(query.names, similarity, strict=True)
        ]
    return plot_queries(
        query.world, None, queries, "Similarity of the estimated and of the recalled positions"
    )
