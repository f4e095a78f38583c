"""The experiments with place cells, on short walks."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from neuroslam.experiments import place_bump, place_methods
from neuroslam.experiments import place_cells as experiment
from neuroslam.experiments.animals import read_track, run_cells, simulate
from neuroslam.figures.place_errors import Spread
from neuroslam.worlds.senses import NO_NOISE, SenseNoise, sense

SEEDS = (3, 8)
MINUTES = 1.5


@pytest.fixture(scope="module")
def data(shared):
    return shared / "data" / "rodent"


@pytest.fixture(scope="module")
def short(data, tmp_path_factory):
    out = tmp_path_factory.mktemp("place_map")
    results = experiment.place_map(data, out, ("triangle",), MINUTES, SEEDS)
    return results, out


def row_of(results, condition, method):
    return next(
        r for r in results["details"] if (r["condition"], r["method"]) == (condition, method)
    )


def test_results_and_figures_are_written(short):
    results, out = short
    assert json.loads((out / "results.json").read_text())["checks"] == results["checks"]
    names = ("maps", "paths", "responses", "growth")
    for path in [out / "errors.png", *(out / f"triangle_{name}.png" for name in names)]:
        assert path.stat().st_size > 20_000, path.name


def test_every_method_has_rows_for_its_conditions(short):
    results, _ = short
    methods = [(row["condition"], row["method"]) for row in results["rows"]]
    assert len(methods) == len(set(methods)) == 9
    assert sum(method == place_methods.SLRB for _, method in methods) == 3
    assert all(len(row) <= 9 for row in results["rows"])
    assert results["paper"]["mean_error_m"] == 0.031


def test_errors_are_relative_to_path_integration(short):
    for condition in (place_methods.FULL, place_methods.WEAK):
        row = row_of(short[0], condition, place_methods.PATH)
        assert row["ratio_to_path_integration"] == pytest.approx(1.0)
        assert row["ratio_aligned"] == pytest.approx(1.0)


def test_the_integrator_without_walls_is_path_integration(short):
    for condition in (place_methods.FULL, place_methods.WEAK):
        path, hebb = (
            row_of(short[0], condition, m) for m in (place_methods.PATH, place_methods.HEBB)
        )
        assert hebb["mean_error_m"] == pytest.approx(path["mean_error_m"], abs=1e-6)
        assert hebb["winner_mean_error_m"] > hebb["mean_error_m"]


def test_walls_reduce_the_error(short):
    slrb = row_of(short[0], place_methods.FULL, place_methods.SLRB)
    assert slrb["ratio_to_path_integration"] < 1.0
    assert slrb["mean_error_m_below_hebb_percent"] == pytest.approx(
        100
        * (
            1
            - slrb["mean_error_m"]
            / row_of(short[0], place_methods.FULL, place_methods.HEBB)["mean_error_m"]
        )
    )


def test_weaker_noise_gives_smaller_errors(short):
    for method in (
        place_methods.PATH,
        place_methods.HEBB,
        place_methods.RATSLAM,
        place_methods.SLRB,
    ):
        strong, weak = (
            row_of(short[0], c, method) for c in (place_methods.FULL, place_methods.WEAK)
        )
        assert weak["mean_error_m"] < strong["mean_error_m"]


def test_one_place_cell_responds_beside_a_wall(short):
    slrb = row_of(short[0], place_methods.FULL, place_methods.SLRB)
    assert slrb["one_cell_share"] > 0.9
    assert 1.0 <= slrb["cells_above_half"] <= slrb["cells_above_half_by_grid_alone"] + 1e-9


def test_checks_say_target_and_whether_it_is_met(short):
    results, _ = short
    row = row_of(results, place_methods.FULL, place_methods.SLRB)
    checks = {check["what"]: check for check in results["checks"]}
    assert len(checks) == len(results["checks"]) == 7
    ratio = checks["ratio_to_path_integration"]
    assert ratio["ours"] == row["ratio_to_path_integration"]
    assert (ratio["target"], ratio["met"]) == ("<= 0.25", ratio["ours"] <= 0.25)
    below = checks["mean_error_m_below_ratslam_percent"]
    assert (below["target"], below["met"]) == (">= 57", below["ours"] >= 57)


def test_pose_cells_without_noise_follow_the_true_path(data):
    walk = read_track(data, "hafting", 1.0)
    path = place_methods.pose_cells_alone(sense(walk, NO_NOISE, [0], k=2))
    estimate = walk.positions[0] + path.in_world(path.cells)[0]
    error = np.linalg.norm(estimate - walk.positions[path.steps], axis=1)
    assert error.mean() < 0.01
    assert error.max() < 0.03


def test_animals_of_a_batch_do_not_affect_each_other(data):
    walk = read_track(data, "triangle", 0.5)
    senses = [sense(walk, SenseNoise().scaled(s), SEEDS, k=2) for s in (1.0, 0.3)]
    both = place_methods.stacked(senses)
    log = place_methods.PlaceCellLog(np.isfinite(both.wall_m[..., 0]), walk.positions[0], 0)
    run_cells(both, experiment.BrainConfig(), log)
    alone = simulate(walk, SEEDS).estimate_m
    estimate = log.estimate[:, :2].transpose(1, 0, 2) + walk.positions[0]
    np.testing.assert_allclose(estimate, alone, atol=1e-6)


def test_fewer_place_cells_where_they_must_be_farther_apart(data, tmp_path):
    results = experiment.threshold_sweep(
        data, tmp_path, thresholds_m=(0.06, 0.15), minutes=1.0, seeds=SEEDS
    )
    fine, coarse = results["rows"]
    assert fine["cells"] > 1.5 * coarse["cells"]
    assert fine["winner_mean_error_m"] < coarse["winner_mean_error_m"]
    assert fine["integrator_mean_error_m"] == pytest.approx(
        coarse["integrator_mean_error_m"], rel=0.05
    )
    assert results["our_threshold_of_least_winner_error_m"] == 0.06
    assert (tmp_path / "thresholds.png").stat().st_size > 20_000
    assert json.loads((tmp_path / "results.json").read_text()) == results


@given(st.lists(st.tuples(st.integers(-3, 3), st.integers(-3, 3)), min_size=1, max_size=30))
def test_cells_are_numbered_by_their_first_visit(track):
    track = np.array(track)
    cells, first, numbers = place_methods.visited(track)
    np.testing.assert_array_equal(cells[numbers], track)
    np.testing.assert_array_equal(cells, track[first])
    assert (np.diff(first) > 0).all()


def test_links_join_successive_places_once():
    assert place_methods.links_of(np.array([0, 1, 1, 0, 2])).tolist() == [[0, 1], [0, 2]]


def test_growth_is_that_of_the_last_third():
    cells = Spread(np.linspace(0.0, 30.0, 4), np.array([[1, 50, 100, 103], [1, 50, 200, 200]]))
    np.testing.assert_allclose(experiment.growth_percent(cells), [3.0, 0.0])


def test_a_bump_of_place_cells_is_nearer_than_the_winner(data, tmp_path):
    rows = place_bump.place_bump(data, tmp_path, MINUTES, SEEDS, ("nonagon",))["rows"]
    wins, plain, excited = rows
    assert [row["cells_in_bump"] >= 1.0 for row in rows] == [True] * 3
    assert excited["bump_error_m"] < plain["bump_error_m"] < wins["winner_error_m"]
    assert {row["place_cells"] for row in rows} == {wins["place_cells"]}
    assert (tmp_path / "errors.png").stat().st_size > 10_000
