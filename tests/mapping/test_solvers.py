"""Facts about the two solvers of the map: relaxation and sparse least squares."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from neuroslam import compiled as switch
from neuroslam.errors import MapError
from neuroslam.geometry import wrap_angles
from neuroslam.mapping.least_squares import _jacobian, _Links, _residuals, solve_pose_graph
from neuroslam.mapping.relax import Relaxation, _displacements, relax_sequentially


def links_between(poses, source, target, rng=None, sigma_m=0.0, sigma_rad=0.0):
    """Links from each source to each target as measured, with noise."""
    apart = poses[target] - poses[source]
    bearing = np.arctan2(apart[:, 1], apart[:, 0])
    noise = np.zeros((2, len(source))) if rng is None else rng.normal(size=(2, len(source)))
    return (
        source,
        target,
        np.hypot(apart[:, 0], apart[:, 1]) + sigma_m * noise[0],
        bearing - poses[source, 2],
        wrap_angles(apart[:, 2] + sigma_rad * noise[1]),
    )


def laps(n, n_laps, n_loops, rng, radius_m=20.0, sigma_m=0.02, sigma_rad=0.005, false_share=0.0):
    """Laps of a circle: truth, its odometry, noisy links, and which of them are false loops."""
    angle = np.linspace(0.0, 2 * np.pi * n_laps, n, endpoint=False)
    truth = np.column_stack([radius_m * np.cos(angle), radius_m * np.sin(angle), angle])
    again = rng.integers(n // n_laps, n, n_loops)
    before = again - n // n_laps * rng.integers(1, again // (n // n_laps) + 1)
    source, target = np.append(np.arange(n - 1), again), np.append(np.arange(1, n), before)
    links = links_between(truth, source, target, rng, sigma_m, sigma_rad)
    false = (np.arange(len(source)) >= n - 1) & (rng.random(len(source)) < false_share)
    target[false] = rng.integers(0, n, false.sum())
    odometry = truth.copy()
    for k in range(n - 1):
        bearing = odometry[k, 2] + links[3][k]
        step = links[2][k] * np.array([np.cos(bearing), np.sin(bearing)])
        odometry[k + 1] = [*(odometry[k, :2] + step), odometry[k, 2] + links[4][k]]
    return truth, odometry, links, false


def squared_error(poses, source, target, distance_m, heading_rad, facing_rad):
    bearing = poses[source, 2] + heading_rad
    apart = poses[target] - poses[source]
    return float(
        np.sum((apart[:, 0] - distance_m * np.cos(bearing)) ** 2)
        + np.sum((apart[:, 1] - distance_m * np.sin(bearing)) ** 2)
        + np.nansum(wrap_angles(apart[:, 2] - facing_rad) ** 2)
    )


def differ(first, second):
    difference = first - second
    difference[:, 2] = wrap_angles(difference[:, 2])
    return np.abs(difference).max()


@pytest.fixture(scope="module")
def reference_map(shared):
    folder = shared / "refs" / "ratslam" / "unit"

    def read(name):
        return np.loadtxt(folder / f"em200_{name}.csv", delimiter=",", skiprows=1)

    table = read("links")
    links = (table[:, 0].astype(np.int64), table[:, 1].astype(np.int64), *table[:, 2:5].T)
    return links, {loops: read(f"it{loops}")[:, 1:] for loops in (0, 1, 100)}


@st.composite
def random_maps(draw):
    n = draw(st.integers(2, 12))
    n_links = draw(st.integers(1, 30))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    source = rng.integers(0, n, n_links)
    target = (source + rng.integers(1, n, n_links)) % n
    facing = rng.uniform(-np.pi, np.pi, n_links)
    facing[rng.random(n_links) < draw(st.sampled_from([0.0, 0.3]))] = np.nan
    poses = rng.uniform(-np.pi, np.pi, (n, 3))
    links = source, target, rng.uniform(0, 3, n_links), rng.uniform(-np.pi, np.pi, n_links), facing
    return poses, links, draw(st.sampled_from([0.1, 0.35, 0.5]))


@settings(max_examples=150, deadline=None)
@given(random_maps(), st.integers(1, 4))
def test_fast_relaxation_equals_sequential_relaxation(random_map, loops):
    poses, links, correction = random_map
    fast, _ = Relaxation(*links).run(poses, loops, correction)
    slow = poses
    for _ in range(loops):
        slow = relax_sequentially(slow, *links, correction=correction)
    assert differ(fast, slow) < 1e-9


@st.composite
def maps_at_rest_but_for_a_loop(draw):
    """A chain whose links agree to the last bit, and a loop that bends it; a link added later."""
    n, rng = draw(st.integers(3, 60)), np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    poses = np.zeros((n, 3))
    poses[:, 0] = np.arange(n)
    poses[:, 1:] = draw(st.sampled_from([0.0, 0.25]))  # at 0, movements die out much later
    chain = [np.arange(n - 1), np.arange(1, n), np.ones(n - 1), np.full(n - 1, -poses[0, 2]),
             np.zeros(n - 1)]  # fmt: skip
    loops = [
        (*rng.choice(n, 2, replace=False), rng.uniform(0, n / 4), *rng.uniform(-0.1, 0.1, 2))
        for _ in range(2)
    ]
    return poses, chain, loops


@settings(max_examples=60, deadline=None)
@given(maps_at_rest_but_for_a_loop(), st.integers(1, 45), st.integers(0, 59))
def test_links_passed_over_alter_no_bit(a_map, loops, pushed):
    poses, links, more = a_map
    relaxation, kept = Relaxation(*links), poses
    for frame in range(6):
        if frame in (1, 4):
            link = more[frame // 3]
            relaxation.add_link(*link)
            links = [np.append(column, value) for column, value in zip(links, link, strict=True)]
        if frame == 3:
            kept, poses = kept.copy(), poses.copy()
            kept[pushed % len(poses), :2] += 0.5
            poses[pushed % len(poses), :2] += 0.5
        kept, moved = relaxation.run(kept, loops, 0.4)
        for _ in range(loops):
            poses, last = Relaxation(*links).run(poses, 1, 0.4)  # knows of no visit: none skipped
        assert kept.tobytes() == poses.tobytes()
        assert moved == last


@pytest.mark.skipif(not switch.ENABLED, reason="the definition visits every link")
def test_a_loop_in_a_map_at_rest_is_not_felt_far_from_it():
    n = 400
    poses = np.column_stack([np.arange(n), np.full((n, 2), 0.5)])
    ends, one = (np.arange(n - 1), np.arange(1, n)), np.ones(n - 1)
    relaxation = Relaxation(*ends, one, -0.5 * one, 0.0 * one)
    poses, _ = relaxation.run(poses, 1, 0.5)
    for frame in range(5):
        if frame == 1:
            relaxation.add_link(199, 210, 10.0, -0.5, 0.1)
        poses, _ = relaxation.run(poses, 10, 0.5)
        altered = int(relaxation._counts[0])
        assert altered == 0 if frame == 0 else 0 < altered < 400  # of 1600


def test_displacements_are_exact_at_any_angle():
    rng = np.random.default_rng(0)
    bearing = np.concatenate([rng.uniform(-300.0, 300.0, 20_000), np.arange(-40, 41) * np.pi / 4])
    distance = rng.uniform(0.0, 5.0, bearing.size)
    along_x, along_y = np.empty((2, bearing.size))
    _displacements(bearing, distance, along_x, along_y)
    np.testing.assert_allclose(along_x, distance * np.cos(bearing), rtol=0.0, atol=3e-15)
    np.testing.assert_allclose(along_y, distance * np.sin(bearing), rtol=0.0, atol=3e-15)


@settings(max_examples=30, deadline=None)
@given(random_maps(), st.integers(0, 5))
def test_relaxing_leaves_the_centre_of_the_map_where_it_is(random_map, loops):
    poses, links, correction = random_map
    relaxed, _ = Relaxation(*links).run(poses, loops, correction)
    np.testing.assert_allclose(relaxed[:, :2].mean(0), poses[:, :2].mean(0), atol=1e-12)


@pytest.mark.parametrize("loops", [1, 100])
def test_relaxation_equals_the_reference_program(reference_map, loops):
    links, poses = reference_map
    relaxed, _ = Relaxation(*links).run(poses[0], loops, 0.5)
    assert differ(relaxed, poses[loops]) < 1e-12


def test_a_run_split_in_two_gives_the_same_map(reference_map):
    links, poses = reference_map
    relaxation = Relaxation(*links)
    whole, _ = relaxation.run(poses[0], 30, 0.5)
    part, _ = relaxation.run(poses[0], 12, 0.5)
    rest, _ = Relaxation(*links).run(part, 18, 0.5)
    assert differ(whole, rest) < 1e-12


def test_a_map_whose_links_agree_has_converged():
    rng = np.random.default_rng(0)
    truth, _, links, _ = laps(60, 3, 10, rng, sigma_m=0.0, sigma_rad=0.0)
    relaxed, moved = Relaxation(*links).run(truth, 20, 0.5, tolerance=1e-9)
    assert moved < 1e-9
    assert differ(relaxed, truth) < 1e-9


def test_contradictory_links_converge_too():
    links = [np.array(v) for v in ([0, 0], [1, 1], [1.0, 2.0], [0.0, 0.0], [0.0, 0.0])]
    relaxed, moved = Relaxation(*links).run(np.zeros((2, 3)), 100, 0.5, tolerance=1e-12)
    assert moved < 1e-12
    assert 1.0 <= relaxed[1, 0] - relaxed[0, 0] <= 2.0


def test_a_map_without_links_does_not_change():
    none, no = np.empty(0, np.int64), np.empty(0)
    poses = np.array([[1.0, 2.0, 0.5]])
    relaxed, moved = Relaxation(none, none, no, no, no).run(poses, 20, 0.5)
    assert relaxed.tolist() == poses.tolist()
    assert moved == 0.0
    solved, report = solve_pose_graph(poses, none, none, no, no, no)
    assert solved.tolist() == poses.tolist()
    assert report.converged


def test_a_pose_that_is_not_a_number_does_not_hang_the_relaxation():
    links = [np.array([v]) for v in (0, 1, 1.0, 0.0, 0.0)]
    relaxed, _ = Relaxation(*links).run(np.array([[0, 0, np.nan], [0, 0, 0]]), 3, 0.5)
    assert np.isnan(relaxed).any()


@settings(max_examples=30, deadline=None)
@given(random_maps())
def test_the_jacobian_is_the_derivative_of_the_residuals(random_map):
    poses, (source, target, distance, heading, facing), _ = random_map
    scale = np.column_stack([np.full((len(source), 2), 2.0), np.where(np.isnan(facing), 0.0, 3.0)])
    measured = np.column_stack([distance * np.cos(heading), distance * np.sin(heading), facing])
    links = _Links(source, target, np.nan_to_num(measured), scale)
    step = np.random.default_rng(1).normal(size=poses.shape) * 1e-6
    step[0] = 0.0
    change = _residuals(poses + step, links) - _residuals(poses - step, links)
    change = wrap_angles(change / np.maximum(scale, 1.0)) * np.maximum(scale, 1.0)
    predicted = 2.0 * _jacobian(poses, links) @ step.ravel()
    np.testing.assert_allclose(change.ravel(), predicted, atol=1e-9)


def test_least_squares_has_less_error_than_a_thousand_relaxation_loops(reference_map):
    links, poses = reference_map
    relaxed, _ = Relaxation(*links).run(poses[0], 1000, 0.5)
    solved, report = solve_pose_graph(poses[0], *links)
    assert report.converged
    assert report.iterations < 20
    assert squared_error(solved, *links) < squared_error(relaxed, *links)
    assert report.cost == pytest.approx(squared_error(solved, *links))


def test_least_squares_closes_laps_better_than_relaxation():
    truth, odometry, links, _ = laps(600, 3, 60, np.random.default_rng(2), sigma_rad=0.02)
    relaxed, _ = Relaxation(*links).run(odometry, 1000, 0.5)
    solved, report = solve_pose_graph(odometry, *links, sigma_m=0.02, sigma_rad=0.02)
    assert report.converged
    assert squared_error(solved, *links) < squared_error(relaxed, *links)
    worst = np.linalg.norm(odometry[:, :2] - truth[:, :2], axis=1).max()
    assert np.linalg.norm(solved[:, :2] - truth[:, :2], axis=1).max() < worst / 4


def test_links_without_error_give_the_truth_and_keep_the_first_pose():
    truth, _, links, _ = laps(90, 3, 20, np.random.default_rng(3), sigma_m=0.0, sigma_rad=0.0)
    start = truth + np.random.default_rng(4).normal(size=truth.shape) * [[1.0, 1.0, 0.2]]
    start[0] = truth[0]
    solved, report = solve_pose_graph(start, *links)
    assert differ(solved, truth) < 1e-6
    assert solved[0].tolist() == truth[0].tolist()
    assert report.cost < 1e-12


def test_a_link_with_unknown_facing_moves_positions_only():
    links = [np.array(v) for v in ([0, 1], [1, 0], [2.0, 0.0], [0.0, 0.0], [0.5, np.nan])]
    start = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.5]])
    solved, _ = solve_pose_graph(start, *links)
    np.testing.assert_allclose(solved, [[0, 0, 0], [1.0, 0.0, 0.5]], atol=1e-6)
    relaxed, _ = Relaxation(*links).run(start, 50, 0.2)
    np.testing.assert_allclose(relaxed[:, 2], [0.0, 0.5], atol=1e-12)


def test_confidence_weighs_as_inverse_variance():
    links = [np.array(v) for v in ([0, 0], [1, 1], [1.0, 2.0], [0.0, 0.0], [0.0, 0.0])]
    start = np.zeros((2, 3))
    by_confidence, _ = solve_pose_graph(start, *links, confidence=np.array([1.0, 0.25]))
    by_sigma, _ = solve_pose_graph(start, *links, sigma_m=np.array([1.0, 2.0]))
    np.testing.assert_allclose(by_confidence[1, 0], 1.2, atol=1e-6)
    np.testing.assert_allclose(by_sigma[1, 0], 1.2, atol=1e-6)


def test_unconnected_parts_are_solved_separately():
    links = [np.array(v) for v in ([0, 2], [1, 3], [1.0, 1.0], [0.0, 0.0], [0.0, 0.0])]
    start = np.array([[0, 0, 0], [3, 0, 0], [5, 5, 0], [7, 5, 0]], dtype=float)
    solved, _ = solve_pose_graph(start, *links)
    np.testing.assert_allclose(solved[1], [1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(solved[3, :2] - solved[2, :2], [1, 0], atol=1e-6)


@pytest.mark.parametrize("knows_facing", [True, False])
@pytest.mark.parametrize("seed", range(4))
def test_laps_with_half_of_the_loops_false_are_solved_to_the_truth(seed, knows_facing):
    rng = np.random.default_rng(seed)
    _, odometry, links, false = laps(300, 3, 80, rng, false_share=0.5)
    rejectable = np.arange(len(false)) >= 299
    if not knows_facing:
        links[4][rejectable] = np.nan
    sigma = {"sigma_m": 0.02, "sigma_rad": 0.005}
    solved, report = solve_pose_graph(odometry, *links, **sigma, rejectable=rejectable)
    ideal, _ = solve_pose_graph(odometry, *(link[~false] for link in links), **sigma)
    inlier = report.weights > 0
    assert inlier[~rejectable].all()
    assert (inlier & false).sum() <= 2  # a false loop between neighbours is hardly false
    assert (inlier & rejectable & ~false).sum() >= 0.9 * (rejectable & ~false).sum()
    assert np.linalg.norm(solved[:, :2] - ideal[:, :2], axis=1).max() < 0.3
    without_rejection, _ = solve_pose_graph(odometry, *links, **sigma)
    assert np.linalg.norm(without_rejection[:, :2] - ideal[:, :2], axis=1).max() > 5.0


def test_the_same_seed_gives_the_same_map():
    _, odometry, links, false = laps(120, 3, 40, np.random.default_rng(9), false_share=0.5)
    rejectable = np.arange(len(false)) >= 119
    first, second = (solve_pose_graph(odometry, *links, rejectable=rejectable)[0] for _ in range(2))
    assert first.tobytes() == second.tobytes()


def test_the_error_names_the_invalid_link_or_pose():
    links = [np.array([v]) for v in (0, 5, 1.0, 0.0, 0.0)]
    with pytest.raises(MapError, match="links end at poses 0 to 5, expected 0 to 1"):
        solve_pose_graph(np.zeros((2, 3)), *links)
    links[1][:] = 1
    with pytest.raises(MapError, match=r"pose 1 is \[nan"):
        solve_pose_graph(np.array([[0, 0, 0], [np.nan, 0, 0]]), *links)
    links[2][:] = np.inf
    with pytest.raises(MapError, match="link 0 is"):
        solve_pose_graph(np.zeros((2, 3)), *links)
