"""Velocity-controlled oscillators: phases that advance with displacement along a direction."""

import math
from collections.abc import Callable
from typing import cast

import numpy as np
import torch
from torch import Tensor, nn

from neuroslam.compiled import compiled
from neuroslam.config import GridCellConfig
from neuroslam.state.mergeable import Arrays, BufferModule
from neuroslam.state.pickling import Calls


def wave_vectors(spacing_m: Tensor, orientation_rad: Tensor, directions: int) -> Tensor:
    r"""Return the wave vectors of modules of oscillators, evenly over the full turn.

    .. math:: \mathbf k_{mj} = \frac{4\pi}{\sqrt 3\,\lambda_m}
              (\cos\beta_{mj}, \sin\beta_{mj}), \qquad \beta_{mj} = \beta_m + 2\pi j / D

    Args:
        spacing_m: :math:`\lambda`, spacing of the fields of a grid cell, ``(n_modules,)``.
        orientation_rad: :math:`\beta_m`, ``(n_modules,)``.
        directions: :math:`D`; with six the waves close in triangles, and their sums are hexagons.

    Returns:
        rad/m, ``(n_modules, directions, 2)``.
    """
    steps = torch.arange(directions, dtype=spacing_m.dtype, device=spacing_m.device)
    beta = orientation_rad[:, None] + steps * (2 * math.pi / directions)
    k = 4 * math.pi / (math.sqrt(3) * spacing_m)
    return k[:, None, None] * torch.stack([beta.cos(), beta.sin()], dim=-1)


def turn_phases(waves: Tensor, displacement_m: Tensor, phases: Tensor) -> Tensor:
    r"""Advance the phases by a displacement.

    .. math:: z_j \leftarrow z_j\,e^{i\,\mathbf k_j \cdot \Delta x}

    This is the Hopf oscillator :math:`\dot z = i\omega z + z(1 - |z|^2)` on its unit circle, SLRB
    Eqs. 10 and 11, with :math:`\omega_j = \mathbf k_j \cdot \mathbf v` integrated exactly. (Euler
    steps of it leave the unit circle, by half at 15 rad/s. The boundary response that Eqs. 10 and
    11 add to every frequency shifts all phases equally, without effect on the position; walls
    correct the phases instead.)

    Args:
        waves: :math:`\mathbf k`, ``(n_modules, directions, 2)``.
        displacement_m: :math:`\Delta x`, ``(..., 2)``.
        phases: :math:`z` as cosine and sine, ``(..., n_modules, directions, 2)``.

    Example:
        >>> waves = wave_vectors(torch.tensor([0.5]), torch.tensor([0.0]), 6)
        >>> start = torch.tensor([1.0, 0.0]).expand(1, 6, 2).contiguous()
        >>> lap = torch.tensor([0.5 * 3**0.5 / 2, 0.0])  # a whole wave along x
        >>> turn_phases(waves, lap, start)[0, 0].round(decimals=5).abs().tolist()
        [1.0, 0.0]
    """
    return torch.view_as_real(torch.view_as_complex(phases) * _turn(waves, displacement_m))


def restore_amplitude(phases: Tensor) -> Tensor:
    r"""Return oscillators to the unit circle, as :math:`z(1 - |z|^2)` does: removes rounding.

    .. math:: z \leftarrow \tfrac12 (3 - |z|^2)\,z

    One step of Newton's for :math:`|z| = 1`.
    """
    return phases * (1.5 - 0.5 * phases.square().sum(-1, keepdim=True))


def _turn(waves: Tensor, at_m: Tensor) -> Tensor:
    angle = torch.nn.functional.linear(at_m, waves.view(-1, 2))
    turn = torch.polar(torch.ones_like(angle), angle)
    return turn.view(*turn.shape[:-1], *waves.shape[:2])


def decode_phases(waves: Tensor, solver: Tensor, phases: Tensor, near_m: Tensor) -> Tensor:
    r"""Decode the position, near a given one, that fits all phases best.

    .. math:: x = x_0 + K^{+} \arg\!\big(z\,e^{-iKx_0}\big)

    Least squares over all modules; exact while :math:`|\mathbf k \cdot (x - x_0)| < \pi`.

    Args:
        waves: :math:`K`, ``(n_modules, directions, 2)``.
        solver: Its pseudo-inverse, ``(2, n_modules * directions)``.
        phases: :math:`z`, ``(..., n_modules, directions, 2)``.
        near_m: :math:`x_0`, ``(..., 2)``.

    Returns:
        ``(..., 2)`` in metres.
    """
    z = torch.view_as_complex(phases) * _turn(waves, -near_m)
    return near_m + z.angle().flatten(-2) @ solver.mT


@compiled
def shift_step(
    dx_m: float, dy_m: float, waves: np.ndarray, phases: np.ndarray, position_m: np.ndarray
) -> None:
    """Do as :func:`turn_phases` for one animal, in place, and move its position."""
    for m in range(waves.shape[0]):
        for j in range(waves.shape[1]):
            angle = waves[m, j, 0] * dx_m + waves[m, j, 1] * dy_m
            c, s = math.cos(angle), math.sin(angle)
            x, y = phases[m, j, 0], phases[m, j, 1]
            phases[m, j, 0] = x * c - y * s
            phases[m, j, 1] = x * s + y * c
    position_m[0] += dx_m
    position_m[1] += dy_m


@compiled
def decode_step(
    waves: np.ndarray, solver: np.ndarray, phases: np.ndarray, position_m: np.ndarray
) -> None:
    """Do as :func:`restore_amplitude` and :func:`decode_phases` for one animal, in place."""
    to_x, to_y, directions = 0.0, 0.0, waves.shape[1]
    for m in range(waves.shape[0]):
        for j in range(directions):
            x, y = phases[m, j, 0], phases[m, j, 1]
            length = 1.5 - 0.5 * (x * x + y * y)
            x, y = x * length, y * length
            phases[m, j, 0], phases[m, j, 1] = x, y
            angle = -(waves[m, j, 0] * position_m[0] + waves[m, j, 1] * position_m[1])
            c, s = math.cos(angle), math.sin(angle)
            off = math.atan2(x * s + y * c, x * c - y * s)
            to_x += solver[0, m * directions + j] * off
            to_y += solver[1, m * directions + j] * off
    position_m[0] += to_x
    position_m[1] += to_y


class VelocityOscillators(BufferModule):
    """Modules of oscillators whose phases integrate motion; state: ``phases`` and ``position_m``.

    :func:`turn_phases` has the mathematics. The field spacings are parameters.

    Args:
        config: Spacings, orientations, number of directions.
        batch: Number of animals side by side, or ``None`` for one.

    Example:
        >>> oscillators = VelocityOscillators(GridCellConfig())
        >>> oscillators(torch.tensor([0.2, 0.0]), dt_s=0.5).shape
        torch.Size([4, 6, 2])
        >>> [round(x, 6) for x in oscillators.position_m.tolist()]
        [0.1, 0.0]
    """

    phases: Tensor
    position_m: Tensor
    orientation_rad: Tensor

    def __init__(self, config: GridCellConfig, batch: int | None = None) -> None:
        super().__init__()
        self.config = config
        self.batch = batch
        lead = () if batch is None else (batch,)
        kind = torch.float64
        self.spacing_m = nn.Parameter(torch.tensor(config.spacings_m, dtype=kind))
        angles = torch.tensor(config.orientations_deg, dtype=kind).deg2rad()
        self.register_buffer("orientation_rad", angles)
        start = torch.zeros(*lead, len(angles), config.directions, 2, dtype=kind)
        start[..., 0] = 1.0
        self.register_buffer("phases", start)
        self.register_buffer("position_m", torch.zeros(*lead, 2, dtype=kind))
        self._waves: tuple[int, Tensor, Tensor] | None = None  # follow from the spacings
        self._wave_arrays: tuple[Tensor, np.ndarray, np.ndarray] | None = None
        self.register_load_state_dict_post_hook(Calls("_forget_waves"))

    @property
    def waves(self) -> Tensor:
        """Wave vectors in rad/m, ``(n_modules, directions, 2)``; they follow from the spacings."""
        return wave_vectors(self.spacing_m, self.orientation_rad, self.config.directions)

    def _forget_waves(self) -> None:
        self._waves = None

    def _kept_waves(self) -> tuple[Tensor, Tensor]:
        if torch.is_grad_enabled() and self.spacing_m.requires_grad:
            return self.waves, torch.linalg.pinv(self.waves.flatten(0, 1))
        spacing = self.spacing_m
        version = -1 if spacing.is_inference() else spacing._version
        if self._waves is None or self._waves[0] != version:
            with torch.inference_mode(mode=False), torch.no_grad():
                waves = wave_vectors(
                    spacing.detach().clone(), self.orientation_rad.clone(), self.config.directions
                )
                self._waves = version, waves, torch.linalg.pinv(waves.flatten(0, 1))
        return self._waves[1:]

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "VelocityOscillators":
        self._waves = None
        return super()._apply(fn, recurse)

    def forward(self, velocity_m_s: Tensor, dt_s: float | Tensor) -> Tensor:
        """Move with a velocity in the world, ``([batch,] 2)``, and return the phases."""
        return self.shift(velocity_m_s * dt_s)

    def shift(self, displacement_m: Tensor) -> Tensor:
        """Move all modules by one displacement, ``([batch,] 2)``, so that they stay consistent.

        Returns:
            Phases as cosine and sine, ``([batch,] n_modules, directions, 2)``.
        """
        waves, _ = self._kept_waves()
        step = displacement_m.to(self.position_m)
        phases = turn_phases(waves, step, self.phases)
        self.phases = phases.detach()
        self.position_m = self.position_m + step.detach()
        return phases

    def decode(self) -> Tensor:
        """Decode the position, ``([batch,] 2)``, from the phases; else it is integrated."""
        waves, solver = self._kept_waves()
        self.phases = restore_amplitude(self.phases).detach()
        self.position_m = decode_phases(waves, solver, self.phases, self.position_m).detach()
        return self.position_m

    def shift_compiled(self, dx_m: float, dy_m: float) -> tuple[np.ndarray, np.ndarray]:
        """Do as :meth:`shift` for one animal, in place; return phases and position."""
        _, _, phases, position_m = cast(Arrays, self.arrays())
        shift_step(dx_m, dy_m, self._kept_arrays()[0], phases, position_m)
        return phases, position_m

    def decode_compiled(self) -> np.ndarray:
        """Do as :meth:`decode` for one animal, in place; return the position, ``(2,)``."""
        _, _, phases, position_m = cast(Arrays, self.arrays())
        decode_step(*self._kept_arrays(), phases, position_m)
        return position_m

    def _kept_arrays(self) -> tuple[np.ndarray, np.ndarray]:
        waves, solver = self._kept_waves()
        if self._wave_arrays is None or self._wave_arrays[0] is not waves:
            self._wave_arrays = waves, waves.numpy(), np.ascontiguousarray(solver.numpy())
        return self._wave_arrays[1:]

    def phases_at(self, position_m: Tensor) -> Tensor:
        """Return the phases at positions, ``(..., 2)``; the state does not change.

        Gradients flow to the position and to ``spacing_m``.

        Returns:
            Phases as cosine and sine, ``(..., n_modules, directions, 2)``.

        Example:
            >>> oscillators = VelocityOscillators(GridCellConfig())
            >>> oscillators.phases_at(torch.zeros(5, 2)).shape
            torch.Size([5, 4, 6, 2])
        """
        waves, _ = self._kept_waves()
        position = position_m.to(self.position_m)
        start = self.phases.new_zeros(*position.shape[:-1], *self.phases.shape[-3:])
        start[..., 0] = 1.0
        return turn_phases(waves, position, start)

    def place_at(self, position_m: Tensor) -> Tensor:
        """Set the phases to those of a position, ``([batch,] 2)``, and return them.

        Gradients flow through what it returns, as those of :meth:`shift` do; the state is detached.

        Example:
            >>> oscillators = VelocityOscillators(GridCellConfig())
            >>> phases = oscillators.place_at(torch.tensor([0.2, 0.1]))
            >>> phases.sum().backward()
            >>> bool((oscillators.spacing_m.grad != 0.0).all()), oscillators.phases.requires_grad
            (True, False)
        """
        position = position_m.to(self.position_m).expand_as(self.position_m)
        phases = self.phases_at(position)
        self.phases = phases.detach().contiguous()
        self.position_m = position.detach().clone()
        return phases
