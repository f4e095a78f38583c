"""Every compiled step gives what its definition gives, and the same bits each time.

A step stands under its definition. Here each step that Python calls has a case: a function that
makes random inputs and returns pairs of what the definition and what the step gave.
"""

import ast
import importlib
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import neuroslam.compiled as switch
from neuroslam.cells import PoseCellNetwork
from neuroslam.compiled import STEPS, Compiled, _names, compiled
from neuroslam.config import PoseCellConfig
from neuroslam.mapping.actions import nearest_bound, nearest_bound_of_arrays
from neuroslam.mapping.relax import Relaxation
from neuroslam.types import Motion, ViewMatch

ROOT = Path(__file__).resolve().parents[1] / "neuroslam"
FILES = [path for path in sorted(ROOT.rglob("*.py")) if "\n@compiled\n" in path.read_text()]
for _path in FILES:
    importlib.import_module(".".join(("neuroslam", *_path.relative_to(ROOT).with_suffix("").parts)))

CASES = {}


def case(*steps):
    """Register a case of steps of the package, named without ``neuroslam.``."""

    def register(make):
        CASES.update({f"neuroslam.{step}": make for step in steps})
        return make

    return register


def with_and_without(do):
    """Do the same by the definition and by compiled steps; pairs of the arrays that it returns."""
    found = []
    for enabled in (False, True):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(switch, "ENABLED", enabled)
            found.append(do())
    return list(zip(*found, strict=True))


@case("cells.attractor.advance", "cells.attractor.decode_window", "cells.attractor.inject_window")
def _a_few_frames_of_pose_cells(draw):
    n_theta, n_xy = draw.integers(7, 14, 2)
    precision = draw.choice(["float32", "float64"])
    config = PoseCellConfig(
        n_theta=n_theta, n_xy=n_xy, cell_size_m=1.0, precision=precision, inject_after=0,
        excite_size=draw.choice([3, 7]), inhibit_size=draw.choice([3, 5]),
        decode_radius=draw.integers(1, 8), exact_gain=bool(draw.integers(2)),
    )  # fmt: skip
    activity = torch.from_numpy(draw.random((n_theta, n_xy, n_xy)) ** draw.integers(9, 60))
    torus = torch.tensor([n_xy, n_xy, n_theta])
    start, v, w = draw.random(3), *draw.normal(0.0, 2.0, 2)

    def drive():
        cells = PoseCellNetwork(config)
        cells.activity = activity / activity.sum()
        cells.bindings.append(**dict(zip(("x", "y", "theta"), 7 * start, strict=True)), decay=0.1)
        frames = [cells.activity]
        for view in (ViewMatch(0, 0.0, 0.3, False), ViewMatch(-1, -1.0, 0.0, False)):
            cells(Motion(v, w, 0.4), view)
            turns = torch.tensor(cells.estimate, dtype=torch.float64) / torus
            frames += [cells.activity, turns.to(cells.activity)]
        return [frame.numpy() for frame in frames]

    return with_and_without(drive)


@case("mapping.relax.relax")
def _loops_of_relaxation(draw):
    n, n_links = draw.integers(2, 40), draw.integers(1, 90)
    source = draw.integers(0, n, n_links)
    links = (
        source, (source + draw.integers(1, n, n_links)) % n, draw.uniform(0.0, 3.0, n_links),
        *draw.uniform(-np.pi, np.pi, (2, n_links)),
    )  # fmt: skip
    links[4][draw.random(n_links) < 0.2] = np.nan
    poses, loops = draw.normal(size=(n, 3)), draw.integers(1, 4)

    def relaxed():
        solved, moved = Relaxation(*links).run(poses, loops, 0.4)
        turns = np.cos(solved[:, 2]), np.sin(solved[:, 2])  # pi and -pi are one heading
        return [solved[:, :2].copy(), *turns, np.array(moved)]

    return with_and_without(relaxed)


@case("mapping.actions.nearest_bound")
def _experiences_with_one_view(draw):
    torus, n = (5, 5, 7), draw.integers(0, 12)
    bound = np.round(draw.uniform(0.0, 1.0, (n, 3)) * torus * 2) / 2  # some are equally near
    views, now = draw.integers(0, 3, n), tuple(np.round(draw.uniform(-9.0, 9.0, 3) * 2) / 2)
    found = [find(bound, views, 1, now, torus) for find in (nearest_bound_of_arrays, nearest_bound)]
    return [(np.array(a), np.array(b)) for a, b in zip(*found, strict=True)]


@pytest.mark.parametrize("name", sorted(CASES))
@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_step_gives_what_its_definition_gives_and_the_same_bits_again(name, seed):
    pairs, again = (CASES[name](np.random.default_rng(seed)) for _ in range(2))
    assert pairs
    for (expected, got), (_, repeated) in zip(pairs, again, strict=True):
        expected, got = np.asarray(expected), np.asarray(got)
        assert expected.dtype == got.dtype
        assert got.tobytes() == np.asarray(repeated).tobytes()
        exact = 1e-6 if got.dtype in (np.float32, np.complex64) else 1e-12
        if np.array_equal(expected, got):  # infinity too
            continue
        scale = np.abs(expected).max(initial=1.0)
        np.testing.assert_allclose(got, expected, rtol=0.0, atol=exact * scale)


def test_every_step_has_a_case_or_is_part_of_one_that_has():
    def parts(name):
        step = STEPS[name]
        called = (f"{step.__module__}.{other}" for other in _names(step.plain.__code__))
        return {name}.union(*(parts(other) for other in called if other in STEPS))

    covered = set().union(*map(parts, CASES))
    assert {name for name in STEPS if name.startswith("neuroslam.")} <= covered


@compiled
def _twice(x):
    return 2.0 * x


@compiled
def _sum_of_twice(values):
    total = 0.0
    for k in range(values.shape[0]):
        total += _twice(values[k])
    return total


def test_a_step_calls_the_compiled_steps_of_its_file():
    assert _sum_of_twice(np.array([1.0, 2.5])) == 7.0
    assert isinstance(_sum_of_twice, Compiled)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_a_step_calls_steps_of_its_own_file_only(path):
    # What is kept on disk is renewed when the file changes, not when another does.
    foreign = {
        alias.asname or alias.name
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
        if isinstance(getattr(importlib.import_module(node.module), alias.name, None), Compiled)
    }
    mine = [s for s in STEPS.values() if s.__wrapped__.__code__.co_filename == str(path)]
    for step in mine:
        assert not foreign & set(step.plain.__code__.co_names)


def test_steps_compile_where_no_folder_can_be_written(tmp_path):
    code = (
        "import numpy as np, numba.core.caching as c;"
        "c.CacheImpl._locator_classes = [];"
        "from neuroslam.compiled import compiled;"
        "exec(compile('def f(x):\\n    return x + 1.0\\n', 'f.py', 'exec'));"
        "print(compiled(f)(1.0))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, env=os.environ
    )
    assert done.stdout.strip() == "2.0", done.stderr
