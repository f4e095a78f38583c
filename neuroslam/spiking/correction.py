"""The gate in neurons: no function is computed outside of them, as on a chip."""

import torch
from torch import Tensor

from neuroslam.config.semantic import NeuronConfig
from neuroslam.spiking.binding import SpikingBinding
from neuroslam.spiking.ensemble import NeuronArray, lowpass, sample_tuning, synapse
from neuroslam.state.mergeable import BufferModule

_SOLVER_POINTS = 3000
_VETO_NEURONS = 50
_VETO = 25.0  # inhibition of the correction's neurons, more than any current
_TAU_S = 0.05
_OUT_S = 0.1  # noise of few neurons stays out of the path integrator


class SpikingCorrection(BufferModule):
    r"""Represents the disagreement of the map with the position, unless a population vetoes it.

    One population holds the difference of two vectors; another fires where their similarity is
    below the gate, or nothing is seen, and silences it (the variant for Loihi of the reference).
    The similarity is the sum of products in populations that square.

    State: that of the populations and their outputs, ``difference`` ``(batch,
    n_frequencies, 2)``, ``alike`` and ``veto`` ``(batch,)``.

    Args:
        n_frequencies: Of the vectors.
        neurons: Of the difference.
        products: Neurons of one product.
        gate: Similarity below which there is no correction.
        config: Model of the neurons.
        time_step_s: Length of a step.
        seed: Of the neurons.
        batch: Animals side by side.

    Example:
        >>> gate = SpikingCorrection(4, 400, 50, 0.2, NeuronConfig(), time_step_s=1e-3)
        >>> here, implied = torch.ones(1, 4) + 0j, torch.ones(1, 4) + 0.3j
        >>> for _ in range(500):
        ...     pull = gate(implied, here, torch.ones(1))
        >>> bool((pull - 0.3j).abs().mean() < 0.15)
        True
        >>> for _ in range(500):
        ...     pull = gate(implied, here, torch.zeros(1))
        >>> bool(pull.abs().max() < 0.02)
        True
    """

    difference: Tensor
    alike: Tensor
    veto: Tensor
    decoders: Tensor
    veto_decoders: Tensor

    def __init__(
        self,
        n_frequencies: int,
        neurons: int,
        products: int,
        gate: float,
        config: NeuronConfig,
        time_step_s: float,
        seed: int = 0,
        batch: int = 1,
    ) -> None:
        super().__init__()
        self.time_step_s = time_step_s
        draw = torch.Generator().manual_seed(seed)
        size = 2 * n_frequencies
        # Differences are as long as two vectors apart at most, whose parts are up to 1.
        radius = float(n_frequencies) ** 0.5
        tuning = sample_tuning(1, neurons, size, config, draw, radius)
        self.neurons = NeuronArray(tuning, config, time_step_s, draw, batch)
        points = torch.randn(1, _SOLVER_POINTS, size, generator=draw)
        share = torch.rand(1, _SOLVER_POINTS, 1, generator=draw)
        points = radius * share * points / points.norm(dim=-1, keepdim=True)
        decoders = self.neurons.solve(points, points) / time_step_s
        self.register_buffer("decoders", decoders)
        self.products = SpikingBinding(
            n_frequencies, products, config, time_step_s, seed + 1, batch
        )
        sparse = config.model_copy(update={"intercept": (1.0 - gate - 0.1, 1.0 - gate)})
        tuning = sample_tuning(1, _VETO_NEURONS, 1, sparse, draw)
        tuning = tuning._replace(encoders=torch.ones_like(tuning.encoders))
        self.objecting = NeuronArray(tuning, config, time_step_s, draw, batch)
        x = torch.linspace(-1.0, 2.0, 500).reshape(1, -1, 1)
        objects = (x > 1.0 - gate).to(x)
        decoders = self.objecting.solve(x, objects) / time_step_s
        self.register_buffer("veto_decoders", decoders)
        self.register_buffer("difference", torch.zeros(batch, n_frequencies, 2))
        self.register_buffer("alike", torch.zeros(batch))
        self.register_buffer("veto", torch.zeros(batch))

    @property
    def n_neurons(self) -> int:
        """Of one animal."""
        return self.neurons.n_neurons + self.products.n_neurons + self.objecting.n_neurons

    def forward(self, implied: Tensor, here: Tensor, seen: Tensor) -> Tensor:
        """Step, and return the correction, complex, ``(batch, n_frequencies)``.

        Args:
            implied: Position that the map implies, complex.
            here: Estimated position.
            seen: 1 where something is in view, ``(batch,)``.
        """
        dt = self.time_step_s
        apart = torch.view_as_real(implied - here).flatten(-2)
        missing = 1.0 - self.neurons.currents(apart.unsqueeze(0))
        missing = missing + _VETO * self.veto.clamp_min(0.0).unsqueeze(-1)
        fired = self.neurons.fire(self.neurons.charged * missing)[0]
        said = (fired @ self.decoders[0]).reshape(self.difference.shape)
        against = 1.0 - self.alike + (1.0 - seen)
        objects = self.objecting(against.reshape(1, -1, 1))[0] @ self.veto_decoders[0]
        self.alike = self.products(implied, here.conj()).real.mean(-1)
        self.veto = lowpass(self.veto, objects.squeeze(-1), synapse(_TAU_S, dt))
        self.difference = lowpass(self.difference, said, synapse(_OUT_S, dt))
        return torch.view_as_complex(self.difference)
