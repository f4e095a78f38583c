"""The experiments of the multisession paper, against a single session over the same frames."""

import json
from functools import cache

import numpy as np
import pytest

from neuroslam.config import build_config
from neuroslam.experiments import multisession, run_experiment
from neuroslam.experiments.multisession import PLANS, run_plan, variants, wrong_merges
from neuroslam.experiments.session_runs import run_session
from neuroslam.sensors import open_source


@pytest.fixture(scope="module")
def opened():
    """Open a world that renders each frame once, however many sessions drive through it."""

    @cache
    def open_once(spec, *options):
        source = open_source(spec, *options)
        if str(spec).startswith("world:"):
            source.frame = cache(source.frame)
        return source

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(multisession, "open_source", open_once)
        yield open_once


@pytest.fixture(scope="module")
def tour(opened, tmp_path_factory):
    out = tmp_path_factory.mktemp("tour")
    return out, run_experiment("virtual-tour", None, out)


def test_the_virtual_tour_in_two_sessions_is_the_map_of_one(tour):
    _, (single, multi, *_) = tour
    assert (multi["merges"], multi["maps_not_joined"]) == (1, 0)
    assert multi["places_created_at_known_views_after_merge"] == 0
    for what in ("templates", "experiences", "links"):
        assert multi[what] == single[what], what
    assert multi["icp_rmse_rigid_of_diagonal"] <= 0.005
    assert multi["ate_rigid_m"] <= 1.2 * single["ate_rigid_m"]


def test_an_experiment_writes_its_rows_its_merges_and_its_figures(tour):
    out, rows = tour
    results = json.loads((out / "results.json").read_text())
    assert [row["experiences"] for row in results["rows"]] == [row["experiences"] for row in rows]
    report, *_ = results["merges"]
    assert (report["merged"], report["match"]["places"] >= 4) == (True, True)
    for name in ("stages", "bindings", "overlay", "accuracy"):
        assert (out / f"{name}.png").stat().st_size > 20_000, name


@pytest.mark.parametrize("cells", ["none", "shift"])
def test_pose_cells_that_are_not_moved_and_turned_create_experiences_twice(cells, opened, tour):
    """Figure 12 of the paper; its own shift alone leaves the links turned by the new heading."""
    source = opened(PLANS["virtual-tour"].source)
    (first, stop), (again, _) = PLANS["virtual-tour"].cuts(source)
    config = build_config({"sessions": {"cells": cells}})
    stored = run_session(source.frames(first, stop), config).brain
    joined = run_session(source.frames(again, again + 500), config, stored)  # more than a lap
    assert joined.created_at_known_views > 0
    assert joined.brain.map.n > tour[1][0]["experiences"]


@pytest.mark.usefixtures("opened")
def test_the_lab_tour_joins_where_the_rectangles_meet(tmp_path):
    single, multi, *_ = run_experiment("lab-tour", None, tmp_path)
    assert (multi["merges"], multi["maps_not_joined"]) == (1, 0)
    assert multi["icp_rmse_rigid_of_diagonal"] <= 0.01
    assert multi["ate_similarity_m"] <= 1.2 * single["ate_similarity_m"]


def test_four_of_five_sessions_share_no_street_and_the_fifth_passes_all():
    source = open_source(PLANS["five-sessions"].source)
    cuts, truth = PLANS["five-sessions"].cuts(source), source.truths()[:, :2]
    assert (cuts[0][0], cuts[-1][1], len(cuts)) == (0, source.n_frames, 5)
    laps = [truth[a:b] for a, b in cuts]
    sides = [np.sign(np.mean(lap, axis=0)).tolist() for lap in laps[:-1]]
    assert sides == [[-1, -1], [1, -1], [1, 1], [-1, 1]]

    def apart(one, other):
        return np.linalg.norm(one[:, None] - other, axis=-1).min()

    pairs = [(one, other) for k, one in enumerate(laps[:-1]) for other in laps[:k]]
    assert min(apart(*pair) for pair in pairs) > 20.0
    assert all(apart(lap, laps[-1]) < 0.01 for lap in laps[:-1])
    assert np.ptp(laps[-1], axis=0) == pytest.approx([102.0, 84.0], abs=0.1)


def test_table_1_of_the_paper_is_run_beside_our_parameters():
    for name, table in (("virtual-tour", 0.05), ("lab-tour", 0.04), ("five-sessions", 0.035),
                        ("campus", 0.059)):  # fmt: skip
        ours, rule, paper = (build_config(one) for one in variants(PLANS[name]).values())
        assert paper.view.threshold == table
        assert paper.pose_cells.cell_size_m == ours.pose_cells.cell_size_m
        assert (ours.sessions.confirm, ours.sessions.cells) == (4, "turn")
        assert rule.view == ours.view
        for one in (rule, paper):
            assert (one.sessions.confirm, one.sessions.cells) == (1, "shift")
            assert not one.sessions.check_residuals


def test_sessions_of_the_campus_are_the_court_the_park_and_everything():
    source = open_source(PLANS["campus"].source)
    cuts, truth = PLANS["campus"].cuts(source), source.truths()[:, 0]
    assert source.n_frames >= 20_000
    assert (cuts[0][0], cuts[-1][1], len(cuts)) == (0, source.n_frames, 3)
    assert truth[slice(*cuts[0])].max() <= 10.1  # the court
    assert truth[slice(*cuts[1])].min() >= -25.1  # the park
    assert np.ptp(truth[slice(*cuts[2])]) > 150.0  # everything


@pytest.mark.parametrize(("name", "k"), [("circuit_launch", 2), ("circuit_launch", 5)])
def test_a_real_drive_in_sessions_has_the_shape_of_a_single_session(name, k, shared):
    from neuroslam.experiments.multisession import Plan, equal_parts
    from neuroslam.experiments.session_runs import measure

    source = shared / "data" / name / "frames.tar"
    if not source.is_file():
        pytest.skip(f"no {name} beside the checkout")
    result = run_plan(Plan(name, str(source), equal_parts(k), preset="rc_car"))
    every = np.arange(len(result.single.trace["session"]))
    row = measure("", result.runs, result.single, every)
    assert row["maps_not_joined"] == 0
    assert row["icp_rmse_rigid_of_diagonal"] < 0.03
    assert row["track_rmse_of_diagonal"] < 0.03


def test_no_cut_of_one_drive_is_joined_to_one_of_another(shared):
    if not (shared / "data" / "usi_track1").is_dir():
        pytest.skip("no usi_track1 beside the checkout")
    row = wrong_merges(shared / "data", n=5)
    assert row["tries"] == 25
    assert row["merges"] == 0
    assert all(row["reasons"])
