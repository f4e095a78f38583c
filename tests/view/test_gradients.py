"""Templates of oriented gradients: what they tell apart, and what they forgive."""

import cv2
import numpy as np
import pytest

from neuroslam.config import BrainConfig, ViewConfig, build_config
from neuroslam.errors import ConfigError
from neuroslam.view import LocalViewCells
from neuroslam.view.preprocess import encode

CONFIG = ViewConfig(template_width=16, template_height=72, orientations=6, shift_match=2)


def picture(seed=0):
    """Blocks of random grey: edges of all places, 120x160."""
    blocks = np.random.default_rng(seed).integers(30, 200, (8, 10), np.uint8)
    return cv2.resize(blocks, (160, 120), interpolation=cv2.INTER_CUBIC)


def difference(one, other, config=CONFIG):
    cells = LocalViewCells(config)
    cells.learn(cells.encode(one))
    return cells.search(cells.encode(other)).error


def stripes(angle_deg):
    y, x = np.mgrid[:120, :160]
    angle = np.deg2rad(angle_deg)
    return (128 + 90 * np.sin((np.cos(angle) * x + np.sin(angle) * y) / 4)).astype(np.uint8)


@pytest.mark.parametrize("angle_deg", [0, 30, 60, 90, 120, 150])
def test_the_orientation_of_an_edge_is_the_part_of_the_template_that_is_white(angle_deg):
    parts = encode(stripes(angle_deg), CONFIG).template.reshape(6, 12, 16)[:, 2:-2, 2:-2]
    assert parts.mean(axis=(1, 2)).argmax() == angle_deg // 30


@pytest.mark.parametrize("change", [lambda g: 0.5 * g, lambda g: g + 50, lambda g: 255.0 - g])
def test_brightness_contrast_and_even_sign_change_little(change):
    changed = np.clip(change(picture().astype(float)), 0, 255).astype(np.uint8)
    assert difference(picture(), changed) < 0.25 * difference(picture(), picture(1))


def test_a_panorama_has_no_seam():
    config = CONFIG.model_copy(update={"panoramic": True})
    rolled = encode(np.roll(picture(), 80, axis=1), config).template
    expected = np.roll(encode(picture(), config).template, 8, axis=1)
    np.testing.assert_allclose(rolled, expected, atol=1e-6)


def test_a_uniform_image_is_black_and_has_no_contrast():
    view, contrast = encode(np.full((120, 160, 3), 90, np.uint8), CONFIG)
    assert not view.any()
    assert contrast == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"template_height": 10, "orientations": 6}, "not a multiple of orientations 6"),
        ({"features": "module", "orientations": 10}, "orientations 10 are those of grey"),
    ],
)
def test_orientations_that_do_not_fit_are_refused(values, says):
    with pytest.raises(ConfigError, match=says):
        build_config({"view": values})


def test_orientations_are_off_by_default():
    assert BrainConfig().view.orientations == 0
