"""Pose cells in x, y, z and heading: attractors, heights of the map, storeys that look alike."""

import copy
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neuroslam import NavigationBrain, load_brain, save_brain
from neuroslam.brain.forgetting import renumber
from neuroslam.brain.soundness import faults_of
from neuroslam.cells.grid_3d import GridCells3D
from neuroslam.cells.pose_3d import Pose3DConfig, PoseCells3D
from neuroslam.cells.yaw_height import YawHeightCells, settle_sheet, shift_sheet
from neuroslam.config import PoseCellConfig, build_config, merge_values, read_preset
from neuroslam.errors import BadFrame, ConfigError, MapError
from neuroslam.geometry import TWO_PI
from neuroslam.runs.files import experiences_csv, more_columns
from neuroslam.state.match import Match, Pairs
from neuroslam.state.population import Correction
from neuroslam.types import Frame, Motion, Pose, Revoked, Velocity, ViewMatch
from neuroslam.worlds.world import open_world

EXACT = PoseCellConfig(precision="float64", cell_size_m=0.5)
SPEEDS = st.floats(-1.0, 1.0)
PLACES, STOREY_M, DT_S = 48, 3.0, 0.1
PICTURES = np.random.default_rng(0).integers(0, 256, (3, PLACES, 10, 60)).astype(np.uint8)
"""Of the places of a storey, equal on all; of the ramp up and of the ramp down."""


def apart(a, b, n):
    return (a - b + n / 2) % n - n / 2


# --- attractors ------------------------------------------------------------------------------


def test_a_rise_and_a_fall_end_where_they_began():
    cells = PoseCells3D(EXACT)
    start = cells.estimate_3d
    for up in [0.8] * 25 + [-0.8] * 25:
        cells.integrate(Motion(0.0, 0.0, DT_S), up)
    np.testing.assert_allclose(cells.estimate_3d, start, atol=0.02)


@given(v=SPEEDS, w=SPEEDS, up=SPEEDS)
@settings(max_examples=15, deadline=None)
def test_the_estimate_follows_odometry_in_all_four_directions(v, w, up):
    cells = PoseCells3D(EXACT)
    at = np.array(cells.estimate_3d)
    for _ in range(20):
        heading = TWO_PI * at[3] / 36
        step = v * math.cos(heading) / 5, v * math.sin(heading) / 5, up / 5
        at += (*step, w * DT_S * 36 / TWO_PI)
        found = cells.integrate(Motion(v, w, DT_S), up)
    sizes = np.array([21, 21, 21, 36])
    assert np.abs(apart(np.array(found), at, sizes)).max() < 0.3
    assert abs(apart(cells.sheet.estimate[0], at[2], 21)) < 0.3  # both networks know the height


def test_height_and_heading_have_no_end():
    cells = YawHeightCells(EXACT, n_z=9)
    start = cells.activity
    for _ in range(9):
        moved = shift_sheet(cells.activity, 1.0, 4.0)
        cells.activity = moved
    torch.testing.assert_close(cells.activity, start)


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_a_batch_gives_what_each_robot_gives_alone(precision):
    config = EXACT.model_copy(update={"precision": precision})
    together = PoseCells3D(config, batch=3)
    alone = [PoseCells3D(config) for _ in range(3)]
    v, w, up = torch.tensor([[0.5, -0.3, 0.0], [0.4, 0.0, -1.0], [0.0, 0.6, -0.4]]).double()
    for _ in range(12):
        found = together.integrate(Motion(v, w, DT_S), up)
        for one, motion in zip(alone, zip(v, w, up, strict=True), strict=True):
            a, b, c = (m.item() for m in motion)
            one.integrate(Motion(a, b, DT_S), c)
    expected = torch.tensor([one.estimate_3d for one in alone], dtype=torch.float64)
    torch.testing.assert_close(
        found.double(), expected, atol=2e-3 if precision == "float32" else 1e-7, rtol=0.0
    )


def test_activity_stays_non_negative_with_sum_1():
    sheet = torch.rand(2, 9, 12, dtype=torch.float64)
    cells = YawHeightCells(EXACT.model_copy(update={"n_theta": 12}), n_z=9)
    settled = settle_sheet(sheet, cells.kernels, 1e-6)
    moved = shift_sheet(settled, torch.tensor([0.3, -2.7]), 5.5)
    for activity in (settled, moved):
        assert activity.min() >= 0.0
        torch.testing.assert_close(activity.sum((1, 2)), torch.ones(2, dtype=torch.float64))


def test_gradients_pass_through_a_step_of_the_sheet():
    cells, by = YawHeightCells(EXACT, n_z=9), torch.tensor(0.4, requires_grad=True)
    settled = settle_sheet(cells.activity, cells.kernels, 1e-6)
    shift_sheet(settled, by.double(), 0.0)[5].sum().backward()
    assert by.grad is not None
    assert by.grad > 0.0


def test_inhibition_above_all_activity_is_an_error():
    config = EXACT.model_copy(update={"global_inhibition": 1.0})
    for cells, step in (
        (GridCells3D(config, 9), (0.0,) * 3),
        (YawHeightCells(config, 9), (0.0,) * 2),
    ):
        with pytest.raises(MapError, match="inhibition silenced every cell"):
            cells(*step)


def test_a_view_brings_height_and_heading_back():
    cells = PoseCells3D(EXACT.model_copy(update={"inject_after": 0, "inject_energy": 0.4}))
    bound = cells.estimate_3d
    cells.update_from_view(ViewMatch(0, -1.0, 0.0, True))
    for _ in range(10):
        cells.integrate(Motion(0.2, 0.3, DT_S), 1.0)
    assert abs(cells.estimate_3d.z - bound.z) > 1.5
    for _ in range(12):
        cells.update_from_view(ViewMatch(0, 0.0, 0.0, False))
        cells.update_from_view(ViewMatch(-1, -1.0, 0.0, False))  # so that it does not tire
        cells.integrate(Motion(0.0, 0.0, DT_S))
    np.testing.assert_allclose(cells.estimate_3d, bound, atol=0.2)
    assert cells.sheet.estimate[0] == pytest.approx(bound.z, abs=0.2)


def test_a_correction_to_the_east_moves_the_activity_there():
    cells = PoseCells3D(EXACT)
    before, heading = cells.estimate_3d, TWO_PI * cells.estimate_3d.theta / 36
    cells.follow(Correction(dx_m=0.1, turn_rad=TWO_PI / 36, heading_rad=heading))
    after = cells.estimate_3d
    np.testing.assert_allclose(np.subtract(after, before), (0.2, 0.0, 0.0, 1.0), atol=0.01)


# --- a brain on storeys that look alike ------------------------------------------------------


def drive(storeys, drift=0.0):
    """A lap of a ring on each storey, the same pictures on all; the last eighth is the ramp."""
    heights, pictures, level = [], [], PLACES - PLACES // 8
    for storey, following in zip(storeys, [*storeys[1:], storeys[-1]], strict=True):
        rise = np.linspace(0.0, following - storey, PLACES // 8 + 1)[1:]
        heights += [storey] * level + (storey + rise).tolist()
        pictures += [*PICTURES[0, :level], *PICTURES[following - storey, level:]]
    z = STOREY_M * np.array(heights, dtype=float)
    climbs = np.diff(z, prepend=z[:1]) / DT_S * (1.0 + drift)
    turn = TWO_PI / PLACES / DT_S
    frames = [
        Frame(i, i * DT_S, pictures[i], Velocity(4.0, turn * (i > 0)), v_z_m_s=float(up))
        for i, up in enumerate(climbs)
    ]
    return frames, z


def brain_3d(**more):
    values = merge_values(read_preset("neuroslam_3d"), {"view": {"template_height": 10}, **more})
    return NavigationBrain(build_config(values))


def confused(brain, frames, z):
    """Frames at which the robot is believed to be on another storey than it is."""
    at = [brain(frame).experience for frame in frames]
    return int((np.abs(z[brain.map.experiences.array("first_frame")[at]] - z) > STOREY_M / 2).sum())


TOUR = [0, 1, 2, 2, 1, 0, 0]


@pytest.mark.parametrize("drift", [0.0, 0.1])
def test_storeys_that_look_alike_are_not_confused(drift):
    frames, z = drive(TOUR, drift)
    brain = brain_3d()
    assert confused(brain, frames, z) == 0
    assert brain.view.n == brain.map.n  # each storey has its own templates ...
    assert brain.map.n < 5 * PLACES  # ... to which the robot comes back
    assert brain.map.n_links > brain.map.n
    assert np.ptp(brain.pose_3d.experience_heights_m) == pytest.approx(6.0, rel=0.15)
    assert confused(brain_3d(cells=["pose"]), frames, z) > 2 * PLACES


def test_sequences_of_views_do_not_match_across_storeys():
    frames, z = drive([0, 0, 1, 1, 0, 0])
    brain, flat = (
        brain_3d(map={"closure": "sequence"}, **more) for more in ({}, {"cells": ["pose"]})
    )
    assert confused(brain, frames, z) <= 2
    assert confused(flat, frames, z) > PLACES
    assert brain.map.n < 5 * PLACES  # it comes back to both storeys ...
    heights = brain.pose_3d.experience_heights_m
    assert np.ptp(heights) == pytest.approx(STOREY_M, rel=0.1)  # ... at their heights
    assert abs(brain.pose_3d.z_m) < 0.3


def test_a_revoked_loop_closure_gives_the_height_of_before_back():
    brain = brain_3d()
    for frame in drive([0, 1])[0]:
        brain(frame)
    cells = brain.pose_3d
    before, last = cells.z_m, brain.map.current
    cells.rises.append(source=last, target=2, rise_m=0.1)  # it would have closed a loop to there
    cells.now.at, cells.now.rise_m = 2, 0.0
    cells._undo(Revoked(last, 2, Pose(0.0, 0.0, 0.0)))
    assert cells.z_m == pytest.approx(cells.levels.array("z_m")[last] + 0.1)
    assert cells.z_m == pytest.approx(before, abs=0.5)
    assert not ((cells.measured_rises.source == last) & (cells.measured_rises.target == 2)).any()


def test_a_closed_loop_corrects_the_height():
    frames, z = drive([0, 1, 0, 0])
    biased = [frame._replace(v_z_m_s=frame.v_z_m_s + 0.03) for frame in frames]
    brain = brain_3d()
    heights = np.array([(brain(frame), brain.pose_3d.z_m)[1] for frame in biased])
    drifted = 0.03 * DT_S * len(frames)
    assert abs(heights[-1] - z[-1]) < 0.3 * drifted
    rises, map_z = brain.pose_3d.measured_rises, brain.pose_3d.experience_heights_m
    residual = map_z[rises.target] - map_z[rises.source] - rises.rise_m
    assert np.abs(residual).max() < 0.05 * drifted  # many rises share what the loop is open by


def test_a_template_of_this_storey_can_match_though_another_storey_has_it_too(monkeypatch):
    brain = brain_3d()
    for frame in drive([0])[0]:
        brain(frame)
    brain.map.experiences.array("template")[1] = 0
    excluded = np.arange(brain.map.n) == 1
    monkeypatch.setattr(brain.pose_3d, "excludes", lambda: excluded)
    assert not brain._hidden().any()
    excluded[2] = True
    assert np.flatnonzero(brain._hidden()).tolist() == [2]


def test_a_drive_in_the_plane_has_no_heights():
    frames = [frame._replace(v_z_m_s=None) for frame in drive([0, 0])[0]]
    brain = brain_3d()
    for frame in frames:
        brain(frame)
    assert not brain.pose_3d.experience_heights_m.any()
    assert brain.map.n == PLACES


def test_a_brain_continues_bit_for_bit_from_its_file(tmp_path):
    frames, _ = drive(TOUR[:4])
    brain = brain_3d()
    for frame in frames[:120]:
        brain(frame)
    save_brain(brain, tmp_path / "one.safetensors")
    others = [load_brain(tmp_path / "one.safetensors"), copy.deepcopy(brain)]
    for frame in frames[120:]:
        results = [one(frame) for one in (brain, *others)]
        assert results[0] == results[1] == results[2]
    state = brain.state_dict()
    for other in others:
        assert all(torch.equal(v, other.state_dict()[k]) for k, v in state.items())


def test_new_columns_come_after_the_others():
    brain = brain_3d()
    for frame in drive([0, 1])[0]:
        brain(frame)
    lines = experiences_csv(brain).splitlines()
    assert lines[0] == "id,x_m,y_m,theta_rad,template,first_frame,z_m"
    assert float(lines[-1].split(",")[-1]) == brain.pose_3d.experience_heights_m[-1]
    assert list(more_columns(brain)) == ["z_m", "pose_z", "rise_m"]
    assert more_columns(NavigationBrain()) == {}


def test_a_height_that_is_no_number_refuses_the_frame():
    frames, brain = drive([0])[0], brain_3d()
    brain(frames[0])
    with pytest.raises(BadFrame, match=r"frame 1: vertical speed nan m/s; expected"):
        brain(frames[1]._replace(v_z_m_s=math.nan))
    assert brain(frames[1]).frame == 1


def test_forgotten_experiences_keep_the_heights_of_the_rest():
    frames, _ = drive([0, 1])
    brain = brain_3d()
    for frame in frames:
        brain(frame)
    cells, root = brain.pose_3d, np.arange(brain.map.n)
    before = cells.experience_heights_m
    root[1:-1:3] = root[0:-2:3]
    renumber(brain, root)
    rises, heights = cells.measured_rises, cells.experience_heights_m
    np.testing.assert_array_equal(heights, before[root == np.arange(len(root))])
    np.testing.assert_allclose(
        heights[rises.target] - heights[rises.source], rises.rise_m, atol=0.4
    )
    assert faults_of(brain.state_dict(), brain) == []


def test_heights_landmarks_and_head_direction_are_in_one_brain():
    source = open_world("world:garage?markers=12&landmark_reach=6&start=0.19&noise=0.05")
    alone, together = brain_3d(), brain_3d(cells=["pose_3d", "semantic", "head_direction"])
    for i in range(40):
        alone(source.frame(i))
        together(source.frame(i))
    assert together.leader is together.pose_3d
    assert together.pose_3d.z_m == alone.pose_3d.z_m > 0.3
    assert together.semantic.counts()["landmarks"] > 0
    assert faults_of(together.state_dict(), together) == []


# --- two sessions ----------------------------------------------------------------------------


def two_maps():
    brains = []
    for storeys in ([0, 1], [1, 0]):
        brain = brain_3d()
        brain.about = (f"storeys {storeys}", "", "")
        for frame in drive(storeys)[0]:
            brain(frame)
        brains.append(brain)
    return brains


def test_maps_merge_at_the_height_of_the_matched_experiences():
    loaded, partial = two_maps()
    merged, report = loaded.merge(partial, Match(loaded=PLACES, partial=0))
    assert merged is not None, report.reason
    assert faults_of(merged.state_dict(), merged) == []
    own = loaded.pose_3d.experience_heights_m
    moved = merged.pose_3d.experience_heights_m[loaded.map.n :]
    expected = partial.pose_3d.experience_heights_m[1:] + own[PLACES]
    np.testing.assert_allclose(moved, expected, atol=1e-12)
    here = partial.pose_3d.z_m + own[PLACES] - partial.pose_3d.experience_heights_m[0]
    assert merged.pose_3d.z_m == pytest.approx(here)


def test_a_merge_that_takes_storeys_for_each_other_is_refused_with_the_reason():
    loaded, partial = two_maps()
    wrong = Pairs.of([(5, 5, 0.0, 0.0)])  # storey 1 of the partial is not storey 0 of the loaded
    match = Match(loaded=PLACES + 5, partial=PLACES + 5, others=wrong)
    states = [brain.pose_3d.state_dict() for brain in (loaded, partial)]
    reason = partial.pose_3d.contradicts(*states, match.pairs)
    assert "differ in height by" in reason
    assert "pose_3d.gate_m = 1.2 m" in reason
    assert partial.pose_3d.contradicts(*states, match.pairs.pick([0])) == ""


# --- configs and faults ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"pose_cells": {"excite_size": 9}, "pose_3d": {"n_z": 7}}, "expected n_z of at least"),
    ],
)
def test_configs_that_cannot_work_are_refused(more, message):
    with pytest.raises(ConfigError, match=message):
        brain_3d(**more)


def test_damage_is_found():
    brain = brain_3d()
    for frame in drive([0])[0]:
        brain(frame)
    state = {k.removeprefix("pose_3d."): v.numpy() for k, v in brain.state_dict().items()}
    cases = {
        "sheet.activity": lambda a: -a,
        "now.at": lambda a: a + 10_000,
        "now.view": lambda a: a + 10_000,
        "bindings.z": lambda a: a + 50.0,
        "levels.z_m": lambda a: a[1:],
        "rises.target": lambda a: a + 10_000,
        "grid.origin": lambda a: a + 21,
        "slip": lambda a: a[1:],
    }
    for name, damage in cases.items():
        damaged = state | {name: damage(state[name])}
        found = PoseCells3D.faults(damaged, brain.config, brain.view.n, brain.map.n)
        assert list(found), name
    assert not list(PoseCells3D.faults(state, brain.config, brain.view.n, brain.map.n))
    assert Pose3DConfig().gate_m < STOREY_M / 2
