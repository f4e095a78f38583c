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
from hypothesis import given, settings
from hypothesis import strategies as st

import neuroslam.compiled
from neuroslam.compiled import STEPS, Compiled, _names, compiled
from neuroslam.config import OdometryConfig, ViewConfig
from neuroslam.odometry import VisualOdometry
from neuroslam.odometry.visual import match_profiles
from neuroslam.sensors.grey import to_grey
from neuroslam.view import LocalViewCells
from neuroslam.view.preprocess import encode
from neuroslam.view.search import Geometry, distances

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


def by_both(call):
    """Return what a call gives by definition, and by compiled steps."""
    enabled, found = neuroslam.compiled.ENABLED, []
    try:
        for neuroslam.compiled.ENABLED in (False, True):
            found.append(call())
    finally:
        neuroslam.compiled.ENABLED = enabled
    return list(zip(*found, strict=True))


def random_images(rng, n=2):
    """Grey images of one random size: a texture, each noisier than the one before."""
    height, width = rng.integers(40, 90, 2)
    texture = rng.integers(0, 256, (height, width), np.uint8)
    noise = rng.integers(-9, 10, (n, height, width)) * np.arange(n)[:, None, None]
    return np.clip(texture.astype(int) + noise, 0, 255).astype(np.uint8)


def random_view_config(rng):
    return ViewConfig(
        template_width=int(rng.integers(12, 32)),
        template_height=int(rng.integers(3, 12)),
        shift_match=int(rng.integers(0, 4)),
        shift_step=int(rng.integers(1, 3)),
        panoramic=bool(rng.integers(2)),
        precision=("uint8", "float64")[rng.integers(2)],
        mean_gate=bool(rng.integers(2)),
        threshold=float(rng.uniform(0.02, 0.2)),
        normalisation=(0.0, 0.5)[rng.integers(2)],
        patch_radius=int(rng.integers(0, 4)),
    )


@case("sensors.grey.mean_step")
def _mean_of_colours(rng):
    image = rng.integers(0, 256, (*rng.integers(1, 40, 2), 3), np.uint8)
    return by_both(lambda: [to_grey(image, "mean")])


@case("view.preprocess.encode_step")
def _encode(rng):
    (image,), config = random_images(rng, 1), random_view_config(rng)
    return by_both(lambda: encode(image[:, 1:], config))


@case("view.search.nearest_step", "view.search.learn_step", "view.search.coarse_step")
def _views(rng):
    config = random_view_config(rng)
    size = (int(rng.integers(0, 70)), config.template_height, config.template_width)
    templates = rng.random(size) * rng.uniform(0.5, 1.0, (size[0], 1, 1))
    views = rng.random((5, *size[1:]))
    if size[0]:
        views[1:] = np.roll(templates[rng.integers(size[0], size=4)], 1, axis=2)
        views[1:] += rng.uniform(-0.02, 0.02, views[1:].shape)  # or two shifts may be equally near
        views = np.clip(views, 0.0, 1.0)
        templates[-1] = templates[0]

    def call():
        cells = LocalViewCells(config)
        for template in templates:
            cells.learn(template)
        cells.last.template = 3
        found = [tuple(cells.search(view)) for view in views]
        return [found, *(cells.templates[name].numpy() for name in cells.templates.columns)]

    return by_both(call)


@case("view.search.distances_step")
def _distances(rng):
    geometry = Geometry.of(random_view_config(rng))
    pixels = rng.integers(0, 256, (7, geometry.width * geometry.height), np.uint8)
    query = rng.integers(0, 256, (geometry.width, geometry.height), np.uint8)
    return by_both(lambda: [distances(pixels, query, geometry)])


@case("odometry.visual.match_step")
def _match(rng):
    n = int(rng.integers(5, 40))
    now, previous = rng.integers(0, rng.integers(2, 1000), (2, n)).astype(np.int32)
    return by_both(lambda: match_profiles(now, previous, n // 2))


@case("odometry.visual.measure_step")
def _measure(rng):
    images, first_frame = random_images(rng, 4), ("still", "zero_profile")[rng.integers(2)]
    config = OdometryConfig(max_shift_px=9, first_frame=first_frame)

    def call():
        odometry = VisualOdometry(config)
        motions = [odometry(image, 0.1) for image in images]
        return [motions, odometry.speed_sums.numpy(), odometry.turn_sums.numpy()]

    return by_both(call)


@pytest.mark.parametrize("name", sorted(CASES))
@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_step_gives_what_its_definition_gives_and_the_same_bits_again(name, seed):
    pairs, again = (CASES[name](np.random.default_rng(seed)) for _ in range(2))
    assert pairs
    for (expected, got), (_, repeated) in zip(pairs, again, strict=True):
        expected, got = np.asarray(expected), np.asarray(got)
        assert expected.dtype == got.dtype
        exact = 1e-6 if got.dtype in (np.float32, np.complex64) else 1e-12
        scale = np.abs(expected).max(initial=1.0)
        np.testing.assert_allclose(got, expected, rtol=0.0, atol=exact * scale)
        assert got.tobytes() == np.asarray(repeated).tobytes()


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
