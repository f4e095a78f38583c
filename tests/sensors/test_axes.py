"""Poses in three dimensions on the ground plane, whatever their axes; a note where these differ."""

import numpy as np
import pytest

from neuroslam.errors import SourceError
from neuroslam.sensors.axes import axes_note, on_ground, parse_axes

ANGLES = np.linspace(0.0, 2.0, 9)
XY = np.column_stack([3.0 * np.sin(ANGLES), 3.0 - 3.0 * np.cos(ANGLES)])  # a left turn


def about(axis, angles):
    """Quaternions x, y, z, w of turns about an axis."""
    half = np.asarray(angles) / 2.0
    return np.column_stack([np.outer(np.sin(half), axis), np.cos(half)])


def in_robot_axes():
    return np.column_stack([XY, 0.2 * np.ones(9)]), about([0, 0, 1], ANGLES)


def in_camera_axes():
    """x right, y down, z ahead."""
    return np.column_stack([-XY[:, 1], np.zeros(9), XY[:, 0]]), about([0, -1, 0], ANGLES)


def in_graphics_axes():
    """x right, y up, z backward."""
    return np.column_stack([-XY[:, 1], np.zeros(9), -XY[:, 0]]), about([0, 1, 0], ANGLES)


@pytest.mark.parametrize(
    ("make", "axes"),
    [
        (in_robot_axes, "robot"),
        (in_robot_axes, "x,y"),
        (in_camera_axes, "camera"),
        (in_camera_axes, "z,-x"),
        (in_graphics_axes, "-z, -x"),
    ],
)
def test_one_drive_in_any_axes_is_the_same_on_the_ground(make, axes):
    poses = on_ground(*make(), parse_axes(axes))
    np.testing.assert_allclose(poses, np.column_stack([XY, ANGLES]), atol=1e-12)


def test_without_quaternions_the_heading_is_unknown():
    poses = on_ground(in_camera_axes()[0], None, parse_axes("camera"))
    np.testing.assert_allclose(poses[:, :2], XY)
    assert np.isnan(poses[:, 2]).all()


def test_axes_of_a_camera_are_noticed_and_those_of_a_robot_or_a_drone_are_not():
    assert "moves along z (2.99 m) and not along y (0 m)" in axes_note("t", in_camera_axes()[0])
    assert axes_note("t", in_graphics_axes()[0]) is not None
    assert axes_note("t", in_robot_axes()[0]) is None
    hill = np.column_stack([np.linspace(0, 9, 5), np.zeros(5), np.linspace(0, 0.5, 5)])
    assert axes_note("t", hill) is None  # straight ahead, and a little up
    assert axes_note("t", np.zeros((5, 3))) is None
    drone = np.random.default_rng(0).normal(size=(99, 3))
    assert axes_note("t", drone) is None


@pytest.mark.parametrize("text", ["", "xy", "x,x", "z,-z", "forward", "x,y,z"])
def test_unknown_axes_are_one_line(text):
    with pytest.raises(SourceError, match=r"expected robot .x ahead, y left., camera"):
        parse_axes(text)
