"""Mutual corrections of populations: who says what, and who follows it by how much."""

import math
from copy import deepcopy
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import tensor

from neuroslam.brain import NavigationBrain
from neuroslam.brain.compass import Compass
from neuroslam.cells.familiarity import Familiarity
from neuroslam.cells.head_direction import HeadDirectionCells, Heard
from neuroslam.cells.navigation import NavigationCells
from neuroslam.cells.pose import PoseCellNetwork
from neuroslam.config import (
    BoundaryCellConfig,
    BrainConfig,
    MapConfig,
    PoseCellConfig,
    build_config,
)
from neuroslam.config.populations import registered
from neuroslam.config.semantic import SemanticConfig
from neuroslam.geometry import wrap_angle
from neuroslam.mapping.experience import ExperienceMap
from neuroslam.spiking.semantic import SemanticCells
from neuroslam.spiking.sightings import Sightings
from neuroslam.state.join import Join
from neuroslam.state.population import Belief, Correction, Population, StepInput, total
from neuroslam.state.registry import register
from neuroslam.types import NO_TEMPLATE, Frame, Motion, Pose, Velocity, ViewMatch

EAST_M = 0.1
ANGLES = st.floats(-math.pi, math.pi)
SMALL = st.floats(-0.3, 0.3)
BLIND = ViewMatch(NO_TEMPLATE, -1.0, 0.0, False)
STILL = StepInput(0, Motion(0.0, 0.0, 0.1), BLIND)
CORRECTIONS = st.builds(Correction, dx_m=SMALL, dy_m=SMALL, turn_rad=SMALL, heading_rad=ANGLES)


def towards_east(true_rad: float, own_rad: float) -> tuple[float, float]:
    """0.1 m to the east of the world, in a frame in which a heading is ``own_rad``."""
    apart = own_rad - true_rad
    return EAST_M * math.cos(apart), EAST_M * math.sin(apart)


def east(true_rad: float, author_rad: float, **more) -> Correction:
    """The robot is 0.1 m farther to the east, as an author says with a frame of its own."""
    return Correction(*towards_east(true_rad, author_rad), heading_rad=author_rad, **more)


# --- every follower, whatever its own frame -----------------------------------------------------


@settings(max_examples=20, deadline=None)
@given(true=ANGLES, author=ANGLES, own=ANGLES)
def test_pose_cells_follow_to_the_east_whatever_their_frame(true, author, own):
    cells = PoseCellNetwork(PoseCellConfig())
    cells.nudge(0.0, 0.0, (own - cells.heading_rad) * cells.config.n_theta / math.tau)
    before = cells.estimate
    cells.follow(east(true, author, turn_rad=0.05))
    after, turned = cells.estimate, cells.heading_rad
    moved = [(b - a) * cells.config.cell_size_m for a, b in zip(before[:2], after[:2], strict=True)]
    assert moved == pytest.approx(towards_east(true, own), abs=2e-3)
    assert wrap_angle(turned - own) == pytest.approx(0.05, abs=2e-3)


@given(true=ANGLES, author=ANGLES, own=ANGLES, turn=SMALL)
def test_the_map_follows_to_the_east_whatever_its_frame(true, author, own, turn):
    map_ = ExperienceMap(MapConfig())
    map_.set_pose(Pose(2.0, -1.0, own))
    map_.follow(east(true, author, turn_rad=turn))
    x, y, heading = map_.pose
    assert (x - 2.0, y + 1.0) == pytest.approx(towards_east(true, own), abs=1e-12)
    assert wrap_angle(heading - own - turn) == pytest.approx(0.0, abs=1e-12)


@settings(max_examples=15, deadline=None)
@given(true=ANGLES, author=ANGLES, own=ANGLES)
def test_navigation_cells_that_are_carried_go_to_the_east_whatever_their_frame(true, author, own):
    cells = navigation()
    cells.now.heading_rad = own
    cells.follow(east(true, author, relocalises=True))
    x, y, heading = cells.pose
    assert (x, y) == pytest.approx(towards_east(true, own), abs=1e-6)
    assert wrap_angle(heading - own) == pytest.approx(0.0, abs=1e-12)


def test_navigation_cells_go_where_the_robot_was_carried_and_are_as_sure_as_who_told_it():
    cells = navigation()
    cells.follow(Correction(9.0, position_m=(0.5, -0.3), sigma_m=0.2, relocalises=True))
    assert cells.pose[:2] == pytest.approx((0.5, -0.3), abs=1e-6)
    assert cells.variance_m2 == pytest.approx(0.04)


def test_navigation_cells_do_not_follow_small_corrections_of_others():
    cells = navigation()
    before = state_of(cells)
    cells.follow(Correction(0.1, 0.2, 0.1, 0.3))
    assert changed(before, cells) == []


@given(true=ANGLES, author=ANGLES, own=ANGLES)
def test_a_population_of_ones_own_is_told_the_displacement_in_its_own_frame(true, author, own):
    told = east(true, author).displacement(own)
    assert told == pytest.approx(towards_east(true, own), abs=1e-12)


@settings(max_examples=15, deadline=None)
@given(own=ANGLES, turn=SMALL, author=ANGLES)
def test_head_direction_cells_turn_by_what_others_turn_whatever_the_frames(own, turn, author):
    cells = HeadDirectionCells()
    cells.place(own)
    cells.follow(Correction(0.3, 0.2, turn, heading_rad=author))
    assert wrap_angle(cells.heading_rad - own - turn) == pytest.approx(0.0, abs=1e-3)


def test_head_direction_cells_do_not_turn_when_others_only_move():
    cells = HeadDirectionCells()
    before = state_of(cells)
    cells.follow(Correction(0.3, 0.2, 0.0, heading_rad=1.0))
    assert changed(before, cells) == []


@pytest.mark.parametrize("off", [0.2, -0.2])
def test_head_direction_cells_tell_by_how_much_the_compass_has_turned_them(off):
    cells = HeadDirectionCells()
    first = cells.step(STILL, Heard(1.0))
    assert first.turn_rad == 0.0  # the first reading says how the ring lies: nobody has to follow
    assert cells.heading_rad == pytest.approx(1.0, abs=1e-3)
    before = cells.heading_rad
    told = cells.step(STILL, Heard(1.0 + off))
    assert told == Correction(turn_rad=told.turn_rad)
    assert told.turn_rad == pytest.approx(cells.heading_rad - before, abs=1e-9)
    assert told.turn_rad == pytest.approx(off * -math.expm1(-0.1 / 2.0), rel=0.1)
    assert cells.step(STILL, None).is_nothing


@pytest.mark.parametrize("turn", [0.4, -0.4])
def test_the_compass_turns_the_map_within_two_seconds(turn):
    compass = Compass()
    assert compass.step(None, STILL.motion) is None
    assert not compass.step(3.0, STILL.motion).moves
    told = compass.step(wrap_angle(3.0 + turn), STILL.motion)
    assert told == Correction(turn_rad=pytest.approx(turn * (1.0 - math.exp(-0.1 / 2.0))))
    for _ in range(400):
        compass.step(wrap_angle(3.0 + turn), STILL.motion)
    assert wrap_angle(compass.heading_rad - 3.0 - turn) == pytest.approx(0.0, abs=1e-6)


def test_the_compass_agrees_with_a_robot_that_turns_as_it_says():
    compass, motion = Compass(), Motion(0.0, 0.5, 0.1)
    compass.step(0.0, motion)
    assert compass.step(None, motion) is None  # no reading: it turns with the robot
    assert compass.step(0.1, motion).turn_rad == pytest.approx(0.0, abs=1e-12)


# --- corrections of one instant -----------------------------------------------------------------


@given(corrections=st.lists(CORRECTIONS, min_size=1, max_size=4), heading=ANGLES)
def test_corrections_of_one_instant_add_whatever_the_frames_of_their_authors(corrections, heading):
    both = total(corrections)
    each = np.array([c.displacement(heading) for c in corrections])
    assert both.displacement(heading) == pytest.approx(each.sum(0), abs=1e-12)
    assert both.turn_rad == pytest.approx(sum(c.turn_rad for c in corrections), abs=1e-12)


def test_the_first_absolute_position_counts_with_the_error_of_who_told_it():
    some = [
        Correction(turn_rad=0.1),
        Correction(0.2, 0.0, heading_rad=1.0),
        Correction(0.0, 0.3, 0.0, 1.0, (1.0, 2.0), sigma_m=0.1, variance_m2=0.02),
        Correction(0.0, 0.0, 0.0, 0.0, (9.0, 9.0), sigma_m=0.9, relocalises=True),
    ]
    assert total(some) == Correction(0.2, 0.3, 0.1, 1.0, (1.0, 2.0), 0.1, 0.02, relocalises=True)
    assert not total(some[:3]).relocalises


def test_who_tells_a_place_or_that_the_robot_was_carried_has_said_something():
    assert Correction(heading_rad=1.0, sigma_m=0.1).is_nothing
    for more in ({"position_m": (0.0, 0.0)}, {"relocalises": True}, {"turn_rad": -1e-9}):
        assert not Correction(**more).is_nothing


# --- in a brain ---------------------------------------------------------------------------------


class Told(Population):
    """Says, in each frame, what the test has it say, and notes what it is told."""

    def __init__(self) -> None:
        super().__init__()
        self.says = self.recalls = Correction()
        self.heard = []

    def step(self, now, observation):
        return self.says

    def recall(self, now, observation, belief):
        return self.recalls

    def follow(self, correction):
        self.heard.append(correction)


@pytest.fixture
def others():
    """Two kinds of populations that say what they are told to."""
    for kind in ("told", "told_too"):
        register(kind)(type(Told)(kind.title(), (Told,), {"__module__": __name__}))
    yield
    for kind in ("told", "told_too"):
        registered.pop(kind)


def brain_with(cells: str, **says) -> NavigationBrain:
    brain = NavigationBrain(build_config({"cells": cells, "map": {"initial_heading_deg": 0.0}}))
    for name, correction in says.items():
        kind, _, where = name.partition("__")
        setattr(brain.populations[kind], where or "says", correction)
    return brain


def frame(i: int = 0, picture: np.ndarray | None = None) -> Frame:
    return Frame(i, 0.1 * i, picture, Velocity(0.0, 0.0))


def picture_of(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (40, 64), dtype=np.uint8)


def test_all_in_a_brain_move_to_the_east_but_for_who_said_so(others):
    brain, still = brain_with("pose+head_direction+told+told_too"), brain_with("pose")
    heading = brain.map.pose.theta_rad
    brain.told.says = east(heading, 2.0, turn_rad=0.05)  # the author's frame is another
    for one in (brain, still):
        one(frame())
    size = brain.config.pose_cells.cell_size_m
    assert np.subtract(brain.map.pose, still.map.pose) == pytest.approx([0.1, 0.0, 0.05])
    cells, alone = brain.pose_cells, still.pose_cells
    moved = size * np.subtract(cells.estimate[:2], alone.estimate[:2])
    assert moved == pytest.approx(towards_east(heading, alone.heading_rad), abs=2e-3)
    assert wrap_angle(cells.heading_rad - alone.heading_rad) == pytest.approx(0.05, abs=2e-3)
    assert brain.head_direction.heading_rad == pytest.approx(0.05, abs=1e-3)
    assert [c.displacement(-0.3) for c in brain.told_too.heard] == [
        pytest.approx(towards_east(heading, -0.3))
    ]
    assert brain.told.heard == []


def test_nobody_follows_its_own_correction_in_a_sum(others):
    one, other = Correction(0.1, turn_rad=0.1), Correction(0.0, 0.2, turn_rad=0.01)
    brain = brain_with("pose+told+told_too", told=one, told_too=other)
    brain(frame())
    assert brain.told.heard == [other]
    assert brain.told_too.heard == [one]


def test_turns_of_walls_and_compass_add_on_the_map(others):
    brain = brain_with(
        "pose+head_direction+told+told_too",
        told=Correction(turn_rad=0.1), told_too=Correction(turn_rad=0.02),
    )  # fmt: skip
    before = brain.map.pose.theta_rad
    brain(frame())
    assert brain.map.pose.theta_rad - before == pytest.approx(0.12)
    assert brain.head_direction.heading_rad == pytest.approx(0.12, abs=1e-3)


def test_corrections_of_one_instant_are_summed_before_one_nudge(others, monkeypatch):
    nudges = []
    monkeypatch.setattr(ExperienceMap, "follow", lambda _, told: nudges.append(told))
    monkeypatch.setattr(PoseCellNetwork, "follow", lambda _, told: nudges.append(told))
    says = [Correction(0.1, 0.0, 0.1), Correction(0.0, 0.1, 0.02, heading_rad=math.pi / 2)]
    brain = brain_with("pose+told+told_too", told=says[0], told_too=says[1])
    brain(frame())
    assert nudges == [total(says)] * 2  # the map's, and the pose cells'
    assert nudges[0][:3] == pytest.approx((0.2, 0.0, 0.12))


def test_what_is_recalled_is_told_by_one_after_the_other(others):
    says = [Correction(0.1), Correction(0.0, 0.1)]
    brain = brain_with("pose+told+told_too", told__recalls=says[0], told_too__recalls=says[1])
    brain(frame())
    assert brain.told.heard == says[1:]
    assert brain.told_too.heard == says[:1]
    assert brain.map.pose[:2] == pytest.approx((0.1, 0.1))


def test_the_first_correction_is_applied_after_the_map_has_acted(others):
    brain = brain_with("pose+told", told=Correction(0.1, heading_rad=0.0, turn_rad=0.2))
    result = brain(frame(0, picture_of(0)))
    assert result.action == "create"
    assert brain.map.poses[0].tolist() == [0.0, 0.0, 0.0]  # made where the robot was believed
    assert brain.map.pose == pytest.approx((0.1, 0.0, 0.2))
    assert result.cells.theta == brain.map.experiences["cell"][0, 2].item()


def test_where_place_cells_lead_the_map_shows_what_corrections_made_of_them(others):
    there = (0.4, 0.3)
    brain = brain_with("place+told", told=Correction(position_m=there, relocalises=True))
    result = brain(frame())
    assert brain.navigation.pose[:2] == pytest.approx(there, abs=1e-6)
    assert brain.map.pose[:2] == result.cells[:2] == brain.navigation.pose[:2]


@pytest.mark.parametrize(
    ("cells", "leader"), [("pose+place", "pose"), ("place", "place"), ("place+semantic", "place")]
)
def test_only_the_leader_gets_the_absolute_position(cells, leader, others, monkeypatch):
    told = {}
    for kind in (PoseCellNetwork, NavigationCells):
        monkeypatch.setattr(kind, "follow", lambda self, c: told.setdefault(self.kind, c))
    says = Correction(0.1, position_m=(1.0, 2.0), sigma_m=0.1)
    brain = brain_with(f"{cells}+told+told_too", told=says)
    brain(frame())
    assert told.pop(leader).position_m == (1.0, 2.0)
    rest = [c.position_m for c in (*told.values(), *brain.told_too.heard)]
    assert rest == [None] * len(rest) != []


def test_a_correction_of_nothing_is_told_to_nobody(others):
    brain = brain_with("pose+told+told_too", told=Correction(heading_rad=2.0, sigma_m=0.3))
    brain(frame())
    assert brain.told_too.heard == []


@pytest.mark.parametrize("cells", ["pose+place", "pose+semantic", "pose+place+semantic"])
def test_the_map_turns_by_the_compass_once_whoever_hears_it(cells):
    turns = {}
    for kinds in (cells, f"{cells}+head_direction"):
        brain = brain_with(kinds)
        for i, heading in enumerate([1.0, *[1.3] * 10]):
            brain(frame(i)._replace(heading_rad=heading))
        turns[kinds] = brain.map.pose.theta_rad
    expected = 0.3 * (1.0 - math.exp(-1.0 / 2.0))
    assert turns[cells] == pytest.approx(expected, abs=1e-9)
    assert turns[f"{cells}+head_direction"] == pytest.approx(expected, rel=0.1)


def test_a_brain_of_views_alone_ignores_the_compass():
    brain = brain_with("pose")
    for i, heading in enumerate([1.0, 2.0]):
        brain(frame(i)._replace(heading_rad=heading))
    assert brain.map.pose.theta_rad == 0.0


# --- landmarks ----------------------------------------------------------------------------------


@cache
def fresh() -> NavigationCells:
    return NavigationCells(BrainConfig())


def navigation(sigma_m: float = 0.0) -> NavigationCells:
    """Navigation cells at the origin, unsure of their place by so much."""
    cells = deepcopy(fresh())
    cells.walls.forget_position(sigma_m)
    return cells


def state_of(module: torch.nn.Module) -> dict[str, torch.Tensor]:
    return {name: value.clone() for name, value in module.state_dict().items()}


def changed(before: dict[str, torch.Tensor], module: torch.nn.Module) -> list[str]:
    after = module.state_dict()
    assert before.keys() == after.keys()
    return [name for name, value in after.items() if not torch.equal(before[name], value)]


SURE = st.floats(0.01, 0.2)


@settings(max_examples=15, deadline=None)
@given(learnt=SURE, sigma=SURE, more=st.floats(1.01, 3.0), x=SMALL, y=SMALL)
def test_a_landmark_makes_no_one_surer_than_who_learnt_it_was(learnt, sigma, more, x, y):
    then = learnt**2 + sigma**2
    cells = navigation(more * math.sqrt(then))
    now = cells.variance_m2
    assert now == pytest.approx(more**2 * then)
    off = 0.5 * math.sqrt(now)  # well inside of what it may be off by
    place = (off * x, off * y)
    assert cells.update_from_landmark(place, sigma, learnt**2)
    assert cells.variance_m2 == pytest.approx(then, rel=1e-9)
    share = 1.0 - then / now
    assert cells.pose[:2] == pytest.approx((share * place[0], share * place[1]), abs=1e-6)


@settings(max_examples=15, deadline=None)
@given(learnt=SURE, sigma=st.floats(0.0, 0.2), x=SMALL, y=SMALL)
def test_to_look_again_at_what_was_learnt_a_moment_ago_tells_nothing(learnt, sigma, x, y):
    cells = navigation(learnt)
    before = state_of(cells)
    assert cells.update_from_landmark((x, y), sigma, cells.variance_m2)
    assert changed(before, cells) == []


def test_a_landmark_that_puts_the_robot_too_far_away_is_not_believed():
    cells = navigation(0.1)
    limit = cells.config.wall_memory.gate * math.sqrt(2.0 * 0.01 + 0.05**2)
    before = state_of(cells)
    assert not cells.update_from_landmark((1.01 * limit, 0.0), 0.05, 0.0)
    assert changed(before, cells) == []
    assert cells.update_from_landmark((0.99 * limit, 0.0), 0.05, 0.0)
    assert cells.pose.x_m > 0.5 * limit


def test_where_place_cells_lead_a_landmark_is_told_with_its_errors():
    cells, twin = navigation(0.3), navigation(0.3)
    cells.follow(Correction(position_m=(0.1, 0.2), sigma_m=0.1, variance_m2=0.02))
    twin.update_from_landmark((0.1, 0.2), 0.1, 0.02)
    assert changed(state_of(twin), cells) == []
    assert cells.variance_m2 == pytest.approx(0.03)


def taught(follows: str = "map", seconds: int = 6) -> SemanticCells:
    """Cells that know a landmark 2 m to the east of where they are, and one to the north."""
    cells = SemanticCells(SemanticConfig(), follows=follows)
    for _ in range(10 * seconds):
        cells.recall(STILL, posts((0.0, 0.0)), belief_at(0.0, 0.0, follows))
    return cells


def posts(at: tuple[float, float], heading: float = 0.0) -> Sightings:
    rows = [
        (k, math.hypot(x - at[0], y - at[1]), math.atan2(y - at[1], x - at[0]) - heading)
        for k, (x, y) in enumerate([(2.0, 0.0), (0.0, 2.0)])
    ]
    return Sightings.of(np.array(rows))


def belief_at(x: float, y: float, follows: str = "map", heading: float = 0.0) -> Belief | None:
    if follows == "nothing":
        return None
    here = Pose(x, y, heading)
    if follows == "cells":
        return Belief(here, 0.04)
    return Belief(here, 0.0, 0, np.zeros((1, 3)))


@pytest.mark.parametrize("drift", [(0.15, 0.0), (0.0, -0.15)])
def test_known_landmarks_bring_a_map_back_that_has_drifted(drift):
    cells, here = taught(), np.array(drift)
    for _ in range(60):
        told = cells.recall(STILL._replace(compass_rad=0.0), posts((0.0, 0.0)), belief_at(*here))
        here += told[:2]
    assert np.hypot(*here) < 0.05


@pytest.mark.parametrize("follows", ["map", "cells"])
@pytest.mark.parametrize("heading", [0.0, 1.2, -2.5])
def test_what_landmarks_correct_is_told_in_the_frame_of_the_belief(follows, heading):
    cells = taught(follows)
    now = STILL._replace(compass_rad=heading)
    told = cells.recall(now, posts((0.0, 0.0), heading), belief_at(0.05, 0.0, follows, heading))
    assert told.heading_rad == heading


def test_beside_place_cells_landmarks_tell_a_place_and_its_errors_and_move_nobody_themselves():
    cells = taught("cells", seconds=1)
    told = [cells.recall(STILL, posts((0.0, 0.0)), belief_at(0.1, 0.1, "cells")) for _ in range(60)]
    assert all(not c.moves for c in told)
    where = [c for c in told if c.position_m is not None]
    assert where
    assert len(where) < len(told)  # each is told once, while it is attended to
    for c in where:
        assert c.position_m == pytest.approx((0.0, 0.0), abs=0.1)
        assert c.sigma_m == cells.config.sigma_m
        assert c.variance_m2 == pytest.approx(0.04)  # of the belief when it was learnt


def test_landmarks_that_two_sessions_saw_were_seen_as_often_as_in_both():
    one, other = taught("nothing"), taught("nothing", seconds=3)
    seen = [cells.known["seen"].clone() for cells in (one, other)]
    assert seen[0].tolist() != seen[1].tolist()
    merged = one.merged(one.state_dict(), other.state_dict(), Join.nothing())
    assert merged["known.number"].tolist() == [0, 1]
    assert merged["known.seen"].tolist() == (seen[0] + seen[1]).tolist()


# --- doubt --------------------------------------------------------------------------------------


def feel(familiarity: Familiarity, seconds: float, *, against: bool = False, agrees: bool = False):
    none = tensor([[math.inf]]), tensor([[0.0]])
    for _ in range(round(seconds / 0.5)):
        familiarity(tensor([0]), *none, (tensor([against]), tensor([agrees])), 0.5)
    return SimpleNamespace(doubt_s=familiarity.doubt_s.item(), lost=familiarity.lost.item())


def test_what_agrees_takes_back_three_twentieths_of_the_doubt_that_as_much_against_makes():
    familiarity = Familiarity(BoundaryCellConfig(), lost_after_s=9.0)
    assert feel(familiarity, 4.0, against=True).doubt_s == pytest.approx(4.0)
    assert feel(familiarity, 10.0).doubt_s == pytest.approx(4.0)  # nothing felt: it stays
    assert feel(familiarity, 10.0, agrees=True).doubt_s == pytest.approx(4.0 - 0.15 * 10.0)
    assert feel(familiarity, 60.0, agrees=True).doubt_s == 0.0


def test_what_contradicts_and_agrees_at_once_contradicts():
    familiarity = Familiarity(BoundaryCellConfig(), lost_after_s=9.0)
    assert feel(familiarity, 4.0, against=True, agrees=True).doubt_s == pytest.approx(4.0)


def test_who_is_lost_is_so_until_all_doubt_is_gone():
    familiarity = Familiarity(BoundaryCellConfig(), lost_after_s=2.0)
    assert not feel(familiarity, 2.0, against=True).lost
    assert feel(familiarity, 0.5, against=True).lost
    assert feel(familiarity, 16.0, agrees=True).lost  # 2.5 s of doubt less 2.4 s
    assert not feel(familiarity, 1.0, agrees=True).lost
