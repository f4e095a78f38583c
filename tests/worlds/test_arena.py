import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from neuroslam.errors import SourceError
from neuroslam.worlds.arena import Arena, named_arena

NAMES = [
    "triangle", "square", "pentagon", "nonagon", "circle1m", "circle2m",
    "rectangle", "two_rooms", "pillar",
]  # fmt: skip
CROWDED = Arena(
    [(0, 0), (3, 0), (3, 2), (2, 2), (2.1, 0.6), (1.2, 0.5), (1, 2), (0, 2)],
    holes=[[(0.4, 0.4), (0.6, 0.9), (0.3, 1.0)], (2.5, 0.5, 0.2)],
    walls=[[(0.2, 1.5), (0.8, 1.2)], [(1.6, 0), (1.6, 0.4)], [(2.5, 1.2), (2.5, 1.8)]],
    name="crowded",
)
ROUND = Arena(
    (0, 0, 1),
    holes=[(0.3, 0.2, 0.2), [(-0.5, -0.5), (-0.2, -0.5), (-0.3, -0.1)]],
    walls=[[(-0.6, 0.3), (-0.1, 0.5)]],
    name="round",
)
ARENAS = [named_arena(name) for name in NAMES] + [CROWDED, ROUND, Arena.rooms(4)]
by_name = pytest.mark.parametrize("arena", ARENAS, ids=lambda arena: arena.name)


def inside(arena, n=200, seed=0):
    x_min, x_max, y_min, y_max = arena.bounds
    low, high = [x_min, y_min], [x_max, y_max]
    found = np.random.default_rng(seed).uniform(low, high, (6 * n, 2))
    return found[arena.contains(found)][:n]


def faces(arena):
    """Sides with the free space on their left, and walls: start, end, whether one-sided."""
    found = []
    for outline in [arena.boundary, *arena.holes]:
        if outline.ndim == 2:
            loop = outline if outline is arena.boundary else outline[::-1]
            found += [(loop[i - 1], loop[i], True) for i in np.roll(range(len(loop)), -1)]
    return found + [(a, b, False) for a, b in arena.walls]


def cut(p, q, a, b):
    """Where on pq the segment ab crosses it, 0 to 1, or None: by solving the two equations."""
    matrix = np.column_stack([q - p, a - b])
    if abs(np.linalg.det(matrix)) < 1e-14:
        return None
    along, across = np.linalg.solve(matrix, a - p)
    return along if 0 <= across <= 1 else None


def hidden(arena, p, q):
    for a, b, _ in faces(arena):
        at = cut(p, q, a, b)
        if at is not None and 1e-7 < at < 1 - 1e-7:
            return True
    for pillar in arena.holes:
        if pillar.ndim == 1:
            way = p + np.linspace(0, 1, 2001)[:, None] * (q - p)
            if np.hypot(*(way - pillar[:2]).T).min() < pillar[2] - 1e-6:
                return True
    return False


def brute_force(arena, p, reach):
    """One position, wall by wall, from the definition."""
    found = []
    for a, b, one_sided in faces(arena):
        along = (p - a) @ (b - a) / ((b - a) @ (b - a))
        left = (b - a)[0] * (p - a)[1] - (b - a)[1] * (p - a)[0] >= 0
        found.append((a + along * (b - a), 0 <= along <= 1 and (left or not one_sided)))
    for outline in [arena.boundary, *arena.holes]:
        if outline.ndim == 1:
            out = p - outline[:2]
            found.append((outline[:2] + outline[2] * out / np.hypot(*out), True))
    distance, bearing = np.full(len(found), np.inf), np.zeros(len(found))
    for k, (foot, seen) in enumerate(found):
        gap = foot - p
        if seen and np.hypot(*gap) <= reach and not hidden(arena, p, foot):
            distance[k], bearing[k] = np.hypot(*gap), math.atan2(gap[1], gap[0])
    return distance, bearing


@by_name
def test_walls_are_those_of_the_definition_applied_wall_by_wall(arena):
    # The walls are numbered sides of the boundary, of the holes, free ones, circles: check order.
    positions = inside(arena, 60)
    for reach in (0.3, math.inf):
        distance, bearing = arena.walls_near(positions, reach)
        expected = [brute_force(arena, p, reach) for p in positions]
        np.testing.assert_allclose(distance, [d for d, _ in expected], atol=1e-12)
        turn = np.exp(1j * bearing) - np.exp(1j * np.array([b for _, b in expected]))
        assert np.abs(turn).max() < 1e-9


@by_name
def test_the_distance_along_the_bearing_lands_on_the_wall(arena):
    positions = inside(arena)
    distance, bearing = arena.walls_near(positions, 0.7)
    i, k = np.nonzero(distance < np.inf)
    foot = positions[i] + distance[i, k, None] * np.column_stack(
        [np.cos(bearing[i, k]), np.sin(bearing[i, k])]
    )
    assert len(i) > 100
    assert arena.clearance(foot).max() < 1e-9
    assert (bearing <= math.pi).all()
    assert (bearing > -math.pi).all()


@by_name
def test_the_beam_towards_a_foot_measures_its_distance(arena):
    positions = inside(arena, 100)
    distance, bearing = arena.walls_near(positions, 0.7)
    i, k = np.nonzero(distance < np.inf)
    seen = arena.ranges(positions[i], bearing[i, k], 1, 10.0)[:, 0]
    np.testing.assert_allclose(seen, distance[i, k], atol=1e-9)


@by_name
def test_no_beam_is_shorter_than_the_clearance_and_each_ends_on_a_wall(arena):
    positions, beams = inside(arena, 50), 2 * np.pi * np.arange(90) / 90
    headings = np.random.default_rng(1).uniform(-4, 4, len(positions))
    ranges = arena.ranges(positions, headings, 90, math.inf)
    assert np.isfinite(ranges).all()
    assert (ranges.min(axis=1) > arena.clearance(positions) - 1e-12).all()
    angle = headings[:, None] + beams
    ends = positions[:, None] + ranges[..., None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    assert arena.clearance(ends.reshape(-1, 2)).max() < 1e-9
    halfway = (positions[:, None] + ends) / 2
    assert arena.contains(halfway.reshape(-1, 2)).all()
    near = arena.ranges(positions, headings, 90, 0.4)
    np.testing.assert_array_equal(near, np.where(ranges <= 0.4, ranges, np.inf))


@given(
    turn=st.floats(-4, 4),
    x=st.floats(-30, 30),
    y=st.floats(-30, 30),
    which=st.sampled_from([CROWDED, ROUND]),
)
@settings(max_examples=30, deadline=None)
def test_turning_arena_and_animal_together_changes_only_the_bearings(turn, x, y, which):
    rotation = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])

    def move(outline):
        outline = np.asarray(outline)
        if outline.ndim == 1:
            return np.append(rotation @ outline[:2] + (x, y), outline[2])
        return outline @ rotation.T + (x, y)

    positions = inside(which, 40)
    moved = Arena(
        move(which.boundary), *([move(o) for o in os] for os in (which.holes, which.walls))
    )
    distance, bearing = which.walls_near(positions, 0.5)
    there, turned = moved.walls_near(move(positions), 0.5)
    np.testing.assert_allclose(there, distance, atol=1e-10)
    off = np.exp(1j * (turned - bearing - turn))[distance < np.inf]
    np.testing.assert_allclose(off, 1.0, atol=1e-7)


def test_a_wall_whose_foot_lies_beyond_its_end_is_not_seen():
    # Beside the reflex corner at (1, 1) of an L: both its sides end there.
    ell = Arena([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)])
    assert np.isinf(ell.walls_near([(0.9, 0.9)], 0.3)[0]).all()
    assert ell.clearance([(0.9, 0.9)])[0] == pytest.approx(math.hypot(0.1, 0.1))


def test_no_wall_is_seen_through_the_wall_between_two_rooms():
    rooms = named_arena("two_rooms")
    distance, bearing = rooms.walls_near([(-0.2, 0.3), (0.2, 0.3)], math.inf)
    left_end, right_end = bearing == math.pi, (bearing == 0.0) & (distance < np.inf)
    assert distance[0, left_end[0]].tolist() == pytest.approx([0.8])
    assert distance[0, right_end[0]].tolist() == pytest.approx([0.2])  # the wall between
    assert distance[1, left_end[1]].tolist() == pytest.approx([0.2])  # seen from both sides
    through_the_door, _ = rooms.walls_near([(-0.2, 0.0)], math.inf)
    assert through_the_door[0, 1] == pytest.approx(1.2)


def test_a_position_at_a_wall_sees_it_but_not_through_it():
    square = named_arena("square")
    at_wall = [(1.0 + 1e-12, 0.25), (1.0 - 1e-12, 0.25), (1.0, 0.25)]
    assert square.contains(at_wall).all()
    np.testing.assert_allclose(square.walls_near(at_wall, 0.3)[0][:, 1], 0.0, atol=1e-9)
    ranges = square.ranges(at_wall, [0.0] * 3, 4, math.inf)
    np.testing.assert_allclose(ranges[:, [0, 2]], [[0.0, 2.0]] * 3, atol=1e-9)
    rooms = named_arena("two_rooms")
    assert rooms.ranges([(-1e-12, 0.3)], [0.0], 2, 9.0)[0] == pytest.approx([0.0, 1.0])
    assert rooms.ranges([(1e-12, 0.3)], [0.0], 2, 9.0)[0] == pytest.approx([1.0, 0.0])


def test_a_position_that_is_not_known_sees_nothing():
    for arena in ARENAS:
        assert np.isinf(arena.walls_near([(np.nan, 0.0)], math.inf)[0]).all()
        assert not arena.contains([(np.nan, 0.0)])[0]


@by_name
def test_the_nearest_walls_are_the_first_of_all_in_order(arena):
    positions = inside(arena, 50)
    distance, bearing = arena.walls_near(positions, 0.6)
    nearest, towards = arena.nearest_walls(positions, 0.6, arena.n_walls + 2)
    np.testing.assert_array_equal(nearest[:, :-2], np.sort(distance, axis=1))
    assert np.isinf(nearest[:, -2:]).all()
    pairs = [sorted(zip(*row, strict=True)) for row in zip(distance, bearing, strict=True)]
    again = [sorted(zip(*row, strict=True))[:-2] for row in zip(nearest, towards, strict=True)]
    assert [p[:1] for p in pairs] == [p[:1] for p in again]
    np.testing.assert_array_equal(arena.nearest_walls(positions, 0.6, 1)[0], nearest[:, :1])


@by_name
def test_an_arena_is_read_back_from_its_arrays(arena, tmp_path):
    np.savez(tmp_path / "arena.npz", **arena.to_arrays())
    with np.load(tmp_path / "arena.npz") as arrays:
        again = Arena.from_arrays(arrays)
    positions = inside(arena, 100)
    for ours, theirs in zip(
        arena.walls_near(positions, 1.0), again.walls_near(positions, 1.0), strict=True
    ):
        np.testing.assert_array_equal(ours, theirs)


@by_name
def test_outlines_lie_on_the_walls_within_the_bounds(arena):
    points = np.concatenate(arena.outlines)
    assert arena.clearance(points).max() < 1e-9
    x_min, x_max, y_min, y_max = arena.bounds
    assert (points.min(axis=0) >= [x_min - 1e-9, y_min - 1e-9]).all()
    assert (points.max(axis=0) <= [x_max + 1e-9, y_max + 1e-9]).all()
    n_closed = 1 + len(arena.holes)
    assert all(np.array_equal(line[0], line[-1]) for line in arena.outlines[:n_closed])


def test_the_sense_of_the_vertices_does_not_matter():
    turned = Arena(
        CROWDED.boundary[::-1],
        [hole[::-1] if hole.ndim == 2 else hole for hole in CROWDED.holes],
        [wall[::-1] for wall in CROWDED.walls],
    )
    positions = inside(CROWDED)
    ours, theirs = (np.sort(a.walls_near(positions, 0.5)[0]) for a in (CROWDED, turned))
    np.testing.assert_allclose(ours, theirs, atol=1e-12)


def test_only_arenas_without_hidden_walls_are_convex():
    convex = {arena.name for arena in ARENAS if arena.is_convex}
    assert convex == set(NAMES) - {"two_rooms", "pillar"}
    assert not Arena([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)]).is_convex
    assert Arena([(0, 0), (1, 0), (2, 0), (2, 1), (0, 1)]).is_convex  # a wall in two pieces


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("triangle", "simulated_triangle"),
        ("pentagon", "simulated_pentagon"),
        ("nonagon", "simulated_nonagon"),
        ("circle2m", "hafting2005_circle2m"),
    ],
)
def test_recorded_animals_stay_inside_the_arena_of_their_recording(shared, name, file):
    with np.load(shared / "data" / "rodent" / f"{file}.npz") as arrays:
        arena = Arena.from_arrays(arrays, file)
        positions = arrays["pos"]
    assert arena.bounds == pytest.approx(named_arena(name).bounds)
    arena.check_inside(positions)
    distance, _ = arena.walls_near(positions, 0.3)
    assert 0.05 < (distance < np.inf).any(axis=1).mean() < 0.95


def test_the_rat_of_the_small_circle_was_tracked_a_little_past_its_wall(shared):
    with np.load(shared / "data" / "rodent" / "sargolini2006_circle1m.npz") as arrays:
        arena, positions = Arena.from_arrays(arrays, "sargolini"), arrays["pos"]
    outside = ~arena.contains(positions)
    assert 0 < outside.mean() < 0.01
    assert arena.clearance(positions[outside]).max() < 0.02
    assert np.isinf(arena.walls_near(positions[outside], 0.3)[0]).all()
    with pytest.raises(SourceError, match=r"position 10285 is .* outside the arena, as are 580 of"):
        arena.check_inside(positions)


BOX = [(0, 0), (2, 0), (2, 2), (0, 2)]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Arena([(0, 0), (1, 0)]), "arena: the boundary has shape (2, 2); expected"),
        (lambda: Arena([(0, 0), (1, 0), (1, 0)]), "side 1 has length 0"),
        (lambda: Arena([*BOX, (0, 0)]), "side 4 has length 0"),
        (lambda: Arena([(0, 0), (1, 1), (1, 0), (0, 1)]), "crosses itself at sides 0 and 2"),
        (lambda: Arena([(0, 0), (2, 0), (1, 0)]), "crosses itself"),
        (lambda: Arena([(0, 0), (1, np.nan), (1, 1)]), "not finite"),
        (lambda: Arena.circle(-0.5), "radius -0.5 m; expected more than 0"),
        (lambda: Arena.circle(np.nan), "not finite"),
        (lambda: Arena.regular(2, 1.0), "at least 3"),
        (lambda: Arena(BOX, [[(1, 1), (3, 1), (1, 1.5)]]), "hole 0 crosses or touches"),
        (lambda: Arena(BOX, [[(5, 5), (6, 5), (5, 6)]]), "hole 0 lies outside"),
        (lambda: Arena(BOX, [(1, 1, 1.2)]), "hole 0 crosses or touches"),
        (lambda: Arena(BOX, [(1, 1, 9)]), "hole 0 lies outside"),
        (lambda: Arena((0, 0, 1), [(0, 0.5, 0.5)]), "hole 0 crosses or touches"),
        (lambda: Arena((0, 0, 1), [BOX]), "hole 0 crosses or touches"),
        (lambda: Arena(BOX, [(1, 1, 0.3), (1, 1, 0.1)]), "hole 1 and hole 0 touch or overlap"),
        (lambda: Arena(BOX, walls=[[(1, 1), (3, 1)]]), "crosses the boundary or a hole"),
        (lambda: Arena(BOX, [(1, 1, 0.3)], [[(0, 1), (2, 1)]]), "crosses the boundary or a hole"),
        (lambda: Arena(BOX, walls=[[(3, 1), (4, 1)]]), "lies outside the arena"),
        (lambda: Arena(BOX, walls=[[(1, 1), (1, 1)]]), "wall 0 has length 0"),
        (lambda: Arena(BOX, walls=[[(1, 1), (1, np.inf)]]), "wall 0 has shape"),
        (lambda: Arena.rooms(2, door_m=1.0), "expected at least 1 room"),
        (lambda: Arena.from_arrays({"pos": np.zeros(3)}, "x.npz"), "x.npz: has the arrays pos; ex"),
        (lambda: Arena(BOX).check_inside([(1, 1), (3, 1)]), "position 1 is (3, 1) m, outside"),
        (lambda: Arena(BOX).walls_near((1, 1), 0.3), "positions of shape (2,); expected (n, 2)"),
        (lambda: Arena(BOX).walls_near([(1, 1)], 0.0), "reach_m is 0.0; expected"),
        (lambda: Arena(BOX).ranges([(1, 1)], 0.0, 8, 1.0), "one heading per position"),
        (lambda: named_arena("maze"), "no arena is named 'maze'; expected one of"),
    ],
)
def test_an_invalid_arena_is_a_one_line_error(make, message):
    with pytest.raises(SourceError) as error:
        make()
    assert message in str(error.value)
    assert "\n" not in str(error.value)
