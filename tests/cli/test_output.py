"""What the commands print: progress, results for programs, completions of the shell."""

import json
import os
import re
import subprocess
import sys

import numpy as np
import pytest

from neuroslam.cli import main, output, progress

WORLD = "world:ellipse?laps=1&width=96&height=24&frames_per_lap=40"
QUICK = "--no-tensorboard"


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    out = tmp_path_factory.mktemp("cli") / "run"
    assert main(["run", WORLD, "-o", str(out), QUICK, "--quiet"]) == 0
    return out


@pytest.fixture
def call(capsys):
    def calling(*arguments):
        code = main([str(one) for one in arguments])
        return code, *capsys.readouterr()

    return calling


def test_quiet_prints_nothing_and_still_prints_errors(tmp_path, call):
    assert call("run", WORLD, "-o", tmp_path / "a", QUICK, "-q") == (
        0,
        "",
        "",
    )
    assert (tmp_path / "a" / "map.png").exists()
    code, out, err = call("run", WORLD, "-o", tmp_path / "a", QUICK, "--quiet")
    assert (code, out) == (2, "")
    assert "holds a run already" in err


def test_json_is_one_object_and_the_lines_go_to_stderr(tmp_path, call):
    code, out, err = call("run", WORLD, "-o", tmp_path / "run", QUICK, "--json")
    found = json.loads(out)
    assert (code, out.count("\n")) == (0, 1)
    assert (found["command"], found["exit_code"], found["frames"]) == ("run", 0, 41)
    assert found["out"] == str(tmp_path / "run")
    saved = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert saved.items() <= found.items()
    assert f"Written: {tmp_path / 'run'}" in err


def test_json_of_the_commands_on_results(finished, tmp_path, call):
    def figures(*arguments):
        code, out, _ = call(*arguments, "--json")
        found = json.loads(out)
        assert (found["command"], found["exit_code"]) == (arguments[0], code)
        return found

    table = figures("inspect", finished)
    metrics = json.loads((finished / "metrics.json").read_text())
    assert table["experiences"] == metrics["experiences"]
    assert [one["frames"] for one in table["sessions"]] == [41]
    errors = figures("evaluate", finished)["errors"]
    assert errors[0]["rmse"] == pytest.approx(metrics["ate_rmse_m"], rel=1e-6)
    assert figures("verify", finished)["sound"] is True
    assert figures("plan", finished, "0", "-o", tmp_path)["experiences"][-1] == 0
    assert figures("export", finished, tmp_path / "m.g2o")["written"] == str(tmp_path / "m.g2o")
    assert "rc_car" in figures("presets")["presets"]
    merged = figures("merge", finished, finished, "-o", tmp_path / "merged")
    assert (merged["exit_code"], merged["merged"]) == (0, True)
    assert merged["reports"][0]["loaded_sessions"]
    rows = figures("localise", finished, WORLD, "-o", tmp_path / "poses.csv")
    assert rows["frames"] == 41


def test_json_of_an_error_holds_its_text(tmp_path, call):
    code, out, err = call("inspect", tmp_path / "none", "--json")
    found = json.loads(out)
    assert (code, found["exit_code"]) == (2, 2)
    assert found["error"] in err


def test_json_has_no_number_that_json_lacks():
    assert output.plain({"a": float("nan"), "b": [float("inf"), 1.5]}) == {
        "a": None,
        "b": [None, 1.5],
    }


def test_a_dry_run_names_what_would_be_read_and_writes_nothing(tmp_path, monkeypatch, call):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "motion.csv").write_text(
        "time_s,v_m_s,w_rad_s\n" + "".join(f"{5 + 0.5 * i},1.0,0.0\n" for i in range(21))
    )
    before = sorted(tmp_path.iterdir())
    code, out, _ = call("run", "motion.csv", "--dry-run", "--json")
    found = json.loads(out)
    assert code == 0
    expected = {
        "kind": "track of motion", "content": ["motion"], "frames": 21, "first_s": 5.0,
        "last_s": 15.0, "exact": True, "unit": "m", "preset": "none, the defaults",
        "file_bytes": (tmp_path / "motion.csv").stat().st_size,
    }  # fmt: skip
    assert expected.items() <= found.items()
    assert found["rate_hz"] == pytest.approx(2.0)
    code, out, _ = call("run", WORLD, "-o", "out", "--dry-run", "--stop", 10)
    assert code == 0
    assert re.search(r"frames +│ 10 ", out)
    assert re.search(r"image size +│ 96 x 24 px", out)
    assert sorted(tmp_path.iterdir()) == before


def test_a_dry_run_names_the_topics_of_a_bag(tmp_path, call):
    pytest.importorskip("rosbags", reason="rosbags is not installed")
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    vector, quaternion = (
        store.types[f"geometry_msgs/msg/{name}"] for name in ("Vector3", "Quaternion")
    )

    def odometry(i):
        of = {name.rpartition("/")[2]: kind for name, kind in store.types.items()}
        pose = of["Pose"](of["Point"](0.1 * i, 0.0, 0.0), quaternion(0.0, 0.0, 0.0, 1.0))
        twist = of["Twist"](vector(1.0, 0.0, 0.0), vector(0.0, 0.0, 0.0))
        time = of["Time"](100 + i // 10, 100_000_000 * (i % 10))
        return of["Odometry"](
            of["Header"](time, "odom"), "base",
            of["PoseWithCovariance"](pose, np.zeros(36)),
            of["TwistWithCovariance"](twist, np.zeros(36)),
        )  # fmt: skip

    kind = "nav_msgs/msg/Odometry"
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        topics = [
            writer.add_connection(name, kind, typestore=store) for name in ("/odom", "/gt/odom")
        ]
        for i in range(100):
            for topic in topics:
                message = store.serialize_cdr(odometry(i), kind)
                writer.write(topic, 100 * 10**9 + 10**8 * i, message)
    code, out, _ = call("run", tmp_path / "bag", "--dry-run", "--json")
    found = json.loads(out)
    assert (code, found["kind"], found["topics"]) == (0, "odometry of a ROS bag", ["/odom"])
    assert (found["frames"], found["first_s"]) == (100, 100.0)
    assert found["last_s"] == pytest.approx(109.9, abs=1e-6)
    assert found["rate_hz"] == pytest.approx(10.0)
    assert any("not /gt/odom" in note for note in found["notes"])


def test_without_a_terminal_a_line_is_printed_when_it_is_due(monkeypatch, tmp_path, call):
    monkeypatch.setattr(progress, "EVERY_S", 0.0)
    monkeypatch.setattr(progress, "_COMPILES", 0)
    code, out, err = call("run", WORLD, "-o", tmp_path / "run", QUICK, "--stop", 30)
    assert code == 0
    assert "elapsed" not in out
    line = r"neuroslam run: frame \d+ of 30 \(\d+ %\), \d+ frames/s, \d+:\d\d left, \d+ templates"
    assert re.search(line, err)


def test_the_rate_is_that_of_the_last_seconds(monkeypatch):
    now = 0.0
    monkeypatch.setattr(progress.time, "monotonic", lambda: now)
    rate = progress._Rate()
    found = [rate(1.0 * s, s if s < 60 else 60 + 10 * (s - 60)) for s in range(1, 121)]
    assert found[40] == pytest.approx(1.0)
    assert found[-1] == pytest.approx(10.0)
    assert progress.remaining(100, 400, found[-1]) == "0:30 left"


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("neuroslam re", {"resume", "report"}),
        ("neuroslam run x --preset ope", {"openratslam"}),
        ("neuroslam experiment grid-com", {"grid-comparison"}),
    ],
)
def test_the_shell_completes_without_torch(words, expected):
    asked = {
        "_NEUROSLAM_COMPLETE": "complete_bash",
        "COMP_WORDS": words,
        "COMP_CWORD": str(len(words.split()) - 1),
    }
    program = (
        "import sys; from neuroslam.cli import main\n"
        "try: main([])\n"
        "finally: assert 'torch' not in sys.modules"
    )
    done = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True, check=False, text=True, env={**os.environ, **asked},
    )  # fmt: skip
    assert set(done.stdout.split()) == expected, done.stderr


def test_help_is_as_wide_as_the_terminal(monkeypatch, call):
    widths = {}
    for columns in (60, 100, 200):
        monkeypatch.setenv("COLUMNS", str(columns))
        widths[columns] = max(map(len, call("run", "--help")[1].splitlines()))
    assert widths[100] > 90
    assert widths[200] > 160
    assert all(width <= columns for columns, width in widths.items() if columns >= 100)
