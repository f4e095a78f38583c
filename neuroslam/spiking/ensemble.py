"""Populations of neurons that represent vectors: tuning, decoders, synapses (NEF)."""

import math
import operator
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from torch import Tensor

from neuroslam.compiled import compiled, runs_compiled
from neuroslam.config.semantic import NeuronConfig
from neuroslam.spiking.neurons import (
    LIFState,
    Membrane,
    fire_row,
    lif_constants,
    lif_rate,
    lif_step,
    respond,
    resting,
    stepped_lif,
    stepped_lif_rate,
)
from neuroslam.spiking.rounding import rounded
from neuroslam.state.mergeable import BufferModule

Stepper = tuple[Callable[..., np.ndarray], Callable[[], None]]
"""A function that advances a part of a network by a step, on copies of its buffers, and one that
sets the buffers to them: for many steps, in which only numbers change."""


class Tuning(NamedTuple):
    r"""Tuning of neurons: :math:`J = \alpha\,e \cdot x / r + \beta`.

    Attributes:
        encoders: :math:`e`, unit vectors, ``(groups, neurons, dimensions)``.
        gain: :math:`\alpha`, ``(groups, neurons)``.
        bias: :math:`\beta`, the same shape.
        radius: :math:`r`, largest length of what is represented.
    """

    encoders: Tensor
    gain: Tensor
    bias: Tensor
    radius: float

    @property
    def weights(self) -> Tensor:
        """Encoders with the gain and the radius in them."""
        return self.encoders * (self.gain / self.radius).unsqueeze(-1)


def sample_tuning(
    groups: int,
    neurons: int,
    dimensions: int,
    config: NeuronConfig,
    generator: torch.Generator,
    radius: float = 1.0,
    encoders: Tensor | None = None,
    intercept: float | None = None,
) -> Tuning:
    r"""Draw neurons whose rates at their encoders and whose intercepts are uniform.

    .. math:: a(1) = r_{max}, \quad J(c) = 1 \quad \Rightarrow \quad
              \alpha = \frac{J_{max} - 1}{1 - c}, \quad \beta = 1 - \alpha c

    Args:
        groups: Populations of the same size, side by side.
        neurons: In each.
        dimensions: Of what each represents.
        config: Rates and intercepts.
        generator: Of the draw.
        radius: Largest length of what is represented.
        encoders: Of unit length; ``None``: uniform on the sphere.
        intercept: The same for all; ``None``: drawn from the config's range.

    Example:
        >>> draw = torch.Generator().manual_seed(0)
        >>> tuning = sample_tuning(1, 4, 2, NeuronConfig(max_rate_hz=(200, 200)), draw)
        >>> strongest = tuning.gain + tuning.bias
        >>> lif_rate(strongest).round().tolist()
        [[200.0, 200.0, 200.0, 200.0]]
    """

    def uniform(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(groups, neurons, generator=generator)

    if encoders is None:
        encoders = torch.randn(groups, neurons, dimensions, generator=generator)
        encoders = encoders / encoders.norm(dim=-1, keepdim=True)
    rate = uniform(*config.max_rate_hz)
    c = uniform(*config.intercept) if intercept is None else torch.full_like(rate, intercept)
    if config.model == "relu":
        gain = rate / (1.0 - c)
        return Tuning(encoders, gain, -gain * c, radius)
    # The inverse of the rate, as a current above threshold.
    excess = 1.0 / torch.expm1((1.0 / rate - config.tau_ref_s) / config.tau_rc_s)
    gain = excess / (1.0 - c)
    return Tuning(encoders, gain, 1.0 - gain * c, radius)


def rates(current: Tensor, config: NeuronConfig, time_step_s: float = 1e-3) -> Tensor:
    """Return the rates of neurons of a model under constant currents, in Hz."""
    if config.model == "relu":
        return current.clamp_min(0.0)
    membrane = Membrane(config.tau_rc_s, config.tau_ref_s)
    if config.model == "stepped_lif":
        return stepped_lif_rate(current, membrane, time_step_s)
    return lif_rate(current, membrane)


def solve_decoders(activity: Tensor, targets: Tensor, noise: float = 0.1) -> Tensor:
    r"""Solve for the weights that decode a function from rates, robust to noise.

    .. math:: D = (A^\top A + n \sigma^2 I)^{-1} A^\top Y

    with :math:`\sigma` the noise times the highest rate (NEF; Eliasmith and Anderson 2003).

    Args:
        activity: :math:`A`, rates at ``n`` points, ``(groups, n, neurons)``.
        targets: :math:`Y`, ``(groups, n, outputs)``.
        noise: As a share of the highest rate.

    Returns:
        ``(groups, neurons, outputs)``.

    Example:
        >>> rates = torch.rand(1, 50, 8, generator=torch.Generator().manual_seed(0))
        >>> solve_decoders(rates, rates[..., :2], noise=1e-6).round(decimals=2)[0, :3].tolist()
        [[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]]
    """
    a = activity.double()
    gram = a.mT @ a
    sigma = noise * a.amax((-2, -1))
    ridge = (a.shape[-2] * sigma.square())[:, None] * torch.ones_like(gram[..., 0])
    factor = torch.linalg.cholesky(gram + torch.diag_embed(ridge))
    return torch.cholesky_solve(a.mT @ targets.double(), factor).to(activity.dtype)


def synapse(tau_s: float, time_step_s: float) -> float:
    r"""Return the decay of a lowpass over a step, :math:`e^{-\Delta t/\tau}`; 0 without one."""
    return math.exp(-time_step_s / tau_s) if tau_s > 0 else 0.0


def lowpass(filtered: Tensor, value: Tensor, kept: float) -> Tensor:
    r"""Filter a value, :math:`y \leftarrow a y + (1 - a) u` (Eq. 10, zero-order hold)."""
    return torch.lerp(value, filtered, kept)


class _Views(dict[str, tuple[Tensor, np.ndarray]]):
    """Arrays that share the memory of buffers; a copy of the module makes its own."""

    def __deepcopy__(self, memo: object) -> "_Views":
        return _Views()

    def __reduce__(self) -> tuple[type, tuple[()]]:
        return _Views, ()


class Remembered:
    """What a module looks up once for its compiled steps; a copy of the module does so again."""

    def __init__(self) -> None:
        self.of: tuple[object, ...] = ()
        self.value: Any = None

    def holds(self, of: tuple[object, ...]) -> bool:
        """Return whether the value was made of these very objects."""
        return len(of) == len(self.of) and all(map(operator.is_, self.of, of))

    def __deepcopy__(self, memo: object) -> "Remembered":
        return Remembered()

    def __reduce__(self) -> tuple[type, tuple[()]]:
        return Remembered, ()


def view(module: BufferModule, name: str) -> np.ndarray:
    """Return a buffer as an array that shares its memory, for compiled steps."""
    buffer = module._buffers[name]
    views = module.__dict__.get("_views")
    if views is None:
        views = module.__dict__["_views"] = _Views()
    known = views.get(name)
    if known is not None and known[0] is buffer:
        return known[1]
    assert buffer is not None
    if not buffer.is_contiguous():
        module._buffers[name] = buffer = buffer.contiguous()
    array = buffer.numpy()
    views[name] = buffer, array
    return array


def replace(module: BufferModule, **arrays: np.ndarray) -> None:
    """Set buffers to arrays."""
    views = module.__dict__.get("_views")
    if views is None:
        views = module.__dict__["_views"] = _Views()
    for name, array in arrays.items():
        module._buffers[name] = buffer = torch.from_numpy(array)
        views[name] = buffer, array


def may_share(module: BufferModule, *names: str) -> bool:
    """Return whether compiled steps may take these buffers; quick for those that they have set."""
    views = module.__dict__.get("_views") or {}
    for name in names:
        buffer, known = cast(Tensor, module._buffers[name]), views.get(name)
        shared = known is not None and known[0] is buffer and not buffer.requires_grad
        if not shared and not runs_compiled(buffer):
            return False
    return True


def filtered(before: np.ndarray, value: np.ndarray, kept: float) -> np.ndarray:
    """Filter coefficients, ``(batch, n_frequencies, 2)``, as :func:`lowpass` does."""
    after = np.empty_like(before)
    filter_into(before.reshape(-1), value.reshape(-1), kept, after.reshape(-1))
    return after


@compiled
def filter_into(before: np.ndarray, value: np.ndarray, kept: float, after: np.ndarray) -> None:
    """Filter numbers into ``after``; :func:`lowpass` is the definition.

    What has faded is 0: below 1e-38 numbers are several times slower.
    """
    for i in range(before.shape[0]):
        left = value[i] + kept * (before[i] - value[i])
        after[i] = left if abs(left) > 1e-30 else 0.0


class NeuronArray(BufferModule):
    """Populations of the same size, side by side: currents in, spikes out.

    :func:`neuroslam.spiking.neurons.lif_step` has the mathematics. Groups lead and animals come
    second, so that one batched matrix product serves all of them. State: ``weights`` (encoders with
    gain) and ``bias``, both rounded if the config has ``weight_bits``, and what each neuron
    carries, ``deficit`` and ``asleep``. What fired in the last step are in ``spikes``, for
    recorders.

    Args:
        tuning: What the neurons respond to.
        config: Their model.
        time_step_s: Length of a step.
        generator: Of the voltages at the start.
        batch: Animals side by side.

    Example:
        >>> draw = torch.Generator().manual_seed(0)
        >>> tuning = sample_tuning(1, 100, 2, NeuronConfig(), draw)
        >>> neurons = NeuronArray(tuning, NeuronConfig(), 1e-3, draw)
        >>> neurons(torch.ones(1, 1, 2)).shape
        torch.Size([1, 1, 100])
    """

    weights: Tensor
    bias: Tensor
    deficit: Tensor
    asleep: Tensor
    spikes: Tensor

    def __init__(
        self,
        tuning: Tuning,
        config: NeuronConfig,
        time_step_s: float,
        generator: torch.Generator,
        batch: int = 1,
    ) -> None:
        super().__init__()
        self.config = config
        self.time_step_s = time_step_s
        self.membrane = Membrane(config.tau_rc_s, config.tau_ref_s)
        weights, bias, bits = tuning.weights, tuning.bias, config.weight_bits
        self.register_buffer("weights", rounded(weights, bits) if bits else weights)
        self.register_buffer("bias", rounded(bias, bits) if bits else bias)
        groups, neurons = tuning.bias.shape
        start = torch.rand(groups, 1, neurons, generator=generator).expand(-1, batch, -1)
        state = resting(start.contiguous())
        self.register_buffer("deficit", state.deficit)
        self.register_buffer("asleep", state.asleep)
        self.register_buffer("spikes", torch.zeros_like(state.deficit), persistent=False)
        self._folded: _Folded | None = None

    @property
    def charged(self) -> float:
        """Share by which a voltage approaches its current in a step."""
        return 1.0 - self.membrane.keeps(self.time_step_s)

    @property
    def n_neurons(self) -> int:
        """Number of neurons of one animal, in all groups."""
        return self.bias.numel()

    def currents(self, x: Tensor) -> Tensor:
        """Return the currents that vectors cause, ``(groups, points, dimensions)`` in."""
        return torch.baddbmm(self.bias.unsqueeze(1), x, self.weights.mT)

    def rates(self, x: Tensor) -> Tensor:
        """Return the rates under constant input, Hz; ``(groups, points, neurons)``."""
        return rates(self.currents(x), self.config, self.time_step_s)

    def solve(self, points: Tensor, targets: Tensor, noise: float = 0.1) -> Tensor:
        """Solve for decoders of a function, see :func:`solve_decoders`.

        One group after the other: the rates of all groups at all points fill no cache.

        Args:
            points: ``(groups, n, dimensions)``.
            targets: The function there, ``(groups, n, outputs)``.
            noise: As a share of the highest rate.

        Returns:
            ``(groups, neurons, outputs)``.
        """
        solved = []
        for g in range(len(points)):
            own = slice(g, g + 1)
            current = torch.baddbmm(self.bias[own, None], points[own], self.weights[own].mT)
            activity = rates(current, self.config, self.time_step_s)
            solved.append(solve_decoders(activity, targets[own], noise))
        return torch.cat(solved)

    def forward(self, x: Tensor) -> Tensor:
        """Step with vectors as input, ``(groups, batch, dimensions)``."""
        share = self.charged
        rest = (share * (1.0 - self.bias)).unsqueeze(1)
        return self.fire(torch.baddbmm(rest, x, self.weights.mT, alpha=-share))

    def drive_on_line(self, x: Tensor) -> Tensor:
        """Return the drive of neurons for one dimension, ``(groups, batch, 1)`` in.

        Products of numbers, which is quicker than of matrices with one column.
        """
        share = self.charged
        rest, slope = share * (1.0 - self.bias), self.weights.squeeze(-1)
        return torch.addcmul(rest.unsqueeze(1), x, slope.unsqueeze(1), value=-share)

    def fire(self, drive: Tensor) -> Tensor:
        """Step with currents as input.

        Args:
            drive: One minus the current, times ``charged``, ``(groups, batch, neurons)``.

        Returns:
            Spikes in this step, 0 or 1; of rates, how many are to be expected. Same shape.
        """
        model = self.config.model
        if self._has_rates:
            return rates(1.0 - drive / self.charged, self.config) * self.time_step_s
        if self.runs_compiled(drive):
            return torch.from_numpy(self.fire_compiled(drive.contiguous().numpy()).copy())
        step = lif_step if model == "lif" else stepped_lif
        state = LIFState(self.deficit, self.asleep)
        state, fired = step(state, drive, self.membrane, self.time_step_s)
        self.deficit, self.asleep = state
        self.spikes = fired
        return fired

    @property
    def _has_rates(self) -> bool:
        return self.config.model in ("lif_rate", "relu")

    def runs_compiled(self, *tensors: Tensor) -> bool:
        """Return whether a compiled step may advance the neurons and take these tensors."""
        weights = cast(Tensor, self._buffers["weights"])
        return runs_compiled(weights, *tensors) and may_share(self, "deficit", "asleep")

    def respond(
        self, x: np.ndarray, decoders: np.ndarray, more: np.ndarray | None = None
    ) -> np.ndarray:
        """Step with vectors as input, and decode, in one compiled pass.

        The spikes of :meth:`forward` times the decoders. Rates are left to torch: all neurons have
        one, so nothing is gained where few fire, and its logarithm is vectorised.

        Args:
            x: ``(groups, batch, dimensions)``.
            decoders: ``(groups, neurons, outputs)``.
            more: Added to the drive of an animal's neurons, ``(batch,)``; see :meth:`fire`.

        Returns:
            ``(groups, batch, outputs)``.
        """
        folded = self._constants()
        deficit = view(self, "deficit")
        groups, batch, n = deficit.shape
        added = np.zeros(batch, dtype=deficit.dtype) if more is None else more
        if x.shape != (groups, batch, folded.slopes.shape[1]) or decoders.shape[:2] != (groups, n):
            raise ValueError(
                f"NeuronArray: inputs {x.shape} and decoders {decoders.shape} do not fit "
                f"(groups, batch, neurons) = {deficit.shape}"
            )
        if self._has_rates:
            more_t = torch.from_numpy(added).unsqueeze(-1)
            drive = torch.from_numpy(folded.rest).unsqueeze(1) + more_t
            drive = torch.baddbmm(drive, torch.from_numpy(x), torch.from_numpy(folded.slopes))
            return torch.bmm(self.fire(drive), torch.from_numpy(decoders)).numpy()
        asleep, spikes = view(self, "asleep"), self._spikes()
        decoded = np.empty((groups, batch, decoders.shape[2]), dtype=deficit.dtype)
        respond(
            x, added, folded.slopes, folded.rest, deficit, asleep, spikes, decoders, folded.lif,
            decoded,
        )  # fmt: skip
        return decoded

    def responder(
        self, decoders: np.ndarray
    ) -> Callable[[np.ndarray, np.ndarray | None], np.ndarray]:
        """Return :meth:`respond` for many steps, until a buffer of the neurons is replaced.

        What does not change from step to step is looked up once.
        """
        if self._has_rates:
            return lambda x, more: self.respond(x, decoders, more)
        folded, deficit, asleep = self._constants(), view(self, "deficit"), view(self, "asleep")
        spikes, step = self._spikes(), respond.dispatcher()
        slopes, rest, lif = folded.slopes, folded.rest, folded.lif
        nothing = np.zeros(deficit.shape[1], dtype=deficit.dtype)
        shape, kind = (*deficit.shape[:2], decoders.shape[2]), deficit.dtype

        def responded(x: np.ndarray, more: np.ndarray | None) -> np.ndarray:
            decoded = np.empty(shape, kind)
            added = nothing if more is None else more
            step(x, added, slopes, rest, deficit, asleep, spikes, decoders, lif, decoded)
            return decoded

        return responded

    def fire_compiled(self, drive: np.ndarray) -> np.ndarray:
        """Step as :meth:`fire` does, in one compiled pass."""
        deficit = view(self, "deficit")
        if drive.shape != deficit.shape:
            raise ValueError(f"NeuronArray: drive {drive.shape}, expected {deficit.shape}")
        return self.firer()(drive)

    def firer(self) -> Callable[[np.ndarray], np.ndarray]:
        """Return :meth:`fire_compiled` for many steps, until a buffer of the neurons is replaced.

        The spikes that it returns are changed by its next call.
        """
        if self._has_rates:
            return lambda drive: self.fire(torch.from_numpy(drive)).numpy()
        spikes, lif, step = self._spikes(), self._constants().lif, fire_row.dispatcher()
        states = view(self, "deficit"), view(self, "asleep"), spikes
        owing, paused, fired = (each.reshape(-1) for each in states)

        def fire(drive: np.ndarray) -> np.ndarray:
            step(drive.reshape(-1), owing, paused, fired, lif)
            return spikes

        return fire

    def _spikes(self) -> np.ndarray:
        deficit, spikes = view(self, "deficit"), view(self, "spikes")
        if spikes.shape != deficit.shape or spikes.dtype != deficit.dtype:
            replace(self, spikes=np.zeros_like(deficit))  # of a state that was put in
            spikes = view(self, "spikes")
        return spikes

    def given(self) -> tuple[object, ...]:
        """Return the objects that :meth:`responder` takes: others if a buffer was replaced."""
        return self._constants(), view(self, "deficit"), view(self, "asleep"), self._spikes()

    def _constants(self) -> "_Folded":
        """Return what follows from weights and biases; renewed with them."""
        weights, bias = self._buffers["weights"], self._buffers["bias"]
        assert weights is not None
        assert bias is not None
        versions = _version(weights), _version(bias)
        known = self._folded
        if (
            known is None
            or known.weights is not weights
            or known.bias is not bias
            or known.versions != versions
        ):
            share = self.charged
            slopes = (-share * weights).mT.contiguous().numpy()
            rest = (share * (1.0 - bias)).contiguous().numpy()
            stepped = self.config.model == "stepped_lif"
            lif = lif_constants(self.membrane, self.time_step_s, stepped, rest.dtype)
            self._folded = known = _Folded(weights, bias, versions, slopes, rest, lif)
        return known

    def silence(self) -> None:
        """Reset all neurons to rest, at distance 1 from threshold."""
        self.deficit = torch.ones_like(self.deficit)
        self.asleep = torch.zeros_like(self.asleep)


class _Folded(NamedTuple):
    """What compiled steps take of neurons, and of which weights and biases it is made."""

    weights: Tensor
    bias: Tensor
    versions: tuple[int, int]
    slopes: np.ndarray
    rest: np.ndarray
    lif: np.ndarray


def _version(tensor: Tensor) -> int:
    """Return how often a tensor was changed in place; 0 where torch does not count."""
    return 0 if tensor.is_inference() else tensor._version
