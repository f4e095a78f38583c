"""Worlds of landmarks and paths through them."""

import json

import numpy as np
import pytest

from neuroslam.errors import SourceError
from neuroslam.worlds.landmark_paths import (
    KITTI_SEQUENCES,
    LandmarkPath,
    band_limited_path,
    kitti_files,
    path_of_walk,
    read_kitti,
    read_path,
)
from neuroslam.worlds.landmarks import (
    make_world,
    paper_world,
    point,
    random_world,
    read_world,
    wall,
)
from neuroslam.worlds.rodent import read_walk


def test_a_wall_is_as_far_as_its_nearest_point():
    world = make_world([wall("WALL", ((0.0, 0.0), (0.4, 0.1))), point("P", (-0.5, 0.0))])
    view = world.observe(np.array([[0.2, 0.05], [0.2, -0.15], [0.7, 0.5], [-0.45, 0.0]]))
    np.testing.assert_allclose(view.distance_m[:3, 0], [0.0, 0.15, 0.5])
    assert view.in_view.tolist() == [[True, False], [True, False], [False, False], [False, True]]
    np.testing.assert_allclose(view.low_m[1, 0], [-0.2, 0.15])
    np.testing.assert_allclose(view.high_m[1, 0], [0.2, 0.25])


def test_the_paper_s_world_has_attributes_and_an_l_of_walls():
    world = paper_world()
    assert world.named("BLUE_TRIANGLE").pointer == "BLUE * TRIANGLE"
    assert world.box_landmark.tolist() == [0, 1, 2, 3, 3]
    # SSP-SLAM, Eqs. 21 to 24.
    points = [landmark.position_m.tolist() for landmark in world.landmarks[:3]]
    assert points == [[0.6, 0.2], [0.0, -0.6], [-0.2, 0.2]]
    boxes = world.named("WALL").boxes_m
    assert boxes.tolist() == [[[-1.1, 0.5], [-0.95, 1.1]], [[-1.0, 0.95], [-0.4, 1.1]]]
    overlap = boxes[:, 1].min(0) - boxes[:, 0].max(0)
    assert (overlap > 0).all(), "the two boxes are one wall"


def test_random_worlds_follow_from_the_seed():
    at = [np.array([m.position_m for m in random_world(seed=s).landmarks]) for s in (1, 1, 2)]
    np.testing.assert_array_equal(at[0], at[1])
    assert not np.allclose(at[0], at[2])
    names = random_world(20, attributes=True).names
    assert len(set(names)) == 20


def test_worlds_are_read_from_files(tmp_path):
    file = tmp_path / "world.json"
    landmarks = [
        {"name": "DOOR", "position_m": [0, 1]},
        {"name": "W", "boxes_m": [[[0, 0], [1, 0.1]]]},
    ]
    file.write_text(json.dumps({"landmarks": landmarks, "view_radius_m": 0.5}), encoding="utf-8")
    world = read_world(file)
    assert world.names == ("DOOR", "W")
    assert world.view_radius_m == 0.5


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "is no world"),
        ('{"landmarks": [{"name": "A"}]}', "position_m"),
        ('{"landmarks": []}', "at least one"),
        ('{"landmarks": [{"name": "A", "position_m": [3, 0]}]}', "expected corners within"),
    ],
)
def test_files_that_are_no_worlds_are_refused(tmp_path, content, message):
    file = tmp_path / "world.json"
    file.write_text(content, encoding="utf-8")
    with pytest.raises(SourceError, match=message):
        read_world(file)
    with pytest.raises(SourceError, match="cannot be read"):
        read_world(tmp_path / "none.json")


@pytest.mark.parametrize(
    ("position", "message"),
    [((2.0, 0.0), "outside the bounds"), ((np.nan, 0.0), "not a number"), ((0.0,), "expected")],
)
def test_positions_that_cannot_be_are_refused(position, message):
    with pytest.raises(SourceError, match=message):
        random_world().observe(np.array(position))


def test_unknown_and_double_landmarks_are_refused():
    with pytest.raises(SourceError, match="no landmark 'X'; expected one of L0"):
        random_world().named("X")
    with pytest.raises(SourceError, match="twice"):
        make_world([point("A", (0, 0)), point("A", (0, 1))])


def test_random_paths_reach_the_bounds_and_have_no_high_frequency():
    path = band_limited_path(120.0, 0.08, seed=3, time_step_s=0.01)
    np.testing.assert_allclose(np.abs(path.position_m).max(0), 0.9)
    power = np.abs(np.fft.rfft(path.position_m, axis=0)) ** 2
    frequency = np.fft.rfftfreq(len(path.position_m), 0.01)
    assert power[frequency > 0.081].sum() < 1e-12 * power.sum()


def test_velocities_add_up_to_the_path_at_any_step():
    path = band_limited_path(60.0, 0.08, 3, seed=1, time_step_s=0.01)
    for other in (path, path.resampled(0.001), path.resampled(0.02)):
        walked = other.position_m[0] + np.cumsum(other.velocity_m_s, 0) * other.time_step_s
        np.testing.assert_allclose(walked, other.position_m, atol=1e-9)
    fine = path.resampled(0.001).resampled(0.01)
    np.testing.assert_allclose(fine.position_m, path.position_m, atol=1e-6)
    assert len(path.first(10.0).position_m) == 1000


def test_recorded_paths_are_scaled_by_one_factor(tmp_path):
    at = np.column_stack([np.linspace(0, 10, 50), np.linspace(0, 5, 50) ** 2 / 5])
    np.save(tmp_path / "path.npy", at)
    path = read_path(tmp_path / "path.npy", 0.1)
    assert path.metres == pytest.approx(10 / 1.8)
    np.testing.assert_allclose(np.ptp(path.position_m, axis=0), [1.8, 0.9])
    rows = "\n".join(f"{0.1 * k},{x},{y}" for k, (x, y) in enumerate(at))
    (tmp_path / "path.csv").write_text("t,x,y\n" + rows, encoding="utf-8")
    np.testing.assert_allclose(
        read_path(tmp_path / "path.csv", 0.1).position_m, path.position_m, atol=1e-9
    )


def test_two_rooms_and_kitti_and_a_rat_are_paths(shared):
    rooms = read_path(shared / "data" / "two_rooms" / "twoRooms_path.npy")
    assert rooms.position_m.shape == (60_000, 2)
    kitti = read_kitti(shared / "data" / "kitti_00", time_step_s=0.1)
    assert kitti.position_m.shape[1] == 3
    assert 250 < kitti.metres < 350  # the sequence spans about 560 m
    walk = read_walk(shared / "data" / "rodent" / "sargolini2006_circle1m.npz", minutes=1.0)
    rat = path_of_walk(walk, 0.01)
    assert rat.metres == pytest.approx(np.ptp(walk.positions, axis=0).max() / 1.8)


def write_kitti(poses, times, length_m=40.0, n=50):
    """Poses of a camera that drives ahead, climbs a fifth of it and turns right, at 10 Hz."""
    s = np.linspace(0.0, 1.0, n)
    rows = np.zeros((n, 12))
    rows[:, [0, 5, 10]] = 1.0
    rows[:, 3], rows[:, 7], rows[:, 11] = length_m * s**2 / 2, -0.2 * length_m * s, length_m * s
    for file, table in ((poses, rows), (times, 0.1 * np.arange(n))):
        file.parent.mkdir(parents=True, exist_ok=True)
        np.savetxt(file, table)


@pytest.mark.parametrize("sequence", KITTI_SEQUENCES)
@pytest.mark.parametrize("archive", [False, True])
def test_each_kitti_sequence_with_poses_is_read_from_either_layout(tmp_path, sequence, archive):
    files = tmp_path / f"KITTI_{sequence}_gt.txt", tmp_path / f"KITTI_{sequence}_gt_times.txt"
    if archive:
        files = tmp_path / f"poses/{sequence}.txt", tmp_path / f"sequences/{sequence}/times.txt"
    write_kitti(*files, length_m=10.0 * (1 + int(sequence)))
    assert kitti_files(tmp_path, sequence) == files
    path = read_kitti(tmp_path, sequence, time_step_s=0.05)
    assert path.metres == pytest.approx(10.0 * (1 + int(sequence)) / 1.8)
    x, y, z = (path.position_m[-1] - path.position_m[0]) * path.metres
    assert (x / y, z / y) == pytest.approx((0.5, 0.2), abs=1e-6)  # right, ahead, up
    assert path.time_s[-1] == pytest.approx(4.9)


def test_kitti_s_times_are_asked_for_by_the_name_of_their_file(tmp_path):
    write_kitti(tmp_path / "poses/03.txt", tmp_path / "times.txt")
    with pytest.raises(SourceError, match=r"sequences/03/times\.txt: no such file; .*calibration"):
        read_kitti(tmp_path, "03")
    (tmp_path / "sequences/03").mkdir(parents=True)
    (tmp_path / "sequences/03/times.txt").write_text("0.0\n0.1\n", encoding="utf-8")
    with pytest.raises(SourceError, match=r"expected \(n, 12\) and \(n, 1\)"):
        read_kitti(tmp_path, "03")


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([[0, 0]] * 3, "at least 4"),
        ([[np.nan, 0]] * 9, "a position is not finite"),
        ([[1, 2]] * 9, "all positions are equal"),
    ],
)
def test_files_that_are_no_paths_are_refused(tmp_path, rows, message):
    np.save(tmp_path / "path.npy", np.array(rows, dtype=float))
    with pytest.raises(SourceError, match=message):
        read_path(tmp_path / "path.npy")


def test_missing_and_strange_files_are_refused(tmp_path):
    with pytest.raises(SourceError, match="cannot be read"):
        read_path(tmp_path / "none.npy")
    with pytest.raises(SourceError, match=r"a \.npy or a \.csv"):
        read_path(tmp_path / "path.txt")
    with pytest.raises(SourceError, match="has no poses of KITTI sequence 00"):
        read_kitti(tmp_path)
    with pytest.raises(SourceError, match=r"'11': its true poses are not published"):
        read_kitti(tmp_path, "11")
    with pytest.raises(SourceError, match="no frequency below"):
        band_limited_path(5.0, 0.08)
    assert isinstance(band_limited_path(20.0, 0.1), LandmarkPath)
