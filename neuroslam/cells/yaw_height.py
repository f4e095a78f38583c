r"""Conjunctive yaw-height cells: an attractor on a sheet of height by heading, moved by odometry.

One of the two networks of :mod:`~neuroslam.cells.pose_3d`; pure steps and, under them, a compiled
one. (F. Yu, J. Shang, Y. Hu, M. Milford, "NeuroSLAM: a brain-inspired SLAM system for 3D
environments", Biological Cybernetics 113, 2019, has the two networks; the equations are those of
the pose cells in :mod:`~neuroslam.cells.attractor`, along the axes of the sheet.)
"""

import math
from typing import cast

import numpy as np
import torch
from torch import Tensor

from neuroslam.cells.attractor import decode, decode_window, shift_matrix, silenced
from neuroslam.cells.convolve import (
    GaussianDifference,
    Packet,
    convolve_axes,
    gaussian_difference,
)
from neuroslam.cells.side_by_side import decode_all
from neuroslam.compiled import compiled, runs_compiled
from neuroslam.config import PoseCellConfig
from neuroslam.state.mergeable import BufferModule


def settle_sheet(activity: Tensor, kernels: GaussianDifference, global_inhibition: float) -> Tensor:
    r"""Excite, inhibit, inhibit globally, normalise.

    .. math::
        P \leftarrow W_e * P, \quad P \leftarrow P - W_i * P, \quad
        P \leftarrow \frac{[P - \varphi]_+}{\sum [P - \varphi]_+}

    Args:
        activity: :math:`P`, ``(..., n_z, n_theta)``, any batch dimensions.
        kernels: :math:`W_e` and :math:`W_i`: a factor along height and one along heading.
        global_inhibition: :math:`\varphi`, activity removed from every cell.

    Returns:
        Same shape, non-negative, sum 1.

    Raises:
        MapError: If inhibition silenced every cell.
    """
    excited = convolve_axes(activity, [kernel.to(activity) for kernel in kernels.excite])
    inhibited = convolve_axes(excited, [kernel.to(activity) for kernel in kernels.inhibit])
    field = (excited - inhibited - global_inhibition).clamp_min(0.0)
    total = field.sum((-2, -1), keepdim=True)
    if total.min().item() <= 0.0:
        raise silenced(global_inhibition)
    return field / total


def shift_sheet(activity: Tensor, rise_cells: float | Tensor, turn_cells: float | Tensor) -> Tensor:
    r"""Move activity along height and heading by any distance, interpolating linearly.

    .. math:: P \leftarrow S(\Delta z)\, P\, S(\Delta\theta)^\top

    with the matrices of :func:`~neuroslam.cells.attractor.shift_matrix`; both axes are rings.

    Args:
        activity: ``(..., n_z, n_theta)``.
        rise_cells: Numbers, or of shape ``(...)``.
        turn_cells: Likewise.

    Example:
        >>> sheet = torch.zeros(3, 4); sheet[0, 3] = 1.0
        >>> shift_sheet(sheet, -1.0, 0.5).nonzero().tolist()
        [[2, 0], [2, 3]]
    """
    n_z, n_theta = activity.shape[-2:]
    rise, turn = (
        torch.as_tensor(by, dtype=activity.dtype, device=activity.device)
        for by in (rise_cells, turn_cells)
    )
    along_z = shift_matrix(rise, 0, n_z, n_z, n_z)
    along_theta = shift_matrix(turn, 0, n_theta, n_theta, n_theta)
    return along_z @ activity @ along_theta.transpose(-1, -2)


def inject_sheet(activity: Tensor, z: float, theta: float, energy: float) -> Tensor:
    r"""Add activity at a point between cells, shared by its four neighbours (bilinear).

    .. math:: \Delta P_{k,j} = \delta\, [1-|k-z|]_+ [1-|j-\theta|]_+

    Example:
        >>> inject_sheet(torch.zeros(3, 4), 2.5, 1.0, 0.2)[:, 1].tolist()
        [0.10000000149011612, 0.0, 0.10000000149011612]
    """
    weights = []
    for at, n in zip((z, theta), activity.shape, strict=True):
        low = math.floor(at)
        row = activity.new_zeros(n)
        row[low % n] += 1.0 - (at - low)
        row[(low + 1) % n] += at - low
        weights.append(row)
    return activity + energy * weights[0][:, None] * weights[1]


def decode_sheet(activity: Tensor, radius: int) -> tuple[float, float]:
    """Decode height and heading of the dominant packet: :func:`~.attractor.decode` of a sheet.

    Args:
        activity: ``(n_z, n_theta)``.
        radius: Cells to each side of the peak.

    Returns:
        In cells, each in ``[0, n)``.
    """
    found = decode(_as_packet(activity), radius)
    return float(found.theta), float(found.x)


def decode_sheets(activity: Tensor, radius: int) -> Tensor:
    """Do the same for a batch; height and heading in cells, ``(batch, 2)``."""
    packets = _as_packet(activity)
    origin = torch.zeros(len(activity), 3, dtype=torch.int64, device=activity.device)
    return decode_all(packets._replace(origin=origin), radius)[:, [2, 0]]


def _as_packet(activity: Tensor) -> Packet:
    n_z, n_theta = activity.shape[-2:]
    return Packet(activity.unsqueeze(-2), (0, 0, 0), (n_z, 1, n_theta))


@compiled
def sheet_step(
    activity: np.ndarray,
    excite: np.ndarray,
    inhibit: np.ndarray,
    global_inhibition: float,
    rise_cells: float,
    turn_cells: float,
    single: bool,
) -> np.ndarray:
    """Advance a sheet by a frame: :func:`settle_sheet`, then :func:`shift_sheet`.

    Silent cells are passed over: an activity packet is a tenth of the sheet.

    Args:
        activity: ``float64 (n_z, n_theta)``.
        excite: Factors along height and heading, ``(2, size)``.
        inhibit: The same of the inhibition.
        global_inhibition: Activity removed from every cell.
        rise_cells: Movement along height.
        turn_cells: Along heading.
        single: Round the result to ``float32``.

    Returns:
        The new activity, ``float64``; of no rows if inhibition silenced every cell.
    """
    n_z, n_theta = activity.shape
    excited = _spread(activity, excite)
    inhibited = _spread(excited, inhibit)
    total = 0.0
    for i in range(n_z):
        for j in range(n_theta):
            value = max(0.0, excited[i, j] - inhibited[i, j] - global_inhibition)
            inhibited[i, j] = value
            total += value
    if not total > 0.0:
        return inhibited[:0]
    out = np.zeros((n_z, n_theta))
    whole_z, whole_theta = math.floor(rise_cells), math.floor(turn_cells)
    ahead_z, ahead_theta = rise_cells - whole_z, turn_cells - whole_theta
    for i in range(n_z):
        for j in range(n_theta):
            value = inhibited[i, j] / total
            if value == 0.0:
                continue
            for up in range(2):
                weight_z = ahead_z if up else 1.0 - ahead_z
                row = (i + whole_z + up) % n_z
                column = (j + whole_theta) % n_theta
                out[row, column] += weight_z * (1.0 - ahead_theta) * value
                column = (column + 1) % n_theta
                out[row, column] += weight_z * ahead_theta * value
    if single:
        for i in range(n_z):
            for j in range(n_theta):
                out[i, j] = np.float32(out[i, j])
    return out


@compiled
def _spread(values: np.ndarray, kernels: np.ndarray) -> np.ndarray:
    """Convolve a sheet along both of its rings, from the cells that are active."""
    n_z, n_theta = values.shape
    size = kernels.shape[1]
    reach = size // 2
    along, out = np.zeros((n_z, n_theta)), np.zeros((n_z, n_theta))
    active = np.zeros(n_z)
    for i in range(n_z):
        for j in range(n_theta):
            value = values[i, j]
            if value != 0.0:
                active[i] = 1.0
                for m in range(size):
                    along[i, (j + m - reach) % n_theta] += kernels[1, m] * value
    for i in range(n_z):
        if active[i] == 0.0:
            continue
        for m in range(size):
            row = (i + m - reach) % n_z
            for j in range(n_theta):
                out[row, j] += kernels[0, m] * along[i, j]
    return out


class YawHeightCells(BufferModule):
    """Conjunctive cells of height and heading, ``(n_z, n_theta)``; a packet encodes both.

    Args:
        config: Sizes and kernels; those along height are those along x and y.
        n_z: Cells along height.
        batch: Number of robots side by side; ``None`` for one.

    Example:
        >>> cells = YawHeightCells(PoseCellConfig(), n_z=9)
        >>> cells.estimate
        (4.0, 18.0)
        >>> [round(at, 6) for at in cells(rise_cells=0.0, turn_cells=36.0)]
        [4.0, 18.0]
    """

    activity: Tensor

    def __init__(self, config: PoseCellConfig, n_z: int, batch: int | None = None) -> None:
        super().__init__()
        self.config, self.shape, self.batch = config, (n_z, config.n_theta), batch
        self.kernels = gaussian_difference(
            [(config.excite_size, s) for s in (config.excite_std_xy, config.excite_std_theta)],
            [(config.inhibit_size, s) for s in (config.inhibit_std_xy, config.inhibit_std_theta)],
        )
        excite, inhibit = (np.stack([k.numpy() for k in made]) for made in self.kernels)
        self._loops = excite, inhibit
        brains = () if batch is None else (batch,)
        dtype = getattr(torch, config.precision)
        # The activity that was decoded last, and its estimate.
        self._decoded: tuple[Tensor | None, tuple[float, float]] = None, (0.0, 0.0)
        self.register_buffer("activity", torch.zeros(*brains, *self.shape, dtype=dtype))
        self.reset()

    def reset(self) -> None:
        """Set all activity into the middle cell, as at the start of a session."""
        start = torch.zeros_like(self.activity)
        start[..., self.shape[0] // 2, self.shape[1] // 2] = 1.0
        self.activity = start

    @property
    def estimate(self) -> tuple[float, float] | Tensor:
        """Height and heading of the dominant packet in cells; of a batch ``(batch, 2)``."""
        radius = self.config.decode_radius
        if self.batch is not None:
            return decode_sheets(self.activity, radius)
        activity, known = self._decoded
        if activity is not self.activity:
            if runs_compiled(self.activity):
                values = self.activity.numpy().astype(np.float64).reshape(-1)
                sizes = (self.shape[0], 1, self.shape[1])
                theta, _, z = decode_window(values, sizes, (0, 0, 0), sizes, radius)
                known = z, theta
            else:
                known = decode_sheet(self.activity, radius)
            self._decoded = self.activity, known
        return known

    def forward(
        self, rise_cells: float | Tensor, turn_cells: float | Tensor
    ) -> tuple[float, float] | Tensor:
        """Settle the attractor, move its activity by odometry, and return the estimate.

        Args:
            rise_cells: Movement along height; of a batch ``(batch,)``.
            turn_cells: Along heading.

        Raises:
            MapError: If inhibition silenced every cell.
        """
        c = self.config
        if runs_compiled(self.activity) and self.batch is None:
            moved = sheet_step(
                self.activity.numpy().astype(np.float64), *self._loops, c.global_inhibition,
                float(rise_cells), float(turn_cells), c.precision == "float32",
            )  # fmt: skip
            if not moved.size:
                raise silenced(c.global_inhibition)
            self.activity = torch.from_numpy(moved).to(self.activity.dtype)
        else:
            settled = settle_sheet(self.activity, self.kernels, c.global_inhibition)
            self.activity = shift_sheet(settled, rise_cells, turn_cells)
        return self.estimate

    def shift(self, rise_cells: float, turn_cells: float) -> None:
        """Move the activity by a correction."""
        self.activity = shift_sheet(self.activity, rise_cells, turn_cells)

    def inject(self, z: float, theta: float, energy: float) -> None:
        """Add activity at a point between cells; see :func:`inject_sheet`."""
        self.activity = inject_sheet(self.activity, z, theta, energy)

    @property
    def heading_cells(self) -> float:
        """Heading of the estimate of one robot, in cells."""
        return cast(tuple[float, float], self.estimate)[1]
