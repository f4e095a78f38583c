"""The speed upwards from images: a car's pitch on ramps, a drone's slope, the profile of rows."""

import copy
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neuroslam import NavigationBrain, load_brain, save_brain
from neuroslam.config import OdometryConfig, build_config, merge_values, read_preset
from neuroslam.errors import BadFrame, ConfigError
from neuroslam.odometry.climb import (
    VisualClimb,
    next_pitch,
    pitched,
    shift_of_rows,
    turned,
    vertical_of_rays,
)
from neuroslam.types import Frame, Velocity
from neuroslam.worlds.world import open_world

DT = 0.1
PITCH, SLOPE = (OdometryConfig(method="flow", climb=c) for c in ("pitch", "slope"))


@pytest.fixture(scope="module")
def ramp():
    """Frames of a car from before the first ramp to behind it, with its height and odometry."""
    source = open_world("world:garage?grey=true")
    span = range(345, 425)
    return [source.frame(i) for i in span], source.heights()[345:425], source.pitches()[345:425]


def corners(n=60, seed=0):
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-3, 3, n), rng.uniform(-2, 1.5, n), rng.uniform(2, 9, n)])


def rays(points):
    return points / points[:, 2:]


@given(pitch=st.floats(-0.05, 0.05), slope=st.floats(-0.02, 0.02), error=st.floats(-0.02, 0.02))
@settings(max_examples=20, deadline=None)
def test_a_change_of_pitch_is_found_though_odometry_turns_otherwise(pitch, slope, error):
    points = corners()
    half = turned(0.5 * error) @ pitched(0.5 * pitch)  # the displacement is that of the middle
    before = points @ np.linalg.inv(half).T
    after = (points - [0.0, -0.5 * slope, 0.5]) @ half.T
    found = vertical_of_rays(rays(before), rays(after), 1e-4, pitches=True)
    assert found is not None
    assert found[0] == pytest.approx(pitch, abs=2e-3)


@given(slope=st.floats(-0.4, 0.4))
@settings(max_examples=20, deadline=None)
def test_the_slope_of_a_path_is_found_among_false_matches(slope):
    points = corners()
    moved = points - [0.0, -0.5 * slope, 0.5]
    moved[::4] = corners(15, seed=1)
    found = vertical_of_rays(rays(points), rays(moved), 1e-4, pitches=False)
    assert found is not None
    assert found[1] == pytest.approx(slope, abs=5e-3)


def test_too_few_corners_say_nothing():
    assert vertical_of_rays(corners(5), corners(5), 1e-3, pitches=True) is None
    flat = np.full((80, 160), 90, np.uint8)
    assert VisualClimb(SLOPE).compare(flat, flat) is None


def test_a_car_sees_how_high_a_ramp_is(ramp):
    frames, height, pitch = ramp
    climb = VisualClimb(PITCH)
    seen = [climb(frame.image, DT, *frame.velocity) for frame in frames]
    risen = np.cumsum(seen) * DT
    assert risen[-1] == pytest.approx(height[-1] - height[0], rel=0.08)
    assert np.abs(risen - height + height[0]).max() < 0.25
    assert abs(climb.before.pitch_rad - pitch[-1]) < math.radians(2.0)


def test_a_level_ring_has_no_height():
    source = open_world("world:garage?grey=true&route=2&noise=0.05&rate=5")
    climb = VisualClimb(PITCH)
    seen = [climb(source.frame(i).image, 0.2, *source.odometry()[i]) for i in range(60)]
    assert not np.any(seen)


def test_a_small_pitch_decays_and_climbs_nothing():
    assert next_pitch(0.04, 0.0, 2.0, 0.05, 2.0) == (0.04 / math.e, 0.0)
    pitch, tangent = next_pitch(-0.1, 0.0, 2.0, 0.05, 2.0)
    assert (pitch, tangent) == (-0.1, math.tan(-0.1))


@pytest.mark.parametrize("shift", [-3.5, -1.0, 0.0, 0.5, 2.0])
def test_rows_move_by_parts_of_a_pixel(shift):
    fine = np.random.default_rng(0).integers(0, 255, (240, 40)).astype(np.float32)
    fine = np.stack([np.convolve(row, np.ones(24) / 24, "same") for row in fine.T]).T
    now, before = (np.roll(fine, round(2 * by), axis=0)[40:200:2] for by in (shift, 0.0))
    found = shift_of_rows(now.astype(np.uint8), before.astype(np.uint8), 10)
    assert found == pytest.approx(shift, abs=0.3)


def test_profiles_measure_metres_by_the_distance_of_the_view():
    image = np.random.default_rng(0).integers(0, 255, (30, 1)).astype(np.uint8)
    image = np.repeat(np.repeat(image, 4, axis=0), 160, axis=1)
    climb = VisualClimb(OdometryConfig(climb="slope", view_distance_m=8.0))
    climb(image, DT, 0.0)
    up = climb(np.roll(image, 2, axis=0), DT, 0.0)  # the picture moves down
    assert up == pytest.approx(2.0 / 80.0 * 8.0 / DT, rel=0.1)
    assert climb.reckon(1.0) == up


def test_measuring_changes_nothing_and_a_broken_view_keeps_the_pitch(ramp):
    frames, _, _ = ramp
    climb = VisualClimb(PITCH)
    for frame in frames[:30]:
        climb(frame.image, DT, *frame.velocity)
    before = {k: v.clone() for k, v in climb.state_dict().items()}
    speed, outlook = climb.measure(frames[30].image, DT, *frames[30].velocity)
    assert all(torch.equal(v, before[k]) for k, v in climb.state_dict().items())
    pitch = climb.before.pitch_rad
    assert climb.reckon(2.0) == pytest.approx(2.0 * math.tan(pitch))
    climb.remember(None, DT)
    assert climb.measure(frames[30].image, DT, *frames[30].velocity)[0] != 0.0
    climb.remember(outlook, broken=True)
    assert (climb.before.pitch_rad, climb.before.rate, climb.before.since_s) == (pitch, 0.0, 0.0)
    assert speed == pytest.approx(frames[30].velocity.v_m_s * math.tan(outlook.pitch_rad))


def test_images_of_other_sizes_and_times_are_refused(ramp):
    climb = VisualClimb(PITCH)
    climb(ramp[0][0].image, DT, 1.0)
    with pytest.raises(BadFrame, match="image is 80 x 80 px; expected 160 x 80 px"):
        climb(ramp[0][0].image[:, :80], DT, 1.0)
    with pytest.raises(BadFrame, match="expected more than 0"):
        climb(ramp[0][0].image, 0.0, 1.0)


def test_configs_that_cannot_see_the_height_are_refused():
    for odometry, message in (
        ({"climb": "pitch"}, "needs method = 'flow'"),
        ({"climb": "slope", "fov_deg": 360}, "expected at most 150"),
    ):
        with pytest.raises(ConfigError, match=message):
            build_config({"odometry": odometry})


# --- in a brain ------------------------------------------------------------------------------


def brain_of(climb):
    more = {"odometry": {"method": "flow", "climb": climb}, "sessions": {"after_gap": "new_map"}}
    return NavigationBrain(build_config(merge_values(read_preset("neuroslam_3d"), more)))


def test_a_brain_sees_its_height_and_ignores_the_sources(ramp, tmp_path):
    frames, height, _ = ramp
    blind = [frame._replace(v_z_m_s=None) for frame in frames]
    misled = [frame._replace(v_z_m_s=3.0) for frame in frames]
    seeing, other, given = brain_of("pitch"), brain_of("pitch"), brain_of("given")
    for one, two in zip(blind[:40], misled[:40], strict=True):
        assert seeing(one) == other(two)
        given(one)
    save_brain(seeing, tmp_path / "one.safetensors")
    others = [load_brain(tmp_path / "one.safetensors"), copy.deepcopy(seeing)]
    for frame in blind[40:]:
        results = [one(frame) for one in (seeing, *others)]
        assert results[0] == results[1] == results[2]
    assert seeing.pose_3d.z_m == pytest.approx(height[-1] - height[0], rel=0.08)
    assert given.pose_3d.z_m == 0.0
    assert given.climb is None
    assert not any(name.startswith("climb") for name in given.state_dict())


def test_a_new_map_goes_on_with_the_pitch_and_a_gap_with_none_of_the_speed(ramp):
    brain = brain_of("pitch")
    for frame in ramp[0][:30]:
        brain(frame)
    pitch = brain.climb.before.pitch_rad
    assert pitch > math.radians(5.0)
    late = ramp[0][40]
    brain(late._replace(time_s=late.time_s + 100.0))
    assert brain.climb.before.pitch_rad == pitch
    assert brain.pose_3d.z_m == 0.0
    assert len(brain.stored) == 1


def test_a_frame_without_an_image_climbs_on(ramp):
    brain = brain_of("pitch")
    for frame in ramp[0][:30]:
        brain(frame)
    before, last = brain.pose_3d.z_m, ramp[0][29]
    brain(Frame(last.index + 1, last.time_s + DT, None, Velocity(2.0, 0.0)))
    rise = 2.0 * math.tan(brain.climb.before.pitch_rad) * DT
    assert brain.pose_3d.z_m - before == pytest.approx(rise)
