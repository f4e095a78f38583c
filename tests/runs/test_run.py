"""Runs: the files and columns that are promised, and that a cut run ends up like an uncut one."""

import json
import re
import shutil
import signal
import subprocess
import sys
import time
import tomllib

import cv2
import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from neuroslam.brain import load_brain
from neuroslam.config import BrainConfig, build_config, read_preset
from neuroslam.errors import RunError
from neuroslam.evaluation.trajectory import read_tum
from neuroslam.figures.places import plot_place_cells
from neuroslam.runs.evaluate import evaluate
from neuroslam.runs.files import TRACE_COLUMNS
from neuroslam.runs.plot import plot
from neuroslam.runs.reading import read_frames, read_trace
from neuroslam.runs.results import RunSummary
from neuroslam.runs.run import resolve_config, resume, run
from neuroslam.sensors import open_source

WORLD = "world:corridor?width=64&height=40&frames_per_lap=100&laps=1.5"
N = 151
CONFIG = BrainConfig()
EQUAL = (
    "frames.csv",
    "experiences.csv",
    "links.csv",
    "trajectory.tum",
    "brain.safetensors",
    "config.toml",
    "trace.f64",
    "map.png",
)
TIMINGS = {"seconds", "cpu_seconds", "frames_per_s", "frames_per_cpu_s"}


def quiet_run(source, out, config=CONFIG, **options) -> RunSummary:
    return run(source, out, config, tensorboard=False, **options)


def assert_equal_runs(a, b):
    for name in EQUAL:
        assert (a / name).read_bytes() == (b / name).read_bytes(), name


def table(path) -> tuple[str, list[list[str]]]:
    head, *rows = path.read_text().splitlines()
    return head, [row.split(",") for row in rows]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    out = tmp_path_factory.mktemp("whole")
    summary = run(WORLD, out, CONFIG)
    return out, summary


@pytest.fixture(scope="module")
def cut(tmp_path_factory):
    """A run that stopped in the middle; for tests to copy."""
    out = tmp_path_factory.mktemp("cut") / "run"
    quiet_run(WORLD, out, stop=120)
    return out


@pytest.fixture
def cut_copy(cut, tmp_path):
    return shutil.copytree(cut, tmp_path / "copy")


def test_a_run_writes_these_files_and_no_others(whole):
    out, _ = whole
    assert {path.name for path in out.iterdir()} == {
        *EQUAL,
        "metrics.json",
        "manifest.json",
        "events",
    }


def test_the_columns_are_a_contract(whole):
    out, _ = whole
    assert table(out / "frames.csv")[0] == (
        "frame,time_s,v_m_s,w_rad_s,template,match_error,relative_heading_rad,action,experience,"
        "x_m,y_m,theta_rad,pose_x,pose_y,pose_theta,n_templates,n_experiences,n_links"
    )
    assert table(out / "experiences.csv")[0] == "id,x_m,y_m,theta_rad,template,first_frame"
    assert table(out / "links.csv")[0] == (
        "from,to,distance_m,heading_rad,facing_rad,duration_s,weight"
    )


def test_every_frame_has_a_row_that_says_what_the_brain_said(whole):
    out, _ = whole
    head, rows = table(out / "frames.csv")
    assert [int(row[0]) for row in rows] == list(range(N))
    actions = {row[head.split(",").index("action")] for row in rows}
    assert {"create", "link", "none"} <= actions <= {"create", "link", "set", "none"}
    numbers = read_frames(out)
    assert np.isfinite(np.column_stack(list(numbers.values()))).all()
    source = open_source(WORLD)
    np.testing.assert_array_equal(
        np.column_stack([numbers["v_m_s"], numbers["w_rad_s"]]), source.odometry()
    )
    brain = load_brain(out / "brain.safetensors")
    assert (numbers["n_experiences"][-1], numbers["n_links"][-1]) == (
        brain.map.n,
        brain.map.n_links,
    )
    for name in ("n_templates", "n_experiences", "n_links"):
        assert (np.diff(numbers[name]) >= 0).all()


def test_the_tables_hold_the_map_to_the_last_digit(whole):
    out, _ = whole
    brain = load_brain(out / "brain.safetensors")
    rows = np.loadtxt(out / "experiences.csv", delimiter=",", skiprows=1)
    np.testing.assert_array_equal(rows[:, 1:4], brain.map.poses)
    np.testing.assert_array_equal(rows[:, 0], np.arange(brain.map.n))
    links = np.loadtxt(out / "links.csv", delimiter=",", skiprows=1)
    np.testing.assert_array_equal(links[:, :6], np.column_stack(brain.map.links))
    np.testing.assert_array_equal(links[:, 6], brain.map.link_weights)
    assert (links[:, 6] > 0.0).all()
    assert (links[:, 6] <= 1.0).all()
    assert links[0, 6] == 1.0


def test_the_metrics_say_how_much_how_fast_and_how_well(whole):
    out, summary = whole
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics == summary.to_dict()
    assert (metrics["frames"], metrics["skipped_frames"], metrics["merges"]) == (N, 0, 0)
    assert metrics["frames_per_s"] == pytest.approx(N / metrics["seconds"])
    assert metrics["loop_closures"] > 0
    frames = read_frames(out)
    for name in ("templates", "experiences", "links"):
        assert metrics[name] == frames[f"n_{name}"][-1]


def test_the_config_is_written_complete_and_gives_the_same_brain(whole, tmp_path):
    out, _ = whole
    written = tomllib.loads((out / "config.toml").read_text())
    assert written.pop("run") == {"source": WORLD, "start": 0, "on_bad_frame": "stop"}
    assert build_config(written) == CONFIG
    set_keys = CONFIG.model_dump(exclude_none=True)
    assert {name: written[name].keys() for name in set_keys if name in ("view", "map")} == {
        name: set_keys[name].keys() for name in ("view", "map")
    }
    assert resolve_config(config=out / "config.toml") == CONFIG


def test_the_track_agrees_with_the_truth_where_odometry_is_exact(whole):
    """Truth starts elsewhere, so it is moved to the start of the map, not fitted to it."""
    out, summary = whole
    assert summary.accuracy["odometry_ate_rmse_m"] < 0.1
    assert summary.accuracy["ate_rmse_m"] < 0.25
    track = read_tum(out / "trajectory.tum")
    source = open_source(WORLD)
    np.testing.assert_allclose(track.times_s, np.arange(N) / source.frame_rate_hz)
    true = source.truths()
    turn = track.poses[0, 2] - true[0, 2]
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    expected = track.poses[0, :2] + (true[:, :2] - true[0, :2]) @ rotation.T
    assert np.hypot(*(track.poses[:, :2] - expected).T).max() < 1.0  # of a lap of 33 m


def test_events_are_for_tensorboard(whole):
    out, _ = whole
    events = EventAccumulator(str(out / "events"))
    events.Reload()
    assert "map/experiences" in events.Tags()["scalars"]


def test_two_runs_write_equal_files(whole, tmp_path):
    out, summary = whole
    again = quiet_run(WORLD, tmp_path / "again")
    assert_equal_runs(out, tmp_path / "again")
    assert not (tmp_path / "again" / "events").exists()
    same = [{k: v for k, v in s.to_dict().items() if k not in TIMINGS} for s in (summary, again)]
    assert same[0] == same[1]


def test_a_resumed_run_equals_an_uncut_one(whole, cut_copy, tmp_path):
    """Cut after the first loop closure, and once more."""
    out, uncut = whole
    resume(cut_copy, stop=130, tensorboard=False)
    summary = resume(cut_copy, tensorboard=False)
    assert_equal_runs(out, cut_copy)
    assert (summary.frames, summary.counts) == (uncut.frames, uncut.counts)
    resume(cut_copy, tensorboard=False)  # nothing is left to do
    assert_equal_runs(out, cut_copy)


def test_a_map_solved_as_it_grows_resumes_to_the_last_bit_and_is_solved_at_its_end(tmp_path):
    config = BrainConfig(map={"solver": "incremental", "robust": True})
    quiet_run(WORLD, tmp_path / "whole", config)
    quiet_run(WORLD, tmp_path / "cut", config, stop=130)
    before = load_brain(tmp_path / "cut" / "brain.safetensors").map
    assert before.n_links >= before.n  # a loop has been closed
    resume(tmp_path / "cut", tensorboard=False)
    assert_equal_runs(tmp_path / "whole", tmp_path / "cut")
    resume(tmp_path / "cut", tensorboard=False)  # nothing is left to do
    assert_equal_runs(tmp_path / "whole", tmp_path / "cut")
    ended = load_brain(tmp_path / "whole" / "brain.safetensors").map
    solved = ended.poses
    ended.solve()
    assert np.abs(ended.poses - solved).max() < 1e-4


def test_a_run_may_begin_and_be_cut_anywhere(tmp_path):
    quiet_run(WORLD, tmp_path / "whole", start=20, stop=26)
    quiet_run(WORLD, tmp_path / "cut", start=20, stop=21)
    resume(tmp_path / "cut", stop=26, tensorboard=False)
    assert_equal_runs(tmp_path / "whole", tmp_path / "cut")
    assert read_frames(tmp_path / "cut")["frame"].tolist() == list(range(20, 26))


def test_a_run_goes_on_in_a_new_process_after_one_was_killed(whole, cut_copy):
    """A killed run has written rows that its last saved brain knows nothing of, one not whole."""
    frames = (cut_copy / "frames.csv").read_bytes()
    extra = b"".join(frames.splitlines(keepends=True)[-5:])
    (cut_copy / "frames.csv").write_bytes(frames + extra + extra[:20])
    trace = (cut_copy / "trace.f64").read_bytes()
    (cut_copy / "trace.f64").write_bytes(trace + trace[: 5 * 8 * len(TRACE_COLUMNS) + 3])
    command = [sys.executable, "-m", "neuroslam.cli", "resume", cut_copy, "--quiet"]
    command.append("--no-tensorboard")
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert_equal_runs(whole[0], cut_copy)


def test_ctrl_c_saves_and_the_run_goes_on_as_if_it_had_not_been(tmp_path):
    world, out = WORLD.replace("laps=1.5", "laps=500"), tmp_path / "run"
    command = [sys.executable, "-m", "neuroslam.cli", "run", world, "-o", out, "--no-tensorboard"]
    (tmp_path / "plain.toml").write_text("")
    command += ["--config", tmp_path / "plain.toml"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        while process.poll() is None:
            if (out / "frames.csv").exists() and (out / "frames.csv").stat().st_size > 4096:
                process.send_signal(signal.SIGINT)
                break
            time.sleep(0.01)
        _, said = process.communicate(timeout=300)
    assert process.returncode == 130
    assert said.decode() == (f"neuroslam run: interrupted; continue with: neuroslam resume {out}\n")
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["interrupted"]
    frames = metrics["frames"]
    assert len(read_frames(out)["frame"]) == frames == len(read_trace(out)["time_s"])
    resume(out, stop=frames + 10, tensorboard=False)
    quiet_run(world, tmp_path / "uncut", stop=frames + 10)
    assert_equal_runs(tmp_path / "uncut", out)


def test_a_frame_that_was_skipped_at_the_end_counts_once(tmp_path):
    source = tmp_path / "motion.csv"
    rows = ["1.0,0.0"] * 5 + ["nan,0.0"] + ["1.0,0.0"] * 4
    source.write_text("v_m_s,w_rad_s\n" + "\n".join(rows) + "\n")
    quiet_run(source, tmp_path / "run", stop=6, on_bad_frame="skip")
    summary = resume(tmp_path / "run", tensorboard=False)
    assert (summary.frames, len(summary.skipped)) == (9, 1)
    assert json.loads((tmp_path / "run/metrics.json").read_text())["skipped_frames"] == 1


def test_one_frame_is_a_run_too(tmp_path):
    summary = quiet_run(WORLD, tmp_path, stop=1)
    assert (summary.frames, summary.counts["experiences"], summary.counts["links"]) == (1, 1, 0)


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    """Twelve frames of the world as a folder of pictures with odometry.csv, and as a video."""
    folder = tmp_path_factory.mktemp("kept") / "frames"
    folder.mkdir()
    video = folder.parent / "drive.avi"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (64, 40))
    rows = ["time_s,v_m_s,w_rad_s,x_m,y_m,theta_rad"]
    for frame in open_source(WORLD).frames(0, 12):
        image = frame.image[..., ::-1]
        cv2.imwrite(str(folder / f"{frame.index}.png"), image)
        writer.write(np.ascontiguousarray(image))
        rows.append(",".join(map(repr, (frame.time_s, *frame.velocity, *frame.truth))))
    writer.release()
    (folder / "odometry.csv").write_text("\n".join(rows) + "\n")
    return folder


def test_a_folder_of_a_worlds_pictures_and_motion_maps_like_the_world(pictures, tmp_path):
    summary = quiet_run(pictures, tmp_path / "folder")
    expected = quiet_run(WORLD, tmp_path / "world", stop=12)
    named_after_their_source = {"config.toml", "map.png", "trace.f64", "brain.safetensors"}
    for name in set(EQUAL) - named_after_their_source:
        assert (tmp_path / "folder" / name).read_bytes() == (
            tmp_path / "world" / name
        ).read_bytes(), name
    states = [
        load_brain(tmp_path / name / "brain.safetensors").state_dict()
        for name in ("folder", "world")
    ]
    for name in states[0]:
        if "session" not in name:
            assert torch.equal(states[0][name], states[1][name]), name
    assert summary.accuracy == expected.accuracy


def test_a_video_is_mapped_by_what_it_shows_alone(pictures, tmp_path):
    summary = quiet_run(pictures.parent / "drive.avi", tmp_path)
    frames = read_frames(tmp_path)
    assert (summary.frames, summary.accuracy) == (12, {})
    np.testing.assert_allclose(frames["time_s"], np.arange(12) / 10.0)
    assert (frames["v_m_s"][1:] > 0).all()
    assert summary.counts["templates"] > 0


def test_motion_alone_is_dead_reckoned(tmp_path):
    """A circle of 2 m radius, driven in 40 steps, ends where it began."""
    w, dt = 2 * np.pi / 4.0, 0.1
    rows = [f"{i * dt!r},{2.0 * w!r},{w!r}" for i in range(41)]
    rows[0] = "0.0,0.0,0.0"
    source = tmp_path / "circle.csv"
    source.write_text("time_s,v_m_s,w_rad_s\n" + "\n".join(rows) + "\n")
    summary = quiet_run(source, tmp_path / "run")
    track = read_tum(tmp_path / "run" / "trajectory.tum")
    assert summary.frames == 41
    assert (summary.counts["templates"], summary.counts["loop_closures"]) == (0, 0)
    np.testing.assert_allclose(track.poses[-1, :2], track.poses[0, :2], atol=1e-9)
    assert np.ptp(track.poses[:, 0]) == pytest.approx(4.0, rel=0.01)
    drawn = cv2.imread(str(tmp_path / "run" / "map.png"))
    assert drawn.std() > 1  # not an empty sheet


def test_a_stretch_of_a_real_tar_is_mapped(shared, tmp_path):
    tar = shared / "data" / "circuit_launch" / "frames.tar"
    if not tar.is_file():
        pytest.skip("no circuit_launch/frames.tar")
    summary = quiet_run(tar, tmp_path, start=100, stop=115)
    assert read_frames(tmp_path)["frame"].tolist() == list(range(100, 115))
    assert (summary.frames, summary.counts["templates"] > 0) == (15, True)


def test_a_source_outside_the_folder_is_found_from_anywhere(pictures, tmp_path, monkeypatch):
    """A relative path, and letters beyond ASCII, survive config.toml."""
    odd = shutil.copytree(pictures, tmp_path / '$f$ räme "1" 🐀')
    monkeypatch.chdir(tmp_path)
    quiet_run(odd.name, "run", stop=5)
    monkeypatch.chdir(tmp_path / "run")
    summary = resume(tmp_path / "run", tensorboard=False)
    assert summary.frames == 12


def test_a_file_overrides_a_preset_and_assignments_override_both(tmp_path):
    preset = read_preset("openratslam")
    assert {"threshold", "shift_match"} <= preset["view"].keys()
    file = tmp_path / "mine.toml"
    file.write_text("[view]\nthreshold = 0.011\nshift_match = 3\n[map]\nloops = 7\n")
    found = resolve_config("openratslam", file, ("view.threshold=0.022",))
    assert (found.view.threshold, found.view.shift_match, found.map.loops) == (0.022, 3, 7)
    untouched = resolve_config("openratslam").model_dump()
    changed = {
        (section, key)
        for section in ("odometry", "view", "pose_cells", "map")
        for key, value in found.model_dump()[section].items()
        if value != untouched[section][key]
    }
    assert changed == {("view", "threshold"), ("view", "shift_match"), ("map", "loops")}


def test_evaluate_repeats_the_error_of_the_run(whole, tmp_path):
    out, summary = whole
    (name, absolute, unit), *relative = evaluate(out)
    assert (name, unit, absolute.n) == ("absolute (ATE)", "m", N)
    assert absolute.rmse == pytest.approx(summary.accuracy["ate_rmse_m"], abs=1e-6)
    assert [unit for *_, unit in relative] == ["m", "rad"]
    itself = evaluate(out / "trajectory.tum", out / "trajectory.tum", "none")
    assert all(found.max < 1e-6 for _, found, _ in itself)


def test_plot_draws_the_map_again_and_two_more(whole, tmp_path):
    out, _ = whole
    written = plot(out, tmp_path / "figures")
    assert [path.name for path in written] == ["map.png", "pose_cells.png", "signals.png"]
    assert written[0].read_bytes() == (out / "map.png").read_bytes()
    for path in written:
        assert cv2.imread(str(path)).std() > 1


@pytest.mark.parametrize(
    ("cells", "figures"),
    [
        (["place"], ["place_cells.png", "cells_grid.png", "cells_place.png", "raster.png"]),
        (["semantic"], []),
        (["pose", "place"], ["pose_cells.png", "place_cells.png"]),
    ],
)
def test_plot_draws_the_cells_that_the_brain_has(cells, figures, tmp_path):
    quiet_run(f"{WORLD}&ranges=36&markers=6", tmp_path / "run", BrainConfig(cells=cells), stop=8)
    written = plot(tmp_path / "run", tmp_path / "figures")
    assert [path.name for path in written] == ["map.png", *figures, "signals.png"]


def test_the_path_is_drawn_where_the_place_cells_are(tmp_path, monkeypatch):
    """The pose cells lead, and their map has its own coordinates."""
    config = build_config(read_preset("full") | {"cells": ["pose", "place"]})
    quiet_run("arena:square?minutes=0.5", tmp_path / "run", config)
    drawn = []
    monkeypatch.setattr(
        "neuroslam.runs.plot.plot_place_cells",
        lambda *what: drawn.append(what) or plot_place_cells(*what),
    )
    plot(tmp_path / "run", tmp_path / "figures")
    ((centres, _, _, here, path),) = drawn
    assert len(centres) > 2
    np.testing.assert_allclose(path[-1], here[:2], atol=1e-9)
    np.testing.assert_allclose(path[0], centres[0], atol=0.1)
    apart = np.linalg.norm(path[:, None] - centres, axis=-1).min(axis=0)
    assert apart.max() < 0.1


def test_overwriting_leaves_nothing_of_the_run_before(whole, tmp_path):
    out = shutil.copytree(whole[0], tmp_path / "run")
    with pytest.raises(RunError, match="holds a run already"):
        quiet_run(WORLD, out, stop=5)
    quiet_run(WORLD, out, stop=5, overwrite=True)
    quiet_run(WORLD, tmp_path / "fresh", stop=5)
    assert_equal_runs(out, tmp_path / "fresh")
    assert not (out / "events").exists()


@pytest.mark.parametrize("name", ["frames.csv", "trace.f64"])
def test_missing_rows_are_reported_before_anything_is_written(cut_copy, name):
    content = (cut_copy / name).read_bytes()
    (cut_copy / name).write_bytes(content[: len(content) // 2])
    with pytest.raises(RunError, match=rf"{re.escape(name)}: .*cannot resume"):
        resume(cut_copy, tensorboard=False)
    assert (cut_copy / name).read_bytes() == content[: len(content) // 2]
