"""A run as a recording of rerun: it is opened again by rerun's own reader."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from neuroslam import NavigationBrain, open_source
from neuroslam.cli import main
from neuroslam.config import build_config, read_preset
from neuroslam.mapping.tables import closes_loop
from neuroslam.runs.rerun import EVERY, RerunRecorder

rr = pytest.importorskip("rerun", reason="needs the extra rerun")
chunks = pytest.importorskip("rerun.chunk", reason="needs a reader: rerun-sdk 0.41")

SOURCE = "world:corridor?width=64&height=40&frames_per_lap=54&laps=1.2"


def read(path):
    """Every component of a recording: rows of frame number, time in s, and value."""
    found = {}
    for chunk in chunks.RrdReader(str(path)).stream():
        if chunk.is_static or not {"frame", "time"} <= set(chunk.timeline_names):
            continue
        batch = chunk.to_record_batch()
        columns = {name: batch.column(k).to_pylist() for k, name in enumerate(batch.schema.names)}
        times = [t.total_seconds() for t in columns["time"]]
        for name in columns.keys() - {"frame", "time", "log_time", "rerun.controls.RowId"}:
            rows = zip(columns["frame"], times, columns[name], strict=True)
            found.setdefault(f"{chunk.entity_path}:{name}", []).extend(rows)
    return {name: sorted(rows, key=lambda row: row[0]) for name, rows in found.items()}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    path = tmp_path_factory.mktemp("rerun") / "run.rrd"
    brain = NavigationBrain(build_config(read_preset("ratslam")))
    recorder, results = RerunRecorder(path, share=1.0), []
    for frame in open_source(SOURCE):
        results.append(brain(frame))
        recorder.step(results[-1], frame, brain)
    recorder.close()
    recorder.close()
    return read(path), results, brain, path


def test_every_frame_has_its_pose_and_figures(recorded):
    found, results, _, _ = recorded
    rows = found["/map/robot:Arrows3D:origins"]
    assert [row[0] for row in rows] == [result.frame for result in results]
    assert [row[1] for row in rows] == pytest.approx([result.time_s for result in results])
    origins = np.array([row[2][0] for row in rows])
    assert origins[:, :2] == pytest.approx(np.array([r.pose[:2] for r in results]), abs=1e-5)
    ahead = np.array([row[2][0] for row in found["/map/robot:Arrows3D:vectors"]])
    headings = np.arctan2(ahead[:, 1], ahead[:, 0])
    assert np.cos(headings - [r.pose.theta_rad for r in results]) == pytest.approx(1.0)
    for name, value in (("templates", "n_templates"), ("experiences", "n_experiences")):
        figures = [row[2][0] for row in found[f"/figures/{name}:Scalars:scalars"]]
        assert figures == [getattr(result, value) for result in results]


def test_pictures_templates_and_cells_follow_every_tenth_frame(recorded):
    found, results, brain, _ = recorded
    frames = [row[0] for row in found["/camera/picture:EncodedImage:blob"]]
    assert frames == [*range(0, len(results), EVERY), len(results) - 1]
    blob = np.frombuffer(bytes(found["/camera/picture:EncodedImage:blob"][-1][2][0]), np.uint8)
    assert cv2.imdecode(blob, cv2.IMREAD_COLOR).shape == (40, 64, 3)
    assert [row[0] for row in found["/cells/activity:Image:buffer"]] == frames
    templates = found["/camera/template:Image:buffer"]
    assert [row[0] for row in templates] == frames
    pixels = np.frombuffer(bytes(templates[-1][2][0]), np.uint8)
    expected = brain.view.template_image(results[-1].view.template)
    np.testing.assert_array_equal(pixels, expected.ravel())


def test_the_map_and_its_loop_closures_are_those_of_the_brain(recorded):
    found, results, brain, _ = recorded
    nodes = np.array(found["/map/experiences:Points3D:positions"][-1][2])
    assert nodes[:, :2] == pytest.approx(brain.map.poses[:, :2], abs=1e-5)
    closing = closes_loop(*brain.map.links[:2])
    assert closing.sum() > 0
    assert len(found["/map/links:LineStrips3D:strips"][-1][2]) == (~closing).sum()
    red = found["/map/loop_closures:LineStrips3D:strips"][-1][2]
    ends = [brain.map.links.source[closing], brain.map.links.target[closing]]
    for strip, source, target in zip(red, *ends, strict=True):
        at = brain.map.poses[[source, target], :2]
        assert np.array(strip)[:, :2] == pytest.approx(at, abs=1e-5)
    texts = [row[2][0] for row in found["/events:TextLog:text"]]
    assert len(texts) == closing.sum()
    assert texts[0].startswith("loop closed at experience ")
    last = found["/figures/loop_closures:Scalars:scalars"][-1][2][0]
    assert last == closing.sum()
    path = np.array(found["/map/path:LineStrips3D:strips"][-1][2][0])
    assert len(path) == len(results)


def test_the_layout_is_in_the_recording(recorded):
    path = recorded[-1]
    stored = chunks.RrdReader(str(path))
    assert len(stored.recordings()) == 1
    assert stored.blueprints()
    names = set()
    for blueprint in stored.blueprints():
        for chunk in stored.stream(store=blueprint):
            batch = chunk.to_record_batch()
            for k, name in enumerate(batch.schema.names):
                if name.endswith("display_name"):
                    names |= {value[0] for value in batch.column(k).to_pylist() if value}
    assert {"map", "camera", "matched template", "cells", "loop closures"} <= names


def test_a_small_share_of_the_time_leaves_pictures_out_but_no_pose(tmp_path):
    brain = NavigationBrain(build_config(read_preset("ratslam")))
    frames, found = list(open_source(SOURCE).frames(stop=30)), {}
    with RerunRecorder(tmp_path / "run.rrd", share=0.0) as recorder:
        for frame in frames:
            recorder.step(brain(frame), frame, brain)
    found = read(tmp_path / "run.rrd")
    assert len(found["/map/robot:Arrows3D:origins"]) == 30
    assert [row[0] for row in found["/camera/picture:EncodedImage:blob"]] == [0, 29]


def test_the_command_line_writes_a_recording_and_opens_the_viewer(tmp_path, monkeypatch, capsys):
    spawned = []
    monkeypatch.setattr(rr, "spawn", lambda connect: spawned.append(connect))
    monkeypatch.setattr(rr, "GrpcSink", lambda: rr.FileSink(str(tmp_path / "viewer.rrd")))
    words = ["run", SOURCE, "-o", str(tmp_path / "run"), "--stop", "12", "--no-tensorboard"]
    assert (
        main([*words, "--preset", "ratslam", "--rerun", "--rerun-save", str(tmp_path / "a.rrd")])
        == 0
    )
    assert spawned == [False]
    for name in ("a.rrd", "viewer.rrd"):
        assert len(read(tmp_path / name)["/map/robot:Arrows3D:origins"]) == 12

    def no_viewer(connect):
        raise RuntimeError("no executable")

    monkeypatch.setattr(rr, "spawn", no_viewer)
    assert main([*words, "--overwrite", "--rerun"]) == 2
    assert "the viewer does not start (no executable)" in " ".join(capsys.readouterr().err.split())
    assert main([*words, "--overwrite", "--rerun-save", str(Path("/dev/null/a.rrd"))]) == 2
    assert "cannot be written" in capsys.readouterr().err
