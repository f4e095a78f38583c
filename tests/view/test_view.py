"""Local view cells: what becomes a template, what is recognised, what shows nothing."""

import csv
import math

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neuroslam.cells import PoseCellNetwork
from neuroslam.config import PoseCellConfig, ViewConfig
from neuroslam.errors import BadFrame, ConfigError, MapError
from neuroslam.runs.run import resolve_config
from neuroslam.sensors import open_source
from neuroslam.view import LocalViewCells
from neuroslam.view.preprocess import block_mean, encode, normalise_mean, normalise_patches

SMALL = {"template_width": 24, "template_height": 8, "shift_match": 3, "threshold": 0.05}


def random_image(seed=0, height=64, width=96):
    """Smooth random texture, as a place looks."""
    noise = np.random.default_rng(seed).normal(size=(height, width)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 4)
    return cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def test_a_view_is_learnt_once_and_matched_afterwards():
    cells = LocalViewCells(ViewConfig(**SMALL))
    first = [cells(random_image(seed)) for seed in range(10)]
    again = [cells(random_image(seed)) for seed in range(10)]
    assert [m.template for m in first] == [m.template for m in again] == list(range(10))
    assert all(m.is_new for m in first)
    assert not any(m.is_new for m in again)
    assert all(m.error == 0.0 for m in again)
    assert cells.n == 10


@pytest.mark.parametrize("name", ["circuit_launch", "usi_track1"])
def test_templates_of_a_real_drive_are_those_of_the_reference(shared, name):
    """Of C++ OpenRatSLAM on the same frames, every id is equal and every error."""
    refs = shared / "refs" / "ratslam"
    cells = LocalViewCells(resolve_config("openratslam", refs / f"config_{name}.ini").view)
    frames = open_source(shared / "data" / name / "frames.tar").frames()
    found = [cells(frame.image) for frame in frames]
    with (refs / f"{name}_sync_frames.csv").open() as file:
        wanted = list(csv.DictReader(file))
    assert [match.template for match in found] == [int(row["vt_id"]) for row in wanted]
    errors = [float(row["vt_error"]) for row in wanted]
    np.testing.assert_allclose([match.error for match in found], errors, rtol=0, atol=1e-9)


@pytest.mark.parametrize("precision", ["uint8", "float64"])
def test_a_shift_within_the_range_is_forgiven_and_a_larger_one_is_not(precision):
    cells = LocalViewCells(ViewConfig(**SMALL, precision=precision, normalisation=0.0))
    wide = random_image(1, width=96 + 80)
    cells(wide[:, 40:136])
    for columns in (-3, -1, 2, 3):  # a column of the template is 4 px
        assert cells(wide[:, 40 + 4 * columns : 136 + 4 * columns]).template == 0
    assert cells(wide[:, 72:168]).template == 1


def test_colour_is_seen_as_its_grey():
    colour = np.stack([random_image(seed) for seed in range(3)], axis=2)
    grey = cv2.cvtColor(colour, cv2.COLOR_RGB2GRAY)
    config = ViewConfig(**SMALL)
    np.testing.assert_array_equal(encode(colour, config).template, encode(grey, config).template)


@pytest.mark.parametrize("panoramic_turn", range(-11, 13))
def test_a_panorama_gives_the_turn_since_it_was_learnt(panoramic_turn):
    """Turning to the left moves the image to the right."""
    cells = LocalViewCells(ViewConfig(**SMALL | {"shift_match": 0}, panoramic=True))
    view = random_image(3)
    cells(view)
    seen = cells(np.roll(view, 4 * panoramic_turn, axis=1))
    assert seen.template == 0
    assert seen.error == 0.0
    assert seen.relative_heading_rad == pytest.approx(math.tau * panoramic_turn / 24)


def test_forward_views_have_no_relative_heading():
    cells = LocalViewCells(ViewConfig(**SMALL))
    view = random_image(3)
    cells(view)
    assert cells(np.roll(view, 8, axis=1)).relative_heading_rad == 0.0


@pytest.mark.parametrize(
    "stream",
    [
        [np.zeros((64, 96), np.uint8)] * 5,
        [np.full((64, 96), 200, np.uint8)] * 5,
        [np.full((64, 96), level, np.uint8) for level in range(0, 250, 50)],
        [np.random.default_rng(i).integers(0, 4, (64, 96)).astype(np.uint8) for i in range(5)],
    ],
    ids=["black", "constant", "fading", "noise of a covered camera"],
)
def test_a_stream_that_shows_nothing_makes_and_matches_nothing(stream):
    cells = LocalViewCells(ViewConfig(**SMALL))
    for image in stream:
        assert cells(image) == (-1, -1.0, 0.0, False)
    assert cells.n == 0


def test_light_is_normalised_away():
    cells = LocalViewCells(ViewConfig(**SMALL))
    view = random_image(5)
    cells(view)
    assert cells((view * 0.6).astype(np.uint8)).template == 0


@given(st.integers(1, 5), st.integers(1, 5), st.integers(0, 6), st.integers(0, 6))
@settings(max_examples=40, deadline=None)
def test_block_means_are_means_of_whole_blocks(block_h, block_w, more_h, more_w):
    height, width = 4, 6
    image = np.random.default_rng(0).integers(
        0, 256, (height * block_h + more_h % height, width * block_w + more_w % width), np.uint8
    )
    found = block_mean(image, height, width)
    for i in range(height):
        for j in range(width):
            block = image[i * block_h : (i + 1) * block_h, j * block_w : (j + 1) * block_w]
            assert found[i, j] == pytest.approx(block.mean() / 255.0, abs=1e-15)


def test_mean_normalisation_scales_the_mean_and_clips():
    view = np.array([[0.1, 0.2], [0.3, 0.2]])
    assert normalise_mean(view, 0.4).mean() == pytest.approx(0.4)
    assert normalise_mean(view, 0.9).max() == 1.0
    assert normalise_mean(np.zeros((2, 2)), 0.5).max() == 0.0


def test_patch_normalisation_is_that_of_its_definition():
    view = np.random.default_rng(1).random((9, 14))
    view[:4, :5] = 0.3  # a flat corner
    found = normalise_patches(view, radius=2, min_std=0.01)
    for i in range(9):
        for j in range(14):
            patch = view[max(0, i - 2) : i + 3, max(0, j - 2) : j + 3]
            z = (view[i, j] - patch.mean()) / patch.std() if patch.std() > 0.01 else 0.0
            assert found[i, j] == pytest.approx(np.clip((z + 3) / 6, 0, 1), abs=1e-9)
    assert found[0, 0] == 0.5


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (
            {"crop": (0, 100, 0, 64)},
            r"view\.crop = \[0, 100, 0, 64\].*not inside the image of 96x64",
        ),
        ({"crop": (10, 10, 0, 64)}, "not inside the image"),
        ({"crop": (0, 20, 0, 64)}, "24x8 is larger than the cropped image of 20x64"),
    ],
)
def test_a_crop_that_does_not_fit_is_named(config, message):
    with pytest.raises(ConfigError, match=message):
        LocalViewCells(ViewConfig(**SMALL, **config))(random_image())


@pytest.mark.parametrize(
    "config", [{}, {"precision": "float64"}, {"mean_gate": True}, {"panoramic": True}]
)
def test_state_dict_is_complete(config):
    cells = LocalViewCells(ViewConfig(**SMALL, **config))
    for seed in range(20):
        cells(random_image(seed))
    copy = LocalViewCells(cells.config)
    copy.load_state_dict(cells.state_dict())
    for seed in (3, 19, 30, 31):
        assert copy(random_image(seed)) == cells(random_image(seed))
    for (name, a), b in zip(cells.state_dict().items(), copy.state_dict().values(), strict=True):
        assert torch.equal(a, b), name


def test_a_template_takes_at_most_700_bytes_in_total():
    view = LocalViewCells(ViewConfig(template_width=60, template_height=10, shift_match=5))
    tables = (view.templates, PoseCellNetwork(PoseCellConfig()).bindings)
    sizes = sum(
        int(np.prod(buffer.shape[1:])) * buffer.element_size()
        for table in tables
        for buffer in table.buffers()
    )
    assert sizes <= 700


def test_a_template_can_be_read_as_an_image():
    cells = LocalViewCells(ViewConfig(**SMALL))
    cells(random_image(2))
    wanted = np.rint(encode(random_image(2), cells.config).template * 255)
    np.testing.assert_array_equal(cells.template_image(0), wanted)


@pytest.mark.parametrize("precision", ["uint8", "float64"])
def test_the_gate_skips_templates_of_another_mean(precision):
    config = ViewConfig(
        **SMALL, normalisation=0.0, mean_gate=True, min_contrast=0.0, precision=precision
    )
    cells = LocalViewCells(config)
    view = random_image(4) // 2
    cells(view)
    brighter = cells(view + 60)
    assert brighter.is_new
    assert brighter.error == -1.0  # nothing passed the gate, so nothing was compared
    assert cells(view + 2).template == 0


@pytest.mark.parametrize(
    ("image", "got"),
    [
        (random_image() / 255.0, r"float64 \(64, 96\)"),
        (random_image().astype(np.uint16), r"uint16 \(64, 96\)"),
        (np.stack([random_image()] * 4, axis=2), r"uint8 \(64, 96, 4\)"),
        (np.stack([random_image()] * 3), r"uint8 \(3, 64, 96\)"),
        (random_image()[..., None], r"uint8 \(64, 96, 1\)"),
    ],
    ids=["float", "16 bit", "with alpha", "channels first", "one channel"],
)
def test_an_image_of_another_kind_is_refused_and_not_taken_for_black(image, got):
    cells = LocalViewCells(ViewConfig(**SMALL))
    with pytest.raises(BadFrame, match=rf"image is {got}; expected uint8, \(h, w\) or"):
        cells(image)
    assert cells.n == 0


def test_a_view_of_another_size_is_neither_compared_nor_stored():
    cells = LocalViewCells(ViewConfig(**SMALL))
    view = cells.encode(random_image())
    cells.learn(view)
    for wrong in (view.T, view[:, 1:]):
        for use in (cells.learn, cells.search):
            with pytest.raises(MapError, match=r"expected \(template_height, .* = \(8, 24\)"):
                use(wrong)


@pytest.mark.parametrize("template", [-1, 1])
def test_reading_a_missing_template_is_an_error(template):
    cells = LocalViewCells(ViewConfig(**SMALL))
    cells(random_image())
    with pytest.raises(MapError, match=f"no template {template}; there are 1"):
        cells.template_image(template)
