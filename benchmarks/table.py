"""Run every benchmark and print one table: ``python -m benchmarks.table``."""

import cv2
import torch
from rich.console import Console
from rich.table import Table

from benchmarks import (
    bench_arena,
    bench_batches,
    bench_end_to_end,
    bench_merge,
    bench_navigation,
    bench_pose_cells,
    bench_relaxation,
    bench_ssp,
    bench_view_search,
)


def main() -> None:
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    table = Table("step", "size", "C++ reference", "target", "measured here")
    for module in (
        bench_pose_cells,
        bench_view_search,
        bench_relaxation,
        bench_merge,
        bench_arena,
        bench_navigation,
        bench_ssp,
        bench_batches,
        bench_end_to_end,
    ):
        for row in module.rows():
            table.add_row(*row)
    Console(width=130).print(table)


if __name__ == "__main__":
    main()
