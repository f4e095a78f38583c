import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from neuroslam.errors import BadFrame, ConfigError, SourceError
from neuroslam.geometry import integrate_velocities, wrap_angles
from neuroslam.sensors import open_source
from neuroslam.sensors.open import absolute_spec
from neuroslam.types import Pose
from neuroslam.worlds.arena import Arena, named_arena
from neuroslam.worlds.rodent import Walk, ornstein_uhlenbeck, ratinabox_walk, read_walk, roam
from neuroslam.worlds.senses import NO_NOISE, ArenaSource, SenseNoise, sense

ARENAS = [
    *("triangle", "square", "pentagon", "nonagon", "circle1m", "circle2m", "rectangle"),
    *("two_rooms", "pillar"),
]
HAFTING, SARGOLINI = "hafting2005_circle2m.npz", "sargolini2006_circle1m.npz"
SQUARE = named_arena("square")


def wander(n=200, seed=0, arena=SQUARE, uneven=False):
    """A short walk that stands still now and then."""
    rng = np.random.default_rng(seed)
    steps = rng.normal(0.0, 0.01, (n, 2)) * (rng.random((n, 1)) > 0.2)
    dt = rng.uniform(0.02, 0.2, n) if uneven else np.full(n, 0.05)
    return Walk.along("wander", 3.0 + np.cumsum(dt), np.cumsum(steps, axis=0), arena)


def dead_reckoned(senses):
    forward = senses.speed_m_s * senses.dt_s
    steps = forward[..., None] * np.stack(
        [np.cos(senses.heading_rad), np.sin(senses.heading_rad)], axis=-1
    )
    return senses.position_m[0] + np.cumsum(steps, axis=1)


def rmse(senses):
    off = dead_reckoned(senses) - senses.position_m
    return np.sqrt(np.mean(np.sum(off**2, axis=2), axis=1))


def refused(act):
    with pytest.raises(SourceError) as caught:
        act()
    assert "\n" not in str(caught.value)
    return str(caught.value)


walks = st.builds(wander, st.integers(2, 60), st.integers(0, 999), st.none(), st.booleans())


# Reading


def test_recorded_walks_are_read_with_their_arena_and_spikes(shared):
    hafting = read_walk(shared / "data" / "rodent" / HAFTING)
    assert len(hafting.times_s) == 29552
    assert hafting.rate_hz == pytest.approx(50.0)
    assert hafting.arena.bounds == (-1.0, 1.0, -1.0, 1.0)
    assert hafting.spikes_s is None
    sargolini = read_walk(str(shared / "data" / "rodent" / SARGOLINI))
    assert len(sargolini.spikes_s) == 673
    assert sargolini.duration_s == pytest.approx(1199.96)
    triangle = read_walk(shared / "data" / "rodent" / "simulated_triangle.npz", 1.0, 10.0)
    assert triangle.arena.n_walls == 3
    assert (triangle.duration_s, triangle.rate_hz) == (pytest.approx(60.0), pytest.approx(10.0))
    assert [w.n_dropped for w in (hafting, sargolini, triangle)] == [0, 0, 0]


def test_a_csv_gives_the_walk_that_the_npz_gives_but_for_the_arena(tmp_path):
    walk = wander()
    np.savez(tmp_path / "w.npz", t=walk.times_s, pos=walk.positions)
    rows = np.column_stack([walk.positions[:, 0], walk.times_s, walk.positions[:, 1]])
    lines = [",".join(map(repr, row)) for row in rows.tolist()]
    (tmp_path / "w.csv").write_text("x_m,time_s,y_m\n" + "\n".join(lines))
    ours, theirs = read_walk(tmp_path / "w.csv"), read_walk(tmp_path / "w.npz")
    for field in ("times_s", "positions", "headings_rad"):
        np.testing.assert_array_equal(getattr(ours, field), getattr(theirs, field))


def test_rows_without_numbers_or_with_a_time_that_does_not_rise_are_dropped_and_counted(tmp_path):
    path = tmp_path / "w.csv"
    path.write_text("time_s,x_m,y_m\n0,0,0\n9,nan,0\n1,1,0\n1,5,5\n0.5,5,5\n2,,0\n,5,5\n3,2,0\n")
    walk = read_walk(path)
    assert walk.n_dropped == 5
    assert walk.times_s.tolist() == [0, 1, 3]
    assert walk.positions[:, 0].tolist() == [0, 1, 2]
    assert walk.resampled(2).lasting(1).n_dropped == 5


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty; expected time_s,x_m,y_m: seconds and metres"),
        ("time_s,x_m,y_m\n", "has a header, but no lines"),
        ("time_s,x_m\n0,1\n", "has the columns time_s,x_m, but no y_m"),
        ("time_s,x_m,y_m\n0,1,here\n", "line 2: y_m is 'here'; expected a number"),
        ("time_s,x_m,y_m\n0,1,1\n", "1 of 1 rows have numbers and a rising time"),
        ("time_s,x_m,y_m\n1,1,1\n0,1,1\n2,,\n", "1 of 3 rows"),
    ],
)
def test_a_walk_that_cannot_be_used_says_why(tmp_path, text, message):
    path = tmp_path / "w.csv"
    path.write_text(text)
    assert message in refused(lambda: read_walk(path))
    assert "w.csv" in refused(lambda: read_walk(path))


def test_a_damaged_or_missing_npz_is_refused(tmp_path):
    path = tmp_path / "w.npz"
    assert "w.npz: no such file; expected an .npz with pos and t" in refused(
        lambda: read_walk(path)
    )
    walk = {"t": np.arange(3.0), "pos": np.eye(3, 2)}
    np.savez(path, **walk, spikes_s=np.zeros((2, 2)))
    assert "spikes_s has shape (2, 2); expected times (m,)" in refused(lambda: read_walk(path))
    np.savez(path, **walk, vertices=np.eye(2))
    refused(lambda: read_walk(path))
    np.savez(path, **walk)
    path.write_bytes(path.read_bytes()[:100])
    assert "is damaged or incomplete" in refused(lambda: read_walk(path))


def test_a_walk_of_wrong_shape_or_order_is_refused():
    two = np.zeros((2, 2))
    assert "n at least 2" in refused(lambda: Walk.along("w", [0.0], two[:1]))
    assert "positions (3, 2)" in refused(lambda: Walk.along("w", [0, 1], np.zeros((3, 2))))
    assert "times do not rise" in refused(lambda: Walk.along("w", [0, 0], two))
    assert "finite" in refused(lambda: Walk.along("w", [0, 1], two + np.nan))
    for wrong in (0.0, -1.0, math.nan, math.inf):
        assert "expected a number above 0" in refused(lambda w=wrong: wander().lasting(w))
        assert "expected a number above 0" in refused(lambda w=wrong: wander().resampled(w))


# Length and rate


@given(walks, st.floats(0.005, 2.0))
def test_a_longer_walk_goes_back_on_its_own_steps_and_never_jumps(walk, minutes):
    if minutes * 60 < walk.times_s[1] - walk.times_s[0]:
        return
    long = walk.lasting(minutes)
    span = long.times_s - long.times_s[0]
    assert np.all(np.diff(span) > 0)
    assert 60 * minutes - np.diff(walk.times_s).max() - 1e-6 <= span[-1] <= 60 * minutes + 1e-6
    # Folded back, every sample is one of the walk: a triangular wave over its duration.
    period = 2 * walk.duration_s
    folded = np.abs((span + walk.duration_s) % period - walk.duration_s)
    for axis in range(2):
        np.testing.assert_allclose(
            np.interp(folded, walk.times_s - walk.times_s[0], walk.positions[:, axis]),
            long.positions[:, axis],
            atol=1e-8,
        )
    fastest = [
        (np.hypot(*np.diff(w.positions, axis=0).T) / np.diff(w.times_s)).max() for w in (walk, long)
    ]
    assert fastest[1] <= fastest[0] * (1 + 1e-6) + 1e-12


def test_a_shorter_walk_is_its_beginning_and_keeps_its_spikes(shared):
    walk = read_walk(shared / "data" / "rodent" / SARGOLINI)
    short = walk.lasting(5)
    np.testing.assert_array_equal(short.positions, walk.positions[: len(short.positions)])
    assert short.duration_s == pytest.approx(300.0)
    assert 0 < len(short.spikes_s) < 673
    assert short.spikes_s.max() <= 300.0
    assert walk.lasting(30).spikes_s is None


def test_every_second_sample_is_half_the_rate(shared):
    walk = read_walk(shared / "data" / "rodent" / HAFTING)
    half = walk.resampled(25.0)
    np.testing.assert_allclose(half.positions, walk.positions[::2], atol=1e-9)
    np.testing.assert_allclose(half.times_s, walk.times_s[::2], atol=1e-9)


# Roaming


@pytest.mark.parametrize("name", ARENAS)
@pytest.mark.parametrize("seed", [0, 1])
def test_the_agent_stays_inside_passes_no_wall_and_goes_everywhere(name, seed):
    arena = named_arena(name)
    walk = roam(arena, 30, np.random.default_rng(seed))
    assert arena.contains(walk.positions).all()
    clearance = arena.clearance(walk.positions)
    assert clearance.min() > 0.01
    # Whoever passes a wall goes at least as far as both ends of the step are from it.
    steps = np.hypot(*np.diff(walk.positions, axis=0).T)
    assert np.all(steps < clearance[1:] + clearance[:-1])
    x0, x1, y0, y1 = arena.bounds
    edges = [np.arange(low, high + 0.2, 0.2) for low, high in ((x0, x1), (y0, y1))]
    visits, *_ = np.histogram2d(*walk.positions.T, bins=edges)
    centres = np.stack(np.meshgrid(*(e[:-1] + 0.1 for e in edges), indexing="ij"), axis=-1)
    free = arena.contains(centres.reshape(-1, 2)) & (arena.clearance(centres.reshape(-1, 2)) > 0.08)
    assert np.mean(visits.ravel()[free] > 0) > 0.9
    assert (clearance < 0.3).mean() > 0.25  # walls are there to be sensed


def test_the_agent_is_as_fast_as_asked_and_turns_smoothly():
    for speed, rate in ((0.08, 20.0), (0.2, 50.0), (0.3, 10.0), (0.08, 5.0)):
        walk = roam(SQUARE, 20, np.random.default_rng(3), rate, speed)
        assert walk.rate_hz == pytest.approx(rate)
        assert walk.duration_s == pytest.approx(1200.0)
        lengths = np.hypot(*np.diff(walk.positions, axis=0).T)
        assert lengths.mean() * rate == pytest.approx(speed, rel=0.1)
    walk = roam(SQUARE, 20, np.random.default_rng(3))
    turn = np.abs(wrap_angles(np.diff(walk.headings_rad)))
    assert np.quantile(turn, 0.99) < 0.3
    acceleration = np.diff(np.hypot(*np.diff(walk.positions, axis=0).T)) * 20 * 20
    assert np.quantile(np.abs(acceleration), 0.99) < 2.0


def test_a_walk_follows_from_its_generator_alone():
    one, two, other = (roam(SQUARE, 1, np.random.default_rng(seed)) for seed in (5, 5, 6))
    np.testing.assert_array_equal(one.positions, two.positions)
    assert not np.allclose(one.positions, other.positions)


def test_an_agent_without_room_is_refused():
    assert "expected a larger arena" in refused(
        lambda: roam(Arena.circle(0.02), 1, np.random.default_rng(0))
    )
    for numbers in ({"minutes": 0}, {"rate_hz": math.nan}, {"speed_m_s": -1}):
        wrong = {"minutes": 1, **numbers}
        assert "expected a number above 0" in refused(
            lambda w=wrong: roam(SQUARE, generator=np.random.default_rng(0), **w)
        )


def test_ratinabox_walks_in_our_arenas_and_leaves_the_global_generator_alone():
    pytest.importorskip("ratinabox", reason="the extra neuroslam[rodent] is not installed")
    triangle = [(-0.6, -0.6), (-0.3, -0.6), (-0.4, -0.3)]
    holes = Arena(SQUARE.boundary, holes=[(0.4, 0.4, 0.2), triangle], name="two holes")
    for arena in (holes, named_arena("two_rooms"), named_arena("circle1m")):
        before = np.random.get_state()[1].copy()
        one, two = (ratinabox_walk(arena, 0.5, seed=3) for _ in range(2))
        np.testing.assert_array_equal(before, np.random.get_state()[1])
        np.testing.assert_array_equal(one.positions, two.positions)
        assert arena.contains(one.positions).all()
        assert one.duration_s == pytest.approx(30.0)


def test_without_ratinabox_one_line_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "ratinabox.Agent", None)
    with pytest.raises(ConfigError, match=r"pip install neuroslam\[rodent\], or use roam"):
        ratinabox_walk(SQUARE, 1, 0)


# Slow noise


@given(st.integers(0, 999), st.integers(2, 50), st.sampled_from([1e-3, 0.1, 1.0, 100.0]))
def test_slow_noise_follows_its_recurrence_whatever_the_intervals_are(seed, n, tau):
    rng = np.random.default_rng(seed)
    normals, times = rng.standard_normal((3, n)), np.cumsum(rng.exponential(1.0, n))
    slow = ornstein_uhlenbeck(normals, times, tau)
    a = np.exp(-np.diff(times) / tau)
    np.testing.assert_array_equal(slow[:, 0], normals[:, 0])
    np.testing.assert_allclose(
        slow[:, 1:], a * slow[:, :-1] + np.sqrt(1 - a**2) * normals[:, 1:], atol=1e-12
    )
    cut = n // 2
    np.testing.assert_array_equal(
        ornstein_uhlenbeck(normals[:, :cut], times[:cut], tau), slow[:, :cut]
    )


def test_slow_noise_has_its_deviation_and_forgets_over_its_time():
    times = np.arange(0.0, 600.0, 5.0)
    normals = np.random.default_rng(0).standard_normal((4000, len(times)))
    slow = ornstein_uhlenbeck(normals, times, 120.0)
    # 4000 rows: the standard error of a deviation is 0.011, of a correlation 0.016 at most.
    np.testing.assert_allclose(slow.std(axis=0), 1.0, atol=0.05)
    for lag in (6, 24, 48):
        correlation = np.corrcoef(slow[:, 10], slow[:, 10 + lag])[0, 1]
        assert correlation == pytest.approx(math.exp(-5.0 * lag / 120.0), abs=0.05)


# Senses


@given(walks)
def test_without_noise_dead_reckoning_gives_the_walk_back(walk):
    senses = sense(walk, NO_NOISE, [1, 2])
    np.testing.assert_allclose(
        dead_reckoned(senses), np.broadcast_to(walk.positions, (2, *walk.positions.shape)),
        atol=1e-9,
    )  # fmt: skip


def test_half_an_hour_without_noise_dead_reckons_to_a_nanometre(shared):
    walk = read_walk(shared / "data" / "rodent" / "simulated_nonagon.npz")
    assert np.abs(dead_reckoned(sense(walk)) - walk.positions).max() < 1e-9


def test_no_noise_of_motion_is_exact_and_leaves_that_of_the_walls():
    walk = roam(SQUARE, 1, np.random.default_rng(0))
    still, exact = sense(walk, SenseNoise().scaled(0.0)), sense(walk)
    np.testing.assert_array_equal(still.speed_m_s, exact.speed_m_s)
    np.testing.assert_array_equal(still.heading_rad[0], walk.headings_rad)
    near = np.isfinite(exact.wall_m)
    assert near.any()
    assert np.all(still.wall_m[near] != exact.wall_m[near])


@pytest.mark.parametrize(
    ("name", "expected_m"),
    [
        ("simulated_triangle.npz", 0.205),
        ("simulated_pentagon.npz", 0.209),
        ("simulated_nonagon.npz", 0.168),
        (HAFTING, 0.219),
    ],
)
def test_path_integration_drifts_as_the_reference_did(shared, name, expected_m):
    walk = read_walk(shared / "data" / "rodent" / name)
    walk = walk.resampled(25.0).lasting(30) if name == HAFTING else walk
    drift = {factor: rmse(sense(walk, SenseNoise().scaled(factor), range(10))).mean()
             for factor in (0.3, 1.0)}  # fmt: skip
    assert expected_m / 1.5 < drift[1.0] < expected_m * 1.5
    assert drift[0.3] == pytest.approx(0.3 * drift[1.0], rel=0.05)


def test_a_row_depends_on_its_seed_alone_and_not_on_what_follows():
    walk = roam(SQUARE, 1, np.random.default_rng(0))
    three, two = sense(walk, SenseNoise(), [7, 8, 9]), sense(walk, SenseNoise(), [9, 7])
    for field in ("speed_m_s", "heading_rad", "wall_m", "wall_bearing_rad"):
        a, b = getattr(three, field), getattr(two, field)
        np.testing.assert_array_equal(a[[2, 0]], b)
        assert not np.array_equal(a[0], a[1])
    start = Walk.along("start", walk.times_s[:50], walk.positions[:50], SQUARE)
    np.testing.assert_array_equal(
        sense(start, SenseNoise(), [7]).heading_rad[0], three.heading_rad[0, :50]
    )


def test_each_term_of_the_noise_has_its_size():
    n = 20_000
    positions = np.column_stack([np.linspace(-0.9, -0.8, n), np.zeros(n)])  # beside the left wall
    walk = Walk.along("line", np.arange(n) * 0.05, positions, SQUARE)
    speed = np.hypot(*np.diff(positions, axis=0).T)[0] / 0.05
    off = dict.fromkeys(SenseNoise.model_fields, 0.0) | {"heading_slow_s": 120.0}

    def only(seeds=(0,), samples=n, **term):
        start = Walk.along("line", walk.times_s[:samples], positions[:samples], SQUARE)
        return sense(start, SenseNoise(**(off | term)), seeds)

    scales = only(range(300), 50, speed_scale=0.02).speed_m_s[:, 1:] / speed
    np.testing.assert_allclose(np.ptp(scales, axis=1), 0.0, atol=1e-9)  # one factor a run
    assert scales[:, 0].std() == pytest.approx(0.02, rel=0.15)
    factor = only(speed_factor=0.1).speed_m_s[0, 1:] / speed
    assert factor.std() == pytest.approx(0.1, rel=0.03)
    added = only(speed_add_m_s=0.01).speed_m_s[0, 1:] - speed
    assert added.std() == pytest.approx(0.01, rel=0.03)
    white = np.degrees(only(heading_white_deg=3.0).heading_rad[0])
    assert white.std() == pytest.approx(3.0, rel=0.03)
    assert abs(np.corrcoef(white[1:], white[:-1])[0, 1]) < 0.03
    slow = np.degrees(only(range(300), 2401, heading_slow_deg=2.0).heading_rad[:, ::2400])
    assert slow.std() == pytest.approx(2.0, rel=0.1)  # 300 runs, each 120 s: 3 % is one deviation
    assert np.corrcoef(slow.T)[0, 1] == pytest.approx(math.exp(-1.0), abs=0.15)
    walls = only(wall_distance_m=0.01, wall_bearing_deg=2.0)
    assert np.isfinite(walls.wall_m[0, :, 0]).all()
    assert (walls.wall_m[0, :, 0] - 1.0 - positions[:, 0]).std() == pytest.approx(0.01, rel=0.03)
    bearing = np.degrees(wrap_angles(walls.wall_bearing_rad[0, :, 0] - math.pi))
    assert bearing.std() == pytest.approx(2.0, rel=0.03)
    assert np.isinf(walls.wall_m[0, :, 1:]).all()
    assert not walls.wall_bearing_rad[0, :, 1:].any()


def test_bearings_are_to_the_true_heading_or_free_of_the_compass():
    walk = roam(SQUARE, 2, np.random.default_rng(1))
    quiet = SenseNoise(wall_distance_m=0.0, wall_bearing_deg=0.0)
    distance, alpha = SQUARE.nearest_walls(walk.positions, 0.3, 4)
    near = np.isfinite(distance)
    plain, free = (
        sense(walk, quiet, [3], compass_free_bearings=option) for option in (False, True)
    )
    np.testing.assert_array_equal(plain.wall_m[0], distance)
    for senses, heading in ((plain, walk.headings_rad), (free, free.heading_rad[0])):
        off = wrap_angles(senses.wall_bearing_rad[0] + heading[:, None] - alpha)
        np.testing.assert_allclose(off[near], 0.0, atol=1e-12)
    error = wrap_angles(plain.heading_rad[0] - walk.headings_rad)
    assert np.degrees(error).std() > 2.0


def test_senses_hold_no_nan_and_a_walk_without_an_arena_has_no_walls():
    for walk in (wander(n=2), wander(arena=None, uneven=True), wander(n=500)):
        senses = sense(walk, SenseNoise(), range(3))
        for field in senses:
            assert not np.isnan(field).any()
        assert (senses.wall_m >= 0.0).all()
        assert np.all(senses.speed_m_s[:, 0] == 0.0)
        assert senses.dt_s[0] == senses.dt_s[1]
    assert np.isinf(sense(wander(arena=None)).wall_m).all()


def test_a_negative_factor_is_refused():
    for factor in (-1.0, math.nan):
        with pytest.raises(ConfigError, match="expected a finite number, at least 0"):
            SenseNoise().scaled(factor)


# The source


def test_frames_of_a_walk_hold_what_is_sensed():
    walk = roam(SQUARE, 1, np.random.default_rng(2))
    source = ArenaSource(walk, SenseNoise(), seed=4)
    senses = sense(walk, SenseNoise(), [4])
    frames = list(source)
    assert (source.n_frames, len(frames)) == (1201, 1201)
    assert source.frame_rate_hz == pytest.approx(20.0)
    motion = np.array([f.velocity for f in frames])
    np.testing.assert_array_equal(motion[:, 0], senses.speed_m_s[0])
    np.testing.assert_array_equal([f.heading_rad for f in frames], senses.heading_rad[0])
    start = Pose(*walk.positions[0], frames[0].heading_rad)
    walked = integrate_velocities(*motion.T, senses.dt_s, start)
    np.testing.assert_allclose(walked[:, :2], dead_reckoned(senses)[0], atol=1e-9)
    for frame in frames[::50]:
        assert frame.truth[:2] == tuple(walk.positions[frame.index])
        near = np.isfinite(senses.wall_m[0, frame.index])
        np.testing.assert_array_equal(frame.walls[:, 0], senses.wall_m[0, frame.index, near])
    assert {len(f.walls) for f in frames} == {
        0,
        1,
        2,
    }  # one in the middle of a side, two in a corner
    with pytest.raises(SourceError, match="no frame 1201; expected 0 to 1200"):
        source.frame(1201)


def test_ranges_lead_to_the_walls_and_come_in_place_of_them():
    walk = roam(named_arena("circle2m"), 1, np.random.default_rng(2))
    exact = ArenaSource(walk, beams=60)
    for frame in exact.frames():
        if frame.index % 100:
            continue
        angle = frame.truth.theta_rad + 2.0 * np.pi * np.arange(60) / 60
        ends = frame.truth[:2] + frame.ranges[:, None] * np.column_stack(
            [np.cos(angle), np.sin(angle)]
        )
        np.testing.assert_allclose(np.hypot(*ends.T), 1.0, atol=1e-9)
        assert frame.walls is None
    noisy = ArenaSource(walk, SenseNoise(), beams=60)
    off = np.array([noisy.frame(i).ranges - exact.frame(i).ranges for i in range(200)])
    assert off.std() == pytest.approx(0.01, rel=0.05)
    np.testing.assert_array_equal(noisy.frame(7).ranges, noisy.frame(7).ranges)
    message = refused(lambda: ArenaSource(wander(arena=None), beams=60))
    assert "has no arena, so no ranges" in message


def test_a_track_with_an_arena_opens_with_its_walls(shared, tmp_path):
    for name in (HAFTING, "simulated_pentagon.npz"):
        source = open_source(shared / "data" / "rodent" / name)
        assert isinstance(source, ArenaSource)
        seen = [len(f.walls) for f in source.frames(0, 2000)]
        assert max(seen) >= 1
    np.savez(tmp_path / "w.npz", t=np.arange(3.0), pos=np.eye(3, 2))
    assert not isinstance(open_source(tmp_path / "w.npz"), ArenaSource)


def test_dropped_rows_of_a_track_with_an_arena_are_one_bad_frame(tmp_path):
    path = tmp_path / "w.npz"
    np.savez(path, t=np.arange(4.0), pos=[[0, 0], [1, 0], [np.nan, 0], [3, 0]], arena_radius=5.0)
    assert "1 row has no numbers" in refused(lambda: list(open_source(path)))
    faults = []
    frames = list(open_source(path).frames(on_bad_frame=faults.append))
    assert [f.time_s for f in frames] == [0, 1, 3]
    assert [type(f) for f in faults] == [BadFrame]


def test_an_arena_is_opened_by_name_with_options():
    source = open_source("arena:square?minutes=0.5&noise=0.5&seed=3&rate=10&speed=0.2&ranges=12")
    again = open_source("arena:square?seed=3&minutes=0.5&noise=0.5&rate=10&speed=0.2&ranges=12")
    assert source.n_frames == 301
    for one, two in zip(source.frames(7, 20), again.frames(7, 20), strict=True):
        assert one._replace(ranges=None) == two._replace(ranges=None)
        np.testing.assert_array_equal(one.ranges, two.ranges)
    exact = open_source("arena:two_rooms?minutes=0.1&noise=0")
    assert all(f.heading_rad == f.truth.theta_rad for f in exact)


def test_a_recorded_walk_is_opened_with_noise_length_and_rate(shared):
    path = shared / "data" / "rodent" / HAFTING
    source = open_source(f"arena:{path}?minutes=11&rate=5")
    assert source.n_frames == 11 * 60 * 5 + 1
    assert source.frame(100).heading_rad != source.frame(100).truth.theta_rad


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("arena:nowhere", "'nowhere'"),
        ("arena:square?minute=3", "arena 'square': unknown option 'minute'"),
        ("arena:square?minute=3", "did you mean 'minutes'?"),
        ("arena:square?noise", "option 'noise' has no value; write noise=VALUE once"),
        ("arena:square?noise=-1", "option noise='-1': input should be greater than or equal to 0"),
        ("arena:nowhere.npz", "nowhere.npz: no such file"),
    ],
)
def test_an_arena_that_cannot_be_opened_says_why(spec, message):
    assert message in refused(lambda: open_source(spec))


def test_an_unknown_arena_is_refused_with_the_choices():
    message = refused(lambda: open_source("arena:nowhere"))
    assert all(name in message for name in ARENAS)


def test_a_recording_without_an_arena_is_not_opened_as_one(tmp_path):
    np.savez(tmp_path / "w.npz", t=np.arange(3.0), pos=np.eye(3, 2))
    assert "contains no arena; expected vertices (n, 2) or arena_radius" in refused(
        lambda: open_source(f"arena:{tmp_path}/w.npz")
    )


def test_the_absolute_name_of_a_source_opens_from_anywhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "m.csv").touch()
    assert absolute_spec("arena:w.npz?noise=0") == f"arena:{tmp_path}/w.npz?noise=0"
    assert absolute_spec("m.csv") == f"{tmp_path}/m.csv"
    assert absolute_spec("m.csv+world:town?laps=1") == f"{tmp_path}/m.csv+world:town?laps=1"
