"""TensorBoard panels of SSP-SLAM: rates, rasters, gate, similarity, answers of the map."""

from collections import deque
from typing import TYPE_CHECKING

import numpy as np
import torch

from neuroslam.figures.landmarks import Query, plot_queries
from neuroslam.figures.spikes import plot_rasters
from neuroslam.spiking.ensemble import NeuronArray
from neuroslam.spiking.slam import SSPSLAM, SSPStep
from neuroslam.worlds.landmarks import LandmarkWorld

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

_SHOWN = 100  # neurons of a population
_RASTER_STEPS = 500
_GRID = 61


class SemanticPanels:
    """Writes what SSP-SLAM does, as the ``watch`` of :meth:`~neuroslam.spiking.slam.SSPSLAM.run`.

    Of a batch the first animal is shown.

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
        self._fired: dict[str, deque[np.ndarray]] = {}
        for name, part in slam.named_modules():
            if isinstance(part, NeuronArray):
                self._fired[name.removesuffix(".neurons")] = deque(maxlen=_RASTER_STEPS)

    def __call__(self, _step: int, said: SSPStep) -> None:
        """Take a step; its time is the animal's own, so that a life that goes on is one curve."""
        now = round(float(self.slam.time_s) / self.slam.config.time_step_s)
        for name, part in self.slam.named_modules():
            if isinstance(part, NeuronArray):
                flat = part.spikes[:, 0].flatten()
                some = flat[torch.linspace(0, len(flat) - 1, min(_SHOWN, len(flat))).long()]
                self._fired[name.removesuffix(".neurons")].append(some.numpy(force=True))
        if now % self.every == 0:
            self._scalars(said, now)
        if now % (10 * self.every) == 0:
            self._pictures(now)

    def _scalars(self, said: SSPStep, now: int) -> None:
        values = {"recall": said.recall, "agreement": said.agreement, "gate": said.gate}
        for name, value in values.items():
            self.writer.add_scalar(f"ssp/{name}", float(value[0]), now)
        self.writer.add_scalar("ssp/lost", float(said.lost[0]), now)
        dt = self.slam.config.time_step_s
        for name, fired in self._fired.items():
            rates = np.mean(fired, axis=0) / dt
            self.writer.add_scalar(f"ssp_rate_hz/{name}", float(rates.mean()), now)
            self.writer.add_histogram(f"ssp_rates_hz/{name}", rates, now)

    def _pictures(self, now: int) -> None:
        dt = self.slam.config.time_step_s
        if self._fired:
            shown = {name: np.stack(fired) > 0 for name, fired in self._fired.items()}
            steps = len(next(iter(shown.values())))
            figure = plot_rasters(shown, dt, (now - steps) * dt, "Spikes of the last half second")
            self.writer.add_figure("ssp/spikes", figure, now)
        if self.world is not None and self.slam.space.dimension == 2:
            with torch.inference_mode():
                self.writer.add_figure("ssp/map", self._answers(), now)

    def _answers(self) -> object:
        slam, world = self.slam, self.world
        (x0, x1), (y0, y1) = world.bounds_m
        x, y = torch.linspace(x0, x1, _GRID), torch.linspace(y0, y1, _GRID)
        at = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1).reshape(-1, 2)
        phi = slam.map.read(slam.pointers)[0]
        alike = slam.space.similarity(phi, at).reshape(len(phi), _GRID, _GRID)
        queries = [
            Query(name, picture.numpy(force=True), [name])
            for name, picture in zip(slam.names, alike, strict=True)
        ]
        now_at = slam.space.similarity(slam.space.from_fourier(slam.integrator.z)[0], at)
        now_at = Query("the animal", now_at.reshape(_GRID, _GRID).numpy(force=True), [])
        return plot_queries(world, None, [now_at, *queries[:7]], "What the map recalls now")
