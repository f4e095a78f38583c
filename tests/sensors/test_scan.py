import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from neuroslam.errors import BadFrame
from neuroslam.geometry import wrap_angles
from neuroslam.sensors.scan import walls_in_scan
from neuroslam.worlds.arena import Arena, named_arena

REACH_M, BEAMS = 0.3, 180
BLOCK = Arena(
    [(-1, -1), (1, -1), (1, 1), (-1, 1)],
    holes=[[(-0.2, -0.2), (0.2, -0.2), (0.2, 0.2), (-0.2, 0.2)]],
    name="block",
)


def poses(arena, n, nearest_m=0.03, farthest_m=0.4):
    """Random poses not far from a wall."""
    rng = np.random.default_rng(5)
    x_min, x_max, y_min, y_max = arena.bounds
    found = rng.uniform([x_min, y_min], [x_max, y_max], (20 * n, 2))
    found = found[arena.contains(found)]
    clear = arena.clearance(found)
    found = found[(clear > nearest_m) & (clear < farthest_m)][:n]
    return found, rng.uniform(-math.pi, math.pi, len(found)), rng


def compare(arena, noise_m, n=250):
    """Recall, share of false ones, and errors in distance (m) and bearing (rad) of the rest."""
    positions, headings, rng = poses(arena, n)
    scans = arena.ranges(positions, headings, BEAMS, 5.0)
    scans = np.maximum(scans + rng.normal(0.0, noise_m, scans.shape), 0.0)
    # Walls a little beyond reach are no false ones; those at its very edge need not be found.
    truth, bearing = arena.walls_near(positions, REACH_M + 0.03)
    n_true = n_found = n_false = 0
    errors = []
    for scan, d, b, heading in zip(scans, truth, bearing, headings, strict=True):
        seen = walls_in_scan(scan, REACH_M)
        gap = np.abs(seen[:, :1] - d)
        turn = np.abs(wrap_angles(seen[:, 1:] + heading - b))
        match = (gap < 0.04) & (turn < 0.35)
        sure = d < REACH_M - 0.03
        n_true += sure.sum()
        n_found += (match.any(axis=0) & sure).sum()
        n_false += len(seen) - match.any(axis=0).sum()
        errors += [(gap[i, k], turn[i, k]) for i, k in zip(*np.nonzero(match), strict=True)]
    errors = np.array(errors)
    return n_found / n_true, n_false / len(errors), errors[:, 0], errors[:, 1]


# Recall, share of false ones, 95 % errors in distance (m) and bearing (degrees), with 1 cm noise:
# a little worse than what was measured. Walls that are curved, or meet at flat corners, are hard.
@pytest.mark.parametrize(
    ("arena", "recall", "false", "distance_m", "bearing_deg"),
    [
        (named_arena("triangle"), 0.98, 0.01, 0.005, 2.0),
        (named_arena("square"), 0.98, 0.01, 0.005, 2.5),
        (named_arena("pentagon"), 0.97, 0.02, 0.006, 3.5),
        (named_arena("nonagon"), 0.94, 0.04, 0.008, 8.0),
        (named_arena("circle2m"), 0.98, 0.05, 0.008, 10.0),
        (named_arena("circle1m"), 0.97, 0.13, 0.010, 17.0),
        (named_arena("two_rooms"), 0.97, 0.02, 0.006, 3.5),
        (named_arena("pillar"), 0.96, 0.02, 0.008, 13.0),
        (BLOCK, 0.97, 0.02, 0.006, 2.5),
    ],
    ids=lambda value: getattr(value, "name", ""),
)
def test_a_noisy_scan_agrees_with_the_geometry(arena, recall, false, distance_m, bearing_deg):
    found, wrong, gap, turn = compare(arena, noise_m=0.01)
    assert found >= recall
    assert wrong <= false
    assert np.percentile(gap, 95) <= distance_m
    assert np.degrees(np.percentile(turn, 95)) <= bearing_deg
    assert np.median(np.degrees(turn)) <= 1.2


@pytest.mark.parametrize("name", ["triangle", "square", "circle1m", "circle2m", "pillar"])
def test_a_scan_without_noise_shows_every_wall_and_no_other(name):
    found, wrong, gap, turn = compare(named_arena(name), noise_m=0.0)
    assert found >= 0.99
    assert wrong == 0.0
    assert np.percentile(gap, 95) < 0.002
    assert np.degrees(np.percentile(turn, 95)) < 1.0


@given(heading=st.floats(-math.pi, math.pi), reach=st.floats(0.1, 0.3))
@settings(max_examples=40, deadline=None)
def test_a_corner_that_stands_out_is_no_wall(heading, reach):
    # Out from the corner at (0.2, 0.2) of a block: nearest point, but no foot.
    for away in (0.02, 0.05, 0.07):
        position = [(0.2 + away, 0.2 + away)]
        scan = BLOCK.ranges(position, [heading], BEAMS, 5.0)[0]
        assert len(walls_in_scan(scan, reach)) == 0


@given(angle=st.floats(-math.pi, math.pi), d=st.floats(0.03, 0.29), beams=st.integers(90, 400))
@settings(max_examples=60, deadline=None)
def test_a_long_wall_is_found_at_any_bearing_by_any_number_of_beams(angle, d, beams):
    bearing = 2 * np.pi * np.arange(beams) / beams
    cos = np.cos(bearing - angle)
    scan = np.full(beams, np.inf)
    scan[cos > 0.05] = d / cos[cos > 0.05]
    ((distance, towards),) = walls_in_scan(scan, REACH_M)
    assert distance == pytest.approx(d, abs=1e-6)
    assert abs(wrap_angles(np.array(towards - angle))) < 1e-4
    assert -math.pi <= towards < math.pi


def test_turning_the_animal_turns_the_bearings_by_whole_beams():
    positions, headings, rng = poses(named_arena("square"), 20)
    scans = named_arena("square").ranges(positions, headings, BEAMS, 5.0)
    for scan in np.maximum(scans + rng.normal(0.0, 0.01, scans.shape), 0.0):
        here, there = walls_in_scan(scan, REACH_M), walls_in_scan(np.roll(scan, 47), REACH_M)
        np.testing.assert_allclose(here[:, 0], there[:, 0], atol=1e-9)
        turn = wrap_angles(there[:, 1] - here[:, 1] - 47 * 2 * np.pi / BEAMS)
        np.testing.assert_allclose(turn, 0.0, atol=1e-6)


def test_a_wall_cut_short_before_its_foot_is_not_taken():
    bearing = 2 * np.pi * np.arange(BEAMS) / BEAMS
    scan = np.full(BEAMS, np.inf)
    part = slice(10, 35)  # from 20 to 70 degrees beside the foot
    scan[part] = 0.1 / np.cos(bearing[part])
    assert len(walls_in_scan(scan, REACH_M)) == 0


def test_nothing_is_found_where_nothing_is_in_reach():
    assert walls_in_scan(np.full(BEAMS, np.inf), REACH_M).shape == (0, 2)
    assert walls_in_scan(np.full(BEAMS, 1.0), REACH_M).shape == (0, 2)
    assert walls_in_scan(np.zeros(BEAMS), REACH_M).shape[1] == 2


def test_the_scan_given_is_left_as_it_was():
    scan = named_arena("square").ranges([(0.8, 0.8)], [0.3], BEAMS, 5.0)[0]
    before = scan.copy()
    assert len(walls_in_scan(scan, REACH_M)) == 2
    np.testing.assert_array_equal(scan, before)


@pytest.mark.parametrize(
    ("scan", "options", "message"),
    [
        (np.ones((2, 90)), {}, "shape (2, 90); expected (n,): metres, at least 8 beams"),
        (np.ones(7), {}, "shape (7,); expected (n,), at least 8 beams"),
        (np.array([1.0] * 9 + [np.nan]), {}, "beam 9 measures nan m; expected"),
        (np.array([1.0, -0.5] + [1.0] * 8), {}, "beam 1 measures -0.5 m; expected"),
        (np.ones(8), {"reach_m": 0.0}, "reach_m is 0.0"),
        (np.ones(8), {"tolerance_m": -1.0}, "tolerance_m is -1.0"),
    ],
)
def test_a_scan_that_cannot_be_used_is_a_bad_frame(scan, options, message):
    with pytest.raises(BadFrame) as error:
        walls_in_scan(scan, **{"reach_m": REACH_M} | options)
    assert message in str(error.value)
    assert "\n" not in str(error.value)
