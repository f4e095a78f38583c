"""The semantic map: an associative memory in neurons from landmarks to positions."""

import numpy as np
import torch
from torch import Tensor

from neuroslam.config.semantic import NeuronConfig, SemanticMapConfig
from neuroslam.spiking.ensemble import (
    NeuronArray,
    Stepper,
    lowpass,
    rates,
    replace,
    sample_tuning,
    solve_decoders,
    synapse,
    view,
)
from neuroslam.spiking.learning import drive_by_keys, memorise, pes_step, voja_step
from neuroslam.state.mergeable import BufferModule

_SOLVER_POINTS = 3000
_TAU_RECALL_S = 0.005
_TAU_ERROR_S = 0.05
_TAU_TEACHER_S = 0.05
_INHIBITION = 25.0  # of the error's neurons, where nothing is to be learnt


class AssociativeMap(BufferModule):
    """Associates vectors with keys: positions of landmarks with their pointers.

    A population fires to keys; the weights with which it recalls learn from the error
    (:func:`~neuroslam.spiking.learning.pes_step`), its encoders move to the keys that it meets
    (:func:`~neuroslam.spiking.learning.voja_step`). A further population represents the
    error and is silenced where nothing is to be learnt. The recall may pass through one more
    (``relay`` in the config).

    State: all of it, with the learnt weights of every animal, ``encoders`` ``(batch, neurons,
    key)`` and ``decoders`` ``(batch, neurons, value)``.

    Args:
        n_key: Length of keys.
        n_value: Length of values.
        config: Size and rates of learning.
        neurons: Their model.
        time_step_s: Length of a step.
        seed: Of the neurons.
        batch: Animals side by side.
        keys: Keys known in advance, ``(n, n_key)``, as initial encoders; ``None``: random.

    Example:
        >>> key, place = torch.eye(8)[:1], torch.eye(8)[6:7]
        >>> config = SemanticMapConfig(neurons=200, pes_rate=0.05)
        >>> memory = AssociativeMap(8, 8, config, NeuronConfig(), time_step_s=1e-3)
        >>> for _ in range(500):
        ...     recall = memory(key, place, torch.ones(1))
        >>> memory.read(key)[0].argmax(-1).item()
        6
    """

    memory: NeuronArray
    error: NeuronArray
    relay: NeuronArray
    encoders: Tensor
    decoders: Tensor
    gain: Tensor
    activity_hz: Tensor
    recalled: Tensor
    relayed: Tensor
    taught: Tensor
    rule: Tensor
    relay_decoders: Tensor
    error_decoders: Tensor

    def __init__(
        self,
        n_key: int,
        n_value: int,
        config: SemanticMapConfig,
        neurons: NeuronConfig,
        time_step_s: float,
        seed: int = 0,
        batch: int = 1,
        keys: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.config = config
        self.time_step_s = time_step_s
        self._rates: np.ndarray | None = None  # constants of compiled steps
        draw = torch.Generator().manual_seed(seed)
        n = config.neurons
        near = None
        if keys is not None:
            near = keys[torch.arange(n) % len(keys)].unsqueeze(0).to(torch.get_default_dtype())
            near = near / near.norm(dim=-1, keepdim=True)
        tuning = sample_tuning(1, n, n_key, neurons, draw, 1.0, near, config.intercept)
        self.memory = NeuronArray(tuning, neurons, time_step_s, draw, batch)
        self.register_buffer("gain", tuning.gain[0] / tuning.radius)
        self.register_buffer("encoders", self.memory.weights.repeat(batch, 1, 1))
        self.register_buffer("decoders", torch.zeros(batch, n, n_value))
        self.register_buffer("activity_hz", torch.zeros(batch, n))
        for name in ("recalled", "relayed", "taught", "rule"):
            self.register_buffer(name, torch.zeros(batch, n_value))
        for name in ("relay", "error")[not config.relay :]:
            tuning = sample_tuning(1, n, n_value, neurons, draw)
            part = NeuronArray(tuning, neurons, time_step_s, draw, batch)
            setattr(self, name, part)
            decoders = _identity(part, tuning.radius, draw) / time_step_s
            self.register_buffer(f"{name}_decoders", decoders)

    def forward(
        self,
        key: Tensor,
        value: Tensor,
        seen: Tensor,
        plasticity: Tensor | None = None,
        voja: Tensor | None = None,
    ) -> Tensor:
        """Recall a key's value and learn the value that it has now, by one step.

        Args:
            key: ``(batch, n_key)``.
            value: ``(batch, n_value)``.
            seen: 1 where there is something to learn, else 0, ``(batch,)``.
            plasticity: Share of the rate of learning, ``(batch,)``; ``None``: all of it.
            voja: How much encoders learn, ``(batch,)``; ``None``: as ``seen``.

        Returns:
            The recall, filtered, ``(batch, n_value)``.
        """
        c, dt = self.config, self.time_step_s
        inputs = key, value, seen, *(part for part in (plasticity, voja) if part is not None)
        state = self.encoders, self.decoders, self.rule, self.recalled, self.taught
        if self.memory.runs_compiled(*inputs, *state):
            numbers = [part.to(key).contiguous().numpy() for part in inputs[2:]]
            learns = np.ones_like(numbers[0]) if plasticity is None else numbers[1]
            moves = numbers[0] if voja is None else numbers[-1]
            recall = self.advance(
                key.contiguous().numpy(), value.contiguous().numpy(), numbers[0], learns, moves
            )
            return torch.from_numpy(recall)
        # In this order; the other one takes seven times as long.
        current = self.memory.bias + torch.bmm(key.unsqueeze(1), self.encoders.mT).squeeze(1)
        spikes = self.memory.fire((self.memory.charged * (1.0 - current)).unsqueeze(0))[0]
        error_now = self.error_output(seen)
        passed = self.recalled
        if c.relay:
            passed = self.relay(passed.unsqueeze(0))[0] @ self.relay_decoders[0]
        decoded = torch.bmm(spikes.unsqueeze(1), self.decoders).squeeze(1) / dt
        self.activity_hz = lowpass(self.activity_hz, spikes / dt, synapse(_TAU_RECALL_S, dt))
        error = self.rule if plasticity is None else self.rule * plasticity.unsqueeze(-1)
        if c.pes_rate > 0:
            rate = c.pes_rate * dt / c.neurons
            self.decoders = pes_step(self.decoders, error, self.activity_hz, rate)
        if c.voja_rate > 0:
            rate = c.voja_rate * (seen if voja is None else voja).unsqueeze(-1)
            self.encoders = voja_step(self.encoders, self.gain, spikes, key, rate)
        kept = synapse(_TAU_ERROR_S, dt)
        self.relayed = lowpass(self.relayed, passed, kept)
        self.recalled = lowpass(self.recalled, decoded, synapse(_TAU_RECALL_S, dt))
        self.taught = lowpass(self.taught, value, synapse(_TAU_TEACHER_S, dt))
        self.rule = lowpass(self.rule, error_now, kept)
        return self.recalled

    def advance(
        self,
        key: np.ndarray,
        value: np.ndarray,
        seen: np.ndarray,
        plasticity: np.ndarray,
        voja: np.ndarray,
    ) -> np.ndarray:
        """Step as :meth:`forward` does, compiled; arguments are its own."""
        step, keep = self.stepper()
        recalled = step(key, value, seen, plasticity, voja, np.zeros(len(key), dtype=np.bool_))
        keep()
        return recalled

    def stepper(self) -> Stepper:
        """Return a function that steps as :meth:`advance` does, and one that keeps the state.

        The first takes one argument more: whether an animal's key is that of the step before,
        ``(batch,)``; not so in the first step. Its array is changed by the step after the next.
        """
        memory, error = self.memory, self.error
        names = "rule", "relayed", "taught", "recalled"
        rule, relayed, taught, recalled = (view(self, name).copy() for name in names)
        encoders, decoders, gain = (view(self, n) for n in ("encoders", "decoders", "gain"))
        activity, bias = view(self, "activity_hz"), view(memory, "bias")
        rates = self._rates
        if rates is None or rates.dtype != rule.dtype:
            rates = self._rates = self._constants(rule.dtype)
        spare, wrong = np.empty_like(rule), np.empty_like(rule[0])
        drive = np.zeros((1, *activity.shape), dtype=rule.dtype)
        said, spikes = np.zeros_like(activity), np.zeros_like(activity)
        answer = error.responder(view(self, "error_decoders"))
        pass_on = None
        if self.config.relay:
            pass_on = self.relay.responder(view(self, "relay_decoders"))
        drive_, memorise_ = drive_by_keys.dispatcher(), memorise.dispatcher()
        one, silence, fire = rates[7], rates[8], memory.firer()

        def step(
            key: np.ndarray,
            value: np.ndarray,
            seen: np.ndarray,
            plasticity: np.ndarray,
            voja: np.ndarray,
            same: np.ndarray,
        ) -> np.ndarray:
            nonlocal recalled, spare, spikes
            drive_(key, encoders, bias[0], spikes, same, rates, said, drive[0])
            spikes = fire(drive)[0]
            error_now = answer((relayed - taught)[None], silence * (one - seen))[0]
            passed = recalled if pass_on is None else pass_on(recalled[None], None)[0]
            memorise_(
                spikes, key, plasticity, voja, gain, encoders, decoders, activity,
                (rule, recalled, relayed, taught), (error_now, passed, value), rates,
                (rule, spare, relayed, taught, wrong),
            )  # fmt: skip
            recalled, spare = spare, recalled
            return recalled

        def keep() -> None:
            replace(self, rule=rule, recalled=recalled, relayed=relayed, taught=taught)

        return step, keep

    def _constants(self, kind: np.dtype) -> np.ndarray:
        """Return the rates of ``memorise``, and those of the drive; the last is 0."""
        c, dt = self.config, self.time_step_s
        numbers = [
            1.0 / dt,
            c.pes_rate * dt / c.neurons,
            c.voja_rate,
            *(synapse(tau, dt) for tau in (_TAU_RECALL_S, _TAU_ERROR_S, _TAU_TEACHER_S)),
            self.memory.charged,
            1.0,
            self.error.charged * _INHIBITION,
            0.0,
        ]
        return np.array(numbers, dtype=kind)

    def error_output(self, seen: Tensor) -> Tensor:
        """Step the neurons of the error; return their unfiltered output, ``(batch, n_value)``."""
        current = self.error.currents((self.relayed - self.taught).unsqueeze(0))
        missing = 1.0 - current + _INHIBITION * (1.0 - seen).unsqueeze(-1)
        return self.error.fire(self.error.charged * missing)[0] @ self.error_decoders[0]

    @property
    def n_neurons(self) -> int:
        """Number of neurons of one animal, in all populations."""
        parts = [self.memory, self.error] + ([self.relay] if self.config.relay else [])
        return sum(part.n_neurons for part in parts)

    @torch.no_grad()
    def read(self, keys: Tensor) -> Tensor:
        """Return the recall at rest, without learning or stepping.

        Args:
            keys: ``(n, n_key)``.

        Returns:
            ``(batch, n, n_value)``.
        """
        return self.respond(keys) @ self.decoders

    def respond(self, keys: Tensor) -> Tensor:
        """Return the rates of the memory to keys, ``(batch, n, neurons)``."""
        current = self.memory.bias + keys.to(self.encoders) @ self.encoders.mT
        return rates(current, self.memory.config, self.time_step_s)

    @torch.no_grad()
    def write(self, keys: Tensor, values: Tensor) -> None:
        r"""Make keys recall values, and forget earlier ones, for all animals.

        .. math:: D = A^\top (A A^\top)^{-1} V

        with the rates :math:`A` to the keys: the weights of least norm.

        Args:
            keys: ``(n, n_key)``.
            values: ``(n, n_value)``.
        """
        a = self.respond(keys).double()
        gram = a @ a.mT
        ridge = 1e-6 * gram.diagonal(dim1=-2, dim2=-1).mean(-1)[:, None, None]
        gram = gram + ridge * torch.eye(len(keys), dtype=gram.dtype, device=gram.device)
        weights = a.mT @ torch.linalg.solve(gram, values.to(a).expand(len(a), -1, -1))
        self.decoders = weights.to(self.decoders.dtype).contiguous()


def _identity(neurons: NeuronArray, radius: float, draw: torch.Generator) -> Tensor:
    """Decoders of the represented vector itself, for vectors anywhere in the ball."""
    dimensions = neurons.weights.shape[-1]
    points = torch.randn(1, _SOLVER_POINTS, dimensions, generator=draw)
    share = torch.rand(1, _SOLVER_POINTS, 1, generator=draw) ** (1.0 / dimensions)
    points = radius * share * points / points.norm(dim=-1, keepdim=True)
    return solve_decoders(rates(neurons.currents(points), neurons.config), points)
