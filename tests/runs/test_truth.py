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
    (name, found, _), *relative = evaluate(tmp_path, on_note=notes.append)
    assert (name, found.n, relative) == ("absolute (ATE)", n, [])
    assert notes == [
        f"{n} of {len(poses)} frames have a true pose; the errors are over those",
        "the truth has no headings; there is no relative error",
    ]


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
