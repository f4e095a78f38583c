"""Ramps of a rendered building, and the camera that pitches on them."""

import math

import numpy as np
import pytest

from neuroslam.types import Pose
from neuroslam.worlds.camera import Camera
from neuroslam.worlds.ramps import floors_around, in_view, larger_camera, warp
from neuroslam.worlds.render import render
from neuroslam.worlds.scene import Ramp
from neuroslam.worlds.world import open_world

UP = Ramp(-5.0, 5.0, 1.0, 3.0, 2.0)
GARAGE = open_world("world:garage?grey=true")


def test_a_ramp_is_the_floor_of_the_storey_at_both_ends():
    for x, y, z in ((-5.0, 0.0, 0.0), (5.0, 0.0, 0.0), (5.0, 2.0, 2.0), (-4.999, 2.0, 0.0)):
        floors, above = floors_around((UP,), x, y)
        near = floors[0].a_m + floors[0].slope * x
        assert (near, above) == pytest.approx((z if UP.covers(x, y) else 0.0, above), abs=1e-2)
    assert floors_around((UP,), 4.0, 2.0)[1] == pytest.approx(1.8)


def test_a_pitched_camera_sees_the_horizon_lower():
    camera = Camera(width=120, height=80)
    larger = larger_camera(camera, 0.2)
    fine = len(larger.slopes)
    level = np.zeros((fine, larger.width), np.uint8)
    level[larger.slopes > 0.0] = 255
    image = warp(level, larger, camera, 0.2)
    rows = np.count_nonzero(image[:, 60] > 127) / 2.0
    assert rows == pytest.approx(40.0 + camera.focal_px * math.tan(0.2), abs=0.5)
    assert warp(level, larger, camera, 0.0) is level
    assert larger_camera(camera, 0.0) is camera


def test_ramps_change_nothing_where_none_is_in_view():
    level = open_world("world:garage?grey=true&ramps=false")
    for index in (0, 20, 60):
        assert np.array_equal(GARAGE.frame(index).image, level.frame(index).image)
    middle = int(np.argmax(GARAGE.pitches()))
    assert np.abs(GARAGE.frame(middle).image.astype(float) - level.frame(middle).image).mean() > 8.0


def test_a_ramp_is_in_view_from_its_foot_and_not_through_a_wall():
    world, camera = GARAGE.world, GARAGE.camera
    ahead = camera.rays
    assert in_view(world.ramps, Pose(-7.5, 2.0, 0.0), ahead, np.full(len(ahead), 9.0))
    assert not in_view(world.ramps, Pose(-7.5, 2.0, 0.0), ahead, np.full(len(ahead), 0.5))
    assert not in_view(world.ramps, Pose(-7.5, 2.0, math.pi), -ahead, np.full(len(ahead), 9.0))


def test_a_car_drives_onto_a_ramp_without_a_jump_of_the_picture():
    world, camera = GARAGE.world, GARAGE.camera
    before, after = (
        render(world, Pose(-6.5 + by, 2.0, 0.0), camera, pitch_rad=0.1).astype(float)
        for by in (-0.002, 0.002)
    )
    assert np.abs(before - after).mean() < 2.0


def test_the_pitch_of_a_car_is_that_of_its_axles():
    pitch, z = GARAGE.pitches(), GARAGE.heights()
    slope = math.atan(2.7 / 13.0)
    assert pitch.max() == pytest.approx(slope, abs=1e-3)
    assert pitch.min() == pytest.approx(-slope, abs=1e-3)
    assert not pitch[z == 0.0][:300].any()
    assert not open_world("world:atrium").pitches().any()
    kidnapped = open_world("world:garage?kidnapped=20:0.5")
    assert np.array_equal(kidnapped.pitches()[:200], pitch[:200])
