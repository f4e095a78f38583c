"""`neuroslam merge`: two finished sessions become the folder of a run, or nothing is written."""

import csv
import errno
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from neuroslam import load_brain, run
from neuroslam.cli import main
from neuroslam.merging.report import MergeReport
from neuroslam.runs import plot
from neuroslam.runs.files import RUN_FILES, RunPlan
from neuroslam.runs.manifest import MANIFEST
from neuroslam.runs.reading import read_frames

WORLD = "world:ellipse?laps=2&width=128&height=32"
OTHER = "world:corridor?laps=1&width=128&height=32"
QUICK = "--no-tensorboard"


def contents(folder) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def rows(path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def sizes(brain):
    return brain.view.n, brain.map.n, brain.map.n_links


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two drives through the ellipse that overlap, one elsewhere, one with another threshold."""
    folder = tmp_path_factory.mktemp("runs")
    for name, *arguments in (
        ("a", WORLD, "--stop", "200"),
        ("b", WORLD, "--start", "100", "--stop", "300"),
        ("elsewhere", OTHER, "--stop", "120"),
        ("other", WORLD, "--start", "100", "--stop", "200", "--set", "view.threshold=0.04"),
    ):
        given = [*arguments, "--preset", "ratslam", "-o", str(folder / name), QUICK]
        assert main(["run", *given]) == 0
    return folder


@pytest.fixture(scope="module")
def merged(runs, tmp_path_factory):
    out = tmp_path_factory.mktemp("merged") / "out"
    assert main(["merge", str(runs / "a"), str(runs / "b"), "-o", str(out)]) == 0
    return out


@pytest.fixture
def drawn(monkeypatch):
    """Draw ``map.png`` of a run: its title, and the names in the legend of each panel."""

    def draw(out):
        figures = []
        monkeypatch.setattr(plot, "save", lambda figure, _path: figures.append(figure))
        plot.plot(out, out)
        legends = [axes.get_legend() for axes in figures[0].get_axes()]
        names = [[text.get_text() for text in legend.get_texts()] for legend in legends]
        return figures[0].get_suptitle(), *names

    return draw


# --- merged -------------------------------------------------------------------------------------


def test_two_overlapping_runs_merge_into_the_files_of_a_run(runs, tmp_path, call):
    before = contents(runs / "a"), contents(runs / "b")
    out = tmp_path / "deep" / "out"
    done = call("merge", runs / "a", runs / "b", "-o", out)
    assert (done.code, done.err) == (0, "")
    assert re.search(r"^merged: \d+ experiences are new$", done.out, re.MULTILINE)
    assert done.out.endswith(f"Written: {out}\n")
    assert {path.name for path in out.iterdir()} == {*RUN_FILES, MANIFEST}
    assert [path.name for path in out.parent.iterdir()] == ["out"]
    assert (contents(runs / "a"), contents(runs / "b")) == before


def test_the_map_of_a_merge_names_its_sessions_and_whose_odometry_is_beside_it(merged, drawn):
    title, odometry, names = drawn(merged)
    world = "rendered world ellip … width 128, height 32)"
    assert title == f"2 sessions on one map: {world}"
    first, second = f"{world} from frame 0", f"{world} from frame 100"
    assert odometry[0] == f"odometry of {second}"
    assert names[:2] == [first, second]


def test_a_run_alone_is_titled_by_its_source_and_its_frames(runs, drawn):
    title, odometry, names = drawn(runs / "a")
    assert title == "rendered world ellipse (laps 2, width 128, height 32): 200 frames"
    assert (odometry[0], names[0]) == ("odometry", "experiences, links")


def test_the_map_says_how_many_frames_are_on_maps_that_were_not_joined(runs):
    brain, plan = load_brain(runs / "a" / "brain.safetensors"), RunPlan("long/way/drive.mp4")
    on_map = np.arange(1000) < 28
    brain.store(load_brain(runs / "elsewhere" / "brain.safetensors"))
    assert plot._title(brain, plan, on_map, 1).splitlines() == [
        "way/drive.mp4: 1,000 frames",
        "972 of 1,000 frames are on maps that were not joined",
    ]
    all_here = plot._title(brain, plan, on_map[:28], 1)
    assert all_here == "way/drive.mp4: 28 frames\n1 stored map was not joined"


def test_all_files_of_a_merge_agree(runs, merged):
    brain, a, b = (load_brain(f / "brain.safetensors") for f in (merged, runs / "a", runs / "b"))
    metrics = json.loads((merged / "metrics.json").read_text())
    assert (metrics["templates"], metrics["experiences"], metrics["links"]) == sizes(brain)
    assert len(rows(merged / "experiences.csv")) == brain.map.n
    assert len(rows(merged / "links.csv")) == brain.map.n_links
    assert (metrics["merges"], metrics["refused_merges"], metrics["not_joined"]) == (1, [], [])
    (report,) = metrics["merge_reports"]
    assert report["merged"] is True
    for what, part in (("views", 0), ("experiences", 1), ("links", 2)):
        counted = report["counts"][what]
        assert counted == {
            "loaded": sizes(a)[part],
            "partial": sizes(b)[part],
            "merged": sizes(brain)[part],
        }
    assert report == brain.sessions.merges[-1]
    assert [s.id for s in brain.sessions.sessions] == [
        s.id for one in (a, b) for s in one.sessions.sessions
    ]
    assert (
        f"maps = {json.dumps([str((runs / 'a' / 'brain.safetensors').resolve())])}"
        in (merged / "config.toml").read_text()
    )


def test_the_frames_of_a_merge_are_those_of_the_second_session(runs, merged):
    assert (merged / "frames.csv").read_bytes() == (runs / "b" / "frames.csv").read_bytes()
    assert len(read_frames(merged)["frame"]) == 200
    track = (merged / "trajectory.tum").read_text().splitlines()
    assert sum(not line.startswith("#") for line in track) == 200


def test_two_merged_drives_have_the_places_of_one_long_drive(merged, tmp_path):
    given = ("--preset", "ratslam", "--stop", "300", "-o", str(tmp_path / "one"), QUICK)
    assert main(["run", WORLD, *given]) == 0
    one = load_brain(tmp_path / "one" / "brain.safetensors")
    brain = load_brain(merged / "brain.safetensors")
    assert abs(brain.map.n - one.map.n) <= 1  # where the second session began is a place too
    accuracy = json.loads((merged / "metrics.json").read_text())
    assert accuracy["ate_rmse_m"] <= 0.05


def test_verify_says_that_a_merge_is_sound(merged, call):
    done = call("verify", merged)
    assert (done.code, done.out, done.err) == (0, f"{merged}: sound\n", "")


def test_a_merged_session_goes_on(merged, tmp_path, call):
    out = shutil.copytree(merged, tmp_path / "out")
    done = call("resume", out, "--stop", "360", QUICK)
    assert (done.code, done.err) == (0, "")
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["frames"] == 260
    assert metrics["merges"] == 1
    assert len(read_frames(out)["frame"]) == 260
    assert call("verify", out).code == 0


def test_the_report_reads_the_same_after_the_file_was_read(merged, tmp_path, call, runs):
    said = call("merge", runs / "a", runs / "b", "-o", tmp_path / "out").out.splitlines()[:-1]
    (report,) = load_brain(tmp_path / "out" / "brain.safetensors").sessions.merges
    first, *rest = MergeReport(**report).lines()
    assert said == [first, *(f"  {line}" for line in rest)]


def test_brain_files_merge_too_without_frames(runs, tmp_path, call):
    files = [runs / name / "brain.safetensors" for name in ("a", "b")]
    out = tmp_path / "out"
    done = call("merge", *files, "-o", out)
    assert (done.code, done.err) == (0, "")
    assert len((out / "frames.csv").read_text().splitlines()) == 1
    assert call("verify", out).code == 0
    whole = call("merge", runs / "a", runs / "b", "-o", tmp_path / "whole")
    assert whole.code == 0
    assert (out / "brain.safetensors").read_bytes() == (
        tmp_path / "whole" / "brain.safetensors"
    ).read_bytes()


def test_commands_that_need_frames_refuse_a_merge_of_brain_files(runs, tmp_path, call, mistake):
    files = [runs / name / "brain.safetensors" for name in ("a", "b")]
    out = tmp_path / "out"
    assert call("merge", *files, "-o", out).code == 0
    for command in (("plot", out), ("evaluate", out), ("resume", out, QUICK)):
        assert "damaged" not in mistake(*command)
    assert call("inspect", out).code == 0
    assert call("export", out, tmp_path / "map.g2o").code == 0


def test_a_merge_can_be_merged_inspected_and_drawn(runs, merged, tmp_path, call):
    out = shutil.copytree(merged, tmp_path / "out")
    for command in ("inspect", "evaluate", "plot"):
        assert (call(command, out).code, command) == (0, command)
    for k, maps in enumerate([(runs / "b", out), (out, runs / "b")]):
        again = tmp_path / str(k)
        done = call("merge", *maps, "-o", again)
        assert (done.code, "no experience is new" in done.out) == (0, maps[0] == out)
        assert call("verify", again).code == 0
        found, expected = (load_brain(f / "brain.safetensors") for f in (again, merged))
        assert sizes(found) == sizes(expected)


def test_a_merge_is_the_same_every_time(runs, merged, tmp_path, call):
    assert call("merge", runs / "a", runs / "b", "-o", tmp_path / "out").code == 0
    assert contents(tmp_path / "out") == contents(merged)


def test_a_map_merged_with_itself_is_that_map(runs, tmp_path, call):
    done = call("merge", runs / "a", runs / "a", "-o", tmp_path / "out")
    assert done.code == 0
    assert "no experience is new" in done.out
    a, out = (load_brain(f / "brain.safetensors") for f in (runs / "a", tmp_path / "out"))
    assert sizes(out) == sizes(a)


# --- refused ------------------------------------------------------------------------------------


def test_maps_that_do_not_meet_are_refused_with_the_reason_and_nothing_is_written(
    runs, tmp_path, call
):
    done = call("merge", runs / "a", runs / "elsewhere", "-o", tmp_path / "out")
    assert (done.code, done.err) == (3, "")
    assert re.match(r"not merged: no view of one map matches one of the other.*\n", done.out)
    assert "Written" not in done.out
    assert list(tmp_path.iterdir()) == []


def test_a_refused_merge_leaves_an_earlier_run_as_it_was(runs, merged, tmp_path, call):
    out = shutil.copytree(merged, tmp_path / "out")
    before = contents(out)
    done = call("merge", runs / "a", runs / "elsewhere", "-o", out, "--overwrite")
    assert done.code == 3
    assert contents(out) == before


def test_a_merge_leaves_no_landmarks_of_an_earlier_run(runs, merged, tmp_path, call):
    out = shutil.copytree(merged, tmp_path / "out")
    (out / "landmarks.csv").write_text("name,x_m,y_m,seen,first_frame,experience\n")
    assert call("merge", runs / "a", runs / "b", "-o", out, "--overwrite").code == 0
    assert not (out / "landmarks.csv").exists()  # the merged map has no semantic cells
    assert {path.name for path in out.iterdir()} == {path.name for path in merged.iterdir()}
    assert (out / "brain.safetensors").is_file()


def test_maps_of_different_configs_are_refused_and_the_keys_named(runs, tmp_path, call):
    done = call("merge", runs / "a", runs / "other", "-o", tmp_path / "out")
    assert done.code == 3
    assert "view.threshold is 0.05 and 0.04" in done.out
    assert list(tmp_path.iterdir()) == []


def test_confirm_says_how_many_places_must_agree(runs, tmp_path, call):
    out = tmp_path / "out"
    refused = call("merge", runs / "a", runs / "b", "-o", out, "--confirm", "1000")
    assert refused.code == 3
    assert "expected 1000 (--confirm)" in refused.out
    assert not out.exists()
    assert call("merge", runs / "a", runs / "b", "-o", out, "--confirm", "20").code == 0
    assert load_brain(out / "brain.safetensors").config.sessions.confirm == 20
    wrong = call("merge", runs / "a", runs / "b", "-o", out, "--confirm", "0")
    assert (wrong.code, "--confirm" in wrong.err) == (2, True)


def test_parameters_of_matching_can_be_set_and_are_saved(runs, tmp_path, call):
    out = tmp_path / "out"
    maps = ("merge", runs / "a", runs / "b", "-o", out)
    refused = call("merge", runs / "a", runs / "elsewhere", "-o", out)
    assert "try a larger --set view.threshold" in refused.out
    done = call(*maps, "--set", "sessions.drift=0.4", "--set", "view.threshold=0.06")
    assert (done.code, done.err) == (0, "")
    config = load_brain(out / "brain.safetensors").config
    assert (config.sessions.drift, config.view.threshold) == (0.4, 0.06)
    assert call("verify", out).code == 0


def test_what_maps_are_made_of_cannot_be_set(runs, tmp_path, mistake):
    maps = ("merge", runs / "a", runs / "b", "-o", tmp_path / "out")
    said = mistake(*maps, "--set", "view.template_width=20")
    assert "a merge can change sessions.*, map.* and view.threshold" in said
    assert "did you mean 'sessions.drift'" in mistake(*maps, "--set", "sessions.drif=0.4")
    assert list(tmp_path.iterdir()) == []


# --- more than two ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def chain(runs, tmp_path_factory):
    """A drive that meets ``b`` and not ``a``."""
    folder = tmp_path_factory.mktemp("chain")
    given = ("--start", "230", "--stop", "380", "-o", str(folder / "c"), QUICK)
    assert main(["run", WORLD, "--preset", "ratslam", *given]) == 0
    return folder / "c"


def test_of_several_maps_every_pair_is_tried_and_the_best_comes_first(runs, chain, tmp_path, call):
    """The first of the maps does not meet the third; each of them meets the one between."""
    maps = [runs / "a", chain, runs / "b"]
    assert call("merge", maps[0], maps[1], "-o", tmp_path / "two").code == 3
    done = call("merge", *maps, "-o", tmp_path / "out")
    assert (done.code, done.err) == (0, "")
    assert done.out.count("merged: ") == 2
    agree = [int(n) for n in re.findall(r"(\d+) experiences agree", done.out)]
    assert agree == sorted(agree, reverse=True)
    brain = load_brain(tmp_path / "out" / "brain.safetensors")
    names = {load_brain(m / "brain.safetensors").sessions.now.name for m in maps}
    assert {session.name for session in brain.sessions.sessions} == names
    b = load_brain(runs / "b" / "brain.safetensors").sessions.now.name
    assert brain.sessions.now.name == b  # the last can be resumed
    assert call("verify", tmp_path / "out").code == 0
    assert len(read_frames(tmp_path / "out")["frame"]) == 200


def test_a_map_of_several_that_meets_no_other_refuses_them_all(runs, tmp_path, call):
    maps = runs / "a", runs / "elsewhere", runs / "b"
    done = call("merge", *maps, "-o", tmp_path / "out")
    assert (done.code, done.err) == (3, "")
    assert "not merged: no view of one map matches" in done.out
    assert list(tmp_path.iterdir()) == []
    assert "two or more" in call("merge", runs / "a", "-o", tmp_path / "out").err


# --- mistakes -----------------------------------------------------------------------------------


@pytest.mark.parametrize("overwrite", [[], ["--overwrite"]])
@pytest.mark.parametrize("which", ["a", "b"])
def test_a_map_cannot_be_overwritten_by_its_own_merge(which, overwrite, runs, mistake):
    before = contents(runs)
    said = mistake("merge", runs / "a", runs / "b", "-o", runs / which, *overwrite)
    assert str(runs / which) in said
    said = mistake(
        "merge", runs / "a" / "brain.safetensors", runs / "b" / "brain.safetensors",
        "-o", runs / "a" / ".." / which, *overwrite,
    )  # fmt: skip
    assert which in said
    assert contents(runs) == before


def test_a_folder_that_holds_a_run_is_kept_without_overwrite(runs, merged, tmp_path, mistake):
    out = shutil.copytree(merged, tmp_path / "out")
    before = contents(out)
    assert "--overwrite" in mistake("merge", runs / "b", runs / "a", "-o", out)
    assert contents(out) == before


def test_a_missing_or_damaged_map_is_one_line(runs, tmp_path, mistake):
    out = tmp_path / "out"
    assert "nowhere" in mistake("merge", tmp_path / "nowhere", runs / "b", "-o", out)
    assert "nowhere" in mistake("merge", runs / "a", tmp_path / "nowhere", "-o", out)
    (tmp_path / "empty").mkdir()
    assert "empty" in mistake("merge", runs / "a", tmp_path / "empty", "-o", out)
    whole = (runs / "a" / "brain.safetensors").read_bytes()
    for name, damaged in (
        ("short", whole[: len(whole) // 2]),
        ("altered", whole[:-9] + bytes([whole[-9] ^ 1]) + whole[-8:]),
        ("nothing", b""),
        ("text", b"no brain at all\n"),
    ):
        file = tmp_path / f"{name}.safetensors"
        file.write_bytes(damaged)
        assert f"{name}.safetensors" in mistake("merge", file, runs / "b", "-o", out)
        assert f"{name}.safetensors" in mistake("merge", runs / "a", file, "-o", out)
    assert not out.exists()


@pytest.mark.parametrize("lost", ["frames.csv", "trace.f64", "config.toml"])
def test_a_run_that_lost_a_file_is_one_line_and_nothing_is_written(lost, runs, tmp_path, mistake):
    b = shutil.copytree(runs / "b", tmp_path / "b")
    (b / lost).unlink()
    said = mistake("merge", runs / "a", b, "-o", tmp_path / "out")
    assert str(b if lost == "config.toml" else b / lost) in said
    assert [path.name for path in tmp_path.iterdir()] == ["b"]


def test_a_run_with_a_stored_map_of_another_config_is_one_line(runs, tmp_path, mistake):
    out = tmp_path / "out"
    given = ("--stop", "150", "-o", out, QUICK)
    said = mistake("run", WORLD, "--map", runs / "a", "--set", "view.threshold=0.04", *given)
    assert "view.threshold is 0.04 and 0.05" in said
    said = mistake("run", WORLD, "--map", runs / "a", "--map", runs / "other", *given)
    assert "view.threshold is 0.05 and 0.04" in said
    assert not out.exists()


# --- whatever goes wrong while writing ----------------------------------------------------------


def full(*_args, **_options):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize(
    "where", ["neuroslam.state.files.save_file", "os.fsync", "shutil.copyfile"]
)
def test_on_a_full_disk_the_folder_stays_as_it_was(
    where, runs, merged, tmp_path, monkeypatch, mistake
):
    old = shutil.copytree(merged, tmp_path / "old")
    before = contents(old)
    monkeypatch.setattr(where, full)
    said = mistake("merge", runs / "b", runs / "a", "-o", old, "--overwrite")
    assert "No space left on device" in said
    said = mistake("merge", runs / "b", runs / "a", "-o", tmp_path / "new")
    assert "No space left on device" in said
    assert contents(old) == before
    assert [path.name for path in tmp_path.iterdir()] == ["old"]


_KILLED = """
import os, signal, sys, time
import torch
torch.set_num_threads(1)
from neuroslam.brain import load_brain
from neuroslam.runs.files import brain_file
from neuroslam.runs.merge import merge_runs

a, b, out = sys.argv[1:]
merge_runs(a, b, out)
one = time.perf_counter()
merge_runs(b, a, out, overwrite=True)
one = time.perf_counter() - one
for k in range(20):
    child = os.fork()
    if child == 0:
        while True:
            merge_runs(a, b, out, overwrite=True)
            merge_runs(b, a, out, overwrite=True)
    time.sleep(one * (0.05 + 1.2 * k / 20))
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    brain = load_brain(brain_file(out))
    print(*(session.name for session in brain.sessions.sessions), flush=True)
"""


def test_a_merge_killed_at_any_moment_leaves_the_old_brain_or_the_new_one(runs, tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", _KILLED, *(str(p) for p in (runs / "a", runs / "b")),
         str(tmp_path / "out")],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    loaded = done.stdout.splitlines()
    a, b = (load_brain(runs / name / "brain.safetensors").sessions.now.name for name in ("a", "b"))
    assert len(loaded) == 20
    assert set(loaded) <= {f"{a} {b}", f"{b} {a}"}
    assert main(["merge", str(runs / "a"), str(runs / "b"), "-o", str(tmp_path / "out"),
                 "--overwrite"]) == 0  # fmt: skip
    assert main(["verify", str(tmp_path / "out")]) == 0


@pytest.fixture(scope="module")
def uncut(runs, tmp_path_factory):
    out = tmp_path_factory.mktemp("uncut") / "run"
    summary = run(WORLD, out, maps=[runs / "a"], start=100, stop=160, tensorboard=False)
    (report,) = summary.merges
    assert 100 < report["at_frame"] < 150
    return out, report["at_frame"]


@pytest.mark.parametrize("after_merge", [-3, -1, 0, 1, 20])
def test_ctrl_c_in_a_run_with_a_stored_map_keeps_a_brain_that_goes_on(
    after_merge, runs, uncut, tmp_path, call
):
    folder, at = uncut
    out = tmp_path / "out"

    def press(result):
        if result.frame == at + after_merge:
            signal.raise_signal(signal.SIGINT)

    summary = run(
        WORLD, out, maps=[runs / "a"], start=100, stop=160, tensorboard=False, on_step=press
    )
    assert summary.interrupted
    brain = load_brain(out / "brain.safetensors")
    assert brain.clock.frame == at + after_merge
    assert len(brain.stored) == (after_merge < 0)
    assert call("verify", out).code == 0
    assert call("resume", out, "--stop", "160", QUICK).code == 0
    one, other = (load_brain(Path(f) / "brain.safetensors").state_dict() for f in (out, folder))
    assert one.keys() == other.keys()
    assert all(torch.equal(one[name], other[name]) for name in one)
    for name in ("frames.csv", "experiences.csv", "links.csv", "trajectory.tum", "trace.f64"):
        assert (out / name).read_bytes() == (folder / name).read_bytes(), name
