"""Path integrator and map as vectors without neurons: what the neurons approximate."""

import math

import numpy as np
import torch
from torch import Tensor

from neuroslam.compiled import runs_compiled
from neuroslam.config.semantic import PathIntegratorConfig, SemanticMapConfig
from neuroslam.spiking.ensemble import may_share, replace, view
from neuroslam.spiking.path_integrator import REREAD_STEPS, BasePathIntegrator, coupled
from neuroslam.spiking.space import SSPSpace
from neuroslam.spiking.vector_steps import Scratch, Sights, VectorState, advance
from neuroslam.state.mergeable import BufferModule


class AlgebraicIntegrator(BasePathIntegrator):
    r"""Represents a position by phases that the velocity advances.

    .. math:: z_k \leftarrow z_k\, e^{i (a_k \cdot v\,\Delta t + \sigma \sqrt{\Delta t}\,\xi_k)}

    State: ``phasor``, ``position_m``, and the generator of the noise.

    Args:
        space: Space of the positions.
        config: Noise, coupling, time constant of corrections.
        time_step_s: Length of a step.
        seed: Of the noise.
        batch: Animals side by side; each has its own noise.

    Example:
        >>> from neuroslam.spiking.space import SSPSpace
        >>> space = SSPSpace.hexagonal()
        >>> walk = AlgebraicIntegrator(space, PathIntegratorConfig(), time_step_s=0.01)
        >>> walk.start(torch.zeros(1, 2))
        >>> for _ in range(100):
        ...     z = walk(torch.tensor([[0.3, 0.1]]))
        >>> [round(x, 3) for x in walk.position_m[0].tolist()]
        [0.3, 0.1]
    """

    phasor: Tensor
    generator_state: Tensor

    def __init__(
        self,
        space: SSPSpace,
        config: PathIntegratorConfig,
        time_step_s: float,
        seed: int = 0,
        batch: int = 1,
    ) -> None:
        super().__init__(space, config, time_step_s, batch)
        draw = torch.Generator().manual_seed(seed)
        self.register_buffer("phasor", torch.zeros(batch, space.n_frequencies, 2))
        self.register_buffer("generator_state", draw.get_state())
        self._draw = draw

    @property
    def z(self) -> Tensor:
        """Fourier coefficients, complex, ``(batch, n_frequencies)``."""
        return torch.view_as_complex(self.phasor)

    @property
    def n_neurons(self) -> int:
        """Number of neurons: none."""
        return 0

    @torch.no_grad()
    def start(self, position_m: Tensor) -> None:
        """Set the phases to a position, ``(batch, dimension)``."""
        z = self.space.encode_fourier(position_m.to(self.position_m))
        self.phasor = torch.view_as_real(z).clone()
        self._place(position_m)

    def forward(self, velocity_m_s: Tensor, pull: Tensor | None = None) -> Tensor:
        """Advance one step; arguments as for :class:`~.path_integrator.PathIntegrator`."""
        c, dt, space = self.config, self.time_step_s, self.space
        given = (velocity_m_s,) if pull is None else (velocity_m_s, pull)
        if (
            velocity_m_s.shape == self.position_m.shape
            and runs_compiled(space.frequencies, space.length_scale_m, *given)
            and may_share(self, "phasor", "position_m")
        ):
            return self._compiled(velocity_m_s, pull)
        turn = (velocity_m_s * dt) @ self.space.wave_vectors.T
        if c.phase_noise_rad > 0:
            turn = turn + self.noise(1)[0].to(turn)
        z = self.z
        pull = coupled(z, pull, self.position_m, self.space, c)
        if pull is not None:
            z = z + pull * self.share
        z = z / z.abs().clamp_min(1e-6) * torch.polar(torch.ones_like(turn), turn)
        self.phasor = torch.view_as_real(z)
        return self.locate(velocity_m_s)

    def _compiled(self, velocity_m_s: Tensor, pull: Tensor | None) -> Tensor:
        """Advance one step as :meth:`forward` does, compiled."""
        phasor, position = view(self, "phasor").copy(), view(self, "position_m").copy()
        velocity = velocity_m_s.to(self.phasor).contiguous().numpy()[None]
        kind, (batch, k, _) = phasor.dtype, phasor.shape
        pulled = np.zeros_like(phasor)
        if pull is not None:
            pulled = torch.view_as_real(pull).to(self.phasor).numpy().copy()
        nothing, numbers = np.zeros((1, batch, 0), dtype=kind), np.zeros((1, batch), dtype=kind)
        unseen, noise = np.zeros((1, batch), dtype=bool), self.noise(1).to(self.phasor).numpy()
        inputs = Sights(velocity, nothing, nothing[..., None], unseen, numbers, noise)
        state = VectorState(
            phasor, position, nothing, nothing, phasor, pulled, unseen[0], numbers[0]
        )
        found = Scratch.of(inputs, 2 * k + 1)
        walk = np.array([self.time_step_s, self.config.coupling_gain, self.share, 0], dtype=kind)
        flags = np.array([0, 0, 0, self.coupling, int(self.age), self.look_steps, 1])
        advance(
            tuple(self.decoder.tables()), tuple(inputs), tuple(state),
            (*found[:3], *found.room), walk, numbers[0], flags,
        )  # fmt: skip
        if (int(self.age) + 1) % REREAD_STEPS == 0:
            self.reread(phasor, position)
        replace(self, phasor=phasor, position_m=position, age=np.array(int(self.age) + 1))
        return self.z

    @property
    def share(self) -> float:
        """Share of a correction that acts in a step."""
        return 1.0 - math.exp(-self.time_step_s / self.config.tau_s)

    def noise(self, steps: int) -> Tensor:
        """Draw the noise of the phases in some steps, rad, ``(steps, batch, n_frequencies)``.

        Empty, ``(0, 0, 0)``, if there is none.
        """
        c, (batch, k, _) = self.config, self.phasor.shape
        if c.phase_noise_rad == 0:
            return torch.zeros(0, 0, 0)
        self._draw.set_state(self.generator_state)
        each = [torch.randn((batch, k), generator=self._draw) for _ in range(steps)]
        self.generator_state = self._draw.get_state()
        return c.phase_noise_rad * math.sqrt(self.time_step_s) * torch.stack(each)


class AlgebraicMap(BufferModule):
    r"""Associates vectors with keys by one matrix and the delta rule.

    .. math:: W \leftarrow W + \kappa\,\Delta t\,(v - W k)\, k^\top / |k|^2

    State: ``weights``, ``(batch, n_value, n_key)``.

    Args:
        n_key: Length of keys.
        n_value: Length of values.
        config: Rate of learning.
        time_step_s: Length of a step.
        batch: Animals side by side.

    Example:
        >>> memory = AlgebraicMap(4, 3, SemanticMapConfig(), time_step_s=0.01)
        >>> key, value = torch.eye(4)[:1], torch.tensor([[1.0, 2.0, 3.0]])
        >>> for _ in range(100):
        ...     recall = memory(key, value, torch.ones(1))
        >>> memory.read(key).round(decimals=1).tolist()
        [[[1.0, 2.0, 3.0]]]
    """

    weights: Tensor

    def __init__(
        self,
        n_key: int,
        n_value: int,
        config: SemanticMapConfig,
        time_step_s: float,
        batch: int = 1,
    ) -> None:
        super().__init__()
        self.config = config
        self.time_step_s = time_step_s
        self.register_buffer("weights", torch.zeros(batch, n_value, n_key))

    @property
    def n_neurons(self) -> int:
        """Number of neurons: none."""
        return 0

    def forward(
        self, key: Tensor, value: Tensor, seen: Tensor, plasticity: Tensor | None = None
    ) -> Tensor:
        """Recall a key's value and learn; see :class:`~.associative.AssociativeMap`."""
        recall = torch.bmm(key.unsqueeze(1), self.weights.mT).squeeze(1)
        rate = seen * self.share
        rate = rate if plasticity is None else rate * plasticity
        error = (value - recall) * rate.unsqueeze(-1)
        unit = key / key.square().sum(-1, keepdim=True).clamp_min(1e-6)
        self.weights = self.weights.baddbmm(error.unsqueeze(-1), unit.unsqueeze(-2))
        return recall

    @property
    def share(self) -> float:
        """Share of the error that is learnt in a step."""
        return 1.0 - math.exp(-self.config.learning_rate_s * self.time_step_s)

    @torch.no_grad()
    def read(self, keys: Tensor) -> Tensor:
        """Return the recall of keys, ``(n, n_key)`` to ``(batch, n, n_value)``."""
        return self.respond(keys) @ self.weights.mT

    def respond(self, keys: Tensor) -> Tensor:
        """Return the keys for every animal, in place of rates of neurons."""
        return keys.to(self.weights).expand(len(self.weights), -1, -1)

    @torch.no_grad()
    def write(self, keys: Tensor, values: Tensor) -> None:
        """Make keys recall values, ``(n, n_key)`` and ``(n, n_value)``, of all animals."""
        inverse = torch.linalg.pinv(keys.double()).to(self.weights)
        weights = (inverse @ values.to(self.weights)).T
        self.weights = weights.expand_as(self.weights).contiguous()
