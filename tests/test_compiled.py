"""Every compiled step gives what its definition gives, and the same bits each time.

A step stands under its definition; each that Python calls has a case in ``compiled_cases/``.
"""

import ast
import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from neuroslam.compiled import STEPS, Compiled, _names, compiled
from tests.compiled_cases import CASES

ROOT = Path(__file__).resolve().parents[1] / "neuroslam"
FILES = [path for path in sorted(ROOT.rglob("*.py")) if "\n@compiled\n" in path.read_text()]
for _path in FILES:
    importlib.import_module(".".join(("neuroslam", *_path.relative_to(ROOT).with_suffix("").parts)))
for _path in sorted(Path(__file__).parent.glob("compiled_cases/[a-z]*.py")):
    importlib.import_module(f"tests.compiled_cases.{_path.stem}")

ONCE = {make: name for name, make in CASES.items()}
"""A case of several steps is run under the name of the last."""


@pytest.mark.parametrize("name", sorted(ONCE.values()))
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
        if isinstance(node, ast.ImportFrom) and str(node.module).startswith("neuroslam")
        for alias in node.names
        if isinstance(getattr(importlib.import_module(node.module), alias.name, None), Compiled)
    }
    mine = [s for s in STEPS.values() if s.__wrapped__.__code__.co_filename == str(path)]
    for step in mine:
        assert not foreign & set(step.plain.__code__.co_names)


def test_what_is_not_kept_is_announced_once(monkeypatch, tmp_path):
    said = []
    monkeypatch.setattr("neuroslam.compiled.announce", lambda: said.append("compiling"))
    (tmp_path / "fresh.py").write_text(
        "def one(x):\n    return x + 1.0\n\n\ndef two(x):\n    return x + 2.0\n"
    )
    spec = importlib.util.spec_from_file_location("fresh", tmp_path / "fresh.py")
    fresh = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "fresh", fresh)
    spec.loader.exec_module(fresh)
    assert compiled(fresh.one)(1.0) == 2.0
    assert said == ["compiling"]
    assert compiled(fresh.two)(1.0) == 3.0
    assert said == ["compiling"]
    monkeypatch.setattr("neuroslam.compiled.announce", lambda: said.append("again"))
    assert compiled(fresh.one)(1.0) == 2.0
    assert said == ["compiling"]


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
