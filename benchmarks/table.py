"""Run the benchmarks and print one table: ``python -m benchmarks.table``.

``--write`` keeps it in ``benchmarks/last.json``; ``--check`` fails if a row takes 15 % longer, in
Y, than there. ``--only NAME`` runs the modules whose names contain NAME, and ``--only NAME:TEXT``
keeps of them the rows whose step and size contain TEXT. Rows that were not measured stay in
``last.json`` as they are.
"""

import argparse
import json
import platform
import sys
from importlib import import_module
from pathlib import Path

import cv2
import torch

from benchmarks.timing import Row, written, yardstick_ms

MODULES = (
    "pose_cells", "view_search", "relaxation", "pose_graph", "merge", "arena", "navigation", "ssp",
    "batches", "end_to_end", "compilation",
)  # fmt: skip
LAST = Path(__file__).with_name("last.json")
LOSS = 1.15
HEAD = ("step", "size", "here", "in Y", "target", "beside", "more")


def machine() -> str:
    """Name the processor and what it runs."""
    names = [
        line.partition(":")[2].strip()
        for line in Path("/proc/cpuinfo").read_text().splitlines()
        if line.startswith("model name")
    ] if Path("/proc/cpuinfo").is_file() else [platform.processor()]  # fmt: skip
    return f"{names[0]}, Python {platform.python_version()}, torch {torch.__version__}"


def measured(only: str) -> dict[str, tuple[float, Row]]:
    """Run the modules: step and size -> time in Y, and the row."""
    found = {}
    wanted, _, text = only.partition(":")
    for name in MODULES:
        if wanted in name:
            y = yardstick_ms()
            for row in import_module(f"benchmarks.bench_{name}").rows():
                title = f"{row.step} | {row.size}"
                print(f"  {row.step}, {row.size}: {written(row.ms)}", file=sys.stderr)
                if text in title:
                    found[title] = row.ms / y, row
    return found


def lost(now: dict[str, float], last: dict[str, float]) -> list[str]:
    """Say which rows take longer than they did, by 15 % or more."""
    return [
        f"{name}: {now[name]:.4g} Y, last {last[name]:.4g} Y"
        for name in now.keys() & last.keys()
        if now[name] > LOSS * last[name]
    ]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--write", action="store_true")
    parser.add_argument("--only", default="")
    asked = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    found = measured(asked.only)
    print(f"{machine()}; Y = {yardstick_ms():.2f} ms\n")
    print("| " + " | ".join(HEAD) + " |")
    print("|---" * len(HEAD) + "|")
    for y, row in found.values():
        cells = (row.step, row.size, written(row.ms), f"{y:.3g}", row.target, row.beside, row.more)
        print("| " + " | ".join(cells) + " |")
    now = {name: y for name, (y, _) in found.items()}
    last = json.loads(LAST.read_text()) if LAST.is_file() else {}
    slower = lost(now, last) if asked.check else []
    if asked.write:
        kept = last | {name: round(y, 5) for name, y in now.items()}
        LAST.write_text(json.dumps(kept, indent=1) + "\n")
    print(*slower, sep="\n")
    return 1 if slower else 0


if __name__ == "__main__":
    sys.exit(main())
