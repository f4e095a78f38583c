"""An attractor on a torus of three axes, in the window of its active cells: set-up, steps, reading.

The base of the pose cells (heading, y, x) and of the 3-D grid cells (height, y, x).
:func:`~neuroslam.cells.attractor.settle` and :func:`~neuroslam.cells.attractor.path_integrate` have
the mathematics.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Self, cast

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
from neuroslam.cells.convolve import Cell, Kernels, Packet, gaussian_difference, to_dense, to_packet
from neuroslam.cells.side_by_side import decode_all, move_all, to_packets, to_tori, trim_all
from neuroslam.compiled import runs_compiled
from neuroslam.config import PoseCellConfig
from neuroslam.errors import MapError
from neuroslam.state.mergeable import BufferModule
from neuroslam.state.pickling import Calls
from neuroslam.types import PoseEstimate

Factor = tuple[int, float]
"""Width of a kernel along one axis, and its standard deviation in cells."""


@dataclass
class Active:
    """Activity in use: writing buffers in each step would cost more than the cells.

    Attributes:
        packet: The active window.
        estimate: Its centre, once it was decoded.
        flat: A packet, and its values and sizes as compiled steps gave them.
    """

    packet: Packet
    estimate: PoseEstimate | Tensor | None = None
    flat: tuple[Packet, np.ndarray, Cell] | None = None


class Torus(BufferModule):
    """Activity on a torus ``(layers, n_y, n_x)``; a subclass calls :meth:`_set_up`, and moves it.

    The state is the window of active cells, buffers ``window`` and ``origin``.
    """

    growing = ("window",)

    config: PoseCellConfig
    batch: int | None
    shape: Cell
    window: Tensor
    origin: Tensor
    _active: Active

    def _set_up(
        self,
        config: PoseCellConfig,
        batch: int | None,
        shape: Cell,
        factors: tuple[list[Factor], list[Factor]],
    ) -> None:
        """Make buffers and kernels.

        Args:
            config: Dynamics.
            batch: Number of robots side by side; ``None`` for one.
            shape: Layers, and cells along y and x.
            factors: Of excitation and inhibition, along the three axes.
        """
        self.config, self.batch, self.shape = config, batch, shape
        with torch.inference_mode(mode=False):
            made = gaussian_difference(*factors)
        self._kernels = cast(Kernels, made.excite), cast(Kernels, made.inhibit)
        self._couplings: dict[Cell, Couplings] = {}
        self._loops: tuple[np.ndarray, ...] | None = None  # kernels, headings of compiled steps
        brains = () if batch is None else (batch,)
        dtype = getattr(torch, config.precision)
        self.register_buffer("window", torch.ones(1, 1, 1, dtype=dtype))
        self.register_buffer("origin", torch.zeros(*brains, 3, dtype=torch.int64))
        self._active = Active(Packet(self.window, (0, 0, 0), shape))
        self.register_state_dict_pre_hook(Calls("_write_buffers"))
        self.register_load_state_dict_post_hook(Calls("_read_buffers"))

    def reset(self) -> None:
        """Set all activity into the middle cell, as at the start of a session."""
        brains = () if self.batch is None else (self.batch,)
        start = self.window.new_zeros(brains + self.shape)
        start[..., self.shape[0] // 2, self.shape[1] // 2, self.shape[2] // 2] = 1.0
        self.activity = start

    @property
    def kernels(self) -> tuple[Kernels, Kernels]:
        """Excitation and inhibition kernels: the 1-D factors along layers, y and x."""
        return self._kernels

    @property
    def packet(self) -> Packet:
        """The active window and its origin on the torus."""
        return self._active.packet

    @packet.setter
    def packet(self, packet: Packet) -> None:
        self._active.packet = packet
        self._active.estimate = None

    @property
    def activity(self) -> Tensor:
        """Activity of all cells, ``([batch,] layers, n_y, n_x)``, non-negative, sum 1."""
        return (to_dense if self.batch is None else to_tori)(self.packet)

    @activity.setter
    def activity(self, activity: Tensor) -> None:
        self._set_activity(activity)

    def _set_activity(self, activity: Tensor) -> None:
        expected = (() if self.batch is None else (self.batch,)) + self.shape
        if tuple(activity.shape) != expected:
            raise MapError(
                f"{type(self).__name__}: activity has shape {tuple(activity.shape)}, "
                f"expected {expected}"
            )
        convert = to_packet if self.batch is None else to_packets
        self.packet = convert(activity.to(self.window))

    @property
    def peak(self) -> float:
        """Activity of the most active cell: near 0 if the activity is spread out."""
        return self.packet.values.max().item()

    @property
    def centre(self) -> PoseEstimate | Tensor:
        """Centre of the dominant packet in cells: x, y and layer; of a batch ``(batch, 3)``."""
        active = self._active
        if active.estimate is None:
            active.estimate = self._decoded()
        return active.estimate

    def _decoded(self) -> PoseEstimate | Tensor:
        packet, radius = self._active.packet, self.config.decode_radius
        if self.batch is not None:
            return decode_all(packet, radius)
        if not runs_compiled(packet.values):
            return decode(packet, radius)
        return PoseEstimate(*decode_window(*self._flat(), radius))

    def _move(self, ahead: float, layers: float, aside: tuple[float, float]) -> None:
        """Settle and move the activity of one robot.

        Args:
            ahead: Cells by which a layer moves along its heading.
            layers: By which activity moves across layers.
            aside: By which all move along x and y.

        Raises:
            MapError: If inhibition silenced every cell.
        """
        c, active = self.config, self._active
        if not runs_compiled(active.packet.values) or isinstance(ahead, Tensor):
            self.packet = path_integrate(self._settled(), ahead, layers, aside)
            return
        if self._loops is None:
            kernels = (np.stack([k.numpy() for k in made]) for made in self._kernels)
            self._loops = (*kernels, heading_table(self.shape[0]))
        excite, inhibit, headings = self._loops
        moved, sizes, origin, estimate = advance(
            *self._flat(), excite, inhibit, c.global_inhibition, ahead, layers,
            aside, headings, c.decode_radius, c.precision == "float32",
        )  # fmt: skip
        if not moved.size:
            raise silenced(c.global_inhibition)
        active.packet = packet = self._packed(moved, sizes, origin)
        active.flat = packet, moved, sizes
        active.estimate = PoseEstimate(*estimate)

    def _move_all(self, ahead: float | Tensor, layers: float | Tensor, aside: Tensor) -> None:
        """Do the same for a batch; ``aside`` is ``(batch, 2)``."""
        settled = trim_all(self._settled())
        self.packet = move_all(settled, cast(float, ahead), cast(float, layers), aside)

    def _settled(self) -> Packet:
        """Excite, inhibit and normalise the activity."""
        c, packet = self.config, self._active.packet
        a, b, width = packet.values.shape[-3:]
        sizes = (a, b, width)
        coupled = self._couplings.get(sizes)
        if coupled is None:
            with torch.inference_mode(mode=False):  # kept for steps that may want gradients
                made = couplings(*self._kernels, sizes, self.shape)
                coupled = Couplings(
                    *(m.to(device=self.window.device, dtype=self.window.dtype) for m in made)
                )
            self._couplings[sizes] = coupled
        half = c.excite_size // 2
        return settle(packet, coupled, (half, half, half), c.global_inhibition)

    def _inject(self, at: PoseEstimate, energy: float) -> None:
        """Add activity at a point between cells; see :func:`~.attractor.inject`."""
        packet = self.packet
        if runs_compiled(packet.values):
            where = (float(at.theta), float(at.y), float(at.x))
            self.packet = self._packed(*inject_window(*self._flat(), where, energy))
        else:
            self.packet = inject(packet, at, energy)

    def _flat(self) -> tuple[np.ndarray, Cell, Cell, Cell]:
        """Return values, sizes, origin and torus for a compiled step."""
        active = self._active
        packet = active.packet
        if active.flat is not None and active.flat[0] is packet:
            return active.flat[1], active.flat[2], cast(Cell, packet.origin), packet.shape
        values = packet.values.numpy()
        a, b, c = values.shape
        flat = values.reshape(-1).astype(np.float64)
        return flat, (a, b, c), cast(Cell, packet.origin), packet.shape

    def _packed(self, values: np.ndarray, sizes: Cell, origin: Cell) -> Packet:
        """Make a packet of a compiled step's flat window."""
        like = self._active.packet
        window = torch.from_numpy(values.reshape(sizes)).to(like.values.dtype)
        return Packet(window, origin, like.shape)

    def _write_buffers(self) -> None:
        packet = self._active.packet
        self.window = packet.values
        self.origin = (
            torch.tensor(packet.origin) if self.batch is None else cast(Tensor, packet.origin)
        )

    def _read_buffers(self) -> None:
        origin = cast(Cell, tuple(self.origin.tolist())) if self.batch is None else self.origin
        self._active = Active(Packet(self.window, origin, self.shape))

    def _apply(self, fn: Callable[..., Any], recurse: bool = True) -> Self:
        self._couplings.clear()
        self._write_buffers()
        super()._apply(fn, recurse)
        self._read_buffers()
        return self
