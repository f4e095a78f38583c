"""The fast search gives what comparing everything gives."""

from copy import deepcopy

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import cdist

from neuroslam.config import ViewConfig
from neuroslam.sensors import open_source
from neuroslam.view import LocalViewCells, search
from neuroslam.view.templates import to_bytes


def memory(templates, **config):
    """View cells that hold these templates (n, height, width)."""
    height, width = templates.shape[1:]
    cells = LocalViewCells(ViewConfig(template_width=width, template_height=height, **config))
    for template in templates:
        cells.learn(template)
    return cells


def brute_force(templates, views, config):
    """The definition, in float64: distance of every view to every template, best of all shifts."""
    width, step, s = views.shape[2], config.shift_step, config.shift_match
    best = np.inf
    for o in range(0, width if config.panoramic else 2 * s + 1, step):
        if config.panoramic:
            there, here = templates, np.roll(views, o, axis=2)
        else:
            there, here = templates[:, :, o : o + width - 2 * s], views[:, :, s : width - s]
        flat = [part.reshape(len(part), -1) for part in (here, there)]
        best = np.minimum(best, cdist(*flat, "cityblock") / flat[0].shape[1])
    return best


def assert_exact(cells, views):
    """Every search gives the template and the error of brute force; returns these errors."""
    seen = np.stack([quantised(view, cells) for view in views])
    wanted = brute_force(stored(cells), seen, cells.config)
    for view, errors in zip(views, wanted, strict=True):
        found = cells.search(view)
        assert found.template == errors.argmin()
        assert found.error == pytest.approx(errors.min(), abs=1e-12)
    return wanted.min(axis=1)


@pytest.fixture
def always_pruned(monkeypatch):
    """Small memories are searched as large ones: by bounds, and in parts."""
    monkeypatch.setattr(search, "PRUNE_FROM", 100)
    monkeypatch.setattr(search, "_BATCH", 64)


def stored(cells):
    """The templates as the memory holds them, in [0, 1]."""
    if cells.config.precision == "float64":
        values = cells.templates["values"].numpy()
    else:
        values = cells.templates["pixels"].numpy() / 255.0
    shape = (cells.n, cells.config.template_width, cells.config.template_height)
    return values.reshape(shape).transpose(0, 2, 1)


def quantised(view, cells):
    return view if cells.config.precision == "float64" else to_bytes(view) / 255.0


def smooth(rng, n, height=10, width=60):
    coarse = rng.random((n, 4, 13))
    rows = np.linspace(0, 2.999, height)
    columns = np.linspace(0, 11.999, width)
    i, j = rows.astype(int), columns.astype(int)
    a, b = (rows - i)[None, :, None], (columns - j)[None, None, :]
    corner = lambda di, dj: coarse[:, i + di][:, :, j + dj]  # noqa: E731
    top = corner(0, 0) * (1 - b) + corner(0, 1) * b
    return top * (1 - a) + (corner(1, 0) * (1 - b) + corner(1, 1) * b) * a


def noise(rng, n):
    return rng.random((n, 10, 60))


@pytest.mark.usefixtures("always_pruned")
@pytest.mark.parametrize("precision", ["uint8", "float64"])
@pytest.mark.parametrize("make", [smooth, noise])
def test_a_thousand_random_queries_find_what_brute_force_finds(precision, make):
    rng = np.random.default_rng(7)
    cells = memory(make(rng, 400), shift_match=5, precision=precision)
    views = make(rng, 1000)
    for view in views[::2]:  # half of them are seen again, shifted and noisy
        view[:] = np.roll(stored(cells)[rng.integers(400)], rng.integers(-5, 6), axis=1)
        view[:] = np.clip(view + rng.normal(0, 0.02, view.shape), 0, 1)
    assert_exact(cells, views)


@pytest.mark.usefixtures("always_pruned")
@pytest.mark.parametrize("precision", ["uint8", "float64"])
def test_a_thousand_real_queries_find_what_brute_force_finds(shared, precision):
    config = {"crop": (0, 160, 0, 60), "template_width": 40, "template_height": 15}
    cells = LocalViewCells(ViewConfig(**config, precision=precision))
    source = open_source(shared / "data" / "usi_track1" / "frames.tar")
    views = [cells.encode(frame.image) for frame in source.frames(0, 1400)]
    for view in views[:400]:
        cells.learn(view)
    assert_exact(cells, views[400:])


@pytest.mark.usefixtures("always_pruned")
@pytest.mark.parametrize("precision", ["uint8", "float64"])
def test_a_panorama_finds_what_brute_force_finds(precision):
    rng = np.random.default_rng(3)
    cells = memory(smooth(rng, 300), panoramic=True, shift_step=2, precision=precision)
    picked = stored(cells)[rng.integers(300, size=60)]
    views = [np.roll(view, rng.integers(60), axis=1) for view in picked]
    assert_exact(cells, [np.clip(view + rng.normal(0, 0.02, view.shape), 0, 1) for view in views])


@pytest.mark.parametrize("precision", ["uint8", "float64"])
def test_behind_the_gate_the_search_is_that_of_what_passed_it(precision):
    rng = np.random.default_rng(11)
    templates = smooth(rng, 60) * rng.uniform(0.3, 1.0, (60, 1, 1))
    cells = memory(templates, shift_match=5, precision=precision, mean_gate=True, threshold=0.1)
    views = np.clip(templates + rng.normal(0, 0.05, (60, 10, 60)), 0, 1)
    seen = np.stack([quantised(view, cells) for view in views])
    errors = brute_force(stored(cells), seen, cells.config)
    passed = np.abs(stored(cells).mean((1, 2)) - seen.mean((1, 2))[:, None]) <= 0.105
    assert 0.2 < passed.mean() < 0.8
    for view, wanted in zip(views, np.where(passed, errors, np.inf), strict=True):
        found = cells.search(view)
        assert found.template == wanted.argmin()
        assert found.error == pytest.approx(wanted.min(), abs=1e-12)


@pytest.mark.usefixtures("always_pruned")
@pytest.mark.parametrize(("make", "limit"), [(smooth, 0.05), (noise, 0.295)])
def test_with_a_limit_the_search_is_exact_up_to_it(make, limit):
    rng = np.random.default_rng(5)
    cells = memory(make(rng, 500), shift_match=5)
    apart = rng.normal(0, 0.03, (200, 10, 60)) * (np.arange(200) % 5)[:, None, None]
    views = np.concatenate([np.clip(stored(cells)[:200] + apart, 0, 1), make(rng, 100)])
    errors = assert_exact(cells, views)
    assert 20 < (errors <= limit).sum() < 280
    for view, error in zip(views, errors, strict=True):
        limited = cells.search(view, limit)
        if error <= limit:
            assert limited == cells.search(view)
        else:
            assert limited.error >= error - 1e-12  # never better than the truth


def test_templates_that_differ_by_less_than_a_byte_are_distinguished():
    """More than a list of the nearest holds; those like the view before the gate do not count."""
    base = smooth(np.random.default_rng(4), 1)[0] * 0.5 + 0.2
    like = base + 1e-8 * np.arange(40)[:, None, None]
    gated = base.copy()
    gated[:, :5] = gated[:, -5:] = 0.0  # equal where it is compared, but darker
    templates = np.concatenate([np.repeat(gated[None], 30, axis=0), like])
    config = {"shift_match": 5, "precision": "float64", "threshold": 0.01}
    cells = memory(templates, **config, mean_gate=True)
    assert [cells.search(view).template for view in like] == list(range(30, 70))
    assert memory(templates, **config).search(like[35]).template == 65
    assert cells.search(gated).template == 0


@given(seed=st.integers(0, 10_000), shift=st.integers(0, 6), panoramic=st.booleans())
@settings(max_examples=60, deadline=None)
def test_a_bound_is_never_above_the_distance(seed, shift, panoramic):
    rng = np.random.default_rng(seed)
    width, height = int(rng.integers(16, 50)), int(rng.integers(3, 20))
    config = ViewConfig(
        template_width=width,
        template_height=height,
        shift_match=min(shift, (width - 1) // 4),
        panoramic=panoramic,
    )
    geometry = search.Geometry.of(config)
    templates = rng.integers(0, 256, (20, width, height), np.uint8)
    templates[:10] = np.clip(templates[0].astype(int) + rng.integers(-3, 4, (10, 1, 1)), 0, 255)
    query = templates[rng.integers(20)]
    blocks = np.stack([search.template_blocks(t, geometry) for t in templates])
    bounds = search.lower_bounds(blocks, query, geometry)
    true = search.distances(templates.reshape(20, -1), query, geometry).min(axis=0)
    assert (bounds <= true).all()
    assert geometry.n_blocks <= 64


def test_distances_are_those_of_the_definition():
    rng = np.random.default_rng(2)
    config = ViewConfig(template_width=12, template_height=5, shift_match=2)
    geometry = search.Geometry.of(config)
    templates = rng.integers(0, 256, (6, 12, 5), np.uint8)
    query = rng.integers(0, 256, (12, 5), np.uint8)
    found = search.distances(templates.reshape(6, -1), query, geometry)
    for o in range(5):
        parts = templates[:, o : o + 8].astype(int) - query[2:10].astype(int)
        np.testing.assert_array_equal(found[o], np.abs(parts).sum((1, 2)))


@pytest.mark.parametrize("prune_from", [1, 10**6])
@pytest.mark.parametrize("precision", ["uint8", "float64"])
def test_of_equally_near_templates_the_first_is_found(monkeypatch, prune_from, precision):
    monkeypatch.setattr(search, "PRUNE_FROM", prune_from)
    rng = np.random.default_rng(1)
    templates = smooth(rng, 100)
    templates[[20, 60, 90]] = templates[20]
    cells = memory(templates, shift_match=4, precision=precision)
    cells.last.template = 90  # a hint must not win
    assert cells.search(templates[60]).template == 20


def test_what_follows_from_the_templates_is_renewed_with_them():
    rng = np.random.default_rng(12)
    first, second = smooth(rng, 700), smooth(rng, 700)
    cells, other = memory(first, shift_match=5), memory(second, shift_match=5)
    assert_exact(cells, first[:5])
    cells.load_state_dict(other.state_dict())
    assert_exact(cells, second[:5])
    cells.templates.replace(**{name: other.templates[name][:600] for name in ("pixels", "blocks")})
    assert_exact(cells, second[598:602])
    for view in first[:300]:  # the table grows, and so do its tiles
        cells.learn(view)
    assert_exact(cells, np.concatenate([first[298:302], second[:2]]))
    copy = deepcopy(cells)
    copy.learn(first[500])
    assert copy.search(first[500]).error == 0.0 < cells.search(first[500]).error


def test_an_empty_memory_finds_nothing():
    cells = LocalViewCells(ViewConfig())
    assert cells.search(np.zeros((10, 60))) == (-1, -1.0, 0.0, False)
    assert torch.is_tensor(cells.templates["pixels"])
