"""Grid cells by interference of theta oscillations, a model for comparison."""

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np
import torch
from torch import Tensor, nn

from neuroslam.compiled import compiled, runs_compiled
from neuroslam.errors import ConfigError, MapError
from neuroslam.geometry import TWO_PI

Combine = Literal["product", "sum"]

_WAVE_NUMBER = 4.0 * math.pi / math.sqrt(3.0)
"""Wave number of a hexagonal grid times its spacing."""
_CYCLE = 24
"""Samples of a theta cycle for its mean."""
_SUM_THRESHOLD = 0.6
"""Share of the largest possible sum below which a summing cell is silent."""


def phase_step(phase_rad: Tensor, velocity_m_s: Tensor, waves_rad_m: Tensor, dt_s: float) -> Tensor:
    r"""Advance every dendritic oscillator against the soma by the displacement along its direction.

    .. math:: \varphi_j \leftarrow \varphi_j + \mathbf k_j \cdot \mathbf v \, dt \pmod{2\pi},
              \qquad |\mathbf k_j| = \beta = \frac{4\pi}{\sqrt 3\,\lambda}

    (Burgess, Barry and O'Keefe 2007: :math:`\omega_j = \omega_s + \beta s \cos(\phi - \phi_j)`.)

    Args:
        phase_rad: :math:`\varphi_j`, phase of each relative to the soma, ``(..., modules, waves)``.
        velocity_m_s: Allocentric x and y, ``(..., 2)``.
        waves_rad_m: :math:`\mathbf k_j`, ``(modules, waves, 2)``.
        dt_s: Duration of the step.

    Returns:
        Phases in :math:`[0, 2\pi)`, of the same shape.

    Example:
        >>> east = torch.tensor([[[math.pi, 0.0]]])
        >>> ahead = phase_step(torch.zeros(1, 1), torch.tensor([2.0, 5.0]), east, dt_s=0.25)
        >>> round(ahead.item() / math.pi, 3)
        0.5
    """
    gained = (velocity_m_s[..., None, None, :] * waves_rad_m).sum(-1) * dt_s
    return torch.remainder(phase_rad + gained, TWO_PI)


def interference(
    phase_rad: Tensor, theta_rad: Tensor, combine: Combine, threshold: float
) -> Tensor:
    r"""Return the rate of cells in which dendritic and somatic oscillations interfere.

    .. math:: f = \Theta\Big(\prod_j \tfrac12\big[\cos(\theta + \varphi_j) + \cos\theta\big] - c
              \Big) / (1 - c), \qquad \Theta(x) = [x]_+

    or, by ``sum``, with :math:`\tfrac1n \sum_j` in place of the product (Burgess, Barry and O'Keefe
    2007).

    Args:
        phase_rad: :math:`\varphi_j`, ``(..., n)``.
        theta_rad: :math:`\theta`, the soma's phase, ``(...)``.
        combine: ``product`` or ``sum``.
        threshold: :math:`c`, in ``[0, 1)``.

    Returns:
        Rates in ``[0, 1]``, 1 if all are in phase at the crest; shape ``(...)``.

    Example:
        >>> interference(torch.zeros(3), torch.tensor(0.0), "product", threshold=0.0).item()
        1.0
    """
    crest = 0.5 * (torch.cos(theta_rad[..., None] + phase_rad) + torch.cos(theta_rad)[..., None])
    met = crest.prod(-1) if combine == "product" else crest.mean(-1)
    return (met - threshold).clamp_min(0.0) / (1.0 - threshold)


@compiled
def interference_step(
    phase_rad: np.ndarray, velocity_m_s: np.ndarray, waves_rad_m: np.ndarray, dt_s: float,
    offset_rad: np.ndarray, theta_rad: np.ndarray, product: bool, threshold: float,
    rates: np.ndarray,
) -> None:  # fmt: skip
    """Do as :func:`phase_step` for one animal, in place; write the rates of :func:`interference`.

    Several phases of theta, ``(n,)``, give the mean rate over them.
    """
    n_modules, n_cells, n_waves = offset_rad.shape
    n_thetas = theta_rad.shape[0]
    crests, troughs = np.empty(n_thetas), np.empty(n_thetas)
    for k in range(n_thetas):
        crests[k], troughs[k] = math.cos(theta_rad[k]), math.sin(theta_rad[k])
    for m in range(n_modules):
        for j in range(n_waves):
            along = velocity_m_s[0] * waves_rad_m[m, j, 0] + velocity_m_s[1] * waves_rad_m[m, j, 1]
            phase_rad[m, j] = (phase_rad[m, j] + along * dt_s) % TWO_PI
    c, s = np.empty(n_waves), np.empty(n_waves)
    for m in range(n_modules):
        for i in range(n_cells):
            for j in range(n_waves):
                phase = phase_rad[m, j] - offset_rad[m, i, j]
                c[j], s[j] = 1.0 + math.cos(phase), math.sin(phase)
            total = 0.0
            for k in range(n_thetas):
                met, mean = 1.0, 0.0
                for j in range(n_waves):
                    crest = 0.5 * (crests[k] * c[j] - troughs[k] * s[j])
                    met, mean = met * crest, mean + crest
                met = met if product else mean / n_waves
                total += max(met - threshold, 0.0)
            rates[m * n_cells + i] = total / (1.0 - threshold) / n_thetas


def lattice_waves(orientation_rad: Tensor, directions: int) -> Tensor:
    r"""Return unit vectors 60 degrees apart whose stripes meet in a grid of that orientation.

    The wave vectors of a hexagonal grid are 30 degrees off its axes.

    Args:
        orientation_rad: Direction of an axis of the grid, ``(...)``.
        directions: How many: 3 make it, 6 are those and their opposites.

    Returns:
        Shape ``(..., directions, 2)``.

    Example:
        >>> lattice_waves(torch.tensor(math.pi / 3), 3)[0].round(decimals=3).abs().tolist()
        [0.0, 1.0]
    """
    turns = torch.arange(directions, dtype=torch.float64) * (TWO_PI / 6) + TWO_PI / 12
    angles = orientation_rad[..., None] + turns.to(orientation_rad)
    return torch.stack([angles.cos(), angles.sin()], dim=-1)


class OscillatoryInterference(nn.Module):
    """Grid cells that fire where dendritic oscillators come into phase with the soma's theta.

    The model of Burgess, Barry and O'Keefe 2007 (Hippocampus 17:801-812); :func:`phase_step` and
    :func:`interference` have the mathematics. Cells of a module share spacing and orientation and
    differ in the positions of their fields. State: the buffers ``phase_rad`` and ``theta_rad``.

    Args:
        spacings_m: Distance of neighbouring fields, one for each module.
        n_cells: Cells of each module.
        directions: Dendritic oscillators, 3 or 6; their directions are 60 degrees apart.
        combine: Whether the soma multiplies or adds the interference of its dendrites.
        theta_hz: Frequency of the soma; ``None``: the mean rate of a theta cycle is returned.
        threshold: Share of the largest response below which a cell is silent; ``None``: 0 for
            the product, 0.6 for the sum.
        orientations_rad: Direction of a grid axis, one for each module; ``None``: random.
        batch: Number of animals side by side; ``None`` for one.
        generator: Generator of random orientations and fields; ``None``: seed 0.

    Raises:
        ConfigError: If a value is out of bounds.

    Example:
        >>> cells = OscillatoryInterference([0.3, 0.5], n_cells=8, theta_hz=None)
        >>> before = cells.rates
        >>> there = cells(torch.tensor([0.4, 0.1]), dt_s=0.5)
        >>> back = cells(torch.tensor([-0.4, -0.1]), dt_s=0.5)
        >>> tuple(back.shape), torch.allclose(back, before), torch.allclose(there, before)
        ((16,), True, False)
    """

    spacings_m: Tensor
    directions: Tensor
    offset_rad: Tensor
    phase_rad: Tensor
    theta_rad: Tensor

    def __init__(
        self,
        spacings_m: Sequence[float] = (0.35, 0.46, 0.60, 0.78),
        n_cells: int = 24,
        *,
        directions: int = 3,
        combine: Combine = "product",
        theta_hz: float | None = 8.0,
        threshold: float | None = None,
        orientations_rad: Sequence[float] | None = None,
        batch: int | None = None,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        if threshold is None:
            threshold = 0.0 if combine == "product" else _SUM_THRESHOLD
        _check(
            (len(spacings_m) > 0 and all(0 < s < math.inf for s in spacings_m), "spacings_m",
             list(spacings_m), "positive numbers, one a module"),
            (n_cells >= 1, "n_cells", n_cells, "at least 1"),
            (directions in (3, 6), "directions", directions, "3 or 6"),
            (combine in ("product", "sum"), "combine", combine, "product or sum"),
            (theta_hz is None or 0 < theta_hz < math.inf, "theta_hz", theta_hz,
             "a positive number or None"),
            (0 <= threshold < 1, "threshold", threshold, "a number in [0, 1)"),
            (orientations_rad is None or len(orientations_rad) == len(spacings_m),
             "orientations_rad", orientations_rad, f"{len(spacings_m)} of them, one a module"),
            (batch is None or batch >= 1, "batch", batch, "at least 1 or None"),
        )  # fmt: skip
        self.combine: Combine = combine
        self.theta_hz, self.threshold, self.batch = theta_hz, threshold, batch
        self.n_cells = n_cells * len(spacings_m)
        generator = generator or torch.Generator().manual_seed(0)
        n_modules, dtype = len(spacings_m), torch.float64
        drawn = torch.rand(n_modules, generator=generator, dtype=dtype) * (TWO_PI / 6)
        turned = drawn if orientations_rad is None else torch.tensor(orientations_rad, dtype=dtype)
        axes = torch.stack([turned, turned + TWO_PI / 6], dim=-1)
        axes = torch.stack([axes.cos(), axes.sin()], dim=-1)  # (modules, 2, 2): a cell of the grid
        fields = torch.rand(n_modules, n_cells, 2, generator=generator, dtype=dtype) @ axes
        waves = lattice_waves(turned, directions)
        self.register_buffer("spacings_m", torch.tensor(list(spacings_m), dtype=dtype))
        self.register_buffer("directions", waves)
        # In units of the spacing, so a cell keeps its phase when the spacing changes.
        self.register_buffer("offset_rad", _WAVE_NUMBER * fields @ waves.transpose(-1, -2))
        self.reset()

    def reset(self) -> None:
        """Reset the animal to the origin: all oscillators in phase, theta at its crest."""
        lead = () if self.batch is None else (self.batch,)
        zeros = self.offset_rad.new_zeros(lead + self.directions.shape[:2])
        self.register_buffer("phase_rad", zeros)
        self.register_buffer("theta_rad", self.offset_rad.new_zeros(lead))

    @property
    def waves_rad_m(self) -> Tensor:
        """Wave vectors of the oscillators, ``(modules, directions, 2)``."""
        return (_WAVE_NUMBER / self.spacings_m)[:, None, None] * self.directions

    @property
    def rates(self) -> Tensor:
        """Rates now, ``([batch,] n_cells)``, module after module, each in ``[0, 1]``."""
        phase = self.phase_rad[..., None, :] - self.offset_rad
        if self.theta_hz is None:
            cycle = torch.arange(_CYCLE, dtype=phase.dtype, device=phase.device)
            cycle = (cycle * (TWO_PI / _CYCLE)).expand(*phase.shape[:-1], _CYCLE)
            fired = interference(phase[..., None, :], cycle, self.combine, self.threshold).mean(-1)
        else:
            theta = self.theta_rad[..., None, None]
            fired = interference(phase, theta, self.combine, self.threshold)
        return fired.flatten(-2)

    def forward(self, velocity_m_s: Tensor, dt_s: float) -> Tensor:
        """Move by one step and return the rates, ``([batch,] n_cells)``.

        Args:
            velocity_m_s: Allocentric x and y, ``([batch,] 2)``.
            dt_s: Duration of the step.

        Raises:
            MapError: If the velocity has another shape or is not finite, or time runs backward.
        """
        velocity = checked_velocity(self, velocity_m_s, dt_s, self.batch).to(self.phase_rad)
        if self._compiles(velocity):
            return self._step(velocity, dt_s)
        self.phase_rad = phase_step(self.phase_rad, velocity, self.waves_rad_m, dt_s)
        if self.theta_hz is not None:
            self.theta_rad = torch.remainder(self.theta_rad + TWO_PI * self.theta_hz * dt_s, TWO_PI)
        return self.rates

    def _compiles(self, velocity: Tensor) -> bool:
        state = (velocity, self.phase_rad, self.spacings_m, self.offset_rad)
        return self.batch is None and velocity.dtype == torch.float64 and runs_compiled(*state)

    def _step(self, velocity: Tensor, dt_s: float) -> Tensor:
        """Do as :meth:`forward` for one animal by a compiled step."""
        waves, theta = self.waves_rad_m.contiguous().numpy(), np.arange(_CYCLE) * (TWO_PI / _CYCLE)
        self.phase_rad = phase = self.phase_rad.clone(memory_format=torch.contiguous_format)
        if self.theta_hz is not None:
            self.theta_rad = torch.remainder(self.theta_rad + TWO_PI * self.theta_hz * dt_s, TWO_PI)
            theta = self.theta_rad.reshape(1).numpy()
        rates = np.empty(self.n_cells)
        interference_step(
            phase.numpy(), velocity.contiguous().numpy(), waves, dt_s,
            self.offset_rad.contiguous().numpy(), theta, self.combine == "product",
            self.threshold, rates,
        )  # fmt: skip
        return torch.from_numpy(rates)


def checked_velocity(
    module: nn.Module, velocity_m_s: Tensor, dt_s: float, batch: int | None
) -> Tensor:
    """Return the velocity, ``([batch,] 2)``, after checking it.

    Raises:
        MapError: If it has another shape or is not finite, or time runs backward.
    """
    name, expected = type(module).__name__, (2,) if batch is None else (batch, 2)
    if tuple(velocity_m_s.shape) != expected:
        raise MapError(
            f"{name}: velocity_m_s has shape {tuple(velocity_m_s.shape)}, expected {expected}: "
            "x and y" + ("" if batch is None else ", a row for each animal")
        )
    if not 0.0 <= dt_s < math.inf:
        raise MapError(f"{name}: dt_s is {dt_s}; expected a number of seconds, not below 0")
    if not bool(velocity_m_s.isfinite().all()):
        raise MapError(
            f"{name}: velocity_m_s is {velocity_m_s.tolist()}; expected finite numbers, leave "
            "such steps out"
        )
    return velocity_m_s


def _check(*rules: tuple[bool, str, object, str]) -> None:
    for holds, name, got, expected in rules:
        if not holds:
            raise ConfigError(f"OscillatoryInterference: {name} is {got!r}; expected {expected}")
