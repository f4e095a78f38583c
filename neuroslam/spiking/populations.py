"""Grid, place and object-vector cells, whose encoders are pointers; cells of the velocity."""

from typing import cast

import numpy as np
import torch
from torch import Tensor

from neuroslam.config.semantic import NeuronConfig
from neuroslam.spiking.ensemble import (
    NeuronArray,
    Stepper,
    filter_into,
    filtered,
    lowpass,
    may_share,
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
        step, keep = self.stepper()
        decoded = step(z)
        keep()
        return decoded

    def stepper(self) -> Stepper:
        """Return a function that steps as :meth:`advance` does, and one that keeps the state.

        The array that the first returns is changed by its next call.
        """
        answer = self.neurons.responder(view(self, "decoders")[None])
        decoded, kept = view(self, "decoded").copy(), synapse(TAU_S, self.time_step_s)
        flat, filter_ = decoded.reshape(-1), filter_into.dispatcher()

        def step(z: np.ndarray) -> np.ndarray:
            said = answer(z.reshape(1, len(z), -1), None)
            filter_(flat, said.reshape(-1), kept, flat)
            return decoded

        return step, lambda: replace(self, decoded=decoded)


class VelocityPopulation(BufferModule):
    r"""Represents the velocity by cells tuned to a direction and to speed along it.

    .. math:: J_i = \alpha_i\, e_i \cdot v / v_{max} + \beta_i, \qquad
              \hat v = \sum_i d_i\,(a_i * h), \qquad h(t) = e^{-t/\tau} / \tau

    (SSP-SLAM, Sect. 2.2.1; Eqs. 8 to 10; :math:`\tau` is 10 ms). Decoders are solved for
    velocities up to the highest speed; higher speeds are represented as less than they are.

    State: the neurons' and ``decoded``, m/s, ``(batch, dimension)``.

    Args:
        neurons: Number of cells.
        dimension: Of the velocity.
        max_speed_m_s: :math:`v_{max}`.
        config: Model of the neurons.
        time_step_s: Length of a step.
        seed: Of the neurons.
        batch: Animals side by side; they have the same network.
        decoder_noise: Noise for which the decoders are solved, as a share of the highest rate.

    Example:
        >>> cells = VelocityPopulation(300, 2, 0.5, NeuronConfig(model="lif_rate"), 1e-3)
        >>> for _ in range(100):
        ...     decoded = cells(torch.tensor([[0.3, -0.1]]))
        >>> [round(x, 2) for x in decoded[0].tolist()]
        [0.3, -0.1]
    """

    decoders: Tensor
    decoded: Tensor

    def __init__(
        self,
        neurons: int,
        dimension: int,
        max_speed_m_s: float,
        config: NeuronConfig,
        time_step_s: float,
        seed: int = 0,
        batch: int = 1,
        decoder_noise: float = 0.005,
    ) -> None:
        super().__init__()
        self.time_step_s = time_step_s
        draw = torch.Generator().manual_seed(seed)
        tuning = sample_tuning(1, neurons, dimension, config, draw, radius=max_speed_m_s)
        self.neurons = NeuronArray(tuning, config, time_step_s, draw, batch)
        # Uniform over the ball's volume, not over its radius.
        direction = torch.randn(1, _SOLVER_POINTS, dimension, generator=draw)
        direction = direction / direction.norm(dim=-1, keepdim=True)
        share = torch.rand(1, _SOLVER_POINTS, 1, generator=draw).pow(1.0 / dimension)
        velocity = max_speed_m_s * share * direction
        decoders = self.neurons.solve(velocity, velocity, decoder_noise)
        self.register_buffer("decoders", decoders / time_step_s)
        self.register_buffer("decoded", torch.zeros(batch, dimension))

    @property
    def n_neurons(self) -> int:
        """Number of neurons of one animal."""
        return self.neurons.n_neurons

    def runs_compiled(self, *tensors: Tensor) -> bool:
        """Return whether a compiled step may advance the cells and take these tensors."""
        return self.neurons.runs_compiled(*tensors) and may_share(self, "decoders", "decoded")

    def silence(self) -> None:
        """Forget the velocity that was decoded; the neurons' voltages are left as they are."""
        self.decoded = torch.zeros_like(self.decoded)

    def forward(self, velocity_m_s: Tensor) -> Tensor:
        """Step with a velocity; return the decoded velocity, both m/s, ``(batch, dimension)``."""
        if velocity_m_s.shape == self.decoded.shape and self.runs_compiled(velocity_m_s):
            velocity = velocity_m_s.to(self.decoded).contiguous()
            return torch.from_numpy(self.advance(velocity.numpy()))
        said = torch.bmm(self.neurons(velocity_m_s.to(self.decoded).unsqueeze(0)), self.decoders)[0]
        self.decoded = lowpass(self.decoded, said, synapse(TAU_S, self.time_step_s))
        return self.decoded

    def advance(self, velocity: np.ndarray) -> np.ndarray:
        """Step as :meth:`forward` does, compiled; arrays ``(batch, dimension)``."""
        said = self.neurons.respond(velocity[None], view(self, "decoders"))[0]
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
