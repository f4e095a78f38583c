"""The command line: a mistake is one line that names the culprit, exit 2, and nothing is lost."""

import json
import os
import pickle
import re
import shutil
import subprocess
import sys
from importlib.metadata import version

import cv2
import numpy as np
import pytest
import torch
from rich.console import Console
from safetensors.torch import load_file, save_file

from neuroslam.brain import load_brain
from neuroslam.cli import main, output
from neuroslam.config import preset_names
from neuroslam.runs.inspect import inspect
from neuroslam.runs.reading import read_frames

WORLD = "world:corridor?width=64&height=40&frames_per_lap=60"
QUICK = "--no-tensorboard"


def contents(folder) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    out = tmp_path_factory.mktemp("finished") / "run"
    assert main(["run", WORLD, "-o", str(out), "--stop", "12"]) == 0
    return out


@pytest.fixture
def earlier(finished, tmp_path):
    """A copy of a finished run."""
    return shutil.copytree(finished, tmp_path / "earlier")


def video(path, frames, size=(64, 48)):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 20.0, size)
    for i in range(frames):
        coarse = np.random.default_rng(i // 4).integers(0, 255, (6, 8, 3), np.uint8)
        writer.write(cv2.resize(coarse, size, interpolation=cv2.INTER_NEAREST))
    writer.release()
    return path


def motion(path, rows):
    path.write_text("time_s,v_m_s,w_rad_s\n" + "\n".join(rows) + "\n")
    return path


def pictures(folder, sizes):
    folder.mkdir()
    for i, (height, width) in enumerate(sizes):
        coarse = np.random.default_rng(i // 4).integers(0, 255, (6, 8), np.uint8)
        image = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_NEAREST)
        cv2.imwrite(str(folder / f"{i}.png"), image)
    return folder


@pytest.fixture(scope="module")
def sources(tmp_path_factory):
    """A folder of sources that cannot be used."""
    folder = tmp_path_factory.mktemp("sources")
    whole = video(folder / "whole.avi", 20).read_bytes()
    (folder / "text.mp4").write_text("this is not a video")
    (folder / "empty.avi").write_bytes(b"")
    (folder / "head.avi").write_bytes(whole[:200])
    video(folder / "none.avi", 0)
    (folder / "nothing").mkdir()
    (folder / "notes.pdf").write_text("")
    motion(folder / "empty.csv", [])
    motion(folder / "nan.csv", ["0.0,nan,0.0", "0.1,1.0,0.0"])
    motion(folder / "short.csv", ["0.0,1.0"])
    pictures(folder / "good", [(40, 64)] * 3)
    return folder


@pytest.mark.parametrize(
    ("source", "cause"),
    [
        ("missing.avi", r"missing\.avi: no such file or folder; expected a video, "),
        ("text.mp4", r"text\.mp4: cannot be read"),
        ("empty.avi", r"empty\.avi: cannot be read"),
        ("head.avi", r"head\.avi: cannot be read; expected a complete video"),
        ("none.avi", r"none\.avi: "),
        ("nothing", r"nothing: contains no images"),
        ("notes.pdf", r"notes\.pdf: is of no known kind"),
        ("empty.csv", r"empty\.csv: "),
        ("nan.csv", r"nan\.csv: frame 0 \(line 2\): its motion is v = nan m/s"),
        ("short.csv", r"short\.csv: line 2 "),
        ("world:corridr", r"world 'corridr': no such world.*did you mean 'corridor'\?"),
        ("arena:cirle2m", r"no arena is named 'cirle2m'.*did you mean 'circle2m'\?"),
        (
            "http://example.com/x.mp4",
            r"http://example\.com/x\.mp4: .*: camera:http://example\.com/x",
        ),
        ("camera:foo", r"camera:foo: 'foo' is neither a number nor an address; expected camera:0"),
        ("world:corridor?lap=2", r"unknown option 'lap'.*did you mean 'laps'\?"),
        ("world:corridor?laps=-1", r"option laps='-1': input should be greater than 0"),
        ("world:corridor?laps", r"option 'laps' has no value"),
        ("world:corridor?route=7", r"route 7 does not exist; expected 1 to 1"),
    ],
)
def test_a_source_that_cannot_be_used_is_named_and_nothing_is_overwritten(
    source, cause, sources, earlier, tmp_path, mistake
):
    given = source if ":" in source else sources / source
    before = contents(earlier)
    said = mistake("run", given, "-o", earlier, "--overwrite")
    assert re.search(cause, said), said
    assert contents(earlier) == before
    mistake("run", given, "-o", tmp_path / "fresh")
    assert not (tmp_path / "fresh").exists()


@pytest.mark.parametrize(
    ("options", "cause"),
    [
        (["--preset", "irta"], r"unknown preset 'irta'.*did you mean 'irat'\?"),
        (["--config", "nowhere.toml"], r"config nowhere\.toml: no such file"),
        (["--set", "view.treshold=0.1"], r"unknown key 'view\.treshold'; did you mean 'view\.thr"),
        (["--set", "threshold=0.1"], r"unknown key 'threshold'; did you mean 'view\.threshold'"),
        (["--set", "views.threshold=0.1"], r"unknown key 'views'; did you mean 'view'\?"),
        (
            ["--set", "semantic.spaces.seed=1"],
            r"'semantic\.spaces'; did you mean 'semantic\.space'",
        ),
        (["--set", "view.threshold"], r"--set 'view\.threshold': expected section\.key=value"),
        (["--set", "view.threshold=high"], r"view\.threshold = 'high': .*valid number"),
        (["--set", "view.threshold=nan"], r"view\.threshold = nan: .*finite"),
        (["--set", "view=3"], r"view = 3: "),
        (["--set", "pose_cells.n_xy=2"], r"pose_cells\.n_xy = 2: .*greater than or equal to 7"),
        (["--set", "view.crop=[0,99,0,40]"], r"view\.crop = \[0, 99, 0, 40\].*64 ?x ?40 px"),
        (["--set", "view.crop=[30,10,0,40]"], r"crop"),
        (["--set", "odometry.use='visual'", "--set", "odometry.turn_region=[0,99,0,9]"], "turn_r"),
        (["--stop", "0"], r"0 <= start < stop"),
        (["--start", "-3"], r"0 <= start"),
        (["--start", "5000"], r"frames, none from --start 5000 on"),
    ],
)
def test_a_setting_that_cannot_be_used_is_named_and_nothing_is_overwritten(
    options, cause, earlier, tmp_path, mistake
):
    """A crop that does not fit shows with the first picture: even then nothing has been touched."""
    before = contents(earlier)
    said = mistake("run", WORLD, "-o", earlier, "--overwrite", *options)
    assert re.search(cause, said), said
    assert contents(earlier) == before
    mistake("run", WORLD, "-o", tmp_path / "fresh", *options)
    assert not (tmp_path / "fresh").exists()


@pytest.mark.parametrize(
    ("name", "text", "cause"),
    [
        ("a.toml", "[view]\nthreshhold = 0.1\n", r"a\.toml: unknown key 'view\.threshhold'; did"),
        ("b.toml", "view = [", r"b\.toml: not valid TOML"),
        ("c.ini", "[ratslam]\npc_dim_xx = 11\n", r"c\.ini: unknown key 'pc_dim_xx'.*'pc_dim_xy'"),
        ("d.toml", "\0\xff", r"d\.toml: "),
    ],
)
def test_a_config_file_that_cannot_be_used_is_named(name, text, cause, tmp_path, mistake):
    (tmp_path / name).write_bytes(text.encode("latin-1"))
    said = mistake("run", WORLD, "-o", tmp_path / "out", "--config", tmp_path / name)
    assert re.search(cause, said), said
    assert not (tmp_path / "out").exists()


LINES = [f"{i / 10!r},1.0,0.1" for i in range(8)]


@pytest.mark.parametrize(
    ("row", "cause", "left_out"),
    [
        ("0.5,nan,0.1", r"frame 5 \(line 7\): its motion is v = nan", 1),
        ("0.5,1.0,inf", r"frame 5 \(line 7\): its motion is v = 1\.0 m/s, w = inf", 1),
        ("0.2,1.0,0.1", r"frame 5: its time 0\.2 s is not after 0\.4 s", 1),
        ("nan,1.0,0.1", r"frame 5: its time is nan", 1),
        ("9.5,1.0,0.1", r"frame 5: 9\.1 s after frame 4; expected at most max_gap_s = 2", 3),
    ],
)
def test_a_bad_line_of_motion_stops_the_run_or_is_skipped(row, cause, left_out, tmp_path, call):
    """What was mapped before it is kept. After a jump in time, no frame is near the last one."""
    source = motion(tmp_path / "log.csv", [*LINES[:5], row, *LINES[6:]])
    stopped = call("run", source, "-o", tmp_path / "stop", QUICK)
    assert stopped.code == 2
    assert stopped.err.count("\n") == 1
    assert re.search(r"^neuroslam run: stopped early: .*" + cause, stopped.err), stopped.err
    assert read_frames(tmp_path / "stop")["frame"].tolist() == [0, 1, 2, 3, 4]
    again = call("resume", tmp_path / "stop", QUICK)
    assert (again.code, re.search(cause, again.err) is not None) == (2, True)

    skipped = call("run", source, "-o", tmp_path / "skip", QUICK, "--on-bad-frame", "skip")
    assert skipped.code == 0
    assert re.search(r"^neuroslam run: skipped: .*" + cause, skipped.err), skipped.err
    metrics = json.loads((tmp_path / "skip" / "metrics.json").read_text())
    assert (metrics["frames"], metrics["skipped_frames"]) == (8 - left_out, left_out)


def test_a_picture_of_another_size_stops_the_run_or_is_skipped(tmp_path, call):
    sizes = [(40, 64)] * 3 + [(40, 60)] + [(40, 64)] * 2
    source = pictures(tmp_path / "frames", sizes)
    stopped = call("run", source, "-o", tmp_path / "stop", QUICK)
    assert stopped.code == 2
    assert "frame 3 (3.png) is 60 x 40 px; expected 64 x 40 px" in stopped.err
    skipped = call("run", source, "-o", tmp_path / "skip", QUICK, "--on-bad-frame", "skip")
    assert skipped.code == 0
    assert read_frames(tmp_path / "skip")["frame"].tolist() == [0, 1, 2, 4, 5]


def test_a_truncated_video_is_mapped_as_far_as_it_goes(tmp_path, call):
    whole = video(tmp_path / "whole.avi", 20).read_bytes()
    (tmp_path / "cut.avi").write_bytes(whole[: len(whole) * 6 // 10])
    stopped = call("run", tmp_path / "cut.avi", "-o", tmp_path / "stop", QUICK)
    assert stopped.code == 2
    assert stopped.err.count("\n") == 1
    assert re.search(r"cut\.avi: frame \d+ is missing; .*file is complete", stopped.err), (
        stopped.err
    )
    frames = len(read_frames(tmp_path / "stop")["frame"])
    assert 5 < frames < 15
    skipped = call(
        "run", tmp_path / "cut.avi", "-o", tmp_path / "skip", QUICK, "--on-bad-frame", "skip"
    )
    assert skipped.code == 0
    assert len(read_frames(tmp_path / "skip")["frame"]) == frames


def test_no_decoder_adds_a_word_of_its_own(sources, tmp_path):
    """In a process of its own: FFmpeg is told once, when it is first used, how much to say."""
    (tmp_path / "cut.avi").write_bytes((sources / "whole.avi").read_bytes()[:-5000])
    given = [str(sources / "text.mp4"), str(sources / "head.avi"), str(tmp_path / "cut.avi")]
    program = (
        "import sys; from neuroslam.cli import main;"
        "codes = [main(['run', f, '-o', sys.argv[1], '--no-tensorboard']) for f in sys.argv[2:]];"
        "sys.exit(codes != [2, 2, 2])"
    )
    command = [sys.executable, "-c", program, tmp_path / "out", *given]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    said = done.stderr.splitlines()
    assert [file in line for file, line in zip(given, said, strict=True)] == [True] * 3


def test_a_source_whose_every_frame_is_bad_has_no_usable_frame(earlier, tmp_path, mistake):
    source = motion(tmp_path / "log.csv", ["0.0,nan,0.0", "0.1,0.0,nan"])
    before = contents(earlier)
    said = mistake("run", source, "-o", earlier, "--overwrite", "--on-bad-frame", "skip")
    assert "no usable frame; 2 were skipped, the first: " in said
    assert contents(earlier) == before


def test_an_empty_name_is_no_source(sources, tmp_path, monkeypatch, mistake):
    monkeypatch.chdir(sources / "good")
    assert "the name of the source is empty" in mistake("run", "", "-o", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("grey", [0, 128, 255])
def test_a_camera_that_shows_nothing_closes_no_loop(grey, tmp_path, call):
    """Two laps of a circle: the same picture everywhere must not be taken for the same place."""
    folder = tmp_path / "frames"
    folder.mkdir()
    rows = []
    for i in range(80):
        cv2.imwrite(str(folder / f"{i}.png"), np.full((40, 64), grey, np.uint8))
        rows.append(f"{i / 10!r},1.0,{np.pi / 2!r}")
    motion(folder / "odometry.csv", rows)
    done = call("run", folder, "-o", tmp_path / "run", QUICK)
    assert done.code == 0
    assert "No experiences: no image reaches the contrast view.min_contrast\n" in done.out
    again = call("resume", tmp_path / "run", QUICK)
    assert "No experiences: no image reaches the contrast" in again.out
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert (metrics["frames"], metrics["templates"], metrics["loop_closures"]) == (80, 0, 0)


def test_motion_without_images_gives_no_experiences(tmp_path, call):
    done = call("run", motion(tmp_path / "log.csv", LINES), "-o", tmp_path / "run", QUICK)
    assert (
        "No experiences: the source has no images. Without a camera, use --preset slrb\n"
        in done.out
    )


def test_pictures_outside_the_time_of_the_motion_are_told_once(tmp_path, call):
    """Of two seconds of video motion covers the second half second."""
    source = f"{video(tmp_path / 'drive.avi', 40)}+{tmp_path}/log.csv"
    motion(tmp_path / "log.csv", [f"{i / 20!r},1.0,0.1" for i in range(10, 21)])
    done = call("run", source, "-o", tmp_path / "run", QUICK, "--stop", 5)
    early = "motion begins at 0.5 s; 10 images before it were not used"
    late = "motion ends at 1 s; 19 images after it were not used"
    assert done.code == 0
    assert (early in done.out, late in done.out) == (True, False)
    done = call("resume", tmp_path / "run", QUICK)
    assert done.code == 0
    assert done.out.splitlines()[0].startswith("11 frames ")
    assert done.out.splitlines()[1:3] == [early, late]
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["unused"] == [early, late]


def test_a_run_is_not_overwritten_unasked(earlier, mistake):
    before = contents(earlier)
    said = mistake("run", WORLD, "-o", earlier)
    assert re.search(rf"{earlier}: holds a run already.*; resume it, choose another .*--over", said)
    assert contents(earlier) == before


@pytest.mark.parametrize("command", ["run", "demo"])
def test_a_folder_that_cannot_be_written_is_named(command, tmp_path, mistake):
    file = tmp_path / "file"
    file.write_text("precious")
    source = [WORLD] if command == "run" else []
    assert f"{file}: is a file; expected a folder" in mistake(command, *source, "-o", file)
    below = file / "below"
    assert f"{below}: cannot be written" in mistake(command, *source, "-o", below)
    assert file.read_text() == "precious"


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_without_permission_is_named(tmp_path, mistake):
    (tmp_path / "locked").mkdir(mode=0o500)
    assert "cannot be written (Permission denied)" in mistake(
        "run", WORLD, "-o", tmp_path / "locked" / "run"
    )


def test_a_file_of_the_run_that_cannot_be_written_costs_no_brain(earlier, mistake):
    (earlier / "frames.csv").unlink()
    (earlier / "frames.csv").mkdir()
    before = contents(earlier)
    assert "cannot be written" in mistake("run", WORLD, "-o", earlier, "--overwrite", QUICK)
    assert contents(earlier) == before


def truncated(path):
    path.write_bytes(path.read_bytes()[:-100])


def bit_flipped(path):
    content = bytearray(path.read_bytes())
    content[-50] ^= 1
    path.write_bytes(content)


def newer(path):
    (path.parent / "manifest.json").unlink(missing_ok=True)
    about = {"format": 99, "config": {}, "sha256": "0"}
    save_file(load_file(path), path, metadata={"neuroslam": json.dumps(about)})


def of_torch(path):
    torch.save({"a": torch.zeros(3)}, path)


def pickled(path):
    path.write_bytes(pickle.dumps({"a": 1}))


def missing(path):
    path.unlink()


@pytest.mark.parametrize(
    ("damage", "cause"),
    [
        (truncated, r"(truncated|damaged)"),
        (bit_flipped, r"does not match its SHA-256"),
        (newer, r"format 99, this neuroslam reads up to \d+; upgrade it"),
        (of_torch, r"a pickle"),
        (pickled, r"a pickle"),
        (missing, r"no such brain file"),
    ],
)
def test_a_brain_that_cannot_be_loaded_is_named_and_left_as_it_is(damage, cause, earlier, mistake):
    damage(earlier / "brain.safetensors")
    before = contents(earlier)
    for command in ("resume", "plot"):
        said = mistake(command, earlier)
        assert re.search(rf"brain\.safetensors: .*{cause}", said), said
        assert contents(earlier) == before


@pytest.mark.parametrize(
    ("name", "content", "cause"),
    [
        ("config.toml", None, r"config\.toml: missing; it holds the source of the run"),
        ("config.toml", b"[view]\n", r"config\.toml: has no valid \[run\] table"),
        ("config.toml", b"\xff\xfe", r"config\.toml: has no valid \[run\] table"),
        ("metrics.json", None, r"metrics\.json: missing; expected the folder of a run"),
        ("metrics.json", b"[]", r"metrics\.json: damaged"),
        ("frames.csv", None, r"frames\.csv: .*cannot resume"),
        ("frames.csv", b"frame\n0\n", r"frames\.csv: damaged, 0 whole rows; .* seen 12 frames"),
        ("trace.f64", None, r"trace\.f64: .*cannot resume"),
        ("trace.f64", b"12345", r"trace\.f64: 0 rows, the brain has seen 12 frames"),
    ],
)
def test_a_part_of_a_run_that_is_missing_or_damaged_is_named(
    name, content, cause, earlier, mistake
):
    (earlier / name).unlink()
    if content is not None:
        (earlier / name).write_bytes(content)
    before = contents(earlier)
    said = mistake("resume", earlier)
    assert re.search(cause, said), said
    assert contents(earlier) == before


def test_what_is_not_a_run_can_be_neither_resumed_nor_drawn_nor_evaluated(tmp_path, mistake):
    (tmp_path / "file").write_text("")
    for out in (tmp_path, tmp_path / "nowhere", tmp_path / "file"):
        for command in ("resume", "plot", "evaluate"):
            assert str(out) in mistake(command, out)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("cut", [-1, -9, -60])
def test_every_reader_reports_an_incomplete_row_alike(cut, earlier, mistake):
    rows = (earlier / "frames.csv").read_text()
    (earlier / "frames.csv").write_text(rows[:cut])
    told = f"{earlier}/frames.csv: damaged, 11 whole rows; the brain has seen 12 frames"
    for command in ("report", "verify", "plot"):
        assert mistake(command, earlier) == f"neuroslam {command}: {told}\n"
    assert mistake("resume", earlier) == f"neuroslam resume: {told}; cannot resume\n"


@pytest.mark.parametrize(
    ("file", "inside", "told"),
    [
        (
            "sweep.json",
            "1-a/frames.csv",
            "a sweep; expected one of its runs, which are folders in it, e.g. {}/1-a",
        ),
        ("fleet.json", "merged/frames.csv", "a fleet; its merged map is in {}/merged"),
        ("fleet.json", "sessions/1/frames.csv", "a fleet; its maps are in {}/sessions"),
        ("tune.json", "config.toml", "a tuning; use its config with --config {}/config.toml"),
    ],
)
def test_a_folder_of_many_runs_is_not_taken_for_a_run(file, inside, told, tmp_path, mistake):
    out = tmp_path / "out"
    (out / inside).parent.mkdir(parents=True)
    (out / inside).touch()
    (out / file).write_text("{}")
    for command in ("inspect", "verify", "report", "resume", "plot", "evaluate"):
        assert mistake(command, out) == f"neuroslam {command}: {out}: is {told.format(out)}\n"
    assert f"{out}: is {told.format(out)}" in mistake("merge", out, out, "-o", tmp_path / "both")


def test_the_source_of_a_run_that_has_gone_is_named(tmp_path, call, mistake):
    source = motion(tmp_path / "log.csv", LINES)
    assert call("run", source, "-o", tmp_path / "run", "--stop", 4, QUICK).code == 0
    source.unlink()
    before = contents(tmp_path / "run")
    assert f"{source}: no such file" in mistake("resume", tmp_path / "run")
    assert contents(tmp_path / "run") == before


def test_evaluate_says_how_many_frames_have_truth(finished, tmp_path, call):
    rows = (finished / "trajectory.tum").read_text().splitlines(keepends=True)
    (tmp_path / "half.tum").write_text("".join(rows[:6]))
    done = call("evaluate", finished, "--truth", tmp_path / "half.tum")
    assert (done.code, done.err) == (0, "")
    assert done.out.endswith("6 of 12 frames have truth; the errors are over those\n")
    assert "have truth" not in call("evaluate", finished).out


def test_evaluate_asks_for_a_truth_where_there_is_none(finished, tmp_path, call, mistake):
    source = motion(tmp_path / "log.csv", LINES)
    assert call("run", source, "-o", tmp_path / "run", QUICK).code == 0
    assert "give a TUM file or CSV with --truth FILE" in mistake("evaluate", tmp_path / "run")
    assert "nowhere.tum" in mistake("evaluate", tmp_path / "run", "--truth", "nowhere.tum")
    assert "--align rgid: expected one of " in mistake("evaluate", finished, "--align", "rgid")
    (tmp_path / "run" / "trace.f64").write_bytes(b"12345")
    assert "trace.f64: damaged" in mistake("evaluate", tmp_path / "run")
    (tmp_path / "words.tum").write_text("not a track\n")
    assert "words.tum" in mistake("evaluate", tmp_path / "words.tum", "--truth", source)


def test_a_folder_for_figures_that_cannot_be_made_is_named(finished, tmp_path, mistake):
    (tmp_path / "file").write_text("")
    assert f"{tmp_path / 'file'}: cannot be written" in mistake(
        "plot", finished, "--to", tmp_path / "file"
    )


def test_experiments_without_their_data_or_of_no_known_name_are_refused(tmp_path, mistake):
    given = ("-o", tmp_path / "out", "--data", tmp_path)
    said = mistake("experiment", "corridr-loops", *given)
    assert said.endswith("; did you mean 'corridor-loops'?\n")
    assert "nowhere" in mistake(
        "experiment", "corridor-loops", "-o", tmp_path / "out", "--data", tmp_path / "nowhere"
    )


def test_a_run_says_what_it_did_and_where(tmp_path, call):
    """Names with brackets are names, not colours; nothing is broken into lines."""
    out = tmp_path / ("a[bold]" + "long" * 30 + "[/x]")
    done = call("run", WORLD, "-o", out, "--stop", 6, QUICK)
    assert (done.code, done.err) == (0, "")
    first, error, written = done.out.splitlines()
    assert re.fullmatch(r"6 frames at \d+ frames/s: .* templates, .*, 0 loop closures", first)
    assert "ATE (rigid): map " in error
    assert written == f"Written: {out}; next: neuroslam report {out}"


def test_an_old_name_of_a_key_is_read_and_told_in_one_line(tmp_path, call):
    out = tmp_path / "run"
    done = call("run", WORLD, "-o", out, "--stop", 3, QUICK, "--set", "sessions.carried=ignore")
    assert done.code == 0
    assert done.err == (
        "neuroslam run: note: sessions: carried is called kidnapped now; the old name is read "
        "until the next release\n"
    )
    assert load_brain(out / "brain.safetensors").config.sessions.kidnapped == "ignore"
    again = call("resume", out, QUICK)
    assert (again.code, again.err) == (0, "")  # what was written has the new name


def test_a_count_of_one_is_singular(tmp_path, call):
    done = call("run", WORLD, "-o", tmp_path / "run", "--stop", 1, QUICK)
    assert re.match(
        r"1 frame at \d+ frames?/s: 1 template, 1 experience, 0 links, 0 loop closures", done.out
    )
    [told] = [value for name, value in inspect(tmp_path / "run") if name.startswith("session")]
    assert "1 frame from frame 0, 1 experience, began" in told


def test_evaluate_plot_and_presets_print_tables(finished, tmp_path, call):
    shown = call("evaluate", finished)
    assert (shown.code, "absolute (ATE)" in shown.out, "rad" in shown.out) == (0, True, True)
    drawn = call("plot", finished, "--to", tmp_path)
    assert drawn.out.splitlines() == [
        str(tmp_path / name) for name in ("map.png", "pose_cells.png", "signals.png")
    ]
    presets = call("presets")
    assert (presets.code, "irat" in presets.out) == (0, True)


def test_cells_of_a_table_are_never_truncated(monkeypatch, capsys):
    told = "".join(sorted(preset_names()))
    monkeypatch.setattr(output, "console", Console(width=30))
    assert main(["presets"]) == 0
    shown = capsys.readouterr().out
    assert "…" not in shown
    names = "".join(line.split("│")[1].strip() for line in shown.splitlines() if "│" in line)
    assert names == told
    assert "all at once." in " ".join(
        line.split("│")[2].strip() for line in shown.splitlines() if "│" in line
    )


def test_the_version_is_printed(call):
    assert call("--version").out == f"neuroslam {version('neuroslam')}\n"


COMMANDS = (
    "run", "resume", "merge", "demo", "evaluate", "plot", "inspect", "verify", "export", "presets",
    "experiment",
)  # fmt: skip


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help(command, call):
    done = call(command, "--help")
    assert (done.code, done.err) == (0, "")
    assert done.out.startswith(f"Usage: neuroslam {command} ")


def test_neuroslam_alone_lists_the_commands(call):
    done = call()
    assert done.code == 2
    listed = call("--help")
    assert listed.code == 0
    for command in COMMANDS:
        assert re.search(rf"^  {command} ", done.out + done.err, re.MULTILINE), command
        assert re.search(rf"^  {command} ", listed.out, re.MULTILINE), command


@pytest.mark.parametrize(
    ("arguments", "cause"),
    [
        (["rnu"], "No such command 'rnu'"),
        (["run", "world:corridor", "-o", "x", "--prest", "irat"], "No such option: --prest"),
        (["run", "world:corridor"], "Missing option '--out'"),
        (["run"], "Missing argument"),
        (["run", "world:corridor", "-o", "x", "--stop", "ten"], "Invalid value for '--stop'"),
        (["run", "world:corridor", "-o", "x", "--on-bad-frame", "ignore"], "'ignore'"),
        (["resume"], "Missing argument 'DIR'"),
    ],
)
def test_typing_errors_are_explained(arguments, cause, tmp_path, monkeypatch, call):
    monkeypatch.chdir(tmp_path)
    done = call(*arguments)
    assert (done.code, done.out) == (2, "")
    assert cause in done.err
    assert list(tmp_path.iterdir()) == []


def test_the_package_can_be_run_as_a_module():
    command = [sys.executable, "-m", "neuroslam", "inspect", "nowhere"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("neuroslam inspect: nowhere: no such brain file")


def test_help_comes_at_once_without_torch():
    program = (
        "import sys; from neuroslam.cli import main; code = main(['--help']);"
        "sys.exit(code or 3 * any(name in sys.modules for name in ('torch', 'cv2', 'numpy')))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (0, b"")
