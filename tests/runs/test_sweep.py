"""`neuroslam sweep`: all with all, the same figures however many run at once, and one table."""

import contextlib
import csv
import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
import tomllib
from itertools import pairwise
from pathlib import Path

import pytest

from neuroslam import load_brain
from neuroslam.errors import ConfigError, NeuroslamError, RunError, SourceError, WriteError
from neuroslam.figures.sweep import plot_sweep
from neuroslam.runs.files import RUN_FILES, TIMINGS
from neuroslam.runs.manifest import MANIFEST
from neuroslam.runs.sweep import parse_values, plan_sweep, sweep, varied
from neuroslam.sensors.open import seeded_spec
from neuroslam.state.files import tensors_digest

WORLD = "world:ellipse?laps=1&width=64&height=32&noise=0.05"
VARY = ["view.threshold=0.03,0.06"]
STOP = 60
ARGUMENTS = ["sweep", WORLD, "--vary", VARY[0], "--seeds", "2", "--stop", str(STOP)]


def all_but_timings(folder: Path) -> dict[str, object]:
    """Every file of a sweep: its bytes, or its figures without those that no two runs share."""
    found: dict[str, object] = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if path.is_dir():
            continue
        if path.name == "metrics.json":
            figures = json.loads(path.read_text())
            found[name] = {key: v for key, v in figures.items() if key not in TIMINGS}
        elif path.name == MANIFEST:
            files = json.loads(path.read_text())["files"]
            found[name] = {key: v for key, v in files.items() if key != "metrics.json"}
        elif path.name == "sweep.json":
            runs = json.loads(path.read_text())["runs"]
            found[name] = [{k: v for k, v in row.items() if k not in TIMINGS} for row in runs]
        elif path.name == "sweep.csv":
            with path.open(newline="") as file:
                rows = list(csv.DictReader(file))
            found[name] = [{k: v for k, v in row.items() if k not in TIMINGS} for row in rows]
        else:
            found[name] = path.read_bytes()
    return found


def digests(folder: Path) -> dict[str, str]:
    files = sorted(folder.glob("*/brain.safetensors"))
    return {file.parent.name: tensors_digest(load_brain(file).state_dict()) for file in files}


@pytest.fixture(scope="module")
def serial(tmp_path_factory):
    out = tmp_path_factory.mktemp("serial") / "sweep"
    return out, sweep([WORLD], out, vary=VARY, seeds=2, stop=STOP)


# --- what is run --------------------------------------------------------------------------------


def test_every_combination_of_source_value_and_seed_occurs_once():
    plan = plan_sweep(
        ["world:town", "world:campus"], ["map.loops=5,20", "cells=pose,pose+place"], seeds=3
    )
    assert len(plan) == len({trial.name for trial in plan}) == 2 * 2 * 2 * 3
    assert len({json.dumps(trial.varied) for trial in plan}) == len(plan)
    assert [trial.name.partition("-")[0] for trial in plan[::23]] == ["01", "24"]
    for trial in plan:
        assert trial.config.map.loops == trial.varied["map.loops"]
        assert "+".join(trial.config.cells) == trial.varied["cells"]
        assert trial.source.endswith(f"?seed={trial.varied['seed']}")


def test_a_seed_is_of_the_noise_and_of_random_weights_but_not_of_what_is_varied():
    plan = plan_sweep(["drive.avi"], ["semantic.seed=8,9"], 2, assignments=["cells=place+semantic"])
    seeds = [
        (t.config.grid_cells.seed, t.config.semantic.space.seed, t.config.semantic.seed)
        for t in plan
    ]
    assert seeds == [(0, 0, 8), (1, 1, 8), (0, 0, 9), (1, 1, 9)]
    assert {Path(trial.source).name for trial in plan} == {"drive.avi"}
    assert seeded_spec("world:town", 3) == "world:town?seed=3"
    assert seeded_spec("arena:square?minutes=2", 3) == "arena:square?minutes=2&seed=3"


def test_values_override_the_preset_and_single_assignments():
    plan = plan_sweep(["a.avi"], ["view.threshold=0.03,0.05"], preset="rc_car",
                      assignments=["view.threshold=0.9", "map.loops=7"])  # fmt: skip
    assert [trial.config.view.threshold for trial in plan] == [0.03, 0.05]
    assert {trial.config.map.loops for trial in plan} == {7}


@pytest.mark.parametrize(
    ("sources", "options", "error", "cause"),
    [
        (["a.avi"], {}, RunError, "nothing is varied; give several sources, --vary or --seeds"),
        (["a.avi", "a.avi"], {}, RunError, "a source is given twice"),
        (["a.avi"], {"vary": ["view.threshold"]}, ConfigError, "expected key=a,b,c"),
        (["a.avi"], {"vary": ["view.threshold=0.1,0.1"]}, ConfigError, "a value occurs twice"),
        (["a.avi"], {"vary": ["map.loops=1", "map.loops=2"]}, ConfigError, "given twice"),
        (["a.avi"], {"vary": ["view.treshold=1,2"]}, ConfigError, "did you mean 'view.threshold'"),
        (["a.avi"], {"vary": ["view.treshold=1,2"]}, ConfigError, "--vary: unknown key"),
        (["a.avi"], {"vary": ["map.loops=5,many"]}, ConfigError, "--vary: map.loops = 'many'"),
        (
            ["a.avi"],
            {"vary": ["map.loops=5,6"], "assignments": ["view.treshold=1"]},
            ConfigError,
            "--set: unknown key 'view.treshold'",
        ),
        (["a.avi", "b.avi"], {"assignments": ["view.treshold=1"]}, ConfigError, "--set: unknown"),
        (["a.avi"], {"seeds": 2}, RunError, "nothing is random in a.avi with cells pose"),
        (["a.avi"], {"seeds": 0}, RunError, "seeds is 0; expected 1 or more"),
        ([f"{WORLD}&seed=1"], {"seeds": 2}, SourceError, "has a seed already"),
    ],
)
def test_an_invalid_sweep_is_refused_before_any_run(sources, options, error, cause, tmp_path):
    with pytest.raises(error, match=cause.replace("(", r"\(")):
        plan_sweep(sources, **options)
    with pytest.raises(NeuroslamError):
        sweep(sources, tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


def test_values_are_those_of_toml_or_else_text():
    assert parse_values("a.b=1, 2.5,true") == ("a.b", [1, 2.5, True])
    assert parse_values('a="x,y",z'.replace(",z", ',"z"')) == ("a", ["x,y", "z"])


# --- what is written ----------------------------------------------------------------------------


def test_each_run_is_a_folder_like_that_of_any_run(serial, tmp_path, call):
    out, rows = serial
    folders = sorted(path.name for path in out.iterdir() if path.is_dir())
    assert folders == [row["run"] for row in rows]
    assert {path.name for path in (out / folders[0]).iterdir()} == {*RUN_FILES, MANIFEST}
    source = f"{WORLD}&seed=1"
    single = call("run", source, "-o", tmp_path / "one", "--stop", STOP, "--no-tensorboard",
                  "--set", "view.threshold=0.06")  # fmt: skip
    assert single.code == 0
    assert all_but_timings(tmp_path / "one") == {
        name.partition("/")[2]: content
        for name, content in all_but_timings(out).items()
        if name.startswith(folders[3])
    }


def test_the_table_has_a_row_for_each_run_and_says_the_same_as_the_runs(serial):
    out, rows = serial
    assert [(row["view.threshold"], row["seed"]) for row in rows] == [
        (0.03, 0), (0.03, 1), (0.06, 0), (0.06, 1)
    ]  # fmt: skip
    assert json.loads((out / "sweep.json").read_text())["runs"] == rows
    with (out / "sweep.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    for row, line in zip(rows, table, strict=True):
        metrics = json.loads((out / row["run"] / "metrics.json").read_text())
        for key in ("frames", "templates", "ate_rmse_m", "odometry_ate_rmse_m", *TIMINGS):
            assert row[key] == metrics[key] == float(line[key])
        assert row["error"] == line["error"] == ""
    assert varied(rows) == ["view.threshold", "seed"]
    assert rows[0]["templates"] > rows[2]["templates"]
    assert rows[0]["odometry_ate_rmse_m"] != rows[1]["odometry_ate_rmse_m"]


def test_two_at_once_give_the_files_of_one_after_the_other(serial, tmp_path, call):
    done = call(*ARGUMENTS, "-o", tmp_path / "two", "--jobs", "2")
    assert (done.code, done.err) == (0, "")
    assert digests(tmp_path / "two") == digests(serial[0])
    assert all_but_timings(tmp_path / "two") == all_but_timings(serial[0])


def addresses_of(pid):
    """Return the addresses on which a process and those that it started listen."""
    try:
        import psutil
    except ImportError:
        return set()
    found = set()
    with contextlib.suppress(psutil.Error):
        for process in (psutil.Process(pid), *psutil.Process(pid).children(recursive=True)):
            with contextlib.suppress(psutil.Error):
                found |= {
                    c.laddr.ip for c in process.net_connections("inet") if c.status == "LISTEN"
                }
    return found


@pytest.mark.skipif(
    importlib.util.find_spec("ray") is None, reason="Ray is not installed: neuroslam[sweep]"
)
def test_a_local_ray_of_two_workers_gives_the_files_of_one_after_the_other(serial, tmp_path):
    out = tmp_path / "ray"
    command = [sys.executable, "-m", "neuroslam.cli", *ARGUMENTS, "-o", str(out)]
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).resolve().parents[2])}
    with subprocess.Popen(
        [*command, "--ray", "local", "--jobs", "2"],
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, env=environment,
    ) as running:  # fmt: skip
        listening = set()
        while running.poll() is None:
            listening |= addresses_of(running.pid)
            time.sleep(0.2)
        said = [line for line in running.stderr.read().splitlines() if "elapsed" not in line]
        assert (running.returncode, said) == (0, [])  # but progress, if the machine is slow
    if listening:  # psutil is installed
        assert listening <= {"127.0.0.1", "::1", "::ffff:127.0.0.1"}
    assert digests(out) == digests(serial[0])
    assert all_but_timings(out) == all_but_timings(serial[0])


# --- what goes wrong ----------------------------------------------------------------------------


def test_a_failed_run_is_reported_in_one_line_and_stops_no_other(tmp_path, call):
    out = tmp_path / "out"
    done = call("sweep", tmp_path / "nowhere.avi", WORLD, "-o", out, "--stop", "20", "--jobs", "2")
    assert done.code == 2
    assert done.err.count("\n") == 1
    assert done.err.startswith("neuroslam sweep: 1-nowhere.avi: ")
    assert "no such file or folder" in done.err
    first, second = json.loads((out / "sweep.json").read_text())["runs"]
    assert "no such file" in first["error"]
    assert (second["frames"], second["error"]) == (20, "")
    assert not (out / "1-nowhere.avi").exists()
    assert (out / "sweep.png").exists()


def test_the_preset_auto_is_estimated_from_each_source(tmp_path, call):
    size = "frames_per_lap=110&width=160&height=120"
    done = call(
        "sweep", f"world:ellipse?{size}", f"world:town?{size}", "-o", tmp_path / "out",
        "--preset", "auto", "--vary", "map.loops=5,7", "--stop", "130",
    )  # fmt: skip
    assert (done.code, done.err) == (0, "")
    assert done.out.count("auto: views of ") == 2
    configs = sorted((tmp_path / "out").glob("*/config.toml"))
    values = [tomllib.loads(path.read_text()) for path in configs]
    assert [one["map"]["loops"] for one in values] == [5, 7, 5, 7]
    ellipse, same, town, other = (one["view"]["threshold"] for one in values)
    assert ellipse == same != town == other


def test_an_earlier_sweep_is_kept_without_overwrite(serial, tmp_path, mistake, call):
    before = all_but_timings(serial[0])
    assert "holds a sweep.json already" in mistake(*ARGUMENTS, "-o", serial[0])
    (tmp_path / "file").write_text("")
    assert "is a file" in mistake(*ARGUMENTS, "-o", tmp_path / "file")
    assert all_but_timings(serial[0]) == before
    assert call(*ARGUMENTS, "-o", serial[0], "--overwrite").code == 0
    assert all_but_timings(serial[0]) == before


def test_ctrl_c_ends_all_runs_and_the_table_has_those_that_ended(tmp_path):
    out = tmp_path / "out"
    long = "world:ellipse?laps=500&width=64&height=32"
    process = subprocess.Popen(
        [sys.executable, "-m", "neuroslam.cli", "sweep", str(tmp_path / "nowhere.avi"), long,
         f"{long}&noise=0.1", "-o", str(out), "--jobs", "2"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
        env=os.environ | {"PYTHONPATH": str(Path(__file__).resolve().parents[2])},
    )  # fmt: skip
    with process:
        end = time.monotonic() + 600  # for the sake of an end if none is written
        while len(list(out.glob("*/frames.csv"))) < 2:
            assert process.poll() is None
            assert time.monotonic() < end
            time.sleep(0.05)
        os.killpg(process.pid, signal.SIGINT)
        shown, said = process.communicate(timeout=300)
    assert process.returncode == 130
    assert shown == f"1 of 3 runs ended: {out}/sweep.csv\n"
    assert [line for line in said.splitlines() if "elapsed" not in line] == [
        "neuroslam sweep: interrupted"
    ]
    errors = [row["error"] for row in json.loads((out / "sweep.json").read_text())["runs"]]
    assert "no such file" in errors[0]
    assert errors[1:] == ["interrupted"] * 2


# --- what is drawn ------------------------------------------------------------------------------


def row(source="a", error="", **figures):
    return {"run": "1", "source": source, **figures, "error": error}


def test_means_over_seeds_are_joined_where_values_are_numbers():
    rows = [
        row(seed=seed, **{"map.loops": loops}, experiences=10 * loops + seed, templates=3)
        for loops in (1, 2, 8)
        for seed in (0, 2)
    ]
    figure = plot_sweep(rows, ["map.loops"])
    panel = next(axes for axes in figure.axes if axes.get_ylabel() == "experiences")
    line, dots = panel.lines
    assert line.get_xdata().tolist() == [1, 2, 8]
    assert line.get_ydata().tolist() == [11, 21, 81]
    assert sorted(dots.get_ydata()) == [10, 12, 20, 22, 80, 82]
    assert panel.get_xlabel() == "map.loops"
    assert panel.get_xscale() == "log"


def test_names_stand_side_by_side_and_what_else_is_varied_is_in_the_legend():
    rows = [
        row(source, cells=cells, experiences=5, ate_rmse_m=0.1, odometry_ate_rmse_m=0.5)
        for source in ("a", "b")
        for cells in ("pose", "place")
    ] + [row("nowhere", error="no such file", cells="pose")]
    figure = plot_sweep(rows, ["source", "cells"])
    assert figure.axes[0].get_ylabel() == "absolute trajectory error (m)"
    labels = [label.get_text() for label in figure.axes[0].get_xticklabels()]
    assert labels == ["pose", "place"]
    assert [text.get_text() for text in figure.legends[0].texts] == ["a", "b", "odometry alone"]
    assert figure.get_suptitle() == "source, cells varied: 4 runs, 1 failed"
    middles = [sum(line.get_xdata()) / 2 for line in figure.axes[1].lines if len(line.get_xdata())]
    assert all(a != b for a, b in pairwise(sorted(set(middles))))


def test_a_sweep_in_which_all_failed_has_no_figure():
    with pytest.raises(ValueError, match="got 1 rows, expected one of a run that succeeded"):
        plot_sweep([row(error="no such file")], ["source"])


def test_a_sweep_prints_the_notes_of_the_readers_once_and_truth_where_it_is_partial(tmp_path, call):
    motion = "v_m_s,w_rad_s,x_m,y_m,theta_rad\n"
    (tmp_path / "a.csv").write_text(motion + "1,0.1,0,0,0\n" * 3 + "1,0.1,,,\n" * 3)
    (tmp_path / "b.csv").write_text(motion + "1,0.1,0,0,0\n" * 6)
    done = call("sweep", tmp_path / "a.csv", "--seeds", "2", "-o", tmp_path / "o",
                "--set", "cells=place")  # fmt: skip
    assert done.out.count("a.csv: has no times; 20 frames per second assumed") == 1
    done = call("sweep", WORLD, "--seeds", "2", "--stop", "8", "-o", tmp_path / "w")
    assert "frames with truth" not in " ".join(done.out.split())


def test_a_disk_that_is_full_at_a_run_ends_a_sweep_and_the_earlier_one_stays(tmp_path, monkeypatch):
    ended = []

    def full(*_arguments, **_options):
        ended.append(1)
        if len(ended) == 2:
            raise WriteError("2: cannot be written (No space left on device)")
        return {"error": ""}

    (tmp_path / "sweep.json").write_text("{}")
    monkeypatch.setattr("neuroslam.runs.sweep.run_one", full)
    with pytest.raises(WriteError, match="No space left"):
        sweep([WORLD], tmp_path, vary=["map.loops=1,2,3"], stop=9, overwrite=True)
    assert len(ended) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["sweep.json"]
    assert (tmp_path / "sweep.json").read_text() == "{}"
