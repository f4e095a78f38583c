"""A save of a folder is one commit, and one process writes a folder at a time."""

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from neuroslam.brain import load_brain, read_checkpoint, save_brain
from neuroslam.cli import main
from neuroslam.errors import CheckpointError, RunError
from neuroslam.runs import saves
from neuroslam.runs.files import RunPlan
from neuroslam.runs.manifest import MANIFEST, read_manifest
from neuroslam.runs.reading import read_metrics, read_plan, read_trace
from neuroslam.runs.run import resume, run
from neuroslam.runs.saves import COMMITTED, LOCK, STAGED, settle, writing
from neuroslam.state.files import save_checked, tensors_digest

CASES = Path(__file__).resolve().parents[2].parent / "shared" / "cases"
WORLD = "world:corridor?width=64&height=40&frames_per_lap=60&laps=300"
RING = "world:ellipse?laps=2&width=128&height=32"
QUICK = "--no-tensorboard"
needs_cases = pytest.mark.skipif(not CASES.is_dir(), reason="../shared/cases is not there")


def contents(out) -> dict[str, bytes]:
    return {str(p.relative_to(out)): p.read_bytes() for p in out.rglob("*") if p.is_file()}


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    for name, start, stop in (("a", 0, 200), ("b", 100, 300)):
        run(RING, folder / name, start=start, stop=stop, tensorboard=False)
    return folder


@pytest.fixture
def old(runs, tmp_path):
    return shutil.copytree(runs / "a", tmp_path / "old")


@pytest.fixture
def says(capfd):
    def call(*arguments) -> tuple[int, str]:
        capfd.readouterr()
        return main([str(argument) for argument in arguments]), capfd.readouterr().err

    return call


def forked(*arguments, before=lambda: None) -> int:
    """Begin a command in a forked process; return the number of the process."""
    child = os.fork()
    if child == 0:
        code = 1
        try:
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            before()
            code = main([str(argument) for argument in arguments])
        finally:
            os._exit(code)
    return child


def ended(child) -> int:
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def killed_at(move: int, out, *arguments) -> int:
    """Call a command, which is killed before its so-manyeth change of a name in ``out`` itself."""

    def watch():
        count = 0

        def hook(event, values):
            nonlocal count
            if event in ("os.rename", "os.remove", "os.mkdir", "os.rmdir"):
                count += str(Path(values[-3 if event == "os.rename" else 0]).parent) == str(out)
                if count == move:
                    os.kill(os.getpid(), signal.SIGKILL)

        sys.addaudithook(hook)

    return ended(forked(*arguments, before=watch))


@pytest.mark.parametrize(
    "command",
    ["run {ring} --stop 20 -o {old} --overwrite", "merge {runs}/a {runs}/b -o {old} --overwrite",
     "resume {old} --stop 205"],
    ids=["run", "merge", "resume"],
)  # fmt: skip
def test_a_kill_between_any_two_renames_leaves_the_old_run_or_the_new(
    command, runs, tmp_path, says, monkeypatch
):
    from neuroslam.runs import results

    monkeypatch.setattr(results, "draw_map", lambda *words: words[3].write_text("drawn"))
    words = command.format(ring=RING, runs=runs, old=tmp_path / "old").split()
    words += [QUICK] * (words[0] != "merge")
    before, seen, code, move = contents(runs / "a"), [], -signal.SIGKILL, 0
    while code == -signal.SIGKILL:
        out, move = shutil.copytree(runs / "a", tmp_path / "old"), move + 2 - (words[0] == "merge")
        code = killed_at(move, out, *words)
        assert code in (0, -signal.SIGKILL)
        verified, said = says("verify", out)
        if verified and words[0] == "resume":  # it has rows after the save
            assert said.endswith("the run was cut off: resume it\n")
            assert says(*words) == (0, "")
        assert says("verify", out) == (0, "")
        now = contents(out)
        assert before.keys() == now.keys()  # nothing else is left
        seen.append("old" if now == before else "new")
        assert seen[-1] == "old" or not any(
            now[name] == before[name] for name in ("brain.safetensors", "links.csv", MANIFEST)
        )
        shutil.rmtree(out)
    assert len(seen) > 5
    assert sorted(seen, reverse=True) == seen  # from one moment on, the new one
    assert {*seen} == {"old", "new"} or words[0] == "resume"


def test_an_earlier_run_stays_until_the_new_one_has_saved(old, says):
    before = contents(old)
    child = forked("run", WORLD, "-o", old, "--overwrite", QUICK)
    rows, late = old / STAGED / "frames.csv", time.monotonic() + 300
    while not (rows.exists() and rows.stat().st_size > 9000):
        assert time.monotonic() < late
        time.sleep(0.02)
    assert contents(old).items() >= before.items()  # readable while the new one is made
    assert says("verify", old) == (0, "")
    for again in (("run", WORLD, "-o", old, "--overwrite"), ("resume", old)):
        said = f"{old}: another process is writing there; wait for its end or choose another "
        assert says(*again) == (2, f"neuroslam {again[0]}: {said}folder\n")
    os.kill(child, signal.SIGKILL)
    assert ended(child) == -signal.SIGKILL
    assert (old / LOCK).exists()
    assert says("verify", old) == (0, "")
    assert contents(old) == before  # and nothing else


def test_events_go_on_where_the_first_save_puts_them(old):
    (old / "events").mkdir()
    (old / "events" / "events.out.tfevents.1").write_bytes(b"earlier")
    run(WORLD, old, stop=60, overwrite=True, save_every_s=0.05)
    from neuroslam.report.reading import read_curves

    assert not (old / "events" / "events.out.tfevents.1").exists()
    assert len(list((old / "events").iterdir())) >= 2  # before and after the first save
    (curve, *_) = read_curves(old, np.arange(60)).values()
    assert curve.rows[0] == 0
    assert curve.rows[-1] == 50


def test_an_overwriting_run_that_fails_keeps_the_old_one(old, says):
    (old / "events").write_text("no folder")
    before = contents(old)
    source = old.parent / "log.csv"
    source.write_text("v_m_s,w_rad_s\nx,0\n")
    assert says("run", source, "-o", old, "--overwrite", QUICK)[0] == 2
    assert contents(old) == before
    assert says("run", WORLD, "-o", old, "--overwrite", "--stop", 5)[0] == 0
    assert (old / "events").is_dir()


def test_a_save_during_a_run_lists_what_it_has_and_removes_what_it_has_not(old):
    def look(result):
        if result.frame == 210:
            time.sleep(0.06)
        if result.frame == 211:
            assert sorted(read_manifest(old)) == [
                "brain.safetensors", "config.toml", "frames.csv", "metrics.json", "trace.f64"
            ]  # fmt: skip
            assert not (old / "experiences.csv").exists()
            assert not (old / "map.png").exists()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        resume(old, stop=220, tensorboard=False, on_step=look, save_every_s=0.05)
    assert main(["verify", str(old)]) == 2
    assert main(["resume", str(old), "--stop", "220", QUICK]) == 0
    assert main(["verify", str(old)]) == 0


# --- locks --------------------------------------------------------------------------------------


def test_a_lock_is_held_by_one_and_leaves_nothing(tmp_path):
    out = tmp_path / "new"
    with writing(out), pytest.raises(RunError, match="another process is writing"), writing(out):
        pass
    assert not out.exists()  # nothing was written
    with writing(out) as folder:
        (folder.staged / "file").write_text("1")
        folder.commit()
    assert [path.name for path in out.iterdir()] == ["file"]


def test_a_lock_of_a_process_that_died_is_free(tmp_path):
    child = os.fork()
    if child == 0:
        with writing(tmp_path):
            os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(child, 0)
    assert (tmp_path / LOCK).exists()
    with writing(tmp_path):
        pass
    assert list(tmp_path.iterdir()) == []


def test_a_file_system_without_locks_is_written_all_the_same(tmp_path, monkeypatch):
    def none(*_arguments):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(saves.fcntl, "flock", none)
    with writing(tmp_path) as folder:
        (folder.staged / "file").write_text("1")
        folder.commit()
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@needs_cases
def test_of_two_runs_in_one_folder_one_is_refused(tmp_path):
    logs = [CASES / "two_runs_one_folder" / f"{name}.csv" for name in "ab"]
    words = ("-o", tmp_path / "both", QUICK, "--preset", "slrb")
    said = [tmp_path / name for name in "ab"]
    started = [
        forked("run", log, *words, before=lambda to=to: setattr(sys, "stderr", to.open("w", 1)))
        for log, to in zip(logs, said, strict=True)
    ]
    codes = [ended(child) for child in started]
    assert sorted(codes) == [0, 2]
    refusal = said[codes.index(2)].read_text()
    assert refusal.count("\n") == 1
    assert "another process is writing there" in refusal or "holds a run already" in refusal
    assert main(["verify", str(tmp_path / "both")]) == 0
    assert Path(read_plan(tmp_path / "both").source) == logs[codes.index(0)].resolve()


# --- what a killed process left -----------------------------------------------------------------


def test_a_committed_save_is_finished_and_another_one_removed(tmp_path):
    for name, text in (("one", "old"), ("two", "old"), ("gone", "old"), ("own", "mine")):
        (tmp_path / name).write_text(text)
    (tmp_path / COMMITTED).mkdir()
    (tmp_path / COMMITTED / "one").write_text("new")  # "two" has been moved up already
    (tmp_path / "two").write_text("new")
    (tmp_path / COMMITTED / ".removed").write_text('["gone"]')
    (tmp_path / STAGED).mkdir()
    (tmp_path / STAGED / "one").write_text("half")
    (tmp_path / ".one.abcd1234.tmp").write_text("half")
    settle(tmp_path)
    assert contents(tmp_path) == {"one": b"new", "two": b"new", "own": b"mine"}
    assert {path.name for path in tmp_path.iterdir()} == {"one", "two", "own"}


@pytest.mark.parametrize(
    "names", ['["../precious", "/tmp/precious", ".", "..", ""]', "{}", "[1]", "no JSON"]
)
def test_a_received_folder_removes_nothing_outside_it(names, tmp_path):
    (tmp_path / "precious").write_text("1")
    out = tmp_path / "out"
    (out / COMMITTED).mkdir(parents=True)
    (out / COMMITTED / ".removed").write_text(names)
    (out / COMMITTED / ".hidden").write_text("1")
    settle(out)
    assert contents(tmp_path) == {"precious": b"1"}
    assert list(out.iterdir()) == []
    (out / COMMITTED).symlink_to(tmp_path, target_is_directory=True)
    settle(out)
    assert contents(tmp_path) == {"precious": b"1"}
    assert list(out.iterdir()) == []


def test_a_reader_waits_for_a_save_in_progress_and_not_for_ever(tmp_path, monkeypatch):
    monkeypatch.setattr(saves, "_WAIT_S", 0.05)
    with writing(tmp_path):
        (tmp_path / COMMITTED).mkdir()
        with pytest.raises(RunError, match="another process is saving there"):
            settle(tmp_path)
        (tmp_path / COMMITTED).rmdir()
        settle(tmp_path)


# --- signals ------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_saves_the_run_as_ctrl_c_does(number, tmp_path, says):
    before = signal.getsignal(number)
    if before == signal.SIG_IGN:
        pytest.skip(f"{number.name} is ignored here, as under nohup")

    def press(result):
        if result.frame in (5, 6):  # a second one does not break the save
            signal.raise_signal(number)

    summary = run(WORLD, tmp_path, stop=20, tensorboard=False, on_step=press)
    assert (summary.interrupted, summary.frames) == (True, 6)
    assert says("verify", tmp_path) == (0, "")
    assert signal.getsignal(number) == before


def test_a_command_that_is_no_run_ends_at_sigterm_in_one_line(monkeypatch, runs, tmp_path, says):
    from neuroslam.runs import merge

    monkeypatch.setattr(merge, "find_match", lambda *_: signal.raise_signal(signal.SIGTERM))
    out = tmp_path / "out"
    assert says("merge", runs / "a", runs / "b", "-o", out) == (
        130, "neuroslam merge: interrupted\n"
    )  # fmt: skip
    assert not out.exists()


def test_a_signal_that_is_ignored_stays_so(tmp_path):
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does
    try:
        summary = run(
            WORLD, tmp_path, stop=8, tensorboard=False,
            on_step=lambda _: signal.raise_signal(signal.SIGHUP),
        )  # fmt: skip
    finally:
        signal.signal(signal.SIGHUP, before)
    assert not summary.interrupted


def test_the_runs_of_a_sweep_that_is_ended_are_saved(tmp_path):
    out = tmp_path / "out"
    words = [sys.executable, "-m", "neuroslam.cli", "sweep", WORLD, "--vary", "map.loops=1,2",
             "-o", out, "--jobs", "2"]  # fmt: skip
    with subprocess.Popen(words, stderr=subprocess.PIPE, text=True) as process:
        late = time.monotonic() + 300
        while sum(path.stat().st_size > 6000 for path in out.glob("*/frames.csv")) < 2:
            assert process.poll() is None
            assert time.monotonic() < late
            time.sleep(0.05)
        process.send_signal(signal.SIGTERM)
        assert process.communicate(timeout=300)[1] == "neuroslam sweep: interrupted\n"
    assert process.returncode == 130
    folders = sorted(path.parent for path in out.glob("*/frames.csv"))
    for folder in folders:
        assert main(["verify", str(folder)]) == 0
        assert read_metrics(folder)["interrupted"]
        assert len(read_trace(folder)["time_s"]) == read_metrics(folder)["frames"]


# --- digests and content ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "commands"),
    [("config.toml", ("resume", "plot", "report")), ("metrics.json", ("resume", "report")),
     ("frames.csv", ("resume", "plot", "report")), ("trace.f64", ("resume", "plot", "evaluate")),
     ("trajectory.tum", ("evaluate",)), ("experiences.csv", ())],
)  # fmt: skip
def test_a_changed_digit_is_noticed_by_whoever_reads_the_file(name, commands, old, says):
    content = bytearray((old / name).read_bytes())
    at = next(
        i
        for i in range(len(content) - 40, 0, -1)
        if name == "trace.f64" or chr(content[i]).isdigit()
    )
    content[at] ^= 1
    (old / name).write_bytes(content)
    for command in (*commands, "verify"):
        code, said = says(command, old)
        assert (code, said.count("\n")) == (2, 1), command
        assert f"{old / name}: " in said, command


def test_the_error_says_how_to_accept_what_was_changed_on_purpose(old, says):
    config = old / "config.toml"
    config.write_text(config.read_text() + "# mine\n")
    code, said = says("resume", old, "--stop", 203, QUICK)
    assert (code, said.endswith(f"if you changed it yourself, remove {MANIFEST}\n")) == (2, True)
    (old / MANIFEST).unlink()
    assert says("resume", old, "--stop", 203, QUICK) == (0, "")
    assert says("verify", old) == (0, "")


def test_the_brain_of_another_save_is_refused(old, runs, says):
    shutil.copy(runs / "b" / "brain.safetensors", old)
    for command in ("inspect", "verify", "resume", "plot"):
        code, said = says(command, old)
        assert code == 2
        assert f"{old}/brain.safetensors: differs from what was saved" in said


@pytest.mark.parametrize("change", ["flip", "cut", "newer", "list"])
def test_a_damaged_manifest_is_one_line(change, old, says):
    path = old / MANIFEST
    text = path.read_text()
    content = {
        "flip": text.replace('"bytes": ', '"bytfs": ', 1), "cut": text[:-1], "list": "[]",
        "newer": text.replace('"format": 1', '"format": 7'),
    }  # fmt: skip
    path.write_text(content[change])
    for command in ("inspect", "verify", "resume"):
        code, said = says(command, old)
        assert (code, said.count("\n"), f"{path}: damaged" in said) == (2, 1, True), command


def test_no_bit_of_the_config_in_a_brain_may_flip(old):
    file = old / "brain.safetensors"
    content = file.read_bytes()
    begin = content.index(b'\\"config\\"')
    for at in np.random.default_rng(1).integers(begin, begin + 2000, 40).tolist():
        flipped = bytearray(content)
        flipped[at] ^= 1
        file.write_bytes(flipped)
        with pytest.raises(CheckpointError):
            load_brain(file)


@needs_cases
@pytest.mark.parametrize(
    ("case", "said"),
    [("brain-config-bitflip-accepted/cf.safetensors", "has no config"),
     ("traceback_brain_header_edit/b.safetensors", "not one that neuroslam wrote")],
)  # fmt: skip
def test_a_brain_with_a_damaged_header_is_one_line(case, said, says):
    for command in ("verify", "inspect"):
        code, error = says(command, CASES / "hostile" / case)
        assert (code, error.count("\n"), said in error) == (2, 1, True)


def test_a_brain_of_the_format_before_is_read(old, tmp_path):
    config, tensors = read_checkpoint(old / "brain.safetensors")
    from safetensors.torch import save_file

    about = {"format": 4, "config": config.model_dump(mode="json")}
    text = json.dumps(about | {"sha256": tensors_digest(tensors)})
    save_file(tensors, tmp_path / "four.safetensors", metadata={"neuroslam": text})
    assert load_brain(tmp_path / "four.safetensors").config == config


CRAFTED = {
    "map.state.current": 10**6,
    "map.links_table.source": -1,
    "map.links_table.target": 10**6,
    "map.experiences.template": 10**6,
    "map.experiences.pose": float("nan"),
    "pose_cells.window": 10**9,
}


@pytest.mark.parametrize("name", CRAFTED)
def test_a_crafted_brain_is_refused_by_every_command(name, old, tmp_path, says):
    """Its digest is right: whoever made it signed it."""
    config, tensors = read_checkpoint(old / "brain.safetensors")
    value = tensors[name].clone()
    value.view(-1)[0] = CRAFTED[name]
    file = tmp_path / "crafted.safetensors"
    about = {"format": 5, "config": config.model_dump(mode="json")}
    save_checked(file, about, tensors | {name: value})
    out = tmp_path / "out"
    for words in (
        ("verify", file),
        ("inspect", file),
        ("export", file, tmp_path / "x.g2o"),
        ("merge", old, file, "-o", out),
        ("run", RING, "--map", file, "-o", out),
    ):
        code, said = says(*words)
        assert code == 2, words
        assert name.rpartition(".")[2].split("_")[0] in said or "experience" in said, said
    assert not out.exists()
    shutil.copy(file, old / "brain.safetensors")
    (old / MANIFEST).unlink()
    for command in ("resume", "report", "plot"):
        assert says(command, old)[0] == 2


@pytest.mark.parametrize(
    "log",
    ["[]", '{"sessions": [{}]}', '{"sessions": 3}', '{"sessions": [], "merges": [1]}',
     '{"sessions": [], "merges": [{"merged": true, "reason": "x", "match": {"a": 1}}]}',
     "[" * 50_000],
)  # fmt: skip
def test_a_crafted_log_of_sessions_is_refused(log, old, tmp_path, says):
    import torch

    config, tensors = read_checkpoint(old / "brain.safetensors")
    tensors["sessions.text"] = torch.frombuffer(bytearray(log.encode()), dtype=torch.uint8)
    file = tmp_path / "crafted.safetensors"
    save_checked(file, {"format": 5, "config": config.model_dump(mode="json")}, tensors)
    for command in ("verify", "inspect"):
        code, said = says(command, file)
        assert (code, "sessions.text: not a log of sessions" in said) == (2, True)


@pytest.mark.parametrize(
    "row", ['start = "1"', "source = 3", "speed = 1", 'on_bad_frame = "maybe"', "stop = 1.5"]
)
def test_a_crafted_plan_is_one_line(row, old, says):
    key = row.split()[0]
    lines = (old / "config.toml").read_text().splitlines()
    lines = [line for line in lines if not line.startswith(f"{key} ")] + [row]
    (old / "config.toml").write_text("\n".join(lines))
    code, said = says("resume", old)
    assert (code, said.count("\n"), "no valid [run] table" in said) == (2, 1, True)


@pytest.mark.parametrize("change", [{"merge_reports": 7}, {"seconds": "x"}, {"skipped": None}])
def test_crafted_figures_are_one_line(change, old, says):
    path = old / "metrics.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    for command in ("resume", "report"):
        code, said = says(command, old)
        assert (code, said.count("\n"), f"{path}: damaged" in said) == (2, 1, True)


def test_a_full_disk_while_the_brain_is_written_is_one_line(old, monkeypatch, says):
    from safetensors import SafetensorError

    def full(*_arguments, **_options):
        raise SafetensorError("I/O error: No space left on device (os error 28)")

    before = contents(old)
    monkeypatch.setattr("neuroslam.state.files.save_file", full)
    assert says("run", WORLD, "-o", old, "--overwrite", "--stop", 5, QUICK) == (
        2, f"neuroslam run: {old}: cannot be written (No space left on device)\n",
    )  # fmt: skip
    assert contents(old) == before
    with pytest.raises(OSError, match="No space left"):
        save_brain(load_brain(old / "brain.safetensors"), old / "b.safetensors")


def test_a_plan_written_is_read_again(tmp_path):
    plan = RunPlan("a b", 3, 9, "skip", ("m",), "t.tum", "camera")
    (tmp_path / "config.toml").write_text(plan.to_toml())
    assert read_plan(tmp_path) == plan
