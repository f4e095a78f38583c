"""Head-direction and speed cells move the grid cells, and keep what walls say of the heading."""

import math

import numpy as np
import pytest

from neuroslam import NavigationBrain
from neuroslam.config import build_config, merge_values, read_preset
from neuroslam.types import Frame, Velocity

CELLS = {"cells": ["place", "head_direction", "speed"], "grid_cells": {"self_motion": "cells"}}


def brain_of(over):
    return NavigationBrain(build_config(merge_values(read_preset("slrb"), over)))


def frames(n, compass, speed=0.2, walls=None):
    for i in range(n):
        heading = 0.5 + math.radians(compass[i]) if compass is not None else None
        yield Frame(i, 0.05 * i, velocity=Velocity(speed, 0.0), walls=walls, heading_rad=heading)


def test_the_ring_averages_the_noise_of_a_compass():
    noise = np.random.default_rng(0).normal(0.0, 10.0, 400)
    off = {}
    for name, over in (("measured", {}), ("cells", CELLS)):
        brain = brain_of(over)
        poses = [brain(frame).pose.theta_rad for frame in frames(400, noise)]
        off[name] = np.degrees(np.std(np.array(poses[200:]) - 0.5))
    assert off["measured"] == pytest.approx(10.0, rel=0.15)
    assert off["cells"] < 3.0


def test_the_cells_move_the_animal_as_far_as_it_runs():
    brain = brain_of(CELLS)
    for frame in frames(201, np.zeros(201)):
        here = brain(frame).pose
    assert math.hypot(here.x_m, here.y_m) == pytest.approx(200 * 0.05 * 0.2, rel=0.02)
    assert math.atan2(here.y_m, here.x_m) == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize("compass", [True, False])
def test_what_walls_say_of_the_heading_stays_with_the_cells_where_there_is_no_compass(compass):
    brain = brain_of(CELLS)
    before = brain.navigation.pose.theta_rad
    brain.navigation.walls.errors = brain.navigation.walls.errors + 0.0
    brain.navigation.walls.errors[0, 1] = 0.2  # a correction by -0.2 rad, still unsaid
    turn = brain.navigation._hand_over(-0.2, compass)
    assert brain.navigation.pose.theta_rad == pytest.approx(before - 0.2)
    assert turn == (0.0 if compass else -0.2)
    assert brain.navigation.heading_error_rad == pytest.approx(0.2 if compass else 0.0)


def test_measured_self_motion_is_what_counts_by_default():
    alone, with_cells = brain_of({}), brain_of({"cells": CELLS["cells"]})
    noise = np.random.default_rng(1).normal(0.0, 5.0, 60)
    for frame in frames(60, noise):
        assert alone(frame).pose == with_cells(frame).pose
