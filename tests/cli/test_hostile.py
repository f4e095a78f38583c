"""Names, configs and folders from elsewhere: one line, no escape, nothing opened unasked."""

import csv
import errno
import http.server
import io
import json
import os
import re
import shutil
import subprocess
import sys
import threading
import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest
from pydantic import BaseModel
from safetensors import safe_open

from neuroslam.brain import NavigationBrain
from neuroslam.cli import main
from neuroslam.config import BrainConfig, build_config, parse_assignment
from neuroslam.config.populations import HOMES, section_class
from neuroslam.config.size import MOST_WORK, estimated_bytes
from neuroslam.errors import ConfigError, SourceError, csv_text, printable
from neuroslam.limits import MAX_MEMORY
from neuroslam.report import write_report
from neuroslam.sensors import open_source
from neuroslam.state.files import save_checked

WORLD = "world:corridor?width=64&height=40&frames_per_lap=60"
QUICK = "--no-tensorboard"
ESCAPE = "\x1b]0;pwned\x07\x1b[2J"


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    out = tmp_path_factory.mktemp("finished") / "run"
    assert main(["run", WORLD, "-o", str(out), "--stop", "12", QUICK]) == 0
    return out


def motion(path, rows=6):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("v_m_s,w_rad_s\n" + "1,0\n" * rows)
    return path


# --- bounds of a config --------------------------------------------------------------------------


def whole_numbers(section, path=""):
    """Yield every key of a section whose values are, or hold, whole numbers; and its schema."""
    schema = section.model_json_schema()
    for name, field in section.model_fields.items():
        inner = field.annotation
        if isinstance(inner, type) and issubclass(inner, BaseModel):
            yield from whole_numbers(inner, f"{path}{name}.")
            continue
        found = json.dumps(schema["properties"][name])
        if '"integer"' in found:
            yield f"{path}{name}", schema["properties"][name]


def parameters():
    yield from whole_numbers(BrainConfig)
    for kind in HOMES:
        if (section := section_class(kind)) is not None:
            yield from whole_numbers(section, f"{kind}.")


def test_every_whole_number_of_a_config_has_an_upper_bound():
    without = [key for key, schema in parameters() if '"maximum"' not in json.dumps(schema)]
    assert without == []
    assert len(list(parameters())) > 40


def test_every_list_of_a_config_has_a_longest_length():
    for key in ("spacings_m", "orientations_deg"):
        with pytest.raises(ConfigError, match="at most 64 items"):
            build_config({"grid_cells": {key: [0.5] * 65}})


@pytest.mark.parametrize(
    "text",
    ["threads=1000000", "view.template_width=1000000000", "threads=99999999999999999999"],
)
def test_the_given_assignments_are_refused_at_once(text, mistake, tmp_path):
    line = mistake("run", WORLD, "-o", tmp_path / "out", "--set", text)
    assert "input should be less than or equal to" in line
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "value", ["9" * 5000, "0x" + "f" * 9000, "[" * 50_000, "{a=" * 2000, "1e999", "'" * 300]
)
def test_a_value_that_cannot_be_parsed_is_one_short_line(value, mistake, tmp_path):
    line = mistake("run", WORLD, "-o", tmp_path / "out", "--set", f"view.shift_match={value}")
    assert len(line) < 300


@pytest.mark.parametrize("text", ["a = " + "[" * 9000, "a = " + "9" * 5000, "a." * 3000 + "b = 1"])
def test_a_config_file_that_cannot_be_parsed_is_one_line(text, mistake, tmp_path):
    (tmp_path / "c.toml").write_text(text)
    assert "c.toml" in mistake("run", WORLD, "-o", tmp_path / "o", "--config", tmp_path / "c.toml")


def test_a_config_that_is_a_device_or_large_is_one_line(mistake, tmp_path):
    line = mistake("run", WORLD, "-o", tmp_path / "o", "--config", "/dev/zero")
    assert "is a device or a pipe; expected a regular file" in line
    (tmp_path / "c.toml").write_bytes(b"#" * (2**20 + 1))
    line = mistake("run", WORLD, "-o", tmp_path / "o", "--config", tmp_path / "c.toml")
    assert "has 1 MB; expected at most 1 MB" in line


def test_the_given_ini_with_an_infinite_edge_is_one_line(mistake, cases, tmp_path):
    ini = cases / "hostile" / "traceback_ini" / "c.ini"
    line = mistake("run", "nowhere.avi", "-o", tmp_path / "o", "--config", ini)
    assert "vtrans_image_x_max = 'inf' in [visual_odometry]; expected a number, finite" in line


def test_a_config_that_asks_for_more_than_memory_is_refused(mistake, tmp_path):
    line = mistake(
        "run", WORLD, "-o", tmp_path / "o", "--set", "pose_cells.n_xy=301", "--max-memory", "10M"
    )
    assert "pose_cells alone asks for 75 MB, the brain needs about 76 MB; expected at most" in line
    assert not (tmp_path / "o").exists()


def test_a_size_that_is_none_is_one_line_and_a_set_one_ends_with_its_command(mistake, tmp_path):
    assert "'2X' is no size" in mistake("run", WORLD, "-o", tmp_path / "o", "--max-memory", "2X")
    assert MAX_MEMORY not in os.environ


def test_networks_that_would_be_solved_for_days_are_refused(monkeypatch):
    monkeypatch.setenv(MAX_MEMORY, "100G")
    neurons = {"tier": "spiking", "integrator": {"neurons": 20_000}}
    with pytest.raises(ConfigError, match=re.escape(f"at most {MOST_WORK:.1g}; use fewer neurons")):
        NavigationBrain(build_config({"cells": "semantic", "semantic": neurons}))


def test_the_size_of_a_brain_is_estimated_from_above():
    few = {"space": {"n_scales": 2, "n_rotations": 2}, "integrator": {"neurons": 60}}
    few |= {"tier": "spiking", "binding": "exact", "vector_neurons": 60, "map": {"neurons": 60}}
    config = build_config({"cells": "pose+semantic", "pose_cells": {"n_xy": 61}, "semantic": few})
    brain, sizes = NavigationBrain(config), estimated_bytes(config)
    for name, module in (("pose_cells", brain.pose_cells), ("semantic", brain.semantic)):
        held = sum(t.numel() * t.element_size() for t in module.buffers())
        assert held < sizes[name]
    assert sum(sizes.values()) < 100e6


# --- names ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", [f"{ESCAPE}x.avi", "a\nneuroslam run: all is well.avi", "a\x7f\x85"]
)
@pytest.mark.parametrize("command", ["verify", "inspect", "report", "export", "plot"])
def test_a_name_with_escapes_is_printed_without_them(name, command, call):
    done = call(command, name, *(["to.tum"] if command == "export" else []))
    assert done.code == 2
    assert done.err.count("\n") == 1
    assert done.err[:-1].isprintable()
    assert printable(name) in done.err


def test_a_member_of_an_archive_forges_no_line(call, tmp_path):
    import tarfile

    good = cv2.imencode(".png", np.random.default_rng(0).integers(0, 255, (48, 64), np.uint8))[1]
    with tarfile.open(tmp_path / "t.tar", "w") as tar:
        for name, data in ((f"0{ESCAPE}.png", b"no"), ("1.png", good.tobytes()), ("2\nx.png", b"")):
            info = tarfile.TarInfo(name)
            info.size = len(data)
            (tmp_path / "member").write_bytes(data)
            with (tmp_path / "member").open("rb") as file:
                tar.addfile(info, file)
    done = call("run", tmp_path / "t.tar", "-o", tmp_path / "o", QUICK, "--on-bad-frame", "skip")
    assert done.code == 0
    for line in (done.out + done.err).splitlines():
        assert line.isprintable()
    assert "2\\nx.png is corrupt" in done.err.replace("\\x0a", "\\n")


def test_a_mistake_of_typing_is_printed_without_escapes(call):
    done = call("verify", "a", f"b{ESCAPE}\nneuroslam verify: fine")
    assert done.code == 2
    assert "\x1b" not in done.err
    assert not any(line.startswith("neuroslam verify: fine") for line in done.err.splitlines())


@pytest.mark.parametrize("argument", ["source", "out", "config"])
def test_a_name_that_is_not_utf8_is_refused_everywhere(argument, call, tmp_path):
    name = os.fsdecode(b"a\xff.csv")
    words = {"source": motion(tmp_path / "m.csv"), "out": tmp_path / "o", "config": ""}
    words[argument] = f"{tmp_path}/{name}"
    more = ["--config", words["config"]] if words["config"] else []
    done = call("run", words["source"], "-o", words["out"], QUICK, *more)
    assert done.code == 2
    assert "a\\xff.csv: its name is not UTF-8; rename it" in done.err


@pytest.mark.parametrize("command", ["sweep", "fleet", "tune"])
def test_many_runs_of_a_name_that_is_not_utf8_are_refused(command, call, tmp_path):
    name = f"{tmp_path}/{os.fsdecode(bytes([0x61, 0xFF]))}.avi"
    vary = ["--vary", "map.loops=1,2"] if command == "sweep" else []
    out = ["-o", tmp_path / "o"] if command != "tune" else ["-o", tmp_path / "o.toml"]
    done = call(command, name, *vary, *out)
    assert (done.code, done.err.count("\n")) == (2, 1)
    assert "a\\xff.avi" in done.err
    assert not (tmp_path / "o").exists()


def test_in_python_a_video_with_such_a_name_is_refused(tmp_path):
    (tmp_path / os.fsdecode(b"a\xff.avi")).write_bytes(b"RIFF")
    with pytest.raises(SourceError, match="its name is not UTF-8"):
        open_source(tmp_path / os.fsdecode(b"a\xff.avi"))


def test_images_with_such_names_are_read(tmp_path, call):
    (tmp_path / "f").mkdir()
    for k in range(3):
        image = np.random.default_rng(k).integers(0, 255, (48, 64), np.uint8)
        data = cv2.imencode(".png", image)[1].tobytes()
        (tmp_path / "f" / os.fsdecode(b"%d\xff.png" % k)).write_bytes(data)
    assert call("run", tmp_path / "f", "-o", tmp_path / "o", QUICK).code == 0


@pytest.mark.parametrize("name", ["a\x7fb", 'q"uo\\te', "t\tb", "день", "a\u2028b"])
def test_a_run_of_a_folder_with_any_name_is_resumed(name, call, tmp_path):
    source = motion(tmp_path / name / "m.csv")
    assert call("run", source, "-o", tmp_path / "o", QUICK, "--stop", "3").code == 0
    text = (tmp_path / "o" / "config.toml").read_text()
    assert tomllib.loads(text)["run"]["source"] == str(source)
    assert call("resume", tmp_path / "o", QUICK).code == 0


def test_the_given_config_with_a_del_in_it_is_one_line(cases, call, tmp_path):
    shutil.copy(cases / "hostile" / "name-del" / "config.toml", tmp_path)
    done = call("resume", tmp_path, QUICK)
    assert (done.code, done.err.count("\n")) == (2, 1)


def test_no_cell_of_a_table_is_a_formula(call, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = ["=1+1.csv", "@SUM(1).csv", "+a.csv", "-b.csv"]
    for name in names:
        motion(tmp_path / name)
    words = ["--", *names[:3]]
    done = call("sweep", "-o", "s", *words)
    assert done.code == 0, done.err
    rows = list(csv.DictReader((tmp_path / "s" / "sweep.csv").read_text().splitlines()))
    assert [row["source"] for row in rows] == ["'=1+1.csv", "'@SUM(1).csv", "'+a.csv"]
    assert json.loads((tmp_path / "s" / "sweep.json").read_text())["runs"][0]["source"] == names[0]


@pytest.mark.parametrize("text", ["-0.5", "1e-3", "+7", "plain", "a=b", "-inf"])
def test_a_cell_that_is_no_formula_stays_as_it_is(text):
    assert csv_text(text) == text


def test_the_given_name_is_printed_on_an_ascii_terminal(cases, tmp_path):
    done = ascii_run(cases / "name_on_ascii_terminal" / "день.csv", tmp_path / "день")
    assert done.returncode == 0
    assert "Traceback" not in done.stderr
    assert "Written: " in done.stdout
    assert (tmp_path / "день" / "metrics.json").exists()


def ascii_run(source, out):
    root = str(Path(__file__).resolve().parents[2])
    environment = os.environ | {"PYTHONPATH": root, "PYTHONIOENCODING": "ascii"}
    return subprocess.run(
        [sys.executable, "-m", "neuroslam.cli", "run", str(source), "-o", str(out), QUICK],
        capture_output=True, text=True, check=False, env=environment,
    )  # fmt: skip


# --- a folder from elsewhere ---------------------------------------------------------------------


@pytest.fixture
def listener():
    """An address on this machine, and the requests that it gets."""
    hits = []

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            hits.append(self.path)
            self.send_error(404)

        def log_message(self, *_words):
            pass

    server = http.server.HTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}/x", hits
    server.shutdown()
    server.server_close()


def with_source(finished, to, source):
    """Return a copy of a run whose config names another source, as somebody else could write it."""
    out = shutil.copytree(finished, to)
    (out / "manifest.json").unlink(missing_ok=True)
    text = (out / "config.toml").read_text()
    lines = [f"source = {json.dumps(source)}" if line.startswith("source =") else line
             for line in text.splitlines()]  # fmt: skip
    (out / "config.toml").write_text("\n".join(lines) + "\n")
    return out


@pytest.mark.parametrize("command", ["report", "verify", "inspect", "plot"])
def test_a_folder_from_elsewhere_connects_to_nothing(command, finished, tmp_path, listener, call):
    address, hits = listener
    out = with_source(finished, tmp_path / "o", f"camera:{address}")
    call(command, out)
    assert hits == []


def test_a_report_opens_files_only_if_asked(tmp_path):
    folder = tmp_path / "pictures"
    folder.mkdir()
    for k in range(6):
        coarse = np.random.default_rng(k).integers(0, 255, (6, 8), np.uint8)
        cv2.imwrite(str(folder / f"{k}.png"), cv2.resize(coarse, (64, 48)))
    assert main(["run", str(folder), "-o", str(tmp_path / "o"), QUICK]) == 0
    page = write_report(tmp_path / "o").read_text()
    assert "the source of a run is opened only if asked, with --source" in page
    asked = write_report(tmp_path / "o", source=True).read_text()
    assert len(asked) > len(page) + 1000


def test_a_report_of_a_rendered_world_has_pictures(finished, tmp_path):
    page = write_report(finished, tmp_path / "a.html").read_text()
    assert "opened only if asked" not in page


# --- brains --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "case", ["traceback_brain_header_edit", "traceback_brain_header_edit_HANG"]
)
def test_the_given_brains_with_an_edited_header_are_one_line(case, cases, mistake):
    mistake("verify", cases / "hostile" / case / "b.safetensors")


CONFIGS = {
    "view.template_width": 10**9,
    "threads": 10**6,
    "pose_cells.n_xy": 10**5,
    "semantic.space.n_random": 10**12,
    "map.loops": float("inf"),
}


@pytest.mark.parametrize("key", CONFIGS)
@pytest.mark.parametrize("command", ["verify", "inspect", "resume", "report"])
def test_a_brain_whose_config_asks_for_too_much_is_one_line(key, command, finished, tmp_path, call):
    out = shutil.copytree(finished, tmp_path / "o")
    (out / "manifest.json").unlink(missing_ok=True)
    file = out / "brain.safetensors"
    with safe_open(file, framework="pt") as opened:
        about = json.loads(opened.metadata()["neuroslam"])
        tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
    *path, last = key.split(".")
    where = about["config"]
    for part in path:
        where = where[part]
    where[last] = CONFIGS[key]
    save_checked(file, {k: v for k, v in about.items() if k != "sha256"}, tensors)
    done = call(command, out)
    assert done.code == 2
    assert done.err.count("\n") == 1
    assert last in done.err


@pytest.mark.parametrize(("name", "value"), [("clock.frames_seen", -1), ("clock.frame", -7)])
def test_a_brain_that_has_seen_less_than_no_frames_is_refused(
    name, value, finished, tmp_path, call
):
    out = shutil.copytree(finished, tmp_path / "o")
    (out / "manifest.json").unlink(missing_ok=True)
    file = out / "brain.safetensors"
    with safe_open(file, framework="pt") as opened:
        about = json.loads(opened.metadata()["neuroslam"])
        tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
    tensors[name].fill_(value)
    save_checked(file, {k: v for k, v in about.items() if k != "sha256"}, tensors)
    for command in ("verify", "inspect", "resume"):
        done = call(command, out)
        assert done.code == 2
        assert "clock" in done.err


def test_assignments_still_give_what_they_say():
    assert parse_assignment("view.threshold=0.04") == {"view": {"threshold": 0.04}}


@pytest.mark.skipif(sys.platform != "linux", reason="limits of address space are those of Linux")
@pytest.mark.parametrize("megabytes", [0, 2, 20])
def test_a_process_without_memory_says_so_and_keeps_the_earlier_run(megabytes, finished, tmp_path):
    import resource

    out = shutil.copytree(finished, tmp_path / "o")
    before = (out / "brain.safetensors").read_bytes()
    said = tmp_path / "said"
    child = os.fork()
    if child == 0:
        try:
            os.dup2(os.open(said, os.O_WRONLY | os.O_CREAT), 2)
            sys.stderr = open(2, "w", closefd=False)  # noqa: SIM115
            used = 4096 * int(Path("/proc/self/statm").read_text().split()[0])
            resource.setrlimit(resource.RLIMIT_AS, (used + megabytes * 10**6,) * 2)
            words = ["run", "world:corridor?width=640&height=480", "-o", str(out), "--overwrite"]
            code = main([*words, "--stop", "3", QUICK])
            sys.stderr.flush()
        except BaseException as error:
            os.write(2, f"Traceback {error!r}".encode())
            code = 1
        os._exit(code)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    assert code in (0, 2), said.read_text()
    assert "Traceback" not in said.read_text()
    if code:
        assert said.read_text().count("\n") == 1
        assert (out / "brain.safetensors").read_bytes() == before


# --- names and files that the system refuses ------------------------------------------------------


@pytest.mark.parametrize("name", ["a" * 300, "d/" * 3000, "loop"])
@pytest.mark.parametrize("command", ["run", "verify"])
def test_a_folder_that_cannot_be_named_is_one_line(name, command, mistake, tmp_path):
    (tmp_path / "loop").symlink_to("loop")
    words = ("run", WORLD, "--stop", "3", QUICK, "-o") if command == "run" else (command,)
    line = mistake(*words, tmp_path / name)
    assert len(line) < 4500


@pytest.mark.parametrize("name", ["brain.safetensors", "frames.csv", "trace.f64", "manifest.json"])
@pytest.mark.parametrize("command", ["verify", "report", "resume", "inspect"])
def test_a_pipe_in_a_folder_from_elsewhere_is_not_waited_for(
    name, command, finished, tmp_path, mistake
):
    out = shutil.copytree(finished, tmp_path / "o")
    (out / name).unlink()
    os.mkfifo(out / name)
    assert "is a device or a pipe; expected a regular file" in mistake(command, out)


def test_a_current_folder_that_was_removed_is_one_line(mistake, tmp_path, monkeypatch):
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    line = mistake("run", WORLD, "-o", "out", "--stop", "3", QUICK)
    assert "the current folder was removed" in line


class FullOutput(io.StringIO):
    def write(self, _text):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_output_to_a_full_disk_is_one_line(mistake, finished, monkeypatch):
    monkeypatch.setattr(sys, "stdout", FullOutput())
    line = mistake("verify", finished)
    assert "what it prints cannot be written (No space left on device)" in line
