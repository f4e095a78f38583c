"""A brain file is described for a reader, and every kind of damage to it is found and named."""

import csv
import json
import math
import shutil

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neuroslam.brain import NavigationBrain, load_brain, read_checkpoint, save_brain
from neuroslam.brain.checkpoint import FORMAT_VERSION
from neuroslam.config import BrainConfig, build_config, read_preset
from neuroslam.errors import CheckpointError
from neuroslam.runs.files import FRAME_COLUMNS, RunPlan, experiences_csv, links_csv
from neuroslam.runs.inspect import inspect
from neuroslam.runs.results import RunSummary
from neuroslam.runs.run import run
from neuroslam.runs.verify import verify
from neuroslam.sensors import open_source
from neuroslam.state.files import save_checked, stored_digest

ELLIPSE = "world:ellipse?laps=2&width=256&height=64"
CORRIDOR = "world:corridor?width=64&height=40&frames_per_lap=60&laps=1"


def lived(source, start, stop, *stored) -> NavigationBrain:
    brain = NavigationBrain(BrainConfig())
    brain.about = (source, "small", "2020-02-02")
    for one in stored:
        brain.store(one)
    for frame in open_source(source).frames(start, stop):
        brain(frame)
    return brain


@pytest.fixture(scope="module")
def joined(tmp_path_factory):
    """Two sessions in one map, and another that was not met."""
    first, other = lived(ELLIPSE, 0, 300), lived(CORRIDOR, 0, 20)
    brain = lived(ELLIPSE, 320, 450, first, other)
    assert (len(brain.sessions.merges), len(brain.stored)) == (1, 1)
    file = tmp_path_factory.mktemp("joined") / "brain.safetensors"
    save_brain(brain, file)
    return file


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "run"
    run(CORRIDOR, out, stop=60, tensorboard=False)
    return out


def save(config, state, file):
    """Write a state as it is, with the digest that it has."""
    save_checked(file, {"format": FORMAT_VERSION, "config": config.model_dump(mode="json")}, state)


def damaged(file, to, alter) -> list[str]:
    config, state = read_checkpoint(file)
    alter(state)
    save(config, state, to)
    return verify(to)


@pytest.fixture(scope="module")
def folder_with_landmarks(tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "run"
    source = f"{CORRIDOR}&ranges=36&markers=12&landmark_reach=6"
    run(source, out, build_config(read_preset("full")), stop=40, tensorboard=False)
    return out


def test_a_healthy_brain_has_no_faults(joined, folder):
    assert verify(joined) == []
    assert verify(folder) == []
    assert verify(folder / "brain.safetensors") == []


def test_a_brain_that_has_seen_nothing_has_no_faults_and_no_extent(tmp_path):
    save_brain(NavigationBrain(), tmp_path / "new.safetensors")
    assert verify(tmp_path / "new.safetensors") == []
    rows = dict(inspect(tmp_path / "new.safetensors"))
    assert (rows["experiences"], rows["extent"]) == ("0", "0.00 m x 0.00 m")


def test_goals_with_and_without_a_time_are_no_faults(tmp_path):
    brain = lived(CORRIDOR, 0, 30)
    brain.map.add_goal(0)
    brain.map.add_goal(1, 10.0)
    brain.start_new_map()
    save_brain(brain, tmp_path / "brain.safetensors")
    assert verify(tmp_path / "brain.safetensors") == []


def test_tables_hold_the_bindings_the_goals_and_the_rates_of_a_brain(joined, tmp_path, call):
    brain = load_brain(joined)
    brain.map.add_goal(3)
    save_brain(brain, tmp_path / "brain.safetensors")
    done = call("inspect", tmp_path / "brain.safetensors", "--tables", tmp_path / "tables")
    written = {path.name for path in (tmp_path / "tables").iterdir()}
    assert (done.code, f"Written: {len(written)} tables" in done.out) == (0, True), done.out
    assert "stored.0.map.experiences.csv" in written

    def column(file, name):
        with (tmp_path / "tables" / file).open(newline="") as opened:
            return [float(row[name]) for row in csv.DictReader(opened)]

    assert (
        column("pose_cells.bindings.csv", "x") == brain.populations["pose"].bindings["x"].tolist()
    )
    assert column("map.goals.csv", "experience") == [3.0]
    assert column("map.goals.csv", "until_s") == [math.inf]
    assert column("map.experiences.csv", "pose_1") == brain.map.poses[:, 1].tolist()
    assert sum(column("pose_cells.rates.csv", "rate")) == pytest.approx(1.0, abs=1e-5)
    assert "pixels" not in (tmp_path / "tables" / "view.templates.csv").read_text()
    inside = call("inspect", joined, "--tables", joined / "tables")
    assert (inside.code, "cannot be written" in inside.err) == (2, True)
    refused = call("inspect", joined, "--tables", joined)
    assert (refused.code, "is a file; expected a folder" in refused.err) == (2, True)


def test_the_table_of_a_brain_lists_its_content(joined):
    brain, rows = load_brain(joined), inspect(joined)
    told = dict(rows)
    assert told["experiences"] == str(brain.map.n)
    assert told["templates"] == str(brain.view.n)
    assert told["links"] == str(brain.map.n_links)
    assert told["loop closures"] == "1"  # where the two maps meet
    assert told["frames seen"] == "430"
    assert told["format"] == str(FORMAT_VERSION)
    assert told["SHA-256"] == stored_digest(joined)
    assert told["size"] == f"{joined.stat().st_size} bytes"
    width, height = np.ptp(brain.map.poses[:, :2], axis=0)
    assert told["extent"] == f"{width:.2f} m x {height:.2f} m"
    assert told["length of all links"] == f"{brain.map.links.distance_m.sum():.2f} m"
    assert told["view"] == "60 x 10 px of grey, threshold 0.05"
    assert told["pose cells"] == "21 x 21 x 36, 0.25 m"
    first, second = brain.sessions.sessions
    [merge] = brain.sessions.merges
    made = {s.id: (brain.map.origins().session == s.id).sum() for s in (first, second)}
    about = f"{ELLIPSE}, preset small, recorded 2020-02-02, "
    assert told[f"session {first.name}"] == (
        f"{about}300 frames from frame 0, {made[first.id]} experiences, began: start"
    )
    assert told[f"session {second.name}"] == (
        f"{about}130 frames from frame 320, {made[second.id]} experiences "
        f"({brain.map.aliases.n} merged into those of other sessions), began: start"
    )
    text = told[f"merge at frame {merge['at_frame']}"]
    assert text.startswith(f"session {second.name} into {first.name}, 4 experiences agree, ")
    assert text.endswith(f"map turned by {np.degrees(merge['rotation_rad']):.1f} degrees")
    assert told["refused merges"] == "0"
    stored = brain.stored[0]
    assert told["stored map 0, not joined"].startswith(
        f"sessions {stored.sessions.now.name}: {stored.view.n} templates, "
        f"{stored.map.n} experiences, "
    )


@pytest.mark.parametrize("cells", [("place",), ("semantic",)])
def test_views_and_pose_cells_are_not_listed_for_a_brain_without(cells, tmp_path):
    save_brain(NavigationBrain(BrainConfig(cells=cells)), tmp_path / "brain.safetensors")
    told = dict(inspect(tmp_path / "brain.safetensors"))
    assert told["cells"] == cells[0]
    assert not {"view", "templates", "pose cells"} & told.keys()


def put(name, row, value):
    def alter(state):
        if state[name].dim():
            state[name][row] = value
        else:
            state[name].fill_(value)

    return alter


def cut(name):
    return lambda state: state.update({name: state[name][:-1].clone()})


def copy_row(table, row, to, *names):
    def alter(state):
        for name in names:
            state[f"{table}.{name}"][to] = state[f"{table}.{name}"][row]

    return alter


def log(alter_log):
    def alter(state):
        text = json.loads(bytes(state["sessions.text"].tolist()))
        alter_log(text["sessions"])
        state["sessions.text"] = torch.tensor(list(json.dumps(text).encode()), dtype=torch.uint8)

    return alter


def torn(state):
    """Links 50 to 59 are there once more instead: experiences 51 to 60 have no link."""
    for name in ("source", "target"):
        column = state[f"map.links_table.{name}"]
        column[50:60] = column[:10]


DAMAGE = {
    "view": (put("map.experiences.template", 7, 999), "experiences 7: template 999, the map has"),
    "no view": (put("map.experiences.template", 7, -1), "experiences 7: template -1, the map has"),
    "unbound": (
        lambda state: [
            cut(f"pose_cells.bindings.{c}")(state) for c in ("x", "y", "theta", "decay")
        ],
        "views, 120 of them bound to pose cells",
    ),
    "link from": (put("map.links_table.source", 5, -3), "links 5: source -3, the map has"),
    "link to": (put("map.links_table.target", 5, 4000), "links 5: target 4000, the map has"),
    "loop": (put("map.links_table.source", 5, 6), "links 5: lead from an experience to itself, 6"),
    "back in space": (put("map.links_table.distance_m", 3, -0.5), "links 3: distance_m -0.5 is n"),
    "back in time": (put("map.links_table.duration_s", 3, -2.0), "links 3: duration_s -2 is neg"),
    "current": (put("map.state.current", 0, 4000), "map.state.current: is 4000; expected 0 to"),
    "nowhere": (put("map.state.current", 0, -1), "map.state.current: is -1; expected 0 to"),
    "last view": (put("view.last.template", 0, 999), "view.last.template: is 999; expected -1"),
    "last bound": (put("pose_cells.last.view", 0, -2), "pose_cells.last.view: is -2, expected"),
    "silent": (put("pose_cells.window", ..., 0.0), "pose_cells.window: adds up to 0, expected 1"),
    "window": (
        lambda state: state.update({"pose_cells.window": torch.full((37, 1, 1), 1.0 / 37)}),
        "pose_cells.window: (37, 1, 1) cells do not fit the torus of (36, 21, 21)",
    ),
    "origin": (put("pose_cells.origin", 2, 21), "21) is not on the torus of (36, 21, 21)"),
    "bound": (put("pose_cells.bindings.y", 4, 30.0), "pose_cells.bindings.y: rows 4 are not on"),
    "cell": (put("map.experiences.cell", 6, -1.0), "map.experiences.cell[2]: rows 6 are not on"),
    "twice": (
        copy_row("map.experiences", 3, 9, "session", "number"),
        "experiences 3, 9: each is experience 3 of ",
    ),
    "alias twice": (
        copy_row("map.aliases", 0, 2, "session", "number"),
        "aliases 0, 2: each is experience ",
    ),
    "alias": (put("map.aliases.experience", 1, 500), "aliases 1: experience 500, the map has"),
    "number": (put("map.experiences.number", 3, -1), "experiences 3: number -1 in their session"),
    "session": (
        put("map.experiences.session", 3, 255),
        "experiences 3: of a session that is not in the log, 00000000ff",
    ),
    "log": (log(lambda sessions: sessions.pop(0)), "of a session that is not in the log"),
    "log twice": (
        log(lambda sessions: sessions.insert(0, sessions[0])),
        "is listed more than once",
    ),
    "log order": (log(lambda sessions: sessions.reverse()), "map.state.session: is "),
    "log damaged": (put("sessions.text", 0, 0), "sessions.text: not a log of sessions"),
    "log strange": (log(lambda s: s[0].update(mood="fine")), "sessions.text: not a log of ses"),
    "made": (put("map.state.made", 0, 1), "in their session, which has created 1"),
    "torn": (torn, "the map is not connected: 11 parts, of "),
    "column": (
        cut("map.links_table.duration_s"),
        "map.links_table: columns of different lengths: source 121, target 121, distance_m 121, "
        "heading_rad 121, facing_rad 121, duration_s 120",
    ),
    "missing": (lambda state: state.pop("clock.frame"), "clock.frame: missing"),
    "more": (
        lambda state: state.update({"mood": torch.ones(1)}),
        "mood: not part of a brain",
    ),
    "strange": (
        lambda state: state.update({"stored.x": torch.ones(1)}),
        "stored.x: not part of a brain",
    ),
    "type": (
        lambda state: state.update({"clock.frame": torch.tensor(1.0)}),
        "clock.frame: torch.float32; expected torch.int64",
    ),
    "shape": (
        lambda state: state.update({"pose_cells.origin": torch.zeros(2, dtype=torch.int64)}),
        "pose_cells.origin: shape (2,); expected one like (3,)",
    ),
    "table's shape": (
        lambda state: state.update({"map.experiences.pose": torch.zeros(122, 2).double()}),
        "map.experiences.pose: shape (122, 2); expected one like (0, 3)",
    ),
    "tally": (
        lambda state: [cut(f"recognition.tally.{name}")(state) for name in ("alike", "agreed")],
        "recognition.tally: 0 rows; expected 1 row, one per stored map",
    ),
    "stored": (
        put("stored.0.map.links_table.target", 0, 77),
        "stored map 0: links 0: target 77, the map has ",
    ),
    "stored number": (
        lambda state: [
            state.update({name.replace("stored.0", "stored.2"): state.pop(name)})
            for name in list(state)
            if name.startswith("stored.0")
        ],
        "stored maps are numbered [2]; expected 0, 1, ...",
    ),
}


@pytest.mark.parametrize("kind", DAMAGE)
def test_damage_is_named(kind, joined, tmp_path):
    alter, expected = DAMAGE[kind]
    faults = damaged(joined, tmp_path / "damaged.safetensors", alter)
    assert any(expected in fault for fault in faults), faults
    assert all(fault and "\n" not in fault for fault in faults)


def test_negative_activity_is_named_by_its_cell(joined, tmp_path):
    faults = damaged(joined, tmp_path / "a", put("pose_cells.window", (1, 2, 3), -0.25))
    assert "pose_cells.window: 1 cells are negative, the first (1, 2, 3)" in faults


def test_ten_faults_of_a_kind_are_one_line(joined, tmp_path):
    at = slice(10, 20)
    [fault] = damaged(joined, tmp_path / "a", put("map.links_table.duration_s", at, -1.0))
    assert fault == (
        "links 10, 11, 12, 13, 14 and 5 more: duration_s -1, -1, -1, -1, -1 and 5 more is negative"
    )


@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_no_number_of_a_brain_may_be_infinite_or_none(data, joined, tmp_path_factory):
    config, state = read_checkpoint(joined)
    floats = sorted(name for name, t in state.items() if t.is_floating_point() and t.numel())
    name = data.draw(st.sampled_from(floats))
    at = data.draw(st.integers(0, state[name].numel() - 1))
    state[name].view(-1)[at] = data.draw(st.sampled_from([np.nan, np.inf, -np.inf]))
    file = tmp_path_factory.mktemp("infinite") / "brain.safetensors"
    save(config, state, file)
    row = at // (state[name].numel() // len(state[name])) if state[name].dim() else None
    told = ": not finite" + ("" if row is None else f" in rows {row}")
    where = name.replace("stored.0.", "stored map 0: ")
    assert f"{where}{told}" in verify(file)


@settings(max_examples=20, deadline=None)
@given(data=st.data())
def test_a_flipped_bit_of_the_content_is_one_fault(data, joined, tmp_path_factory):
    content = bytearray(joined.read_bytes())
    start = 8 + int.from_bytes(content[:8], "little")
    at = data.draw(st.integers(start, len(content) - 1))
    content[at] ^= 1 << data.draw(st.integers(0, 7))
    file = tmp_path_factory.mktemp("flipped") / "brain.safetensors"
    file.write_bytes(content)
    [fault] = verify(file)
    assert "does not match its SHA-256" in fault
    with pytest.raises(CheckpointError, match="does not match its SHA-256"):
        inspect(file)


def test_a_file_that_is_no_brain_is_one_fault(tmp_path):
    (tmp_path / "text").write_text("hello")
    assert len(verify(tmp_path / "text")) == 1
    assert verify(tmp_path / "none") == [f"{tmp_path / 'none'}: no such brain file"]
    assert verify(tmp_path) == [f"{tmp_path / 'brain.safetensors'}: no such brain file"]


def edit(name, change):
    def alter(out):
        lines = (out / name).read_text().splitlines(keepends=True)
        change(lines)
        (out / name).write_text("".join(lines))

    return alter


def raise_x(lines):
    number, x, rest = lines[4].split(",", 2)
    lines[4] = f"{number},{float(x) + 1e-12!r},{rest}"


FOLDER_DAMAGE = {
    "places": (edit("experiences.csv", lambda lines: lines.pop()), "experiences.csv: "),
    "a digit": (edit("experiences.csv", raise_x), "experiences.csv: rows 3 differ from the brain"),
    "links": (edit("links.csv", lambda lines: lines.append("0,0,0,0,0,0,1")), "links.csv: "),
    "header": (edit("links.csv", lambda lines: lines.pop(0)), "links.csv: its columns are '0,1"),
    "text": (edit("links.csv", lambda lines: lines.append("a,b")), "links.csv: cannot be read"),
    "no file": (lambda out: (out / "links.csv").unlink(), "links.csv: cannot be read (No such"),
    "frames": (
        edit("frames.csv", lambda lines: lines.pop()),
        "frames.csv: damaged, 59 whole rows; the brain has seen 60 frames",
    ),
    "half a frame": (
        edit("frames.csv", lambda lines: lines.__setitem__(60, lines[60][:40])),
        "frames.csv: damaged, 59 whole rows; the brain has seen 60 frames",
    ),
    "cut off": (
        edit("frames.csv", lambda lines: lines.append(lines[-1])),
        "frames.csv: 61 rows, the brain has seen 60 frames; the run was cut off: resume it",
    ),
    "no frames": (
        edit("frames.csv", lambda lines: lines.__delitem__(slice(1, None))),
        "frames.csv: damaged, 0 whole rows; the brain has seen 60 frames",
    ),
    "track": (
        edit("trajectory.tum", lambda lines: lines.append("x y\n")),
        "trajectory.tum, line 61: got 'x y', not numbers",
    ),
    "short track": (
        edit("trajectory.tum", lambda lines: lines.pop()),
        "trajectory.tum: 59 poses; expected 60",
    ),
    "other track": (
        edit("trajectory.tum", lambda lines: lines.__setitem__(59, "9 9 9 0 0 0 0 1\n")),
        "trajectory.tum: poses 59 differ from the brain",
    ),
    "trace": (
        lambda out: (out / "trace.f64").unlink(),
        "trace.f64: missing; expected the folder of a run",
    ),
    "no plan": (
        lambda out: (out / "config.toml").unlink(),
        "config.toml: missing; it holds the source",
    ),
    "half a plan": (
        lambda out: (out / "config.toml").write_text("cells = ["),
        "config.toml: has no valid [run] table",
    ),
    "half the figures": (
        lambda out: (out / "metrics.json").write_text('{"frames": '),
        "metrics.json: damaged (Expecting value",
    ),
}


@pytest.mark.parametrize("kind", FOLDER_DAMAGE)
def test_files_that_disagree_with_the_brain_are_named(kind, folder, tmp_path):
    alter, expected = FOLDER_DAMAGE[kind]
    out = shutil.copytree(folder, tmp_path / "run")
    alter(out)
    [fault] = verify(out)
    assert expected in fault
    assert str(out) in fault


def test_a_run_with_landmarks_has_no_faults(folder_with_landmarks):
    rows = (folder_with_landmarks / "landmarks.csv").read_text().splitlines()[1:]
    assert len(rows) >= 4  # there is something to compare
    assert verify(folder_with_landmarks) == []


def change(row, column, to):
    """Change a value of a row of landmarks.csv."""

    def alter(lines):
        cells = lines[row].rstrip("\n").split(",")
        cells[column] = to(cells[column])
        lines[row] = ",".join(cells) + "\n"

    return alter


LANDMARK_DAMAGE = {
    "name": (change(2, 0, lambda _: "landmark_99"), "rows 1 differ from the brain"),
    "place": (change(2, 1, lambda x: repr(float(x) + 1e-12)), "rows 1 differ from the brain"),
    "no number": (change(2, 1, lambda _: "far"), "cannot be read (could not convert string to"),
    "no row": (lambda lines: lines.pop(), " as in the brain"),
    "no value": (
        lambda lines: lines.__setitem__(1, "landmark_0,1.0\n"),
        "cannot be read (a row has 2 values; expected 7)",
    ),
}


@pytest.mark.parametrize("kind", LANDMARK_DAMAGE)
def test_landmarks_that_disagree_with_the_brain_are_named(kind, folder_with_landmarks, tmp_path):
    alter, expected = LANDMARK_DAMAGE[kind]
    out = shutil.copytree(folder_with_landmarks, tmp_path / "run")
    edit("landmarks.csv", alter)(out)
    [fault] = verify(out)
    assert fault.startswith(f"{out / 'landmarks.csv'}: ")
    assert expected in fault


def test_a_folder_of_merged_maps_has_no_frames(joined, tmp_path):
    """A merge sees nothing: a header is all there is in its frames.csv, and there is no track."""
    brain = load_brain(joined)
    shutil.copy(joined, tmp_path / "brain.safetensors")
    (tmp_path / "experiences.csv").write_text(experiences_csv(brain))
    (tmp_path / "links.csv").write_text(links_csv(brain.map.links))
    (tmp_path / "frames.csv").write_text(FRAME_COLUMNS + "\n")
    (tmp_path / "config.toml").write_text(RunPlan("world:corridor").to_toml())
    (tmp_path / "metrics.json").write_text(json.dumps(RunSummary().to_dict()))
    assert verify(tmp_path) == []


def test_verifying_changes_nothing(folder):
    before = {p.name: p.read_bytes() for p in folder.iterdir() if p.is_file()}
    assert (verify(folder), dict(inspect(folder))["frames seen"]) == ([], "60")
    assert {p.name: p.read_bytes() for p in folder.iterdir() if p.is_file()} == before
