"""Estimates from the first laps: threshold and band by the views, field of view by the laps."""

import re
from pathlib import Path

import numpy as np
import pytest

from neuroslam.runs.run import resolve_config
from neuroslam.sensors import open_source
from neuroslam.tuning.auto import SHARE, estimate, has_pictures
from neuroslam.types import Frame
from tests.brain.test_tracker import laps, strip


class Wall:
    """A recording of a wall that turns past the camera, in the upper half of the image."""

    live = False
    name = "wall"

    def __init__(self, phases, pixels_per_lap=2400, size=(80, 80)):
        self.phases, self.size = phases, size
        self.wall = strip(width=pixels_per_lap)

    def frames(self, start=0, stop=None, on_bad_frame=None):
        rng = np.random.default_rng(0)
        rows, width = self.size
        for i, phase in enumerate(self.phases[:stop]):
            left = round(phase * self.wall.shape[1])
            view = np.take(self.wall, range(left, left + width), axis=1, mode="wrap")
            floor = rng.normal(128, 20, (rows - len(view), width))
            image = np.clip(np.vstack([view, floor]), 0, 255).astype(np.uint8)
            yield Frame(i, i / 20.0, np.repeat(image[:, :, None], 3, axis=2))


def test_field_of_view_of_a_camera_that_turns_once_a_lap():
    """2400 px a lap and 80 px in view: 12 degrees a view is too narrow, 600 px give 48."""
    found = estimate(Wall(laps(3), 600), resolve_config("auto"))
    assert found.values["odometry"]["fov_deg"] == pytest.approx(48, abs=2)
    narrow = estimate(Wall(laps(3), 2400), resolve_config("auto"))
    assert "fov_deg" not in narrow.values["odometry"]


def test_without_a_second_lap_the_field_of_view_stays():
    found = estimate(Wall(laps(0.9), 600), resolve_config("auto"))
    assert "fov_deg" not in found.values["odometry"]
    assert any("field of view stays" in note for note in found.notes)


def test_the_band_with_the_wall_is_found():
    found = estimate(Wall(laps(2), 600), resolve_config("auto"))
    assert found.values["view"]["crop"] == (0, 80, 0, 40)
    assert found.values["view"]["template_height"] == 120  # 20 rows of 6 orientations


def test_the_page_states_the_share_that_is_the_threshold():
    page = (Path(__file__).parents[2] / "docs" / "tuning.md").read_text()
    assert f"{SHARE:g} of the mean match error between far frames" in page


def test_pixels_of_grey_views_are_square():
    grey = ("view.orientations=0", "view.template_width=40", "view.patch_radius=4")
    view = estimate(Wall(laps(1), 600), resolve_config("auto", assignments=grey)).values["view"]
    _, width, top, bottom = view.get("crop", (0, 80, 0, 80))
    assert view["template_height"] == 40 * (bottom - top) // width


def test_the_threshold_lies_between_near_and_far_frames():
    slow = np.arange(600) / 600
    found = estimate(Wall(slow, 400), resolve_config("auto"))
    near, far = _errors(found.notes[0])
    assert near < found.values["view"]["threshold"] < far


def _errors(note):
    return [float(number) for number in re.findall(r"by (0\.\d+)", note)]


def test_a_short_recording_or_one_without_pictures_is_not_estimated(tmp_path):
    short = estimate(Wall(laps(0.2)), resolve_config("auto"))
    assert short.values == {}
    assert "expected 100" in short.notes[0]
    still = estimate(Wall(np.zeros(150)), resolve_config("auto"))
    assert still.values == {} or "fov_deg" not in still.values.get("odometry", {})
    track = tmp_path / "track.csv"
    rows = [f"{i / 10},0.1,0.0" for i in range(200)]
    track.write_text("time_s,v_m_s,w_rad_s\n" + "\n".join(rows) + "\n")
    opened = open_source(track, 20.0)
    assert not has_pictures(opened)
    assert estimate(opened, resolve_config("auto")).values == {}


def test_run_estimates_and_what_is_set_by_hand_wins(call, tmp_path, shared):
    source = shared / "data" / "circuit_launch" / "frames.tar"
    plain = call("run", source, "--stop", 800, "--no-tensorboard", "-o", tmp_path / "plain")
    assert plain.code == 0
    assert "auto: field of view 1" in plain.out
    config = (tmp_path / "plain" / "config.toml").read_text()
    assert 'closure = "sequence"' in config
    assert "fov_deg = 11" in config
    given = call(
        "run", source, "--stop", 120, "--no-tensorboard", "-o", tmp_path / "given",
        "--set", "odometry.fov_deg=70", "--set", "view.threshold=0.05",
    )  # fmt: skip
    assert given.code == 0
    config = (tmp_path / "given" / "config.toml").read_text()
    assert "fov_deg = 70" in config
    assert "threshold = 0.05" in config
