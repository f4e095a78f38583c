"""Grid cells of a periodic sheet, a continuous attractor; a model for comparison."""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from neuroslam.cells.convolve import fourier_convolve
from neuroslam.cells.interference import checked_velocity
from neuroslam.compiled import compiled, runs_compiled
from neuroslam.errors import ConfigError
from neuroslam.geometry import TWO_PI

_WAVE_NUMBER = 4.0 * math.pi / math.sqrt(3.0)
"""Wave number of a hexagonal pattern, one period being the distance of neighbouring bumps."""
_SIZE = (2.0, math.sqrt(3.0))
"""The torus along x and y, in periods: the smallest even one on which hexagons close."""
_WAVES = ((math.sqrt(0.75), 0.5), (math.sqrt(0.75), -0.5), (0.0, 1.0))
"""Directions of the pattern's three waves."""
_PAPER_CELLS = 13.0
"""The model's lambda_net in cells, for which its weights are given."""
_SETTLING_TAUS = 100.0
_SILENT = 1e-20
"""Rate below which a cell is silent: numbers that fade on below 1e-38 take much longer."""
_CALIBRATING_DRIVES = (0.02, 0.05, 0.1)


@dataclass(frozen=True, kw_only=True)
class SheetParameters:
    r"""Size and dynamics of a sheet; they determine its gains.

    Attributes:
        n_y: Cells along y, over :math:`\sqrt 3` periods of the pattern.
        n_x: Cells along x, over 2 periods; 56 by 48 cells are nearly square.
        tau_s: Time constant of a cell.
        strength: :math:`a`, factor of all weights. The paper has 1, at which no pattern
            grows with outputs shifted as far as here; with 3 its speed is proportional to the
            drive over all of the range.
        surround: :math:`\gamma / \beta`, how much narrower the missing centre is.
        shift: :math:`l`, by how much outputs are shifted, in periods.
        drive_limit: Largest :math:`\alpha v`; one of 0.3 dissolves the pattern.
        substep: Longest Euler step in time constants.

    Raises:
        ConfigError: If a value is out of bounds.
    """

    n_y: int = 48
    n_x: int = 56
    tau_s: float = 0.01
    strength: float = 3.0
    surround: float = 1.05
    shift: float = 0.15
    drive_limit: float = 0.2
    substep: float = 0.25

    def __post_init__(self) -> None:
        for name, least, most in (
            ("n_y", 24, math.inf), ("n_x", 24, math.inf), ("tau_s", 1e-6, math.inf),
            ("strength", 1.0, 5.0), ("surround", 1.001, 2.0), ("shift", 0.01, 0.2),
            ("drive_limit", 0.1, 0.25), ("substep", 0.001, 0.25),
        ):  # fmt: skip
            if not least <= getattr(self, name) <= most:
                raise ConfigError(
                    f"SheetParameters: {name} is {getattr(self, name)!r}; expected a number in "
                    f"[{least:g}, {most:g}]"
                )


def sheet_weights(parameters: SheetParameters) -> Tensor:
    r"""Return the Fourier transform of the weights with which each of four layers projects.

    .. math:: w(\mathbf d) = \tfrac a4 \big[e^{-\gamma |\mathbf d - l \mathbf e|^2}
              - e^{-\beta |\mathbf d - l \mathbf e|^2}\big], \qquad
              \hat w(\mathbf k) = \tfrac a4 \Big[\tfrac\pi\gamma e^{-k^2 / 4 \gamma}
              - \tfrac\pi\beta e^{-k^2 / 4 \beta}\Big] e^{-i l \mathbf k \cdot \mathbf e}

    (Burak and Fiete 2009, Eqs. 2 and 3, with :math:`\beta = 3 / \lambda^2`.) Distances are in
    periods, and :math:`\beta` is such that the wave number that grows fastest is the hexagons'.
    The transform is sampled, not the kernel: it is round whatever the cells' aspect, and outputs
    can be shifted by any fraction of a cell.

    Args:
        parameters: Size and dynamics.

    Returns:
        Complex, ``(4, n_y, n_x // 2 + 1)``: layers that prefer +x, -x, +y, -y.
    """
    p, dtype = parameters, torch.float64
    k_x = TWO_PI / _SIZE[0] * torch.arange(p.n_x // 2 + 1, dtype=dtype)
    k_y = TWO_PI / _SIZE[1] * torch.fft.fftfreq(p.n_y, 1.0 / p.n_y, dtype=dtype)
    squared = k_y[:, None] ** 2 + k_x**2
    # d w / d k = 0 at k^2 / 4 beta = 2 ln(surround) surround / (surround - 1).
    steepness = 2.0 * math.log(p.surround) * p.surround / (p.surround - 1.0)
    beta = _WAVE_NUMBER**2 / (4.0 * steepness)
    gamma = p.surround * beta
    weights = (math.pi / gamma) * torch.exp(-squared / (4.0 * gamma))
    weights = weights - (math.pi / beta) * torch.exp(-squared / (4.0 * beta))
    # As many cells project to a cell as in the paper; with lambda^2 = 3 / beta in squared periods.
    density = _PAPER_CELLS**2 / (3.0 / beta)
    along = torch.stack([k_x.expand_as(squared), k_y[:, None].expand_as(squared)])
    shifts = p.shift * torch.stack([along[0], -along[0], along[1], -along[1]])
    return 0.25 * p.strength * density * weights * torch.exp(-1j * shifts)


def sheet_step(rates: Tensor, drive: Tensor, weights: Tensor, fraction: float) -> Tensor:
    r"""Take one Euler step of all cells.

    .. math:: \tau \dot r_d + r_d = \Big[\sum_{d'} w_{d'} * r_{d'} + 1
              + \mathbf e_d \cdot \mathbf u \Big]_+, \qquad \mathbf u = \alpha \mathbf v

    (Burak and Fiete 2009, Eqs. 1 and 4; there the four preferred directions take turns from cell
    to cell, here every place has all four, which makes one convolution of smooth layers of it.)

    Args:
        rates: :math:`r_d`, ``(..., 4, n_y, n_x)``, layers that prefer +x, -x, +y, -y.
        drive: :math:`\mathbf u` in the sheet's x and y, ``(..., 2)``.
        weights: Transform of :func:`sheet_weights`.
        fraction: :math:`dt / \tau`.

    Returns:
        Rates of the same shape, not below 0.

    Example:
        >>> silent = torch.zeros(4, 48, 56, dtype=torch.float64)
        >>> push = torch.tensor([0.1, 0.0], dtype=torch.float64)
        >>> woken = sheet_step(silent, push, sheet_weights(SheetParameters()), fraction=0.5)
        >>> woken[:, 0, 0].tolist()
        [0.55, 0.45, 0.5, 0.5]
    """
    return _relax(rates, _feedforward(drive), weights, fraction)


def _feedforward(drive: Tensor) -> Tensor:
    pushed = torch.stack([drive, -drive], dim=-1).flatten(-2)  # +x, -x, +y, -y
    return (1.0 + pushed)[..., None, None]


def _relax(rates: Tensor, feedforward: Tensor, weights: Tensor, fraction: float) -> Tensor:
    field = fourier_convolve(rates, weights).unsqueeze(-3)
    relaxed = torch.lerp(rates, (field + feedforward).clamp_min_(0.0), fraction)
    return F.threshold(relaxed, _SILENT, 0.0)


class _Waves(NamedTuple):
    """The waves that the weights let through; real parts stand before imaginary ones.

    Attributes:
        into_x: From cells along x to waves, ``(n_x, 2 k_x)``.
        shift_x: Factor of the layer that prefers +x, ``(2, k_x)``.
        into_y: From three rows of cells along y, the second and third for the layers that prefer
            +y and -y, ``(2 k_y, 6 n_y)``.
        gain: ``(k_y, k_x)``.
        from_y: To cells along y, ``(2 n_y, 2 k_y)``.
        from_x: To cells along x, ``(2 k_x, n_x)``.
    """

    into_x: np.ndarray
    shift_x: np.ndarray
    into_y: np.ndarray
    gain: np.ndarray
    from_y: np.ndarray
    from_x: np.ndarray


@lru_cache(maxsize=16)
def _waves(parameters: SheetParameters) -> _Waves:
    """Return the waves of :func:`sheet_weights` that are not 1e-10 times weaker than the first."""
    p = parameters
    weights = sheet_weights(p).numpy()
    own = weights[0] * np.exp(1j * TWO_PI / _SIZE[0] * p.shift * np.arange(p.n_x // 2 + 1))
    heard = np.abs(own) > 1e-10 * np.abs(own).max()
    rows, columns = np.flatnonzero(heard.any(1)), np.flatnonzero(heard.any(0))
    k_y, k_x = np.fft.fftfreq(p.n_y, 1.0 / p.n_y)[rows], columns.astype(np.float64)
    turn_x = np.exp(-1j * TWO_PI / p.n_x * np.outer(np.arange(p.n_x), k_x))
    turn_y = np.exp(-1j * TWO_PI / p.n_y * np.outer(k_y, np.arange(p.n_y)))
    shift_x = np.exp(-1j * TWO_PI / _SIZE[0] * p.shift * k_x)
    shift_y = np.exp(-1j * TWO_PI / _SIZE[1] * p.shift * k_y)[:, None]
    into_y = np.concatenate([turn_y, turn_y * shift_y, turn_y * shift_y.conj()], axis=1)
    once = (columns == 0) | (2 * columns == p.n_x)
    back = (np.where(once, 1.0, 2.0) / p.n_x)[:, None] * turn_x.T
    made = (
        np.concatenate([np.real(turn_x), np.imag(turn_x)], axis=1),
        np.stack([np.real(shift_x), np.imag(shift_x)]),
        _as_real(into_y),
        np.real(own)[np.ix_(rows, columns)],
        _as_real(turn_y.conj().T / p.n_y),
        np.concatenate([np.real(back), np.imag(back)]),
    )
    return _Waves(*(np.ascontiguousarray(part, np.float32) for part in made))


def _as_real(matrix: np.ndarray) -> np.ndarray:
    """Return a complex matrix as one of real numbers, for vectors whose real parts come first."""
    real, imaginary = np.real(matrix), np.imag(matrix)
    return np.block([[real, -imaginary], [imaginary, real]])


@compiled
def relax_step(
    rates: np.ndarray, feedforward: np.ndarray, fraction: float, n_steps: int,
    into_x: np.ndarray, shift_x: np.ndarray, into_y: np.ndarray, gain: np.ndarray,
    from_y: np.ndarray, from_x: np.ndarray,
) -> None:  # fmt: skip
    """Take Euler steps of one animal as :func:`sheet_step` does, in place.

    The weights let few waves through; a sum over those is all of the convolution. The arrays after
    the number of steps are those of ``_Waves``.
    """
    n_y, n_x, k_y, k_x = rates.shape[1], rates.shape[2], gain.shape[0], gain.shape[1]
    share, zero, least = np.float32(fraction), np.float32(0.0), np.float32(_SILENT)
    cells = rates.reshape(4 * n_y, n_x)
    waves = np.empty((4 * n_y, 2 * k_x), np.float32)
    rows, heard = np.empty((6 * n_y, k_x), np.float32), np.empty((2 * k_y, k_x), np.float32)
    back, turned = np.empty((2 * n_y, k_x), np.float32), np.empty((n_y, 2 * k_x), np.float32)
    field = np.empty((n_y, n_x), np.float32)
    for _ in range(n_steps):
        np.dot(cells, into_x, waves)
        for y in range(n_y):
            ahead, behind = waves[y], waves[n_y + y]
            for k in range(k_x):
                c, s, i = shift_x[0, k], shift_x[1, k], k_x + k
                rows[y, k] = c * (ahead[k] + behind[k]) - s * (ahead[i] - behind[i])
                rows[3 * n_y + y, k] = c * (ahead[i] + behind[i]) + s * (ahead[k] - behind[k])
                rows[n_y + y, k], rows[4 * n_y + y, k] = (
                    waves[2 * n_y + y, k],
                    waves[2 * n_y + y, i],
                )
                rows[2 * n_y + y, k] = waves[3 * n_y + y, k]
                rows[5 * n_y + y, k] = waves[3 * n_y + y, i]
        np.dot(into_y, rows, heard)
        for m in range(k_y):
            for k in range(k_x):
                heard[m, k] *= gain[m, k]
                heard[k_y + m, k] *= gain[m, k]
        np.dot(from_y, heard, back)
        for y in range(n_y):
            for k in range(k_x):
                turned[y, k], turned[y, k_x + k] = back[y, k], back[n_y + y, k]
        np.dot(turned, from_x, field)
        for layer in range(4):
            push = feedforward[layer]
            for y in range(n_y):
                for x in range(n_x):
                    before = rates[layer, y, x]
                    after = before + share * (max(field[y, x] + push, zero) - before)
                    rates[layer, y, x] = after if after > least else zero


def pattern_waves(rates: Tensor) -> Tensor:
    """Return the amplitudes of the pattern's three waves, ``(..., 3)`` complex, at most 1.

    Args:
        rates: ``(..., 4, n_y, n_x)``.
    """
    spectrum = torch.fft.rfft2(rates.sum(-3).to(torch.float64))
    n_y = rates.shape[-2]
    waves = [spectrum[..., 1, 2], spectrum[..., n_y - 1, 2], spectrum[..., 2, 0]]
    return torch.stack(waves, dim=-1) / spectrum[..., 0, 0].real[..., None]


def pattern_shift(before: Tensor, after: Tensor) -> Tensor:
    r"""Return how far the pattern moved, in periods along the sheet's x and y, ``(..., 2)``.

    The least-squares solution of :math:`\mathbf k_j \cdot \mathbf s = -\Delta \varphi_j` over the
    phases of the pattern's waves; right for moves below 0.4 periods.

    Args:
        before: Rates, ``(..., 4, n_y, n_x)``.
        after: Rates of the same shape.

    Example:
        >>> sheet = GridSheet(0.5)
        >>> moved = pattern_shift(sheet.sheet, sheet.sheet.roll(7, dims=-1))
        >>> moved.round(decimals=3).abs().tolist()
        [0.25, 0.0]
    """
    turned = torch.angle(pattern_waves(after) * pattern_waves(before).conj())
    directions = turned.new_tensor(_WAVES)  # sum of e e^T is 3/2 of the identity
    return -(turned @ directions) / (1.5 * _WAVE_NUMBER)


def settled(parameters: SheetParameters, generator: torch.Generator) -> Tensor:
    """Let the pattern grow from noise, without drive; ``(4, n_y, n_x)``, float64.

    Raises:
        ConfigError: If no hexagons grew.
    """
    p, weights = parameters, sheet_weights(parameters)
    noise = torch.rand(p.n_y, p.n_x, generator=generator, dtype=torch.float64)
    rates = (0.1 * noise).expand(4, p.n_y, p.n_x)
    feedforward = _feedforward(rates.new_zeros(2))
    # At first all cells are active and inhibit each other too strongly for long steps.
    for fraction in (min(0.05, p.substep), p.substep):
        for _ in range(round(_SETTLING_TAUS / 2.0 / fraction)):
            rates = _relax(rates, feedforward, weights, fraction)
    weakest = pattern_waves(rates).abs().min().item()
    if not weakest > 0.4:
        raise ConfigError(
            f"SheetParameters: no hexagons grew, one of their waves has the amplitude "
            f"{weakest:.2f}; expected more than 0.4, raise strength or lower shift"
        )
    return rates


@lru_cache(maxsize=16)
def calibrated_gains(parameters: SheetParameters) -> tuple[float, float]:
    r"""Measure how fast a drive moves the pattern along the sheet's x and along its y.

    Constant drives of 0.02, 0.05 and 0.1 push a settled pattern; the gain is the least-squares
    slope of speed over drive.

    Args:
        parameters: Size and dynamics.

    Returns:
        Periods per second of a drive of 1, along x and y.

    Example:
        >>> x, y = calibrated_gains(SheetParameters())
        >>> round(x, 1), abs(y / x - 1.0) < 0.01
        (42.5, True)
    """
    p, weights = parameters, sheet_weights(parameters)
    strengths = torch.tensor(_CALIBRATING_DRIVES, dtype=torch.float64)
    drives = torch.cat([strengths[:, None] * axis for axis in torch.eye(2, dtype=torch.float64)])
    feedforward = _feedforward(drives)
    rates = settled(p, torch.Generator().manual_seed(0)).expand(len(drives), 4, p.n_y, p.n_x)
    moved = torch.zeros_like(drives)
    n_substeps = round(4.0 / p.substep)  # too few for a bump to move near that of its neighbour
    for piece in range(15):
        before = rates
        for _ in range(n_substeps):
            rates = _relax(rates, feedforward, weights, p.substep)
        if piece >= 5:  # by then it moves steadily
            moved = moved + pattern_shift(before, rates)
    speeds = moved / (10 * n_substeps * p.substep * p.tau_s)
    along = (speeds * drives).unflatten(0, (2, -1)).sum((1, 2)) / (strengths**2).sum()
    return along[0].item(), along[1].item()


class GridSheet(nn.Module):
    r"""Grid cells that carry a hexagonal pattern of bumps about a torus as the animal moves.

    The model of Burak and Fiete 2009 (PLoS Comput Biol 5:e1000291) with periodic borders and
    without noise; :func:`sheet_step` and :func:`sheet_weights` have the mathematics. Its gain
    :math:`\alpha` is calibrated for each axis, :func:`calibrated_gains`, so that fields are
    ``spacing_m`` apart. The state is the buffer ``sheet``; ``start`` is the settled pattern that
    :meth:`reset` returns to.

    Args:
        spacing_m: Distance of neighbouring fields.
        n_cells: Cells whose rates are returned; they are spread over the sheet and its layers.
        orientation_rad: Direction of an axis of the grid.
        parameters: Size and dynamics.
        batch: Number of animals side by side; ``None`` for one. They start with one pattern.
        generator: Generator of the noise from which the pattern grows; ``None``: seed 0.

    Raises:
        ConfigError: If a value is out of bounds, or no pattern grew.

    Example:
        >>> cells = GridSheet(spacing_m=0.5)
        >>> before = cells.sheet
        >>> for _ in range(10):
        ...     rates = cells(torch.tensor([0.2, 0.0]), dt_s=0.05)
        >>> rates.shape[0], round(0.5 * pattern_shift(before, cells.sheet)[0].item(), 2)
        (24, 0.1)
    """

    sheet: Tensor
    start: Tensor
    weights: Tensor
    recorded: Tensor
    turn_and_gain: Tensor

    def __init__(
        self,
        spacing_m: float = 0.46,
        n_cells: int = 24,
        *,
        orientation_rad: float = 0.0,
        parameters: SheetParameters | None = None,
        batch: int | None = None,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        self.sheet_parameters = p = parameters or SheetParameters()
        for holds, name, got, expected in (
            (0 < spacing_m < math.inf, "spacing_m", spacing_m, "a positive number"),
            (1 <= n_cells <= p.n_y * p.n_x, "n_cells", n_cells, f"1 to {p.n_y * p.n_x}"),
            (math.isfinite(orientation_rad), "orientation_rad", orientation_rad, "a number"),
            (batch is None or batch >= 1, "batch", batch, "at least 1 or None"),
        ):
            if not holds:
                raise ConfigError(f"GridSheet: {name} is {got!r}; expected {expected}")
        self.spacing_m, self.n_cells, self.batch = spacing_m, n_cells, batch
        # Multiples of the plastic number's powers fill a square evenly, however many they are.
        which = torch.arange(n_cells, dtype=torch.float64)
        column = (which * 0.7548776662466927 % 1.0 * p.n_x).long()
        row = (which * 0.5698402909980532 % 1.0 * p.n_y).long()
        layer = torch.arange(n_cells) % 4
        self.register_buffer("recorded", (layer * p.n_y + row) * p.n_x + column, persistent=False)
        # Real pairs: a change of type would cut complex numbers down.
        weights = torch.view_as_real(sheet_weights(p)).float()
        self.register_buffer("weights", weights, persistent=False)
        c, s = math.cos(orientation_rad), math.sin(orientation_rad)
        turn = torch.tensor([[c, s], [-s, c]], dtype=torch.float64)
        per_m_s = 1.0 / (spacing_m * torch.tensor(calibrated_gains(p), dtype=torch.float64))
        self.register_buffer(
            "turn_and_gain", (per_m_s[:, None] * turn).T.contiguous().float(), persistent=False
        )
        self.register_buffer("sheet", torch.zeros(4, p.n_y, p.n_x))
        self.register_buffer("start", torch.zeros(4, p.n_y, p.n_x))
        self.reset(generator or torch.Generator().manual_seed(0))

    def reset(self, generator: torch.Generator | None = None) -> None:
        """Return to the pattern it was made with, or let a new one settle from noise."""
        if generator is not None:
            self.start = settled(self.sheet_parameters, generator).to(self.start)
        lead = () if self.batch is None else (self.batch,)
        self.sheet = self.start.expand(lead + self.start.shape).clone()

    @property
    def rates(self) -> Tensor:
        """Rates of the recorded cells, ``([batch,] n_cells)``, not below 0."""
        return self.sheet.flatten(-3)[..., self.recorded]

    @property
    def fastest_m_s(self) -> float:
        """Speed at which the drive reaches its limit; the pattern lags behind a faster animal."""
        p = self.sheet_parameters
        return p.drive_limit * self.spacing_m * min(calibrated_gains(p))

    def forward(self, velocity_m_s: Tensor, dt_s: float) -> Tensor:
        """Move by one step and return the rates, ``([batch,] n_cells)``.

        Args:
            velocity_m_s: Allocentric x and y, ``([batch,] 2)``.
            dt_s: Duration of the step.

        Raises:
            MapError: If the velocity has another shape or is not finite, or time runs backward.
        """
        p = self.sheet_parameters
        velocity = checked_velocity(self, velocity_m_s, dt_s, self.batch).to(self.sheet)
        drive = velocity @ self.turn_and_gain
        speed = torch.linalg.vector_norm(drive, dim=-1, keepdim=True)
        drive = drive * (p.drive_limit / speed.clamp_min(p.drive_limit))
        feedforward, weights = _feedforward(drive), torch.view_as_complex(self.weights)
        n_substeps = math.ceil(dt_s / (p.substep * p.tau_s) - 1e-9)
        if runs_compiled(self.sheet, drive) and self.sheet.dtype == torch.float32 and n_substeps:
            self.sheet = rates = self.sheet.clone(memory_format=torch.contiguous_format)
            pushed = feedforward.reshape(-1, 4).numpy()
            for animal, push in zip(rates.view(-1, *rates.shape[-3:]).numpy(), pushed, strict=True):
                relax_step(animal, push, dt_s / (n_substeps * p.tau_s), n_substeps, *_waves(p))
            return self.rates
        rates = self.sheet
        for _ in range(n_substeps):
            rates = _relax(rates, feedforward, weights, dt_s / (n_substeps * p.tau_s))
        self.sheet = rates
        return self.rates
