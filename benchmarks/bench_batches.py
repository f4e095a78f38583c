"""64 brains of cells side by side beside 64 alone, each with motions of its own, on one thread."""

from collections.abc import Callable

import torch

from benchmarks.bench_navigation import Rat
from benchmarks.bench_ssp import Animals, milliseconds
from benchmarks.timing import Row, written
from neuroslam.cells import PoseCellNetwork
from neuroslam.config import PoseCellConfig
from neuroslam.config.semantic import SSPSLAMConfig
from neuroslam.types import Motion

BRAINS = 64
ALONE = 8
"""Brains that are timed alone: each has other motions, and all take about as long."""

Run = Callable[[int], None]


def pose_cells() -> tuple[Run, Run]:
    """Make runs of so many steps of all brains side by side, and of some, one after the other."""
    generator = torch.Generator().manual_seed(0)
    v = 0.6 * torch.rand(BRAINS, generator=generator)
    w = 0.4 * torch.rand(BRAINS, generator=generator) - 0.2
    config = PoseCellConfig(cell_size_m=1.0)
    together = PoseCellNetwork(config, batch=BRAINS)
    alone = [PoseCellNetwork(config) for _ in range(ALONE)]
    own = [Motion(v[k].item(), w[k].item(), 1.0) for k in range(ALONE)]

    def all_of_them(steps: int) -> None:
        for _ in range(steps):
            together.integrate(Motion(v, w, 1.0))

    def some(steps: int) -> None:
        for cells, motion in zip(alone, own, strict=True):
            for _ in range(steps):
                cells.integrate(motion)

    return all_of_them, some


def navigation_cells() -> tuple[Run, Run]:
    """Make the same for boundary, grid and place cells of a foraging rat."""
    together, alone = Rat(BRAINS), Rat()
    together.steps(2000)
    alone.steps(2000)

    def some(steps: int) -> None:
        for _ in range(ALONE):
            alone.steps(steps)

    return together.steps, some


def ssp_slam() -> tuple[Run, Run]:
    """Make the same for SSP-SLAM in vectors."""
    together, alone = Animals(SSPSLAMConfig(), BRAINS), Animals(SSPSLAMConfig(), 1)

    def some(steps: int) -> None:
        for _ in range(ALONE):
            alone.steps(steps)

    return together.steps, some


@torch.inference_mode()
def rows() -> list[Row]:
    found = []
    for name, make, steps in (
        ("pose cells, tracking", pose_cells, 50),
        ("boundary, grid and place cells", navigation_cells, 50),
        ("SSP-SLAM in vectors", ssp_slam, 50),
    ):
        together, alone = make()
        together(50)
        alone(50)
        ms = milliseconds({"together": together, "alone": alone}, steps)
        one, side_by_side = ms["alone"] / ALONE, ms["together"] / BRAINS
        ratio = f"{one / side_by_side:.1f} times one alone, which takes {written(one)}"
        size = f"a step of one of {BRAINS} brains"
        found.append(Row(name, size, side_by_side, "", "", ratio))
    return found
