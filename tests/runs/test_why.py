"""Why a frame closed a loop or not, with the numbers of that instant."""

import csv

import pytest

from neuroslam.config import build_config
from neuroslam.errors import RunError
from neuroslam.runs.run import run
from neuroslam.runs.why import why

WORLD = "world:corridor?frames_per_lap=60&laps=1.5&width=160&height=120&grey=true"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("why") / "run"
    config = build_config({"sessions": {"kidnapped": "ignore"}, "view": {"threshold": 0.06}})
    run(WORLD, out, config, tensorboard=False)
    return out


@pytest.fixture(scope="module")
def rows(folder):
    return list(csv.DictReader((folder / "frames.csv").read_text().splitlines()))


def test_a_loop_that_was_closed_passed_every_check(folder, rows):
    loop = next(int(r["frame"]) for r in rows if r["action"] == "link" and int(r["frame"]) >= 55)
    found = why(folder, loop)
    assert found.closed
    assert "A loop was closed to experience" in found.verdict
    assert all(check.passed for check in found.checks)
    assert found.experience == int(rows[loop]["experience"])


def test_a_new_place_is_stopped_by_its_match_error_with_the_number_of_the_run(folder, rows):
    new = next(r for r in rows if r["action"] == "create" and int(r["frame"]) > 52)
    found = why(folder, int(new["frame"]))
    assert not found.closed
    assert "stopped by 'match error" in found.verdict
    error = next(check for check in found.checks if check.name == "match error")
    assert error.value > error.limit == 0.06
    best = next(check for check in found.checks if "best of all" in check.name)
    assert best.limit == pytest.approx(float(new["match_error"]), abs=1e-9)


@pytest.mark.parametrize("frame", [0, 10])
def test_at_the_start_there_is_nothing_to_return_to(folder, frame):
    found = why(folder, frame)
    assert "'earlier views, of places not visited for 5 s', 0" in found.verdict
    assert (found.candidate, found.experience) == (-1, -1)
    assert found.template is None


def test_a_view_that_matches_where_the_pose_cells_are_elsewhere_says_so(folder):
    other = folder.parent / "far"
    config = build_config(
        {"sessions": {"kidnapped": "ignore"}, "view": {"threshold": 0.06},
         "pose_cells": {"inject_energy": 1e-3}}
    )  # fmt: skip
    run(WORLD + "&noise=0.3", other, config, tensorboard=False)
    rows = csv.DictReader((other / "frames.csv").read_text().splitlines())
    new = [int(r["frame"]) for r in rows if r["action"] == "create" and int(r["frame"]) > 60]
    verdicts = [why(other, frame).verdict for frame in new[:3]]
    assert any("stopped by 'distance in the pose cells'" in verdict for verdict in verdicts)


def test_the_command_prints_the_checks_and_draws_the_two_views(call, mistake, folder, tmp_path):
    done = call("why", folder, 70, "-o", tmp_path / "why.png")
    assert done.code == 0
    assert "match error" in done.out
    assert (tmp_path / "why.png").stat().st_size > 10_000
    assert "frame 100000 is not in its source" in mistake("why", folder, 100_000)
    with pytest.raises(RunError, match="has no frame -1"):
        why(folder, -1)
