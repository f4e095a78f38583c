"""A robot's own loop: it maps, sleeps, wakes up on any clock, is found, and drives to goals."""

import importlib.util
import threading
from pathlib import Path

import numpy as np
import pytest

from neuroslam import NavigationBrain, open_source
from neuroslam.brain import load_brain
from neuroslam.config import build_config
from neuroslam.errors import BadFrame
from neuroslam.mapping.planning import leads_to, on_loops, quickest_path
from neuroslam.runs.following import PathFollower
from neuroslam.runs.live import LiveRobot, as_picture
from neuroslam.types import Velocity

ROOT = Path(__file__).resolve().parents[2]
CONFIG = build_config({"frame_rate_hz": 10.0, "view": {"threshold": 0.06}})


@pytest.fixture(scope="module")
def example():
    spec = importlib.util.spec_from_file_location("live_robot", ROOT / "examples/live_robot.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def drive():
    source = open_source("world:corridor?width=64&height=40&frames_per_lap=100&laps=1.3")
    return list(source)


@pytest.fixture(scope="module")
def mapped(drive, tmp_path_factory):
    """The first day: a map on disk, and the events."""
    path, events = tmp_path_factory.mktemp("live") / "map.safetensors", []
    with LiveRobot(CONFIG, path, events.append) as robot:
        for frame in drive:
            robot.step(frame.image, frame.time_s, frame.velocity)
    return path, events, robot


def test_the_example_maps_wakes_up_and_reaches_its_goals(example, tmp_path, capsys):
    path, events = tmp_path / "map.safetensors", []
    example.WORLD = "world:corridor?width=80&height=60&frames_per_lap=300&laps=1.7"
    example.first_day(path, events.append)
    assert "loop_closed" in [event.kind for event in events]
    frames, reached, timing = example.next_day(path, goals=2, start=60, pushed_m=0.4)
    assert frames < 150
    assert reached == 2  # it finds back to the path after the push
    assert timing.steps > 30
    assert "goal_reached" in capsys.readouterr().out


def test_the_loop_gives_what_a_brain_gives_and_saves_on_exit(mapped, drive):
    path, events, robot = mapped
    brain = NavigationBrain(CONFIG)
    for frame in drive:
        result = brain(frame)
    assert robot.pose == result.pose
    assert robot.located.confidence > 0.9
    assert load_brain(path).map.n == brain.map.n
    assert [event.kind for event in events] == ["loop_closed"] * len(events) != []
    assert robot.timing.steps == len(drive)


def test_a_stored_map_is_joined_on_any_clock(mapped, drive):
    path, _, _ = mapped
    events, robot = [], LiveRobot(path=path)
    robot.on_event = events.append
    for i, frame in enumerate(drive[30:90]):
        robot.step(frame.image, 1e-3 + i / 10, frame.velocity)  # earlier than yesterday
        if events:
            break
    assert [event.kind for event in events] == ["joined"]


@pytest.mark.parametrize("later_s", [1e6, -50.0])
def test_a_loaded_brain_starts_a_new_map_at_any_time(mapped, drive, later_s):
    brain = load_brain(mapped[0])
    brain.start_new_map()
    first = drive[0]._replace(index=0, time_s=brain.clock.time_s + later_s)
    assert brain(first).action == "create"
    with pytest.raises(BadFrame):  # from then on times rise
        brain(first)


def test_goals_and_saves_may_come_from_another_thread(mapped, drive):
    robot = LiveRobot(CONFIG, mapped[0].with_name("other.safetensors"))
    for frame in drive[:3]:
        robot.step(frame.image, frame.time_s, frame.velocity)
    helper = threading.Thread(target=lambda: (robot.add_goal(0), robot.save(), robot.timing))
    helper.start()
    for frame in drive[3:30]:
        robot.step(frame.image, frame.time_s, frame.velocity)
    helper.join()
    assert load_brain(robot.path).map.n >= 1


def test_forward_plans_follow_links_as_they_were_driven():
    links = (np.array([0, 1, 2]), np.array([1, 2, 1]), np.array([1.0, 1.0, 1.0]))
    assert quickest_path(links, 3, 2, 0).path == [2, 1, 0]
    assert quickest_path(links, 3, 2, 0, forward=True).path == []
    assert on_loops(links, 3).tolist() == [1, 2]
    assert leads_to(links, 3, 0).tolist() == [True, False, False]


def test_a_robot_without_a_goal_gets_no_command_and_with_one_steers_for_it(mapped):
    robot = LiveRobot(path=mapped[0])
    robot.brain = load_brain(mapped[0])
    assert robot.steer(0.5, 0.5) is None
    assert robot.plan().reason == "there is no goal"
    robot.add_goal(robot.brain.map.n - 1)
    command = robot.steer(0.5, 0.5)
    assert isinstance(command, Velocity)
    assert 0.0 < command.v_m_s <= 0.5


def test_a_goal_stays_while_the_views_show_the_robot_elsewhere(mapped):
    robot = LiveRobot(path=mapped[0])
    robot.brain = load_brain(mapped[0])
    robot._follower = PathFollower(robot.brain)
    goal = robot.brain.map.n - 1
    robot.brain.map.relocalise(2)
    robot.add_goal(goal)
    waiting = {name: robot.brain.map.goals[name].clone() for name in robot.brain.map.goals.columns}
    assert robot.steer(0.5, 0.5) is not None
    robot.brain.map.goals.replace(**{name: rows[:0] for name, rows in waiting.items()})
    robot._settle_goal(waiting)
    assert robot.brain.map.goals["experience"].tolist() == [goal]
    robot._follower.at = len(robot._follower.path) - 2  # beside the goal: the map is believed
    robot.brain.map.goals.replace(**{name: rows[:0] for name, rows in waiting.items()})
    robot._settle_goal(waiting)
    assert robot.brain.map.goals.n == 0


def test_a_link_after_which_the_robot_was_lost_is_avoided(mapped):
    robot = LiveRobot(path=mapped[0])
    robot.brain = load_brain(mapped[0])
    robot._follower = PathFollower(robot.brain)
    links = robot.brain.map.links_table
    slow = {"distance_m": 0.7, "heading_rad": 0.0, "facing_rad": 0.0, "duration_s": 60.0}
    links.append(source=3, target=5, **slow)
    assert robot._path(2, 6, forward=True) == [2, 3, 4, 5, 6]
    robot._follower.failed.add((3, 4))
    assert robot._path(2, 6, forward=True) == [2, 3, 5, 6]
    robot._follower.failed.add((3, 5))
    assert robot._path(2, 6, forward=True) == [2, 3, 4, 5, 6]  # there is no other


def test_pictures_of_opencv_and_grey_ones_are_taken():
    blue = np.zeros((4, 4, 3), np.uint8)
    blue[..., 0] = 200
    assert as_picture(blue, "bgr")[0, 0].tolist() == [0, 0, 200]
    assert as_picture(blue[..., :1], "grey").shape == (4, 4)
    with pytest.raises(BadFrame, match="expected rgb, bgr or grey"):
        as_picture(blue, "rbg")
    with pytest.raises(BadFrame, match="shape"):
        as_picture(blue, "grey")
