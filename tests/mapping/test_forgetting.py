"""Forgetting: a map with a cap stays connected, keeps its loops, and goes on bit for bit."""

import numpy as np
import pytest
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from neuroslam.brain import NavigationBrain, load_brain, save_brain
from neuroslam.brain.forgetting import forget, renumber, renumbering
from neuroslam.brain.soundness import faults_of
from neuroslam.config import BrainConfig
from neuroslam.errors import ConfigError, MapError
from neuroslam.mapping import ExperienceMap
from neuroslam.mapping.forgetting import contract_links, least_used, roots
from neuroslam.mapping.tables import Links
from neuroslam.merging.states import merge_states
from neuroslam.runs.reading import trajectory
from neuroslam.spiking.landmark_frames import from_frame
from neuroslam.state.join import Join
from neuroslam.state.match import Match
from neuroslam.state.mergeable import renumbered_by_rules, rows_of_views, summed_by_experience
from neuroslam.types import Frame, Motion, PoseEstimate, Velocity

CAP = 100


def loops_of_a_circle(n=60, extra=20, seed=0):
    """A chain with loop links, whose links disagree with the poses by a little."""
    rng = np.random.default_rng(seed)
    angle = np.linspace(0.0, 4.0 * np.pi, n, endpoint=False)
    poses = np.column_stack([5 * np.cos(angle), 5 * np.sin(angle), angle + np.pi / 2])
    source = np.concatenate([np.arange(n - 1), rng.integers(0, n, extra)])
    target = np.concatenate([np.arange(1, n), rng.integers(0, n, extra)])
    good = source != target
    source, target = source[good], target[good]
    apart = poses[target] - poses[source]
    noise = rng.normal(0, 0.1, (3, len(source)))
    return poses, Links(
        source,
        target,
        np.hypot(apart[:, 0], apart[:, 1]) + np.abs(noise[0]),
        np.arctan2(apart[:, 1], apart[:, 0]) - poses[source, 2] + noise[1],
        apart[:, 2] + noise[2],
        np.ones(len(source)),
    )


def residuals(poses, links):
    """Where a link puts its target, minus where that is; and the same of the heading."""
    bearing = poses[links.source, 2] + links.heading_rad
    step = links.distance_m[:, None] * np.column_stack([np.cos(bearing), np.sin(bearing)])
    turned = poses[links.source, 2] + links.facing_rad - poses[links.target, 2]
    return np.linalg.norm(poses[links.source, :2] + step - poses[links.target, :2], axis=1), np.cos(
        turned
    )


def n_parts(links, ids):
    ends = np.searchsorted(ids, links.source), np.searchsorted(ids, links.target)
    graph = coo_array((np.ones(len(links.source)), ends), shape=(len(ids), len(ids)))
    return connected_components(graph, directed=False)[0]


def test_a_link_that_leads_elsewhere_keeps_its_residual_of_heading_and_the_map_its_loops():
    poses, links = loops_of_a_circle()
    use, keep = np.arange(60.0), np.zeros(60, dtype=bool)
    keep[[0, 59]] = True
    root = least_used(use, links, poses, keep, 25)
    kept = np.flatnonzero(root == np.arange(60))
    fewer = contract_links(links, poses, root)
    assert len(kept) == 35
    assert {0, 59} <= set(kept.tolist())
    assert set(np.unique(np.concatenate(fewer[:2]))) <= set(kept.tolist())
    assert (fewer.source != fewer.target).all()
    assert n_parts(fewer, kept) == 1
    pairs = {frozenset(pair) for pair in zip(root[links.source], root[links.target], strict=True)}
    assert len(fewer.source) == len([pair for pair in pairs if len(pair) == 2])
    turns = sorted(residuals(poses, fewer)[1].round(9))
    assert set(turns) <= set(residuals(poses, links)[1].round(9))


def test_links_without_residuals_have_none_when_they_lead_elsewhere():
    poses, links = loops_of_a_circle(extra=0)
    apart = poses[links.target] - poses[links.source]
    exact = links._replace(
        distance_m=np.hypot(apart[:, 0], apart[:, 1]),
        heading_rad=np.arctan2(apart[:, 1], apart[:, 0]) - poses[links.source, 2],
        facing_rad=apart[:, 2],
    )
    root = least_used(np.arange(60.0), exact, poses, np.arange(60) == 59, 40)
    away, turn = residuals(poses, contract_links(exact, poses, root))
    assert away.max() < 1e-9
    assert turn.min() > 1.0 - 1e-12


def test_a_path_that_is_not_used_loses_every_second_experience():
    poses, links = loops_of_a_circle(extra=0)
    root = least_used(np.zeros(60), links, poses, np.zeros(60, dtype=bool), 30)
    assert (np.diff(np.flatnonzero(root == np.arange(60))) == 2).all()
    assert roots(np.array([3, 0, 1, 3])).tolist() == [3, 3, 3, 3]


def endless(n, first=0):
    """Frames along a wall that never repeats; sideways, so that each step shows something new."""
    for i in range(first, first + n):
        rng = np.random.default_rng(i // 2)
        image = np.kron(rng.integers(0, 256, (6, 8)), np.ones((8, 8))).astype(np.uint8)
        yield Frame(i, i / 20.0, image, Velocity(2.0, 0.05))


def brain(cells="pose", closure="view", **map_):
    return NavigationBrain(
        BrainConfig(
            cells=cells,
            view={"template_width": 20, "template_height": 12, "threshold": 0.02},
            sessions={"kidnapped": "ignore"},
            map={"closure": closure, "loops": 5, "max_experiences": CAP} | map_,
        )
    )


def faults(robot):
    return faults_of(robot.state_dict(), robot)


def trace_of(frames, robot):
    rows = []
    for frame in frames:
        result = robot(frame)
        assert result.n_experiences <= CAP
        assert result.n_templates <= CAP
        assert result.experience < robot.map.n
        rows.append((*robot.map.origin, *robot.map.offset))
    names = ("session", "number", "dx_m", "dy_m", "dtheta_rad")
    return dict(zip(names, np.array(rows).T, strict=True))


@pytest.mark.parametrize("closure", ["view", "sequence"])
def test_a_capped_map_keeps_the_trajectory_and_goes_on_bit_for_bit(closure, tmp_path):
    robot, free = brain(closure=closure), brain(closure=closure, max_experiences=0)
    trace = trace_of(endless(300), robot)
    for frame in endless(300):
        free(frame)
    assert free.map.n > CAP + 40
    assert not faults(robot)
    assert robot.map.forgotten.n >= 40
    track = trajectory(robot, trace)  # without loops no relaxation: the track is that of odometry
    assert track[-1] == pytest.approx(free.map.pose, abs=1e-6)
    assert np.isfinite(track).all()
    steps = np.linalg.norm(np.diff(track[:, :2], axis=0), axis=1)
    assert steps == pytest.approx(np.full(299, 0.1), abs=1e-6)
    save_brain(robot, tmp_path / "brain.safetensors")
    again = load_brain(tmp_path / "brain.safetensors")
    for frame in endless(20, first=300):
        assert robot(frame) == again(frame)
    one, two = robot.state_dict(), again.state_dict()
    assert one.keys() == two.keys()
    assert all(torch.equal(one[name], two[name]) for name in one)


def test_two_maps_that_forget_merge_with_what_they_have_forgotten():
    robots = brain(), brain(max_experiences=0)
    for robot, first in zip(robots, (0, 150), strict=True):
        for frame in endless(240, first):
            robot(frame)
    loaded = robots[0]
    gone = loaded.map.forgotten.n
    assert gone
    firsts = [robot.map.experiences["first_frame"].numpy() for robot in robots]
    same = int(np.intersect1d(*firsts)[-1])
    match = Match(*(int(np.flatnonzero(f == same)[0]) for f in firsts), 0.0, 0.0)
    for one, other in (robots, robots[::-1]):
        state, _ = merge_states(
            one.state_dict(),
            other.state_dict(),
            match if one is loaded else Match(match.partial, match.loaded, 0.0, 0.0),
            other.config,
            other.parts(),
        )
        merged = NavigationBrain(other.config)
        merged.restore(state, [])
        assert merged.map.forgotten.n == gone
        assert not faults(merged)


def test_all_populations_follow_a_map_that_forgets():
    robot = brain("pose+place+head_direction+speed")
    for frame in endless(220):
        robot(frame)
    assert robot.map.forgotten.n
    assert not faults(robot)
    assert robot.head_direction.views.n == robot.view.n == robot.pose_cells.bindings.n


def test_landmarks_stay_where_they_are_when_their_experience_is_forgotten():
    robot = brain("pose+semantic")
    for frame in endless(8):
        robot(frame)
    cells, n = robot.semantic, robot.map.n
    anchor = n // 2
    column = {
        name: torch.zeros((1, *cells.known[name].shape[1:]), dtype=cells.known[name].dtype)
        for name in cells.known.columns
    }
    column["experience"][0] = anchor
    column["offset_m"][0] = torch.tensor([0.3, -0.2])
    cells.known.replace(**column)
    before = from_frame(robot.map.poses[[anchor]], cells.known["offset_m"].numpy())
    root = np.arange(n)
    root[anchor] = anchor + 1
    renumber(robot, root)
    at = cells.known["experience"].numpy()
    assert at.tolist() == [anchor]
    after = from_frame(robot.map.poses[at], cells.known["offset_m"].numpy())
    assert after == pytest.approx(before, abs=1e-9)


def test_two_strands_become_one_where_the_robot_uses_one_of_them():
    """Out and back to the start, side by side; then three more laps along the first strand."""
    robot = brain(max_experiences=0, consolidate_passes=2)
    graph: ExperienceMap = robot.map
    view = next(iter(endless(1))).image
    template = robot.view.learn(robot.view.encode(view))
    robot.pose_cells.bindings.append(x=0.0, y=0.0, theta=0.0, decay=0.0)
    side, here = 30, PoseEstimate(0.0, 0.0, 0.0)
    ring = 2 * np.pi / side

    def step():
        graph.move(Motion(1.0, ring, 1.0))

    for strand in (0, 1):
        for k in range(side):
            step()
            graph.create(template, here, strand * side + k)
    for _ in range(3):
        step()
        graph.link(0)
        for k in range(1, side):
            step()
            graph.link(k)
    step()
    graph.link(0)
    graph.relax(500)
    assert graph.n == 2 * side
    while forget(robot):
        pass
    assert graph.n < 1.25 * side
    assert n_parts(graph.links, np.arange(graph.n)) == 1
    assert graph.forgotten.n == 2 * side - graph.n


def test_a_population_that_cannot_follow_is_refused():
    with pytest.raises(ConfigError, match="here place leads"):
        brain("place")
    with pytest.raises(ConfigError, match="views as landmarks"):
        NavigationBrain(
            BrainConfig(
                cells="pose+semantic",
                map={"max_experiences": CAP},
                semantic={"landmarks": ["views"]},
            )
        )
    with pytest.raises(ValueError, match="expected 100 or more"):
        BrainConfig(map={"max_experiences": 99})


def test_a_population_follows_by_its_merge_rules():
    robot = brain()
    for frame in endless(20):
        robot(frame)
    root = np.arange(robot.map.n)
    root[2] = 3
    change = renumbering(robot, root)
    n = robot.map.n
    rules = {"heard": rows_of_views, "visits": summed_by_experience}
    state = {"heard": torch.arange(robot.view.n), "visits": torch.ones(n)}
    changed = renumbered_by_rules(rules, state, change)
    assert changed["heard"].tolist() == [k for k in range(robot.view.n) if k != 2]
    assert changed["visits"].tolist() == [1.0, 1.0, 2.0] + [1.0] * (n - 4)

    def own(loaded: torch.Tensor, partial: torch.Tensor, join: Join) -> torch.Tensor:
        return partial

    with pytest.raises(MapError, match="not a standard one"):
        renumbered_by_rules({"heard": own}, {"heard": state["heard"]}, change)
