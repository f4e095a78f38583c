"""Grid cells: a lateral anti-Hebbian network (LAHN) that learns hexagons from phases."""

import math
from typing import NamedTuple, cast

import numpy as np
import torch
from torch import Tensor, nn

from neuroslam.cells.convolve import convolve_axes, gaussian_difference
from neuroslam.cells.oscillators import wave_vectors
from neuroslam.compiled import compiled
from neuroslam.config import GridCellConfig
from neuroslam.state.mergeable import Arrays, BufferModule

_DEVELOPMENT_BATCH = 64
_DEVELOPMENT_RANGE_M = 100.0
_KEPT = 8
SETTLING_STEPS = 24
"""Steps after which the rates at rest no longer change; see :meth:`LAHNGridCells.settled`."""

_developed: dict[tuple[str, torch.dtype], dict[str, Tensor]] = {}


class LAHNWeights(NamedTuple):
    r"""Weights of a lateral anti-Hebbian network.

    Attributes:
        feedforward: :math:`Q`, ``(n_modules, n_cells, n_inputs)``, rows of unit norm.
        lateral: :math:`W \le 0`, ``(n_modules, n_cells, n_cells)``, zero diagonal.
        threshold: Drive above which a cell learns, ``(n_modules, n_cells)``.
        bias: Drive above which a cell fires, the same shape.
    """

    feedforward: Tensor
    lateral: Tensor
    threshold: Tensor
    bias: Tensor


def lahn_drive(inputs: Tensor, rates: Tensor, feedforward: Tensor, lateral: Tensor) -> Tensor:
    r"""Return the input currents of the cells.

    .. math:: \xi_i = \sum_j q_{ij} x_j + \sum_k w_{ik} r_k(t-1)

    (SLRB, Eq. 12).

    Args:
        inputs: :math:`x`, ``(..., n_modules, n_inputs)``.
        rates: :math:`r(t-1)`, ``(..., n_modules, n_cells)``.
        feedforward: :math:`Q`, ``(n_modules, n_cells, n_inputs)``.
        lateral: :math:`W`, ``(n_modules, n_cells, n_cells)``.
    """
    # Modules in front: one matrix product each for all animals, and no weights copied for them.
    x, r = (v.reshape(-1, *v.shape[-2:]).transpose(0, 1) for v in (inputs, rates))
    drive = torch.baddbmm(torch.bmm(x, feedforward.mT), r, lateral.mT)
    return drive.transpose(0, 1).reshape(rates.shape)


def sheet_of(n_cells: int) -> tuple[int, int]:
    """Return rows and columns of the torus on which the cells of a module lie, nearly a square.

    Example:
        >>> sheet_of(24), sheet_of(7)
        ((4, 6), (1, 7))
    """
    rows = max(d for d in range(1, math.isqrt(n_cells) + 1) if n_cells % d == 0)
    return rows, n_cells // rows


def lateral_kernel(config: GridCellConfig) -> Tensor:
    r"""Return the weights by which the cells of a module excite and inhibit each other.

    .. math:: K * r = g_E \, G_E * r - g_I \, G_I * r

    by circular convolution on the sheet of :func:`sheet_of`; as a matrix, for so few cells.

    Args:
        config: Strengths and widths.

    Returns:
        ``(n_cells, n_cells)``, ``float64``.

    Example:
        >>> kernel = lateral_kernel(GridCellConfig(n_cells=24))
        >>> kernel[0].argmax().item(), kernel.sum().abs().item() < 1e-9
        (0, True)
    """
    c, sizes = config, sheet_of(config.n_cells)
    odd = [size - 1 + size % 2 for size in sizes]
    kernels = gaussian_difference(
        [(min(5, size), c.excitation_cells) for size in odd],
        [(size, c.inhibition_cells) for size in odd],
    )
    each = torch.eye(c.n_cells, dtype=torch.float64).reshape(-1, *sizes)
    near, far = (convolve_axes(each, kernel) for kernel in kernels)
    return (c.excitation * near - c.inhibition * far).flatten(1).T.contiguous()


def lahn_learn(
    inputs: Tensor, drive: Tensor, weights: LAHNWeights, config: GridCellConfig
) -> LAHNWeights:
    r"""Return the weights after learning from inputs and their drive (Földiák 1990; Oja 1982).

    .. math:: s &= [\xi - \theta]_+^2, \\
              \Delta Q &= \eta\, s\,(x - (Qx)\,Q)^\top \text{, rows to unit norm}, \\
              \Delta W &= -\mu\,(s s^\top - \rho^2), \quad W \le 0, \quad W_{ii} = 0, \\
              \Delta\theta &= \gamma\,(s - \rho)

    The square lets the rule climb :math:`E[s^3]`. Of waves 60 degrees apart that is greatest for
    equal amplitudes whose phases close, which is a hexagon; a linear rule returns any mixture.
    The firing bias follows the quantile of the drive below which a cell is silent.

    Args:
        inputs: :math:`x`, ``(samples, n_modules, n_inputs)``.
        drive: :math:`\xi`, ``(samples, n_modules, n_cells)``.
        weights: Weights before.
        config: Learning rates.

    Returns:
        Weights after.
    """
    q, w, threshold, bias = weights
    n = len(inputs)
    s = (drive - threshold).clamp_min(0.0).square()
    onto = (q @ inputs.unsqueeze(-1)).squeeze(-1)
    hebb = torch.einsum("smc,smi->mci", s, inputs) / n - (s * onto).mean(0).unsqueeze(-1) * q
    q = q + config.hebbian_rate * hebb
    q = q / q.norm(dim=-1, keepdim=True)
    together = torch.einsum("smc,smk->mck", s, s) / n
    w = (w - config.lateral_rate * (together - config.sparseness**2)).clamp_max(0.0)
    w = w * (1.0 - torch.eye(w.shape[-1], dtype=w.dtype, device=w.device))
    threshold = threshold + config.threshold_rate * (s.mean(0) - config.sparseness)
    fires = (drive > bias).to(bias).mean(0)
    bias = bias + config.threshold_rate * (fires - (1.0 - config.silent_fraction))
    return LAHNWeights(q, w, threshold, bias)


@compiled
def rates_step(
    phases: np.ndarray, feedforward: np.ndarray, lateral: np.ndarray, bias: np.ndarray,
    rates: np.ndarray,
) -> None:  # fmt: skip
    """Compute the rates of one animal from :func:`lahn_drive`, in place."""
    n_modules, n_cells, n_inputs = feedforward.shape
    x = np.empty(n_inputs, np.float32)
    before = np.empty(n_cells, np.float32)
    for m in range(n_modules):
        for k in range(n_inputs):
            x[k] = phases[m, k // 2, k % 2]
        for i in range(n_cells):
            before[i] = rates[m, i]
        for i in range(n_cells):
            drive = np.float32(0.0)
            for k in range(n_inputs):
                drive += feedforward[m, i, k] * x[k]
            # Four sums side by side: each alone would wait for its last addition.
            a = b = c = d = np.float32(0.0)
            for k in range(0, n_cells - 3, 4):
                a += lateral[m, i, k] * before[k]
                b += lateral[m, i, k + 1] * before[k + 1]
                c += lateral[m, i, k + 2] * before[k + 2]
                d += lateral[m, i, k + 3] * before[k + 3]
            for k in range(n_cells - n_cells % 4, n_cells):
                a += lateral[m, i, k] * before[k]
            rates[m, i] = max(drive + ((a + b) + (c + d)) - bias[m, i], np.float32(0.0))


@compiled
def learn_step(
    phases: np.ndarray, feedforward: np.ndarray, lateral: np.ndarray, threshold: np.ndarray,
    bias: np.ndarray, numbers: np.ndarray,
) -> None:  # fmt: skip
    """Learn from the phases of one animal at settled rates by :func:`lahn_learn`, in place.

    ``numbers`` are the rates of learning of the weights, the inhibition and the thresholds, the
    sparseness and the silent fraction.
    """
    n_modules, n_cells, n_inputs = feedforward.shape
    hebb, anti, slow, sparse, silent = numbers
    x = np.empty(n_inputs, np.float32)
    onto, rates, s = (
        np.empty(n_cells, np.float32), np.empty(n_cells, np.float32), np.empty(n_cells, np.float32)
    )  # fmt: skip
    for m in range(n_modules):
        for k in range(n_inputs):
            x[k] = phases[m, k // 2, k % 2]
        for i in range(n_cells):
            drive = np.float32(0.0)
            for k in range(n_inputs):
                drive += feedforward[m, i, k] * x[k]
            onto[i], rates[i] = drive, max(drive - bias[m, i], np.float32(0.0))
        for i in range(n_cells):
            drive = onto[i]
            for k in range(n_cells):
                drive += lateral[m, i, k] * rates[k]
            above = max(drive - threshold[m, i], np.float32(0.0))
            s[i] = above * above
            fires = np.float32(1.0 if drive > bias[m, i] else 0.0)
            threshold[m, i] += slow * (s[i] - sparse)
            bias[m, i] += slow * (fires - (np.float32(1.0) - silent))
        for i in range(n_cells):
            square = np.float32(0.0)
            for k in range(n_inputs):
                feedforward[m, i, k] += hebb * s[i] * (x[k] - onto[i] * feedforward[m, i, k])
                square += feedforward[m, i, k] * feedforward[m, i, k]
            norm = np.float32(math.sqrt(square))
            for k in range(n_inputs):
                feedforward[m, i, k] /= norm
            for k in range(n_cells):
                less = lateral[m, i, k] - anti * (s[i] * s[k] - sparse * sparse)
                lateral[m, i, k] = np.float32(0.0) if k == i else min(less, np.float32(0.0))


class LAHNGridCells(BufferModule):
    """Modules of grid cells that learn, without a teacher, from the phases of oscillators.

    :func:`lahn_drive`, :func:`lateral_kernel` and :func:`lahn_learn` have the mathematics. A
    network is made with weights that developed at random positions, without an environment; with
    ``learns_online`` it continues while the animal moves, by smaller steps: positions in a row are
    alike, and steps as large as those of development let the fields wander. State: the parameters
    ``feedforward`` and ``lateral``, the buffers ``threshold``, ``bias`` and ``rates``, and the
    generator of its random weights. Animals of a batch share one network.

    Args:
        config: Modules, cells, learning rates.
        batch: Number of animals side by side, or ``None`` for one.

    Example:
        >>> from neuroslam.cells.oscillators import VelocityOscillators
        >>> config = GridCellConfig(development_steps=10)
        >>> cells, oscillators = LAHNGridCells(config), VelocityOscillators(config)
        >>> cells(oscillators(torch.tensor([0.2, 0.1]), dt_s=0.05)).shape
        torch.Size([4, 24])
    """

    threshold: Tensor
    bias: Tensor
    rates: Tensor
    kernel: Tensor
    generator_state: Tensor

    def __init__(self, config: GridCellConfig, batch: int | None = None) -> None:
        super().__init__()
        self.config = config
        self.batch = batch
        rates = ("hebbian_rate", "lateral_rate", "threshold_rate")
        slower = {name: config.online_share * getattr(config, name) for name in rates}
        self._online = c = config.model_copy(update=slower)
        self._numbers = np.array(
            [c.hebbian_rate, c.lateral_rate, c.threshold_rate, c.sparseness, c.silent_fraction],
            np.float32,
        )
        m, n, inputs = len(config.spacings_m), config.n_cells, 2 * config.directions
        generator = torch.Generator().manual_seed(config.seed)
        start = torch.randn(m, n, inputs, generator=generator)
        weights = LAHNWeights(
            start / start.norm(dim=-1, keepdim=True),
            torch.zeros(m, n, n),
            torch.zeros(m, n),
            torch.zeros(m, n),
        )
        self.feedforward = nn.Parameter(weights.feedforward)
        self.lateral = nn.Parameter(weights.lateral)
        self.register_buffer("threshold", weights.threshold)
        self.register_buffer("bias", weights.bias)
        lead = () if batch is None else (batch,)
        self.register_buffer("rates", torch.zeros(*lead, m, n))
        kernel = lateral_kernel(config).to(weights.bias)
        self.register_buffer("kernel", kernel, persistent=False)
        self.register_buffer("generator_state", generator.get_state())
        self._develop_once()

    def _develop_once(self) -> None:
        """Develop; of one config a process works it out once, as each brain that is loaded asks."""
        key = self.config.model_dump_json(), self.bias.dtype
        if key in _developed:
            self.load_state_dict({**self.state_dict(), **_developed[key]})
            return
        self.develop(self.config.development_steps)
        while len(_developed) >= _KEPT:
            _developed.pop(next(iter(_developed)))
        learnt = (*LAHNWeights._fields, "generator_state")
        _developed[key] = {name: self.state_dict()[name].clone() for name in learnt}

    @property
    def weights(self) -> LAHNWeights:
        """The learnt weights."""
        return LAHNWeights(self.feedforward, self.lateral, self.threshold, self.bias)

    @property
    def coupling(self) -> Tensor:
        """Lateral weights in use, ``(n_modules, n_cells, n_cells)``: learned, a kernel, or both."""
        if self.config.lateral == "kernel":
            return self.kernel.expand_as(self.lateral)
        return self.lateral if self.config.lateral == "learned" else self.lateral + self.kernel

    @torch.no_grad()
    def develop(self, steps: int) -> None:
        """Learn from phases at random positions, before the first frame."""
        c = self.config
        generator = torch.Generator()
        generator.set_state(self.generator_state)
        kind = self.bias.dtype
        waves = wave_vectors(
            torch.tensor(c.spacings_m, dtype=kind),
            torch.tensor(c.orientations_deg, dtype=kind).deg2rad(),
            c.directions,
        )
        for _ in range(steps):
            at = torch.rand(_DEVELOPMENT_BATCH, 2, generator=generator) - 0.5
            angle = torch.einsum("mjd,sd->smj", waves, _DEVELOPMENT_RANGE_M * at)
            self.learn(torch.stack([angle.cos(), angle.sin()], dim=-1).flatten(-2))
        self.generator_state = generator.get_state()

    @torch.no_grad()
    def learn(self, inputs: Tensor, config: GridCellConfig | None = None) -> None:
        """Learn from inputs at settled rates.

        Args:
            inputs: ``(samples, n_modules, 2 * directions)``.
            config: Learning rates; ``None``: those of development.
        """
        q, _, _, bias = self.weights
        rates = (inputs.unsqueeze(-2) @ q.mT).squeeze(-2).sub(bias).clamp_min(0.0)
        drive = lahn_drive(inputs, rates, q, self.coupling)
        learnt = lahn_learn(inputs, drive, self.weights, config or self.config)
        self.feedforward.copy_(learnt.feedforward)
        if self.config.lateral != "kernel":
            self.lateral.copy_(learnt.lateral)
        self.threshold, self.bias = learnt.threshold, learnt.bias

    def forward(self, phases: Tensor) -> Tensor:
        r"""Return the rates :math:`[\xi - b]_+` for the phases of the oscillators.

        Args:
            phases: Cosine and sine, ``([batch,] n_modules, directions, 2)``.

        Returns:
            ``([batch,] n_modules, n_cells)``, non-negative.
        """
        inputs = phases.flatten(-2).to(self.bias.dtype)
        drive = lahn_drive(inputs, self.rates, self.feedforward, self.coupling)
        rates = (drive - self.bias).clamp_min(0.0)
        self.rates = rates.detach()
        if self.config.learns_online:
            with torch.no_grad():
                self.learn(inputs.detach().reshape(-1, *inputs.shape[-2:]), self._online)
        return rates

    def settled(self, phases: Tensor) -> Tensor:
        r"""Return the rates at rest for phases that stay; neither the state nor the weights change.

        .. math:: r \leftarrow [Q x + W r - b]_+ \quad \text{from } r = 0,

        :data:`SETTLING_STEPS` times. Gradients flow to the weights and to the phases.

        Args:
            phases: Cosine and sine, ``(..., n_modules, directions, 2)``.

        Returns:
            ``(..., n_modules, n_cells)``, non-negative.
        """
        inputs = phases.flatten(-2).to(self.bias.dtype)
        rates = inputs.new_zeros(*inputs.shape[:-1], self.config.n_cells)
        for _ in range(SETTLING_STEPS):
            drive = lahn_drive(inputs, rates, self.feedforward, self.coupling)
            rates = (drive - self.bias).clamp_min(0.0)
        return rates

    def rates_compiled(self, phases: np.ndarray) -> np.ndarray:
        """Do as :meth:`forward` for one animal, in place."""
        feedforward, lateral, threshold, bias, rates, *_ = cast(Arrays, self.arrays())
        is_learnt = self.config.lateral == "learned"
        if not is_learnt:
            lateral = self.coupling.detach().contiguous().numpy()
        rates_step(phases, feedforward, lateral, bias, rates)
        if self.config.learns_online and is_learnt:
            learn_step(phases, feedforward, lateral, threshold, bias, self._numbers)
        elif self.config.learns_online:
            inputs = torch.from_numpy(phases).flatten(-2).to(self.bias.dtype)
            self.learn(inputs[None], self._online)
        return rates
