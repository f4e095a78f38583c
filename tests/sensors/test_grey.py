"""Colour becomes grey by one rule, whatever the source, for views and odometry alike."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from neuroslam.brain import NavigationBrain, load_brain
from neuroslam.config import BrainConfig, ViewConfig
from neuroslam.errors import ConfigError
from neuroslam.merging.mapped import differing_keys
from neuroslam.odometry.visual import VisualOdometry
from neuroslam.runs.run import resolve_config, run
from neuroslam.sensors import open_source
from neuroslam.sensors.bag_images import ENCODINGS, grey_of
from neuroslam.sensors.camera import CameraSource
from neuroslam.sensors.grey import to_grey
from neuroslam.sensors.pixels import PixelScale
from neuroslam.view.preprocess import encode

WORLD = "world:corridor?width=64&height=40&frames_per_lap=60&laps=1.2&noise=0.02&odometry=0"


def colourful(seed, height=24, width=32):
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def mean_of(colour):
    """Round the mean of the channels in integers: no mean of three has a tie."""
    return ((colour.astype(np.int64).sum(axis=2) + 1) // 3).astype(np.uint8)


def test_the_mean_of_every_sum_of_channels_is_rounded_to_the_nearest():
    sums = np.arange(3 * 255 + 1)
    channels = np.stack([sums // 3, (sums + 1) // 3, (sums + 2) // 3], axis=1)
    colour = channels.astype(np.uint8)[None]
    assert (colour.astype(int).sum(axis=2) == sums).all()
    assert (to_grey(colour, "mean") == mean_of(colour)).all()


def test_luma_is_the_weighted_sum_of_bt_601_in_either_order_of_channels():
    colour = colourful(0)
    exact = colour @ [0.299, 0.587, 0.114]
    assert np.abs(to_grey(colour) - exact).max() < 0.51  # its weights have 14 bits
    assert (to_grey(colour[..., ::-1].copy(), "luma", "bgr") == to_grey(colour)).all()


@pytest.mark.parametrize("rule", ["luma", "mean"])
def test_a_grey_image_is_the_same_by_both_rules(rule):
    image = colourful(1)[..., 0]
    assert to_grey(image, rule) is image
    assert (to_grey(np.dstack([image] * 3), rule) == image).all()


def test_a_template_of_means_is_that_of_openratslam_within_a_third_of_a_level():
    colour = colourful(2)
    size = {"template_width": 8, "template_height": 6, "shift_match": 1, "normalisation": 0.0}
    exact = colour.reshape(6, 4, 8, 4, 3).mean(axis=(1, 3, 4)) / 255.0
    found = encode(colour, ViewConfig(**size, grey="mean")).template
    assert np.abs(found - exact).max() <= 1.0 / (3.0 * 255.0)
    assert np.abs(encode(colour, ViewConfig(**size)).template - exact).max() > 1.0 / (3.0 * 255.0)


def test_the_rule_holds_for_folders_lists_videos_and_their_motion(tmp_path):
    folder = tmp_path / "frames"
    folder.mkdir()
    for k in range(2):
        cv2.imwrite(str(folder / f"{k}.png"), colourful(k)[..., ::-1])
    (tmp_path / "list.txt").write_text("frames/0.png 0\nframes/1.png 1\n")
    (tmp_path / "rgb.txt").write_text("0 frames/0.png\n1 frames/1.png\n")  # a TUM folder
    for spec in (folder, tmp_path / "list.txt", tmp_path):
        images = [frame.image for frame in open_source(spec, grey="mean")]
        assert all((image == mean_of(colourful(k))).all() for k, image in enumerate(images))

    film = tmp_path / "a.avi"
    writer = cv2.VideoWriter(str(film), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (64, 48))
    for k in range(3):
        writer.write(cv2.resize(colourful(k), (64, 48)))
    writer.release()
    _, decoded = cv2.VideoCapture(str(film)).read()
    (tmp_path / "m.csv").write_text("time_s,v_m_s,w_rad_s\n0,1,0\n0.1,1,0\n0.2,1,0\n")
    for spec in (str(film), f"{film}+{tmp_path / 'm.csv'}"):
        first = next(frame for frame in open_source(spec, grey="mean") if frame.image is not None)
        assert (first.image == mean_of(decoded)).all()
        assert (first.image != to_grey(decoded, "luma", "bgr")).any()


def test_the_rule_holds_for_a_camera(monkeypatch):
    class Device:
        def __init__(self, _):
            pass

        def isOpened(self):  # noqa: N802
            return True

        def get(self, _):
            return 30.0

        def read(self):
            return True, colourful(5)

        def release(self):
            pass

    monkeypatch.setattr(cv2, "VideoCapture", Device)
    (frame,) = CameraSource("0", "mean").frames(0, 1)
    assert (frame.image == mean_of(colourful(5))).all()


@pytest.mark.parametrize("encoding", [name for name, kind in ENCODINGS.items() if kind.to_luma])
def test_the_rule_holds_for_every_encoding_of_a_bag(encoding):
    """A uniform colour, so that the interpolation of Bayer pixels and of chroma adds nothing."""
    red, green, blue = 200, 90, 40
    h, w = 8, 12
    wide = ENCODINGS[encoding].size == 2
    rgb = np.full((h, w, 3), (red, green, blue), np.uint8)
    if encoding.startswith("bayer"):
        of = {"r": red, "g": green, "b": blue}
        pattern = encoding.removeprefix("bayer_").removesuffix("8").removesuffix("16")
        tile = np.array([of[letter] for letter in pattern], np.uint8).reshape(2, 2)
        pixels = np.tile(tile, (h // 2, w // 2))
    elif "yuv" in encoding or "uyv" in encoding:
        y, u, v = 110, 60, 190
        chroma_first = encoding in ("yuv422", "uyvy")
        code = cv2.COLOR_YUV2RGB_UYVY if chroma_first else cv2.COLOR_YUV2RGB_YUY2
        pair = (u, y, v, y) if chroma_first else (y, u, y, v)
        pixels = np.tile(np.array(pair, np.uint8).reshape(2, 2), (h, w // 2, 1))
        rgb = cv2.cvtColor(pixels, code)
    else:
        order = {"b": blue, "g": green, "r": red, "a": 255}
        names = encoding.removesuffix("8").removesuffix("16")
        if "UC" in encoding:
            names = "bgr" if encoding.endswith("3") else "bgra"
        pixels = np.tile(np.array([order[n] for n in names], np.uint8), (h, w, 1))
    if wide:
        pixels = pixels.astype("<u2") << 8
    message = SimpleNamespace(
        encoding=encoding, height=h, width=w, step=pixels.nbytes // h,
        data=pixels.reshape(-1).view(np.uint8), is_bigendian=0,
    )  # fmt: skip
    scale = PixelScale(16, 1)
    assert (grey_of(message, "mean", scale) == mean_of(rgb)).all()
    assert (grey_of(message, "luma", scale) != mean_of(rgb)).all()


def test_views_and_odometry_of_a_brain_use_the_same_rule():
    frames = list(open_source(WORLD))
    ours, theirs = NavigationBrain(BrainConfig(view={"grey": "mean"})), NavigationBrain()
    for frame in frames:
        ours(frame)
        theirs(frame._replace(image=to_grey(frame.image, "mean")))
    assert ours.odometry.grey == "mean"
    assert ours.view.n > 1
    assert (ours.map.poses == theirs.map.poses).all()
    assert (ours.view.templates["pixels"] == theirs.view.templates["pixels"]).all()
    luma = VisualOdometry(BrainConfig().odometry)
    of_luma, of_mean = (one.measure(frames[0].image, 0.1)[1] for one in (luma, ours.odometry))
    assert (of_luma.speed != of_mean.speed).any()


def test_a_run_gives_its_rule_to_the_source(tmp_path):
    folder, brain = tmp_path / "frames", NavigationBrain(BrainConfig(view={"grey": "mean"}))
    folder.mkdir()
    for frame in open_source(WORLD).frames(0, 30):
        brain(frame)
        cv2.imwrite(str(folder / f"{frame.index}.png"), frame.image[..., ::-1])
    config = resolve_config(None, None, ("view.grey=mean", "frame_rate_hz=10"))
    run(folder, tmp_path / "out", config, tensorboard=False)
    found = load_brain(tmp_path / "out" / "brain.safetensors")
    assert found.config.view.grey == "mean"
    assert (found.view.templates["pixels"] == brain.view.templates["pixels"]).all()
    assert (found.map.poses == brain.map.poses).all()


def test_maps_of_different_rules_are_not_merged_and_an_unknown_rule_is_refused():
    (key,) = differing_keys(BrainConfig(), BrainConfig(view={"grey": "mean"}))
    assert "grey" in key
    with pytest.raises(ConfigError, match=r"view.grey = 'max': .*'luma' or 'mean'"):
        resolve_config(None, None, ("view.grey=max",))
