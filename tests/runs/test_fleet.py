"""`neuroslam fleet`: each robot maps its own session, then the maps are merged as a tree."""

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest

from neuroslam import load_brain
from neuroslam.config import BrainConfig
from neuroslam.errors import RunError, WriteError
from neuroslam.runs.files import RUN_FILES, TIMINGS
from neuroslam.runs.fleet import FleetReport, Part, _names, _pairs, fleet
from neuroslam.runs.manifest import MANIFEST
from neuroslam.state.files import tensors_digest

LOOK = "width=128&height=32"
RING = f"world:ellipse?laps=0.4&noise=0.01&{LOOK}"
ELSEWHERE = f"world:corridor?laps=0.2&{LOOK}"
# Neighbours of the first level lie opposite each other on the ring: they do not meet.
SOURCES = [f"{RING}&start={start}&seed={seed}" for seed, start in enumerate((0.0, 0.5, 0.25, 0.75))]


def digest(folder: Path) -> str:
    return tensors_digest(load_brain(folder / "brain.safetensors").state_dict())


def without_timings(report: dict) -> dict:
    sessions = [{k: v for k, v in r.items() if k not in TIMINGS} for r in report["sessions"]]
    return report | {"sessions": sessions}


@pytest.fixture(scope="module")
def done(tmp_path_factory) -> tuple[Path, FleetReport]:
    out = tmp_path_factory.mktemp("fleet") / "out"
    return out, fleet([*SOURCES, ELSEWHERE], out)


def overlapping():
    """Two of the drives, longer: they share a quarter of the ring, which turns by 90 degrees."""
    longer = (SOURCES[i].replace("laps=0.4", "laps=0.5") for i in (0, 2))
    return [f"{source}&frames_per_lap=200" for source in longer]


# --- the tree -----------------------------------------------------------------------------------


def test_neighbours_are_paired_first_and_each_once():
    parts = [Part(str(k), (k,)) for k in range(5)]
    pairs = [(a.sessions[0], b.sessions[0]) for a, b in _pairs(parts, set())]
    assert pairs == [(0, 1), (2, 3)]
    tried = {(parts[0], parts[1]), (parts[2], parts[3])}
    again = [(a.sessions[0], b.sessions[0]) for a, b in _pairs(parts, tried)]
    assert again == [(1, 2), (3, 4)]
    every = {(a, b) for i, a in enumerate(parts) for b in parts[i + 1 :]}
    assert list(_pairs(parts, every)) == []


def test_a_refused_map_is_tried_with_another_of_the_level(done):
    _, report = done
    first = [row for row in report.tree if row["level"] == 1]
    tried = [(row["first"], row["second"], row["merged"]) for row in first]
    assert tried[:2] == [([1], [2], False), ([3], [4], False)]
    assert ([2], [3], True) in tried
    assert ([1], [4], True) in tried
    assert all(row["reason"] and len(row["reports"]) >= 1 for row in report.tree)


def test_matching_maps_become_one_and_the_others_have_a_reason(done):
    out, report = done
    assert report.merged["sessions"] == [1, 2, 3, 4]
    (apart,) = report.apart
    assert apart["sessions"] == [5]
    assert apart["folder"] == "sessions/5"
    assert any(reason.startswith("with 1+2+3+4: no view") for reason in apart["reasons"])
    assert json.loads((out / "fleet.json").read_text()) == report.to_dict()


def test_the_merged_map_is_the_folder_of_a_merge(done, call):
    out, report = done
    assert {path.name for path in (out / "merged").iterdir()} == {*RUN_FILES, MANIFEST}
    assert call("verify", out / "merged").code == 0
    brain = load_brain(out / "merged" / "brain.safetensors")
    alone = [load_brain(out / "sessions" / str(k) / "brain.safetensors") for k in (1, 2, 3, 4)]
    assert {s.id for s in brain.sessions.sessions} == {b.sessions.now.id for b in alone}
    assert brain.map.n == report.merged["experiences"] < sum(b.map.n for b in alone)
    made_in = out / report.merged["made_in"]
    for name in RUN_FILES:
        assert (made_in / name).read_bytes() == (out / "merged" / name).read_bytes()


def test_the_merged_map_lies_where_the_ring_is(done):
    _, report = done
    assert report.merged["ate_rmse_m"] < 0.2  # of 32 m a lap
    for row in report.sessions[:4]:
        assert row["ate_merged_m"] < 0.2
    assert "ate_merged_m" not in report.sessions[4]


def test_two_jobs_give_the_maps_of_one_job(done, tmp_path):
    out, report = done
    told = []
    two = fleet(
        [*SOURCES, ELSEWHERE], tmp_path / "two", jobs=2, on_done=lambda *seen: told.append(seen)
    )
    assert without_timings(two.to_dict()) == without_timings(report.to_dict())
    folders = [row["folder"] for row in (*report.sessions, *report.tree) if "folder" in row]
    for folder in (*folders, "merged"):
        assert digest(tmp_path / "two" / folder) == digest(out / folder)
        for name in ("frames.csv", "trace.f64", "experiences.csv", "links.csv", "trajectory.tum"):
            mine = (tmp_path / "two" / folder / name).read_bytes()
            assert mine == (out / folder / name).read_bytes()
    assert (tmp_path / "two" / "fleet.png").read_bytes() == (out / "fleet.png").read_bytes()
    assert told[4] == ("sessions", 5, 5)
    assert {what for what, _, _ in told[5:]} == {f"merges, level {k}" for k in (1, 2, 3)}


def test_the_legend_names_every_source_and_marks_those_without_an_experience():
    sources = ("a/monday.mp4", "b/c/tuesday.mp4", "world:ellipse?look=$1", "gone.mp4")
    report = FleetReport(
        [
            {"session": k, "source": source, "error": "no such file" if k == 4 else ""}
            for k, source in enumerate(sources, start=1)
        ]
    )
    assert _names(report, {1, 3}) == [
        "1: a/monday.mp4",
        "2: c/tuesday.mp4, no experience of its own",
        r"3: world:ellipse?look=\$1",
        "4: gone.mp4, failed",
    ]


# --- the command --------------------------------------------------------------------------------


def test_a_fleet_on_one_map_is_exit_0_and_one_that_is_not_3(tmp_path, call):
    given = overlapping()
    joined = call("fleet", *given, "-o", tmp_path / "one", "--set", "view.threshold=0.06")
    assert (joined.code, joined.err) == (0, "")
    assert "one map of sessions 1, 2: " in joined.out
    assert joined.out.endswith(f"Written: {tmp_path / 'one'}\n")
    apart = call("fleet", given[0], ELSEWHERE, "-o", tmp_path / "two")
    assert (apart.code, apart.err) == (3, "")
    assert apart.out.count("stays apart: ") == 2
    assert not (tmp_path / "two" / "merged").exists()
    assert json.loads((tmp_path / "two" / "fleet.json").read_text())["merged"] == {}
    # The places that must agree go into the config, as for `run`.
    strict = call("fleet", *given, "-o", tmp_path / "one", "--overwrite", "--confirm", "900")
    assert strict.code == 3
    assert "expected 900 (--confirm)" in strict.out
    assert not (tmp_path / "one" / "merged").exists()


def test_without_a_preset_all_robots_have_what_is_estimated_from_the_first(tmp_path, call):
    given = overlapping()
    done = call("fleet", tmp_path / "nowhere.avi", *given, "-o", tmp_path / "out")
    assert done.out.count("auto: views of ") == 1  # of the first that can be read
    values = [
        tomllib.loads((tmp_path / "out/sessions" / name / "config.toml").read_text())
        for name in "23"
    ]
    assert all(one.pop("run") for one in values)
    assert values[0] == values[1]
    assert values[0]["map"]["closure"] == "sequence"


def test_a_failed_session_is_reported_in_one_line_and_stops_no_other(tmp_path, call):
    out = tmp_path / "out"
    given = overlapping()
    done = call("fleet", given[0], tmp_path / "nowhere.avi", given[1], "-o", out,
                "--set", "view.threshold=0.06")  # fmt: skip
    assert done.code == 2
    assert done.err.startswith("neuroslam fleet: session 2: ")
    assert done.err.count("\n") == 1
    report = json.loads((out / "fleet.json").read_text())
    assert report["merged"]["sessions"] == [1, 3]
    assert "no such file or folder" in report["sessions"][1]["error"]
    both = call("fleet", tmp_path / "a.avi", tmp_path / "b.avi", "-o", tmp_path / "none")
    assert both.code == 2
    assert both.err.count("\n") == 2


def test_mistakes_are_one_line_and_nothing_is_lost(done, tmp_path, mistake):
    out, _ = done
    before = digest(out / "merged")
    assert "got 1 source; expected at least 2" in mistake("fleet", RING, "-o", tmp_path / "a")
    assert "holds a fleet.json already" in mistake("fleet", *SOURCES, "-o", out)
    wrong = ["--set", "view.treshold=1", "--overwrite"]
    assert "view.treshold" in mistake("fleet", *SOURCES, "-o", out, *wrong)
    assert digest(out / "merged") == before
    with pytest.raises(RunError, match="expected 1 or more"):
        fleet(SOURCES[:2], tmp_path / "b", jobs=0)


def test_more_sessions_than_colours_can_be_drawn(tmp_path):
    sources = [f"world:ellipse?laps=0.1&frames_per_lap=60&look={k}&{LOOK}" for k in range(7)]
    report = fleet(sources, tmp_path / "out", BrainConfig(view={"threshold": 0.01}))
    assert len(report.apart) == 7
    assert (tmp_path / "out" / "fleet.png").stat().st_size > 10_000
    assert np.all([part["reasons"] for part in report.apart])


def test_a_disk_that_is_full_at_a_merge_ends_a_fleet_and_the_earlier_one_stays(
    tmp_path, monkeypatch
):
    def full(*_arguments, **_options):
        raise WriteError("merges/1-1: cannot be written (No space left on device)")

    (tmp_path / "sessions").mkdir()
    (tmp_path / "fleet.json").write_text("{}")
    monkeypatch.setattr("neuroslam.runs.fleet.merge_runs", full)
    monkeypatch.setattr("neuroslam.runs.fleet.run_one", lambda *_a, **_o: {"error": ""})
    monkeypatch.setattr("neuroslam.runs.fleet.figures", lambda *_a: {"error": ""})
    with pytest.raises(WriteError, match="No space left"):
        fleet(SOURCES[:2], tmp_path, overwrite=True)
    assert (tmp_path / "fleet.json").read_text() == "{}"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["fleet.json", "sessions"]
