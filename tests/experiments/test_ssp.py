"""Experiments of SSP-SLAM run, small, and their figures are there."""

import json
from functools import partial

import numpy as np
import pytest

from neuroslam.experiments import run_experiment
from neuroslam.experiments.ssp_activity import ssp_activity
from neuroslam.experiments.ssp_kitti import ssp_kitti
from neuroslam.experiments.ssp_localisation import ssp_3d, ssp_localisation
from neuroslam.experiments.ssp_map import ssp_map


def pictures(folder):
    return {p.name for p in folder.glob("*.png") if p.stat().st_size > 10_000}


def test_queries_of_a_map_are_answered_and_counted_in_random_maps(tmp_path):
    found = ssp_map(
        None, tmp_path, seconds=25.0, tier="algebraic", n_random_maps=4, random_seconds=40.0
    )
    rows = {row["question"]: row for row in found["rows"]}
    assert rows["landmark, random maps"]["right"] == rows["landmark, random maps"]["landmarks"] > 10
    assert rows["attribute, random maps"]["right"] >= 2
    assert json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))["rows"]
    assert pictures(tmp_path) == {
        "queries.png", "vectors.png", "area.png", "whole_map.png", "posterior.png",
    }  # fmt: skip


def test_localisation_is_better_with_a_map_under_noise(tmp_path):
    methods = ("algebraic", "algebraic, phase noise 0.3")
    rows = ssp_localisation(None, tmp_path, 60.0, n_trials=2, methods=methods)["rows"]
    assert max(row["ate_mean_m"] for row in rows if row["method"] == "algebraic") < 1e-3
    alone, same, _ = (row["ate_mean_m"] for row in rows if row["method"] == methods[1])
    assert same < alone
    assert pictures(tmp_path) == {"errors.png", "paths.png"}


def test_the_reference_s_paths_are_used_where_they_are(shared, tmp_path, monkeypatch):
    from neuroslam.experiments import ssp_localisation as module

    monkeypatch.setattr(module, "trials", lambda data, *_: pytest.fail(str(data)))
    with pytest.raises(pytest.fail.Exception, match=r"refs/ssp"):
        run_experiment("ssp-localisation", shared / "refs", tmp_path)


def test_three_dimensions_are_like_two(tmp_path):
    rows = ssp_3d(None, tmp_path, seconds=1.5, neurons=60, n_trials=1)["rows"]
    assert [row["tier"] for row in rows] == ["algebraic"] * 2 + ["spiking"] * 2
    assert rows[0]["ate_mean_m"] < 1e-3
    assert pictures(tmp_path) == {"path.png"}


def test_kitti_is_dead_reckoned_in_floating_point_and_quantised(shared, tmp_path):
    found = ssp_kitti(shared / "data" / "kitti_00", tmp_path, seconds=2.0, budgets=(3600,))
    rows = {row["integrator"]: row for row in found["rows"]}
    assert {name: row["neurons"] for name, row in rows.items()} == {
        "plain, 3k neurons": 3600,
        "plain, 3k neurons, velocity in neurons": 4100,
        "quantised, 3k neurons": 3600,
        "quantised, 3k neurons, velocity in neurons": 4100,
    }
    for name in ("plain, 3k neurons", "quantised, 3k neurons"):
        assert rows[name]["rmse"] != rows[f"{name}, velocity in neurons"]["rmse"]
    assert found["metres_per_unit"] > 200
    assert pictures(tmp_path) == {"reckoning.png"}


def test_any_kitti_sequence_with_poses_is_chosen_by_its_number(tmp_path, monkeypatch, mistake):
    short = partial(ssp_kitti, seconds=0.5, budgets=(3600,))
    monkeypatch.setattr("neuroslam.experiments.ssp_kitti.ssp_kitti", short)
    for folder, bend in (("kitti_07", 0.0), ("poses", 1.0)):
        s = np.linspace(0.0, 1.0, 40)
        rows = np.zeros((40, 12))
        rows[:, 3], rows[:, 11] = 30.0 * bend * s**2, 30.0 * s
        names = ("KITTI_07_gt.txt", "KITTI_07_gt_times.txt")
        if folder == "poses":
            names = ("05.txt", "../sequences/05/times.txt")
            (tmp_path / "sequences/05").mkdir(parents=True)
        (tmp_path / folder).mkdir()
        np.savetxt(tmp_path / folder / names[0], rows)
        np.savetxt(tmp_path / folder / names[1], 0.1 * np.arange(40))
    for number in ("07", "05"):
        out = tmp_path / f"out_{number}"
        rows = run_experiment("ssp-kitti", tmp_path, out, sequence=number)
        assert [row["neurons"] for row in rows] == [3600, 4100] * 2
        assert json.loads((out / "results.json").read_text("utf-8"))["sequence"] == number
        assert pictures(out) == {"reckoning.png"}
    command = ("experiment", "--data", tmp_path, "-o", tmp_path / "out", "--sequence")
    assert "expected one of 00, 01" in mistake(*command, "11", "ssp-kitti")
    assert "KITTI sequence 04" in mistake(*command, "04", "ssp-kitti")
    assert "leave --sequence out" in mistake(*command, "00", "ssp-map")


def test_neurons_are_recorded_along_a_rat_s_path(shared, tmp_path):
    rows = ssp_activity(shared / "data" / "rodent", tmp_path, seconds=1.0, grid_neurons=45)["rows"]
    assert len(rows) == 4
    assert rows[0]["ate_m"] < 0.05
    assert pictures(tmp_path) == {"spikes.png", "rasters.png", "gate.png"}
