"""The corridor: ten thousand scored matches, most of them wrong, and the true map."""

import json

import numpy as np
import pytest

from neuroslam.errors import SourceError
from neuroslam.evaluation.trajectory import absolute_trajectory_error
from neuroslam.experiments import corridor_loops as experiment


@pytest.fixture(scope="module")
def folder(shared):
    if not (shared / "data" / "tuc_slam").is_dir():
        pytest.skip("no tuc_slam beside the checkout")
    return shared / "data" / "tuc_slam"


@pytest.fixture(scope="module")
def corridor(folder):
    return experiment.read_corridor(folder)


def error_m(corridor, graph, poses):
    track = experiment.track_at_truth(corridor, graph, poses)
    return absolute_trajectory_error(track, corridor.truth_m).rmse


def test_all_matches_give_a_map_far_better_than_odometry(corridor):
    graph = experiment.build_graph(corridor, 0.0)
    assert graph.is_match.sum() == 10_019
    solved, believed = experiment.solve(graph, "least_squares_robust")
    odometry_m = error_m(corridor, graph, graph.poses)
    assert error_m(corridor, graph, solved) < min(odometry_m / 5, 3.0)
    assert 1000 < (believed & graph.is_match).sum() < 3726  # so many are right


def test_an_unsolved_map_gives_back_the_odometry(corridor):
    graph = experiment.build_graph(corridor, 0.9)
    track = experiment.track_at_truth(corridor, graph, graph.poses)
    expected = np.column_stack(
        [np.interp(corridor.truth_s, corridor.times_s, axis) for axis in corridor.odometry.T[:2]]
    )
    np.testing.assert_allclose(track, expected, atol=1e-9)


def test_the_experiment_writes_its_rows_and_its_figure(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(experiment, "SCORES", (0.8, 0.9))
    results = experiment.corridor_loops(folder, tmp_path)
    assert json.loads((tmp_path / "results.json").read_text()) == results
    assert (tmp_path / "corridor_loops.png").stat().st_size > 10_000
    assert [row["matches"] for row in results["rows"]] == [139] * 4 + [81] * 4
    robust = [row for row in results["rows"] if row["method"] == "least_squares_robust"]
    assert max(row["ate_rmse_m"] for row in robust) < 3.0


def test_a_missing_or_broken_file_is_named(tmp_path):
    with pytest.raises(SourceError, match=r"Corridor_Input.txt cannot be read"):
        experiment.read_corridor(tmp_path)
    (tmp_path / "Corridor_Input.txt").write_text("odom2 0 0 0 0\nwhat 1\n")
    with pytest.raises(SourceError, match="line 2 of"):
        experiment.read_corridor(tmp_path)
