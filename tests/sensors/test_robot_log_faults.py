"""Robots' logs with other units, lost rows, wrong clocks and hostile files: right, or one line."""

import gzip
import os

import cv2
import numpy as np
import pytest

from neuroslam.errors import SourceError
from neuroslam.limits import MAX_MEMORY
from neuroslam.sensors import open_source


def opened(path, spec=None):
    """Return the frames of a source, the faults of its bad frames, and its notes."""
    source, bad = open_source(spec or path), []
    frames = list(source.frames(on_bad_frame=bad.append))
    return frames, [str(fault) for fault in bad], "\n".join((*source.notes, *source.unused))


def refusal(path) -> str:
    with pytest.raises(SourceError) as caught:
        list(open_source(path).frames())
    assert "\n" not in str(caught.value)
    return str(caught.value)


# --- CARMEN --------------------------------------------------------------------------------------


def flaser(x, time, range_m=2.0):
    return f"FLASER 4 {' '.join([str(range_m)] * 4)} {x} 0 0 {x} 0 0 {time} host {time}"


def log(path, lines, mark=b""):
    path.write_bytes(mark + "\n".join(lines).encode())
    return path


LINES = [flaser(round(0.1 * k, 1), round(0.1 * k, 1)) for k in range(8)]


@pytest.mark.parametrize(
    ("lines", "mark"),
    [
        (LINES, b"\xef\xbb\xbf"),
        ([line.replace(" ", "\t") for line in LINES], b""),
        ([f"  {line}\r" for line in LINES], b""),
        ([flaser(0.1 * k, 100 * k) for k in range(8)], b""),
        ([flaser(0.1 * k, 10**8 * k) for k in range(8)], b""),
    ],
)
def test_a_carmen_log_in_another_dress_is_the_same_drive(lines, mark, tmp_path):
    frames, bad, _ = opened(log(tmp_path / "a.clf", lines, mark))
    assert bad == []
    np.testing.assert_allclose([f.time_s for f in frames], 0.1 * np.arange(8), atol=1e-9)
    np.testing.assert_allclose([f.velocity.v_m_s for f in frames], [0.0, *[1.0] * 7], atol=1e-9)
    assert frames[0].ranges[0] == 2.0


def test_unix_times_of_a_carmen_log_in_nanoseconds_are_said(tmp_path):
    lines = [flaser(0.1 * k, 17 * 10**17 + 10**8 * k) for k in range(8)]
    frames, _, notes = opened(log(tmp_path / "a.clf", lines))
    assert "times are in nanoseconds, as their size shows" in notes
    assert frames[-1].time_s - frames[0].time_s == pytest.approx(0.7)


def test_ranges_of_a_carmen_log_in_centimetres_are_said(tmp_path):
    lines = [flaser(0.1 * k, 0.1 * k, range_m=200) for k in range(8)]
    assert "are the ranges in centimetres" in opened(log(tmp_path / "a.clf", lines))[2]


def test_a_jump_of_a_carmen_log_costs_its_frames(tmp_path):
    lines = [*LINES[:3], flaser("1e300", 0.3), *LINES[4:]]
    frames, bad, _ = opened(log(tmp_path / "a.clf", lines))
    assert len(frames) == 6
    assert all("odometry jumps by" in fault for fault in bad)


@pytest.mark.parametrize(("first", "step"), [("-90", "1.0"), ("-1.57", "1e-300"), ("1e300", "0.1")])
def test_scans_in_degrees_are_no_scans(first, step, tmp_path):
    ranges = " ".join(["2.0"] * 181)
    line = f"ROBOTLASER1 0 {first} 3.14 {step} 30 0.01 0 181 {ranges} 0" + " 0" * 11 + " 0.1 h 0.1"
    frames, bad, _ = opened(log(tmp_path / "a.clf", [line]))
    assert frames == []
    assert "frame 0: scan of 181 beams" in bad[0]
    assert "are its angles in degrees?" in bad[0]


@pytest.mark.parametrize("name", ["a.clf", "a.log", "a.log.gz", "a.clf.bz2", "a.npz", "a.nwb"])
@pytest.mark.parametrize("what", ["pipe", "device", "folder"])
def test_what_is_no_file_is_not_waited_for(name, what, tmp_path):
    path = tmp_path / name
    {"pipe": os.mkfifo, "device": lambda p: p.symlink_to("/dev/zero"), "folder": os.mkdir}[what](
        path
    )
    expected = "contains no images" if what == "folder" else "regular file|no such file"
    with pytest.raises(SourceError, match=expected):
        open_source(path)


def test_a_packed_log_above_the_budget_is_refused(tmp_path, monkeypatch):
    (tmp_path / "a.log.gz").write_bytes(gzip.compress(b"ODOM 1 2 3\n" * 200_000))
    monkeypatch.setenv(MAX_MEMORY, "4M")
    assert "see --max-memory" in refusal(tmp_path / "a.log.gz")


# --- MRCLAM --------------------------------------------------------------------------------------

N = 20
START_S = 1e9
FILES = {
    "Robot1_Odometry.dat": [(START_S + 0.1 * k, 0.5, 0.1) for k in range(N)],
    "Robot1_Measurement.dat": [(START_S + 0.1 * k, 72, 2.0, 0.5) for k in range(N)],
    "Robot1_Groundtruth.dat": [(START_S + 0.05 * k, 0.025 * k, 0.0, 0.0) for k in range(2 * N)],
    "Barcodes.dat": [(6, 72)],
}


@pytest.fixture
def mrclam(tmp_path):
    def make(**changed):
        for name, rows in FILES.items():
            change = changed.get(name.removeprefix("Robot1_").removesuffix(".dat").lower())
            lines = [" ".join(map(repr, row)) for row in (change(rows) if change else rows)]
            (tmp_path / name).write_text("\n".join(lines).replace("'", "") + "\n")
        return tmp_path

    return make


def check_drive(frames):
    """Check the drive of the sound files, as far as frames are there."""
    assert all(f.velocity.v_m_s == pytest.approx(0.5) for f in frames[1:])
    for f in frames:
        if f.truth is not None:
            assert f.truth.x_m == pytest.approx(0.5 * (f.time_s - START_S), abs=1e-4)


@pytest.mark.parametrize("factor", [1e3, 1e6, 1e9])
def test_mrclam_in_another_unit_of_time_is_the_same_drive(factor, mrclam):
    def scale(rows):
        return [(row[0] * factor, *row[1:]) for row in rows]

    frames, _, notes = opened(mrclam(odometry=scale, measurement=scale, groundtruth=scale))
    assert len(frames) == N
    check_drive(frames)
    assert all(f.truth is not None for f in frames)
    assert notes.count("as their size shows") == 3


@pytest.mark.parametrize("row", [(START_S + 0.5, "nan", 0.1), ("x",), (START_S + 99.0, 9.0, 9.0)])
def test_a_wrong_row_of_mrclam_odometry_costs_that_row(row, mrclam):
    frames, bad, notes = opened(mrclam(odometry=lambda rows: [*rows[:5], row, *rows[6:]]))
    assert (len(frames), bad) == (N, [])
    check_drive(frames)
    assert "left out" in notes


def test_partly_known_truth_of_mrclam_is_truth(mrclam):
    frames, _, notes = opened(
        mrclam(
            groundtruth=lambda rows: [("x",), *rows[N : N + 4], (0, "nan", 0, 0), *rows[N + 5 :]]
        )
    )
    assert [f.truth is not None for f in frames] == [k >= 10 for k in range(N)]
    check_drive(frames)
    assert "2 lines left out" in notes


def test_a_gap_of_mrclam_odometry_has_no_frames_and_fills_no_memory(mrclam):
    frames, _, notes = opened(
        mrclam(odometry=lambda rows: [*rows[:10], *[(t + 1e9, v, w) for t, v, w in rows[10:]]])
    )
    assert len(frames) == N
    assert "1 gap of more than 2 s" in notes


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"odometry": lambda rows: rows[::-1]}, "19 of 20 times do not rise"),
        ({"measurement": lambda rows: [(*r[:3], 90.0) for r in rows]}, "are they in degrees?"),
        ({"measurement": lambda rows: [(*r[:2], -1.0, 0.1) for r in rows]}, "distance is -1 m"),
        ({"odometry": lambda rows: [("0,5",) for _ in rows]}, "line 1 is '0,5'"),
    ],
)
def test_a_wrong_file_of_mrclam_is_one_line(changed, message, mrclam):
    assert message in refusal(mrclam(**changed))


def test_truth_of_mrclam_of_another_day_is_said(mrclam):
    later = mrclam(groundtruth=lambda rows: [(r[0] + 1e6, *r[1:]) for r in rows])
    assert "no frame has a true pose" in opened(later)[2]


# --- sightings -----------------------------------------------------------------------------------

HEAD = "time_s,number,distance_m,bearing_rad\n"


@pytest.fixture
def sightings(tmp_path):
    rows = "".join(f"{0.1 * k:.1f},0.5,0.1\n" for k in range(10))
    (tmp_path / "m.csv").write_text(f"time_s,v_m_s,w_rad_s\n{rows}")

    def make(text):
        (tmp_path / "s.csv").write_text(text)
        return f"{tmp_path}/m.csv+{tmp_path}/s.csv"

    return make


@pytest.mark.parametrize(
    "text",
    [
        "\ufeff" + HEAD + "0.3,7,2,0.5\n",
        "# of a robot\n" + HEAD + "0.3,7,2,0.5\n",
        f"# of a robot\n# {HEAD.replace('rad', 'deg')}0.3,7,2,28.64788976\n",
        HEAD.upper() + "0.3,7,2,0.5\n",
        "Time [ms],number,distance_m,bearing_rad\n300,7,2,0.5\n",
    ],
)
def test_sightings_in_another_dress_are_the_same(text, sightings):
    frames = opened(None, sightings(text))[0]
    assert [f.landmarks is not None for f in frames] == [k == 3 for k in range(10)]
    np.testing.assert_allclose(frames[3].landmarks, [[7.0, 2.0, 0.5]], atol=1e-9)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (HEAD + "0.3,7,2,90\n", "are they in degrees?"),
        (HEAD + "0.3,7.5,2,0.5\n", "line 2 has number 7.5"),
        (HEAD + "0.3,1e300,2,0.5\n", "line 2 has number 1e+300"),
        ((HEAD + "0.3,7,2,0.5\n").replace(",", ";"), "separated by semicolons"),
        (HEAD.replace("number", "number,number") + "0.3,7,8,2,0.5\n", "has 2 columns of number"),
    ],
)
def test_wrong_sightings_are_one_line(text, message, sightings):
    assert message in refusal(sightings(text))


def test_sightings_of_another_clock_and_unit_are_said(sightings):
    assert (
        "all 1 sighting are after the last frame" in opened(None, sightings(HEAD + "9,7,2,0\n"))[2]
    )
    assert "are the distances in centimetres" in opened(None, sightings(HEAD + "0.3,7,500,0\n"))[2]


# --- raw KITTI, TUM-VI ---------------------------------------------------------------------------


def image(path, k, suffix=".png"):
    coarse = np.random.default_rng(k).integers(0, 255, (6, 8, 3), np.uint8)
    path.write_bytes(cv2.imencode(suffix, cv2.resize(coarse, (64, 48)))[1].tobytes())


@pytest.fixture
def kitti_raw(tmp_path):
    stamps = "".join(f"2011-09-26 13:02:{25 + 0.1 * k:.9f}\n" for k in range(6))
    for folder in ("image_02", "oxts"):
        (tmp_path / folder / "data").mkdir(parents=True)
        (tmp_path / folder / "timestamps.txt").write_text(stamps)
    for k in range(6):
        image(tmp_path / "image_02" / "data" / f"{k:010d}.png", k)
        row = f"{49 + 1e-6 * k} 8.4 112 0 0 0.5\n"
        (tmp_path / "oxts" / "data" / f"{k:010d}.txt").write_text(row)
    return tmp_path


KNOWN = [True, True, False, True, True, True]


@pytest.mark.parametrize("text", [None, "", "x y", "nan 8 1 1 1 1", "0 0 0 0 0 0", "900 8 1 1 1 1"])
def test_a_lost_pose_of_raw_kitti_costs_that_pose(text, kitti_raw):
    pose = kitti_raw / "oxts" / "data" / "0000000002.txt"
    pose.unlink() if text is None else pose.write_text(text)
    frames, _, notes = opened(kitti_raw)
    assert [f.truth is not None for f in frames] == KNOWN
    assert frames[5].truth.y_m == pytest.approx(np.radians(5e-6) * 6378137.0, rel=1e-3)
    assert "1 of 6" in notes or "1 file is missing of 6" in notes


def test_a_lost_image_of_raw_kitti_leaves_the_others_their_times_and_poses(kitti_raw):
    (kitti_raw / "image_02" / "data" / "0000000002.png").unlink()
    frames, _, notes = opened(kitti_raw)
    np.testing.assert_allclose([f.time_s for f in frames], [0.0, 0.1, 0.3, 0.4, 0.5], atol=1e-6)
    assert frames[2].truth.y_m == pytest.approx(np.radians(3e-6) * 6378137.0, rel=1e-3)
    assert "image_02: 1 file is missing of 6" in notes


def test_times_of_raw_kitti_of_another_clock_are_said(kitti_raw):
    seconds = "".join(f"{0.1 * k}\n" for k in range(6))
    (kitti_raw / "image_02" / "timestamps.txt").write_text(seconds)
    frames, _, notes = opened(kitti_raw)
    assert not any(f.truth for f in frames)
    assert "no frame has a true pose" in notes


@pytest.fixture
def tum_vi(tmp_path):
    (tmp_path / "mav0" / "cam0" / "data").mkdir(parents=True)
    (tmp_path / "mav0" / "mocap0").mkdir()
    for k in range(6):
        image(tmp_path / "mav0" / "cam0" / "data" / f"{k}.jpg", k, ".jpg")

    def make(stamp, known=None, pose="{x},0,1.5", rows=range(12)):
        images = [f"{stamp(0.05 * k)},{k}.jpg\n" for k in range(6)]
        (tmp_path / "mav0" / "cam0" / "data.csv").write_text(f"#t,file\n{''.join(images)}")
        poses = [f"{(known or stamp)(0.025 * k)},{pose.format(x=0.05 * k)},1,0,0,0\n" for k in rows]
        (tmp_path / "mav0" / "mocap0" / "data.csv").write_text(
            f"#t,x,y,z,w,x,y,z\n{''.join(poses)}"
        )
        return tmp_path

    return make


def ns(time_s):
    return 17 * 10**17 + round(time_s * 1e9)


@pytest.mark.parametrize("per_s", [1e9, 1e6, 1e3, 1.0])
def test_tum_vi_in_another_unit_of_time_is_the_same(per_s, tum_vi):
    def stamp(time_s):
        return repr((1.7e9 + time_s) * per_s) if per_s < 1e6 else round((1.7e9 + time_s) * per_s)

    for folder in (tum_vi(stamp), tum_vi(ns, known=stamp)):
        frames, _, notes = opened(folder)
        assert frames[-1].time_s - frames[0].time_s == pytest.approx(0.25)
        assert [f.truth.x_m for f in frames] == pytest.approx([0.1 * k for k in range(6)], abs=1e-4)
        assert ("times are in" in notes) == (per_s != 1e9)


def test_wrong_truth_of_tum_vi_is_said(tum_vi):
    assert "no frame has a true pose" in opened(tum_vi(ns, known=lambda t: round(t * 1e9)))[2]
    notes = opened(tum_vi(ns, pose="{x},0,{x}0", rows=range(40)))[2]
    assert "moves along z" in notes
