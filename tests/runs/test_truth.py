"""Ground truth from a file of its own: in the figures, the errors, the report and ``evaluate``."""

import json

import cv2
import numpy as np
import pytest

from neuroslam.errors import SourceError
from neuroslam.evaluation.trajectory import Track, write_tum
from neuroslam.runs.evaluate import evaluate
from neuroslam.runs.reading import read_plan, read_trace
from neuroslam.runs.run import resume, run
from neuroslam.runs.truth import WithTruth, read_truth
from neuroslam.sensors import open_source

WORLD = "world:corridor?width=64&height=40&frames_per_lap=60&laps=1"


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """A video, and its truth as a CSV without headings and as a TUM file."""
    home = tmp_path_factory.mktemp("drive")
    frames = list(open_source(WORLD).frames())
    video = cv2.VideoWriter(
        str(home / "drive.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (64, 40)
    )
    for frame in frames:
        image = frame.image
        video.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image)
    video.release()
    poses = np.array([frame.truth for frame in frames])
    times_s = np.arange(len(frames)) / 10.0
    write_tum(home / "truth.tum", Track(times_s, poses))
    rows = [f"{t - 0.02},{x},{y}" for t, (x, y, _) in zip(times_s, poses, strict=True)]
    (home / "half.csv").write_text("\n".join(["time,x,y", *rows[: len(rows) // 2]]) + "\n")
    return home, poses


def test_a_video_with_truth_has_its_error_in_metrics_figure_and_evaluate(drive, tmp_path, call):
    home, poses = drive
    done = call("run", home / "drive.avi", "-o", tmp_path, "--truth", home / "truth.tum",
                "--no-tensorboard")  # fmt: skip
    assert (done.code, done.err) == (0, "")
    assert f"over {len(poses)} frames with truth" in done.out
    trace = read_trace(tmp_path)
    np.testing.assert_allclose(trace["truth_x_m"], poses[:, 0], atol=1e-6)
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    for mode, name in (("rigid", "ate_rmse_m"), ("similarity", "ate_similarity_rmse_m")):
        (_, found, _), *relative = evaluate(tmp_path, align=mode)
        assert found.rmse == pytest.approx(metrics[name], abs=1e-6)
        assert len(relative) == 2
    assert metrics["ate_similarity_rmse_m"] <= metrics["ate_rmse_m"]


def test_half_a_truth_without_headings_gives_the_error_of_that_half(drive, tmp_path):
    home, poses = drive
    n, notes = len(poses) // 2, []
    run(home / "drive.avi", tmp_path, truth=home / "half.csv", stop=20, tensorboard=False)
    assert read_plan(tmp_path).truth == str(home / "half.csv")
    summary = resume(tmp_path, tensorboard=False)
    assert summary.accuracy["frames_with_truth"] == n
    (free, rigid) = evaluate(tmp_path, on_note=notes.append)
    assert [free[0], rigid[0]] == ["ATE (similarity)", "ATE (rigid)"]
    assert [free[1].n, rigid[1].n] == [n, n]
    assert free[1].rmse == pytest.approx(summary.accuracy["ate_similarity_rmse_m"], abs=1e-6)
    assert notes[0] == f"{n} of {len(poses)} frames have truth; the errors are over those"
    assert notes[1].startswith("the scale is unknown, as one camera measures none: 1 unit of")
    assert notes[2] == "the truth has no headings; there is no relative error"


def test_a_truth_of_another_time_is_reported(drive, tmp_path):
    home, _ = drive
    (tmp_path / "unix.csv").write_text("time_s,x_m,y_m,theta_rad\n1700000000,0,0,0\n")
    source = WithTruth(open_source(home / "drive.avi"), tmp_path / "unix.csv")
    assert all(frame.truth is None for frame in source.frames(stop=3))
    (note,) = source.unused
    assert "no frame has a true pose: it spans 1700000000 s to 1700000000 s" in note
    assert "the frames 0 s to 0.2 s" in note


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("time,x\n0,1\n", "y_m"),
        ("time,x,y\n1,0,0\n0,1,1\n", "its time does not rise"),
        ("time,x,y\n0,,\n", "has no position"),
    ],
)
def test_a_damaged_truth_is_refused(text, words, tmp_path):
    (tmp_path / "truth.csv").write_text(text)
    with pytest.raises(SourceError, match=words):
        read_truth(tmp_path / "truth.csv")


def test_a_missing_truth_is_refused_before_anything_is_written(drive, tmp_path):
    with pytest.raises(SourceError, match="no such file"):
        run(drive[0] / "drive.avi", tmp_path / "out", truth=tmp_path / "nowhere.csv")
    assert not (tmp_path / "out").exists()


# Partly known truth


def as_tum(times_s, poses):
    """TUM lines of poses on the plane, as text."""
    half = poses[:, 2] / 2.0
    return [
        f"{t:.4f} {x:.6f} {y:.6f} 0 0 0 {z:.9f} {w:.9f}"
        for t, (x, y, _), z, w in zip(times_s, poses, np.sin(half), np.cos(half), strict=True)
    ]


def test_the_given_truth_that_begins_late_counts_for_50_of_60_frames(cases, tmp_path, call):
    done = call("run", cases / "truth_begins_late", "-o", tmp_path / "m", "--no-tensorboard")
    assert done.code == 0
    assert "50 of 60 frames have truth" in done.out
    truth = read_trace(tmp_path / "m")["truth_x_m"]
    assert np.isnan(truth[:10]).all()
    assert np.isfinite(truth[10:]).all()
    found = call("evaluate", tmp_path / "m")
    assert found.code == 0
    assert "50 of 60 frames have truth" in found.out
    assert "ATE (similarity)" in found.out


@pytest.mark.parametrize(
    "lost",
    ["{t} nan nan nan nan nan nan nan", "{t} 0 0 0 0 0 0 0", "{t} lost", "", "{t} 1 2 3"],
)
def test_a_lost_row_of_truth_costs_that_row(lost, drive, tmp_path):
    home, poses = drive
    lines = as_tum(np.arange(len(poses)) / 10.0, poses)
    lines[20] = lost.format(t=2.0)
    (tmp_path / "truth.tum").write_text("\n".join(lines))
    source = WithTruth(open_source(home / "drive.avi"), tmp_path / "truth.tum")
    truth = [frame.truth for frame in source.frames()]
    assert [k for k, pose in enumerate(truth) if pose is None] == [20]
    kept = [pose for pose in truth if pose is not None]
    np.testing.assert_allclose(kept, np.delete(poses, 20, axis=0), atol=1e-5)
    what = f"1 of {len(poses)} rows has no usable pose"
    named = [note for note in source.notes if what in note]
    assert len(named) == (lost != "")


@pytest.mark.parametrize("lost", ["2.0,,,", "2.0,nan,nan,nan", "2.0,x,x,x", "2.0", ",1,2,0.5"])
def test_a_lost_row_of_a_csv_costs_that_row(lost, drive, tmp_path):
    home, poses = drive
    rows = [f"{k / 10},{x},{y},{theta}" for k, (x, y, theta) in enumerate(poses)]
    rows[20] = lost
    (tmp_path / "truth.csv").write_text("\n".join(["Time [s],x,y,theta", *rows]))
    source = WithTruth(open_source(home / "drive.avi"), tmp_path / "truth.csv")
    assert [f.index for f in source.frames() if f.truth is None] == [20]


def test_truth_in_the_middle_only_counts_there_and_is_not_extrapolated(drive, tmp_path):
    home, poses = drive
    lines = as_tum(np.arange(len(poses)) / 10.0, poses)
    (tmp_path / "truth.tum").write_text("\n".join(lines[12:40]))
    summary = run(home / "drive.avi", tmp_path / "m", truth=tmp_path / "truth.tum",
                  tensorboard=False)  # fmt: skip
    assert summary.accuracy["frames_with_truth"] == 28
    known = np.isfinite(read_trace(tmp_path / "m")["truth_x_m"])
    assert np.flatnonzero(known).tolist() == list(range(12, 40))


@pytest.mark.parametrize(("unit", "per_s"), [("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
@pytest.mark.parametrize("kind", ["tum", "csv"])
def test_truth_may_have_unix_times_in_any_unit(unit, per_s, kind, drive, tmp_path):
    poses = drive[1]
    stamps = [int((1_700_000_000 + k / 10) * per_s) for k in range(len(poses))]
    path = tmp_path / f"truth.{kind}"
    if kind == "csv":
        rows = [f"{t},{x},{y}" for t, (x, y, _) in zip(stamps, poses, strict=True)]
        path.write_text("\n".join([f"timestamp [{unit}],x,y", *rows]))
    else:
        lines = [f"{t} {line.partition(' ')[2]}" for t, line in
                 zip(stamps, as_tum(np.zeros(len(poses)), poses), strict=True)]  # fmt: skip
        path.write_text("\n".join(lines))
    notes = []
    track = read_truth(path, on_note=notes.append)
    np.testing.assert_allclose(track.times_s, 1_700_000_000 + np.arange(len(poses)) / 10, atol=2e-3)
    np.testing.assert_allclose(track.poses[:, :2], poses[:, :2], atol=1e-6)
    assert len(notes) == 1


def test_the_truth_of_euroc_is_read_from_its_own_csv(tmp_path):
    header = (
        "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], "
        "q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []"
    )
    rows = [f"{1403636579763555584 + 5_000_000 * k},{k},2,3,{np.cos(0.1 * k)},0,0,{np.sin(0.1 * k)}"
            for k in range(9)]  # fmt: skip
    (tmp_path / "data.csv").write_text("\n".join([header, *rows]))
    track = read_truth(tmp_path / "data.csv")
    np.testing.assert_allclose(np.diff(track.times_s), 0.005, atol=1e-6)
    expected = np.column_stack([np.arange(9), np.full(9, 2), 0.2 * np.arange(9)])
    np.testing.assert_allclose(track.poses, expected, atol=1e-9)


def test_a_file_that_is_mostly_no_truth_is_refused(tmp_path):
    (tmp_path / "truth.tum").write_text("0 0 0 0 0 0 0 1\nhello\nworld\n")
    with pytest.raises(SourceError, match="line 2: got 'hello', not numbers"):
        read_truth(tmp_path / "truth.tum")


# Axes


def in_camera_axes(poses):
    """TUM lines with x right, y down, z ahead."""
    half = poses[:, 2] / 2.0
    return [
        f"{k / 10:.4f} {-y:.6f} 0 {x:.6f} 0 {-s:.9f} 0 {c:.9f}"
        for k, ((x, y, _), s, c) in enumerate(zip(poses, np.sin(half), np.cos(half), strict=True))
    ]


def test_the_given_truth_in_camera_axes_is_noticed_and_has_no_error_in_its_axes(cases, call):
    folder = cases / "truth_in_camera_axes"
    args = ("evaluate", folder / "estimate.tum", "--truth", folder / "truth.tum")
    noticed = call(*args)
    assert noticed.code == 0
    assert "moves along z (4 m) and not along y (0 m)" in noticed.out
    assert "use --axes camera" in noticed.out
    rows = evaluate(folder / "estimate.tum", folder / "truth.tum", axes="camera")
    assert [found.rmse < 1e-3 for _, found, _ in rows] == [True, True, True]
    notes = []
    swapped = evaluate(folder / "truth.tum", folder / "estimate.tum", on_note=notes.append)
    assert "use --track-axes camera" in notes[0]
    assert swapped[0][1].rmse > 0.5
    rows = evaluate(folder / "truth.tum", folder / "estimate.tum", track_axes="camera")
    assert rows[0][1].rmse < 1e-3


def test_a_run_with_truth_in_camera_axes_remembers_the_axes(drive, tmp_path, call):
    home, poses = drive
    (tmp_path / "cam.tum").write_text("\n".join(in_camera_axes(poses)))
    out = tmp_path / "m"
    args = ("run", home / "drive.avi", "-o", out, "--truth", tmp_path / "cam.tum",
            "--no-tensorboard", "--stop", 30)  # fmt: skip
    assert "use --axes camera" in call(*args).out
    done = call(*args, "--axes", "camera", "--overwrite")
    assert (done.code, "use --axes camera" in done.out) == (0, False)
    assert read_plan(out).axes == "camera"
    resume(out, tensorboard=False)
    np.testing.assert_allclose(read_trace(out)["truth_x_m"], poses[:, 0], atol=1e-5)
    np.testing.assert_allclose(np.cos(read_trace(out)["truth_theta_rad"] - poses[:, 2]), 1.0)


def test_a_dataset_whose_truth_has_camera_axes_says_so(drive, tmp_path):
    _, poses = drive
    (tmp_path / "rgb").mkdir()
    for k in range(12):
        cv2.imwrite(str(tmp_path / "rgb" / f"{k}.png"), np.full((8, 12), 9 * k, np.uint8))
    (tmp_path / "rgb.txt").write_text("\n".join(f"{k / 10} rgb/{k}.png" for k in range(12)))
    (tmp_path / "groundtruth.txt").write_text("\n".join(in_camera_axes(poses)))
    (note,) = open_source(tmp_path).notes
    assert note.endswith(f"use run with --truth {tmp_path}/groundtruth.txt --axes camera")


def test_axes_without_a_file_of_truth_are_refused(drive, tmp_path, mistake):
    home, _ = drive
    said = mistake("run", home / "drive.avi", "-o", tmp_path / "m", "--axes", "camera")
    assert "--axes camera: are those of a file of truth; give --truth FILE too" in said
    (tmp_path / "t.tum").write_text("0 0 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n")
    said = mistake("evaluate", tmp_path / "t.tum", "--truth", tmp_path / "t.tum", "--axes", "up")
    assert "axes 'up': expected robot" in said
    (tmp_path / "t.csv").write_text("time,x,y\n0,0,0\n1,1,1\n")
    said = mistake("evaluate", tmp_path / "t.tum", "--truth", tmp_path / "t.csv",
                   "--axes", "camera")  # fmt: skip
    assert "has no column z, which --axes camera needs" in said


# One camera


def test_evaluate_of_one_camera_shows_the_similarity_first_and_says_why(drive, tmp_path, call):
    home, _ = drive
    out = tmp_path / "m"
    done = call("run", home / "drive.avi", "-o", out, "--truth", home / "truth.tum",
                "--no-tensorboard")  # fmt: skip
    assert done.out.index("ATE (similarity)") < done.out.index("ATE (rigid)")
    assert "the scale is unknown (one camera)" in done.out
    found = call("evaluate", out).out
    assert found.index("ATE (similarity)") < found.index("ATE (rigid)")
    assert "the scale is unknown, as one camera measures none: 1 unit of the map is" in found
    names = [name for name, _, _ in evaluate(out)]
    assert names == ["ATE (similarity)", "relative, per frame", "relative, per frame",
                     "ATE (rigid)"]  # fmt: skip
    notes = []
    (first, *_) = evaluate(out, align="rigid", on_note=notes.append)
    assert first[0] == "absolute (ATE)"
    assert notes == [
        "the scale is unknown, as one camera measures none; --align similarity frees it"
    ]


def test_evaluate_of_measured_motion_is_rigid(tmp_path):
    run(f"{WORLD}&odometry=true", tmp_path, tensorboard=False, stop=30)
    notes = []
    (first, *_) = evaluate(tmp_path, on_note=notes.append)
    assert (first[0], first[2], notes) == ("absolute (ATE)", "m", [])


def test_a_track_of_another_scale_is_noted(drive, tmp_path):
    home, poses = drive
    scaled = poses * [0.4, 0.4, 1.0]
    (tmp_path / "mono.tum").write_text("\n".join(as_tum(np.arange(len(poses)) / 10.0, scaled)))
    notes = []
    evaluate(tmp_path / "mono.tum", home / "truth.tum", on_note=notes.append)
    assert notes == [
        "the truth is 2.5 times as large as the track; with that scale the ATE is 0.0000 m "
        "(--align similarity)"
    ]
