"""Odometry by optical flow: turns and metres of rendered worlds, fusion, and its state."""

import math

import cv2
import numpy as np
import pytest

from neuroslam import NavigationBrain
from neuroslam.config import OdometryConfig, build_config
from neuroslam.errors import BadFrame, ConfigError
from neuroslam.geometry import wrap_angles
from neuroslam.odometry import FlowOdometry
from neuroslam.odometry.floor import floor_motion
from neuroslam.odometry.fusion import Measured, fused
from neuroslam.types import Frame, Velocity
from neuroslam.worlds.world import open_world

DT = 0.1
KNOWN = OdometryConfig(method="flow", camera_height_m=1.1)


@pytest.fixture(scope="module")
def drive():
    """A bend of the gallery: pictures, true displacements and true turns."""
    world = open_world("world:ellipse?laps=0.12")
    pose = world.truths()
    true = np.hypot(*np.diff(pose[:, :2], axis=0).T), wrap_angles(np.diff(pose[:, 2]))
    return [world.frame(i).image for i in range(world.n_frames)], *true


def test_turns_and_metres_are_those_of_the_world(drive):
    images, way, turn = drive
    odometry = FlowOdometry(KNOWN)
    measured = DT * np.array([odometry(image, DT) for image in images])[1:]
    assert measured[:, 1].sum() == pytest.approx(turn.sum(), rel=0.02)
    assert np.sqrt(np.mean((measured[:, 1] - turn) ** 2)) < math.radians(0.15)
    assert measured[:, 0].sum() == pytest.approx(way.sum(), rel=0.06)


def test_twice_the_height_is_twice_the_way(drive):
    one, two = (
        FlowOdometry(KNOWN.model_copy(update={"camera_height_m": h, "max_speed_m_s": 5.0 * h}))
        for h in (1.0, 2.0)
    )
    for odometry in (one, two):
        odometry(drive[0][0], DT)
    grey = cv2.cvtColor(drive[0][1], cv2.COLOR_RGB2GRAY)
    first, second = one.flow(grey, DT), two.flow(grey, DT)
    assert first is not None
    assert second is not None
    assert second.forward.value == pytest.approx(2.0 * first.forward.value, rel=1e-6)
    assert second.turn == first.turn


def test_a_picture_that_stays_is_no_motion(drive):
    odometry = FlowOdometry(KNOWN)
    for _ in range(4):
        assert odometry(drive[0][0], DT) == pytest.approx((0.0, 0.0), abs=1e-3)


def test_a_floor_without_texture_says_nothing():
    flat = np.full((80, 160), 90, np.uint8)
    assert floor_motion(flat, flat, 0.0, 80.0, 0.0, 0.5) is None


def test_wheels_carry_the_robot_through_the_dark_and_do_not_slip(drive):
    odometry, dark = FlowOdometry(KNOWN), np.zeros_like(drive[0][0])
    given = Velocity(0.8, 0.1)
    odometry(dark, DT, given)
    for _ in range(3):
        assert odometry(dark, DT, given) == pytest.approx(given, abs=0.01)
    odometry = FlowOdometry(KNOWN)
    slipping = [odometry(image, DT, Velocity(3.0, 0.0)).v_m_s for image in drive[0][:8]]
    assert slipping[-1] == pytest.approx(drive[1][7] / DT, rel=0.15)


def test_a_gyroscope_counts_by_its_error(drive):
    sure = KNOWN.model_copy(update={"gyroscope_error_rad_s": 1e-5})
    odometry = FlowOdometry(sure)
    for image, turn in zip(drive[0][:3], drive[2][:3], strict=True):
        found = odometry(image, DT, turn_rate_rad_s=float(turn) / DT + 0.002)
    assert found.w_rad_s == pytest.approx(drive[2][2] / DT + 0.002, abs=5e-4)


def test_measurements_far_from_the_best_are_left_out():
    assert fused([]) is None
    assert fused([Measured(1.0, math.inf)]) is None
    kept = fused([Measured(1.0, 0.1), Measured(2.0, 0.1), Measured(1.1, 0.2)])
    assert kept is not None
    assert kept.value < 1.1


def test_a_brain_with_flow_goes_on_from_its_state(drive):
    config = build_config({"odometry": {"method": "flow", "use": "fused", "camera_height_m": 1.1}})
    one, two = NavigationBrain(config), NavigationBrain(config)
    wheels = Velocity(0.8, 0.1)
    frames = [Frame(i, DT * i, image, wheels) for i, image in enumerate(drive[0][:8])]
    for frame in frames[:5]:
        one(frame)
    two.load_state_dict(one.state_dict())
    for frame in frames[5:]:
        assert one(frame).motion == two(frame).motion
    with pytest.raises(BadFrame, match="px; expected"):
        one(Frame(9, 0.9, drive[0][0][:40]))


@pytest.mark.parametrize("slip", [1.0, 1.3, 3.0])
def test_wheels_faster_than_the_camera_lead_to_where_those_at_its_rate_do(slip, drive):
    images, way, turn = drive
    config = build_config({"odometry": {"method": "flow", "use": "fused", "camera_height_m": 1.1}})
    wheels, moved = Velocity(slip * float(way.mean()) / DT, 0.0), {}
    for rate in (1, 4):  # instants of the wheels to one picture
        one, two, dt = NavigationBrain(config), NavigationBrain(config), DT / rate
        sums = np.zeros((len(images), 2))
        for i in range(rate * len(images) - rate + 1):
            frame = Frame(i, dt * i, None if i % rate else images[i // rate], wheels)
            if i == 30:  # between two pictures
                two.load_state_dict(one.state_dict())
            motion = one(frame).motion
            assert i < 30 or two(frame).motion == motion
            sums[-(-i // rate)] += dt * np.array(motion[:2])
        moved[rate] = sums[1:]
    np.testing.assert_allclose(moved[4], moved[1], atol=1e-9)
    assert moved[4][2:, 1].sum() == pytest.approx(turn[2:].sum(), rel=0.02)
    if slip == 1.0:
        assert moved[4][:, 0].sum() == pytest.approx(way.sum(), rel=0.03)


def test_a_gyroscope_turns_the_robot_between_two_pictures(drive):
    config = build_config({"odometry": {"method": "flow", "use": "fused"}})
    brain = NavigationBrain(config)
    brain(Frame(0, 0.0, drive[0][0], Velocity(1.0, 0.0)))
    without = brain(Frame(1, 0.1, None, Velocity(1.0, 0.0))).motion
    by_gyroscope = brain(Frame(2, 0.2, None, Velocity(1.0, 0.0), turn_rate_rad_s=0.1)).motion
    assert without.w_rad_s == 0.0
    share = 1.0 / (1.0 + (0.01 / 0.05) ** 2)  # by the variances of both
    assert by_gyroscope.w_rad_s == pytest.approx(0.1 * share)
    with pytest.raises(BadFrame, match="turn rate"):
        brain(Frame(3, 0.3, None, Velocity(1.0, 0.0), turn_rate_rad_s=math.nan))


def test_profiles_cannot_be_fused():
    with pytest.raises(ConfigError, match="needs method = 'flow'"):
        build_config({"odometry": {"use": "fused"}})
