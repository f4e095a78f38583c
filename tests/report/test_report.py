"""A page that explains a run: it says what the run's files say, whatever they are called."""

import base64
import csv
import json
import os
import re
import shutil
import subprocess
import sys
import zlib
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest

from neuroslam import BrainConfig, load_brain
from neuroslam.cli import main
from neuroslam.merging.report import MergeReport
from neuroslam.report import collect, write_report
from neuroslam.report.collect import chosen_rows
from neuroslam.report.pictures import base64_size, take_pictures
from neuroslam.report.reading import Curve, read_run
from neuroslam.report.rows import config_rows, metric_rows
from neuroslam.runs.plan import plan
from neuroslam.runs.run import resume, run
from neuroslam.sensors import open_source

WORLD = "world:ellipse?laps=2&width=96&height=24&frames_per_lap=90&people=2"
QUICK = "--no-tensorboard"
POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:"


class Page(HTMLParser):
    """What a browser would be given: elements, and the text of those with an id."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.elements, self.texts, self._inside = [], {}, None
        self.source = path.read_text(encoding="utf-8")
        self.feed(self.source)
        self.about = json.loads(self.texts["about"])
        self.pictures = json.loads(self.texts["pictures"])
        data = zlib.decompress(base64.b64decode(self.texts["arrays"]))
        self.arrays = {
            name: np.frombuffer(data, kind, int(np.prod(shape)), at).reshape(shape)
            for name, (kind, shape, at) in self.about["arrays"].items()
        }

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        self._inside = dict(attrs).get("id") or tag

    def handle_endtag(self, tag):
        self._inside = None

    def handle_data(self, data):
        if self._inside:
            self.texts[self._inside] = self.texts.get(self._inside, "") + data


def table(path):
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    return {name: [row[name] for row in rows] for name in rows[0]}


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A whole drive, two that overlap and their merges, an animal's walk, and motion alone."""
    folder = tmp_path_factory.mktemp("runs")
    (folder / "motion.csv").write_text(
        "time_s,v_m_s,w_rad_s\n" + "".join(f"{0.1 * i},0.5,0.2\n" for i in range(40))
    )
    for name, *arguments in (
        ("whole", WORLD, "--preset", "ratslam"),
        ("a", WORLD, "--preset", "ratslam", "--stop", "70", QUICK),
        (
            "b",
            WORLD,
            "--preset",
            "ratslam",
            "--start",
            "40",
            "--stop",
            "100",
            QUICK,
            "--set",
            "map.loops=5",
        ),
        ("rat", "arena:square?minutes=1&noise=1", "--preset", "slrb"),
        ("blind", str(folder / "motion.csv"), QUICK),
    ):
        assert main(["run", *arguments, "-o", str(folder / name)]) == 0
    assert main(["merge", *(str(folder / x) for x in "ab"), "-o", str(folder / "merged")]) == 0
    files = [str(folder / x / "brain.safetensors") for x in "ab"]
    assert main(["merge", *files, "-o", str(folder / "brains")]) == 0
    return folder


@pytest.fixture(scope="module")
def pages(runs, tmp_path_factory):
    """A page of each."""
    folder = tmp_path_factory.mktemp("pages")
    names = ("whole", "b", "merged", "brains", "rat", "blind")
    return {name: write_report(runs / name, folder / f"{name}.html", source=True) for name in names}


@pytest.fixture(scope="module")
def whole(pages):
    return Page(pages["whole"])


def test_a_page_holds_every_row_of_frames_csv(runs, whole):
    frames, rows = table(runs / "whole" / "frames.csv"), whole.arrays
    for name in ("frame", "template", "n_templates", "n_experiences", "n_links"):
        assert rows[f"row_{name}"].tolist() == [int(value) for value in frames[name]]
    assert rows["row_time_s"].tolist() == [float(value) for value in frames["time_s"]]
    for name in ("v_m_s", "w_rad_s", "match_error", "pose_x", "pose_y", "pose_theta"):
        np.testing.assert_array_equal(rows[f"row_{name}"], np.float32(frames[name]))
    assert [whole.about["actions"][i] for i in rows["row_action"]] == frames["action"]


def test_a_page_holds_every_place_and_link_of_the_final_map(runs, whole):
    places, links = (table(runs / "whole" / f"{name}.csv") for name in ("experiences", "links"))
    for name in ("x_m", "y_m", "theta_rad"):
        np.testing.assert_array_equal(whole.arrays[f"place_{name}"], np.float32(places[name]))
    for name in ("template", "first_frame"):
        assert whole.arrays[f"place_{name}"].tolist() == [int(value) for value in places[name]]
    assert whole.arrays["link_from"].tolist() == [int(value) for value in links["from"]]
    assert whole.arrays["link_to"].tolist() == [int(value) for value in links["to"]]
    assert whole.arrays["link_loop"].sum() == whole.about["summary"]["loop_closures"] > 0


def test_the_path_is_that_on_the_final_map(runs, whole):
    track = np.loadtxt(runs / "whole" / "trajectory.tum")
    np.testing.assert_allclose(whole.arrays["row_x_m"], track[:, 1], atol=1e-5)
    np.testing.assert_allclose(whole.arrays["row_y_m"], track[:, 2], atol=1e-5)


def test_a_frame_is_at_the_place_that_frames_csv_names_where_nothing_was_merged(runs, whole):
    frames = table(runs / "whole" / "frames.csv")
    assert whole.arrays["row_place"].tolist() == [int(value) for value in frames["experience"]]


def test_a_page_asks_nothing_of_the_network(pages):
    for path in pages.values():
        page = Page(path)
        assert not re.findall(r"https?://|//[a-z]+\.[a-z]", page.source.replace(POLICY, ""))
        (policy,) = (a["content"] for _, a in page.elements if a.get("http-equiv"))
        assert policy == POLICY
        for tag, attributes in page.elements:
            assert tag not in ("iframe", "object", "embed", "form", "base")
            assert "src" not in attributes
            assert attributes.get("href", "#").startswith(("#", "data:,"))
        loads = r"\b(fetch\(|XMLHttpRequest|WebSocket|import\(|eval\(|innerHTML|@import|url\()"
        assert not re.findall(loads, page.texts["style"] + page.source[-100_000:])


def test_no_path_of_the_machine_is_on_a_page(runs, pages):
    for path in pages.values():
        source = path.read_text()
        assert str(runs) not in source
        assert str(Path.cwd()) not in source


def test_every_element_that_the_scripts_look_for_is_there(whole):
    scripts = whole.source.rpartition("<script>")[2]
    wanted = set(re.findall(r'\$\("([a-z-]+)"\)', scripts))
    ids = [attributes["id"] for _, attributes in whole.elements if "id" in attributes]
    assert wanted <= set(ids)
    assert len(set(ids)) == len(ids)


def test_pictures_are_those_of_the_source(runs, whole):
    finished = read_run(runs / "whole")
    number = whole.arrays["place_picture"]
    assert (number >= 0).all(), "the source is there: every place has its picture"
    data = np.frombuffer(base64.b64decode(whole.pictures[number[3]]), np.uint8)
    shown = cv2.imdecode(data, cv2.IMREAD_COLOR_RGB)
    frame = open_source(WORLD).frame(int(whole.arrays["place_first_frame"][3])).image
    assert shown.shape == frame.shape
    assert np.abs(shown.astype(float) - frame).mean() < 10.0  # of 255: compressed
    assert whole.about["picture_notes"] == []
    frames, pictures = whole.arrays["picture_row"].T
    assert (np.diff(frames) > 0).all()
    assert len(whole.pictures) == len(pictures) == len(finished.actions)


def test_pictures_stay_within_their_budget(runs):
    finished = read_run(runs / "whole")
    some = take_pictures(finished, 30_000)
    size = sum(base64_size(len(file)) for file in some.files)
    assert 15_000 < size <= 30_000
    assert "to limit its size" in some.notes[0]
    frames = some.row[:, 0]
    assert frames[0] == 0
    assert frames[-1] == len(finished.actions) - 1
    assert np.ptp(np.diff(frames)) <= 1 + 0.5 * np.diff(frames).mean()
    none = take_pictures(finished, 0)
    assert none.files == []
    assert (none.place == -1).all()


def test_a_page_without_pictures_is_small(runs, pages, tmp_path):
    small = write_report(runs / "whole", tmp_path / "small.html", pictures_mb=0, source=True)
    assert small.stat().st_size < min(250_000, pages["whole"].stat().st_size)
    assert "without pictures" in Page(small).about["picture_notes"][0]


def test_where_the_source_is_gone_the_page_says_so(tmp_path, runs):
    folder = tmp_path / "pictures"
    folder.mkdir()
    for i in range(6):
        coarse = np.random.default_rng(i).integers(0, 255, (6, 8), np.uint8)
        cv2.imwrite(str(folder / f"{i}.png"), cv2.resize(coarse, (64, 48)))
    run(folder, tmp_path / "out", tensorboard=False)
    before = Page(write_report(tmp_path / "out", source=True))
    assert len(before.pictures) == 6
    shutil.rmtree(folder)
    after = Page(write_report(tmp_path / "out", source=True))
    name = f"{tmp_path.name}/pictures"
    assert after.about["picture_notes"] == [f"No pictures of {name}: it can no longer be opened."]
    assert after.pictures == []
    assert after.arrays["templates"].tobytes() == before.arrays["templates"].tobytes()


def test_names_cannot_break_out_of_their_element(tmp_path):
    folder = tmp_path / "x<"
    folder.mkdir()
    odd = folder / "script><img src=x onerror=alert(1)>&quot;{{about}}\u2028'.csv"
    odd.write_text("time_s,v_m_s,w_rad_s\n0.0,0.5,0.0\n0.1,0.5,0.0\n")
    run(odd, tmp_path / "out", tensorboard=False)
    page = Page(write_report(tmp_path / "out", source=True))
    assert page.about["name"].startswith("x</script><img")
    assert page.source.count("</script>") == 4
    assert not [tag for tag, _ in page.elements if tag == "img"]
    assert page.texts["h1"] == page.about["name"]


def test_templates_on_the_page_are_those_of_the_brain(runs, whole):
    brain = load_brain(runs / "whole" / "brain.safetensors")
    assert len(whole.arrays["templates"]) == brain.view.n
    np.testing.assert_array_equal(whole.arrays["templates"][5], brain.view.template_image(5))


def test_many_templates_are_made_smaller(runs, monkeypatch):
    monkeypatch.setattr(collect, "_TEMPLATE_BYTES", 5_000)
    pictures = collect.template_pictures(load_brain(runs / "whole" / "brain.safetensors"))
    assert 1_000 < pictures.nbytes <= 5_000


def test_of_a_very_long_run_some_frames_are_left_out(runs, monkeypatch):
    monkeypatch.setattr(collect, "MOST_ROWS", 30)
    finished = read_run(runs / "whole")
    facts = collect.collect(finished)
    rows = chosen_rows(finished.actions)
    assert len(rows) < len(finished.actions)
    assert set(np.flatnonzero(finished.actions != "none")) <= set(rows)
    assert facts.arrays["row_frame"][-1] == finished.frames["frame"][-1]
    assert "frames are on this page" in facts.about["notes"][0]
    assert facts.arrays["peak_row"].max() < len(rows)


# --- merged, interrupted, without a camera, without frames ------------------------------------


def test_a_merged_map_has_both_sessions_their_pictures_and_the_report(runs, pages):
    page, brain = Page(pages["merged"]), load_brain(runs / "merged" / "brain.safetensors")
    assert [session["own"] for session in page.about["sessions"]] == [False, True]
    assert set(page.arrays["place_session"].tolist()) == {0, 1}
    (report,) = page.about["merges"]
    assert report["lines"][0].startswith("merged: ")
    assert report["place"] == brain.sessions.merges[-1]["match"]["loaded_experience"]
    assert (page.arrays["place_picture"] >= 0).all(), "of the stored map too"
    assert len(page.arrays["row_frame"]) == 60
    named = {row["key"] for part in page.about["config"] for row in part["rows"] if row["differs"]}
    assert named == {"loops"}


def test_frames_before_a_merge_are_at_places_as_they_are_named_now(runs, tmp_path):
    out = tmp_path / "second"
    run(WORLD, out, maps=[runs / "a"], start=40, tensorboard=False)
    page = Page(write_report(out, pictures_mb=0, source=True))
    (report,) = page.about["merges"]
    rows, frames = page.arrays, table(out / "frames.csv")
    before = rows["row_frame"] < report["frame"]
    assert before.any()
    assert not before.all()
    then = np.array([int(value) for value in frames["experience"]])
    assert (rows["row_place"][~before] == then[~before]).all()
    assert (rows["row_place"][before] != then[before]).any(), "ids of the time have changed"
    x, y = (rows[f"place_{c}_m"][rows["row_place"]] for c in "xy")
    away = np.hypot(rows["row_x_m"] - x, rows["row_y_m"] - y)
    assert away.max() < 1.0, "a frame is near its place"


def test_two_brain_files_make_a_page_without_frames(runs, pages):
    page = Page(pages["brains"])
    assert len(page.arrays["row_frame"]) == 0
    assert len(page.arrays["place_x_m"]) == len(table(runs / "brains" / "experiences.csv")["id"])
    assert "no frames" in page.about["notes"][0]
    assert (page.arrays["place_picture"] >= 0).all(), "their runs are still there"


def test_places_of_a_map_whose_run_is_gone_have_no_pictures(runs, tmp_path):
    shutil.copy(runs / "a" / "brain.safetensors", tmp_path / "old.safetensors")
    out = tmp_path / "out"
    arguments = ["merge", tmp_path / "old.safetensors", runs / "b", "-o", out]
    assert main([str(argument) for argument in arguments]) == 0
    page = Page(write_report(out, source=True))
    own = page.arrays["place_session"] == 1
    assert ((page.arrays["place_picture"] >= 0) == own).all()
    assert page.about["picture_notes"] == [
        f"No pictures of {(~own).sum()} experiences: the folder of the run that made them "
        "has been moved or deleted."
    ]


def test_an_animal_without_a_camera_has_place_cells_and_walls(runs, pages):
    page, cells = Page(pages["rat"]), load_brain(runs / "rat" / "brain.safetensors").navigation
    n = int(cells.place.n_cells)
    np.testing.assert_array_equal(
        page.arrays["cell_x_m"], np.float32(cells.place.centres_m[0, :n, 0])
    )
    assert page.arrays["cell_visits"].sum() >= n
    assert len(page.arrays["wall_x_m"]) == int(cells.walls.n_walls)
    assert "activity_xy" not in page.arrays
    assert page.about["picture_notes"] == ["No pictures of arena:square?minutes=1&noise=1: "
                                           "it has no camera."]  # fmt: skip
    assert len(page.arrays["doubt_s_row"]) > 10
    unused = {part["section"] for part in page.about["config"] if not part["used"]}
    assert unused == {"view", "pose_cells", "semantic"}


def test_motion_alone_makes_a_path_without_places(pages):
    page = Page(pages["blind"])
    assert len(page.arrays["place_x_m"]) == 0
    assert np.isfinite(page.arrays["row_x_m"]).all()
    assert np.ptp(page.arrays["row_x_m"]) > 0.5
    assert (page.arrays["row_place"] == -1).all()


def test_frames_on_a_map_that_was_not_joined_are_nowhere(tmp_path):
    folder, n = tmp_path / "carried", 0
    folder.mkdir()
    for world, stop in (("corridor", 40), ("town", 120)):  # the largest map is drawn
        for frame in open_source(f"world:{world}?width=96&height=48").frames(0, stop):
            cv2.imwrite(str(folder / f"{n:03d}.png"), frame.image[..., ::-1])
            n += 1
    run(folder, tmp_path / "out", tensorboard=False)
    page = Page(write_report(tmp_path / "out", pictures_mb=0, source=True))
    nowhere = np.isnan(page.arrays["row_x_m"])
    assert nowhere[:40].all()
    assert not nowhere[40:].any()
    assert (page.arrays["row_place"] == -1).tolist() == nowhere.tolist()
    (left,) = page.about["not_joined"]
    assert "matched by view" in left["reason"]
    began = [session["began"] for session in page.about["sessions"]]
    assert "kidnapped" in began
    written = (Path(collect.__file__).parent / "tables.js").read_text()
    words = re.search(r"const BEGAN = \{(.*?)\};", written, re.DOTALL)[1]
    assert {*began, "start", "gap"} <= set(re.findall(r"(\w+):", words))


def test_when_an_animal_was_lost_follows_from_its_doubt():
    doubt = Curve(np.arange(0, 80, 10), np.array([0.0, 2, 4, 6, 3, 0, 0, 9]))
    assert collect.spans_above(doubt, 5.0) == [(30, 50), (70, 70)]


def test_a_run_that_was_cut_and_resumed_makes_the_page_of_an_uncut_one(runs, pages, tmp_path):
    out = tmp_path / "cut"
    run(WORLD, out, stop=50)
    assert len(Page(write_report(out, source=True)).arrays["row_frame"]) == 50
    resume(out)
    one, other = Page(write_report(out, source=True)), Page(pages["whole"])
    for name, array in other.arrays.items():
        if not name.startswith("largest_correction"):
            np.testing.assert_array_equal(one.arrays[name], array, err_msg=name)
    assert one.pictures == other.pictures


def test_rows_after_the_last_save_are_left_out(runs, tmp_path):
    out = shutil.copytree(runs / "a", tmp_path / "killed")
    with (out / "frames.csv").open("a") as file:
        file.write((out / "frames.csv").read_text().splitlines()[-1] + "\n70,7.0,0.")
    (out / "trace.f64").write_bytes((out / "trace.f64").read_bytes() + bytes(100))
    assert len(Page(write_report(out, pictures_mb=0, source=True)).arrays["row_frame"]) == 70


def test_a_planned_path_is_on_the_page_as_long_as_its_links_are_on_the_map(runs, tmp_path):
    out = shutil.copytree(runs / "whole", tmp_path / "out")
    path = plan(out, "2", start="9").path
    page = Page(write_report(out, pictures_mb=0))
    assert page.arrays["plan_place"].tolist() == path
    (note,) = (note for note in page.about["notes"] if note.startswith("Planned path"))
    assert note.startswith(f"Planned path: from experience 9 to 2, {len(path) - 1} links, ")
    (out / "plan.csv").write_text("step,experience\n0,0\n1,9\n")  # no link leads from 0 to 9
    page = Page(write_report(out, pictures_mb=0))
    assert "plan_place" not in page.arrays
    assert any("plan.csv is of another map" in note for note in page.about["notes"])


def test_a_page_is_made_alike_every_time(runs, tmp_path):
    one, other = (
        write_report(runs / "rat", tmp_path / name, source=True) for name in ("1.html", "2.html")
    )
    assert one.read_bytes() == other.read_bytes()


def test_a_report_leaves_the_run_as_it_was(runs, tmp_path):
    out = shutil.copytree(runs / "whole", tmp_path / "out")
    before = {p: p.read_bytes() for p in out.rglob("*") if p.is_file()}
    assert write_report(out, source=True) == out / "report.html"
    assert {p: p.read_bytes() for p in before} == before
    assert set(out.rglob("*")) - set(before) - {p for p in out.rglob("*") if p.is_dir()} == {
        out / "report.html"
    }


def test_the_config_marks_what_differs_from_the_defaults():
    config = BrainConfig(view={"threshold": 0.04, "crop": (0, 8, 0, 8)}, threads=2)
    rows = {
        (part["section"], row["key"]): row for part in config_rows(config) for row in part["rows"]
    }
    assert {key for key, row in rows.items() if row["differs"]} == {
        ("view", "threshold"), ("view", "crop"), ("brain", "threads"),
    }  # fmt: skip
    assert rows["view", "crop"] | {"what": ""} == {
        "key": "crop", "value": "0, 8, 0, 8", "default": "none", "differs": True, "what": "",
    }  # fmt: skip
    assert all(row["what"] for row in rows.values() if row["key"] not in ("threads",))


# --- the command, and mistakes ------------------------------------------------------------------


def test_the_command_says_what_it_wrote(runs, tmp_path, call):
    page = tmp_path / "deep" / "page.html"
    done = call("report", runs / "rat", "-o", page, "--pictures", "0")
    assert (done.code, done.err, done.out) == (0, "", f"Written: {page}\n")
    assert page.read_text().startswith("<!doctype html>")


def damaged(runs, tmp_path, name, change):
    out = shutil.copytree(runs / "a", tmp_path / "damaged")
    change(out / name)
    return out


@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        ("metrics.json", lambda p: p.unlink(), "metrics.json: missing"),
        ("metrics.json", lambda p: p.write_text("{}"), "metrics.json: damaged"),
        ("config.toml", lambda p: p.unlink(), "config.toml: missing"),
        ("frames.csv", lambda p: p.unlink(), "frames.csv: missing"),
        ("frames.csv", lambda p: p.write_text("frame\n0\n"), "frames.csv: damaged"),
        ("frames.csv", lambda p: p.write_bytes(b"\xff\xfe\n\xff"), "frames.csv: damaged"),
        ("trace.f64", lambda p: p.unlink(), "trace.f64: missing"),
        ("trace.f64", lambda p: os.truncate(p, 960), "trace.f64: damaged"),
        ("brain.safetensors", lambda p: p.unlink(), "brain.safetensors"),
        ("brain.safetensors", lambda p: os.truncate(p, 999), "brain.safetensors"),
        ("plan.csv", lambda p: p.write_text("step,place\n0,1\n"), "plan.csv: damaged"),
        ("plan.csv", lambda p: p.write_bytes(b"\xff\n\xff"), "plan.csv: damaged"),
    ],
)  # fmt: skip
def test_a_damaged_run_is_one_line_and_no_page(name, change, said, runs, tmp_path, mistake):
    out = damaged(runs, tmp_path, name, change)
    assert said in mistake("report", out)
    assert not (out / "report.html").exists()


def test_what_is_no_run_is_one_line(runs, tmp_path, mistake):
    (tmp_path / "empty").mkdir()
    assert "no such folder" in mistake("report", tmp_path / "nowhere")
    assert "not a run" in mistake("report", tmp_path / "empty")
    assert "is a file" in mistake("report", runs / "a" / "brain.safetensors")


def test_a_page_replaces_neither_a_folder_nor_a_file_of_the_run(runs, tmp_path, mistake):
    brain = runs / "a" / "brain.safetensors"
    before = brain.read_bytes()
    assert "is a file of the run" in mistake("report", runs / "a", "-o", brain)
    assert brain.read_bytes() == before
    landmarks = runs / "a" / "landmarks.csv"
    assert "is a file of the run" in mistake("report", runs / "a", "-o", landmarks)
    assert "is a folder" in mistake("report", runs / "a", "-o", tmp_path)
    assert "cannot be written" in mistake("report", runs / "a", "-o", brain / "page.html")
    assert "--pictures nan" in mistake("report", runs / "a", "--pictures", "nan")


def test_the_page_is_part_of_an_installed_package():
    from importlib.resources import files

    from neuroslam.report.page import SCRIPTS

    folder = files("neuroslam.report")
    assert all((folder / name).is_file() for name in (*SCRIPTS, "page.html", "page.css"))
    assert {p.name for p in folder.iterdir() if p.name.endswith(".js")} == set(SCRIPTS)


def test_ctrl_c_while_a_page_is_made_leaves_the_old_one(runs, tmp_path):
    out = shutil.copytree(runs / "a", tmp_path / "out")
    (out / "report.html").write_text("old")
    program = (
        "import os, signal, sys\n"
        "from neuroslam import cli\n"
        "from neuroslam.report import page\n"
        "page.make_page = lambda *_: os.kill(os.getpid(), signal.SIGINT)\n"
        f"sys.exit(cli.main(['report', {str(out)!r}]))\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 130, done.stderr
    assert (out / "report.html").read_text() == "old"


def test_lengths_of_one_camera_alone_are_in_an_arbitrary_unit_everywhere(tmp_path):
    folder = tmp_path / "pictures"
    folder.mkdir()
    for k in range(6):
        coarse = np.random.default_rng(k).integers(0, 255, (6, 8), np.uint8)
        cv2.imwrite(str(folder / f"{k}.png"), cv2.resize(coarse, (64, 48)))
    run(folder, tmp_path / "out", tensorboard=False)
    page = Page(write_report(tmp_path / "out"))
    assert page.about["unit"] == "arbitrary unit"
    assert not any(unit == "m" for _, _, unit in page.about["metrics"])
    report = MergeReport(True, "x", rotation_rad=0.0, translation_m=[1.0, 2.0])
    assert report.lines("arbitrary unit")[-1].endswith("moved by 1.00, 2.00 arbitrary unit")
    assert report.lines()[-1].endswith("moved by 1.00, 2.00 m")
    assert metric_rows({"ate_rmse_m": 0.2}, "arbitrary unit") == [
        ["ate rmse", 0.2, "arbitrary unit"]
    ]


def test_the_page_knows_how_far_the_pose_cells_were_where_a_view_matched(tmp_path):
    run(WORLD, tmp_path / "out", BrainConfig(sessions={"kidnapped": "ignore"}), tensorboard=False)
    finished = read_run(tmp_path / "out")
    apart = collect.collect(finished).arrays["row_cells_apart"]
    action, limit = finished.actions, finished.brain.config.pose_cells.create_threshold_cells
    assert (action == "link").any()
    assert (apart[action == "link"] <= limit).all()
    matched = np.isfinite(apart)
    new = (action == "create") & (finished.frames["match_error"] > 0.05)
    assert not matched[new].any()
    assert (apart[(action == "create") & matched] > limit).all()
