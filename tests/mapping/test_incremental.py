"""Facts about the incremental solver: right, local, robust, and the same after a resume."""

import math

import numpy as np
import pytest
import torch

import neuroslam.compiled as switch
from neuroslam.config import MapConfig
from neuroslam.errors import MapError
from neuroslam.geometry import wrap_angles
from neuroslam.mapping import ExperienceMap
from neuroslam.mapping.incremental import REJECTED, IncrementalSolver
from neuroslam.mapping.least_squares import solve_pose_graph
from neuroslam.types import Motion, PoseEstimate

AT = PoseEstimate(5.0, 5.0, 5.0)
SIGMA = {"sigma_m": 0.02, "sigma_rad": 0.005}
NO_LINKS = [np.empty(0, np.int64)] * 2 + [np.empty(0)] * 3


def laps(n, n_laps, n_loops, seed, false_share=0.0, radius_m=20.0):
    """Laps of a circle with noisy links in the order of a drive, and which loops are false."""
    rng = np.random.default_rng(seed)
    angle = np.linspace(0.0, 2 * np.pi * n_laps, n, endpoint=False)
    truth = np.column_stack([radius_m * np.cos(angle), radius_m * np.sin(angle), angle])
    lap = n // n_laps
    again = rng.integers(lap, n, n_loops)
    before = again - lap * rng.integers(1, again // lap + 1)
    source, target = np.append(np.arange(n - 1), again), np.append(np.arange(1, n), before)
    apart = truth[target] - truth[source]
    noise = rng.normal(size=(3, len(source)))
    links = [
        source,
        target,
        np.hypot(apart[:, 0], apart[:, 1]) + SIGMA["sigma_m"] * noise[0],
        np.arctan2(apart[:, 1], apart[:, 0]) - truth[source, 2],
        wrap_angles(apart[:, 2] + SIGMA["sigma_rad"] * noise[1]),
    ]
    loop = np.arange(len(source)) >= n - 1
    false = loop & (rng.random(len(source)) < false_share)
    target[false] = rng.integers(0, source[false] // 2)
    order = np.argsort(np.maximum(source, target), kind="stable")
    return [column[order] for column in links], loop[order], false[order]


def driven(links, loop, robust, **config):
    """Take in the links one by one, each new pose where odometry puts it."""
    solver = IncrementalSolver(*NO_LINKS, **SIGMA, **config)
    poses = np.zeros((int(links[0].max()) + 2, 3))
    known, reports = 1, []
    for k in range(len(loop)):
        s, t, *measured = (column[k].item() for column in links)
        if not loop[k]:
            x, y, theta = poses[s]
            distance, heading, facing = measured
            ahead = distance * math.cos(theta + heading), distance * math.sin(theta + heading)
            poses[t] = x + ahead[0], y + ahead[1], theta + facing
            known = t + 1
        solver.add_link(s, t, *measured, doubted=bool(loop[k]) and robust)
        reports.append(solver.update(poses[:known], k))
    return solver, poses[:known], reports


def cost(poses, links):
    bearing = poses[links[0], 2] + links[3]
    apart = poses[links[1]] - poses[links[0]]
    ahead = apart[:, :2] - links[2][:, None] * np.column_stack([np.cos(bearing), np.sin(bearing)])
    turn = wrap_angles(apart[:, 2] - links[4])
    return (ahead**2).sum() / SIGMA["sigma_m"] ** 2 + (turn**2).sum() / SIGMA["sigma_rad"] ** 2


@pytest.mark.parametrize("seed", range(3))
def test_a_drive_ends_near_the_least_squares_and_a_solution_at_it(seed):
    links, loop, _ = laps(300, 3, 60, seed)
    solver, poses, _ = driven(links, loop, robust=False)
    best, report = solve_pose_graph(poses, *links, **SIGMA)
    assert cost(poses, links) < 1.1 * report.cost
    solver.solve(poses)
    assert cost(poses, links) == pytest.approx(report.cost, rel=1e-4)
    assert np.abs(poses[:, :2] - best[:, :2]).max() < 0.02


def test_most_updates_move_a_few_poses_and_the_first_never_moves():
    links, loop, _ = laps(600, 4, 150, seed=1)
    _, poses, reports = driven(links, loop, robust=False, tolerance=1e-3)
    moved = np.array([len(report.moved) for report in reports])
    assert np.median(moved) <= 2
    assert moved[loop].max() > 100  # the first loop closure bends a lap
    assert np.mean(moved[loop][5:]) < 100
    assert poses[0].tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize(("share", "seed"), [(0.0, 0), (0.05, 1), (0.2, 2), (0.2, 3), (0.5, 4)])
def test_wrong_links_are_dropped_and_right_ones_kept(share, seed):
    links, loop, false = laps(300, 3, 80, seed, false_share=share)
    solver, poses, _ = driven(links, loop, robust=True)
    solver.solve(poses)
    rejected = solver.weights < REJECTED
    assert (~rejected & false).sum() <= 1  # a wrong link between neighbours is hardly wrong
    assert (rejected & loop & ~false).sum() <= 1
    assert not rejected[~loop].any()
    ideal, _ = solve_pose_graph(poses, *(column[~false] for column in links), **SIGMA)
    assert np.linalg.norm(poses[:, :2] - ideal[:, :2], axis=1).max() < 0.1
    if share:
        plain = driven(links, loop, robust=False)[1]
        assert np.linalg.norm(plain[:, :2] - ideal[:, :2], axis=1).max() > 1.0


def test_a_wrong_link_believed_first_is_dropped_when_others_disagree():
    n = 200
    angle = np.linspace(0.0, 4 * np.pi, n, endpoint=False)
    truth = np.column_stack([20 * np.cos(angle), 20 * np.sin(angle), angle + np.pi / 2])
    apart = truth[1:] - truth[:-1]
    odometry = [
        np.arange(n - 1), np.arange(1, n), np.hypot(*apart[:, :2].T),
        np.arctan2(apart[:, 1], apart[:, 0]) - truth[:-1, 2], wrap_angles(apart[:, 2]),
    ]  # fmt: skip
    # Back at the start, the first match is 3 m off, which odometry alone would allow.
    first = [100, 3, np.zeros(1), np.zeros(1), np.zeros(1)]
    right = [np.arange(120, 200, 10), np.arange(20, 100, 10), *np.zeros((3, 8))]
    loops = [np.append(a, b) for a, b in zip(first, right, strict=True)]
    links = [np.append(a, b) for a, b in zip(odometry, loops, strict=True)]
    loop = np.arange(len(links[0])) >= n - 1
    order = np.argsort(np.maximum(*links[:2]) + 0.5 * loop, kind="stable")
    links, loop = [column[order].astype(float) for column in links], loop[order]
    links[:2] = (column.astype(np.int64) for column in links[:2])
    wrong = loop & (links[1] == 3)
    solver, poses, _ = driven(links, loop, robust=True)
    until = np.flatnonzero(wrong)[0] + 1
    early = driven([c[:until] for c in links], loop[:until], robust=True)[0]
    assert early.weights[-1] > REJECTED
    assert solver.weights[wrong] < REJECTED
    assert (solver.weights[loop & ~wrong] > REJECTED).all()
    ends = links[0][loop & ~wrong], links[1][loop & ~wrong]
    assert np.linalg.norm(poses[ends[0], :2] - poses[ends[1], :2], axis=1).max() < 0.05


def test_plain_and_compiled_steps_give_one_map(monkeypatch):
    links, loop, _ = laps(60, 3, 15, seed=5, false_share=0.2)
    compiled_poses = driven(links, loop, robust=True)[1]
    monkeypatch.setattr(switch, "ENABLED", False)
    plain_poses = driven(links, loop, robust=True)[1]
    np.testing.assert_allclose(plain_poses, compiled_poses, rtol=0.0, atol=1e-6)


def test_the_error_names_the_poses_that_links_end_at():
    solver = IncrementalSolver(*(np.array([v]) for v in (0, 5, 1.0, 0.0, 0.0)))
    with pytest.raises(MapError, match="links end at poses up to 5, expected at most 1"):
        solver.solve(np.zeros((2, 3)))


def drive(graph, frames):
    """Laps of a square of 40 m with drift, matches from the second on; return the wrong links."""
    wrong = []
    for frame in frames:
        at = frame % 40
        turn = math.pi / 2 if at % 10 == 0 and frame else 0.0
        graph.move(Motion(1.0, turn + 0.004, 1.0))
        if frame < 40 or frame % 3 == 0:
            graph.create(frame, AT, frame=frame)
        elif frame % 17 == 16:
            wrong.append(graph.n_links)
            graph.link((at + 13) % 40)
            graph.relocalise(at)
        else:
            graph.link(at)
        graph.relax()
    return wrong


@pytest.mark.parametrize("saved_at", [30, 41, 47, 100])
def test_a_resumed_map_is_the_same_to_the_last_bit(saved_at):
    config = MapConfig(solver="incremental", robust=True, initial_heading_deg=0.0)
    whole, part = ExperienceMap(config), ExperienceMap(config)
    drive(whole, range(160))
    drive(part, range(saved_at))
    resumed = ExperienceMap(config)
    resumed.load_state_dict(part.state_dict())
    drive(resumed, range(saved_at, 160))
    for name, tensor in whole.state_dict().items():
        assert torch.equal(tensor, resumed.state_dict()[name]), name
    assert whole.link_weights.tobytes() == resumed.link_weights.tobytes()


def test_the_weight_of_a_link_says_whether_the_map_contradicts_it():
    config = MapConfig(solver="incremental", robust=True, initial_heading_deg=0.0)
    graph = ExperienceMap(config)
    wrong = drive(graph, range(160))
    graph.solve()
    rejected = np.flatnonzero(graph.link_weights < REJECTED)
    assert rejected.tolist() == wrong
    assert len(wrong) > 3
    assert graph.state.at_rest
