"""SSP-SLAM: path integration by oscillators, corrected by an associative map of landmarks."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from torch import Tensor, nn

from neuroslam.compiled import runs_compiled
from neuroslam.config.semantic import NeuronConfig, SSPSLAMConfig
from neuroslam.errors import SpaceError
from neuroslam.spiking.algebraic import AlgebraicIntegrator, AlgebraicMap
from neuroslam.spiking.associative import AssociativeMap
from neuroslam.spiking.attention import NOTHING, SEVERAL, Sight, attend, held, region_vectors
from neuroslam.spiking.binding import TAU_S as TAU_BINDING_S
from neuroslam.spiking.binding import SpikingBinding
from neuroslam.spiking.correction import SpikingCorrection
from neuroslam.spiking.ensemble import filter_into, lowpass, replace, synapse, view
from neuroslam.spiking.gaussian import (
    Gaussian,
    fit_gaussian,
    gaussian_damping,
    sighting_covariance,
)
from neuroslam.spiking.path_integrator import REREAD_STEPS, PathIntegrator
from neuroslam.spiking.populations import TAU_S as TAU_VECTOR_S
from neuroslam.spiking.populations import VectorPopulation
from neuroslam.spiking.quantise import on_chip, quantised
from neuroslam.spiking.space import SSPSpace
from neuroslam.spiking.vector_steps import (
    KNOWN,
    Scratch,
    Sights,
    VectorState,
    advance,
    after_recalls,
    before_recalls,
    encode_each,
    fourier_of_recalls,
    times,
)
from neuroslam.spiking.view_inputs import boxes_of, cut, with_time
from neuroslam.state.mergeable import BufferModule
from neuroslam.worlds.landmarks import LandmarkView

_CHUNK = 200  # steps whose inputs are prepared together
_GATE_WIDTH = 0.02  # range of similarity over which the gate opens
_SETTLED_S = 0.15  # time until neurons represent a landmark and its position is learnt
_AREA_INTERCEPT = 0.05  # similarity above which cells of the position memory fire
_CONTRADICTS, _AGREES = 0.5, 0.7  # similarities; side lobes of a space are below the first
_FADES = 0.25  # of a contradiction, in each second in which no known landmark is attended to
_LOST_GAIN = 1.0  # gain of a correction when lost


class SSPStep(NamedTuple):
    """Result of one step of SSP-SLAM.

    Attributes:
        position_m: Estimated position, ``(batch, dimension)``.
        z: Its Fourier coefficients, complex, ``(batch, n_frequencies)``.
        recall: Strength of the recall, ``(batch,)``.
        agreement: Similarity of recalled and estimated position, ``(batch,)``.
        gate: Opening of the gate, 0 to 1, ``(batch,)``.
        lost: Whether the animal is lost, so that the map sets its position, ``(batch,)``.
        attended: Number of the attended landmark, ``(batch,)``.
    """

    position_m: Tensor
    z: Tensor
    recall: Tensor
    agreement: Tensor
    gate: Tensor
    lost: Tensor
    attended: Tensor


class SSPSLAM(BufferModule):
    r"""Localises an animal and maps landmarks as semantic pointers, in one of three tiers.

    .. math:: \hat\phi(x_i) = \hat\phi(x) \circledast \phi(x_i - x), \qquad
              u = \eta\, g\,(\hat\phi(x_i) \circledast \phi(x_i - x)^{-1} - \hat\phi(x))

    The first is learnt as the recall of a landmark's pointer; the second, from the recall, corrects
    the path integrator, if the gate :math:`g` finds that both agree. If a known landmark
    contradicts for ``relocalise_after_s``, the animal was lost and relocalises by it.

    Where sightings have a standard deviation (``sigma_distance_m``, ``sigma_bearing_rad``), the
    learnt vector is its expectation over the noise, :math:`E[\phi(x_i + \epsilon)]`, each
    coefficient damped by :func:`~neuroslam.spiking.gaussian.gaussian_damping`; so the memory holds
    how certain the position is, and coefficients correct the more the more certain they are. It
    learns the mean of all sightings, each weighted by its certainty (``evidence_s``), until that
    is as slow as ``map.least_plasticity``.

    All tiers have the same parts; see their classes for the equations. Velocities and vectors to
    landmarks are allocentric (rotated by a compass).

    State: that of the parts, ``pointers``, the time, the attended landmark, and for how long known
    landmarks have contradicted. ``gate``, ``gain`` and the frequencies of the space are parameters.

    Args:
        config: Config of all parts.
        pointers: Pointers of the landmarks, ``(landmarks, n_key)``; to be bound with positions they
            need as many features as the space, else they are keys only.
        names: Names of the landmarks; ``None``: their numbers.
        batch: Animals side by side.

    Raises:
        SpaceError: If pointers do not fit the space.
    """

    pointers: Tensor
    time_s: Tensor
    attended: Tensor
    held_s: Tensor
    familiar: Tensor
    contradicted_s: Tensor
    recalled: Tensor
    pull: Tensor
    here: Tensor
    there: Tensor
    evidence_s: Tensor

    def __init__(
        self,
        config: SSPSLAMConfig,
        pointers: Tensor,
        names: Sequence[str] | None = None,
        batch: int = 1,
    ) -> None:
        super().__init__()
        self.given = config
        self.config = config = on_chip(config) if config.quantised else config
        self.batch = batch
        space = SSPSpace.from_config(config.space)
        c, dt, seed, n = config, config.time_step_s, config.seed, space.n_features
        if pointers.ndim != 2:
            raise SpaceError(
                f"SSPSLAM: pointers of shape {tuple(pointers.shape)}, expected (landmarks, "
                "features); make them with SemanticPointers"
            )
        n_key = pointers.shape[1]
        names = tuple(names or (str(k) for k in range(len(pointers))))
        self._names = _checked_names(names, len(pointers))
        neurons = c.neurons
        if c.tier == "rate":
            neurons = neurons.model_copy(update={"model": "lif_rate"})
        self.register_buffer("pointers", pointers.detach().to(torch.get_default_dtype(), copy=True))
        if c.tier == "algebraic":
            self.integrator = AlgebraicIntegrator(space, c.integrator, dt, seed, batch)
            self.map = AlgebraicMap(n_key, n, c.map, dt, batch)
            self.places = AlgebraicMap(n, n_key, c.map, dt, batch) if c.places else None
            self.vectors = self.grid = self.binding = self.unbinding = None
        else:
            self.integrator = PathIntegrator(space, c.integrator, neurons, dt, seed, batch)
            keys = self.pointers if c.map.voja_rate == 0 else None
            self.map = AssociativeMap(n_key, n, c.map, neurons, dt, seed + 1, batch, keys)
            self.places = self._place_memory(neurons, seed + 6) if c.places else None
            self.vectors = self.grid = None
            if c.vector_neurons:
                self.vectors = VectorPopulation.of_objects(
                    self.space, c.vector_neurons, neurons, dt, seed + 2, batch, c.vector_reach_m
                )
            if c.grid_neurons:
                self.grid = VectorPopulation.of_grid_cells(
                    self.space, c.grid_neurons, neurons, dt, seed + 3, batch
                )
            if c.binding == "neurons":
                k, size = self.space.n_frequencies, c.binding_neurons
                self.binding = SpikingBinding(k, size, neurons, dt, seed + 4, batch)
                self.unbinding = SpikingBinding(k, size, neurons, dt, seed + 5, batch)
            else:
                self.binding = self.unbinding = None
        self.correction = None
        if c.quantised:
            self.correction = SpikingCorrection(
                space.n_frequencies, c.map.neurons, c.binding_neurons, c.gate, neurons, dt,
                seed + 7, batch,
            )  # fmt: skip
            for name, part in self.parts.items():
                setattr(self, name, quantised(part))
        self.gate = nn.Parameter(torch.tensor(c.gate), requires_grad=False)
        self.gain = nn.Parameter(torch.tensor(c.gain), requires_grad=False)
        self.register_buffer("time_s", torch.zeros((), dtype=torch.float64))
        self.register_buffer("attended", torch.full((batch,), NOTHING))
        self.register_buffer("held_s", torch.zeros(batch))
        self.register_buffer("familiar", torch.zeros(batch, dtype=torch.bool))
        self.register_buffer("contradicted_s", torch.zeros(batch))
        if c.has_uncertain_sightings:
            self.register_buffer("evidence_s", torch.zeros(batch, len(pointers)))
        for name in ("recalled", "pull", "here", "there"):
            self.register_buffer(name, torch.zeros(batch, self.space.n_frequencies, 2))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the landmarks, one for each pointer."""
        return self._names

    def know(self, pointers: Tensor, names: Sequence[str]) -> None:
        """Replace the landmarks: pointers and names are only ever set together.

        The memory stays: it knows landmarks by their pointers.

        Args:
            pointers: ``(landmarks, n_key)``, of the length of those before.
            names: One for each.

        Raises:
            SpaceError: If there are not as many names as pointers, or a name occurs twice.
        """
        n_key = self.pointers.shape[1]
        if pointers.ndim != 2 or pointers.shape[1] != n_key:
            raise SpaceError(
                f"SSPSLAM: pointers of shape {tuple(pointers.shape)}, expected (landmarks, {n_key})"
            )
        names = _checked_names(names, len(pointers))
        if self.config.has_uncertain_sightings:
            new = pointers.to(self.pointers)
            same = (new.unsqueeze(1) == self.pointers).all(-1)
            self.evidence_s = self.evidence_s @ same.T.to(self.evidence_s)
        self.pointers = pointers.to(self.pointers)
        self._names = names

    @property
    def space(self) -> SSPSpace:
        """Space of the positions; it belongs to the path integrator."""
        return self.integrator.space

    @property
    def n_neurons(self) -> int:
        """Number of neurons of one animal, in all populations."""
        return sum(cast(int, part.n_neurons) for part in self.parts.values())

    @property
    def parts(self) -> dict[str, nn.Module]:
        """Its populations, by name."""
        names = (
            "integrator", "map", "places", "vectors", "grid", "binding", "unbinding", "correction",
        )  # fmt: skip
        return {name: part for name in names if (part := getattr(self, name)) is not None}

    def start(self, position_m: Tensor) -> None:
        """Set the position, ``(batch, dimension)``; the memory stays."""
        position = self._positions(position_m)
        self.integrator.start(position)
        for name in ("contradicted_s", "held_s", "familiar", "pull"):
            setattr(self, name, torch.zeros_like(getattr(self, name)))
        self.attended = torch.full_like(self.attended, NOTHING)

    def forward(self, velocity_m_s: Tensor, view: LandmarkView | None = None) -> SSPStep:
        """Advance one step; gradients reach the space, ``gate`` and ``gain``.

        Args:
            velocity_m_s: ``(batch, dimension)``.
            view: What is in view, arrays that lead with ``(batch,)``; ``None``: nothing.

        Raises:
            SpaceError: If anything does not fit or is not a number; nothing has changed then.
        """
        velocity, sight = self._inputs(velocity_m_s.unsqueeze(0), with_time(view))
        if self._runs_compiled(velocity, *sight[:2]):
            return SSPStep(*(part[0] for part in self._compiled(velocity, sight)))
        return self._step(velocity[0], *(part[0] for part in sight))

    @torch.inference_mode()
    def run(
        self,
        velocity_m_s: Tensor,
        view: LandmarkView | None = None,
        watch: Callable[[int, SSPStep], None] | None = None,
        every: int = 1,
    ) -> SSPStep:
        """Advance many steps, without gradients.

        Args:
            velocity_m_s: ``(steps, batch, dimension)``.
            view: What is in view, arrays that lead with ``(steps, batch)``; ``None``: nothing.
            watch: Called after each step with its number and result.
            every: Number :math:`n`; every n-th step is returned, or the last of
                fewer.

        Returns:
            Results, with the steps in front.
        """
        n, kept = len(velocity_m_s), [k for k in range(every - 1, len(velocity_m_s), every)]
        kept = kept or [n - 1]
        results: list[SSPStep] = []
        for begin in range(0, n, _CHUNK):
            part = slice(begin, begin + _CHUNK)
            velocity, sight = self._inputs(velocity_m_s[part], cut(view, part))
            mine = [k - begin for k in kept if begin <= k < begin + len(velocity)]
            if watch is None and self._runs_compiled(velocity, *sight[:2]):
                results.append(SSPStep(*(each[mine] for each in self._compiled(velocity, sight))))
                continue
            steps: list[SSPStep] = []
            for k, v in enumerate(velocity):
                now = Sight(*(each[k : k + 1] for each in sight))
                if self._runs_compiled(v, *now[:2]):
                    step = SSPStep(*(each[0] for each in self._compiled(v.unsqueeze(0), now)))
                else:
                    step = self._step(v, *(each[0] for each in now))
                if watch is not None:
                    watch(begin + k, step)
                if k in mine:
                    steps.append(step)
            if steps:
                results.append(SSPStep(*(torch.stack(each) for each in zip(*steps, strict=True))))
        return SSPStep(*(torch.cat(each) for each in zip(*results, strict=True)))

    def _runs_compiled(self, *inputs: Tensor) -> bool:
        """Return whether compiled steps may take these inputs and the state."""
        if self.correction is not None or self.config.has_uncertain_sightings:
            return False
        space, walk = self.space, self.integrator
        tensors = (
            *inputs, self.gate, self.gain, space.frequencies, space.length_scale_m, self.pull,
            self.recalled, walk.position_m,
        )  # fmt: skip
        if isinstance(walk, PathIntegrator):
            memory = cast(AssociativeMap, self.map)
            populations = walk, memory.memory
            return all(each.runs_compiled(walk.output) for each in populations) and runs_compiled(
                *tensors, memory.decoders, memory.rule
            )
        memory = cast(AlgebraicMap, self.map)
        return runs_compiled(*tensors, walk.phasor, memory.weights)

    def _compiled(self, velocity: Tensor, sight: Sight) -> SSPStep:
        """Advance some steps as :meth:`_step` does, compiled; results lead with the steps."""
        if self.config.tier == "algebraic":
            return self._compiled_vectors(velocity, sight)
        v, key, vector, held_s = (
            part.contiguous().numpy()
            for part in (velocity, sight.key, torch.view_as_real(sight.vector), sight.held_s)
        )
        seen = (sight.attended != NOTHING).numpy()
        model, flags = self._gate_constants(v.dtype)
        step, keep = self._neuron_stepper(model, flags)
        # Whether an animal attends to the landmark of the step before.
        same = np.zeros(seen.shape, dtype=np.bool_)
        same[1:] = (key[1:] == key[:-1]).all(-1)
        found = [step(v[k], key[k], same[k], vector[k], held_s[k], seen[k]) for k in range(len(v))]
        keep()
        self._count(sight)
        position, z, says = (torch.from_numpy(np.stack(each)) for each in zip(*found, strict=True))
        return _steps_of(position, z, says, sight.attended)

    def _gate_constants(self, kind: np.dtype) -> tuple[np.ndarray, np.ndarray]:
        """Return constants of compiled steps, of the type of the state.

        Returns:
            Time until a landmark is settled, time until the animal is lost, least plasticity,
            similarity below which a landmark contradicts, time step, gate and its width, gain, gain
            when lost, similarity above which a landmark agrees, and by how much a contradiction
            fades in a step. And flags: whether known landmarks
            are learnt more slowly, whether an animal is never lost, whether neurons are quantised,
            and room for four more.
        """
        c, dt = self.config, self.config.time_step_s
        settled = 1.5 * dt if c.tier == "algebraic" else _SETTLED_S
        model = np.array(
            [settled, c.relocalise_after_s, c.map.least_plasticity, _CONTRADICTS, dt,
             float(self.gate), _GATE_WIDTH, float(self.gain), _LOST_GAIN, _AGREES, _FADES * dt],
            dtype=kind,
        )  # fmt: skip
        novelty, never = c.map.plasticity == "novelty", c.relocalise_after_s == 0
        return model, np.array([novelty, never, c.quantised, 0, 0, 0, 0])

    def _compiled_vectors(self, velocity: Tensor, sight: Sight) -> SSPStep:
        """Advance vectors some steps, in one compiled call."""
        c, dt = self.config, self.config.time_step_s
        walk, memory = cast(AlgebraicIntegrator, self.integrator), cast(AlgebraicMap, self.map)
        places = cast(AlgebraicMap | None, self.places)
        kind = view(self, "pull").dtype
        model, flags = self._gate_constants(kind)
        numbers = np.array([dt, c.integrator.coupling_gain, walk.share, memory.share], dtype=kind)
        inputs = Sights(
            velocity.contiguous().numpy(),
            sight.key.contiguous().numpy(),
            torch.view_as_real(sight.vector).contiguous().numpy(),
            (sight.attended != NOTHING).numpy(),
            sight.held_s.contiguous().numpy(),
            walk.noise(len(velocity)).to(self.pull).numpy(),
        )
        state = VectorState(
            view(walk, "phasor").copy(),
            view(walk, "position_m").copy(),
            view(memory, "weights").copy(),
            np.zeros((0, 0, 0), kind) if places is None else view(places, "weights").copy(),
            view(self, "recalled").copy(),
            view(self, "pull").copy(),
            view(self, "familiar").copy(),
            view(self, "contradicted_s").copy(),
        )
        found = Scratch.of(inputs, self.space.n_features)
        begin, age = 0, int(walk.age)
        while begin < len(velocity):
            end = min(len(velocity), begin + REREAD_STEPS - (age + begin) % REREAD_STEPS)
            rereads = (age + end) % REREAD_STEPS == 0
            parts = [(begin, end - rereads, 0)]
            if rereads:
                parts += [(end - 1, end, 1), (end - 1, end, 2)]
            for first, last, half in parts:
                if half == 2:
                    walk.reread(state.phasor, state.position)
                flags[3:] = walk.coupling, age + first, walk.look_steps, half
                advance(
                    tuple(walk.decoder.tables()),
                    tuple(part[first:last] for part in inputs),
                    tuple(state),
                    (*(part[first:last] for part in found[:3]), *found.room),
                    numbers,
                    model,
                    flags,
                )
            begin = end
        replace(walk, phasor=state.phasor, position_m=state.position)
        walk.age = walk.age + len(velocity)
        replace(memory, weights=state.weights)
        if places is not None:
            replace(places, weights=state.places)
        replace(
            self, recalled=state.recalled, pull=state.pull, familiar=state.familiar,
            contradicted_s=state.contradicted,
        )  # fmt: skip
        self._count(sight)
        at, coefficients, said = (torch.from_numpy(each) for each in found[:3])
        return _steps_of(at, coefficients, said, sight.attended)

    def _count(self, sight: Sight) -> None:
        """Note the time, and what is attended to, after some steps."""
        time = float(self.time_s)
        for _ in range(len(sight.held_s)):
            time += self.config.time_step_s
        self.time_s = torch.full_like(self.time_s, time)
        self.attended, self.held_s = sight.attended[-1].clone(), sight.held_s[-1].clone()

    def _neuron_stepper(
        self, model: np.ndarray, flags: np.ndarray
    ) -> tuple[Callable[..., tuple[np.ndarray, ...]], Callable[[], None]]:
        """Return a function that advances neurons a step, and one that keeps the state.

        The first takes velocity, key, whether that is the key of the step before, vector, for how
        long a landmark has been attended to, and whether one is; all lead with ``(batch,)``. It
        returns position, coefficients, and what ``SSPStep`` says.
        """
        walk, memory = cast(PathIntegrator, self.integrator), cast(AssociativeMap, self.map)
        places, vectors, grid = cast(AssociativeMap | None, self.places), self.vectors, self.grid
        keeps = []

        def stepper(part: Any) -> Any:  # noqa: ANN401 - each takes arguments of its own
            if part is None:
                return None
            step, keep = part.stepper()
            keeps.append(keep)
            return step

        integrate, recall_of, learn_place = map(stepper, (walk, memory, places))
        see, fire_grid, bind, unbind = map(stepper, (vectors, grid, self.binding, self.unbinding))
        recalled, pull, familiar, contradicted, late, later = (
            view(self, name).copy()
            for name in ("recalled", "pull", "familiar", "contradicted_s", "here", "there")
        )
        tables = walk.decoder.tables()
        waves, even, odd = tables.waves, tables.even, tables.odd
        kind, dt = pull.dtype, self.config.time_step_s
        seen_late, bound_late = synapse(TAU_VECTOR_S, dt), synapse(TAU_BINDING_S, dt)
        encoded, back, product, value = (
            np.empty_like(pull), np.empty_like(pull), np.empty_like(pull),
            np.empty((self.batch, even.shape[1]), dtype=kind),
        )  # fmt: skip
        now = np.empty((self.batch, 5), dtype=kind)
        learns, plasticity = (np.empty(self.batch, dtype=kind) for _ in range(2))
        encode_, multiply, filter_ = (
            encode_each.dispatcher(), times.dispatcher(), filter_into.dispatcher()
        )  # fmt: skip
        before, between, after = (
            before_recalls.dispatcher(), fourier_of_recalls.dispatcher(), after_recalls.dispatcher()
        )  # fmt: skip

        def step(
            velocity: np.ndarray,
            key: np.ndarray,
            same: np.ndarray,
            vector: np.ndarray,
            held_s: np.ndarray,
            seen: np.ndarray,
        ) -> tuple[np.ndarray, ...]:
            z, at = integrate(velocity, pull)
            position, here, sees = at.copy(), encoded, seen.astype(kind)
            encode_(waves, at, here)
            if fire_grid is not None:
                here = fire_grid(here)
            if see is not None:
                vector = see(vector) * sees[:, None, None]
                filter_(late.reshape(-1), here.reshape(-1), seen_late, late.reshape(-1))
                here = late
            if bind is None:
                place = product
                multiply(here, vector, place)
            else:
                place = bind(here, vector)
            before(
                even, odd, place, recalled, held_s, contradicted, seen, model, flags, value, now,
                learns, plasticity,
            )  # fmt: skip
            recall = recall_of(key, value, sees, plasticity, sees, same)
            between(even, odd, recall, vector, recalled, back)
            if learn_place is not None:
                learn_place(value * sees[:, None], key, sees, learns, sees, never_same)
            if unbind is None:
                implied = product
                multiply(recalled, back, implied)
            else:
                implied = unbind(recalled, back)
                filter_(later.reshape(-1), here.reshape(-1), bound_late, later.reshape(-1))
                here = later
            says = np.empty((len(now), 4), dtype=kind)
            after(implied, here, seen, familiar, contradicted, now, model, flags, pull, says)
            return position, z, says

        never_same = np.zeros(self.batch, dtype=np.bool_)

        def keep() -> None:
            for each in keeps:
                each()
            replace(
                self, recalled=recalled, pull=pull, familiar=familiar, contradicted_s=contradicted,
                here=late, there=later,
            )  # fmt: skip

        return step, keep

    def _step(
        self,
        velocity: Tensor,
        key: Tensor,
        vector: Tensor,
        attended: Tensor,
        held_s: Tensor,
        damping: Tensor,
    ) -> SSPStep:
        c, space = self.config, self.space
        uncertain = c.has_uncertain_sightings
        seen = (attended != NOTHING).to(key)
        # Neurons need a while to represent a landmark; vectors one step, and one to be compared.
        settled = held_s > (1.5 * c.time_step_s if c.tier == "algebraic" else _SETTLED_S)
        z = self.integrator(velocity, torch.view_as_complex(self.pull))
        # Position of the landmark: the position, cleaned up, bound to the vector to it.
        here = z if c.quantised else space.encode_fourier(self.integrator.position_m)
        if self.grid is not None:
            here = self.grid(here)
        if self.vectors is not None:
            vector = self.vectors(vector) * seen.unsqueeze(-1)
            here = self._late("here", here, TAU_VECTOR_S)
        place = here * vector if self.binding is None else self.binding(here, vector)
        strength = torch.view_as_complex(self.recalled).abs().square().mean(-1).sqrt()
        if uncertain:  # relative to what a sighting as certain as this one leaves
            place = place * damping
            strength = strength / damping.square().mean(-1).sqrt()
        lost = self._is_lost()
        # No learning while landmarks contradict: the map must not adapt to a wrong position.
        doubts = (self.contradicted_s > 0) & (c.relocalise_after_s > 0)
        learns = seen if c.quantised else (settled & ~doubts).to(key)
        plasticity = learns * self._plasticity(strength)
        if uncertain:
            plasticity = self._averaging(attended, learns, damping)
        place = space.from_fourier(place)
        recall = space.to_fourier(self.map(key, place, seen, plasticity))
        if self.places is not None:
            self.places(place * seen.unsqueeze(-1), key, seen, learns)
        # Position of the animal implied by the recall: unbound from the vector.
        implied = recall * vector.conj()
        if self.unbinding is not None:
            implied = self.unbinding(recall, vector.conj())
            here = self._late("there", here, TAU_BINDING_S)
        agreement = (implied.real * here.real + implied.imag * here.imag).mean(-1)
        if uncertain:
            agreement = agreement / damping.mean(-1)
        # What is learnt in the present visit is no more accurate than the position.
        familiar = torch.where(settled, self.familiar, strength > KNOWN)
        known = familiar & settled & (seen > 0)
        gate = torch.sigmoid((agreement - self.gate) / _GATE_WIDTH) * known
        self._note_contradiction(known, agreement / strength.clamp_min(KNOWN))
        unit = implied / implied.abs().square().mean(-1, keepdim=True).sqrt().clamp_min(1e-3)
        gain = torch.where(lost & known, _LOST_GAIN, self.gain * gate)
        apart = unit - here
        if uncertain:
            certain = implied.abs() / strength.clamp_min(KNOWN).unsqueeze(-1)
            apart = certain * (implied / implied.abs().clamp_min(1e-6) - here)
        if self.correction is not None:
            gain, apart = self.gain.expand(self.batch), self.correction(implied, here, seen)
            gate = 1.0 - self.correction.veto.clamp(0.0, 1.0)
        self.pull = torch.view_as_real(gain.unsqueeze(-1) * apart)
        self.recalled = torch.view_as_real(recall)
        self.time_s = self.time_s + c.time_step_s
        self.attended, self.held_s, self.familiar = attended, held_s, familiar
        position = self.integrator.position_m
        return SSPStep(position, z, strength, agreement, gate, lost, attended)

    def _place_memory(self, neurons: NeuronConfig, seed: int) -> AssociativeMap:
        """Make a memory whose keys are positions: its neurons fire as place cells do."""
        c, draw = self.config, torch.Generator().manual_seed(seed)
        low, high = self.space.bounds_m.T.to(self.pointers)
        at = low + (high - low) * torch.rand(c.map.neurons, len(low), generator=draw)
        n, keys = self.space.n_features, self.space.encode(at).detach()
        # An area has a low similarity with each of its positions; cells must respond to it.
        low = {"voja_rate": 0.0, "intercept": min(c.map.intercept, _AREA_INTERCEPT)}
        config = c.map.model_copy(update=low)
        n_key = self.pointers.shape[1]
        return AssociativeMap(n, n_key, config, neurons, c.time_step_s, seed, self.batch, keys)

    def _late(self, name: str, z: Tensor, tau_s: float) -> Tensor:
        """Delay like the synapse of the other signal; else motion is corrected backwards."""
        kept = synapse(tau_s, self.config.time_step_s)
        late = lowpass(getattr(self, name), torch.view_as_real(z), kept)
        setattr(self, name, late)
        return torch.view_as_complex(late)

    def _plasticity(self, strength: Tensor) -> Tensor:
        """Return the share of the learning rate for a recall of this strength."""
        c = self.config.map
        if c.plasticity == "constant":
            return torch.ones_like(strength)
        return (1.0 - strength.square()).clamp(c.least_plasticity, 1.0)

    def _averaging(self, attended: Tensor, learns: Tensor, damping: Tensor) -> Tensor:
        r"""Add a sighting to the evidence, and return the plasticity by which a mean is learnt.

        .. math:: w = \text{mean}_k\, d_k^2, \qquad t \leftarrow t + w\,\Delta t, \qquad
                  p = w / (\kappa\, t)

        with the damping :math:`d` and the rate of learning :math:`\kappa`; each sighting has the
        weight :math:`w` in the mean.
        """
        c = self.config.map
        weight = learns * damping.square().mean(-1)
        row = attended.clamp_min(0).unsqueeze(-1)
        more = torch.zeros_like(self.evidence_s)
        more.scatter_(-1, row, (weight * self.config.time_step_s).unsqueeze(-1))
        self.evidence_s = (self.evidence_s + more).detach()
        if c.plasticity == "constant":
            return learns
        seen_s = self.evidence_s.gather(-1, row).squeeze(-1)
        share = weight / (c.learning_rate_s * seen_s.clamp_min(1e-9))
        return learns * share.clamp(c.least_plasticity, 1.0)

    def _is_lost(self) -> Tensor:
        after = self.config.relocalise_after_s
        if after == 0:
            return torch.zeros_like(self.contradicted_s, dtype=torch.bool)
        return self.contradicted_s > after

    def _note_contradiction(self, known: Tensor, agreement: Tensor) -> None:
        """Measure for how long known landmarks contradict; one that clearly agrees resets it.

        Without a known landmark it fades: else one outlier would end all learning of new ones.
        """
        dt = self.config.time_step_s
        more = self.contradicted_s + dt
        less = (self.contradicted_s - _FADES * dt).clamp_min(0.0)
        longer = torch.where(agreement < _CONTRADICTS, more, self.contradicted_s)
        longer = torch.where(agreement > _AGREES, 0.0, longer)
        self.contradicted_s = torch.where(known, longer, less).detach()

    def _inputs(self, velocity: Tensor, view: LandmarkView | None) -> tuple[Tensor, Sight]:
        """Check and prepare the inputs of some steps, without changing the state."""
        m, kind = self.space.dimension, self.pointers
        if velocity.ndim != 3 or velocity.shape[1:] != (self.batch, m):
            raise SpaceError(
                f"SSPSLAM: velocities of shape {tuple(velocity.shape)[1:]}, "
                f"expected (batch, dimension) = {(self.batch, m)}"
            )
        if not bool(torch.isfinite(velocity).all()):
            raise SpaceError(
                "SSPSLAM: a velocity is not a finite number; correct or drop that step"
            )
        steps = len(velocity)
        velocity = velocity.to(kind)
        if view is None:
            key = kind.new_zeros(steps, self.batch, kind.shape[1])
            z = torch.zeros(steps, self.batch, self.space.n_frequencies, 2).to(kind)
            attended = torch.full((steps, self.batch), NOTHING, device=kind.device)
            vector = torch.view_as_complex(z)
            damping = kind.new_ones(steps, self.batch, 1)
        else:
            key, vector, attended, damping = self._seen(view, steps)
        held_s = held(attended, self.attended, self.held_s, self.config.time_step_s)
        return velocity, Sight(key, vector, attended, held_s, damping)

    def _seen(self, view: LandmarkView, steps: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return pointers and vectors of what is attended to, its number, and its damping."""
        c, kind, n = self.config, self.pointers, len(self.pointers)
        in_view = torch.as_tensor(np.asarray(view.in_view), device=kind.device)
        if in_view.shape != (steps, self.batch, n):
            raise SpaceError(
                f"SSPSLAM: landmarks in view of shape {tuple(in_view.shape)}, expected "
                f"{(steps, self.batch, n)}: one column for each pointer"
            )
        distance, low, high = (
            torch.as_tensor(np.asarray(part)).to(kind)
            for part in (view.distance_m, view.low_m, view.high_m)
        )
        if low.shape[-1] != self.space.dimension:
            raise SpaceError(
                f"SSPSLAM: landmarks in {low.shape[-1]} dimensions, the space has "
                f"{self.space.dimension}"
            )
        for part in (low, high):
            if not bool(torch.isfinite(part[in_view[..., view.box_landmark]]).all()):
                raise SpaceError("SSPSLAM: the place of a landmark in view is not a number")
        boxes, weight = boxes_of(view, n)
        boxes, weight = boxes.to(kind.device), weight.to(kind)
        if c.attention == "sum":
            z = region_vectors(self.space, low[..., boxes, :], high[..., boxes, :], weight)
            key = in_view.to(kind) @ kind
            vector = (z * in_view.unsqueeze(-1)).sum(-2)
            several = torch.where(in_view.sum(-1) > 1, SEVERAL, in_view.to(torch.uint8).argmax(-1))
            exact = kind.new_ones(steps, self.batch, 1)
            return key, vector, torch.where(in_view.any(-1), several, NOTHING), exact
        time = self.time_s + c.time_step_s * torch.arange(steps, dtype=torch.float64)
        attended = attend(in_view, distance, time, c.turn_s, c.attention)
        some, which = attended != NOTHING, attended.clamp_min(0)
        mine = boxes[which].unsqueeze(-1).expand(-1, -1, -1, low.shape[-1])
        low, high, weight = low.gather(2, mine), high.gather(2, mine), weight[which]
        z = region_vectors(self.space, low, high, weight)
        some = some.unsqueeze(-1)
        return kind[which] * some, z * some, attended, self._damping(low, high, weight, some)

    def _damping(self, low_m: Tensor, high_m: Tensor, weight: Tensor, some: Tensor) -> Tensor:
        """Return the factors of coefficients by the noise of sightings; 1 where nothing is seen."""
        c = self.config
        if not c.has_uncertain_sightings:
            return weight.new_ones(()).expand(*some.shape)
        middle = ((low_m + high_m) / 2.0 * weight.unsqueeze(-1)).sum(-2)
        middle = torch.where(some, middle, 0.0)
        covariance = sighting_covariance(middle, c.sigma_distance_m, c.sigma_bearing_rad)
        return gaussian_damping(self.space, covariance)

    def wholeness(self, z: Tensor) -> Tensor:
        """Return the similarity with its position of a recall that is of one position alone.

        Args:
            z: Recall as Fourier coefficients, complex, ``(..., n_frequencies)``.
        """
        if self.config.has_uncertain_sightings:  # their coefficients are not of one modulus
            return z.abs().mean(-1)
        return z.abs().square().mean(-1).sqrt()

    @torch.no_grad()
    def uncertainty(self, z: Tensor) -> Gaussian | None:
        """Return the normal distributions that recalls hold; ``None`` if sightings are exact.

        The covariance is that of one sighting as remembered: the noise declared for the sensor, and
        the scatter of the sightings. The mean of many is better known.

        Args:
            z: Recall as Fourier coefficients, complex, ``(..., n_frequencies)``.
        """
        if not self.config.has_uncertain_sightings:
            return None
        return fit_gaussian(self.space, z, free_strength=True)

    def _positions(self, position_m: Tensor) -> Tensor:
        """Check positions against the space."""
        position = torch.as_tensor(position_m).to(self.pointers)
        if position.shape != (self.batch, self.space.dimension):
            raise SpaceError(
                f"SSPSLAM: position of shape {tuple(position.shape)}, expected "
                f"(batch, dimension) = {(self.batch, self.space.dimension)}"
            )
        low, high = self.space.bounds_m.T.to(position)
        inside = (position >= low) & (position <= high)
        if not bool(inside.all()):
            raise SpaceError(
                f"SSPSLAM: position {position[~inside.all(-1)][0].tolist()} is outside the "
                f"bounds {self.space.bounds_m.tolist()}; give the space a larger reach_m"
            )
        return position


def _steps_of(position: Tensor, z: Tensor, says: Tensor, attended: Tensor) -> SSPStep:
    """Return results of compiled steps: ``says`` are strength, agreement, gate and lost."""
    strength, agreement, gate, lost = says.unbind(-1)
    return SSPStep(
        position, torch.view_as_complex(z), strength, agreement, gate, lost != 0, attended
    )


def _checked_names(names: Sequence[str], n: int) -> tuple[str, ...]:
    if len(names) != n or len(set(names)) < n:
        raise SpaceError(
            f"SSPSLAM: {len(names)} names for {n} pointers; give each landmark one of its own"
        )
    return tuple(names)
