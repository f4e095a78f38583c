"""Pose cells and maps of three dimensions."""

import torch

from neuroslam.cells.pose_3d import Pose3DConfig, PoseCells3D
from neuroslam.config import PoseCellConfig
from neuroslam.mapping.heights import Rises, relax_heights
from neuroslam.types import Motion, ViewMatch
from tests.compiled_cases import case, with_and_without


@case("cells.yaw_height.sheet_step")
def _a_few_frames_of_pose_cells_in_3d(draw):
    n_z, n_xy, n_theta = draw.integers(7, 12, 3)
    config = PoseCellConfig(
        n_theta=n_theta, n_xy=n_xy, cell_size_m=1.0, inject_after=0,
        precision=draw.choice(["float32", "float64"]), excite_size=draw.choice([3, 7]),
        inhibit_size=draw.choice([3, 5]), decode_radius=draw.integers(1, 5),
        exact_gain=bool(draw.integers(2)),
    )  # fmt: skip
    volume = torch.from_numpy(draw.random((n_z, n_xy, n_xy)) ** draw.integers(9, 60))
    sheet = torch.from_numpy(draw.random((n_z, n_theta)) ** draw.integers(5, 30))
    start, (v, w, up) = 7 * draw.random(4), draw.normal(0.0, 2.0, 3)

    def drive():
        cells = PoseCells3D(config, Pose3DConfig(n_z=n_z))
        cells.grid.activity = volume / volume.sum()
        cells.sheet.activity = (sheet / sheet.sum()).to(cells.sheet.activity.dtype)
        cells.bindings.append(**dict(zip(("x", "y", "z", "theta"), start, strict=True)), decay=0.1)
        found = []
        for view in (ViewMatch(0, 0.0, 0.3, False), ViewMatch(-1, -1.0, 0.0, False)):
            cells.update_from_view(view)
            cells.integrate(Motion(v, w, 0.4), up)
            found += [cells.grid.activity.numpy(), cells.sheet.activity.numpy()]
        return found

    return with_and_without(drive)


@case("mapping.heights.relax_heights_step")
def _loops_of_heights(draw):
    n, n_rises = draw.integers(2, 40), draw.integers(1, 90)
    source = draw.integers(0, n, n_rises)
    target = (source + draw.integers(1, n, n_rises)) % n
    rises, z = Rises(source, target, draw.normal(size=n_rises)), draw.normal(size=n)

    def relaxed():
        moved = z.copy()
        relax_heights(moved, rises, 3, 0.4)
        return [moved]

    return with_and_without(relaxed)
