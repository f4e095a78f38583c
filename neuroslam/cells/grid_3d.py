"""Grid cells of three dimensions: an attractor on a torus of height, y and x.

One of the two networks of :mod:`~neuroslam.cells.pose_3d`. The torus is that of the pose cells
with height in place of heading, so the steps are theirs: excitation and inhibition by convolution
along three axes, in the window of active cells, and a translation of all cells alike.
"""

import torch
from torch import Tensor

from neuroslam.cells.attractor import path_integrate
from neuroslam.cells.torus import Torus
from neuroslam.config import PoseCellConfig
from neuroslam.types import PoseEstimate


class GridCells3D(Torus):
    """Continuous attractor on the torus ``(n_z, n_xy, n_xy)``; a packet encodes the position.

    :func:`~neuroslam.cells.attractor.settle` has the mathematics of the attractor; movement is
    :func:`~neuroslam.cells.attractor.path_integrate` with height in place of heading. Set-up and
    reading are those of :class:`~neuroslam.cells.torus.Torus`.

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

    def __init__(self, config: PoseCellConfig, n_z: int, batch: int | None = None) -> None:
        super().__init__()
        factors = (
            3 * [(config.excite_size, config.excite_std_xy)],
            3 * [(config.inhibit_size, config.inhibit_std_xy)],
        )
        self._set_up(config, batch, (n_z, config.n_xy, config.n_xy), factors)
        self.reset()

    @property
    def estimate(self) -> tuple[float, float, float] | Tensor:
        """x, y and z of the dominant packet in cells; of a batch ``(batch, 3)``."""
        centre = self.centre
        return centre if isinstance(centre, Tensor) else (centre.x, centre.y, centre.theta)

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
        if self.batch is None:
            self._move(0.0, float(dz_cells), (float(dx_cells), float(dy_cells)))
            return self.estimate
        aside = torch.stack(
            torch.broadcast_tensors(
                *(torch.as_tensor(by, dtype=torch.float64) for by in (dx_cells, dy_cells))
            )
        )
        self._move_all(0.0, dz_cells, aside.T if aside.dim() == 2 else aside.expand(self.batch, 2))
        return self.estimate

    def shift(self, dx_cells: float, dy_cells: float, dz_cells: float) -> None:
        """Move the activity by a correction."""
        self.packet = path_integrate(self.packet, 0.0, dz_cells, (dx_cells, dy_cells))

    def inject(self, x: float, y: float, z: float, energy: float) -> None:
        """Add activity at a point between cells; see :func:`~.attractor.inject`."""
        self._inject(PoseEstimate(x, y, z), energy)
