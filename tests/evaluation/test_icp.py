import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import cdist

from neuroslam.errors import MapError
from neuroslam.evaluation.icp import SCALE_FACTOR, fraction_of_diagonal, icp, map_rmse
from neuroslam.evaluation.trajectory import Alignment, absolute_trajectory_error

angles = st.floats(-math.pi, math.pi)
shifts = st.tuples(st.floats(-50.0, 50.0), st.floats(-50.0, 50.0)).map(np.array)
seeds = st.integers(0, 10_000)
MODES = ["rigid", "similarity"]


def rotation_by(angle):
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s], [s, c]])


def cloud(seed, n=80):
    return np.random.default_rng(seed).uniform([-15.0, -10.0], [15.0, 10.0], (n, 2))


def road(seed, n=400):
    rng = np.random.default_rng(seed)
    heading = np.cumsum(rng.normal(0.0, 0.15, n))
    return np.cumsum(0.5 * np.column_stack([np.cos(heading), np.sin(heading)]), axis=0)


def ellipse(n):
    at = np.arange(n) * (2.0 * math.pi / n)
    return np.column_stack([8.0 * np.cos(at), 3.0 * np.sin(at)])


@given(seed=seeds, angle=angles, shift=shifts)
@settings(max_examples=40, deadline=None)
def test_a_turned_and_shifted_map_is_aligned_with_itself(seed, angle, shift):
    target = cloud(seed)
    found = map_rmse(target @ rotation_by(angle).T + shift, target)
    assert found.rmse < 1e-9
    assert found.converged
    np.testing.assert_allclose(found.alignment.rotation, rotation_by(-angle), atol=1e-9)
    np.testing.assert_allclose(found.alignment.translation, -rotation_by(-angle) @ shift, atol=1e-8)
    assert found.alignment.scale == 1.0
    np.testing.assert_array_equal(found.pairs, np.arange(len(target)))


@given(seed=seeds, angle=angles, scale=st.floats(1e-3, 1e3))
@settings(max_examples=30, deadline=None)
def test_a_similarity_finds_the_unit_of_the_source(seed, angle, scale):
    target = road(seed)
    found = map_rmse(scale * target @ rotation_by(angle).T, target, "similarity")
    assert found.rmse < 1e-9
    assert found.alignment.scale == pytest.approx(1.0 / scale, rel=1e-9)
    np.testing.assert_allclose(found.alignment.rotation, rotation_by(-angle), atol=1e-9)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("make", [cloud, road])
def test_a_small_motion_is_undone_from_the_identity(make, mode):
    target = make(3)
    # Moved by less than most nodes are apart, so nearly every pair is right at once.
    source = (target - target.mean(axis=0)) @ rotation_by(0.005).T + target.mean(axis=0) + 0.01
    found = icp(source, target, mode)
    assert found.rmse < 1e-9
    assert found.converged
    assert found.n_iterations <= 5
    np.testing.assert_allclose(found.alignment.apply(source), target, atol=1e-9)


@pytest.mark.parametrize("mode", MODES)
def test_the_rmse_is_that_of_every_source_point_to_its_nearest_target_point(mode):
    source, target = cloud(1, n=50), cloud(2, n=70)
    found = icp(source, target, mode)
    distances = cdist(found.alignment.apply(source), target)
    np.testing.assert_array_equal(found.pairs, distances.argmin(axis=1))
    assert found.rmse == pytest.approx(math.sqrt(np.mean(distances.min(axis=1) ** 2)))


def test_the_rmse_is_zero_only_where_every_source_point_lies_on_a_target_point():
    target = road(5)
    stray = np.vstack([target, target[200] + [0.0, 30.0]])
    assert map_rmse(target, stray).rmse < 1e-9  # a target point no source point needs is free
    assert map_rmse(stray, target).rmse > 0.1  # a source point is not


def test_zero_steps_only_measure_the_start():
    target = np.array([[0.0, 0.0], [10.0, 0.0]])
    found = icp(target + np.array([0.0, 3.0]), target, max_iterations=0)
    assert (found.rmse, found.n_iterations, found.converged) == (3.0, 0, False)


@pytest.mark.parametrize("mode", MODES)
def test_more_steps_never_raise_the_error(mode):
    source, target = road(1), road(2)
    errors = [icp(source, target, mode, max_iterations=n).rmse for n in range(30)]
    assert errors[-1] < errors[0]
    assert max(np.diff(errors)) <= 1e-12  # rounding


@pytest.mark.parametrize("mode", MODES)
def test_a_search_started_at_its_result_stays_there(mode):
    target = cloud(2)
    source = 1.01 * target + np.random.default_rng(0).normal(0.0, 0.5, target.shape)
    found = icp(source, target, mode)
    assert found.n_iterations > 1
    again = icp(source, target, mode, initial=found.alignment)
    assert found.converged
    assert again.n_iterations == 1
    assert again.rmse == pytest.approx(found.rmse, abs=1e-10)


@given(first=seeds, second=seeds, angle=angles)
@settings(max_examples=15, deadline=None)
def test_a_similarity_fits_no_worse_than_a_rigid_motion(first, second, angle):
    target = cloud(first)
    source = cloud(second) @ rotation_by(angle).T
    assert map_rmse(source, target, "similarity").rmse <= map_rmse(source, target).rmse + 1e-12


@pytest.mark.parametrize("seed", range(5))
def test_many_starts_fit_no_worse_than_the_identity(seed):
    source, target = road(seed), road(seed + 100)
    assert map_rmse(source, target).rmse <= icp(source, target).rmse


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("seed", range(5))
def test_a_part_of_a_map_that_is_aligned_stays(seed, mode):
    target = road(seed)
    part = target[:330]  # its centre is metres away from that of the whole
    found = map_rmse(part, target, mode)
    assert found.rmse < 1e-9
    np.testing.assert_array_equal(found.pairs, np.arange(330))


def test_unpaired_points_fit_no_worse_than_paired_ones():
    target = road(8)
    source = target + np.random.default_rng(0).normal(0.0, 0.3, target.shape)
    assert map_rmse(source, target).rmse <= absolute_trajectory_error(source, target).rmse


@pytest.mark.parametrize("mode", MODES)
def test_the_order_of_the_target_does_not_matter_and_twice_is_the_same(mode):
    source, target = cloud(1), cloud(2)
    order = np.random.default_rng(0).permutation(len(target))
    once, twice = map_rmse(source, target, mode), map_rmse(source, target, mode)
    shuffled = map_rmse(source, target[order], mode)
    assert once.rmse == twice.rmse
    assert shuffled.rmse == pytest.approx(once.rmse, abs=1e-9)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("angle", [0.0, 1.0, math.pi / 2, math.pi, -2.5])
def test_a_shape_with_two_solutions_still_fits_exactly(angle, mode):
    target = ellipse(120)
    found = map_rmse(target @ rotation_by(angle).T + [4.0, -7.0], target, mode)
    assert found.rmse < 1e-9
    turned = found.alignment.rotation @ rotation_by(angle)
    np.testing.assert_allclose(np.abs(turned), np.eye(2), atol=1e-9)  # nothing, or half a turn


def test_a_shape_without_a_principal_axis_fits_exactly():
    at = np.arange(6) * (math.pi / 3.0)
    hexagon = np.column_stack([np.cos(at), np.sin(at)])
    assert map_rmse(hexagon @ rotation_by(0.4).T, hexagon).rmse < 1e-9


def test_a_straight_corridor_fits_exactly():
    corridor = np.column_stack([np.arange(30.0), np.zeros(30)])
    assert map_rmse(corridor @ rotation_by(2.0).T + 5.0, corridor).rmse < 1e-9


@pytest.mark.parametrize("seed", range(10))
def test_half_of_the_nodes_are_found_among_all(seed):
    target = cloud(seed, n=300)
    rng = np.random.default_rng(seed)
    half = target[rng.permutation(300)[:150]]
    found = map_rmse(half @ rotation_by(rng.uniform(-3.0, 3.0)).T + 9.0, target)
    assert found.rmse < 1e-9
    np.testing.assert_allclose(target[found.pairs], half, atol=1e-9)


def test_more_nodes_than_the_coarse_search_takes_fit_exactly():
    target = road(4, n=2000)
    assert map_rmse(target @ rotation_by(2.0).T - 3.0, target).rmse < 1e-9


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("sigma", [0.01, 0.05])
def test_noise_far_below_the_spacing_gives_its_own_rmse(sigma, mode):
    # Nodes 1 m apart, so each is paired with itself: sqrt(2) sigma, of 2 n terms, n = 600.
    x, y = np.meshgrid(np.arange(30.0), np.arange(20.0))
    target = np.column_stack([x.ravel(), y.ravel()])
    noise = np.random.default_rng(7).normal(0.0, sigma, target.shape)
    found = map_rmse((target + noise) @ rotation_by(2.0).T, target, mode)
    assert found.rmse == pytest.approx(math.sqrt(2.0) * sigma, rel=0.1)  # 3 % is one deviation
    assert found.alignment.scale == pytest.approx(1.0, abs=sigma / 10)


@given(first=seeds, second=seeds, unit=st.floats(1e-2, 1e2))
@settings(max_examples=15, deadline=None)
def test_the_scale_never_collapses(first, second, unit):
    # Two roads that have nothing in common: the smaller the source, the better it would fit.
    source, target = unit * road(first, n=150), road(second, n=150)
    spread = [np.linalg.norm(m - m.mean(axis=0)) for m in (source, target)]
    found = map_rmse(source, target, "similarity")
    away = found.alignment.scale * spread[0] / spread[1]
    assert 1.0 / SCALE_FACTOR - 1e-9 <= away <= SCALE_FACTOR + 1e-9


def test_a_source_whose_nodes_share_one_nearest_node_keeps_its_size():
    target = np.array([[0.0, 0.0], [100.0, 0.0]])
    source = np.array([[-1.0, 2.0], [1.0, 2.0]])
    found = icp(source, target, "similarity")
    assert found.alignment.scale == 1.0
    assert found.rmse == pytest.approx(1.0)  # only moved: one node either side of the shared one


def test_a_scale_at_its_bound_is_the_best_within_it():
    target = np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 2.0], [2.0, 2.0]])
    centre = np.array([1.0, 1.0])
    source = centre + (target - centre) / 1.8  # 1.8 would be needed, 1.5 is allowed
    found = icp(source, target, "similarity")
    assert found.alignment.scale == SCALE_FACTOR
    assert found.rmse == pytest.approx(math.sqrt(2.0) * (1.0 - 1.5 / 1.8))
    np.testing.assert_allclose(found.alignment.apply(centre[None]), centre[None], atol=1e-12)


def test_a_start_near_the_solution_aligns_a_part_of_a_map():
    target = road(6)
    part = target[250:330]
    source = (part - [70.0, 0.0]) @ rotation_by(2.0)
    start = Alignment(rotation_by(2.001), np.array([70.0, 0.0]), 1.0)
    found = icp(source, target, initial=start)
    assert found.rmse < 1e-9
    np.testing.assert_array_equal(found.pairs, np.arange(250, 330))


def test_the_diagonal_is_that_of_the_target():
    assert fraction_of_diagonal(1.0, [[1.0, 1.0], [4.0, 5.0], [4.0, 1.0]]) == pytest.approx(0.2)


pair = np.array([[0.0, 0.0], [1.0, 0.0]])


@pytest.mark.parametrize("compare", [icp, map_rmse])
@pytest.mark.parametrize(
    ("source", "target", "says"),
    [
        (np.zeros((3, 3)), pair, r"source has shape \(3, 3\), expected \(n, 2\)"),
        (pair, np.zeros(4), r"target has shape \(4,\), expected \(n, 2\)"),
        (np.zeros((0, 2)), pair, r"source has 0 point\(s\), all equal"),
        (pair, pair[:1], r"target has 1 point\(s\), all equal"),
        (np.full((5, 2), 0.1), pair, r"source has 5 point\(s\), all equal"),
        (pair, np.array([[0.0, 0.0], [np.nan, 0.0]]), "point 1 of the target is not finite"),
        (np.array([[np.inf, 0.0], [1.0, 0.0]]), pair, "point 0 of the source is not finite"),
    ],
)
def test_an_invalid_map_is_refused_in_one_line(compare, source, target, says):
    with pytest.raises(MapError, match=says) as refused:
        compare(source, target)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("compare", [icp, map_rmse])
def test_an_unknown_mode_is_refused(compare):
    with pytest.raises(MapError, match="mode is 'none', expected 'rigid' or 'similarity'"):
        compare(pair, pair, "none")


@pytest.mark.parametrize(
    ("initial", "mode", "says"),
    [
        (Alignment(np.eye(2), np.zeros(2), 2.0), "rigid", "initial scale is 2, but mode 'rigid'"),
        (Alignment(np.eye(2), np.zeros(2), 0.0), "similarity", "initial scale is 0, expected"),
        (Alignment(np.eye(2), np.zeros(2), np.nan), "similarity", "initial scale is nan, expected"),
        (Alignment(np.eye(3), np.zeros(3), 1.0), "rigid", r"shapes \(3, 3\) and \(3,\)"),
        (Alignment(np.eye(2), np.full(2, np.nan), 1.0), "rigid", "alignment is not finite"),
    ],
)
def test_a_wrong_start_is_refused(initial, mode, says):
    with pytest.raises(MapError, match=says):
        icp(pair, pair, mode, initial)


def test_a_fraction_of_an_invalid_map_is_refused():
    with pytest.raises(MapError, match=r"target has 2 point\(s\), all equal"):
        fraction_of_diagonal(1.0, np.ones((2, 2)))
