"""Logs of robots: CARMEN, MRCLAM, landmark sightings, raw KITTI, TUM-VI."""

import bz2
import gzip
import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from neuroslam import NavigationBrain, open_source
from neuroslam.config import build_config
from neuroslam.errors import BadFrame, SourceError
from neuroslam.sensors.open import absolute_spec

RADISH = Path(__file__).parents[3] / "shared" / "data" / "radish"


def flaser(x, time_s, n=180, ranges=None):
    """One scan of a wall 2 m ahead, unless other ranges are given."""
    angles = np.radians(np.arange(n) - 90.0)
    ranges = 2.0 / np.maximum(np.cos(angles), 1e-3) if ranges is None else ranges
    pose = f"{x:.3f} 0.0 0.0"
    return f"FLASER {n} {' '.join(f'{r:.3f}' for r in ranges)} {pose} {pose} {time_s} host 9.0"


LOG = "\n".join(
    [
        "# message_name [message contents]",
        "PARAM robot_frontlaser_offset 0.1 nohost 0",
        "ODOM 0.0 0.0 0.0 0.0 0.0 0.0 9.0 host 0.0",
        flaser(0.0, 0.5),
        flaser(0.2, 1.7),  # its stamp is too late
        flaser(0.4, 1.5),
        "FLASER 180 1.0 2.0",
    ]
)


@pytest.mark.parametrize(
    ("name", "pack"),
    [("a.clf", bytes), ("a.log", bytes), ("a.log.gz", gzip.compress), ("a.clf.bz2", bz2.compress)],
)
def test_a_carmen_log_gives_scans_with_the_motion_of_its_odometry(name, pack, tmp_path):
    (tmp_path / name).write_bytes(pack(LOG.encode()))
    source, bad = open_source(tmp_path / name), []
    frames = list(source.frames(on_bad_frame=bad.append))
    assert [frame.time_s for frame in frames] == [0.5, 1.0, 1.5]
    assert [frame.velocity.v_m_s for frame in frames] == pytest.approx([0.0, 0.4, 0.4])
    ranges = frames[0].ranges
    assert ranges[[0, 45, 315]] == pytest.approx([2.0, 2 * 2**0.5, 2 * 2**0.5], abs=1e-3)
    assert np.isinf(ranges[[120, 180, 240]]).all()  # behind the robot
    assert len(bad) == 1
    assert "line ends with" in str(bad[0])
    assert any("0.1 m ahead" in note for note in source.notes)


def test_robotlaser1_says_its_own_angles_and_range(tmp_path):
    head = "ROBOTLASER1 0 -0.5235988 1.0471976 0.0174533 30.0 0.01 0 61"
    beams = " ".join(["3.0"] * 60 + ["30.0"])
    tail = "0 1.1 2.0 0.3 1.0 2.0 0.3 0.5 0.0 0.0 0.0 0.0"
    (tmp_path / "b.clf").write_text(f"{head} {beams} {tail} 12.0 host 3.0\n")
    source = open_source(tmp_path / "b.clf")
    ranges = source.frame(0).ranges
    assert np.flatnonzero(np.isfinite(ranges)).tolist() == [*range(30), *range(330, 360)]
    assert source.odometry.tolist() == [[1.0, 2.0, 0.3]]
    assert source.frame(0).time_s == 12.0


def test_a_log_without_messages_is_refused(tmp_path):
    (tmp_path / "a.clf").write_text("# nothing\n")
    with pytest.raises(SourceError, match="expected a CARMEN log"):
        open_source(tmp_path / "a.clf")
    (tmp_path / "b.clf.bz2").write_bytes(bz2.compress(LOG.encode())[:60])
    with pytest.raises(SourceError, match="cannot be read"):
        open_source(tmp_path / "b.clf.bz2")


@pytest.mark.skipif(not RADISH.is_dir(), reason="needs ../shared/data/radish")
@pytest.mark.parametrize(
    ("name", "scans", "path_m"), [("aces", 7374, 325.2), ("intel", 13631, 508.4)]
)
def test_real_carmen_logs_are_read_to_the_last_scan(name, scans, path_m):
    source, bad = open_source(RADISH / f"{name}.clf.bz2"), []
    assert source.n_frames == scans
    sampled = [*source.frames(0, 50, bad.append), *source.frames(scans - 50, None, bad.append)]
    assert all(np.isfinite(frame.ranges[:80]).any() for frame in sampled)
    assert len(sampled) + len(bad) == 100
    steps = np.hypot(*np.diff(source.odometry[:, :2], axis=0).T)
    assert steps.max() < 1.0  # in order: none jumps
    assert steps.sum() == pytest.approx(path_m, abs=0.1)


@pytest.fixture
def mrclam(tmp_path):
    """Two robots: one drives ahead at 0.5 m/s past two posts."""
    times = np.arange(0.0, 4.0, 0.02)
    robot = "".join(f"{100 + t:.3f} 0.500 0.000\n" for t in times)
    truth = "".join(f"{100 + t:.3f} {0.5 * t:.4f} 0.0 0.0\n" for t in times)
    files = {
        "Barcodes.dat": "# Subject Barcode\n1 5\n2 14\n6 72\n7 27\n",
        "Landmark_Groundtruth.dat": "# subject x y sx sy\n6 2.0 1.0 0 0\n7 1.0 -1.0 0 0\n",
        "Robot1_Odometry.dat": f"# Time v w\n{robot}",
        "Robot1_Measurement.dat": "100.55 72 2.0 0.52\n100.56 14 1.0 0.0\n101.0 27 1.1 -1.1\n",
        "Robot1_Groundtruth.dat": truth,
    }
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    return tmp_path


def test_an_mrclam_folder_gives_landmarks_that_stand_still_and_truth(mrclam):
    source = open_source(f"{mrclam}?robot=1&rate=5")
    frames = list(source)
    assert source.frame_rate_hz == 5
    assert sum(f.velocity.v_m_s for f in frames) / 5 == pytest.approx(1.9, abs=0.02)
    seen = {
        frame.index: frame.landmarks.tolist() for frame in frames if frame.landmarks is not None
    }
    assert seen == {3: [[6.0, 2.0, 0.52]], 5: [[7.0, 1.1, -1.1]]}
    assert frames[4].truth.x_m == pytest.approx(0.4)
    assert [word.name for word in source.landmark_words] == ["POST_6", "POST_7"]
    assert source.landmarks_m[7] == (1.0, -1.0)
    assert absolute_spec(f"{mrclam}?robot=1") == f"{mrclam.resolve()}?robot=1"
    with pytest.raises(SourceError, match="Robot2_Odometry"):
        open_source(f"{mrclam}?robot=2")


def test_landmarks_of_a_log_enter_the_semantic_map(mrclam):
    brain = NavigationBrain(build_config({"cells": "semantic", "odometry": {"use": "given"}}))
    source = open_source(f"{mrclam}?rate=5")
    brain.semantic.name_landmarks(source.landmark_words)
    for frame in source.frames(3, 6):
        brain(frame)
    assert brain.semantic.names() == ["POST_6", "POST_7"]


def test_sightings_join_the_frame_at_or_after_them(tmp_path):
    motion, posts = tmp_path / "motion.csv", tmp_path / "posts.csv"
    motion.write_text("time_s,v_m_s,w_rad_s\n" + "".join(f"{i / 10},1.0,0\n" for i in range(10)))
    posts.write_text(
        "number,time_ms,distance_m,bearing_deg\n8,350,1.5,-90\n7,200,2.0,90\n,350,3,0\n"
    )
    source = open_source(f"{motion}+{posts}")
    seen = {f.index: f.landmarks.tolist() for f in source if f.landmarks is not None}
    assert list(seen) == [2, 4]
    assert seen[2] == [[7.0, 2.0, pytest.approx(math.pi / 2)]]
    assert [row[0] for row in seen[4]] == [8.0, -1.0]
    assert next(source.frames(4)).landmarks.shape == (2, 3)
    posts.write_text("time_s,number,distance_m,bearing_rad\n0.1,7,-1,0\n")
    with pytest.raises(SourceError, match="at least 0"):
        open_source(posts)
    posts.write_text("time_s,number,distance_m,bearing_rad\n-5,7,1,0\n")
    with pytest.raises(SourceError, match="expected an overlap"):
        open_source(f"{motion}+{posts}")


def _picture(path):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.arange(64, dtype=np.uint8).reshape(8, 8))


def test_a_raw_kitti_drive_has_the_truth_of_its_gps(tmp_path):
    drive = tmp_path / "2011_09_26_drive_0001_sync"
    stamps = "".join(f"2011-09-26 13:02:25.{i}94360375\n" for i in range(3))
    (drive / "oxts" / "data").mkdir(parents=True)
    for i in range(3):
        _picture(drive / "image_02" / "data" / f"{i:010d}.png")
        lon = 8.4 + math.degrees(i / (6378137.0 * math.cos(math.radians(49.0))))
        (drive / "oxts" / "data" / f"{i:010d}.txt").write_text(f"49.0 {lon:.12f} 1 0 0 0.25 1 2")
    (drive / "image_02" / "timestamps.txt").write_text(stamps)
    (drive / "oxts" / "timestamps.txt").write_text(stamps)
    frames = list(open_source(drive))
    assert [frame.time_s for frame in frames] == pytest.approx([0.0, 0.1, 0.2], abs=1e-5)
    assert np.array([f.truth for f in frames]) == pytest.approx(
        np.array([[0, 0, 0.25], [1, 0, 0.25], [2, 0, 0.25]]), abs=1e-4
    )


def test_tum_vi_has_the_truth_of_its_motion_capture(tmp_path):
    camera = tmp_path / "mav0" / "cam0"
    for i in range(2):
        _picture(camera / "data" / f"{i}.png")
    (camera / "data.csv").write_text("#t,name\n1000000000,0.png\n1050000000,1.png\n")
    mocap, dso = tmp_path / "mav0" / "mocap0", tmp_path / "dso"
    mocap.mkdir()
    dso.mkdir()
    (mocap / "data.csv").write_text("#t\n1000000000,1,2,3,1,0,0,0\n1050000000,1,3,3,1,0,0,0\n")
    rows = "[-1.0, 0.0, 0.0, 0.1]", "[0.0, 0.0, -1.0, 0.0]", "[0.0, -1.0, 0.0, 0.0]", "[0, 0, 0, 1]"
    chain = "".join(f"  - {row}\n" for row in rows)
    (dso / "camchain.yaml").write_text(f"cam0:\n  T_cam_imu:\n{chain}  camera_model: pinhole\n")
    frames = list(open_source(tmp_path))
    assert frames[1].truth == pytest.approx((1.0, 3.0, -math.pi / 2))  # the camera looks to -y


def test_a_scan_line_with_too_few_ranges_is_one_bad_frame(tmp_path):
    short = flaser(0.2, 1.0).replace("FLASER 180", "FLASER 500")
    (tmp_path / "a.clf").write_text("\n".join([flaser(0.0, 0.5), short, flaser(0.4, 1.5)]))
    source = open_source(tmp_path / "a.clf")
    with pytest.raises(BadFrame, match="frame 1: its FLASER line holds no scan"):
        source.frame(1)
    assert source.frame(2).velocity.v_m_s == pytest.approx(0.4)
