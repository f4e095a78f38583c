"""Every compiled step gives what its definition gives, and the same bits each time.

A step stands under its definition. Here each step that Python calls has a case: a function that
makes random inputs and returns pairs of what the definition and what the step gave.
"""

import ast
import copy
import functools
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
from neuroslam.config.semantic import (
    NeuronConfig,
    PathIntegratorConfig,
    SemanticMapConfig,
    SSPSLAMConfig,
    SSPSpaceConfig,
)
from neuroslam.mapping.actions import nearest_bound, nearest_bound_of_arrays
from neuroslam.mapping.relax import Relaxation
from neuroslam.spiking import vector_steps
from neuroslam.spiking.associative import AssociativeMap
from neuroslam.spiking.binding import SpikingBinding
from neuroslam.spiking.decoding import PositionDecoder
from neuroslam.spiking.path_integrator import PathIntegrator
from neuroslam.spiking.populations import VectorPopulation
from neuroslam.spiking.slam import SSPSLAM
from neuroslam.spiking.space import SSPSpace
from neuroslam.types import Motion, ViewMatch
from neuroslam.worlds.landmarks import LandmarkView

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


def by_both(module, step):
    """Let copies of a module step, as defined and compiled; pairs of results and states."""

    def stepped():
        mine = copy.deepcopy(module)
        with torch.inference_mode():
            results = step(mine)
        state = [part for _, part in sorted(mine.state_dict().items())]
        return [(part * 1).numpy() for part in (*results, *state)]

    return with_and_without(stepped)


def with_state(module, draw):
    """Return a copy of a module in double precision whose neurons and filters are anywhere."""
    module = copy.deepcopy(module).double()
    for name, buffer in module.named_buffers():
        last = name.rpartition(".")[2]
        noise = torch.from_numpy(draw.standard_normal(tuple(buffer.shape)))
        if last == "deficit":
            buffer.copy_(1e-3 + torch.from_numpy(draw.random(tuple(buffer.shape))))
        elif last == "asleep":
            buffer.copy_((2.0 * noise).clamp(0.0, 2.0))
        elif last in STATE:
            buffer.copy_((0.1 if last == "pull" else 0.5) * noise)
        elif last == "activity_hz":
            buffer.copy_((200.0 * noise).clamp_min(0.0))
        elif last == "contradicted_s":
            buffer.copy_(noise.clamp_min(0.0))
    return module


STATE = {
    "recurrent", "external", "decoded", "product", "recalled", "relayed", "taught", "rule", "pull",
    "here", "there",
}  # fmt: skip


def placed(walk, draw):
    """Put animals somewhere, a little off from where their oscillators say."""
    at = torch.from_numpy(draw.uniform(-0.5, 0.5, tuple(walk.position_m.shape)))
    z = torch.view_as_real(walk.space.encode_fourier(at + 0.01))
    z = z + 0.1 * torch.from_numpy(draw.standard_normal(tuple(z.shape)))
    walk.position_m = at
    if isinstance(walk, PathIntegrator):
        walk.output = z.transpose(0, 1).contiguous()
    else:
        walk.phasor = z
    return walk


def complex_of(draw, *shape):
    return torch.from_numpy(draw.standard_normal(shape) + 1j * draw.standard_normal(shape))


@functools.cache
def made(name):
    """Return a small module of SSP-SLAM, to be copied."""
    space = SSPSpace.hexagonal(n_scales=2)
    model = NeuronConfig(model="stepped_lif" if name == "stepped" else "lif", tau_ref_s=0.0023)
    if name in ("walk", "modules", "none"):
        coupling = {"walk": "manifold"}.get(name, name)
        cells = 12 if name == "modules" else 0
        config = PathIntegratorConfig(neurons=30, coupling=coupling, velocity_neurons=cells)
        return PathIntegrator(space, config, model, 1e-3, batch=2)
    if name == "objects":
        return VectorPopulation.of_objects(space, 30, model, 1e-3, batch=2)
    if name in ("bind", "stepped"):
        return SpikingBinding(4, 12, model, 1e-3, batch=2)
    config = SemanticMapConfig(neurons=20, relay=True, voja_rate=0.1)
    memory = AssociativeMap(5, 13, config, model, 1e-3, batch=2)
    memory.decoders = torch.randn(2, 20, 13, generator=torch.Generator().manual_seed(0))
    return memory


@case("spiking.neurons.respond", "spiking.ensemble.filter_into")
def _a_population_says_what_it_is_tuned_to(draw):
    objects = with_state(made("objects"), draw)
    z = complex_of(draw, 2, objects.decoded.shape[1])
    return by_both(objects, lambda cells: [torch.view_as_real(cells(z))])


@case("spiking.binding.sums_and_differences", "spiking.binding.products_of")
def _vectors_are_bound(draw):
    a, b = complex_of(draw, 2, 4), complex_of(draw, 2, 4).conj()
    return [
        pair
        for name in ("bind", "stepped")
        for pair in by_both(
            with_state(made(name), draw), lambda bind: [torch.view_as_real(bind(a, b))]
        )
    ]


@case("spiking.learning.memorise")
def _a_memory_recalls_and_learns(draw):
    memory = with_state(made("memory"), draw)
    key, value = (torch.from_numpy(draw.standard_normal((2, n))) for n in (5, 13))
    seen, plasticity, voja = torch.from_numpy(draw.random((3, 2)).round(1))
    seen = seen.round()
    return by_both(memory, lambda m: [m(key, value, seen, plasticity, voja)])


@case("spiking.vector_steps.oscillators_before", "spiking.vector_steps.oscillators_after")
def _a_position_is_integrated_by_neurons(draw):
    velocity = torch.from_numpy(draw.uniform(-0.6, 0.6, (2, 2)))
    pairs = []
    for name in ("walk", "modules", "none"):
        walk = placed(with_state(made(name), draw), draw)
        walk.age.fill_(int(draw.choice([2, 3, 99])))
        pull = None if draw.random() < 0.3 else complex_of(draw, 2, 18)
        pairs += by_both(walk, lambda w, pull=pull: [torch.view_as_real(w(velocity, pull))])
    return pairs


@case("spiking.vector_steps.search", "spiking.vector_steps.similarity")
def _a_position_is_decoded(draw):
    space = SSPSpace.hexagonal(n_scales=2).double()
    decoder, at = PositionDecoder(space), torch.from_numpy(draw.uniform(-0.9, 0.9, 2))
    z = space.encode_fourier(at) + 0.1 * complex_of(draw, 18)
    expected, parts, x = decoder(z), torch.view_as_real(z).numpy(), np.empty(2)
    tables = decoder.tables()
    best = vector_steps.search(tuple(tables), parts, x)
    alike = vector_steps.similarity(tables.waves, parts, at.numpy())
    return [
        (expected.position_m.numpy(), x),
        (expected.similarity.numpy(), best),
        (decoder.similarity(z, at).numpy(), alike),
    ]


@functools.cache
def animals(tier):
    """Return SSP-SLAM of a tier, two animals, small."""
    places, coupling = tier == "algebraic", "modules" if tier == "algebraic" else "manifold"
    config = SSPSLAMConfig(
        tier=tier,
        time_step_s=0.01 if places else 1e-3,
        space=SSPSpaceConfig(n_rotations=3, n_scales=2, length_scale_m=0.5),
        integrator=PathIntegratorConfig(neurons=20, phase_noise_rad=0.1, coupling=coupling),
        map=SemanticMapConfig(neurons=20),
        binding="exact",
        vector_neurons=20,
        places=places,
    )
    return SSPSLAM(config, torch.eye(3, 37), batch=2)


@case("spiking.vector_steps.advance", "spiking.vector_steps.times")
def _animals_localise_and_map(draw):
    low = draw.uniform(-0.3, 0.3, (3, 2, 3, 2))
    view = LandmarkView(
        draw.random((3, 2, 3)) < 0.6, np.hypot(*low.T).T, low, low, np.arange(3)
    )  # fmt: skip
    velocity = torch.from_numpy(draw.uniform(-0.3, 0.3, (3, 2, 2)))
    pairs = []
    for tier in ("algebraic", "spiking"):
        slam = with_state(animals(tier), draw)
        placed(slam.integrator, draw).age.fill_(int(draw.choice([0, 2, 98])))
        if tier == "algebraic":
            slam.map.weights = torch.from_numpy(draw.standard_normal((2, 37, 37)))
        slam.attended.copy_(torch.from_numpy(draw.integers(-1, 3, 2)))
        slam.held_s.copy_(torch.from_numpy(draw.choice([0.01, 0.2], 2)))
        slam.familiar.copy_(torch.from_numpy(draw.random(2) < 0.7))

        def step(mine):
            said = mine.run(velocity, view)
            return [*said[:1], torch.view_as_real(said.z), *said[2:]]

        pairs += by_both(slam, step)
    return pairs


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
