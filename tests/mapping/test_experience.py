"""Experience map: actions, odometry, relaxation, planning, goals."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neuroslam.config import MapConfig
from neuroslam.errors import MapError
from neuroslam.mapping import ExperienceMap
from neuroslam.mapping.actions import choose_action
from neuroslam.mapping.tables import closes_loop
from neuroslam.types import Motion, Pose, PoseEstimate, ViewMatch

AT = PoseEstimate(5.0, 5.0, 5.0)


def new_view(template):
    return ViewMatch(template, -1.0, 0.0, True)


def square_lap(solver="relax", drift_rad=0.0, side=4, **config):
    """Drive a square, ``side`` experiences a metre apart on each side, and close the loop."""
    graph = ExperienceMap(MapConfig(solver=solver, initial_heading_deg=0.0, **config))
    graph.create(0, AT, frame=0)
    for step in range(1, 4 * side):
        turn = math.pi / 2 if step % side == 1 and step > 1 else 0.0
        graph.move(Motion(1.0, turn + drift_rad, 1.0))
        graph.create(step, AT, frame=step)
    graph.move(Motion(1.0, drift_rad, 1.0))
    graph.state.facing_rad += math.pi / 2
    graph.link(0)
    return graph


def loop_error_m(graph):
    links, poses = graph.links, graph.poses
    ends = poses[links.source]
    bearing = ends[:, 2] + links.heading_rad
    there = ends[:, :2] + links.distance_m[:, None] * np.stack(
        [np.cos(bearing), np.sin(bearing)], axis=1
    )
    return np.abs(there - poses[links.target, :2]).max()


def test_odometry_turns_first_and_then_moves_along_the_new_heading():
    graph = ExperienceMap(MapConfig(initial_heading_deg=0.0))
    graph.move(Motion(2.0, math.pi / 2, 1.0))
    assert graph.pose.x_m == pytest.approx(0.0, abs=1e-12)
    assert graph.pose.y_m == pytest.approx(2.0)
    graph.create(0, AT, frame=0)
    assert graph.poses[0].tolist() == pytest.approx([0.0, 2.0, math.pi / 2])
    assert graph.offset == pytest.approx((0.0, 0.0, 0.0))


def test_a_link_keeps_what_odometry_measured():
    graph = ExperienceMap(MapConfig(initial_heading_deg=30.0))
    graph.create(0, AT, frame=0)
    graph.move(Motion(1.0, 0.25, 2.0))
    graph.create(1, AT, frame=1)
    links = graph.links
    assert (links.source[0], links.target[0]) == (0, 1)
    assert links.distance_m[0] == pytest.approx(2.0)
    assert links.heading_rad[0] == pytest.approx(0.5)
    assert links.facing_rad[0] == pytest.approx(0.5)
    assert links.duration_s[0] == pytest.approx(2.0)


def test_a_link_is_not_added_twice_and_relocalising_resets_odometry():
    graph = ExperienceMap(MapConfig())
    graph.create(0, AT, frame=0)
    graph.move(Motion(1.0, 0.0, 1.0))
    graph.create(1, AT, frame=1)
    graph.move(Motion(-1.0, 0.0, 1.0))
    graph.link(0)
    graph.move(Motion(1.0, 0.0, 1.0))
    graph.link(1)
    assert graph.n_links == 1
    graph.move(Motion(1.0, 0.0, 3.0))
    graph.relocalise(0)
    assert graph.state.since_s == 0.0
    assert graph.offset == pytest.approx((0.0, 0.0, 0.0))


@pytest.mark.parametrize("solver", ["relax", "least_squares"])
def test_relaxation_does_not_change_a_lap_without_drift(solver):
    graph = square_lap(solver)
    before = graph.poses
    graph.relax(2000)
    np.testing.assert_allclose(graph.poses[:, :2] - graph.poses[0, :2], before[:, :2], atol=1e-3)


@pytest.mark.parametrize("solver", ["relax", "least_squares"])
def test_a_drifting_lap_closes(solver):
    graph = square_lap(solver, drift_rad=0.02)
    opened = loop_error_m(graph)
    graph.relax(3000)
    assert opened > 0.5
    assert loop_error_m(graph) < 0.3 * opened


def test_a_map_without_loops_has_converged_and_is_not_relaxed():
    graph = ExperienceMap(MapConfig())
    for step in range(50):
        graph.move(Motion(1.0, 0.1, 1.0))
        graph.create(step, AT, frame=step)
        assert graph.relax() == 0.0
    assert graph._relaxation is None  # not even prepared


def test_relaxation_converges():
    graph = square_lap(drift_rad=0.02, rest_tolerance=1e-6)
    calls = 0
    while not graph.state.at_rest:
        graph.relax()
        calls += 1
        assert calls < 2000
    assert graph.relax() == 0.0


def test_the_robot_keeps_its_pose_relative_to_its_experience_when_the_map_moves():
    graph = square_lap(drift_rad=0.03)
    graph.move(Motion(0.7, 0.4, 1.0))
    before, pose = graph.offset, graph.pose
    graph.relax(500)
    assert graph.offset == pytest.approx(before, abs=1e-12)
    assert graph.pose != pytest.approx(pose, abs=1e-3)


def test_actions_follow_view_and_cells():
    graph = ExperienceMap(MapConfig(loops=0), torus=(21, 21, 36), threshold_cells=2.0)
    step = Motion(0.5, 0.0, 1.0)
    assert graph(step, new_view(0), AT, 0) == ("create", 0)
    assert graph(step, ViewMatch(0, 0.01, 0.0, False), AT, 1) == ("none", 0)
    far = PoseEstimate(9.0, 5.0, 5.0)
    assert graph(step, ViewMatch(0, 0.01, 0.0, False), far, 2) == ("create", 1)
    assert graph(step, ViewMatch(0, 0.01, 0.0, False), AT, 3) == ("link", 0)
    assert graph(step, ViewMatch(-1, -1.0, 0.0, False), AT, 4) == ("none", 0)
    assert graph.n_links == 1  # 0 -> 1; 1 -> 0 is the same link


@given(shift=st.floats(-40, 40), n=st.sampled_from([21, 36]))
@settings(max_examples=50, deadline=None)
def test_the_distance_between_cells_is_that_on_the_torus(shift, n):
    bound = np.array([[0.0, 0.0, 0.0]])
    at = PoseEstimate(shift % n, 0.0, 0.0)
    action, _ = choose_action(at, 0.0, bound, np.array([8]), 8, 5, 2.0, (n, n, 36))
    ring = min(shift % n, n - shift % n)
    assert action == ("link" if ring <= 2.0 else "create")


def test_a_panoramic_view_is_bound_with_the_heading_it_was_learnt_with():
    graph = ExperienceMap(MapConfig(loops=0, initial_heading_deg=0.0))
    graph(Motion(0.0, 0.0, 1.0), new_view(0), AT, 0)
    turned = AT._replace(theta=(AT.theta + 9) % 36)  # a quarter turn to the left
    view = ViewMatch(0, 0.01, math.pi / 2, False)
    action, at = graph(Motion(0.0, math.pi / 2, 1.0), view, turned, 1)
    assert (action, at) == ("none", 0)
    assert graph.pose.theta_rad == pytest.approx(math.pi / 2)


def test_the_quickest_path_uses_durations_and_both_directions():
    graph = ExperienceMap(MapConfig())
    for step, seconds in enumerate([1.0, 10.0, 1.0, 1.0, 1.0]):
        graph.move(Motion(1.0, 0.0, seconds))
        graph.create(step, AT, frame=step)
    graph.move(Motion(1.0, 0.0, 2.0))
    graph.link(0)
    assert graph.plan(1, start=0).path == [0, 4, 3, 2, 1]
    assert graph.plan(1, start=0).duration_s == pytest.approx(5.0)
    assert graph.plan(0, start=4).path == [4, 0]
    assert graph.neighbours(0) == [1, 4]


def test_goals_are_visited_in_order_and_dropped_when_late():
    graph = square_lap(loops=0)
    graph.add_goal(2)
    graph.add_goal(5, timeout_s=3.0)
    assert graph.next_waypoint() == 1
    for _ in range(4):
        graph(Motion(0.0, 0.0, 1.0), ViewMatch(-1, -1.0, 0.0, False), AT, 99)
    assert graph.goals["experience"].tolist() == [2]
    graph.relocalise(2)
    graph._drop_finished_goals()
    assert graph.next_waypoint() is None
    with pytest.raises(MapError, match="time-out of a goal is -1"):
        graph.add_goal(1, timeout_s=-1)


def test_the_plan_to_an_unreachable_goal_has_the_reason():
    graph = ExperienceMap(MapConfig())
    graph.create(0, AT, frame=0)
    graph.state.current = -1
    graph.create(1, AT, frame=1)
    plan = graph.plan(0, start=1)
    assert plan.path == []
    assert "no links lead from experience 1 to 0" in plan.reason
    graph.add_goal(0)
    assert graph.next_waypoint() is None
    assert "goal 7 is not in a map of 2" in graph.plan(7).reason


def test_an_unreachable_goal_does_not_block_those_after_it():
    graph = square_lap(loops=0)
    apart = graph.n
    graph.state.current = -1
    graph.create(apart, AT, frame=apart)  # a part of the map that no link leads to
    graph.relocalise(0)
    for goal in (apart, 2):
        graph.add_goal(goal)
    assert graph.next_waypoint() == 1
    assert [(goal, bool(plan.path)) for goal, plan in graph.plans()] == [(apart, False), (2, True)]
    graph.relocalise(2)
    graph._drop_finished_goals()
    assert graph.goals["experience"].tolist() == [apart]
    assert graph.next_waypoint() is None
    ((_, plan),) = graph.plans()
    assert plan.reason == f"no links lead from experience 2 to {apart}"


def test_a_goal_passed_on_the_way_to_an_earlier_one_stays():
    graph = square_lap(loops=0)
    for goal in (3, 1):
        graph.add_goal(goal)
    graph.relocalise(1)
    graph._drop_finished_goals()
    assert graph.goals["experience"].tolist() == [3, 1]


def test_distance_and_bearing_are_seen_from_the_robot():
    graph = ExperienceMap(MapConfig(initial_heading_deg=90.0))
    graph.create(0, AT, frame=0)
    graph.move(Motion(3.0, 0.0, 1.0))
    distance, bearing = graph.distance_and_bearing(0)
    assert distance == pytest.approx(3.0)
    assert abs(bearing) == pytest.approx(math.pi)
    with pytest.raises(MapError, match="no experience 4, there are 1"):
        graph.distance_and_bearing(4)


def test_the_first_link_to_an_experience_closes_no_loop():
    graph = square_lap(loops=0)
    graph.move(Motion(1.0, 1.0, 1.0))
    graph.create(99, AT, frame=99)  # a branch from an old experience
    mask = closes_loop(*graph.links[:2])
    assert mask.sum() == 1
    assert (graph.links.source[mask], graph.links.target[mask]) == (15, 0)


def test_state_dict_is_complete():
    graph = square_lap(drift_rad=0.01)
    graph.add_goal(3)
    graph.move(Motion(0.3, 0.2, 1.0))
    copy = ExperienceMap(graph.config)
    copy.load_state_dict(graph.state_dict())
    for each in (graph, copy):
        each.relax(7)
        each.move(Motion(0.1, 0.1, 0.1))
        each.link(4)
        each.relax(3)
    for (name, a), b in zip(graph.state_dict().items(), copy.state_dict().values(), strict=True):
        assert torch.equal(a, b), name
    assert copy.pose == graph.pose
    assert isinstance(copy.pose, Pose)
