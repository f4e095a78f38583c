import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from neuroslam.config import OdometryConfig, read_config_file
from neuroslam.errors import BadFrame, ConfigError
from neuroslam.odometry import VisualOdometry
from neuroslam.odometry.visual import match_profiles, profile
from neuroslam.sensors import open_source
from neuroslam.types import Velocity
from neuroslam.worlds.world import open_world

DT = 0.05
STILL = Velocity(0.0, 0.0)
uint8_images = arrays(np.uint8, st.tuples(st.integers(2, 12), st.integers(8, 40)))


def panorama(seed: int = 0, width: int = 160) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (120, width), dtype=np.uint8)


def match_as_defined(now: np.ndarray, previous: np.ndarray, max_shift: int) -> tuple[int, float]:
    """Section 1 of the specification, word for word."""
    n, best, smallest = len(now), 0, math.inf
    for s in [*range(0, -max_shift, -1), *range(max_shift)]:
        columns = [i for i in range(n) if 0 <= i - s < n]
        d = sum(abs(float(now[i]) - float(previous[i - s])) for i in columns) / len(columns)
        if d < smallest:
            best, smallest = s, d
    return best, smallest


@pytest.mark.parametrize(("name", "n"), [("circuit_launch", 1000), ("usi_track1", 2873)])
def test_motion_equals_the_references_in_every_frame(shared, name, n):
    folder = shared / "refs" / "ratslam"
    values = read_config_file(folder / f"config_{name}.ini")["odometry"]
    odometry = VisualOdometry(OdometryConfig(**values, first_frame="zero_profile"))
    oracle = np.genfromtxt(folder / f"{name}_sync_frames.csv", delimiter=",", names=True)
    frames = open_source(shared / "data" / name / "frames.tar")
    ours = np.array([odometry(frame.image, DT) for frame in frames])
    assert len(ours) == n
    np.testing.assert_allclose(ours[:, 0], oracle["vtrans"], rtol=0, atol=1e-13)
    assert np.array_equal(ours[:, 1], oracle["vrot"])  # to the last bit


@given(st.data(), st.integers(1, 12), st.integers(12, 30))
def test_a_match_is_what_the_definition_says_ties_included(data, max_shift, n):
    grey = arrays(np.int32, n, elements=st.integers(0, 3))  # few levels: many ties
    now, previous = data.draw(grey), data.draw(grey)
    shift, difference = match_profiles(now, previous, max_shift)
    assert (shift, difference) == match_as_defined(now, previous, max_shift)


@given(st.integers(-39, 39), st.integers(0, 2**32 - 1))
def test_a_profile_matches_its_shifted_self_at_that_shift(shift, seed):
    scene = np.random.default_rng(seed).random(240)
    previous, now = scene[40:200], scene[40 - shift : 200 - shift]
    assert match_profiles(now, previous, 40) == (shift, 0.0)


@given(uint8_images, st.data())
def test_a_profile_is_the_mean_grey_of_the_columns(image, data):
    height, width = image.shape
    x_min = data.draw(st.integers(0, width - 1))
    y_min = data.draw(st.integers(0, height - 1))
    ours = profile(image, (x_min, width, y_min, height))
    np.testing.assert_allclose(ours, (image[y_min:, x_min:] / 255.0).mean(axis=0), atol=1e-15)


def test_an_image_that_moves_right_means_a_turn_to_the_left():
    odometry = VisualOdometry(OdometryConfig(fov_deg=90))
    odometry(panorama(), DT)
    left = odometry(np.roll(panorama(), 8, axis=1), DT)
    back = odometry(panorama(), DT)
    assert left.w_rad_s == pytest.approx(math.radians(8 * 90 / 160) / DT)
    assert back.w_rad_s == -left.w_rad_s


def test_through_the_bends_of_a_rendered_world_it_turns_as_the_camera_does():
    world = open_world("world:figure_eight?laps=0.4&grey=1&odometry=1")
    odometry = VisualOdometry(OdometryConfig(fov_deg=world.camera.fov_deg))
    turns = [(odometry(f.image, 0.1).w_rad_s * 0.1, f.velocity.w_rad_s * 0.1) for f in world]
    seen, true = np.sum(turns, axis=0)
    assert math.degrees(true) == pytest.approx(270, abs=1)
    assert seen == pytest.approx(true, rel=0.1)


@given(st.integers(0, 255), st.integers(0, 255))
def test_a_flat_image_that_grows_brighter_or_darker_is_no_turn(before, now):
    odometry = VisualOdometry(OdometryConfig(max_shift_px=20))
    odometry(np.full((31, 47), before, np.uint8), DT)
    velocity = odometry(np.full((31, 47), now, np.uint8), DT)
    assert velocity.w_rad_s == 0.0
    assert velocity.v_m_s == pytest.approx(min(100 * abs(now - before) / 255, 5.0))


@pytest.mark.parametrize("first_frame", ["still", "zero_profile"])
def test_a_black_stream_is_exactly_no_motion(first_frame):
    odometry = VisualOdometry(OdometryConfig(first_frame=first_frame))
    black = np.zeros((120, 160), np.uint8)
    assert [odometry(black, DT) for _ in range(5)] == [STILL] * 5


def test_an_image_seen_twice_is_exactly_no_motion():
    odometry = VisualOdometry(OdometryConfig())
    assert [odometry(panorama(), DT) for _ in range(3)] == [STILL] * 3


def test_the_first_frame_stands_still_unless_the_reference_is_followed():
    assert VisualOdometry(OdometryConfig())(panorama(), DT) == STILL
    as_reference = VisualOdometry(OdometryConfig(first_frame="zero_profile"))
    assert as_reference(panorama(), DT).v_m_s == 5.0


def test_a_speed_below_the_smallest_counts_as_none():
    nearly = panorama().copy()
    nearly[60:] = np.minimum(nearly[60:], 250)
    moved = []
    for min_speed in (0.0, 5.0):
        odometry = VisualOdometry(OdometryConfig(min_speed_m_s=min_speed))
        odometry(panorama(), DT)
        moved.append(odometry(nearly, DT).v_m_s)
    assert 0.0 < moved[0] < 5.0
    assert moved[1] == 0.0


def test_half_the_time_is_twice_the_turn_rate_and_the_same_speed():
    rates = []
    for dt in (0.1, 0.05):
        odometry = VisualOdometry(OdometryConfig())
        odometry(panorama(), dt)
        rates.append(odometry(np.roll(panorama(), -5, axis=1), dt))
    assert rates[1].w_rad_s == pytest.approx(2 * rates[0].w_rad_s)
    assert rates[1].v_m_s == rates[0].v_m_s


def test_grey_and_the_same_in_colour_give_the_same_motion():
    grey, colour = VisualOdometry(OdometryConfig()), VisualOdometry(OdometryConfig())
    for seed in range(3):
        image = panorama(seed)
        assert grey(image, DT) == colour(np.dstack([image] * 3), DT)


def test_it_resumes_bit_for_bit():
    images = [np.roll(panorama(), 3 * i, axis=1) // (i + 1) for i in range(6)]
    whole = VisualOdometry(OdometryConfig())
    expected = [whole(image, DT) for image in images]
    for cut in range(6):
        before, after = VisualOdometry(OdometryConfig()), VisualOdometry(OdometryConfig())
        motions = [before(image, DT) for image in images[:cut]]
        after.load_state_dict({k: v.clone() for k, v in before.state_dict().items()})
        assert motions + [after(image, DT) for image in images[cut:]] == expected


def test_the_state_is_replaced_and_not_written_over():
    odometry = VisualOdometry(OdometryConfig())
    odometry(panorama(0), DT)
    kept = odometry.state_dict()
    copy = {key: value.clone() for key, value in kept.items()}
    odometry(panorama(1), DT)
    assert all(torch.equal(kept[key], copy[key]) for key in copy)


@pytest.mark.parametrize("name", ["speed_region", "turn_region"])
@pytest.mark.parametrize(
    "region",
    [(0, 161, 0, 60), (-1, 100, 0, 60), (0, 160, 60, 121), (80, 80, 0, 60), (0, 160, 9, 3)],
)
def test_a_region_outside_the_image_is_refused_with_both_sizes(name, region):
    odometry = VisualOdometry(OdometryConfig(**{name: region}))
    with pytest.raises(ConfigError) as caught:
        odometry(panorama(), DT)
    assert f"odometry.{name} = {list(region)} does not lie in an image of 160 x 120 px" in str(
        caught.value
    )


def test_a_region_narrower_than_the_offsets_is_refused():
    odometry = VisualOdometry(OdometryConfig())
    with pytest.raises(ConfigError, match="max_shift_px = 40 is more than the 32 columns"):
        odometry(panorama(width=32), DT)


def test_an_image_of_another_size_or_kind_is_a_bad_frame_that_changes_nothing():
    odometry = VisualOdometry(OdometryConfig())
    odometry(panorama(), DT)
    with pytest.raises(BadFrame, match="image is 80 x 120 px; expected 160 x 120 px"):
        odometry(panorama(width=80), DT)
    with pytest.raises(BadFrame, match="image is float64"):
        odometry(panorama() / 255.0, DT)
    for dt in (0.0, -DT, math.nan):
        with pytest.raises(BadFrame, match="s since the last image; expected more than 0"):
            odometry(panorama(), dt)
    assert odometry(panorama(), DT) == STILL
