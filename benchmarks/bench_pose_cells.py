"""One frame of the pose cells, tracking: settle, path integration, estimate."""

import pytest
import torch

from benchmarks.timing import Row, cpu_ms
from neuroslam.cells import PoseCellNetwork
from neuroslam.config import PoseCellConfig
from neuroslam.types import Motion

SIZES = {(21, 36): ("1.06", "0.35"), (80, 35): ("8.4", "0.5")}
BATCH = 64
STEP = Motion(0.3, 0.1, 1.0)


def tracking(n_xy: int, n_theta: int, batch: int | None = None) -> PoseCellNetwork:
    config = PoseCellConfig(n_xy=n_xy, n_theta=n_theta, cell_size_m=1.0)
    cells = PoseCellNetwork(config, batch=batch)
    for _ in range(50):
        cells.integrate(step_of(batch))
    return cells


def step_of(batch: int | None) -> Motion:
    if batch is None:
        return STEP
    return Motion(torch.full((batch,), STEP.v_m_s), torch.full((batch,), STEP.w_rad_s), STEP.dt_s)


@torch.inference_mode()
def rows() -> list[Row]:
    found = []
    for (n_xy, n_theta), (reference, target) in SIZES.items():
        cells = tracking(n_xy, n_theta)
        ms = cpu_ms(lambda cells=cells: cells.integrate(STEP), 300)
        size = f"{n_xy}x{n_xy}x{n_theta}"
        found.append(
            Row("pose cells, a frame", size, f"{reference} ms", f"<= {target} ms", f"{ms:.2f} ms")
        )
    cells = tracking(21, 36, BATCH)
    step = step_of(BATCH)
    ms = cpu_ms(lambda: cells.integrate(step), 5, 5) / BATCH
    found.append(
        Row(f"pose cells, a frame, {BATCH} brains", "21x21x36", "-", "-", f"{ms:.2f} ms a brain")
    )
    return found


@pytest.mark.parametrize(("n_xy", "n_theta"), SIZES)
def test_pose_cells_tracking(benchmark, n_xy, n_theta):
    torch.set_num_threads(1)
    cells = tracking(n_xy, n_theta)
    with torch.inference_mode():
        benchmark(cells.integrate, STEP)
