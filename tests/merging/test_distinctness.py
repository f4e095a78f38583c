"""Places that repeat prove nothing, and a wrong scale shows in the shape of the common path."""

import math
from copy import deepcopy
from functools import partial
from itertools import pairwise

import numpy as np
import pytest

from neuroslam import NavigationBrain
from neuroslam.config import build_config
from neuroslam.mapping.planning import shortest_path_lengths
from neuroslam.merging.distinctness import coincidence, count_places, distinctness
from neuroslam.merging.match import find_match
from neuroslam.merging.shape import LEAST_EXTENT, SHAPE, misshapen
from neuroslam.runs.merge import join_brains
from neuroslam.state.match import Pairs
from neuroslam.worlds import alike
from neuroslam.worlds.world import WorldOptions, WorldSource

PLACES = 5


def lived(world, values, **options):
    """Drive through a world, which is built or a name of the catalogue."""
    built = None if isinstance(world, str) else world
    name = world if built is None else built.name
    source = WorldSource(name, WorldOptions(grey=True, noise=0.02, **options), built)
    brain = NavigationBrain(build_config(values))
    brain.about = (f"{name} {options}", "", "")
    for frame in source:
        brain(frame)
    return brain


def test_the_probability_of_another_place_falls_with_what_is_known_and_rises_with_what_repeats():
    by_seen = [coincidence(0, m, PLACES) for m in range(5, 60)]
    by_matched = [coincidence(0, 20, n) for n in range(1, 20)]
    by_alike = [coincidence(k, 20, PLACES) for k in np.linspace(0.0, 20.0, 41)]
    assert all(later < before for before, later in pairwise(by_seen))
    assert all(later < before for before, later in pairwise(by_matched))
    assert all(later > before for before, later in pairwise(by_alike))
    assert all(0.0 < p < 1.0 for p in by_seen + by_matched + by_alike)


@pytest.mark.parametrize("n", [5, 10, 40])
def test_where_half_of_the_places_repeat_no_number_of_matches_is_enough(n):
    assert coincidence(20, 40, n) > 0.4


def test_a_place_has_a_size_and_a_heading():
    line = np.column_stack([np.arange(10.0), np.zeros(10), np.zeros(10)])
    assert count_places(line, 0.5) == 10
    assert count_places(line, 2.0) == 4
    back = line + np.array([0.0, 0.0, math.pi])
    assert count_places(np.vstack([line, back]), 2.0) == 8
    assert count_places(line[:0], 2.0) == 0


def test_two_buildings_with_one_wallpaper_are_not_merged_and_the_reason_is_how_much_repeats():
    """What both sessions saw is equal in both buildings; without the test they are merged."""
    drives = {"start": 0.8, "laps": 0.6, "seed": 1}, {"start": 0.85, "laps": 0.6, "seed": 2}
    values = {"view": {"threshold": 0.04}}
    one, other = (lived(alike.wallpaper(1, 501 * k), values, **d) for k, d in enumerate(drives))
    strict = find_match(one, other)
    other.config = build_config({**values, "sessions": {"coincidence": 1.0}})
    lenient = find_match(one, other)
    assert strict.match is None
    assert lenient.match is not None
    assert "look like another one" in strict.reason
    assert "sessions.coincidence" in strict.reason


@pytest.fixture(scope="module")
def lap():
    small = {"width": 96, "height": 48, "laps": 1.05}
    return lived("ellipse", {}, seed=1, **small), small


@pytest.mark.parametrize(("scale", "merges"), [(0.1, True), (0.5, False), (-0.35, False)])
def test_odometry_of_another_speed_is_refused_although_its_loops_close(scale, merges, lap):
    one, small = lap
    other = lived("ellipse", {}, seed=2, speed_scale=scale, start=0.3, **small)
    merged, reports = join_brains(one, other)
    assert (merged is not None) == merges
    assert merges or "odometry" in reports[-1].reason


@pytest.mark.parametrize(("scale", "right"), [(1.0, True), (1.2, True), (1.5, False), (0.6, False)])
def test_a_path_of_another_scale_has_another_shape(scale, right, lap):
    brain, _ = lap
    ids = np.arange(brain.map.n)
    pairs = Pairs(ids, ids.copy(), np.zeros(len(ids)), np.zeros(len(ids)))
    other = deepcopy(brain.map)
    other.experiences.array("pose")[:, :2] *= scale
    assert (misshapen(brain.map, other, pairs, brain.config) == "") == right


def test_the_order_of_two_maps_does_not_change_whether_their_shapes_agree(lap):
    brain, _ = lap
    ids = np.arange(brain.map.n)
    pairs = Pairs(ids, ids.copy(), np.zeros(len(ids)), np.zeros(len(ids)))
    other, agree = deepcopy(brain.map), []
    for scale in np.linspace(0.5, 2.0, 61):
        other.experiences.array("pose")[:, :2] = scale * brain.map.poses[:, :2]
        both = ((brain.map, other), (other, brain.map))
        one, turned = (not misshapen(a, b, pairs, brain.config) for a, b in both)
        assert one == turned, scale
        agree.append(one)
    assert set(agree) == {False, True}


def test_the_shape_is_that_of_a_rigid_motion_and_short_paths_do_not_show_it(lap):
    brain, _ = lap
    ids = np.arange(brain.map.n)
    pairs = Pairs(ids, ids.copy(), np.zeros(len(ids)), np.zeros(len(ids)))
    short = pairs.pick(ids < 4)
    assert misshapen(brain.map, brain.map, pairs, brain.config, shape=0.0, strict=True) == ""
    assert misshapen(brain.map, brain.map, short, brain.config) == ""
    reason = misshapen(brain.map, brain.map, short, brain.config, shape=SHAPE, strict=True)
    cells = brain.config.pose_cells
    least = LEAST_EXTENT * cells.create_threshold_cells * cells.cell_size_m
    assert f"expected {least:.1f} m" in reason


@pytest.mark.parametrize(("drift", "linked", "counts"), [
    (0.25, True, False),  # odometry may have moved it on the way
    (0.0, True, True),
    (0.25, False, True),  # no path explains where it is
])  # fmt: skip
def test_a_revisit_that_odometry_moved_is_not_another_place(drift, linked, counts, lap):
    brain, _ = lap
    one, other = deepcopy(brain), deepcopy(brain)
    other.config = build_config({"sessions": {"drift": drift}})
    path_m, poses = brain.map.path_lengths_m(0), brain.map.poses
    moved = poses + np.outer(0.15 * path_m, [0.0, 1.0, 0.0])
    if not linked:
        far = path_m > 0.5 * path_m.max()
        for each in (one, other):
            cut = far[each.map.links.source] != far[each.map.links.target]
            each.map.path_lengths_m = partial(_path_lengths_without, each.map.links, cut)
    ids = np.flatnonzero(path_m < 1.0)
    pairs = Pairs(ids, ids.copy(), np.zeros(len(ids)), np.zeros(len(ids)))
    assert distinctness(one, other, (poses, poses), pairs, 0).alike == 0.0
    assert (distinctness(one, other, (poses, moved), pairs, 0).alike > 0.0) == counts


def _path_lengths_without(links, left_out, start):
    kept = tuple(column[~left_out] for column in links[:3])
    return shortest_path_lengths(kept, int(links.target.max()) + 1, start)
