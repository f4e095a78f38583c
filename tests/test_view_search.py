"""The fast search gives what comparing everything gives."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

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


def brute_force(templates, view, config):
    """The definition, in float64: id and error of the nearest."""
    width, s = view.shape[1], config.shift_match
    if config.panoramic:
        each = [
            np.abs(templates - np.roll(view, o, axis=1)).mean(axis=(1, 2))
            for o in range(0, width, config.shift_step)
        ]
    else:
        query = view[:, s : width - s]
        each = [
            np.abs(templates[:, :, o : o + width - 2 * s] - query).mean(axis=(1, 2))
            for o in range(0, 2 * s + 1, config.shift_step)
        ]
    errors = np.min(each, axis=0)
    return int(errors.argmin()), float(errors.min())


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


@pytest.mark.parametrize("precision", ["uint8", "float64"])
@pytest.mark.parametrize("kind", ["smooth", "noise"])
def test_a_thousand_random_queries_find_what_brute_force_finds(monkeypatch, precision, kind):
    monkeypatch.setattr(search, "PRUNE_FROM", 200)
    rng = np.random.default_rng(7)
    make = smooth if kind == "smooth" else lambda rng, n: rng.random((n, 10, 60))
    cells = memory(make(rng, 400), shift_match=5, precision=precision)
    templates = stored(cells)
    for number in range(500):
        view = make(rng, 1)[0]
        if number % 2:  # half of them are seen again, shifted and in another light
            view = np.roll(templates[rng.integers(400)], rng.integers(-5, 6), axis=1)
            view = np.clip(view + rng.normal(0, 0.02, view.shape), 0, 1)
        found = cells.search(view)
        wanted, error = brute_force(templates, quantised(view, cells), cells.config)
        assert found.template == wanted
        assert found.error == pytest.approx(error, abs=1e-12)


@pytest.mark.parametrize("precision", ["uint8", "float64"])
def test_a_thousand_real_queries_find_what_brute_force_finds(shared, monkeypatch, precision):
    monkeypatch.setattr(search, "PRUNE_FROM", 200)
    config = {"crop": (0, 160, 0, 60), "template_width": 40, "template_height": 15}
    cells = LocalViewCells(ViewConfig(**config, precision=precision))
    source = open_source(shared / "data" / "usi_track1" / "frames.tar")
    views = [cells.encode(frame.image) for frame in source.frames(0, 1400)]
    for view in views[:400]:
        cells.learn(view)
    templates = stored(cells)
    for view in views[400:]:
        found = cells.search(view)
        wanted, error = brute_force(templates, quantised(view, cells), cells.config)
        assert found.template == wanted
        assert found.error == pytest.approx(error, abs=1e-12)


@pytest.mark.parametrize("precision", ["uint8", "float64"])
def test_a_panorama_finds_what_brute_force_finds(monkeypatch, precision):
    monkeypatch.setattr(search, "PRUNE_FROM", 100)
    rng = np.random.default_rng(3)
    cells = memory(smooth(rng, 300), panoramic=True, shift_step=2, precision=precision)
    templates = stored(cells)
    for _ in range(60):
        view = np.roll(templates[rng.integers(300)], rng.integers(60), axis=1)
        view = np.clip(view + rng.normal(0, 0.02, view.shape), 0, 1)
        found = cells.search(view)
        wanted, error = brute_force(templates, quantised(view, cells), cells.config)
        assert (found.template, found.error) == (wanted, pytest.approx(error, abs=1e-12))


def test_with_a_limit_the_search_is_exact_up_to_it(monkeypatch):
    monkeypatch.setattr(search, "PRUNE_FROM", 100)
    rng = np.random.default_rng(5)
    cells = memory(smooth(rng, 500), shift_match=5)
    templates = stored(cells)
    within = 0
    for number in range(200):
        view = np.clip(templates[number] + rng.normal(0, 0.03 * (number % 5), (10, 60)), 0, 1)
        found = cells.search(view, limit=0.05)
        wanted, error = brute_force(templates, quantised(view, cells), cells.config)
        if error <= 0.05:
            within += 1
            assert (found.template, found.error) == (wanted, pytest.approx(error))
        else:
            assert found.error >= error - 1e-12  # never better than the truth
    assert 20 < within < 180


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


def test_an_empty_memory_finds_nothing():
    cells = LocalViewCells(ViewConfig())
    assert cells.search(np.zeros((10, 60))) == (-1, -1.0, 0.0, False)
    assert torch.is_tensor(cells.templates["pixels"])
