"""A run's folder: what a new run may destroy there, and what a killed one leaves behind."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from neuroslam.cli import main
from neuroslam.runs.files import RUN_FILES
from neuroslam.runs.reading import read_frames, read_trace
from neuroslam.runs.recording import TensorBoardRecorder
from neuroslam.runs.run import run

WORLD = "world:corridor?width=64&height=40&frames_per_lap=60&laps=300"
QUICK = "--no-tensorboard"


def contents(folder) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.fixture
def says(capfd):
    """Call the command line: its exit code, what it printed, what it complained of."""

    def call(*arguments) -> tuple[int, str, str]:
        capfd.readouterr()
        code = main([str(argument) for argument in arguments])
        return code, *capfd.readouterr()

    return call


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    out = tmp_path_factory.mktemp("stopped") / "run"
    run(WORLD, out, stop=30, tensorboard=False)
    return out


@pytest.fixture
def copy(stopped, tmp_path):
    return shutil.copytree(stopped, tmp_path / "run")


def log(path, rows, columns="v_m_s,w_rad_s"):
    path.write_text("\n".join([columns, *rows]) + "\n")
    return path


def test_a_run_never_writes_over_its_own_source(copy, tmp_path, says):
    """A second map.png among the pictures would be one of them when the run is resumed."""
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    shutil.copy(copy / "map.png", pictures / "0.png")
    before = contents(tmp_path)
    for source, out in ((copy / "frames.csv", copy), (pictures, pictures)):
        code, _, err = says("run", source, "-o", out, "--overwrite")
        assert code == 2
        assert err == (
            f"neuroslam run: {out}: a run here would overwrite its source; choose another folder\n"
        )
        assert contents(tmp_path) == before


def test_the_frames_of_a_run_are_a_motion_log(stopped, tmp_path, says):
    code, _, err = says("run", stopped / "frames.csv", "-o", tmp_path / "again", QUICK)
    assert (code, err) == (0, "")
    old, new = read_frames(stopped), read_frames(tmp_path / "again")
    np.testing.assert_array_equal(new["v_m_s"], old["v_m_s"])
    np.testing.assert_array_equal(new["time_s"], old["time_s"])


@pytest.mark.parametrize("name", RUN_FILES)
def test_any_file_of_a_run_is_enough_to_ask_before_overwriting(name, tmp_path, says):
    (tmp_path / name).write_text("precious")
    code, _, err = says("run", WORLD, "-o", tmp_path, "--stop", 2, QUICK)
    assert (code, "--overwrite" in err) == (2, True)
    assert contents(tmp_path) == {str(tmp_path / name): b"precious"}
    assert says("run", WORLD, "-o", tmp_path, "--stop", 2, QUICK, "--overwrite")[0] == 0


def test_the_demo_replaces_no_run_but_a_demo(copy, says):
    before = contents(copy)
    code, _, err = says("demo", "-o", copy)
    assert code == 2
    assert err == f"neuroslam demo: {copy}: holds a run of another source; choose another folder\n"
    assert contents(copy) == before


def test_an_interrupted_demo_prints_no_figures(tmp_path, says, monkeypatch):
    out, step = tmp_path / "demo", TensorBoardRecorder.step

    def press(recorder, result, *rest):
        if result.frame == 5:
            signal.raise_signal(signal.SIGINT)
        step(recorder, result, *rest)

    monkeypatch.setattr(TensorBoardRecorder, "step", press)
    assert says("demo", "-o", out) == (130, "", "neuroslam demo: interrupted\n")
    assert not list(out.glob("*.png"))
    assert len(read_frames(out / "first")["frame"]) == 6


def test_resuming_a_finished_run_says_that_there_is_nothing_to_do(copy, says):
    code, out, _ = says("resume", copy, "--stop", 30, QUICK)
    assert (code, out.splitlines()[0]) == (
        0, "Nothing to do: the run has reached its end",
    )  # fmt: skip
    assert "Nothing" not in says("resume", copy, "--stop", 31, QUICK)[1]


def test_a_lost_config_does_not_cost_the_map(copy, says):
    (copy / "config.toml").unlink()
    code, _, err = says("resume", copy)
    assert (code, "overwrite" in err) == (2, False)
    assert err == (
        f"neuroslam resume: {copy}/config.toml: missing; it holds the source of the run. Restore "
        f"it, or use {copy}/brain.safetensors alone\n"
    )


def test_a_full_disk_is_one_line(tmp_path):
    """No file may grow beyond 40 kB: TensorBoard's thread is the first to find out."""
    small = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (40_000, 40_000));"
    command = f"run {WORLD} --stop 400 -o {tmp_path / 'run'}".split()
    program = f"{small} import sys; from neuroslam.cli import main; sys.exit(main({command}))"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert done.stderr == (
        f"neuroslam run: {tmp_path / 'run'}: cannot be written (File too large)\n"
    )


def test_a_run_is_not_resumed_backwards(copy, says):
    before = contents(copy)
    code, _, err = says("resume", copy, "--stop", 29)
    assert code == 2
    assert (
        err
        == f"neuroslam resume: {copy}: is at frame 30; expected --stop of at least that, got 29\n"
    )
    assert contents(copy) == before
    assert says("resume", copy, "--stop", 30, QUICK)[0] == 0


def killed(out, command, rows):
    """Run a command in a process of its own and kill it when it has written so many rows."""
    arguments = [sys.executable, "-m", "neuroslam.cli", *command, QUICK]
    with subprocess.Popen(arguments, stdout=subprocess.DEVNULL) as process:
        grown = rows * 150  # bytes: a row has about 200
        while process.poll() is None:
            if (out / "frames.csv").is_file() and (out / "frames.csv").stat().st_size > grown:
                process.kill()
            time.sleep(0.01)
    assert process.returncode == -signal.SIGKILL


def test_a_killed_run_is_drawn_and_evaluated_as_it_was_saved_and_goes_on(copy, tmp_path, says):
    saved = {command: says(command, copy)[1] for command in ("plot", "evaluate")}
    figures = [(copy / name).read_bytes() for name in ("map.png", "signals.png")]
    killed(copy, ["resume", copy], rows=100)
    assert (copy / "frames.csv").stat().st_size > 100 * 150
    for command, before in saved.items():
        assert says(command, copy) == (0, before, "")
    assert [(copy / name).read_bytes() for name in ("map.png", "signals.png")] == figures
    assert says("resume", copy, "--stop", 90, QUICK)[0] == 0
    run(WORLD, tmp_path / "uncut", stop=90, tensorboard=False)
    for name in set(RUN_FILES) - {"metrics.json", "config.toml"}:
        assert (copy / name).read_bytes() == (tmp_path / "uncut" / name).read_bytes(), name


def test_a_run_that_saves_while_it_drives_and_is_killed_goes_on_to_the_same_files(tmp_path, says):
    out = tmp_path / "run"
    (tmp_path / "plain.toml").write_text("")
    plain = ("--config", tmp_path / "plain.toml")
    killed(out, ["run", WORLD, "-o", out, "--save-every", "0.05", *plain], rows=200)
    told = json.loads((out / "metrics.json").read_text())
    assert told["interrupted"]
    assert told["frames"] > 0
    assert told["seconds"] > 0.0  # it is resumed with the time that it took so far
    assert (out / "brain.safetensors").is_file()
    stop = 30 + len(read_trace(out)["time_s"])
    for command in ("plot", "inspect", "report"):  # what was saved can be looked at
        assert says(command, out)[0] == 0
    (out / ".brain.safetensors.abcd1234.tmp").write_bytes(b"half")  # killed while it saved
    said = f"{out}: the run was cut off; continue it with: neuroslam resume {out}\n"
    for command in (("evaluate", out), ("export", out, tmp_path / "a.tum")):
        assert says(*command) == (2, "", f"neuroslam {command[0]}: {said}")
    assert says("resume", out, "--stop", stop, QUICK, "--save-every", "0")[0] == 0
    run(WORLD, tmp_path / "uncut", stop=stop, tensorboard=False, save_every_s=0.0)
    for name in set(RUN_FILES) - {"metrics.json", "config.toml"}:
        assert (out / name).read_bytes() == (tmp_path / "uncut" / name).read_bytes(), name
    assert not json.loads((out / "metrics.json").read_text())["interrupted"]
    assert not list(out.glob(".*"))


def test_a_run_that_was_killed_in_its_first_save_says_so(copy, says):
    for name in RUN_FILES[4:]:
        (copy / name).unlink()
    said = f"{copy}: the run was cut off before its first save; run again with --overwrite\n"
    assert says("resume", copy) == (2, "", f"neuroslam resume: {said}")


def test_a_run_that_was_killed_before_it_saved_says_so(tmp_path, says):
    out = tmp_path / "run"
    killed(out, ["run", WORLD, "-o", out], rows=50)
    for command in ("resume", "plot"):
        code, _, err = says(command, out)
        assert code == 2
        assert err == (
            f"neuroslam {command}: {out}: the run was cut off before its first save; "
            "run again with --overwrite\n"
        )
    assert says("run", WORLD, "-o", out, "--stop", 2, QUICK, "--overwrite")[0] == 0


def test_a_kill_between_any_two_files_of_the_end_leaves_a_run_that_goes_on(
    copy, tmp_path, says, monkeypatch
):
    """Every file of the end is written whole; here the process dies before one of them."""
    uncut = tmp_path / "uncut"
    run(WORLD, uncut, stop=40, tensorboard=False)
    from neuroslam.runs import results

    for name in ("save_brain", "experiences_csv", "write_tum", "draw_map"):
        out = shutil.copytree(copy, tmp_path / name)

        def die(*_arguments):
            raise KeyboardInterrupt

        with monkeypatch.context() as patch:
            patch.setattr(results, name, die)
            assert says("resume", out, "--stop", 40, QUICK)[0] == 130
        assert says("resume", out, "--stop", 40, QUICK)[0] == 0
        for file in set(RUN_FILES) - {"metrics.json", "config.toml"}:
            assert (out / file).read_bytes() == (uncut / file).read_bytes(), (name, file)
        assert json.loads((out / "metrics.json").read_text())["frames"] == 40


def test_a_robot_that_stands_still_is_mapped_and_drawn_without_a_word(tmp_path, says):
    """Its error has no meaning: nothing tells how to lay one point over another."""
    rows = ["0.0,0.0,1.0,2.0,0.5"] * 5
    source = log(tmp_path / "still.csv", rows, "v_m_s,w_rad_s,x_m,y_m,theta_rad")
    out = tmp_path / "run"
    for arguments in (("run", source, "-o", out, QUICK), ("plot", out)):
        code, _, err = says(*arguments)
        assert (code, err) == (0, "")
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["frames"] == 5
    assert "ate_rmse_m" not in metrics


def test_a_single_frame_and_a_truth_of_another_time_cannot_be_compared(copy, tmp_path, says):
    out = tmp_path / "one"
    assert says("run", WORLD, "-o", out, "--stop", 1, QUICK)[0] == 0
    assert len(read_trace(out)["time_s"]) == 1
    code, _, err = says("evaluate", out)
    assert (code, err.count("\n")) == (2, 1)
    assert f"{out}: a true pose within 0.02 s for 1 of 1 frame; expected at least 2 frames\n" in err
    (tmp_path / "far.tum").write_text("9000 0 0 0 0 0 0 1\n9001 1 0 0 0 0 0 1\n")
    code, _, err = says("evaluate", copy, "--truth", tmp_path / "far.tum")
    assert (code, "0.02 s for 0 of 30 frames; expected at least 2 frames; is " in err) == (2, True)


def test_a_speed_beyond_any_robots_is_a_bad_line(tmp_path, says):
    source = log(tmp_path / "log.csv", ["1.0,0.0", "1e308,1e300", "1.0,0.0", "1e6,-1e6"])
    code, _, err = says("run", source, "-o", tmp_path / "run", QUICK)
    assert code == 2
    assert "log.csv: frame 1 (line 3): its motion is v = 1e+308 m/s" in err
    assert says("run", source, "-o", tmp_path / "skip", QUICK, "--on-bad-frame", "skip")[0] == 0
    assert read_frames(tmp_path / "skip")["frame"].tolist() == [0, 2, 3]


@pytest.mark.skipif(sys.platform == "darwin", reason="there, all names are UTF-8")
def test_a_name_that_cannot_be_written_into_config_toml_is_refused(tmp_path, says):
    source = log(tmp_path / os.fsdecode(b"\xff.csv"), ["1.0,0.0"])
    code, _, err = says("run", source, "-o", tmp_path / "run")
    assert (code, err.count("\n"), "its name is not UTF-8" in err) == (2, 1, True)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("options", "end"), [({"stop": 3}, 3), ({"start": 99, "stop": 5000}, 101)], ids=["stop", "end"]
)
def test_the_frame_to_stop_before_is_announced(options, end, tmp_path):
    seen = []
    world = WORLD.replace("laps=300", f"laps={100 / 60}")
    run(
        world,
        tmp_path,
        tensorboard=False,
        on_start=seen.append,
        on_step=lambda result: seen.append(result.frame),
        **options,
    )
    assert seen == [end, *range(options.get("start", 0), end)]
