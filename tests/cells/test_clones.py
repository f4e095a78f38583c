"""Clone cells: where places look the same, the path decides; a row of rooms is not one room."""

import math

import numpy as np
import pytest
import torch

from neuroslam import BrainConfig, NavigationBrain, load_brain, save_brain
from neuroslam.cells.clone_steps import advance_belief_of_arrays, entropy_bits
from neuroslam.cells.clones import CloneCells
from neuroslam.config import MapConfig, build_config
from neuroslam.config.clones import CloneConfig
from neuroslam.errors import ConfigError
from neuroslam.mapping.experience import ExperienceMap
from neuroslam.state.join import Join
from neuroslam.state.renumbering import Renumbering
from neuroslam.types import Motion, PoseEstimate
from neuroslam.worlds.world import open_world

ROOM, N_ROOMS, STEP_M = 10, 5, 0.1
LINK_M = 0.4
"""Rooms of ten experiences that look the same; the last half of the last room does not."""


def look(at_m):
    """What is seen at a distance: the position in a room, and whether it is the marked one."""
    k = at_m / LINK_M
    return k % ROOM, k >= ROOM * N_ROOMS - 5


def errors_at(at_m, n):
    """Match errors with the experiences of the row, made one a link."""
    phase, marked = look(at_m)
    others = [look(k * LINK_M) for k in range(n)]
    off = np.array([min(abs(phase - p), ROOM - abs(phase - p)) for p, _ in others])
    same = np.array([m == marked for _, m in others])
    return np.where(same & (off < 2.0), 0.03 + 0.03 * off, 0.3)


def row_of_rooms(cells, n=ROOM * N_ROOMS):
    """A map of the row, made by driving it once; the cells saw it too."""
    map_ = ExperienceMap(MapConfig(loops=0))
    ahead = Motion(STEP_M / 0.1, 0.0, 0.1)
    for k in range(n):
        for _ in range(4):
            if k:
                cells.weigh(errors_at(k * LINK_M, map_.n), map_, ahead, False, False)
                map_.move(ahead)
        map_.create(k, PoseEstimate(0.0, 0.0, 0.0), k)
    return map_


def drive(cells, map_, begin_m, metres, tracks=True):
    """Drive on a known row; return the belief in the true place after each step."""
    ahead, here = Motion(STEP_M / 0.1, 0.0, 0.1), []
    for i in range(round(metres / STEP_M)):
        at_m = begin_m + (i + 1) * STEP_M
        cells.weigh(errors_at(at_m, map_.n), map_, ahead, tracks, False)
        near = np.abs(np.arange(map_.n) * LINK_M - at_m) < 1.2
        here.append(float(cells.clones.array("belief")[: map_.n][near].sum()))
    return np.array(here)


def test_the_belief_moves_as_far_as_the_robot_drives():
    source, target = np.arange(19), np.arange(1, 20)
    belief, since = np.zeros(20), np.zeros((20, 2))
    belief[2] = 1.0
    for _ in range(40):
        belief, since, left = advance_belief_of_arrays(
            belief, since, source, target, np.full(19, 0.5), np.zeros(19), (0.1, 0.0), 0.5
        )
        assert left == 0.0
    assert belief.sum() == pytest.approx(1.0)
    assert belief @ np.arange(20) == pytest.approx(2 + 4.0 / 0.5, abs=0.6)
    assert belief.max() > 0.25


def test_a_fork_is_decided_by_the_turn():
    source, target = np.array([0, 0]), np.array([1, 2])
    belief, since = np.array([1.0, 0.0, 0.0]), np.zeros((3, 2))
    facing = np.array([0.0, math.pi / 2])
    for _ in range(12):
        belief, since, _ = advance_belief_of_arrays(
            belief, since, source, target, np.ones(2), facing, (0.1, math.pi / 20), 9.0
        )
    assert belief[2] > 5.0 * belief[1]


def test_new_rooms_are_not_the_first_room_and_the_population_begins_to_vote():
    cells = CloneCells()
    assert not cells.votes
    assert cells.supports(-1)
    map_ = row_of_rooms(cells, 4 * ROOM)
    assert cells.unknown > 0.9
    assert cells.votes
    assert not any(cells.supports(k) for k in range(map_.n))
    assert cells.proposes() in (-1, None)


def test_where_nothing_repeats_it_abstains():
    cells, map_ = CloneCells(), ExperienceMap(MapConfig(loops=0))
    ahead = Motion(1.0, 0.0, 0.1)
    for k in range(40):
        for _ in range(4):
            cells.weigh(np.full(map_.n, 0.3), map_, ahead, False, False)
            map_.move(ahead)
        map_.create(k, PoseEstimate(0.0, 0.0, 0.0), k)
    assert not cells.votes
    assert cells.supports(3)
    assert cells.reaches(3)
    assert cells.proposes() is None
    assert not cells.splits(map_)


def test_a_kidnapping_that_no_view_shows_is_found_at_the_mark():
    cells = CloneCells()
    map_ = row_of_rooms(cells)
    map_.relocalise(2)
    cells._spread_out()
    cells.now.unknown, cells.now.fixed_m = 0.0, cells.now.odometer_m
    cells.clones.array("copy")[:] = 0.0
    begin_m = 2 * ROOM * LINK_M
    blind = drive(cells, map_, begin_m, 4.0)
    assert blind[-1] < 0.6  # three rooms ahead still look the same
    assert cells.entropy_bits > 1.0
    found = drive(cells, map_, begin_m + 4.0, 7.5)
    assert found[-1] > 0.95
    assert cells.supports(cells.now.best)
    assert cells.entropy_bits < 1.0


def test_entropy_is_none_where_the_place_is_known():
    assert entropy_bits(np.array([0.0, 1.0]), 0.0) == pytest.approx(0.0, abs=1e-9)


def test_a_merge_keeps_the_belief_under_new_ids():
    cells = CloneCells()
    row_of_rooms(cells, 21)
    cells.clones.array("belief")[:] = 0.0
    cells.clones.array("belief")[[3, 7]] = 0.25, 0.75
    cells.clones.array("copy")[:], cells.now.unknown, cells.now.best = 0.0, 0.0, 7
    ids = np.concatenate([np.arange(5), np.arange(30, 45)])  # the first five are loaded ones
    join = Join.nothing()._replace(experiences=ids, n_experiences=30)
    merged = cells.merged(CloneCells().state_dict(), cells.state_dict(), join)
    assert merged["clones.belief"][[3, 32]].tolist() == [0.25, 0.75]
    assert float(merged["clones.belief"].sum()) == 1.0
    assert int(merged["now.best"]) == 32
    state = {name: value.numpy() for name, value in merged.items()}
    assert not list(CloneCells.faults(state, BrainConfig(), 45, 45))


def test_a_map_that_forgets_takes_the_belief_along():
    cells = CloneCells()
    row_of_rooms(cells, 21)  # a row for each experience that a frame was compared with
    cells.clones.array("belief")[:] = 1.0 / 20
    kept = np.arange(0, 20, 2)
    halves = np.arange(20) // 2
    change = Renumbering(halves, halves, kept, kept, np.zeros((20, 3)))
    cells.renumber(change)
    assert cells.clones.array("belief").tolist() == pytest.approx([0.1] * 10)


def test_faults_are_named():
    cells = CloneCells()
    row_of_rooms(cells, 21)
    state = {name: value.numpy().copy() for name, value in cells.state_dict().items()}
    state["clones.belief"][2] += 0.5
    assert "expected 1" in " ".join(CloneCells.faults(state, BrainConfig(), 20, 20))
    assert "20 rows for 5" in " ".join(CloneCells.faults(state, BrainConfig(), 20, 5))


def test_a_resumed_brain_continues_bit_for_bit(tmp_path):
    config = build_config({
        "cells": "pose+clones", "view": {"template_width": 16, "template_height": 12},
        "clones": {"notice": 0.0, "notice_share": 0.0}, "sequence": {"min_experiences": 5},
    })  # fmt: skip
    frames = list(open_world("world:corners?laps=1.3&frames_per_lap=90&width=48&height=24"))
    whole, half = NavigationBrain(config), NavigationBrain(config)
    for frame in frames:
        whole(frame)
    for frame in frames[:95]:
        half(frame)
    save_brain(half, tmp_path / "half.safetensors")
    resumed = load_brain(tmp_path / "half.safetensors")
    for frame in frames[95:]:
        resumed(frame)
    expected, got = whole.state_dict(), resumed.state_dict()
    assert expected.keys() == got.keys()
    assert all(torch.equal(expected[name], got[name]) for name in expected)
    assert whole.clones.scalars()["clones/entropy_bits"] >= 0.0
    assert np.shape(whole.clones.images()["cells/clones"]) == (64, 64)


def test_sequences_close_loops_where_the_population_takes_part():
    assert NavigationBrain(BrainConfig(cells=("pose", "clones"))).tracker is not None
    assert NavigationBrain(BrainConfig(cells=("pose",))).tracker is None


def test_a_rate_below_zero_is_refused():
    with pytest.raises((ConfigError, ValueError), match="kidnaps"):
        CloneConfig(kidnaps=-1.0)
