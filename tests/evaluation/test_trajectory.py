import math

import numpy as np
import pytest
from evo.core import metrics, sync
from evo.core.trajectory import PoseTrajectory3D
from evo.core.units import Unit
from evo.tools import file_interface
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from neuroslam.errors import MapError, SourceError
from neuroslam.evaluation.trajectory import (
    Track,
    absolute_trajectory_error,
    align,
    associate,
    path_length,
    read_tum,
    relative_pose_error,
    shape_rmse,
    write_tum,
)
from neuroslam.geometry import integrate_velocities

coordinate = st.floats(-100.0, 100.0)
tracks = st.integers(3, 30).flatmap(lambda n: arrays(np.float64, (n, 2), elements=coordinate))
angles = st.floats(-math.pi, math.pi)


def turn(points, angle):
    c, s = math.cos(angle), math.sin(angle)
    return points @ np.array([[c, -s], [s, c]]).T


def wandering(seed, n=400):
    rng = np.random.default_rng(seed)
    speed, rate = rng.uniform(-0.2, 1.0, n), rng.normal(0.0, 0.8, n)
    return integrate_velocities(speed, rate, np.full(n, 0.1))


def noisy(poses, seed):
    rng = np.random.default_rng(seed)
    drift = np.cumsum(rng.normal(0.0, [0.02, 0.02, 0.01], poses.shape), axis=0)
    out = poses + drift
    out[:, :2] = 1.3 * turn(out[:, :2], 0.7) + [5.0, -2.0]
    out[:, 2] += 0.7
    return out


def real_pair(shared):
    csv = shared / "data/circuit_launch/odometry_vo.csv"
    v, w = np.loadtxt(csv, delimiter=",", skiprows=1).T
    dt = np.full(len(v), 0.05)
    return integrate_velocities(0.97 * v, w + 0.01, dt), integrate_velocities(v, w, dt)


def as_evo(poses):
    half = poses[:, 2] / 2
    zero = np.zeros(len(poses))
    return PoseTrajectory3D(
        positions_xyz=np.column_stack([poses[:, :2], zero]),
        orientations_quat_wxyz=np.column_stack([np.cos(half), zero, zero, np.sin(half)]),
        timestamps=np.arange(len(poses), dtype=float),
    )


def evo_ate(estimate, truth, mode):
    est, ref = as_evo(estimate), as_evo(truth)
    if mode != "none":
        est.align(ref, correct_scale=mode == "similarity")
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((ref, est))
    return ape.get_all_statistics()


def evo_rpe(estimate, truth, delta, relation):
    rpe = metrics.RPE(relation, delta=delta, delta_unit=Unit.frames, all_pairs=True)
    rpe.process_data((as_evo(truth), as_evo(estimate)))
    return rpe.get_all_statistics()


def assert_equals_evo(ours, theirs):
    for name in ("rmse", "mean", "median", "max"):
        assert getattr(ours, name) == pytest.approx(theirs[name], abs=1e-9), name


@pytest.mark.parametrize("mode", ["none", "rigid", "similarity"])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_absolute_error_agrees_with_evo(mode, seed):
    truth = wandering(seed)
    estimate = noisy(truth, seed)
    ours = absolute_trajectory_error(estimate[:, :2], truth[:, :2], mode)
    assert_equals_evo(ours, evo_ate(estimate, truth, mode))


@pytest.mark.parametrize("delta", [1, 7, 200])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_relative_error_agrees_with_evo(delta, seed):
    truth = wandering(seed)
    estimate = noisy(truth, seed)
    ours = relative_pose_error(estimate, truth, delta)
    relation = metrics.PoseRelation
    assert_equals_evo(
        ours.translation_m, evo_rpe(estimate, truth, delta, relation.translation_part)
    )
    # evo takes the angle from a matrix logarithm, good to about 1e-8 near 0
    theirs = evo_rpe(estimate, truth, delta, relation.rotation_angle_rad)
    assert ours.rotation_rad.rmse == pytest.approx(theirs["rmse"], abs=1e-7)
    assert ours.rotation_rad.max == pytest.approx(theirs["max"], abs=1e-7)


@pytest.mark.parametrize("mode", ["none", "rigid", "similarity"])
def test_both_errors_of_a_real_cars_odometry_agree_with_evo(shared, mode):
    estimate, truth = real_pair(shared)
    ours = absolute_trajectory_error(estimate[:, :2], truth[:, :2], mode)
    assert_equals_evo(ours, evo_ate(estimate, truth, mode))
    theirs = evo_rpe(estimate, truth, 20, metrics.PoseRelation.translation_part)
    assert_equals_evo(relative_pose_error(estimate, truth, 20).translation_m, theirs)


def test_alignment_in_three_dimensions_agrees_with_evo():
    rng = np.random.default_rng(5)
    estimate, truth = rng.normal(size=(50, 3)), rng.normal(size=(50, 3))
    r, t, c = PoseTrajectory3D(
        positions_xyz=estimate,
        orientations_quat_wxyz=np.tile([1.0, 0, 0, 0], (50, 1)),
        timestamps=np.arange(50.0),
    ).align(
        PoseTrajectory3D(
            positions_xyz=truth,
            orientations_quat_wxyz=np.tile([1.0, 0, 0, 0], (50, 1)),
            timestamps=np.arange(50.0),
        ),
        correct_scale=True,
    )
    ours = align(estimate, truth, "similarity")
    np.testing.assert_allclose(ours.rotation, r, atol=1e-9)
    np.testing.assert_allclose(ours.translation, t, atol=1e-9)
    assert ours.scale == pytest.approx(c, abs=1e-9)


@given(tracks, angles, st.floats(0.1, 10.0), coordinate, coordinate)
def test_a_known_similarity_is_recovered(points, angle, scale, x, y):
    assume(np.ptp(points, axis=0).max() > 0.1)
    found = align(points, scale * turn(points, angle) + np.array([x, y]), "similarity")
    assert found.scale == pytest.approx(scale, rel=1e-6)
    np.testing.assert_allclose(found.rotation, turn(np.eye(2), angle).T, atol=1e-6)
    np.testing.assert_allclose(found.translation, [x, y], atol=1e-3)
    np.testing.assert_allclose(found.undo(found.apply(points)), points, atol=1e-6)


@given(tracks, angles, coordinate, coordinate, st.integers(0, 2**32 - 1))
def test_moving_the_estimate_rigidly_does_not_change_its_error(points, angle, x, y, seed):
    assume(np.ptp(points, axis=0).max() > 1.0)
    truth = points + np.random.default_rng(seed).normal(0.0, 0.1, points.shape)
    before = absolute_trajectory_error(points, truth, "rigid")
    after = absolute_trajectory_error(turn(points, angle) + np.array([x, y]), truth, "rigid")
    np.testing.assert_allclose(after[:4], before[:4], atol=1e-7)


@given(tracks, angles, coordinate, coordinate)
def test_moving_a_whole_track_rigidly_does_not_change_its_relative_error(points, angle, x, y):
    truth = np.column_stack([points, points[:, 0]])
    moved = np.column_stack([turn(points, angle) + np.array([x, y]), points[:, 0] + angle])
    error = relative_pose_error(moved, truth, 1)
    assert error.translation_m.max < 1e-9
    assert error.rotation_rad.max < 1e-9


def test_more_freedom_never_fits_worse():
    truth = wandering(3)[:, :2]
    estimate = noisy(wandering(3), 3)[:, :2]
    none, rigid, similar = (
        absolute_trajectory_error(estimate, truth, mode).rmse
        for mode in ("none", "rigid", "similarity")
    )
    assert similar < rigid < none


def test_a_mirrored_track_is_not_aligned_by_a_mirror():
    truth = wandering(4)[:, :2]
    found = align(truth * [1.0, -1.0], truth, "rigid")
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)


def test_a_straight_corridor_fixes_a_rotation_in_the_plane():
    line = np.column_stack([np.arange(5.0), np.zeros(5)])
    assert absolute_trajectory_error(turn(line, 1.0), line, "similarity").rmse < 1e-12


def test_one_point_has_an_error_but_no_rotation():
    point = np.array([[1.0, 2.0]])
    assert absolute_trajectory_error(point, point + np.array([[3.0, 4.0]]), "none").rmse == 5.0
    with pytest.raises(MapError, match="all 1 points of the estimate are equal"):
        align(point, point, "rigid")


@pytest.mark.parametrize("place", [0.0, 0.1, 1e6])
def test_a_robot_that_never_moved_cannot_be_aligned(place):
    stood, went = np.full((7, 2), place), wandering(0, 7)[:, :2]
    with pytest.raises(MapError, match="all 7 points of the estimate are equal"):
        align(stood, went, "similarity")
    with pytest.raises(MapError, match="all 7 points of the truth are equal"):
        align(went, stood, "rigid")


def test_unrelated_tracks_are_refused():
    cross = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    other = np.array([[1.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [-1.0, 0.0]])
    with pytest.raises(MapError, match="do not fix a rotation"):
        align(cross, other)


@pytest.mark.parametrize(
    ("estimate", "truth", "said"),
    [
        (np.zeros((3, 2)), np.zeros((4, 2)), r"got shapes \(3, 2\) and \(4, 2\)"),
        (np.zeros(3), np.zeros(3), r"got shapes \(3,\)"),
        (np.zeros((0, 2)), np.zeros((0, 2)), "got no points"),
        (np.array([[0.0, 0.0], [np.nan, 0.0]]), np.zeros((2, 2)), "point 1 of the estimate"),
    ],
)
def test_invalid_input_is_refused_in_one_line(estimate, truth, said):
    with pytest.raises(MapError, match=said) as caught:
        absolute_trajectory_error(estimate, truth)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("delta", [0, 4, -1])
def test_a_delta_outside_the_track_is_refused(delta):
    with pytest.raises(MapError, match="expected 1 to 3 for 4 poses"):
        relative_pose_error(np.zeros((4, 3)), np.zeros((4, 3)), delta)


def test_positions_have_no_relative_pose_error():
    with pytest.raises(MapError, match=r"expected \(n, 3\) poses"):
        relative_pose_error(np.zeros((4, 2)), np.zeros((4, 2)))


def test_association_agrees_with_evo_where_no_time_is_shared():
    rng = np.random.default_rng(0)
    first = np.arange(200) * 0.1 + rng.uniform(-0.02, 0.02, 200)
    second = np.arange(5, 180, 2) * 0.1 + rng.uniform(-0.02, 0.02, 88)
    ours = associate(first, second, 0.03)
    theirs = sync.matching_time_indices(first, second, max_diff=0.03)
    assert ours[0].tolist() == theirs[0]
    assert ours[1].tolist() == theirs[1]
    assert 40 < len(ours[0]) < 88


rising = st.lists(st.integers(0, 500), max_size=40, unique=True).map(
    lambda ticks: np.array(sorted(ticks)) / 8.0
)


@given(rising, rising, st.sampled_from([0.0, 0.125, 1.0]))
def test_pairs_are_near_in_order_and_used_once(first, second, limit):
    i, j = associate(first, second, limit)
    assert (np.diff(i) > 0).all()
    assert (np.diff(j) > 0).all()
    assert (np.abs(first[i] - second[j]) <= limit).all()
    if limit == 0.0:
        assert len(i) == len(set(first) & set(second))


def test_decreasing_times_are_refused():
    with pytest.raises(MapError, match="second track decrease at index 2"):
        associate([0.0], [0.0, 2.0, 1.0])


def test_a_circle_is_as_long_as_its_circumference():
    angle = np.linspace(0.0, 2 * np.pi, 10_001)
    circle = 2.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    assert path_length(circle) == pytest.approx(4 * np.pi, rel=1e-6)
    assert path_length(circle[:1]) == 0.0


@given(st.floats(0.01, 100.0), angles)
def test_the_size_of_a_drawing_does_not_change_its_shape(scale, angle):
    a, b = wandering(1, 50)[:, :2], noisy(wandering(1, 50), 1)[:, :2]
    here = shape_rmse(a, b)
    assert shape_rmse(scale * turn(a, angle), b) == pytest.approx(here, rel=1e-9)
    assert shape_rmse(a, scale * turn(b, 0.0)) == pytest.approx(here, rel=1e-9)


def test_one_corner_off_by_a_tenth_of_the_diagonal_gives_that_rmse():
    square = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 4.0], [0.0, 4.0]] * 50)
    bent = square.copy()
    bent[0] += [0.0, 0.5]
    assert shape_rmse(bent, square) == pytest.approx(0.5 / 5.0 / math.sqrt(200), rel=0.02)


def test_a_track_comes_back_from_a_tum_file_and_evo_reads_the_same(tmp_path):
    poses = wandering(2)
    times = 1602421393.803 + 0.05 * np.arange(len(poses))
    write_tum(tmp_path / "track.tum", Track(times, poses))
    back = read_tum(tmp_path / "track.tum")
    np.testing.assert_allclose(back.times_s, times, rtol=0, atol=1e-6)
    np.testing.assert_allclose(back.poses[:, :2], poses[:, :2], atol=1e-9)
    np.testing.assert_allclose(np.exp(1j * back.poses[:, 2]), np.exp(1j * poses[:, 2]), atol=1e-9)
    theirs = file_interface.read_tum_trajectory_file(str(tmp_path / "track.tum"))
    np.testing.assert_allclose(theirs.positions_xyz[:, :2], back.poses[:, :2], atol=1e-12)
    yaw = theirs.get_orientations_euler("sxyz")[:, 2]
    np.testing.assert_allclose(np.exp(1j * yaw), np.exp(1j * back.poses[:, 2]), atol=1e-9)


def test_comments_blank_lines_and_unnormalised_quaternions_are_read(tmp_path):
    file = tmp_path / "t.tum"
    file.write_text("# time x y z q\n\n0 1 2 9 0 0 2 2\n1.5\t1 2 9 0 0 0 -1\n")
    track = read_tum(file)
    assert track.times_s.tolist() == [0.0, 1.5]
    np.testing.assert_allclose(track.poses, [[1, 2, math.pi / 2], [1, 2, 0]], atol=1e-15)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("0 0 0 0 0 0 0 1\n1 2 3\n", "line 2: got 3 numbers; expected 'time x y z qx qy qz qw'"),
        ("time,x,y\n", "line 1: got 'time,x,y', not numbers"),
        ("0 0 0 0 0 0 0 nan\n", "line 1: got a number that is not finite"),
        ("0 0 0 0 0 0 0 0\n", "line 1: got a quaternion of length 0"),
        ("2 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "line 2: time 1 is not above the time before, 2.0"),
        ("# nothing\n", "has no pose"),
    ],
)
def test_a_file_that_is_no_tum_file_is_refused_in_one_line(tmp_path, text, said):
    file = tmp_path / "t.tum"
    file.write_text(text)
    with pytest.raises(SourceError) as caught:
        read_tum(file)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_or_binary_file_is_refused_in_one_line(tmp_path):
    with pytest.raises(SourceError, match="no such file"):
        read_tum(tmp_path / "none.tum")
    (tmp_path / "b.tum").write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(SourceError, match="cannot be read as text"):
        read_tum(tmp_path / "b.tum")
