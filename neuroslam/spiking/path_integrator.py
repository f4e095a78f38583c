"""Path integration by velocity-controlled oscillators, each a population of neurons."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import cast

import numpy as np
import torch
from torch import Tensor

from neuroslam.config.semantic import NeuronConfig, PathIntegratorConfig
from neuroslam.errors import SpaceError
from neuroslam.spiking.decoding import PositionDecoder
from neuroslam.spiking.ensemble import (
    NeuronArray,
    Remembered,
    lowpass,
    may_share,
    replace,
    sample_tuning,
    synapse,
    view,
)
from neuroslam.spiking.populations import VelocityPopulation
from neuroslam.spiking.space import SSPSpace
from neuroslam.spiking.vector_steps import (
    CLEARLY_BETTER,
    COUPLINGS,
    SpaceTables,
    couple,
    oscillators_after,
    oscillators_before,
    search,
    similarity,
    track,
)
from neuroslam.state.mergeable import BufferModule

_SOLVER_POINTS = 2500
_RADIUS = math.sqrt(2.0)  # of what an oscillator represents: a point of a circle, and a rate
_LOOK_S = 0.004  # time between two decodings of the position
REREAD_STEPS = 100  # steps between two decodings over the whole space
_STATE = ("output", "recurrent", "external", "position_m", "age")  # of compiled steps
_VELOCITY_SEED = 8  # added to the seed; smaller ones are of other parts of SSP-SLAM

Steps = Callable[[np.ndarray, np.ndarray | None], tuple[np.ndarray, np.ndarray]]
"""Advances by a velocity and a pull; returns coefficients and positions."""


def oscillator_dynamics(point: Tensor, frequency: Tensor, tau_s: float, stabilise: float) -> Tensor:
    r"""Return the recurrent input by which an oscillator rotates, through a synapse.

    .. math:: z \leftarrow z + \tau\Bigl(i \omega z + \lambda \frac{1 - r^2}{r} z\Bigr)

    (SSP-SLAM, Eq. 19, by the NEF's third principle).

    Args:
        point: Real and imaginary part of :math:`z`, ``(..., 2)``.
        frequency: :math:`\omega`, rad/s, ``(...)``.
        tau_s: Of the synapse.
        stabilise: :math:`\lambda`; 0: an oscillator without a preferred amplitude.
    """
    r = point.norm(dim=-1, keepdim=True).clamp_min(1e-9)
    turned = torch.stack([-point[..., 1], point[..., 0]], dim=-1)
    pull = stabilise * (1.0 - r.square()) / r * point
    return point + tau_s * (frequency.unsqueeze(-1) * turned + pull)


def module_pull(z: Tensor, modules: Tensor) -> Tensor:
    r"""Return the change of each module's phases that makes their sum zero.

    The waves of a module close, :math:`\sum_j a_j = 0`, so their phases sum to zero wherever the
    animal is. Each takes its share of what is missing.

    Args:
        z: Fourier coefficients, complex, ``(..., n_frequencies)``.
        modules: Frequencies of each module, ``(n_modules, n)``.

    Returns:
        Turns in rad, ``(..., n_frequencies)``.

    Example:
        >>> z = torch.exp(1j * torch.tensor([0.3, 0.1, 0.2]))
        >>> (10 * module_pull(z, torch.arange(3)[None])).round().tolist()
        [-2.0, -2.0, -2.0]
    """
    rest = z[..., modules].prod(-1).angle() / modules.shape[-1]
    turn = torch.zeros(z.shape, dtype=rest.dtype, device=z.device)
    turn[..., modules] = -rest.unsqueeze(-1).expand(*rest.shape, modules.shape[-1])
    return turn


def coupled(
    z: Tensor,
    pull: Tensor | None,
    position_m: Tensor,
    space: SSPSpace,
    config: PathIntegratorConfig,
) -> Tensor | None:
    """Add the coupling of the oscillators to a correction.

    Args:
        z: Fourier coefficients, complex, ``(batch, n_frequencies)``.
        pull: Of the map, the same shape, or ``None``.
        position_m: Where they agree that the animal is, ``(batch, dimension)``.
        space: Their waves.
        config: Kind and gain of the coupling.
    """
    if config.coupling == "none" or config.coupling_gain == 0:
        return pull
    if config.coupling == "manifold":
        inner = space.encode_fourier(position_m) - z
    else:
        turn = module_pull(z, cast(Tensor, space.grid_modules))
        inner = torch.polar(torch.ones_like(turn), turn) * z - z
    inner = config.coupling_gain * inner
    return inner if pull is None else pull + inner


class BasePathIntegrator(BufferModule, ABC):
    """Base of both path integrators: the position that the phases encode.

    State: ``position_m`` ``(batch, dimension)``, ``age`` in steps, and the space's parameters.

    Args:
        space: Of the positions.
        config: Coupling.
        time_step_s: Length of a step.
        batch: Animals side by side.
    """

    position_m: Tensor
    age: Tensor

    @property
    @abstractmethod
    def z(self) -> Tensor:
        """Fourier coefficients that the oscillators hold, complex, ``(batch, n_frequencies)``."""

    def __init__(
        self, space: SSPSpace, config: PathIntegratorConfig, time_step_s: float, batch: int
    ) -> None:
        super().__init__()
        if config.coupling == "modules" and space.grid_modules is None:
            raise SpaceError(
                "PathIntegrator: coupling within modules needs a space of modules; "
                "take a hexagonal space, or coupling 'manifold'"
            )
        self.space, self.config, self.time_step_s = space, config, time_step_s
        self.decoder = PositionDecoder(space)
        self.register_buffer("position_m", torch.zeros(batch, space.dimension))
        self.register_buffer("age", torch.zeros((), dtype=torch.long))

    @property
    def coupling(self) -> int:
        """Kind of the coupling, as its number in ``COUPLINGS``."""
        c = self.config
        return COUPLINGS.index(c.coupling) if c.coupling_gain else 0

    @property
    def look_steps(self) -> int:
        """Number of steps between two decodings of the position nearby."""
        return max(1, round(_LOOK_S / self.time_step_s))

    def _place(self, position_m: Tensor) -> None:
        self.position_m = position_m.detach().to(self.position_m).clone()
        self.age = torch.zeros_like(self.age)

    def locate(self, velocity_m_s: Tensor) -> Tensor:
        """Track the position that the phases encode, and return the Fourier coefficients.

        It is decoded every few steps near the last position, and integrated in between. At longer
        intervals it is decoded over the whole space, so that a jump is found.
        """
        z = self.z
        position = self.position_m + self.time_step_s * velocity_m_s
        age = int(self.age) + 1
        if age % self.look_steps == 0:
            position = self.decoder.track(z, position)
        if age % REREAD_STEPS == 0:
            best = self.decoder(z)
            here = self.decoder.similarity(z, position)
            jumped = best.similarity > here + CLEARLY_BETTER
            position = torch.where(jumped.unsqueeze(-1), best.position_m, position)
        self.position_m, self.age = position, self.age + 1
        return z

    def _look(self, z: np.ndarray, position: np.ndarray, age: int) -> None:
        """Decode positions in place, where :meth:`locate` does in a step of this age.

        Args:
            z: ``(batch, n_frequencies, 2)``.
            position: Integrated, ``(batch, dimension)``.
            age: Steps since the start, with this one.
        """
        if age % self.look_steps == 0:
            tables = self.decoder.tables()
            for mine, x in zip(z, position, strict=True):
                track(tables.waves, tables.bounds, tables.longest, mine, x)
        if age % REREAD_STEPS == 0:
            self.reread(z, position)

    def reread(self, z: np.ndarray, position: np.ndarray) -> None:
        """Decode positions over the whole space, in place; a jump must be clearly better."""
        tables = self.decoder.tables()
        for mine, x in zip(z, position, strict=True):
            found = np.empty_like(x)
            best = search(tuple(tables), mine, found)
            if best > similarity(tables.waves, mine, x) + CLEARLY_BETTER:
                x[:] = found


class PathIntegrator(BasePathIntegrator):
    """Represents a position by phases of oscillators whose frequency the velocity sets.

    :func:`oscillator_dynamics` has the mathematics. Each oscillator is a population of neurons for
    three numbers: a point of the unit circle and its rate, as a share of the rate at the highest
    speed. Decoders are solved for amplitudes near the unit circle. With ``velocity_neurons`` the
    velocity is what a population of its own says
    (:class:`~neuroslam.spiking.populations.VelocityPopulation`), else it is exact.

    State: the neurons' (``neurons``, and ``velocity`` if there are any), and ``recurrent``,
    ``external``, ``output``, ``position_m``; parameters of the space are its own and part of the
    state as well.

    Args:
        space: Of the positions.
        config: Neurons, synapses, coupling.
        neurons: Their model.
        time_step_s: Length of a step.
        seed: Of the neurons.
        batch: Animals side by side; they have the same network.

    Example:
        >>> from neuroslam.spiking.space import SSPSpace
        >>> space = SSPSpace.hexagonal(n_rotations=2, n_scales=2)
        >>> config = PathIntegratorConfig(neurons=100)
        >>> walk = PathIntegrator(space, config, NeuronConfig(), time_step_s=1e-3)
        >>> walk.start(torch.zeros(1, 2))
        >>> for _ in range(200):
        ...     z = walk(torch.tensor([[0.3, 0.0]]))
        >>> bool((walk.position_m - torch.tensor([[0.06, 0.0]])).norm() < 0.02)
        True
    """

    recurrent: Tensor
    external: Tensor
    output: Tensor
    fastest_rad_s: Tensor
    decoders: Tensor

    def __init__(
        self,
        space: SSPSpace,
        config: PathIntegratorConfig,
        neurons: NeuronConfig,
        time_step_s: float,
        seed: int = 0,
        batch: int = 1,
    ) -> None:
        super().__init__(space, config, time_step_s, batch)
        draw = torch.Generator().manual_seed(seed)
        k = space.n_frequencies
        self._steps = Remembered()
        tuning = sample_tuning(k, config.neurons, 3, neurons, draw, radius=_RADIUS)
        self.neurons = NeuronArray(tuning, neurons, time_step_s, draw, batch)
        for name in ("recurrent", "external", "output"):
            self.register_buffer(name, torch.zeros(k, batch, 2))
        # Rates that the decoders are solved for; they stay if the space is trained.
        fastest = space.wave_vectors.detach().norm(dim=-1) * config.max_speed_m_s
        self.register_buffer("fastest_rad_s", fastest)
        self.register_buffer("decoders", self._solve(draw))
        self.velocity = None
        if config.velocity_neurons:
            self.velocity = VelocityPopulation(
                config.velocity_neurons, space.dimension, config.max_speed_m_s, neurons,
                time_step_s, seed + _VELOCITY_SEED, batch, config.decoder_noise,
            )  # fmt: skip

    @property
    def n_neurons(self) -> int:
        """Number of neurons of one animal: of all oscillators, and of the velocity."""
        return self.neurons.n_neurons + self.config.velocity_neurons

    def runs_compiled(self, *tensors: Tensor) -> bool:
        """Return whether a compiled step may advance all neurons and take these tensors."""
        if self.velocity is not None and not self.velocity.runs_compiled():
            return False
        return self.neurons.runs_compiled(*tensors)

    def _solve(self, draw: torch.Generator) -> Tensor:
        """Decoders of what comes back and of what is read out, ``(groups, neurons, 4)``.

        In units of spikes a step, so that they take what the neurons give.
        """
        c, k = self.config, self.space.n_frequencies
        low, high = c.amplitude_range

        def uniform(a: float, b: float) -> Tensor:
            return a + (b - a) * torch.rand(k, _SOLVER_POINTS, generator=draw)

        # Uniform over the ring's area, not over its radius.
        r, angle, share = uniform(low**2, high**2).sqrt(), uniform(0, 2 * math.pi), uniform(-1, 1)
        point = torch.stack([r * angle.cos(), r * angle.sin()], dim=-1)
        inputs = torch.cat([point, share.unsqueeze(-1)], dim=-1)
        omega = share * self.fastest_rad_s.unsqueeze(-1)
        back = oscillator_dynamics(point, omega, c.tau_s, c.stabilise)
        targets = torch.cat([back, point], dim=-1)
        return self.neurons.solve(inputs, targets, c.decoder_noise) / self.time_step_s

    @property
    def z(self) -> Tensor:
        """Fourier coefficients of what is read out, complex, ``(batch, n_frequencies)``."""
        return torch.view_as_complex(self.output.transpose(0, 1).contiguous())

    @torch.no_grad()
    def start(self, position_m: Tensor) -> None:
        """Set the oscillators to a position, ``(batch, dimension)``, and the animal to rest.

        The neurons' voltages are left as they are; they settle within a few milliseconds.
        """
        z = self.space.encode_fourier(position_m.to(self.output))
        point = torch.view_as_real(z).transpose(0, 1).contiguous()
        self.recurrent, self.output = point, point.clone()
        self.external = torch.zeros_like(point)
        if self.velocity is not None:
            self.velocity.silence()
        self._place(position_m)

    def forward(self, velocity_m_s: Tensor, pull: Tensor | None = None) -> Tensor:
        r"""Advance one step.

        Args:
            velocity_m_s: ``(batch, dimension)``.
            pull: Correction :math:`u`, complex, ``(batch, n_frequencies)``: acts like
                :math:`\dot z = u / \tau`.

        Returns:
            Fourier coefficients of where the animal is, complex, ``(batch, n_frequencies)``.
        """
        given = (velocity_m_s,) if pull is None else (velocity_m_s, pull)
        if self._advances_compiled(velocity_m_s.shape, *given):
            velocity, numbers = self._as_array(velocity_m_s), None
            if pull is not None:
                numbers = self._as_array(torch.view_as_real(pull))
            return torch.view_as_complex(torch.from_numpy(self.advance(velocity, numbers)))
        if self.velocity is not None:
            velocity_m_s = self.velocity(velocity_m_s)
        waves = self.space.wave_vectors
        share = (velocity_m_s @ (waves / self.fastest_rad_s.unsqueeze(-1)).T).clamp(-1.0, 1.0)
        pull = coupled(self.z, pull, self.position_m, self.space, self.config)
        parts = None if pull is None else torch.view_as_real(pull).transpose(0, 1)
        self.drive(share.T, parts)
        return self.locate(velocity_m_s)

    @torch.inference_mode()
    def run(self, velocity_m_s: Tensor) -> Tensor:
        """Advance many steps, without gradients, as :meth:`forward` does one by one.

        Args:
            velocity_m_s: ``(steps, batch, dimension)``.

        Returns:
            Fourier coefficients after each step, complex, ``(steps, batch, n_frequencies)``.
        """
        if not len(velocity_m_s):
            return self.z.unsqueeze(0)[:0]
        if not self._advances_compiled(velocity_m_s.shape[1:], velocity_m_s):
            return torch.stack([self(velocity) for velocity in velocity_m_s])
        step, keep = self.stepper()
        found = np.stack([step(each, None)[0] for each in self._as_array(velocity_m_s)])
        keep()
        return torch.view_as_complex(torch.from_numpy(found))

    def _advances_compiled(self, shape: torch.Size, *given: Tensor) -> bool:
        """Return whether :meth:`advance` takes a velocity of this shape, and these tensors."""
        own = self.space.frequencies, self.space.length_scale_m
        return (
            shape == cast(Tensor, self._buffers["position_m"]).shape
            and self.runs_compiled(*own, *given)
            and may_share(self, "recurrent", "external", "output", "position_m")
        )

    def _as_array(self, numbers: Tensor) -> np.ndarray:
        return numbers.to(self.space.frequencies.dtype).contiguous().numpy()

    def advance(self, velocity: np.ndarray, pull: np.ndarray | None) -> np.ndarray:
        """Advance one step as :meth:`forward` does, by compiled steps.

        Args:
            velocity: ``(batch, dimension)``.
            pull: ``(batch, n_frequencies, 2)``, or ``None``.

        Returns:
            ``(batch, n_frequencies, 2)``.
        """
        step, keep = self.stepper()
        z, _ = step(velocity, pull)
        keep()
        return z

    def stepper(self) -> tuple[Steps, Callable[[], None]]:
        """Return a function that steps as :meth:`advance` does, and one that keeps the state.

        The first returns the coefficients and the positions; its next call changes the latter.
        """
        state = tuple(view(self, name) for name in _STATE)
        neurons, tables = cast(NeuronArray, self._modules["neurons"]), self.decoder.tables()
        of = (
            self.config, tables, view(self, "fastest_rad_s"), view(self, "decoders"),
            state[0].dtype, self.velocity, *neurons.given(),
        )  # fmt: skip
        steps = self._steps
        if not steps.holds(of):
            steps.of, steps.value = of, self._stepper(tables)
        step, keep, mine = steps.value
        for ours, theirs in zip(mine, state, strict=True):
            ours[...] = theirs
        return step, keep

    def _stepper(
        self, tables: SpaceTables
    ) -> tuple[Steps, Callable[[], None], tuple[np.ndarray, ...]]:
        """Make the functions of :meth:`stepper`, and the state that they advance."""
        mine = tuple(np.empty_like(view(self, name)) for name in _STATE)
        output, recurrent, external, position, age = mine
        fastest, decoders = view(self, "fastest_rad_s"), view(self, "decoders")
        neurons = cast(NeuronArray, self._modules["neurons"])
        kind, (n, batch, _) = output.dtype, output.shape
        c, dt = self.config, self.time_step_s
        kept = (synapse(tau, dt) for tau in (c.input_tau_s, c.tau_s, c.output_tau_s))
        walk = np.array([c.coupling_gain, *kept, dt], dtype=kind)
        modules = self.coupling == COUPLINGS.index("modules")
        manifold = self.coupling == COUPLINGS.index("manifold")
        before, after = oscillators_before.dispatcher(), oscillators_after.dispatcher()
        answer, hear = neurons.responder(decoders), self.velocity
        x, nothing = np.empty((n, batch, 3), kind), np.zeros((batch, n, 2), kind)
        waves, look = tables.waves, self.look_steps

        def step(velocity: np.ndarray, pull: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
            if hear is not None:
                velocity = hear.advance(velocity)
            pull = nothing if pull is None else pull
            if modules:
                pull = pull.copy()
                for b, inner in enumerate(pull):
                    held = np.ascontiguousarray(output[:, b])
                    couple(tables.modules, held, held, self.coupling, walk[0], inner)
            before(
                waves, output, recurrent, external, fastest, position, velocity, pull, manifold,
                walk, x, external,
            )  # fmt: skip
            z = np.empty((batch, n, 2), kind)
            after(answer(x, None), recurrent, output, walk, recurrent, output, z)
            np.add(position, walk[4] * velocity, out=position)
            now = int(age) + 1
            age[...] = now
            if now % look == 0 or now % REREAD_STEPS == 0:
                self._look(z, position, now)
            return z, position

        def keep() -> None:
            replace(
                self, output=output.copy(), recurrent=recurrent.copy(), external=external.copy(),
                position_m=position.copy(), age=age.copy(),
            )  # fmt: skip

        return step, keep, mine

    def drive(self, share: Tensor, pull: Tensor | None) -> None:
        """Advance the oscillators one step, in terms of their phases.

        Args:
            share: Rate of each oscillator over its highest, ``(n_frequencies, batch)``.
            pull: ``(n_frequencies, batch, 2)``, or ``None``.
        """
        c, dt = self.config, self.time_step_s
        point = self.recurrent + self.external
        x = torch.cat([point, share.unsqueeze(-1)], dim=-1)
        if self.neurons.runs_compiled(x, self.decoders):
            decoded = torch.from_numpy(self.neurons.respond(x.numpy(), view(self, "decoders")))
        else:
            decoded = torch.bmm(self.neurons(x), self.decoders)
        self.recurrent = lowpass(self.recurrent, decoded[..., :2], synapse(c.tau_s, dt))
        kept = synapse(c.input_tau_s, dt)
        self.external = kept * self.external if pull is None else lowpass(self.external, pull, kept)
        self.output = lowpass(self.output, decoded[..., 2:], synapse(c.output_tau_s, dt))
