"""Robots with a laser: odometry from scans, loops that scans confirm, errors of true relations."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from neuroslam.cli import main
from neuroslam.config import ViewConfig
from neuroslam.errors import RunError
from neuroslam.evaluation.relations import Relations, read_relations, relation_errors
from neuroslam.experiments.laser_robots import VIEW, LaserMapper, open_log, scan_odometry, wheels
from neuroslam.odometry.scans import ScanOdometry
from neuroslam.types import Frame, Velocity

RADISH = Path(__file__).parents[3] / "shared" / "data" / "radish"
BEARINGS = 2 * np.pi * np.arange(360) / 360
SPEED, TURN, DT = 0.5, 0.125, 0.2  # a circle of 4 m in 50 s


def scan_in_room(x, y, theta):
    """Ranges of the half turn ahead in a room of 12 m by 9 m with a pillar in it."""
    direction = np.column_stack([np.cos(BEARINGS + theta), np.sin(BEARINGS + theta)])
    with np.errstate(divide="ignore", invalid="ignore"):
        hits = [
            np.where(direction[:, axis] * side > 0, (half * side - at) / direction[:, axis], np.inf)
            for axis, at, half in ((0, x, 6.0), (1, y, 4.5))
            for side in (-1, 1)
        ]
        for x0 in (-1.0, 1.0):  # the two faces of the pillar across x, and its ends
            r = (x0 - x) / direction[:, 0]
            inside = (r > 0) & (np.abs(y + r * direction[:, 1]) < 0.5)
            hits.append(np.where(inside, r, np.inf))
    ranges = np.min(hits, axis=0)
    ranges[np.cos(BEARINGS) < 0] = np.inf
    return ranges


def circle(n, noise_m=0.01):
    """Yield the true pose and the frame of a robot whose wheels turn 4 % short."""
    rng = np.random.default_rng(0)
    for i in range(n):
        angle = TURN * DT * i
        pose = 4.0 * math.cos(angle) - 0.5, 4.0 * math.sin(angle), angle + math.pi / 2
        ranges = np.abs(scan_in_room(*pose) + noise_m * rng.standard_normal(360))
        velocity = Velocity(SPEED, 0.96 * TURN) if i else Velocity(0.0, 0.0)
        yield pose, Frame(i, DT * i, velocity=velocity, ranges=ranges)


def test_scans_correct_wheels_that_slip():
    odometry, drive = ScanOdometry(), list(circle(250))
    start = drive[0][0]
    for _, frame in drive:
        here = odometry(frame.ranges, frame.velocity, DT)
    true_turn = TURN * DT * 249
    assert abs(here.theta_rad - math.remainder(true_turn, 2 * math.pi)) < math.radians(1.0)
    dx, dy = drive[-1][0][0] - start[0], drive[-1][0][1] - start[1]
    expected = (dy, -dx)  # the robot starts facing left
    assert math.hypot(here.x_m - expected[0], here.y_m - expected[1]) < 0.1  # wheels: 1 m
    assert 0.04 * true_turn > math.radians(14.0)  # what the wheels alone get wrong


def test_a_second_lap_closes_loops_where_the_robot_was():
    mapper, truths = LaserMapper(ViewConfig(**VIEW)), {}
    for pose, frame in circle(360):
        experience, _ = mapper(frame, DT)
        truths.setdefault(experience, pose)
    assert len(mapper.loops) >= 5
    apart = [math.dist(truths[a][:2], truths[b][:2]) for a, b in mapper.loops]
    assert max(apart) < 3.0  # a target may be seen from some way off
    poses = mapper.map.poses
    for new, old in mapper.loops[-5:]:
        found = math.dist(poses[new, :2], poses[old, :2])
        assert found == pytest.approx(math.dist(truths[new][:2], truths[old][:2]), abs=0.1)


def test_relations_are_read_and_compared_in_the_frame_of_their_first_instant(tmp_path):
    path = tmp_path / "a.relations"
    path.write_text("0 1 1.0 0.5 9 8 7 0.25\n\n# a comment\n0 200 0 0 0 0 0 3.1\n")
    relations = read_relations(path)
    turned = np.array([[5.0, 5.0, math.pi / 2], [4.5, 6.0, math.pi / 2], [5.0, 5.2, -1.5]])
    errors = relation_errors(np.array([0.0, 1.01, 200.0]), turned, relations)
    assert errors.translation_m == pytest.approx([0.0, 0.2])
    assert errors.rotation_rad == pytest.approx([0.25, 2 * math.pi - 3.1 - math.pi / 2 - 1.5])
    assert errors.far.tolist() == [False, True]
    with pytest.raises(RunError, match="none of 2 relations"):
        relation_errors(np.array([700.0, 701.0]), turned[:2], relations)
    path.write_text("0 1 2\n")
    with pytest.raises(RunError, match="line 1"):
        read_relations(path)


def test_evaluate_prints_the_errors_of_relations(tmp_path, capsys):
    (tmp_path / "a.relations").write_text("0 1 1.0 0 0 0 0 0\n")
    (tmp_path / "a.tum").write_text("0 0 0 0 0 0 0 1\n1 1.25 0 0 0 0 0 1\n")
    words = [str(tmp_path / "a.tum"), "--relations", str(tmp_path / "a.relations")]
    assert main(["evaluate", *words]) == 0
    assert "0.2500" in capsys.readouterr().out
    assert main(["evaluate", *words, "--truth", "b.tum"]) == 2


@pytest.mark.skipif(not RADISH.is_dir(), reason="needs ../shared/data/radish")
def test_scans_of_a_real_robot_correct_its_wheels():
    log = open_log(RADISH / "aces.clf.bz2")
    log.n_frames = 1200
    relations = read_relations(RADISH / "aces.relations")
    of_log = (relations.times_s < log.clock.times_s[1199]).all(axis=1)
    some = Relations(*(part[of_log] for part in relations))
    both = [
        relation_errors(track.times_s, track.poses, some).rotation_rad.mean()
        for track in (wheels(log), scan_odometry(log))
    ]
    assert of_log.sum() > 40
    assert both[1] < 0.75 * both[0], json.dumps(both)
