"""One frame of the pose cells, tracking: settle, path integration, estimate."""

import pytest
import torch

from benchmarks.timing import Row, cpu_ms
from neuroslam.cells import PoseCellNetwork
from neuroslam.config import PoseCellConfig
from neuroslam.types import Motion

SIZES = {(21, 36): "<= 30 µs", (80, 35): "<= 30 µs"}
STEP = Motion(0.3, 0.1, 1.0)


def tracking(n_xy: int, n_theta: int) -> PoseCellNetwork:
    cells = PoseCellNetwork(PoseCellConfig(n_xy=n_xy, n_theta=n_theta, cell_size_m=1.0))
    for _ in range(50):
        cells.integrate(STEP)
    return cells


@torch.inference_mode()
def rows() -> list[Row]:
    found = []
    for (n_xy, n_theta), target in SIZES.items():
        cells = tracking(n_xy, n_theta)
        ms = cpu_ms(lambda cells=cells: cells.integrate(STEP), 300)
        size = f"{n_xy}x{n_xy}x{n_theta}"
        beside = "C++ 0.073 Y" if n_xy == 21 else ""
        found.append(Row("pose cells, a frame", size, ms, target, beside))
    return found


@pytest.mark.parametrize(("n_xy", "n_theta"), SIZES)
def test_pose_cells_tracking(benchmark, n_xy, n_theta):
    torch.set_num_threads(1)
    cells = tracking(n_xy, n_theta)
    with torch.inference_mode():
        benchmark(cells.integrate, STEP)
