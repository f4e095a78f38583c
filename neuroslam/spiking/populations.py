"""Grid, place and object-vector cells: neurons whose encoders are spatial semantic pointers."""

from typing import cast

import numpy as np
import torch
from torch import Tensor

from neuroslam.config.semantic import NeuronConfig
from neuroslam.spiking.ensemble import (
    NeuronArray,
    filtered,
    lowpass,
    replace,
    sample_tuning,
    synapse,
    view,
)
from neuroslam.spiking.space import SSPSpace
from neuroslam.state.mergeable import BufferModule

_SOLVER_POINTS = 3000
TAU_S = 0.01
_INTERCEPTS = (0.1, 0.9)  # similarity to its preferred vector above which a cell fires


class VectorPopulation(BufferModule):
    r"""Represents an SSP by cells tuned to one each: ``φ(p)``, or its part in a module.

    .. math:: J_i = \alpha_i\, e_i \cdot \phi + \beta_i

    (Eq. 8). With encoders :math:`\phi(p)` cells are place cells, or of vectors to objects
    object-vector cells; with those of one module alone they are grid cells (Dumont and Eliasmith
    2020). Decoders are solved on the vectors that are met: points and boxes in the region, and
    nothing at all.

    State: the neurons' and ``decoded``.

    Args:
        encoders: As Fourier coefficients, complex, ``(neurons, n_frequencies)``.
        region_m: Bounds of the vectors, ``(dimension, 2)``.
        space: Of the vectors.
        config: Model of the neurons.
        time_step_s: Length of a step.
        draw: Of the neurons.
        batch: Animals side by side.
    """

    decoders: Tensor
    decoded: Tensor

    def __init__(
        self,
        encoders: Tensor,
        region_m: Tensor,
        space: SSPSpace,
        config: NeuronConfig,
        time_step_s: float,
        draw: torch.Generator,
        batch: int = 1,
    ) -> None:
        super().__init__()
        self.time_step_s = time_step_s
        config = config.model_copy(update={"intercept": _INTERCEPTS})
        # The dot product of two real vectors, in terms of their coefficients (Parseval), over what
        # it is at most: a module alone, too, fires at its highest rate where its waves meet.
        scale = 1.0 / (1.0 + 2.0 * encoders.abs().square().sum(-1, keepdim=True))
        weights = 2.0 * scale * torch.view_as_real(encoders).flatten(-2)
        n = len(encoders)
        tuning = sample_tuning(1, n, weights.shape[-1], config, draw, encoders=weights[None])
        tuning = tuning._replace(bias=tuning.bias + tuning.gain * scale.squeeze(-1))
        self.neurons = NeuronArray(tuning, config, time_step_s, draw, batch)
        points = _met(space, region_m, draw)
        decoders = self.neurons.solve(points.unsqueeze(0), points.unsqueeze(0), noise=0.05)[0]
        self.register_buffer("decoders", decoders / time_step_s)
        self.register_buffer("decoded", torch.zeros(batch, space.n_frequencies, 2))

    @classmethod
    def of_objects(
        cls,
        space: SSPSpace,
        neurons: int,
        config: NeuronConfig,
        time_step_s: float,
        seed: int = 0,
        batch: int = 1,
        reach_m: float = 0.3,
    ) -> "VectorPopulation":
        """Make object-vector cells: each fires for an object at its direction and distance.

        Args:
            space: Of the vectors.
            neurons: How many.
            config: Their model.
            time_step_s: Length of a step.
            seed: Of the neurons.
            batch: Animals side by side.
            reach_m: How far objects are seen.
        """
        draw = torch.Generator().manual_seed(seed)
        region = torch.tensor([[-reach_m, reach_m]]).expand(space.dimension, 2)
        encoders = space.encode_fourier(_uniform(region, neurons, draw)).detach()
        return cls(encoders, region, space, config, time_step_s, draw, batch)

    @classmethod
    def of_places(
        cls,
        space: SSPSpace,
        neurons: int,
        config: NeuronConfig,
        time_step_s: float,
        seed: int = 0,
        batch: int = 1,
    ) -> "VectorPopulation":
        """Make place cells: each fires at one position of the space; arguments as of the others."""
        draw = torch.Generator().manual_seed(seed)
        region = space.bounds_m.to(torch.get_default_dtype())
        encoders = space.encode_fourier(_uniform(region, neurons, draw)).detach()
        return cls(encoders, region, space, config, time_step_s, draw, batch)

    @classmethod
    def of_grid_cells(
        cls,
        space: SSPSpace,
        neurons: int,
        config: NeuronConfig,
        time_step_s: float,
        seed: int = 0,
        batch: int = 1,
    ) -> "VectorPopulation":
        """Make grid cells: each is tuned to the waves of one module; arguments as of the others."""
        draw = torch.Generator().manual_seed(seed)
        region = space.bounds_m.to(torch.get_default_dtype())
        modules = cast(Tensor, space.grid_modules)
        full = space.encode_fourier(_uniform(region, neurons, draw)).detach()
        own = torch.zeros(full.shape, dtype=torch.bool)
        own.scatter_(1, modules[torch.arange(neurons) % len(modules)], True)
        return cls(full * own, region, space, config, time_step_s, draw, batch)

    @property
    def n_neurons(self) -> int:
        """Number of neurons."""
        return self.neurons.n_neurons

    def forward(self, z: Tensor) -> Tensor:
        """Step with a vector; return the decoded vector, both complex, ``(batch, k)``."""
        if self.neurons.runs_compiled(z, self.decoded, self.decoders):
            parts = torch.view_as_real(z.resolve_conj()).to(self.decoded).contiguous()
            return torch.view_as_complex(torch.from_numpy(self.advance(parts.numpy())))
        spikes = self.neurons(torch.view_as_real(z).flatten(-2).unsqueeze(0))[0]
        said = (spikes @ self.decoders).reshape(self.decoded.shape)
        self.decoded = lowpass(self.decoded, said, synapse(TAU_S, self.time_step_s))
        return torch.view_as_complex(self.decoded)

    def advance(self, z: np.ndarray) -> np.ndarray:
        """Step as :meth:`forward` does, compiled; arrays ``(batch, n_frequencies, 2)``."""
        x = z.reshape(1, len(z), -1)
        said = self.neurons.respond(x, view(self, "decoders")[None]).reshape(z.shape)
        decoded = filtered(view(self, "decoded"), said, synapse(TAU_S, self.time_step_s))
        replace(self, decoded=decoded)
        return decoded


def _uniform(region_m: Tensor, n: int, draw: torch.Generator) -> Tensor:
    low, high = region_m.T
    return low + (high - low) * torch.rand(n, len(low), generator=draw)


def _met(space: SSPSpace, region_m: Tensor, draw: torch.Generator) -> Tensor:
    """Coefficients of points, boxes and of nothing, real and imaginary parts in a row."""
    points = space.encode_fourier(_uniform(region_m, _SOLVER_POINTS, draw)).detach()
    some = _SOLVER_POINTS // 6
    at, half = _uniform(region_m, some, draw), torch.rand(some, region_m.shape[0], generator=draw)
    half = half * (region_m[:, 1] - region_m[:, 0]) / 2
    boxes = space.region_fourier(at - half, at + half).detach()
    boxes = boxes / boxes.abs().square().mean(-1, keepdim=True).sqrt().clamp_min(1e-3)
    nothing = torch.zeros(some, space.n_frequencies, dtype=points.dtype)
    return torch.view_as_real(torch.cat([points, boxes, nothing])).flatten(-2)
