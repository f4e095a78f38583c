"""TensorBoard panels of SSP-SLAM: rates, rasters, gate, similarity, answers of the map."""

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

_SHOWN = 100  # neurons of a population
_ASKED = 7  # landmarks that the map is asked for
_RASTER_STEPS = 500
_GRID = 61
_MARGIN = 1.5  # of what is drawn around landmarks and animal, in length scales


class SemanticPanels:
    """Writes what SSP-SLAM does, as the ``watch`` of :meth:`~neuroslam.spiking.slam.SSPSLAM.run`.

    Of a batch the first animal is shown. Whoever counts time otherwise takes :meth:`note` as the
    ``watch``, and calls :meth:`write_scalars` and :meth:`write_pictures` when they are due.

    Args:
        slam: Whose steps they are.
        writer: To write to.
        world: Its landmarks are drawn beside the answers; ``None``: no answers.
        every: Steps between two scalars; pictures are ten times as rare.
    """

    def __init__(
        self,
        slam: SSPSLAM,
        writer: "SummaryWriter",
        world: LandmarkWorld | None = None,
        every: int = 100,
    ) -> None:
        self.slam, self.writer, self.world, self.every = slam, writer, world, every
        self._said: SSPStep | None = None
        self._arrays = {
            name.removesuffix(".neurons"): part
            for name, part in slam.named_modules()
            if isinstance(part, NeuronArray)
        }
        self._fired = {name: deque[np.ndarray](maxlen=_RASTER_STEPS) for name in self._arrays}

    def __call__(self, step: int, said: SSPStep) -> None:
        """Take a step; its time is the animal's own, so that a life that goes on is one curve."""
        self.note(step, said)
        now = self._steps()
        if now % self.every == 0:
            self.write_scalars(now)
        if now % (10 * self.every) == 0:
            known = None if self.world is None else _known_of(self.slam, self.world)
            self.write_pictures(now, known)

    def note(self, _step: int, said: SSPStep) -> None:
        """Take a step, and write nothing."""
        self._said = said
        for name, part in self._arrays.items():
            flat = part.spikes[:, 0].flatten()
            some = flat[torch.linspace(0, len(flat) - 1, min(_SHOWN, len(flat))).long()]
            self._fired[name].append(some.numpy(force=True))

    def write_scalars(self, at: int) -> None:
        """Write what the last step said, and the rates of the last steps; nothing before the first.

        Args:
            at: Step that TensorBoard shows them at.
        """
        said = self._said
        if said is None:
            return
        values = {"recall": said.recall, "agreement": said.agreement, "gate": said.gate}
        for name, value in values.items():
            self.writer.add_scalar(f"ssp/{name}", float(value[0]), at)
        self.writer.add_scalar("ssp/lost", float(said.lost[0]), at)
        dt = self.slam.config.time_step_s
        for name, fired in self._fired.items():
            rates = np.mean(fired, axis=0) / dt
            self.writer.add_scalar(f"ssp_rate_hz/{name}", float(rates.mean()), at)
            self.writer.add_histogram(f"ssp_rates_hz/{name}", rates, at)

    def write_pictures(self, at: int, known: "Known | None" = None) -> None:
        """Draw the spikes of the last steps, and what the map recalls.

        Args:
            at: Step that TensorBoard shows them at.
            known: What the map is asked for; ``None``: nothing.
        """
        dt = self.slam.config.time_step_s
        if self._said is not None and self._fired:
            shown = {name: np.stack(fired) > 0 for name, fired in self._fired.items()}
            steps = len(next(iter(shown.values())))
            start_s = (self._steps() - steps) * dt
            title = f"Spikes of the last {steps * dt:g} s"
            self.writer.add_figure("ssp/spikes", plot_rasters(shown, dt, start_s, title), at)
        if known is not None and self.slam.space.dimension == 2:
            with torch.inference_mode():
                self.writer.add_figure("ssp/map", _answers(self.slam, known), at)

    def _steps(self) -> int:
        return round(float(self.slam.time_s) / self.slam.config.time_step_s)


class Known(NamedTuple):
    """What a map is asked for.

    Attributes:
        world: Its landmarks are drawn, and the similarities within its bounds.
        names: Of landmarks in it.
        pointers: Of the same, ``(n, n_key)``.
    """

    world: LandmarkWorld
    names: Sequence[str]
    pointers: Tensor


def known_landmarks(cells: SemanticCells) -> Known:
    """Return the landmarks that cells have seen most often, where they recall them to be."""
    table = cells.landmarks()
    rows = np.flatnonzero(cells.known.confirmed().numpy(force=True))
    order = np.sort(np.argsort(-table["seen"], kind="stable")[:_ASKED])
    names, places = [str(name) for name in table["name"][order]], table["place_m"][order]
    around = np.vstack([places, [cells.pose[:2]]])
    space = cells.slam.space
    margin = _MARGIN * float(space.length_scale_m.max())
    limits = space.bounds_m.numpy(force=True)
    low = np.maximum(around.min(0) - margin, limits[:, 0])
    high = np.minimum(around.max(0) + margin, limits[:, 1])
    landmarks = tuple(point(name, place) for name, place in zip(names, places, strict=True))
    world = LandmarkWorld(landmarks, np.column_stack([low, high]), view_radius_m=0.0)
    return Known(world, names, cells.slam.pointers[torch.from_numpy(rows[order])])


def _known_of(slam: SSPSLAM, world: LandmarkWorld) -> Known:
    return Known(world, slam.names[:_ASKED], slam.pointers[:_ASKED])


def _answers(slam: SSPSLAM, known: Known) -> Figure:
    (x0, x1), (y0, y1) = known.world.bounds_m
    x, y = torch.linspace(x0, x1, _GRID), torch.linspace(y0, y1, _GRID)
    at = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1).reshape(-1, 2)
    now_at = slam.space.similarity(slam.space.from_fourier(slam.integrator.z)[0], at)
    queries = [Query("the animal", now_at.reshape(_GRID, _GRID).numpy(force=True), [])]
    if known.names:
        phi = slam.map.read(known.pointers)[0]
        alike = slam.space.similarity(phi, at).reshape(len(phi), _GRID, _GRID)
        queries += [
            Query(name, picture.numpy(force=True), [name])
            for name, picture in zip(known.names, alike, strict=True)
        ]
    return plot_queries(known.world, None, queries, "What the map recalls now")
