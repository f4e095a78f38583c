"""Brains of any set of populations: landmarks in the brain, one checkpoint, one merge."""

import math

import numpy as np
import pytest
import torch

from neuroslam.brain import NavigationBrain, load_brain, save_brain
from neuroslam.config import build_config, merge_values, read_preset
from neuroslam.config.semantic import SemanticConfig
from neuroslam.errors import BadFrame, MapError
from neuroslam.evaluation.trajectory import absolute_trajectory_error, align
from neuroslam.merging.match import find_match
from neuroslam.merging.states import make_join
from neuroslam.sensors import open_source
from neuroslam.spiking.landmark_frames import shared_frames
from neuroslam.spiking.semantic import SemanticCells
from neuroslam.spiking.sightings import Sightings
from neuroslam.state.match import Match
from neuroslam.state.population import Belief
from neuroslam.types import Frame, Motion, Pose, Velocity

SETS = [
    "semantic", "pose+semantic", "place+semantic", "pose+place+semantic", "pose+place", "place",
]  # fmt: skip
DRIVE = (
    "world:corridor?width=64&height=40&noise=0.02&compass_deg=2&ranges=36&markers=12"
    "&landmark_reach=6&frames_per_lap=170"
)


def brain_of(cells="pose+place+semantic", **over):
    return NavigationBrain(
        build_config(merge_values(read_preset("full"), {"cells": cells, **over}))
    )


@pytest.fixture(scope="module")
def drive():
    return list(open_source(f"{DRIVE}&laps=2"))


def lives(brain, frames):
    for frame in frames:
        brain(frame)
    return brain


def equal_states(one, other):
    a, b = one.state_dict(), other.state_dict()
    assert a.keys() == b.keys()
    return [name for name in a if not torch.equal(a[name], b[name])]


# --- any set of populations ---------------------------------------------------------------------


@pytest.mark.parametrize("cells", SETS)
def test_a_brain_that_was_saved_goes_on_as_one_that_never_stopped(cells, drive, tmp_path):
    uncut = lives(brain_of(cells), drive[:60])
    save_brain(lives(brain_of(cells), drive[:35]), tmp_path / "half.safetensors")
    resumed = lives(load_brain(tmp_path / "half.safetensors"), drive[35:60])
    assert resumed.config == uncut.config
    assert equal_states(uncut, resumed) == []


@pytest.mark.parametrize("cells", SETS)
def test_every_number_of_every_population_has_a_rule_of_merging(cells, drive):
    loaded, partial = (lives(brain_of(cells), drive[a:b]) for a, b in ((0, 40), (20, 60)))
    states = loaded.state_dict(), partial.state_dict()
    join = make_join(*states, Match(0, 0), partial.config, partial.parts())
    for name, part in partial.parts().items():
        own = [
            {key[len(name) + 1 :]: v for key, v in state.items() if key.startswith(f"{name}.")}
            for state in states
        ]
        merged = part.merged(*own, join)
        assert set(merged) == set(own[0]) == set(own[1]), name
        assert {k: v.dtype for k, v in merged.items()} == {k: v.dtype for k, v in own[1].items()}
    assert "semantic" not in cells or "semantic" in partial.parts()


@pytest.mark.parametrize("cells", ["semantic", "pose+semantic", "pose+place+semantic"])
def test_landmarks_bring_a_lap_home(cells, drive):
    brain, truth = brain_of(cells), np.array([frame.truth[:2] for frame in drive])
    track = np.array([brain(frame).pose[:2] for frame in drive])
    assert absolute_trajectory_error(track, truth, "rigid").rmse < 0.35
    assert brain.semantic.n == 12
    places = open_source(DRIVE).posts_m
    known = brain.semantic.landmarks()
    laid = align(track, truth, "rigid").apply(known["place_m"])
    off = np.linalg.norm(laid - places[known["number"]], axis=1)
    assert np.median(off) < 0.4


# --- landmarks ----------------------------------------------------------------------------------


def seen(*rows):
    return Sightings.of(np.array(rows, dtype=float).reshape(-1, 3))


def taught(n=4, steps=30, follows="nothing"):
    """Cells that stand still among landmarks on a ring of 2 m."""
    cells = SemanticCells(SemanticConfig(), follows=follows)
    ring = [(k, 2.0, 2.0 * math.pi * k / n) for k in range(n)]
    for _ in range(steps * n):
        cells.advance(Motion(0.0, 0.0, 0.1), seen(*ring))
    return cells, ring


def test_a_landmark_that_most_others_contradict_is_not_learnt():
    cells, ring = taught()
    before = cells.landmarks()["place_m"].copy()
    wrong = [(0, 5.0, 1.0), *ring[1:]]
    for _ in range(40):
        cells.advance(Motion(0.0, 0.0, 0.1), seen(*wrong))
    np.testing.assert_allclose(cells.landmarks()["place_m"], before, atol=0.02)
    assert math.hypot(*cells.pose[:2]) < 0.02


@pytest.mark.parametrize("follows", ["nothing", "map"])
def test_a_landmark_that_was_first_seen_where_it_is_not_is_found_where_it_is(follows):
    cells = SemanticCells(SemanticConfig(), follows=follows)
    belief = Belief(Pose(0.0, 0.0, 0.0), 0.0, 0, np.zeros((1, 3))) if follows == "map" else None
    cells.advance(Motion(0.0, 0.0, 0.1), seen((5, 6.0, 2.0)), belief=belief)
    for _ in range(30):
        cells.advance(Motion(0.0, 0.0, 0.1), seen((5, 2.0, 0.0)), belief=belief)
    np.testing.assert_allclose(cells.landmarks()["place_m"], [[2.0, 0.0]], atol=0.05)


def test_landmarks_without_names_are_distinguished_by_position():
    cells = SemanticCells(SemanticConfig())
    ring = [(-1, 3.0, 2.0 * math.pi * k / 5) for k in range(5)]
    for _ in range(60):
        cells.advance(Motion(0.0, 0.0, 0.1), seen(*ring))
    known = cells.landmarks()
    assert cells.n == 5
    expected = np.array([(3.0 * math.cos(b), 3.0 * math.sin(b)) for _, _, b in ring])
    apart = np.linalg.norm(known["place_m"][:, None] - expected, axis=-1)
    assert apart.min(axis=1).max() < 0.05
    assert set(known["name"]) == {f"nameless_{k}" for k in range(5)}


def test_a_landmark_that_two_sensors_report_counts_once():
    scanner, camera = (
        np.array([[7, 2.0, 0.1], [-1, 1.0, 0.0]]),
        np.array([[7, 2.2, 0.1], [8, 3, 0]]),
    )
    both = Sightings.of(scanner, camera)
    assert sorted(both.number.tolist()) == [-1, 7, 8]
    assert both.distance_m[both.number == 7].tolist() == [2.0]
    nameless = np.array([[-1, 1.0, 0.0], [-1, 2.0, 1.0], [-1, 3.0, 2.0]])
    assert len(Sightings.of(nameless).kind) == 3


def test_a_brain_without_cells_for_a_compass_does_not_mind_a_broken_one(drive):
    broken = [frame._replace(heading_rad=math.nan) for frame in drive[:3]]
    assert lives(brain_of("pose"), broken).clock.frames_seen == 3
    with pytest.raises(BadFrame, match="heading nan"):
        brain_of("pose+semantic")(broken[0])


def test_what_was_seen_once_is_no_landmark():
    cells, ring = taught()
    cells.advance(Motion(0.0, 0.0, 0.1), seen(*ring, (99, 1.0, 0.5)))
    assert 99 not in cells.landmarks()["number"]
    assert cells.n == len(ring)


def test_a_kidnapped_robot_relocalises_by_known_landmarks():
    cells, _ = taught()
    there = np.array([1.5, -1.0])
    places = {k: 2.0 * np.array([math.cos(a), math.sin(a)]) for k, a in
              ((k, 2.0 * math.pi * k / 4) for k in range(4))}  # fmt: skip
    told = None
    for _ in range(30):
        rows = [(k, np.hypot(*(p - there)), math.atan2(*(p - there)[::-1])) for k, p in
                places.items()]  # fmt: skip
        told = cells.advance(Motion(0.0, 0.0, 0.1), seen(*rows), compass_rad=0.0)
    np.testing.assert_allclose(cells.pose[:2], there, atol=0.1)
    assert not told.lost


def test_bearings_of_landmarks_keep_an_integrated_heading_from_drifting():
    cells, ring = taught()
    for _ in range(100):  # it stands still, and its gyroscope says that it turns
        cells.advance(Motion(0.0, 0.05, 0.1), seen(*ring))
    assert abs(cells.pose.theta_rad) < 0.3  # alone it would be 0.5
    free = SemanticCells(SemanticConfig(heading_rate_hz=0.0))
    for _ in range(100):
        free.advance(Motion(0.0, 0.05, 0.1), seen())
    assert free.pose.theta_rad == pytest.approx(0.5, abs=1e-9)


def test_landmarks_move_with_the_experiences_at_which_they_were_met():
    cells = SemanticCells(SemanticConfig(), follows="map")
    poses = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    belief = Belief(Pose(1.0, 0.0, 0.0), 0.0, 1, poses)
    for _ in range(30):
        cells.advance(Motion(0.0, 0.0, 0.1), seen((3, 1.0, 0.0)), belief=belief)
    np.testing.assert_allclose(cells.landmarks()["place_m"], [[2.0, 0.0]], atol=0.02)
    relaxed = np.array([[0.0, 0.0, 0.0], [1.0, 1.0, math.pi / 2]])
    assert cells.follow_map(relaxed)
    np.testing.assert_allclose(cells.landmarks()["place_m"], [[1.0, 2.0]], atol=0.02)
    recalled = cells.slam.space.to_fourier(cells.slam.map.read(cells.slam.pointers)[0])
    np.testing.assert_allclose(cells.decoder(recalled).position_m, [[1.0, 2.0]], atol=0.02)
    assert not cells.follow_map(relaxed)


def test_views_can_be_landmarks(drive):
    plain = [frame._replace(landmarks=None) for frame in drive[:200]]
    brain = lives(brain_of("pose+semantic", semantic={"landmarks": ["views"]}), plain)
    known = brain.semantic.landmarks()
    assert brain.semantic.n > 30
    assert all(name.startswith("view_") for name in known["name"])


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        (np.zeros((2, 2)), r"landmarks have shape \(2, 2\); expected \(n, 3\)"),
        (np.array([[1.0, np.nan, 0.0]]), "negative or not a number"),
        (np.array([[1.0, -1.0, 0.0]]), "negative or not a number"),
    ],
)
def test_an_invalid_landmark_is_refused_and_changes_nothing(rows, said, drive):
    brain = lives(brain_of(), drive[:10])
    before = {name: value.clone() for name, value in brain.state_dict().items()}
    with pytest.raises(BadFrame, match=f"frame 10: .*{said}"):
        brain(drive[10]._replace(landmarks=rows))
    assert all(torch.equal(before[name], value) for name, value in brain.state_dict().items())


WRONG = {
    "walls of 3 columns": ({"walls": np.ones((4, 3))}, "walls have shape (4, 3); expected (n, 2)"),
    "walls of 1 row": ({"walls": np.ones(2)}, "walls have shape (2,); expected (n, 2)"),
    "walls on end": ({"walls": np.ones((2, 5))}, "walls have shape (2, 5); expected (n, 2)"),
    "walls of batches": ({"walls": np.ones((1, 4, 2))}, "walls have shape (1, 4, 2); expected"),
    "one wall": ({"walls": 0.5}, "walls have shape (); expected (n, 2)"),
    "text walls": ({"walls": np.array([["1", "2"]])}, "walls are an array of text of shape (1, 2)"),
    "object walls": ({"walls": np.array([[None, 1]])}, "walls are an array of objects of shape"),
    "complex walls": ({"walls": np.ones((1, 2), complex)}, "walls are an array of complex"),
    "true walls": ({"walls": np.ones((1, 2), bool)}, "walls are an array of booleans"),
    "ragged walls": ({"walls": [[1.0, 2.0], [1.0]]}, "walls are of type list; expected numbers"),
    "dict of walls": ({"walls": {"left": 1.0}}, "walls are of type dict; expected numbers of sh"),
    "square scan": (
        {"walls": None, "ranges": np.ones((36, 1))},
        "scan: ranges have shape (36, 1); expected (n,)",
    ),
    "text scan": (
        {"walls": None, "ranges": ["1"] * 36},
        "scan: ranges are an array of text of shape (36,); expected numbers of shape (n,)",
    ),
    "short scan": ({"walls": None, "ranges": []}, "scan: ranges have shape (0,); expected (n,)"),
    "flat landmarks": ({"landmarks": np.ones(3)}, "landmarks have shape (3,); expected (n, 3)"),
    "text landmarks": ({"landmarks": [["1", "2", "3"]]}, "landmarks are an array of text of"),
    "landmark 1.5": ({"landmarks": [[1.5, 2, 0]]}, "a landmark has the number 1.5; expected a"),
    "landmark 1e300": ({"landmarks": [[1e300, 2, 0]]}, "a landmark has the number 1e+300; exp"),
    "heading of text": ({"heading_rad": "north"}, "heading is 'north'; expected a number, in rad"),
    "two headings": ({"heading_rad": np.ones(2)}, "heading is an array of float64 of shape (2,)"),
    "tensor as heading": (
        {"heading_rad": torch.tensor(0.1)},
        "heading is an array of torch.float32 of shape (); expected a number, in rad",
    ),
    "one heading": ({"heading_rad": [0.1]}, "heading is of type list; expected a number, in rad"),
    "huge heading": ({"heading_rad": 10**400}, "heading inf rad; expected a finite number"),
    "speed alone": ({"velocity": 0.5}, "odometry is 0.5; expected speed (m/s) and turn rate"),
    "three speeds": ({"velocity": (1.0, 0.0, 0.0)}, "odometry is of type tuple; expected speed"),
    "text speed": ({"velocity": ("1", "0")}, "odometry is of type tuple; expected speed (m/s)"),
    "no turn rate": ({"velocity": Velocity(1.0, None)}, "odometry is of type Velocity; expected"),
    "float image": ({"image": np.ones((40, 64))}, "image is float64 (40, 64); expected uint8"),
    "image with alpha": (
        {"image": np.ones((40, 64, 4), np.uint8)},
        "image is uint8 (40, 64, 4); expected uint8, (h, w) or (h, w, 3)",
    ),
    "no pixels": ({"image": np.ones((0, 64), np.uint8)}, "image is uint8 (0, 64); expected"),
    "list as image": ({"image": [[0, 1]]}, "image is of type list, not a numpy array; expected"),
    "file as image": ({"image": "a.png"}, "image is 'a.png', not a numpy array; expected uint8"),
    "tensor as image": (
        {"image": torch.zeros(40, 64, dtype=torch.uint8)},
        "image is an array of torch.uint8 of shape (40, 64), not a numpy array; expected",
    ),
    "time of text": ({"time_s": "noon"}, "its time is 'noon'; expected a number, in s"),
    "no time": ({"time_s": None}, "its time is None; expected a number, in s"),
    "index": ({"index": 10.0}, "its index is 10.0; expected a whole number of 64 bits"),
    "large index": ({"index": 2**63}, "its index is 9223372036854775808; expected a whole"),
}


@pytest.mark.parametrize("kind", WRONG)
def test_a_frame_of_wrong_shapes_or_types_is_one_line_and_changes_nothing(kind, drive):
    change, said = WRONG[kind]
    brain = lives(brain_of(), drive[:10])
    before = {name: value.clone() for name, value in brain.state_dict().items()}
    with pytest.raises(BadFrame) as caught:
        brain(drive[10]._replace(**change))
    assert said in str(caught.value)
    assert str(caught.value).startswith(f"frame {change.get('index', 10)}: ")
    assert "\n" not in str(caught.value)
    assert all(torch.equal(before[name], value) for name, value in brain.state_dict().items())
    brain(drive[10])


@pytest.mark.parametrize("kind", ["time of text", "index"])
def test_the_first_frame_is_checked_like_all_others(kind, drive):
    change, said = WRONG[kind]
    brain = brain_of()
    for wrong, told in ((change, said), ({"time_s": math.nan}, "time nan s; times must rise")):
        with pytest.raises(BadFrame) as caught:
            brain(drive[0]._replace(**wrong))
        assert told in str(caught.value)
    brain(drive[0])
    assert brain.clock.frames_seen == 1


def test_lists_and_numbers_of_other_types_say_the_same_as_arrays(drive):
    frame = drive[5]
    same = frame._replace(
        walls=None,
        landmarks=frame.landmarks.tolist(),
        ranges=frame.ranges.tolist(),
        heading_rad=np.array(frame.heading_rad),
        velocity=np.array(frame.velocity),
        index=np.int32(frame.index),
        time_s=np.float64(frame.time_s),
    )
    brains = [lives(brain_of(), drive[:5]) for _ in range(2)]
    for brain, one in zip(brains, (frame._replace(walls=None), same), strict=True):
        brain(one)
    assert equal_states(*brains) == []


def test_no_walls_and_no_landmarks_may_be_empty_lists(drive):
    brains = [lives(brain_of(), drive[:5]) for _ in range(2)]
    brains[0](drive[5]._replace(walls=[], landmarks=[]))
    brains[1](drive[5]._replace(walls=np.empty((0, 2)), landmarks=np.empty((0, 3))))
    assert equal_states(*brains) == []


def test_leaving_the_space_names_the_parameter_to_raise():
    brain = brain_of("semantic", semantic={"space": {"reach_m": 2.0}})
    with pytest.raises(MapError, match=r"outside of its space of \+-2 m; raise semantic.space"):
        lives(brain, [Frame(i, 0.1 * i, velocity=Velocity(1.0, 0.0)) for i in range(100)])


# --- merging ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sessions():
    """Two drives through one corridor, that begin at other places and meet."""
    return {
        start: list(open_source(f"{DRIVE}&laps=1&start={start}&seed={seed}"))
        for start, seed in ((0.0, 1), (0.5, 2))
    }


@pytest.mark.parametrize("cells", ["semantic", "pose+semantic", "pose+place+semantic"])
def test_a_merge_of_two_sessions_is_the_union_of_all_that_they_know(cells, sessions):
    loaded, partial = (lives(brain_of(cells), frames) for frames in sessions.values())
    found = find_match(loaded, partial)
    assert found.match is not None, found.reason
    merged, report = loaded.merge(partial, found.match)
    assert report.merged, report.reason
    counts = report.counts["landmarks"]
    assert counts["loaded"] == counts["partial"] == counts["merged"] == 12
    n = report.counts["experiences"]
    assert max(n["loaded"], n["partial"]) <= n["merged"] <= n["loaded"] + n["partial"]
    if "place" in cells:
        n = report.counts["place_cells"]
        assert max(n["loaded"], n["partial"]) <= n["merged"] <= n["loaded"] + n["partial"]
    one, other = loaded.semantic.landmarks(), merged.semantic.landmarks()
    order = np.argsort(one["number"]), np.argsort(other["number"])
    off = one["place_m"][order[0]] - other["place_m"][order[1]]
    assert np.median(np.linalg.norm(off, axis=1)) < 0.5
    recalled = merged.semantic.slam.map.read(merged.semantic.slam.pointers)[0]
    decoded = merged.semantic.decoder(merged.semantic.slam.space.to_fourier(recalled))
    np.testing.assert_allclose(decoded.position_m, merged.semantic.known["place_m"], atol=1e-3)
    lives(merged, list(open_source(f"{DRIVE}&laps=1.2&start=0.5&seed=2").frames(171)))


def test_maps_of_landmarks_that_share_no_name_are_refused(sessions):
    loaded, partial = (lives(brain_of("semantic"), frames[:60]) for frames in sessions.values())
    found = find_match(loaded, partial)
    assert found.match is None
    assert "landmarks with a name are known to both maps" in found.reason


@pytest.mark.parametrize("turn", [0.0, 0.7, -2.0])
def test_shared_names_say_how_two_maps_lie_even_if_one_has_moved(turn):
    one, _ = taught(n=6)
    other, _ = taught(n=6)
    c, s = math.cos(turn), math.sin(turn)
    way = torch.tensor([[c, s], [-s, c]]).double()  # of row vectors
    places = one.known["place_m"] @ way + 1.0
    places[4] += 3.0
    state = other.state_dict() | {"known.place_m": places}
    start, onto = shared_frames(one.state_dict(), state, same_m=0.1)
    assert onto.theta_rad == pytest.approx(-turn, abs=1e-6)
    back = (np.array(start[:2]) - 1.0) @ way.numpy().T
    np.testing.assert_allclose(back, onto[:2], atol=1e-6)
