"""Noise of the sensor in the memory of landmarks: certainty, better means, ellipses in answers."""

import json
import math

import numpy as np
import pytest
import torch
from matplotlib.patches import Ellipse
from pydantic import ValidationError

from neuroslam.config.semantic import (
    PathIntegratorConfig,
    SemanticConfig,
    SemanticMapConfig,
    SSPSLAMConfig,
)
from neuroslam.figures.answers import plot_answer
from neuroslam.geometry import rotation_matrix
from neuroslam.sensors.landmarks import LandmarkWords
from neuroslam.spiking import SSPSLAM, load_semantic_map, merge_semantic_maps, save_semantic_map
from neuroslam.spiking.ask import ask
from neuroslam.spiking.gaussian import sighting_covariance
from neuroslam.spiking.semantic import SemanticCells
from neuroslam.spiking.semantic_joining import merge_landmarks
from neuroslam.spiking.sightings import Sightings
from neuroslam.state.join import Join
from neuroslam.types import Motion, Pose
from neuroslam.worlds.landmarks import LandmarkView

STILL = Motion(0.0, 0.0, 0.1)
PLACES = np.array([[4.0, 0.0], [0.0, 3.0], [-3.0, -3.0]])
SIGMA = {"sigma_distance_m": 0.3, "sigma_bearing_rad": 0.1}


def taught(frames=60, noise=(0.0, 0.0), seed=0, places=PLACES, **config):
    """Cells that stand still among landmarks, with sightings whose noise has standard deviations.

    Its own position is exact: it is not corrected by the landmarks.
    """
    draw = np.random.default_rng(seed)
    cells = SemanticCells(SemanticConfig(gain=0.0, **config))
    r, b = np.hypot(*places.T), np.arctan2(*places.T[::-1])
    for _ in range(frames):
        rows = np.column_stack(
            [
                np.arange(len(places)),
                np.abs(r + noise[0] * draw.standard_normal(len(places))),
                b + noise[1] * draw.standard_normal(len(places)),
            ]
        )
        cells.advance(STILL, Sightings.of(rows))
    return cells


def expected(place, distance=0.3, bearing=0.1):
    return sighting_covariance(torch.tensor(place), distance, bearing).numpy()


def errors(cells):
    found = {one.name: one for one in ask(cells, "the whole map").found}
    return [
        float(np.hypot(*(np.array(found[f"landmark_{k}"].position_m) - place)))
        for k, place in enumerate(PLACES)
    ]


@pytest.fixture(scope="module")
def certain():
    return taught()


@pytest.fixture(scope="module")
def uncertain():
    return taught(**SIGMA)


def test_without_noise_of_the_sensor_nothing_changes_bit_for_bit(certain):
    zero = taught(sigma_distance_m=0.0, sigma_bearing_rad=0.0)
    mine, its = certain.state_dict(), zero.state_dict()
    assert mine.keys() == its.keys()
    assert all(torch.equal(mine[key], its[key]) for key in mine)
    assert not any("evidence" in key for key in mine)
    assert certain.covariances() is None
    assert certain.tables() == zero.tables()
    answer = ask(certain, "the whole map")
    assert all(one.covariance_m2 == () for one in answer.found)
    assert not any("covariance_m2" in one for one in answer.to_dict()["found"])
    assert math.isnan(answer.found[0].sigma_m[0])


def test_the_memory_of_a_landmark_holds_the_uncertainty_of_its_sightings(certain, uncertain):
    found = ask(uncertain, "the whole map").found
    assert [one.name for one in found] == ["landmark_0", "landmark_1", "landmark_2"]
    for one, place in zip(found, PLACES, strict=True):
        np.testing.assert_allclose(one.position_m, place, atol=0.01)
        np.testing.assert_allclose(one.covariance_m2, expected(place), atol=0.004)
        assert one.strength == pytest.approx(1.0, abs=0.05)
    assert found[0].sigma_m == pytest.approx((0.4, 0.3), abs=0.01)
    assert max(errors(certain)) < 0.01


def test_what_is_far_is_less_certain_across_the_line_of_sight():
    far = taught(places=np.array([[2.0, 0.0], [0.0, 8.0]]), sigma_bearing_rad=0.05)
    near, other = ask(far, "the whole map").found
    assert near.sigma_m == pytest.approx((0.1, 0.0), abs=0.02)
    assert other.sigma_m == pytest.approx((0.4, 0.0), abs=0.02)


def test_repeated_noisy_sightings_give_a_better_mean():
    noise = 0.3, 0.1
    few, many, plain = [], [], []
    for seed in range(3):
        few += errors(taught(30, noise, seed, **SIGMA))
        many += errors(taught(300, noise, seed, **SIGMA))
        plain += errors(taught(300, noise, seed))
    assert np.mean(many) < 0.5 * np.mean(few)
    assert np.mean(many) < 0.6 * np.mean(plain)  # which learns a known landmark hardly any more
    assert np.mean(many) < 0.1  # a single sighting is wrong by 0.45 m


def test_the_scatter_of_sightings_adds_to_their_declared_uncertainty():
    cells = taught(300, (0.3, 0.1), **SIGMA)
    spread = cells.covariances()
    for covariance, place in zip(spread, PLACES, strict=True):
        np.testing.assert_allclose(covariance, 2.0 * expected(place), atol=0.09)


def test_a_near_sighting_counts_for_more_than_a_far_one():
    cells = SemanticCells(SemanticConfig(gain=0.0, sigma_bearing_rad=0.15, relocalise_after_s=0.0))
    for place, away, bearing in ((0.0, 6.0, 0.06), (5.0, 1.0, 0.0)):
        cells.relocalise((place, 0.0))
        for _ in range(40):
            cells.advance(STILL, Sightings.of(np.array([[0.0, away, bearing]])))
    between = cells.landmarks()["place_m"][0, 1]
    assert 0.0 < between < 0.35 * 6.0 * 0.06  # half of it, were both as certain


def test_uncertainty_is_saved_and_goes_on_bit_for_bit():
    cells = taught(20, (0.1, 0.02), **SIGMA)
    again = SemanticCells(cells.config)
    again.load_state_dict(cells.state_dict())
    rows = Sightings.of(np.array([[1.0, 3.1, 1.5], [7.0, 2.0, 0.0]]))
    for one in (cells, again):
        for _ in range(20):
            one.advance(STILL, rows)
    mine, its = cells.state_dict(), again.state_dict()
    assert mine["slam.evidence_s"].shape == (1, 4)
    assert bool((mine["slam.evidence_s"] > 0).all())
    assert all(torch.equal(mine[key], its[key]) for key in mine)


def test_a_new_name_does_not_forget_how_much_was_learnt(uncertain):
    cells = SemanticCells(uncertain.config)
    cells.load_state_dict(uncertain.state_dict())
    cells.name_landmarks([LandmarkWords("DOOR", number=1)])
    assert torch.equal(cells.slam.evidence_s, uncertain.slam.evidence_s)


def test_a_merge_keeps_the_certainty_and_turns_it_with_the_map(uncertain):
    turn = math.radians(90.0)
    join = Join.nothing()._replace(onto=Pose(0.0, 0.0, turn))
    other = taught(places=np.array([[5.0, 0.0]]), **SIGMA)
    with torch.inference_mode():
        other.known["number"][0] = 9
        other.known.index()
    state = merge_landmarks(
        lambda: SemanticCells(uncertain.config), uncertain.state_dict(), other.state_dict(), join
    )
    merged = SemanticCells(uncertain.config)
    merged.load_state_dict(state)
    spread = merged.covariances()
    for k, place in enumerate(PLACES):
        np.testing.assert_allclose(spread[k], expected(place), atol=0.005)
    turned = rotation_matrix(turn) @ expected(np.array([5.0, 0.0])) @ rotation_matrix(turn).T
    np.testing.assert_allclose(spread[3], turned, atol=0.005)
    np.testing.assert_allclose(merged.landmarks()["place_m"][3], (0.0, 5.0), atol=0.01)
    evidence = uncertain.slam.evidence_s[0].tolist() + other.slam.evidence_s[0].tolist()
    assert merged.slam.evidence_s[0].tolist() == pytest.approx(evidence)


def test_a_map_that_relaxes_moves_landmarks_with_their_certainty(uncertain):
    cells = SemanticCells(uncertain.config)
    cells.load_state_dict(uncertain.state_dict())
    certainty = cells.covariances()
    cells.known["place_m"][:] += 1.0
    cells.write_memory(certainty)
    np.testing.assert_allclose(cells.covariances(), certainty, atol=1e-3)
    one = ask(cells, "where is landmark_0").found[0]
    np.testing.assert_allclose(one.position_m, PLACES[0] + 1.0, atol=0.01)


def test_answers_show_the_uncertainty_as_ellipse_number_and_table(uncertain):
    answer = ask(uncertain, "where is landmark_0")
    figure = plot_answer(answer, np.empty((0, 2)), np.empty((0, 2), dtype=np.int64))
    shapes = [p for p in figure.axes[0].patches if isinstance(p, Ellipse)]
    assert len(shapes) == 2 * len(PLACES)
    sizes = [(s.width, s.height) for s in shapes[:2]]
    np.testing.assert_allclose(sizes, [(0.8, 0.6), (1.6, 1.2)], atol=0.03)
    row = answer.to_dict()["found"][0]
    assert json.loads(json.dumps(row))["covariance_m2"][0][0] == pytest.approx(0.09, abs=0.01)
    lines = uncertain.tables()["landmarks.csv"].splitlines()
    assert lines[0].endswith(",var_x_m2,cov_xy_m2,var_y_m2")
    assert float(lines[1].split(",")[-1]) == pytest.approx(0.16, abs=0.01)


def views_of(vectors):
    vectors = np.asarray(vectors, dtype=np.float64)[None]
    n = vectors.shape[1]
    return LandmarkView(
        np.ones((1, n), dtype=bool), np.hypot(*vectors.T).T, vectors, vectors, np.arange(n)
    )


@pytest.mark.parametrize("tier", ["algebraic", "spiking"])
def test_maps_of_uncertain_landmarks_are_saved_and_merged_in_any_tier(tier, tmp_path, call):
    config = SSPSLAMConfig(
        tier=tier, time_step_s=0.01 if tier == "algebraic" else 1e-3,
        integrator=PathIntegratorConfig(neurons=100), binding="exact", vector_neurons=0,
        map=SemanticMapConfig(neurons=400, pes_rate=0.02), sigma_bearing_rad=0.3, turn_s=0.2,
    )  # fmt: skip
    steps = 300 if tier == "algebraic" else 1600
    vectors = [[0.3, 0.0], [0.0, 0.25]]
    maps = []
    for shift in (0.0, 0.2):
        slam = SSPSLAM(config, torch.nn.functional.one_hot(torch.arange(2), 55).float(), ["A", "B"])
        slam.start(torch.tensor([[shift, 0.0]]))
        view = views_of(vectors)
        whole = LandmarkView(
            *(np.tile(p, (steps, *[1] * p.ndim)) for p in view[:4]), np.arange(2)
        )  # fmt: skip
        slam.run(torch.zeros(steps, 1, 2), whole)
        maps.append(slam)
    save_semantic_map(maps[0], tmp_path / "map.safetensors")
    again = load_semantic_map(tmp_path / "map.safetensors")
    assert torch.equal(again.evidence_s, maps[0].evidence_s)
    said = call("ask", tmp_path / "map.safetensors", "where is A").out
    assert "sd (m)" in said
    merged, report = merge_semantic_maps(again, maps[1])
    assert report.joined, report.reason
    torch.testing.assert_close(merged.evidence_s, maps[0].evidence_s + maps[1].evidence_s)
    margin = 0.01 if tier == "algebraic" else 0.03
    for slam in (maps[0], merged):
        one = ask(slam, "where is A").found[0]
        assert one.sigma_m == pytest.approx((0.09, 0.0), abs=2 * margin)
        assert one.position_m == pytest.approx((0.3, 0.0), abs=margin)


@pytest.mark.parametrize("given", [{"attention": "sum"}, {"quantised": True}])
def test_what_cannot_hold_uncertainty_refuses_it(given):
    with pytest.raises(ValidationError, match="expected both 0 there"):
        SSPSLAMConfig(sigma_distance_m=0.1, **given)
    assert not SSPSLAMConfig(**given).has_uncertain_sightings
