"""Grid cells of three dimensions: an attractor on a torus of height, y and x.

One of the two networks of :mod:`~neuroslam.cells.pose_3d`. The torus is that of the pose cells
with height in place of heading, so the steps are theirs: excitation and inhibition by convolution
along three axes, in the window of active cells, and a translation of all cells alike.
"""

from collections.abc import Callable
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from neuroslam.cells.attractor import (
    Couplings,
    advance,
    couplings,
    decode,
    decode_window,
    heading_table,
    inject,
    inject_window,
    path_integrate,
    settle,
    silenced,
)
from neuroslam.cells.convolve import (
    Cell,
    Kernels,
    Packet,
    gaussian_difference,
    to_dense,
    to_packet,
)
from neuroslam.cells.side_by_side import decode_all, move_all, to_packets, to_tori, trim_all
from neuroslam.compiled import runs_compiled
from neuroslam.config import PoseCellConfig
from neuroslam.errors import MapError
from neuroslam.state.mergeable import BufferModule
from neuroslam.state.pickling import Calls
from neuroslam.types import PoseEstimate


class GridCells3D(BufferModule):
    """Continuous attractor on the torus ``(n_z, n_xy, n_xy)``; a packet encodes the position.

    :func:`~neuroslam.cells.attractor.settle` has the mathematics of the attractor; movement is
    :func:`~neuroslam.cells.attractor.path_integrate` with height in place of heading. The state is
    the window of active cells, buffers ``window`` and ``origin``.

    Args:
        config: Sizes and kernels; those along height are those along x and y.
        n_z: Cells along height.
        batch: Number of robots side by side; ``None`` for one.

    Example:
        >>> cells = GridCells3D(PoseCellConfig(n_xy=9), n_z=7)
        >>> cells.estimate
        (4.0, 4.0, 3.0)
        >>> [round(at, 6) for at in cells(9.0, -9.0, 7.0)]  # once round each ring
        [4.0, 4.0, 3.0]
    """

    growing = ("window",)

    window: Tensor
    origin: Tensor

    def __init__(self, config: PoseCellConfig, n_z: int, batch: int | None = None) -> None:
        super().__init__()
        self.config, self.batch = config, batch
        self.shape = (n_z, config.n_xy, config.n_xy)
        kernels = gaussian_difference(
            3 * [(config.excite_size, config.excite_std_xy)],
            3 * [(config.inhibit_size, config.inhibit_std_xy)],
        )
        self.kernels = cast(Kernels, kernels.excite), cast(Kernels, kernels.inhibit)
        excite, inhibit = (np.stack([k.numpy() for k in made]) for made in self.kernels)
        self._loops = excite, inhibit
        self._still = heading_table(n_z)  # not used where all layers move alike
        self._couplings: dict[Cell, Couplings] = {}
        brains = () if batch is None else (batch,)
        dtype = getattr(torch, config.precision)
        self.register_buffer("window", torch.ones(1, 1, 1, dtype=dtype))
        self.register_buffer("origin", torch.zeros(*brains, 3, dtype=torch.int64))
        self.packet = Packet(self.window, (0, 0, 0), self.shape)
        # The packet that was decoded last, and its estimate.
        self._decoded: tuple[Packet | None, tuple[float, float, float]] = None, (0.0, 0.0, 0.0)
        self.register_state_dict_pre_hook(Calls("_write_buffers"))
        self.register_load_state_dict_post_hook(Calls("_read_buffers"))
        self.reset()

    def reset(self) -> None:
        """Set all activity into the middle cell, as at the start of a session."""
        brains = () if self.batch is None else (self.batch,)
        start = self.window.new_zeros(brains + self.shape)
        start[..., self.shape[0] // 2, self.shape[1] // 2, self.shape[2] // 2] = 1.0
        self.activity = start

    @property
    def activity(self) -> Tensor:
        """Activity of all cells, ``([batch,] n_z, n_y, n_x)``, non-negative, sum 1."""
        return (to_dense if self.batch is None else to_tori)(self.packet)

    @activity.setter
    def activity(self, activity: Tensor) -> None:
        expected = (() if self.batch is None else (self.batch,)) + self.shape
        if tuple(activity.shape) != expected:
            raise MapError(
                f"GridCells3D: activity has shape {tuple(activity.shape)}, expected {expected}"
            )
        convert = to_packet if self.batch is None else to_packets
        self.packet = convert(activity.to(self.window))

    @property
    def estimate(self) -> tuple[float, float, float] | Tensor:
        """x, y and z of the dominant packet in cells; of a batch ``(batch, 3)``."""
        radius = self.config.decode_radius
        if self.batch is not None:
            return decode_all(self.packet, radius)
        packet, known = self._decoded
        if packet is not self.packet:
            if runs_compiled(self.packet.values):
                known = decode_window(*self._flat(), radius)
            else:
                found = decode(self.packet, radius)
                known = found.x, found.y, found.theta
            self._decoded = self.packet, known
        return known

    @property
    def peak(self) -> float:
        """Activity of the most active cell: near 0 if the activity is spread out."""
        return self.packet.values.max().item()

    def forward(
        self, dx_cells: float | Tensor, dy_cells: float | Tensor, dz_cells: float | Tensor
    ) -> tuple[float, float, float] | Tensor:
        """Settle the attractor, move its activity by odometry, and return the estimate.

        Args:
            dx_cells: Displacement along x; of a batch ``(batch,)``.
            dy_cells: Along y.
            dz_cells: Along height.

        Raises:
            MapError: If inhibition silenced every cell.
        """
        c, packet = self.config, self.packet
        if self.batch is not None:
            aside = torch.stack(
                torch.broadcast_tensors(
                    *(torch.as_tensor(by, dtype=torch.float64) for by in (dx_cells, dy_cells))
                )
            )
            aside = aside.T if aside.dim() == 2 else aside.expand(self.batch, 2)
            self.packet = move_all(trim_all(self._settled()), 0.0, dz_cells, aside)
            return self.estimate
        dx, dy, dz = float(dx_cells), float(dy_cells), float(dz_cells)
        if not runs_compiled(packet.values):
            self.packet = path_integrate(self._settled(), 0.0, dz, (dx, dy))
            return self.estimate
        moved, sizes, origin, estimate = advance(
            *self._flat(), *self._loops, c.global_inhibition, 0.0, dz, (dx, dy), self._still,
            c.decode_radius, c.precision == "float32",
        )  # fmt: skip
        if not moved.size:
            raise silenced(c.global_inhibition)
        self.packet = self._packed(moved, sizes, origin)
        self._decoded = self.packet, estimate
        return estimate

    def _settled(self) -> Packet:
        """Excite, inhibit and normalise the activity."""
        c, values = self.config, self.packet.values
        sizes = cast(Cell, tuple(values.shape[-3:]))
        coupled = self._couplings.get(sizes)
        if coupled is None:
            with torch.inference_mode(mode=False):  # kept for steps that may want gradients
                made = couplings(*self.kernels, sizes, self.shape)
                coupled = Couplings(*(m.to(values) for m in made))
            self._couplings[sizes] = coupled
        half = c.excite_size // 2
        return settle(self.packet, coupled, (half, half, half), c.global_inhibition)

    def shift(self, dx_cells: float, dy_cells: float, dz_cells: float) -> None:
        """Move the activity by a correction."""
        self.packet = path_integrate(self.packet, 0.0, dz_cells, (dx_cells, dy_cells))

    def inject(self, x: float, y: float, z: float, energy: float) -> None:
        """Add activity at a point between cells; see :func:`~.attractor.inject`."""
        if runs_compiled(self.packet.values):
            where = (float(z), float(y), float(x))
            self.packet = self._packed(*inject_window(*self._flat(), where, energy))
        else:
            self.packet = inject(self.packet, PoseEstimate(x, y, z), energy)

    def _flat(self) -> tuple[np.ndarray, Cell, Cell, Cell]:
        """Return values, sizes, origin and torus for a compiled step."""
        values = self.packet.values.numpy()
        flat = values.reshape(-1).astype(np.float64)
        return flat, cast(Cell, values.shape), cast(Cell, self.packet.origin), self.shape

    def _packed(self, values: np.ndarray, sizes: Cell, origin: Cell) -> Packet:
        """Make a packet of a compiled step's flat window."""
        window = torch.from_numpy(values.reshape(sizes)).to(self.packet.values.dtype)
        return Packet(window, origin, self.shape)

    def _write_buffers(self) -> None:
        self.window = self.packet.values
        origin = self.packet.origin
        self.origin = origin if isinstance(origin, Tensor) else torch.tensor(origin)

    def _read_buffers(self) -> None:
        origin = self.origin if self.batch is not None else tuple(self.origin.tolist())
        self.packet = Packet(self.window, cast(Cell, origin), self.shape)

    def _apply(self, fn: object, recurse: bool = True) -> "GridCells3D":
        self._couplings.clear()
        self._write_buffers()
        super()._apply(cast(Callable[..., Any], fn), recurse)
        self._read_buffers()
        return self
