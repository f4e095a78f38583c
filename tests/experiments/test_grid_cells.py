"""Boundary cells on paths to walls; grid cells in short simulations; written results."""

import json
import math

import numpy as np
import pytest

from neuroslam.cells.boundary import ATTENUATION, GROWTH, INHIBITION, BoundaryCells
from neuroslam.config import BoundaryCellConfig, BrainConfig, GridCellConfig
from neuroslam.evaluation.gridness import gridness
from neuroslam.evaluation.ratemap import rate_map
from neuroslam.experiments import (
    boundary_cells,
    boundary_sheet,
    grid_cells,
    grid_comparison,
    grid_learning,
)
from neuroslam.experiments.census import CensusRecorder, arena_bins, by_seed, median, simulate_grid
from neuroslam.worlds.arena import named_arena
from neuroslam.worlds.rodent import roam
from neuroslam.worlds.senses import NO_NOISE, SenseNoise, sense

FEW = GridCellConfig(
    spacings_m=(0.3, 0.5), orientations_deg=(0.0, 15.0), n_cells=4, development_steps=500
)


@pytest.fixture(scope="module")
def rodent(shared):
    return shared / "data" / "rodent"


@pytest.fixture(scope="module")
def approaches():
    return {s.letter: boundary_cells.walk_straight(s) for s in boundary_cells.SCENARIOS}


@pytest.fixture(scope="module")
def walk():
    return roam(named_arena("circle2m"), 4.0, np.random.default_rng(1), speed_m_s=0.3)


def hexagons(positions, spacing_m):
    k = 4 * np.pi / (np.sqrt(3) * spacing_m)
    waves = k * np.array([[0.0, 1.0], [0.75**0.5, 0.5], [0.75**0.5, -0.5]])
    return np.maximum(np.cos(positions @ waves.T).sum(axis=1), 0.0)


def test_activity_grows_near_a_wall_decreases_farther_away_and_is_0_beyond_reach(approaches):
    for letter in "CBE":
        way = approaches[letter]
        change = np.diff(way.activity, prepend=0.0)
        assert (change[way.zone == GROWTH] > 0).all()
        assert (change[way.zone == ATTENUATION] < 0).all()
        assert not way.activity[way.zone == INHIBITION].any()


def test_on_a_path_to_a_wall_cells_are_silent_until_half_their_reach(approaches):
    for letter in "ADF":
        way = approaches[letter]
        assert not way.activity[way.distance_m > 0.15].any()
        assert (np.diff(way.activity[way.zone == GROWTH]) > 0).all()
        assert way.active[-1] > 0


def test_a_zone_takes_its_width_over_the_speed_and_longer_along_a_diagonal(approaches):
    def seconds(letter):
        return (approaches[letter].zone == ATTENUATION).sum() / boundary_cells.RATE_HZ

    across = 0.15 / boundary_cells.SPEED_M_S
    assert seconds("A") == pytest.approx(across, abs=0.02)
    assert seconds("D") == pytest.approx(across * math.sqrt(2), abs=0.02)
    assert seconds("F") > 1.2 * across  # aslant


def test_at_a_corner_cells_of_both_walls_fire(approaches):
    def bearings(letter):
        return {15 * k for k in np.flatnonzero(approaches[letter].rates[-1] > 0.3)}

    assert bearings("A") >= {0}
    assert 90 not in bearings("A")
    assert bearings("D") >= {0, 90}


def test_the_bearing_of_a_curved_wall_changes_along_the_path(approaches):
    way = approaches["E"]
    best = 15 * way.rates.argmax(axis=1)[(way.activity > 0)]
    assert best[5] == 30
    assert best[-1] == 45


def test_a_boundary_cell_fires_along_its_wall():
    maps = boundary_cells.map_firing("square", 6.0)
    for cell, distance_m in zip(maps[:2], (0.0375, 0.15), strict=True):
        profile = np.nanmean(cell.rate_map, axis=0)
        peak_x = cell.bins.x_min_m + cell.bins.bin_m * (0.5 + profile.argmax())
        assert peak_x == pytest.approx(1.0 - distance_m, abs=0.05)


def test_the_scenarios_are_written_and_are_as_in_the_paper(tmp_path):
    result = boundary_cells.boundary_scenarios(None, tmp_path, minutes=1.0)
    assert json.loads((tmp_path / "results.json").read_text()) == result
    assert [row["scenario"][0] for row in result["rows"]] == list("ACDBFE")
    assert all(row["as_in_the_paper"] for row in result["rows"])
    figures = ("scenarios", "active_cells", "firing_maps")
    assert all((tmp_path / f"{name}.png").is_file() for name in figures)


def test_the_active_cells_are_those_of_the_walls_bearing_and_distance():
    cells = BoundaryCells(BoundaryCellConfig())
    for letter, bearings in (("A", {0.0}), ("C", {0.0}), ("D", {0.0, 90.0}), ("B", {0.0, 90.0})):
        scenario = next(s for s in boundary_cells.SCENARIOS if s.letter == letter)
        active = boundary_cells.active_cells(scenario)
        at_10_cm = active.rates[active.moments.index("10 cm")]
        best = {cells.preferred_rad[at_10_cm.max(axis=1).argmax()].rad2deg().item()}
        if len(bearings) == 2:
            assert at_10_cm[0].max() == pytest.approx(at_10_cm[6].max(), rel=1e-6)
        assert best <= bearings
        preferred_m = cells.preferred_m[at_10_cm.max(axis=0).argmax()].item()
        assert preferred_m == pytest.approx(0.1, abs=0.022)  # half a step of the population


def test_grid_learning_is_scored_by_weights_and_by_the_path(rodent, tmp_path):
    result = grid_learning.grid_learning(rodent, tmp_path, minutes=0.2, seeds=[0])
    assert json.loads((tmp_path / "results.json").read_text()) == result
    assert (tmp_path / "grid_learning.png").is_file()
    weights = {(r["condition"], r["time_s"]): r["gridness_of_weights"] for r in result["rows"]}
    assert len(weights) == 2 * len(grid_learning.CONDITIONS)
    fixed = weights["random, fixed", 2.0]
    assert weights["random, fixed", 10.0] == fixed
    assert weights["random, learns", 10.0] > fixed
    assert weights["developed, fixed", 10.0] > 1.2


def test_boundary_cells_in_the_loop_are_run_with_feet_and_with_noisy_beams(rodent, tmp_path):
    result = boundary_sheet.boundary_cells_in_loop(
        rodent, tmp_path, minutes=0.5, seeds=[3], few_seeds=[3], tracks=["pentagon"]
    )
    rows = {(row["input"], row["condition"]): row for row in result["rows"]}
    assert len(rows) == len(boundary_sheet.CONDITIONS) + 2
    feet = [rows["feet", name]["error_m"] for name in ("raw walls", "boundary cells")]
    assert feet[1] == pytest.approx(feet[0], rel=0.1)
    assert all((tmp_path / f"{name}.png").is_file() for name in ("feet", "noisy_beams"))


def test_nan_is_written_as_null(tmp_path):
    boundary_cells.write_results(tmp_path, {"rows": [{"score": math.nan}]})
    assert json.loads((tmp_path / "results.json").read_text()) == {"rows": [{"score": None}]}


def test_a_census_scores_the_map_since_the_start_and_that_since_the_one_before(walk):
    recorder = CensusRecorder(walk, [120.0, 240.0], (1, 1, 2))
    steady = hexagons(walk.positions, 0.5)
    drifts = np.where(walk.times_s <= 120.0, steady, hexagons(walk.positions + 0.15, 0.5))
    for step, rates in enumerate(np.stack([steady, drifts], axis=1)):
        recorder.add(step, rates)
    early, late = recorder.census
    np.testing.assert_array_equal(early.silent, early.last)
    whole = rate_map(walk.positions, np.float32(steady), arena_bins(walk))
    np.testing.assert_allclose(late.maps[0, 0], whole[0])
    assert late.silent[0, 0, 0] == pytest.approx(gridness(whole)[0])
    assert late.skip[0, 0, 0] > 1.1
    assert late.silent[0, 0, 1] < late.silent[0, 0, 0] - 0.2
    # Since the drift the other is a grid again, only elsewhere.
    assert late.last[0, 0, 1] == pytest.approx(late.last[0, 0, 0], abs=0.15)
    assert (late.n_fields > 5).all()


def test_a_median_is_taken_over_cells_and_averaged_over_seeds():
    scores = np.array([[[0.0, 1.0, np.nan]], [[2.0, 2.0, 5.0]], [[np.nan] * 3]])
    np.testing.assert_array_equal(by_seed(scores), [0.5, 2.0, np.nan])
    assert median(scores[:2]) == 1.25


def test_grid_cells_become_hexagonal_as_an_arena_is_explored(walk):
    (early, late), errors = simulate_grid(
        walk, [0], [30.0, 240.0], BrainConfig(grid_cells=FEW), NO_NOISE
    )
    assert median(early.silent) < 0.6
    assert median(late.skip) > 1.1
    assert errors.shape == (1, len(walk.times_s))


def test_the_other_models_have_the_same_senses(walk):
    exact = grid_comparison.sensed_velocity(sense(walk)).numpy()
    way = np.diff(walk.positions, axis=0)
    np.testing.assert_allclose(exact[1:, 0] / walk.rate_hz, way, atol=1e-9)
    noisy = sense(walk, SenseNoise(), [3, 4])
    assert grid_comparison.sensed_velocity(noisy).shape == (len(walk.times_s), 2, 2)


def test_oscillatory_interference_without_noise_is_a_grid_of_each_spacing(walk):
    (census,) = grid_comparison.interference_grid(walk, sense(walk, k=2), [240.0], FEW)
    assert census.silent.shape == (1, 2, 4)
    assert np.median(census.skip, axis=2).min() > 1.0
    fields = np.median(census.n_fields[0], axis=1)
    assert (np.diff(fields) < 0).all()  # the wider apart, the fewer


def test_the_recorded_cell_is_a_grid_cell(rodent):
    firing, row = grid_cells.recorded_cell(rodent)
    assert row["spikes"] == len(firing.places_m) == 673
    assert row["gridness_silent"] > 0.5
    assert row["gridness_skip"] > 0.5


def test_grid_scores_are_written_beside_the_papers(rodent, tmp_path):
    result = grid_cells.grid_scores(rodent, tmp_path, 0.5, 1, FEW)
    assert [row["arena"] for row in result["rows"]] == ["triangle", "pentagon", "nonagon"]
    assert [row["paper"] for row in result["rows"]] == [0.25, 0.24, 0.20]
    assert [row["directions"] for row in result["directions"]] == [6] * 3 + [12] * 3 + [36] * 3
    assert all((tmp_path / f"{name}.png").is_file() for name in ("scores", "firing"))
    assert (tmp_path / "results.json").is_file()


def test_the_comparison_writes_every_method_spacing_and_time(rodent, tmp_path):
    result = grid_comparison.grid_comparison(rodent, tmp_path, 0.5, 2, 1, FEW)
    methods = ["true motion", "OI", "CAN", "SLRB", "SLRB, no correction"]
    assert [row["method"] for row in result["rows"][::6]] == methods
    assert len(result["by_spacing"]) == 5 * 2 * 6
    counts = [row["activated_boundary_cells"] for row in result["boundary_cells"]]
    assert counts == sorted(counts)
    assert counts[-1] > 0
    pictures = {path.name for path in tmp_path.glob("*.png")}
    spacings = {f"grids_{cm}cm.png" for cm in (30, 50)}
    assert pictures == spacings | {"scores.png", "boundary_cells.png"}


def test_boundary_cells_at_rest_stay_silent():
    far = np.full((5, 1), np.inf)
    activity, rates = boundary_cells.respond(far, np.zeros((5, 1)), 0.1, BoundaryCellConfig())
    assert not activity.any()
    assert not rates.any()
