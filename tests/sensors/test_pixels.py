"""Images of 10, 12 and 16 bits become the grey that their bits stand for, in every reader."""

import tarfile

import cv2
import numpy as np
import pytest

from neuroslam.cli import main
from neuroslam.errors import BadFrame, SourceError
from neuroslam.sensors import open_source
from neuroslam.sensors.pixels import PixelScale, bits_of, spread

GREYS = np.random.default_rng(0).integers(10, 250, (6, 24, 32)).astype(np.uint8)


def of_bits(grey, bits):
    """The same picture as a sensor of so many bits writes it into 16."""
    low = np.random.default_rng(1).integers(0, 2 ** (bits - 8), grey.shape)
    return ((grey.astype(np.int64) << (bits - 8)) + low).astype(np.uint16)


def folder_of(path, images, suffix=".png"):
    path.mkdir()
    for k, image in enumerate(images):
        assert cv2.imwrite(str(path / f"{k:03d}{suffix}"), image)
    return path


def images_of(source):
    return np.stack([frame.image for frame in open_source(source)])


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
@pytest.mark.parametrize("suffix", [".png", ".tiff", ".pgm"])
def test_images_of_any_depth_become_the_same_grey(bits, suffix, tmp_path):
    folder = folder_of(tmp_path / "images", [of_bits(grey, bits) for grey in GREYS], suffix)
    np.testing.assert_array_equal(images_of(folder), GREYS)


def test_colour_of_12_bits_is_that_of_8(tmp_path):
    colour = np.random.default_rng(2).integers(0, 256, (3, 24, 32, 3)).astype(np.uint8)
    eight = folder_of(tmp_path / "eight", colour)
    twelve = folder_of(tmp_path / "twelve", [of_bits(image, 12) for image in colour])
    np.testing.assert_array_equal(images_of(twelve), images_of(eight))


def test_tars_and_lists_scale_like_folders(tmp_path):
    folder = folder_of(tmp_path / "images", [of_bits(grey, 10) for grey in GREYS])
    with tarfile.open(tmp_path / "images.tar.gz", "w:gz") as tar:
        tar.add(folder, "images")
    lines = [f"{0.1 * k} images/{k:03d}.png" for k in range(len(GREYS))]
    (tmp_path / "list.txt").write_text("\n".join(lines))
    for source in (tmp_path / "images.tar.gz", tmp_path / "list.txt"):
        np.testing.assert_array_equal(images_of(source), GREYS)


def test_all_images_of_a_source_have_one_scale_also_dark_ones(tmp_path):
    dark = (GREYS // 16).astype(np.uint8)  # would need fewer bits alone
    images = [of_bits(image, 12) for image in (dark[0], *GREYS, dark[1])]
    folder = folder_of(tmp_path / "images", images)
    np.testing.assert_array_equal(images_of(folder), [dark[0], *GREYS, dark[1]])
    source = open_source(folder)
    assert np.array_equal(source.frame(7).image, dark[1])  # whichever is read first


def test_the_bits_are_told_and_8_and_16_need_no_word(tmp_path):
    for bits, told in ((8, ""), (10, "10 bits"), (16, "")):
        pixels = GREYS if bits == 8 else [of_bits(grey, bits) for grey in GREYS]
        notes = open_source(folder_of(tmp_path / str(bits), pixels)).notes
        assert "\n".join(notes).count("16-bit images use") == bool(told)
        assert told in "\n".join(notes)


def test_a_hot_pixel_does_not_decide_about_the_bits():
    image = of_bits(GREYS[0], 12)
    image = np.tile(image, (4, 4))
    image[5, 5] = 65535
    assert bits_of(image) == 12
    assert PixelScale.of([image])(image)[5, 5] == 255


def test_images_that_exceed_the_bits_of_those_examined_are_clipped_and_counted():
    scale = PixelScale.of([of_bits(GREYS[0], 10)])
    bright = np.full((4, 4), 3000, np.uint16)
    assert (scale(bright, 7) == 255).all()
    assert (scale(bright, 7) == 255).all()  # read twice, counted once
    assert scale.note().endswith("1 image with greater values clipped")


def test_floating_point_images_are_refused_with_their_type(tmp_path):
    folder = folder_of(tmp_path / "depths", [np.full((24, 32), 1.5, np.float32)], ".tiff")
    with pytest.raises(SourceError, match=r"000.tiff: its pixels are float32; expected whole"):
        open_source(folder)
    with pytest.raises(BadFrame, match="int16"):
        bits_of(np.zeros((2, 2), np.int16))


def test_the_sample_holds_the_first_and_the_last():
    assert spread(1) == [0]
    assert spread(1000)[0] == 0
    assert spread(1000)[-1] == 999
    assert len(set(spread(1000))) == 32


def test_the_case_of_12_bits_is_mapped_like_that_of_16(shared, tmp_path, capsys):
    case = shared / "cases" / "png_of_12_bits"
    if not case.is_dir():
        pytest.skip("no cases beside the checkout")
    np.testing.assert_array_equal(images_of(case / "bits12"), images_of(case / "bits16"))
    for name in ("bits12", "bits16"):
        assert main(["run", str(case / name), "-o", str(tmp_path / name), "--no-tensorboard"]) == 0
    printed = capsys.readouterr().out
    assert printed.count("10 experiences") == 2
    assert "16-bit images use 12 bits" in printed
