"""First-use compilation: CPU seconds in which numba compiles every step once, into a new cache.

``python -m benchmarks.bench_compilation`` lists the steps that take longest.
"""

import importlib
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.timing import Row

ROOT = Path(__file__).resolve().parents[1]


def _measure() -> list[tuple[float, float, int, str]]:
    """Run each case of the contract test once: own and whole seconds, depth and name of a step."""
    import numpy as np
    import torch
    from numba.core import event

    from tests.compiled_cases import CASES

    torch.set_num_threads(1)
    stack: list[list[float]] = []
    rows: list[tuple[float, float, int, str]] = []

    class Watch(event.Listener):
        def on_start(self, event):
            stack.append([time.process_time(), 0.0])

        def on_end(self, event):
            began, within = stack.pop()
            whole = time.process_time() - began
            if stack:
                stack[-1][1] += whole
            step = event.data["dispatcher"].py_func
            rows.append((whole - within, whole, len(stack), f"{step.__module__}.{step.__name__}"))

    event.register("numba:compile", Watch())
    for file in sorted((ROOT / "tests/compiled_cases").glob("[a-z]*.py")):
        importlib.import_module(f"tests.compiled_cases.{file.stem}")
    for name in {make: name for name, make in CASES.items()}.values():
        CASES[name](np.random.default_rng(0))
    return rows


FIRST = {
    "auto": "world:corridor",
    "openratslam": "world:corridor",
    "slrb": "arena:square?minutes=1",
    "full": "world:corridor?ranges=36&markers=6",
}
"""Presets -> sources of a first run, long enough to call every step that the preset needs."""


def _first_run(preset: str, source: str) -> float:
    """Return by how many CPU seconds a first run with a preset takes longer than a second one."""
    with tempfile.TemporaryDirectory() as folder:
        seconds = []
        for _ in range(2):
            began = sum(os.times()[2:4])
            subprocess.run(
                [sys.executable, "-m", "neuroslam", "run", source, "--preset", preset,
                 "--overwrite", "-o", f"{folder}/run"],
                check=True, cwd=ROOT, capture_output=True,
                env=os.environ | {"NUMBA_CACHE_DIR": f"{folder}/cache"},
            )  # fmt: skip
            seconds.append(sum(os.times()[2:4]) - began)
    return seconds[0] - seconds[1]


def rows():
    for preset, source in FIRST.items():
        yield Row(
            "first-use compilation", f"run, {preset}", 1e3 * _first_run(preset, source), "15 s"
        )
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(
            [sys.executable, "-W", "ignore", "-m", "benchmarks.bench_compilation"], check=True,
            cwd=ROOT, env=os.environ | {"NUMBA_CACHE_DIR": folder}, capture_output=True, text=True,
        )  # fmt: skip
    whole_s, count = done.stdout.split()[:2]
    yield Row("first-use compilation", f"all steps, {count} compiled", 1e3 * float(whole_s), "15 s")


if __name__ == "__main__":
    compiled = _measure()
    print(f"{sum(whole for _, whole, depth, _ in compiled if depth == 0):.1f} {len(compiled)}")
    for own, whole, _, name in sorted(compiled, reverse=True)[:40]:
        print(f"{own:6.2f} {whole:6.2f} {name}")
