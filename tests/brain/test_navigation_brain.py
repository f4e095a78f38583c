"""Brains with boundary, grid and place cells: runs, kidnapping, merging, sensors of many rates."""

from functools import cache
from itertools import pairwise

import numpy as np
import pytest
import torch

from neuroslam.brain import NavigationBrain, load_brain, save_brain
from neuroslam.cells.wall_matching import (
    Outline,
    align_outlines,
    largest_residual,
    match_walls,
)
from neuroslam.config import build_config, merge_values, read_preset
from neuroslam.errors import BadFrame
from neuroslam.evaluation.trajectory import absolute_trajectory_error, align
from neuroslam.geometry import wrap_angles
from neuroslam.runs.inspect import inspect
from neuroslam.runs.merge import join_brains, merge_runs
from neuroslam.runs.run import resume, run
from neuroslam.runs.verify import verify
from neuroslam.sensors import open_source
from neuroslam.types import Frame, Velocity


def brain_of(preset, **over):
    return NavigationBrain(build_config(merge_values(read_preset(preset), over)))


def lives(brain, frames):
    """Let a brain take in frames; its positions, the true ones, and whether it was lost."""
    track = [(*result.pose[:2], *frame.truth[:2], result.lost)
            for frame in frames for result in [brain(frame)]]  # fmt: skip
    table = np.array(track)
    return table[:, :2], table[:, 2:4], table[:, 4] > 0


def renumbered(frames, dt_s):
    return [f._replace(index=i, time_s=i * dt_s) for i, f in enumerate(frames)]


ROUND = "arena:circle2m?minutes=4&noise=1&seed=1"
NINE = "arena:nonagon?minutes=4&noise=1&seed=2"


@pytest.fixture(scope="module")
def lived():
    """Runs by motion and walls in an arena: the brain, its track, the truth, when it was lost."""

    @cache
    def live(spec, stop=None, about=""):
        brain = brain_of("slrb")
        brain.about = (about, "slrb", "")
        return brain, lives(brain, open_source(spec).frames(0, stop))

    return live


@pytest.fixture(scope="module")
def squares(lived):
    """Two sessions of four minutes in one square, with other walks and other noise."""
    return [
        lived(f"arena:square?minutes=5.5&noise=1&seed={seed}", 4800, f"square {seed}")[0]
        for seed in (1, 2)
    ]


def test_a_life_by_walls_and_motion_maps_the_arena():
    brain = brain_of("slrb")
    track, truth, lost = lives(brain, open_source("arena:pentagon?minutes=2.5&noise=1&seed=3"))
    assert absolute_trajectory_error(track, truth, "rigid").rmse < 0.04
    assert not lost.any()
    assert brain.map.n == int(brain.navigation.place.n_cells) > 100
    np.testing.assert_allclose(
        brain.map.poses[:, :2], brain.navigation.place.centres_m[0, : brain.map.n], atol=1e-9
    )
    way = brain.map.plan(0)  # the graph of places can be planned on
    assert way.path[-1] == 0


def test_a_scan_does_as_well_as_walls():
    errors = []
    for sensor in ("", "&ranges=180"):
        brain = brain_of("slrb")
        track, truth, _ = lives(
            brain, open_source(f"arena:square?minutes=1.2&noise=1&seed=4{sensor}")
        )
        errors.append(absolute_trajectory_error(track, truth, "rigid").rmse)
    assert max(errors) < 0.04


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"walls": np.array([[-0.1, 0.0]])}, r"frame 40: walls: distance -0\.1 m"),
        ({"walls": np.array([[np.nan, 0.0]])}, "frame 40: walls: distance nan m"),
        ({"walls": np.array([[0.1, np.inf]])}, "frame 40: walls: bearing inf rad"),
        ({"heading_rad": np.nan}, "frame 40: heading nan rad"),
        ({"velocity": Velocity(np.nan, 0.0)}, "frame 40: odometry v = nan m/s"),
        ({"walls": None, "ranges": np.full(180, -1.0)}, "frame 40: .*negative|frame 40: .*-1"),
    ],
)
def test_what_no_sensor_can_measure_is_refused_and_changes_nothing(change, said):
    brain = brain_of("slrb")
    frames = list(open_source("arena:square?minutes=1&noise=1").frames(0, 60))
    for frame in frames[:40]:
        brain(frame)
    before = {name: value.clone() for name, value in brain.state_dict().items()}
    with pytest.raises(BadFrame, match=said):
        brain(frames[40]._replace(**change))
    after = brain.state_dict()
    assert all(torch.equal(before[name], after[name]) for name in before)
    brain(frames[40])


def test_a_brain_is_saved_whole(tmp_path):
    whole, cut = brain_of("slrb"), brain_of("slrb")
    frames = list(open_source("arena:nonagon?minutes=1&noise=1&seed=5"))
    for frame in frames:
        whole(frame)
    for frame in frames[:700]:
        cut(frame)
    save_brain(cut, tmp_path / "brain.safetensors")
    cut = load_brain(tmp_path / "brain.safetensors")
    for frame in frames[700:]:
        cut(frame)
    one, other = whole.state_dict(), cut.state_dict()
    assert one.keys() == other.keys()
    assert all(torch.equal(one[name], other[name]) for name in one)


def test_runs_are_resumed_and_equal_and_sound(tmp_path):
    source = "arena:square?minutes=1&noise=1&seed=2"
    config = brain_of("slrb").config
    run(source, tmp_path / "whole", config, tensorboard=False)
    summary = run(source, tmp_path / "cut", config, stop=500, tensorboard=False)
    assert summary.frames == 500
    resume(tmp_path / "cut", tensorboard=False)
    for name in ("frames.csv", "experiences.csv", "links.csv", "brain.safetensors"):
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "cut" / name).read_bytes()
    assert verify(tmp_path / "whole") == []
    rows = dict(inspect(tmp_path / "whole"))
    assert int(rows["place cells"]) == int(rows["experiences"])


def test_verify_finds_what_makes_no_sense(squares, tmp_path):
    file = tmp_path / "brain.safetensors"
    brain = brain_of("slrb")
    brain.restore(squares[0].state_dict(), [])
    brain.navigation.place.neighbours[0, 3, 0] = 5000
    brain.navigation.walls.active[0, 0] = 999
    save_brain(brain, file)
    said = "\n".join(verify(file))
    assert "place cells 3: linked to cells that do not exist" in said
    assert "active walls 0: not remembered" in said


@pytest.mark.parametrize("arena", ["triangle", "circle2m", "nonagon"])
def test_a_kidnapped_animal_reports_that_it_is_lost_and_learns_nothing(arena):
    frames = list(open_source(f"arena:{arena}?minutes=8&noise=1&seed=1"))
    start, place = 4800, np.array([f.truth[:2] for f in frames])
    brain = brain_of("slrb")
    _, _, lost = lives(brain, frames[:start])
    assert lost.mean() < 0.01  # no false alarm to speak of
    state = {name: value.clone() for name, value in brain.state_dict().items()}
    far = [k for k in range(start + 300, len(frames) - 1200, 600)
           if np.linalg.norm(place[k] - place[start - 1]) > 0.5]  # fmt: skip
    noticed = []
    for to in far:
        brain.restore({name: value.clone() for name, value in state.items()}, [])
        known, steps_lost = None, 0
        for i, frame in enumerate(frames[to : to + 1200]):
            at = start + i
            is_lost = brain(frame._replace(index=at, time_s=0.05 * at)).lost
            knows = brain.navigation.place.n_cells.item(), brain.navigation.walls.n_walls.item()
            if is_lost and known is not None:  # it learns nothing as long as it is lost
                assert knows == known
            known, steps_lost = (knows, steps_lost + 1) if is_lost else (None, steps_lost)
            if steps_lost == 50:
                break
        noticed.append(steps_lost > 0)
    assert np.mean(noticed) >= 0.5  # within a minute of walking slowly; the rest met no wall


@pytest.fixture(scope="module")
def kidnapped_drive():
    source = open_source("world:ellipse?laps=3&noise=0.03&ranges=180")
    return [*source.frames(0, 801), *source.frames(1000, 1201)]


@pytest.mark.parametrize("kidnapped", ["detect", "ignore"])
def test_a_kidnapped_animal_with_views_relocalises(kidnapped, kidnapped_drive):
    brain = brain_of("ratslam_slrb", sessions={"kidnapped": kidnapped})
    track, truth, _ = lives(brain, renumbered(kidnapped_drive, 0.1))
    before = align(track[:800], truth[:800])
    off = np.linalg.norm(before.apply(track) - truth, axis=1)
    assert np.median(off[:800]) < 0.6
    assert np.median(off[-100:]) < 0.6  # of 12 m
    assert len(brain.stored) == 0


def test_views_say_how_the_frames_of_two_sessions_lie():
    frames = [
        list(open_source(f"world:ellipse?laps=3&noise=0.03&ranges=90&seed={seed}").frames(*cut))
        for seed, cut in ((0, (0, 420)), (5, (600, 760)))
    ]
    first, second = brain_of("ratslam_slrb"), brain_of("ratslam_slrb")
    first.about = ("first", "", "")
    there, truth = [], np.array([f.truth[:2] for f in frames[0]])
    for frame in frames[0]:
        first(frame)
        there.append(first.navigation.pose[:2])
    lies = align(np.array(there), truth)
    second.store(first)
    n_views, off = [first.view.n], []
    for frame in frames[1]:
        second(frame)
        if not len(second.stored):
            at = lies.apply(np.array([second.navigation.pose[:2]]))
            off.append(np.linalg.norm(at - frame.truth[:2]))
    assert len(off) > 80  # it was joined early
    assert np.mean(off) < 1.0  # of the 12 m by which the frames were apart
    assert second.navigation.seen.n == second.view.n >= n_views[0]


def test_walls_make_the_map_of_views_better():
    errors = {}
    frames = list(open_source("world:ellipse?laps=1.3&noise=0.1&ranges=90"))
    for cells in ("pose", "pose_and_place"):
        brain = brain_of("ratslam_slrb", cells=cells)
        track, truth, _ = lives(brain, frames)
        errors[cells] = absolute_trajectory_error(track, truth, "rigid").rmse
    assert errors["pose_and_place"] < 0.7 * errors["pose"]


def test_a_camera_a_scanner_and_odometry_of_other_rates_are_one_stream(tmp_path):
    source = open_source("world:corridor?laps=0.3&noise=0.02&ranges=90&rate=10")
    frames = list(source)
    fast = []
    for before, after in pairwise(frames):
        for k in range(1, 5):  # odometry at 50 Hz between the pictures
            time_s = before.time_s + 0.02 * k
            fast.append(Frame(len(fast), time_s, velocity=after.velocity))
        fast.append(after._replace(index=len(fast)))
    slow_brain, fast_brain = (brain_of("ratslam_slrb") for _ in range(2))
    for frame in frames:
        slow_brain(frame)
    fast = [frames[0], *[f._replace(index=f.index + 1) for f in fast]]
    for frame in fast:
        fast_brain(frame)
    assert fast_brain.view.n == pytest.approx(slow_brain.view.n, abs=2)
    one, other = fast_brain.navigation.pose, slow_brain.navigation.pose
    assert np.hypot(one.x_m - other.x_m, one.y_m - other.y_m) < 0.2


def test_two_sessions_in_one_arena_become_one_map(squares):
    merged, reports = join_brains(*squares)
    assert merged is not None, reports[0].reason
    first, second = (brain.map.n for brain in squares)
    folded = reports[0].match["places"]
    assert merged.map.n == first + second - folded == int(merged.navigation.place.n_cells)
    assert folded > 0.3 * second
    visits = [int(b.navigation.place.visits.sum()) for b in (*squares, merged)]
    assert visits[0] + visits[1] == visits[2]
    times = [float(b.navigation.place.time_s.sum()) for b in (*squares, merged)]
    assert times[0] + times[1] == pytest.approx(times[2])
    felt = [float(b.navigation.familiarity.time_s.sum()) for b in (*squares, merged)]
    assert felt[0] + felt[1] == pytest.approx(felt[2], rel=1e-5)
    n_walls = [int(b.navigation.walls.n_walls) for b in (*squares, merged)]
    assert n_walls[2] < n_walls[0] + n_walls[1]
    assert "wall segments align with the other map's" in reports[0].found
    assert merged.map.residuals_m.max() < 1e-9
    graph, _ = merged.navigation.place.graph()
    away = torch.cdist(graph[:first], graph[first:])
    assert away.min() >= 0.06 - 1e-9  # no place twice


def test_an_animal_that_continues_after_a_merge_is_localised(squares, lived):
    _, (track, truth, _) = lived("arena:square?minutes=5.5&noise=1&seed=1", 4800, "square 1")
    start = truth[0]
    assert np.linalg.norm(track[-1] + start - truth[-1]) < 0.1
    merged, reports = join_brains(*squares)
    assert merged is not None, reports[0].reason
    rest = open_source("arena:square?minutes=5.5&noise=1&seed=2").frames(4800)
    track, truth, lost = lives(merged, rest)
    off = np.linalg.norm(track + start - truth, axis=1)  # in the first session's frame
    assert off.mean() < 0.08
    assert not lost.any()


def test_a_merge_with_itself_adds_nothing(squares):
    merged, reports = join_brains(squares[0], squares[0])
    assert reports[0].reason == "no experience is new"
    assert merged.map.n == squares[0].map.n
    assert torch.equal(merged.navigation.walls.n_walls, squares[0].navigation.walls.n_walls)


@pytest.mark.parametrize(
    "other",
    [*(f"arena:{name}?minutes=2&noise=1&seed=1" for name in ("triangle", "pentagon", "circle1m")),
     NINE, ROUND],
)  # fmt: skip
def test_maps_of_other_arenas_are_refused_with_the_reason(squares, lived, other):
    brain, _ = lived(other)
    merged, reports = join_brains(squares[0], brain)
    assert merged is None
    assert "wall segments" in reports[0].reason
    assert "must" in reports[0].reason or "when the map" in reports[0].reason


def test_a_circle_is_not_a_nonagon(lived):
    (round_, _), (nine, _) = lived(ROUND), lived(NINE)
    merged, reports = join_brains(round_, nine)
    assert merged is None
    assert "walls of one place leave at most" in reports[0].reason


def test_parallel_walls_alone_are_refused():
    x = np.linspace(0.0, 3.0, 12)
    feet = np.concatenate([np.column_stack([x, 0 * x]), np.column_stack([x, 0 * x + 1.0])])
    bearings = np.repeat([-np.pi / 2, np.pi / 2], 12)
    laid = align_outlines(Outline(feet, bearings), Outline(feet, bearings), [0.0], 0.25, 0.05)
    assert laid.spread < 0.01


def square_walls(n=12):
    """Feet on the walls of a square of 2 m, and their bearings."""
    t, zero = np.linspace(0.1, 1.9, n), np.zeros(n)
    sides = [(t, zero), (zero + 2.0, t), (t, zero + 2.0), (zero, t)]
    feet = np.concatenate([np.column_stack(side) for side in sides])
    return Outline(feet, np.repeat([-np.pi / 2, 0.0, np.pi / 2, np.pi], n))


@pytest.mark.parametrize(("bent_m", "merges"), [(0.03, True), (0.075, False)])
def test_a_map_bent_by_a_few_centimetres_is_the_same_place_if_all_its_walls_match(bent_m, merges):
    """The drift of short sessions bends their maps: 3 of 30 merges in one square were refused."""
    one, config = square_walls(), build_config({})
    bent = one.feet_m * (1.0, 1.0 + bent_m / 2.0) - (0.4, 0.2)  # 2 m become so much longer
    poses = np.column_stack([one.feet_m, np.zeros(len(one.feet_m))])
    moved = poses - (0.4, 0.2, 0.0)
    both = Outline(one.feet_m, one.bearing_rad), Outline(bent, one.bearing_rad)
    match, said = match_walls(both, (poses, moved), config, compass=True)
    if merges:
        assert match is not None, said
        assert abs(match.onto.x_m - moved[match.partial, 0] - 0.4) < 0.001
        assert abs(match.onto.y_m - moved[match.partial, 1] - 0.2) < bent_m
    else:
        assert match is None
        assert said.endswith("longer sessions remember their walls more exactly")


def test_only_maps_of_which_nearly_all_walls_match_may_be_bent():
    limits_m = [largest_residual(share, 0.02) for share in (0.6, 0.85, 0.9, 1.0, 1.3)]
    assert limits_m[:2] == pytest.approx([0.017, 0.017])
    assert limits_m[1] < limits_m[2] < limits_m[3]
    assert limits_m[3:] == pytest.approx([0.024, 0.024])


@pytest.mark.parametrize("turn", [0.0, 0.7, -2.0])
def test_an_outline_is_found_again_wherever_it_was_put(turn):
    t = np.linspace(0.1, 1.9, 10)
    sides = {-np.pi / 2: (t, 0 * t), np.pi: (0 * t, t), np.pi / 2: (t[:5], 0 * t[:5] + 2.0),
             0.0: (0 * t + 2.5, t)}  # fmt: skip
    feet = np.concatenate([np.column_stack(side) for side in sides.values()])
    bearings = np.concatenate([np.full(len(x), b) for b, (x, _) in sides.items()])
    outline = Outline(feet, bearings)
    moved = outline.moved(turn, np.array([3.0, -1.0]))
    laid = align_outlines(outline, moved, [2 * np.pi * k / 12 for k in range(12)], 0.25, 0.05)
    assert laid.n_same == len(feet)
    assert abs(wrap_angles(np.array([laid.turn_rad + turn]))[0]) < 1e-6
    np.testing.assert_allclose(moved.moved(laid.turn_rad, laid.move_m).feet_m, feet, atol=1e-6)


def test_a_stored_map_without_views_refers_to_neuroslam_merge(squares):
    brain = brain_of("slrb")
    brain.store(squares[0])
    lives(brain, open_source("arena:square?minutes=0.5&noise=1&seed=9"))
    (stored,) = brain.not_joined()
    assert stored["reason"].endswith("neuroslam merge")
    assert stored["experiences"] == squares[0].map.n


def test_brains_with_other_cells_do_not_merge(squares):
    for over in ({"cells": "pose"}, {"place_cells": {"threshold_m": 0.1}}):
        other = brain_of("slrb", **over)
        for frame in open_source("arena:square?minutes=0.1").frames(0, 20):
            other(frame._replace(image=None))
        merged, reports = join_brains(squares[0], other)
        assert merged is None
        assert "different configs" in reports[0].reason


def test_merging_from_the_command_line_writes_a_run(tmp_path, call):
    for seed in (1, 2):
        source = f"arena:square?minutes=1.2&noise=1&seed={seed}"
        run(source, tmp_path / str(seed), brain_of("slrb").config, tensorboard=False)
    done = call("merge", tmp_path / "1", tmp_path / "2", "-o", tmp_path / "both")
    assert done.code == 0, done.out + done.err
    assert "found: " in done.out
    assert verify(tmp_path / "both") == []
    summary, _ = merge_runs(tmp_path / "1", tmp_path / "2", tmp_path / "again")
    assert summary.counts["place_cells"] == summary.counts["experiences"]
