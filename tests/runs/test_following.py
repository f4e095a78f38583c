"""Following a path: its layout by links, the correction by views, obstacles, and finding back."""

import math
from itertools import pairwise

import numpy as np
import pytest

from neuroslam.config import build_config
from neuroslam.geometry import ORIGIN, compose, relative
from neuroslam.runs.following import PathFollower, lay_out
from neuroslam.runs.live import LiveRobot
from neuroslam.types import Motion, Pose
from neuroslam.worlds.render import render
from neuroslam.worlds.world import open_world

STILL = Motion(0.0, 0.0, 0.1)


@pytest.fixture(scope="module")
def world():
    return open_world("world:corridor?width=64&height=40&frames_per_lap=100&laps=0.6")


@pytest.fixture(scope="module")
def robot(world):
    """A robot that drove the world's route once."""
    config = build_config({"frame_rate_hz": 10.0, "view": {"threshold": 0.06}})
    robot = LiveRobot(config)
    for frame in world:
        robot.step(frame.image, frame.time_s, frame.velocity)
    return robot


def true_pose(robot, world, experience: int) -> Pose:
    return world.truth(int(robot.brain.map.experiences["first_frame"][experience]))


def show(robot, world, pose: Pose) -> None:
    """Let the camera see the world from a pose; the map stays as it is."""
    image = render(world.world, pose, world.camera)
    robot.brain.continuity.compare(robot.brain.view.encode(image))


@pytest.fixture
def follower(robot):
    follower = PathFollower(robot.brain)
    follower.take_path(list(range(10, 21)))
    return follower


def test_a_path_is_laid_out_by_its_links(robot, world):
    path = list(range(5, 25))
    laid = lay_out(robot.brain.map, path)
    start = true_pose(robot, world, 5)
    true = np.array([relative(start, true_pose(robot, world, e)) for e in path])
    np.testing.assert_allclose(laid, true, atol=0.2)  # odometry steps along chords of the bends
    back = lay_out(robot.brain.map, path[::-1])
    for (a, b), (c, d) in zip(pairwise(laid[::-1]), pairwise(back), strict=True):
        there = relative(Pose(*a.tolist()), Pose(*b.tolist()))
        np.testing.assert_allclose(relative(Pose(*c.tolist()), Pose(*d.tolist())), there, atol=1e-9)


@pytest.mark.parametrize("turned", [-0.15, 0.0, 0.15])
def test_the_view_shows_how_far_the_robot_is_turned(robot, world, follower, turned):
    show(robot, world, compose(true_pose(robot, world, 10), Pose(0.0, 0.0, turned)))
    for _ in range(20):
        follower.moved(STILL)
    assert follower.now.match < 0.75
    assert follower.now.turned_rad == pytest.approx(turned, abs=0.06)


def test_the_view_shows_how_far_along_the_path_the_robot_is(robot, world, follower):
    show(robot, world, true_pose(robot, world, 12))
    for _ in range(40):
        follower.moved(STILL)
    assert follower.now.experience in (11, 12)


def test_pursuit_leads_back_to_the_path(follower):
    follower.take_path(follower.path, Pose(0.0, 0.3, 0.0))  # to the left of it
    assert follower.command(0.5, 0.8, 2.0).w_rad_s < 0.0
    follower.take_path(follower.path, Pose(0.0, 0.0, 2.0))  # faces away
    command = follower.command(0.5, 0.8, 2.0)
    assert command.v_m_s == 0.0
    assert command.w_rad_s < 0.0


def test_the_end_is_reached_only_where_it_is_seen(robot, world, follower):
    end = Pose(*follower.nodes[-1].tolist())
    follower.take_path(follower.path, compose(end, Pose(0.01, 0.0, 0.0)))
    show(robot, world, true_pose(robot, world, 20))
    follower.moved(STILL)
    assert follower.arrived()
    follower.unseen_m = 100.0
    assert not follower.arrived()


def test_a_path_that_ends_behind_its_begin_has_to_be_driven(robot, world, follower):
    lap = np.array([[x, y, 0.0] for x, y in [(0, 0), (2, 0), (2, 2), (-2, 2), (-2, 0), (-0.5, 0)]])
    follower.path, follower.nodes = follower.path[:6], lap
    follower.at, follower.pose = 0, Pose(0.1, 0.0, 0.0)
    assert not follower.arrived()
    follower.at, follower.pose = 4, Pose(-0.6, 0.0, 0.0)
    assert not follower.arrived()
    follower.pose = Pose(-0.45, 0.0, 0.0)
    assert follower.arrived()


def test_a_robot_that_is_held_backs_and_then_looks_around(robot, world, follower):
    show(robot, world, true_pose(robot, world, 10))
    for _ in range(7):
        follower.command(0.5, 0.8, 2.0)
        follower.moved(STILL)
    assert follower.command(0.5, 0.8, 2.0).v_m_s < 0.0
    assert follower.mode == "back"
    for _ in range(7):  # an obstacle behind, too
        follower.command(0.5, 0.8, 2.0)
        follower.moved(STILL)
    assert follower.command(0.5, 0.8, 2.0).w_rad_s > 0.0
    assert follower.mode == "turn"
    assert follower.failed == {(10, 11)}


def test_a_lost_robot_turns_on_the_spot_and_finds_itself(robot, world, follower):
    here = compose(true_pose(robot, world, 14), Pose(0.0, 0.1, 2.5))
    follower.unseen_m = 100.0
    found = None
    for _ in range(300):
        command = follower.command(0.5, 0.8, 2.0)
        here = compose(here, Pose(0.1 * command.v_m_s, 0.0, 0.1 * command.w_rad_s))
        show(robot, world, here)
        follower.moved(Motion(*command, 0.1))
        found = follower.found()
        if found is not None:
            break
    assert found in range(12, 17)
    seen = relative(true_pose(robot, world, found), here)
    assert math.hypot(seen.x_m, seen.y_m) < 0.8
    assert abs(seen.theta_rad) < 0.25
    follower.take_path(list(range(found, 21)), ORIGIN)
    assert follower.sure
