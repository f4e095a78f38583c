"""Facts about the rendered worlds: what is seen, where it is seen from, and what is measured."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from neuroslam.errors import SourceError
from neuroslam.geometry import integrate_velocities, wrap_angles
from neuroslam.types import Pose
from neuroslam.worlds.catalogue import build_world, catalogue
from neuroslam.worlds.render import Camera, cast, render
from neuroslam.worlds.scene import Sense, Surface, World, rounded_route
from neuroslam.worlds.world import OdometryNoise, WorldOptions, WorldSource, open_world

NAMES = list(catalogue())
ALIKE = ("rooms", "wallpaper", "corners")
EVERYTHING = "world:corridor?noise=0.05&light=0.3&people=3&seed=5"


def one_wall(height_m=3.0, distance_m=4.0):
    """A white wall across the view, ``distance_m`` ahead of the origin, black floor and ceiling."""
    white = np.full((64, 640, 3), 255, dtype=np.uint8)
    black = np.zeros((200, 200, 3), dtype=np.uint8)
    return World(
        name="one wall",
        description="",
        walls=np.array([[distance_m, 20.0, distance_m, -20.0]]),
        wall_strips=np.array([0]),
        wall_offsets_m=np.zeros(1),
        strips=[(white, 64 / height_m)],
        ground=Surface(black, 2.0, -50.0, -50.0, 0.0),
        ceiling=Surface(black, 2.0, -50.0, -50.0, height_m),
        routes=[rounded_route([(0, 0), (1, 0), (1, 1), (0, 1)], 0.2)],
        sense=Sense(),
        haze=(0, 0, 0),
        sight_m=1e6,
    )


def same(one, other):
    return (
        one.index == other.index
        and one.time_s == other.time_s
        and np.array_equal(one.image, other.image)
        and one.velocity == other.velocity
        and one.truth == other.truth
    )


def test_a_source_delivers_the_same_frames_every_time():
    first, second = (open_world(EVERYTHING) for _ in range(2))
    pairs = zip(first.frames(40, 52), second.frames(40, 52), strict=True)
    assert all(same(one, other) for one, other in pairs)


def test_starting_later_gives_the_tail_bit_for_bit():
    source = open_world(EVERYTHING + "&laps=0.1")
    whole = list(source)
    tail = list(open_world(EVERYTHING + "&laps=0.1").frames(start=17))
    assert [frame.index for frame in tail] == list(range(17, source.n_frames))
    assert all(same(one, other) for one, other in zip(whole[17:], tail, strict=True))


def test_a_longer_drive_begins_like_a_shorter_one():
    short, long = (open_world(f"{EVERYTHING}&laps={laps}") for laps in (0.05, 3))
    assert all(same(one, long.frame(one.index)) for one in short)


@pytest.mark.parametrize("name", NAMES)
def test_truth_closes_after_whole_laps_exactly(name):
    source = open_world(f"world:{name}?laps=2")
    truths, lap = source.truths(), source.frames_per_lap
    assert len(truths) == 2 * lap + 1
    assert np.array_equal(truths[0], truths[-1])
    assert np.array_equal(truths[: lap + 1], truths[lap:])


def test_another_start_visits_the_same_places_and_sees_the_same_images():
    first = open_world("world:ellipse?laps=0.75")
    second = open_world("world:ellipse?laps=3&start=0.4")
    shift = round(0.4 * first.frames_per_lap)
    assert np.array_equal(first.truths()[shift:], second.truths()[: first.n_frames - shift])
    assert np.array_equal(first.frame(shift + 3).image, second.frame(3).image)
    later = second.frame(second.frames_per_lap + 3)
    assert np.array_equal(later.image, second.frame(3).image)


def routes():
    return [(name, i + 1) for name in NAMES for i in range(len(build_world(name).routes))]


@pytest.mark.parametrize(("name", "route"), routes())
def test_odometry_without_noise_integrates_to_the_truth(name, route):
    source = open_world(f"world:{name}?laps=1&route={route}")
    velocity = source.odometry()
    track = integrate_velocities(*velocity.T, np.full(len(velocity), 0.1), source.truth(0))
    truth = source.truths()
    assert np.abs(wrap_angles(track[:, 2] - truth[:, 2])).max() < 1e-9
    # Integration moves along the heading at the end of a step, the robot along an arc: half the
    # turn of a step is missing in each, which over a bend of any radius adds up to 0.71 steps.
    step = source.route.length_m / source.frames_per_lap
    assert np.hypot(*(track - truth)[:, :2].T).max() < 4 * step


def test_frames_carry_the_velocity_over_the_interval_that_ends_at_them():
    source = open_world("world:corridor?rate=20&frames_per_lap=400")
    assert source.frame(0).velocity == (0.0, 0.0)
    assert source.frame(3).time_s == 0.15
    straight = source.frame(1).velocity
    assert straight.v_m_s == pytest.approx(source.route.length_m / 400 * 20)
    assert straight.w_rad_s == pytest.approx(0.0, abs=1e-9)
    turns = np.array([source.frame(n).velocity.w_rad_s for n in range(380, 400)])
    assert turns.min() > -1e-9  # counter-clockwise: only to the left


@given(level=st.floats(0.0, 0.5), seed=st.integers(0, 2**32))
def test_every_noise_term_does_what_its_unit_says(level, seed):
    true = np.column_stack([np.full(50, 2.0), np.full(50, 0.5)])
    true[0] = 0.0
    terms = [OdometryNoise()._replace(**{field: level}) for field in OdometryNoise._fields]
    scaled, shaken, turned, jittered, biased = (t.apply(true, seed) - true for t in terms)
    np.testing.assert_allclose(scaled[1:, 0], 2.0 * level, atol=1e-12)
    np.testing.assert_allclose(turned[1:, 1], 0.5 * level, atol=1e-12)
    np.testing.assert_allclose(biased[1:, 1], level, atol=1e-12)
    assert shaken[1:, 0].std() == pytest.approx(2.0 * level, rel=0.5)
    assert jittered[1:, 1].std() == pytest.approx(level, rel=0.5)
    for change in (scaled, shaken, turned, jittered, biased):
        assert not change[0].any()


def test_noise_shifts_the_measurement_but_neither_truth_nor_image():
    clean, noisy = open_world("world:corridor"), open_world("world:corridor?noise=0.05&seed=1")
    assert np.array_equal(clean.truths(), noisy.truths())
    assert np.array_equal(clean.frame(9).image, noisy.frame(9).image)
    assert clean.frame(9).velocity != noisy.frame(9).velocity
    other = open_world("world:corridor?noise=0.05&seed=2")
    assert other.frame(9).velocity != noisy.frame(9).velocity


def test_the_panorama_rolls_when_the_robot_turns_on_the_spot():
    world = build_world("campus")
    camera = Camera(256, 64, panoramic=True, camera_height_m=1.2, horizon=0.6)
    here = Pose(*world.routes[0].at(20.0)[0])
    straight = render(world, here, camera).astype(int)
    for columns in (1, 40, 128, -17):
        turned = render(
            world, here._replace(theta_rad=here.theta_rad + columns * math.tau / 256), camera
        )
        difference = np.abs(turned - np.roll(straight, columns, axis=1))
        assert np.mean(difference > 3) < 0.005  # rounding moves a few edges by a pixel


def test_the_image_moves_right_when_the_robot_turns_left():
    world, camera = build_world("corridor"), Camera(160, 64)
    before = render(world, Pose(0.0, -3.25, 0.0), camera).mean(axis=(0, 2))
    after = render(world, Pose(0.0, -3.25, 0.1), camera).mean(axis=(0, 2))
    errors = {s: np.abs(after[20 + s : 140 + s] - before[20:140]).mean() for s in range(-20, 21)}
    assert min(errors, key=errors.get) == pytest.approx(80 * math.tan(0.1), abs=1.0)


@given(
    distance=st.floats(1.5, 12.0),
    height=st.floats(1.5, 4.0),
    turn=st.floats(-0.5, 0.5),
    panoramic=st.booleans(),
)
@settings(max_examples=25, deadline=None)
def test_a_wall_is_as_tall_as_perspective_says(distance, height, turn, panoramic):
    camera = Camera(128, 96, panoramic=panoramic, camera_height_m=1.0)
    image = render(one_wall(height, distance), Pose(0.0, 0.0, turn), camera)[..., 0] / 255.0
    column = 64  # its centre is half a pixel right of the axis
    bearing = turn + math.atan2(camera.rays[column, 1], camera.rays[column, 0])
    depth = distance / math.cos(bearing) / np.hypot(*camera.rays[column])
    up = min((height - 1.0) * camera.focal_px / depth, 48.0)
    down = min(camera.focal_px / depth, 48.0)
    assert image[:, column].sum() == pytest.approx(up + down, abs=1.0)
    assert image[:48, column].sum() == pytest.approx(up, abs=0.6)


def test_where_no_wall_faces_the_camera_there_is_none():
    *_, near = cast(one_wall(), Pose(9.0, 0.0, 0.0), Camera(16, 16).rays, 1.0)
    assert near.depth.min() > 1e5
    image = render(one_wall(), Pose(9.0, 0.0, math.pi), Camera(16, 16))
    assert image.max() == 0  # only the black floor and ceiling


def test_nearer_walls_are_taller():
    camera = Camera(64, 96)
    heights = [
        render(one_wall(3.0, d), Pose(0, 0, 0), camera)[:, 32, 0].sum() for d in (3, 4, 6, 9)
    ]
    assert heights == sorted(heights, reverse=True)
    assert len(set(heights)) == 4


@pytest.mark.parametrize(("name", "route"), routes())
def test_routes_keep_clear_of_walls_and_every_ray_ends_at_one(name, route):
    world = build_world(name)
    camera = Camera(90, 32, panoramic=True)
    for pose in world.routes[route - 1].poses(60):
        *_, near = cast(world, Pose(*pose), camera.rays, 1.0)
        assert near.depth.min() > 0.4
        assert near.depth.max() < 300.0


@pytest.mark.parametrize("name", NAMES)
def test_seen_depth_is_the_distance_to_the_nearest_segment(name):
    world = build_world(name)
    if len(world.pillars):
        world = replace(world, pillars=world.pillars[:0], pillar_strips=world.pillar_strips[:0])
    camera = Camera(64, 32, panoramic=True)
    x, y, _ = world.routes[0].at(5.0)[0]
    *_, near = cast(world, Pose(x, y, 0.0), camera.rays, 1.0)
    for ray, depth in zip(camera.rays, near.depth, strict=True):
        meets = []
        for x0, y0, x1, y1 in world.walls:
            solve = np.array([[ray[0], x0 - x1], [ray[1], y0 - y1]])
            if abs(np.linalg.det(solve)) > 1e-12:
                t, q = np.linalg.solve(solve, [x0 - x, y0 - y])
                if t > 0 and -1e-9 <= q <= 1 + 1e-9:
                    meets.append(t)
        assert depth == pytest.approx(min(meets))


def test_a_route_is_driven_at_constant_speed_along_its_heading():
    route = rounded_route([(0, 0), (6, 0), (6, 4), (0, 4)], 1.0)
    assert route.length_m == pytest.approx(20 - 8 + 2 * math.pi, rel=1e-5)
    poses = route.poses(1000)
    moved = np.diff(poses, axis=0)
    assert np.hypot(moved[:, 0], moved[:, 1]) == pytest.approx(route.length_m / 1000, rel=1e-4)
    course = np.arctan2(moved[:, 1], moved[:, 0])
    middle = poses[:-1, 2] + wrap_angles(moved[:, 2]) / 2
    assert np.abs(wrap_angles(course - middle)).max() < 5e-3
    assert route.at(-1.0) == pytest.approx(route.at(route.length_m - 1.0))


@pytest.mark.parametrize("name", [name for name in NAMES if name not in ALIKE])
def test_places_look_different(name):
    source = open_world(f"world:{name}")
    numbers = np.linspace(0, source.frames_per_lap, 9)[:8].astype(int)
    images = [source.frame(n).image.astype(float) for n in numbers]
    places = source.truths()[numbers, :2]
    for i in range(8):
        assert images[i].std() > 15
        for j in range(i):
            if math.dist(places[i], places[j]) > 1.0:  # a figure of eight passes some twice
                assert np.abs(images[i] - images[j]).mean() > 8


def test_pedestrians_change_images_but_not_truth():
    empty, busy = open_world("world:corridor"), open_world("world:corridor?people=6")
    assert np.array_equal(empty.truths(), busy.truths())
    changed = [
        np.mean(np.any(empty.frame(n).image != busy.frame(n).image, axis=2))
        for n in range(0, 300, 15)
    ]
    assert max(changed) > 0.05  # one is close at some time
    assert min(changed) < 0.5
    lap = busy.frames_per_lap
    assert not np.array_equal(busy.frame(0).image, busy.frame(lap).image)


def test_a_pedestrian_behind_a_wall_is_not_visible():
    world, camera = build_world("corridor"), Camera(160, 64)
    here, kind = Pose(0.0, -3.25, 0.0), world.people[0][0]
    billboard = type(world.billboards[0])
    empty = render(world, here, camera)
    hidden = render(world, here, camera, figures=[billboard(3.0, 0.0, 0.8, 1.8, kind)])
    seen = render(world, here, camera, figures=[billboard(3.0, -3.25, 0.8, 1.8, kind)])
    assert np.array_equal(empty, hidden)
    columns = np.flatnonzero(np.any(empty != seen, axis=(0, 2)))
    assert pytest.approx(columns.mean(), abs=1.5) == 79.5
    assert pytest.approx(np.ptp(columns), abs=7) == 80 * 0.8 / 3.0  # its image has clear margins


def test_light_drifts_slowly_within_its_bounds_and_leaves_the_truth_alone():
    source, plain = open_world("world:corridor?light=0.3"), open_world("world:corridor")
    gains = np.array([source.gain(t) for t in np.arange(0.0, 600.0, 0.1)])
    assert 0.7 <= gains.min() < 0.8
    assert 1.2 < gains.max() <= 1.3
    assert np.abs(np.diff(gains)).max() < 0.01
    assert np.array_equal(source.truths(), plain.truths())
    n = int(np.argmin(gains[:600]))
    ratio = source.frame(n).image.mean() / plain.frame(n).image.mean()
    assert ratio == pytest.approx(gains[n], abs=0.02)


def test_gain_darkens_a_whole_session():
    bright, dark = open_world("world:town"), open_world("world:town?gain=0.6")
    ratio = dark.frame(5).image.mean() / bright.frame(5).image.mean()
    assert ratio == pytest.approx(0.6, abs=0.01)


def test_another_look_paints_other_images_on_the_same_walls():
    one, other = build_world("corridor"), build_world("corridor", look=1)
    assert np.array_equal(one.walls, other.walls)
    assert not np.array_equal(one.strips[0][0], other.strips[0][0])


def test_options_set_the_camera():
    frame = open_world("world:ellipse?width=96&height=40&grey=1&panoramic=1&odometry=0").frame(2)
    assert frame.image.shape == (40, 96)
    assert frame.image.dtype == np.uint8
    assert frame.velocity is None
    assert open_world("figure_eight").frame(0).velocity is None
    assert open_world("world:campus").frame(0).image.shape == (64, 256, 3)


def test_a_campus_drive_can_be_twenty_thousand_frames_long():
    source = open_world("world:campus?route=3&laps=7")
    assert source.n_frames > 20_000
    assert source.frame(source.n_frames - 1).image.std() > 15


def test_every_world_has_a_description():
    for name, line in catalogue().items():
        assert 20 < len(line) < 100
        assert build_world(name).description == line


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("world:coridor", "world 'coridor': no such world; expected one of corridor, ellipse, .*"
         "; did you mean 'corridor'?"),
        ("world:", "world '': no such world; expected one of corridor, .*"),
        ("world:town?lapps=2", "world 'town': unknown option 'lapps'; there are laps, start, .*"
         "; did you mean 'laps'?"),
        ("world:town?laps", "world 'town': option 'laps' has no value; write laps=VALUE once"),
        ("world:town?laps=1&laps=2", "world 'town': option 'laps' is given twice; .*"),
        ("world:town?laps=many", "world 'town': option laps='many': input should be a valid .*"),
        ("world:town?laps=-1", "world 'town': option laps='-1': input should be greater than 0 .*"),
        ("world:town?laps=nan", "world 'town': option laps='nan': .* finite .*"),
        ("world:town?route=7", "world 'town': route 7 does not exist; expected 1 to 6"),
    ],
)  # fmt: skip
def test_mistakes_are_one_line_errors(spec, message):
    with pytest.raises(SourceError, match=f"^{message.replace('?', '[?]')}$") as caught:
        open_world(spec)
    assert "\n" not in str(caught.value)


def test_a_missing_frame_is_an_error():
    source = WorldSource("corridor", WorldOptions(laps=0.1))
    with pytest.raises(SourceError, match="world:corridor: no frame 99; expected 0 to 34"):
        source.frame(99)


def test_a_garage_climbs_where_its_path_does_and_comes_back_down():
    source = open_world("world:garage")
    z = source.heights()
    assert z.min() == 0.0
    assert z.max() == pytest.approx(5.4)
    assert np.allclose(np.cumsum(source.climbs()) * 0.1, z)
    frame = source.frame(400)
    assert frame.v_z_m_s == source.climbs()[400]
    assert open_world("world:garage?route=2").frame(5).v_z_m_s is None
    assert open_world("world:corridor").frame(5).v_z_m_s is None


def test_storeys_of_a_garage_look_alike_and_a_drone_sees_its_height():
    garage, atrium = open_world("world:garage"), open_world("world:atrium")
    for source, alike in ((garage, True), (atrium, False)):
        truth, z = source.truths(), source.heights()
        up = np.flatnonzero(z > 2.6)
        away = np.hypot(*(truth[up, :2] - truth[5, :2]).T)
        above = int(up[away.argmin()])
        assert away.min() < 0.15
        low, high = (source.frame(n).image.astype(float) for n in (5, above))
        assert (np.abs(low - high).mean() < 8) == alike


def test_noise_of_the_climb_is_a_scale_a_bias_and_white():
    clean, noisy = (open_world(f"world:garage?noise={level}").climbs() for level in (0.0, 0.1))
    level = clean == 0.0
    assert noisy[level][1:].std() == pytest.approx(0.1, rel=0.15)
    assert (noisy - clean * 1.1)[1:].mean() == pytest.approx(0.005, abs=0.01)


@pytest.mark.parametrize(("name", "frames_per_lap", "shift"), [("corners", 224, 56)])
def test_a_quarter_of_the_loop_looks_like_the_next(name, frames_per_lap, shift):
    source = WorldSource(name, WorldOptions(frames_per_lap=frames_per_lap, grey=True))
    one, twin, marked = (source.frame(k).image.astype(float) for k in (150, 150 + shift, 80))
    assert np.abs(one - twin).mean() < 3.0
    assert np.abs(one - marked).mean() > 10.0


def test_several_kidnappings_are_not_in_the_odometry():
    options = WorldOptions(frames_per_lap=40, laps=2.0, kidnapped="2:0.5,5:0.25")
    source = WorldSource("corners", options)
    truth, moved = source.truths(), source.odometry()
    jumps = np.hypot(*np.diff(truth[:, :2], axis=0).T)
    assert (np.flatnonzero(jumps > 2.0) + 1).tolist() == [20, 50]
    assert moved[1:, 0].max() < 8.0
