"""Paths through the map of a run, and the comparison of two maps, from the command line."""

import csv

import numpy as np
import pytest

from neuroslam.brain import NavigationBrain, load_brain, save_brain
from neuroslam.errors import CheckpointError
from neuroslam.geometry import rotate_points
from neuroslam.runs.evaluate import compare_maps
from neuroslam.runs.plan import plan
from neuroslam.runs.run import run

CORRIDOR = "world:corridor?width=64&height=40&frames_per_lap=120&laps=1.2&noise=0.02"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "lap"
    run(CORRIDOR, out, tensorboard=False)
    return out


def rows(file):
    with file.open(newline="") as opened:
        return list(csv.DictReader(opened))


def test_a_path_is_printed_written_and_drawn(folder, tmp_path, call):
    brain = load_brain(folder / "brain.safetensors")
    done = call("plan", folder, 9, "--start", 2, "-o", tmp_path)
    assert (done.code, done.err) == (0, "")
    assert done.out.startswith("From experience 2 to 9: 7 links, ")
    path = rows(tmp_path / "plan.csv")
    assert [int(row["experience"]) for row in path] == brain.map.plan(9, 2).path
    assert [float(row["x_m"]) for row in path] == brain.map.poses[2:10, 0].tolist()
    assert (tmp_path / "plan.png").stat().st_size > 10_000


def test_a_position_is_the_experience_nearest_to_it(folder, tmp_path):
    brain = load_brain(folder / "brain.safetensors")
    x, y = brain.map.poses[7, :2] + [0.02, -0.01]
    found = plan(folder, f"{x},{y}", tmp_path)
    assert found.path[-1] == 7
    assert found.path[0] == brain.map.state.current
    assert found.beside_m == pytest.approx(np.hypot(0.02, 0.01))


def test_a_position_far_off_the_map_is_refused(folder, tmp_path, call):
    done = call("plan", folder, "500,500", "-o", tmp_path)
    assert done.code == 2
    assert "from the nearest experience, and the map is" in done.err
    assert not list(tmp_path.iterdir())


def test_the_path_back_is_as_long(folder, tmp_path):
    there, back = (plan(folder, b, tmp_path, start=a) for a, b in (("3", "20"), ("20", "3")))
    assert there.path == back.path[::-1]
    assert there.length_m == pytest.approx(back.length_m)
    poses = load_brain(folder / "brain.safetensors").map.poses[there.path, :2]
    assert there.length_m >= np.linalg.norm(poses[-1] - poses[0])


def test_a_negative_position_is_no_option(folder, tmp_path, call):
    done = call("plan", folder, "-3,-1", "-o", tmp_path)
    assert (done.code, done.err) == (0, "")


def test_wrong_goals_are_refused_in_one_line(folder, tmp_path, mistake):
    n = load_brain(folder / "brain.safetensors").map.n
    assert f"0 to {n - 1}" in mistake("plan", folder, n, "-o", tmp_path)
    for goal in ("kitchen", "1.2.3,4", ".,1", "nan,1", "1e999,0", "1,2,3", "-4", ""):
        said = mistake("plan", folder, goal, "-o", tmp_path)
        assert "expected the id of an experience" in said, goal
    (tmp_path / "file").write_text("")
    assert "cannot be written" in mistake("plan", folder, 3, "-o", tmp_path / "file")
    save_brain(NavigationBrain(), tmp_path / "empty.safetensors")
    assert "has no experiences" in mistake("plan", tmp_path / "empty.safetensors", 3)


def test_a_map_in_two_parts_is_refused(folder, tmp_path):
    brain = load_brain(folder / "brain.safetensors")
    apart = brain.map.n
    brain.map.state.current = -1
    brain.map.create(0, brain.leader.estimate, frame=brain.clock.frame)
    brain.map.relocalise(0)
    save_brain(brain, tmp_path / "brain.safetensors")
    with pytest.raises(CheckpointError, match="the map is not connected: 2 parts"):
        plan(tmp_path / "brain.safetensors", str(apart))


def test_a_map_that_was_moved_and_scaled_is_found_again(folder, tmp_path, call, mistake):
    brain = load_brain(folder / "brain.safetensors")
    poses = brain.map.poses.copy()
    poses[:, :2] = 1.5 * rotate_points(poses[:, :2], 0.5) + [3.0, -2.0]
    brain.map.experiences["pose"][:] = brain.map.experiences["pose"].new_tensor(poses)
    save_brain(brain, tmp_path / "brain.safetensors")
    (rigid, similar), figure = compare_maps(folder, tmp_path, tmp_path / "both.png")
    assert similar.rmse_m < 0.02 < rigid.rmse_m
    assert similar.scale == pytest.approx(1.5, rel=0.01)
    assert similar.turn_deg == pytest.approx(np.degrees(0.5), abs=1.0)
    assert figure.stat().st_size > 10_000
    assert "give both" in mistake("evaluate", folder, "-o", tmp_path / "again.png")
    truth = "--truth", folder / "trajectory.tum"
    assert "give one of them" in mistake("evaluate", folder, "--against", tmp_path, *truth)
    done = call("evaluate", folder, "--against", tmp_path, "-o", tmp_path / "again.png")
    assert (done.code, "similarity" in done.out) == (0, True)
