"""Rate maps: sums and counts add up, nothing leaks in, known fields and informations come out."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from neuroslam.errors import MapError
from neuroslam.evaluation.ratemap import (
    Bins,
    RateMaps,
    coverage,
    fields,
    rate_map,
    responding,
    spatial_information,
    spike_map,
)

ARENA = Bins.around([[-0.5, -0.5], [0.5, 0.5]], bin_m=0.05)


def wander(seed, n=4000, n_cells=3):
    """Positions in the left half of the arena, and activity there."""
    rng = np.random.default_rng(seed)
    return rng.uniform((-0.5, -0.5), (0.0, 0.5), (n, 2)), rng.gamma(2.0, 1.0, (n, n_cells))


def gathered(positions, activity):
    maps = RateMaps(ARENA, activity.shape[1])
    maps.add(positions, activity)
    return maps


@pytest.mark.parametrize("bin_m", [0.025, 0.05, 0.1, 0.07])
def test_bins_cover_every_point_and_their_edges_are_multiples(bin_m):
    points = np.random.default_rng(0).uniform(-1.3, 2.1, (500, 2))
    bins = Bins.around(points, bin_m)
    assert (bins.flat_index(points) >= 0).all()
    left, right, lower, upper = bins.extent_m
    for edge in (left, right, lower, upper):
        assert abs(math.remainder(edge, bin_m)) < 1e-9
    low, high = points.min(axis=0), points.max(axis=0)
    assert 0.0 <= low[0] - left < bin_m
    assert 0.0 <= upper - high[1] < bin_m


def test_a_box_of_whole_bins_gets_no_extra_bin():
    for half in np.arange(1, 60) * 0.025:
        assert Bins.around([[-half, -half], [half, half]]).shape == (round(half / 0.0125),) * 2


def test_rows_are_y_and_columns_are_x():
    rates = rate_map([[0.42, -0.48]], [5.0], ARENA, sigma_bins=0.0)[0]
    row, column = np.argwhere(np.isfinite(rates))[0]
    assert (row, column) == (0, 18)
    assert rates[row, column] == 5.0


def test_the_mean_of_every_bin_is_that_of_its_samples():
    positions, activity = wander(1)
    rates = rate_map(positions, activity, ARENA, sigma_bins=0.0)
    index = ARENA.flat_index(positions)
    for flat in np.unique(index):
        np.testing.assert_allclose(
            rates.reshape(3, -1)[:, flat], activity[index == flat].mean(axis=0), rtol=1e-12
        )


@given(seed=st.integers(0, 1000), cut=st.integers(0, 400))
@settings(max_examples=20, deadline=None)
def test_pieces_and_sums_of_recordings_equal_one_long_one(seed, cut):
    positions, activity = wander(seed, n=400)
    whole = gathered(positions, activity)
    pieces = gathered(positions[:cut], activity[:cut])
    joined = pieces + gathered(positions[cut:], activity[cut:])
    pieces.add(positions[cut:], activity[cut:])
    for maps in (pieces, joined):
        np.testing.assert_allclose(maps.sums, whole.sums, atol=1e-12)
        np.testing.assert_array_equal(maps.counts, whole.counts)
        np.testing.assert_allclose(maps.maps(), whole.maps(), rtol=1e-10)


def test_adding_leaves_the_parts_as_they_were():
    first, second = gathered(*wander(0)), gathered(*wander(1))
    before = first.sums.copy(), first.counts.copy()
    assert (first + second).counts.sum() == 8000
    np.testing.assert_array_equal(first.sums, before[0])
    np.testing.assert_array_equal(first.counts, before[1])


def test_samples_outside_or_lost_are_counted_and_left_out():
    maps = gathered(np.array([[0.0, 0.0], [9.0, 0.0], [np.nan, 0.1]]), np.ones((3, 2)))
    assert maps.n_outside == 2
    assert maps.counts.sum() == 1
    assert (maps + maps).n_outside == 4


@pytest.mark.parametrize("sigma_bins", [0.0, 1.0, 1.5, 4.0])
def test_a_constant_activity_gives_a_constant_map_up_to_the_edge(sigma_bins):
    positions, _ = wander(0)
    rates = rate_map(positions, np.full(len(positions), 3.7), ARENA, sigma_bins)[0]
    np.testing.assert_array_equal(np.isnan(rates[:, 11:]), True)
    np.testing.assert_allclose(rates[:, :10], 3.7, rtol=1e-12)


def test_smoothing_stays_within_the_range_of_the_rates():
    positions, activity = wander(2)
    raw, smooth = (rate_map(positions, activity, ARENA, sigma) for sigma in (0.0, 2.0))
    np.testing.assert_array_equal(np.isnan(raw), np.isnan(smooth))
    assert np.nanmin(smooth) >= np.nanmin(raw)
    assert np.nanmax(smooth) <= np.nanmax(raw)


def test_smoothing_is_the_weighted_mean_of_the_formula():
    positions, activity = wander(3, n=300)
    sigma = 1.5
    y, x = np.indices(ARENA.shape)
    maps = gathered(positions, activity)
    row, column = np.argwhere(maps.counts > 0)[20]
    apart = np.maximum(np.abs(y - row), np.abs(x - column))
    weight = np.exp(-((y - row) ** 2 + (x - column) ** 2) / (2.0 * sigma**2)) * (apart <= 6)
    expected = (weight * maps.sums).sum(axis=(1, 2)) / (weight * maps.counts).sum()
    np.testing.assert_allclose(maps.maps(sigma)[:, row, column], expected, rtol=1e-10)


def test_a_bin_with_too_few_samples_is_unvisited():
    positions = [[0.01, 0.01]] * 3 + [[0.21, 0.01]]
    assert np.isfinite(rate_map(positions, np.ones(4), ARENA)).sum() == 2
    seldom = rate_map(positions, np.ones(4), ARENA, min_occupancy_samples=2)
    assert np.isfinite(seldom).sum() == 1


def test_spikes_over_time_are_hertz():
    rng = np.random.default_rng(0)
    times = np.arange(60_000) * 0.02  # 20 minutes
    positions = np.column_stack([np.sin(0.7 * times), np.cos(0.9 * times)]) * 0.45
    spikes = np.sort(rng.uniform(0.0, times[-1], 12_000))  # 10 Hz wherever it is
    rates = spike_map(positions, times, spikes, ARENA)
    assert np.nanmean(rates) == pytest.approx(10.0, rel=0.05)  # 1 % is one deviation
    seconds = gathered(positions, np.ones((len(times), 1))).counts * 0.02
    raw = spike_map(positions, times, spikes, ARENA, sigma_bins=0.0)
    assert np.nansum(raw * seconds) == pytest.approx(12_000)


def test_spikes_before_and_after_the_track_are_left_out():
    times = np.array([0.0, 1.0, 2.0])
    rates = spike_map(np.zeros((3, 2)), times, [-5.0, 1.1, 1.9, 7.0], ARENA, sigma_bins=0.0)
    assert np.nansum(rates) == pytest.approx(2.0 / 3.0)


def test_fields_are_counted_and_measured():
    y, x = np.indices((60, 60))
    bumps = [(12, 12, 3.0), (45, 15, 3.0), (30, 45, 6.0)]
    rates = sum(np.exp(-((x - a) ** 2 + (y - b) ** 2) / (2.0 * s**2)) for a, b, s in bumps)
    silent, never = np.zeros((60, 60)), np.full((60, 60), np.nan)
    touching = np.zeros((60, 60))
    touching[:30], touching[30, 5] = 1.0, 1.0
    found = fields(np.stack([rates, silent, touching, never, rates]), 0.02)
    assert found.n_fields.tolist() == [3, 0, 1, 0, 3]
    half_maximum_m = 2.0 * 6.0 * math.sqrt(2.0 * math.log(2.0)) * 0.02
    assert found.diameter_m[0] == pytest.approx(half_maximum_m, abs=0.02)  # a bin
    assert found.area_m2[2] == pytest.approx(1801 * 0.02**2)
    assert np.isnan(found.area_m2[[1, 3]]).all()
    assert np.isnan(found.diameter_m[[1, 3]]).all()


def test_a_small_region_is_no_field_and_unvisited_bins_separate_fields():
    rates = np.zeros((20, 20))
    rates[5:10, 2:18], rates[15, 15] = 1.0, 1.0
    assert fields(rates, 0.025).n_fields.tolist() == [1]
    assert fields(rates, 0.025, min_area_m2=0.0).n_fields.tolist() == [2]
    rates[:, 9] = np.nan
    assert fields(rates, 0.025).n_fields.tolist() == [2]


@given(seed=st.integers(0, 1000), gain=st.floats(1e-3, 1e3))
@settings(max_examples=20, deadline=None)
def test_fields_do_not_depend_on_the_unit_of_the_rates(seed, gain):
    rng = np.random.default_rng(seed)
    maps = ndimage.gaussian_filter(rng.random((4, 20, 20)), (0, 1.5, 1.5)) ** 4
    once, again = fields(maps, 0.025), fields(gain * maps, 0.025)
    np.testing.assert_array_equal(once.n_fields, again.n_fields)
    np.testing.assert_array_equal(once.area_m2, again.area_m2)


def test_one_cell_responds_alone_and_equal_cells_all():
    activity = np.array([[0.0, 1.0, 0.2, 0.49], [2.0, 2.0, 2.0, 2.0], [0.0, 0.0, 0.0, 0.0]])
    assert responding(activity).tolist() == [1, 4, 0]
    assert responding(activity, threshold=0.1).tolist() == [3, 4, 0]


def test_coverage_is_the_share_of_bins_that_can_be_visited():
    maps = np.full((2, 4, 4), np.nan)
    maps[0, :2], maps[1] = 1.0, 0.0
    assert coverage(maps).tolist() == [0.5, 1.0]
    inside = np.zeros((4, 4), bool)
    inside[:1] = True
    assert coverage(maps, inside).tolist() == [1.0, 1.0]


@pytest.mark.parametrize("share", [1, 2, 4, 8, 16])
def test_a_cell_that_fires_in_one_of_n_bins_has_log2_n_bits(share):
    rates = np.zeros(16)
    rates[: 16 // share] = 3.0
    bits = spatial_information(rates.reshape(4, 4), np.full((4, 4), 2.5))
    assert bits[0] == pytest.approx(math.log2(share), abs=1e-12)


@given(seed=st.integers(0, 1000), gain=st.floats(1e-3, 1e3))
@settings(max_examples=25, deadline=None)
def test_information_is_not_negative_and_has_no_unit_of_rate(seed, gain):
    rng = np.random.default_rng(seed)
    maps, occupancy = rng.random((3, 6, 5)), rng.random((6, 5)) + 0.01
    maps[:, rng.random((6, 5)) < 0.2] = np.nan
    bits = spatial_information(maps, occupancy)
    assert (bits >= 0.0).all()
    np.testing.assert_allclose(spatial_information(gain * maps, 7.0 * occupancy), bits, atol=1e-10)
    weight = np.where(np.isfinite(maps[0]), occupancy, 0.0).sum()
    assert (bits <= np.log2(weight / occupancy.min())).all()  # as if in the rarest bin only


def test_a_silent_cell_has_no_information():
    bits = spatial_information(np.stack([np.zeros((3, 3)), np.eye(3)]), np.ones((3, 3)))
    assert math.isnan(bits[0])
    assert bits[1] == pytest.approx(math.log2(3.0))


def test_a_recorded_grid_cell_fires_in_places(shared):
    with np.load(shared / "data" / "rodent" / "sargolini2006_circle1m.npz") as rat:
        positions, times, spikes = rat["pos"], rat["t"], rat["spikes_s"]
    bins = Bins.around(positions)
    rates = spike_map(positions, times, spikes, bins)
    visits = RateMaps(bins, 1)
    visits.add(positions, np.zeros(len(positions)))
    assert visits.n_outside == 0
    disc = math.pi * 0.5**2 / 0.025**2
    assert np.isfinite(rates).sum() == pytest.approx(disc, rel=0.05)
    raw = spike_map(positions, times, spikes, bins, sigma_bins=0.0)
    assert np.nansum(raw * visits.counts * 0.02) == pytest.approx(len(spikes))
    assert 1.0 < spatial_information(rates, visits.counts)[0] < 1.4
    with np.load(shared / "refs" / "slrb" / "gridness_oracle.npz") as saved:
        assert np.nanmax(rates) == pytest.approx(np.nanmax(saved["maps"][-1]))


here = np.array([[0.1, 0.1], [0.2, 0.1]])


@pytest.mark.parametrize(
    ("mistake", "says"),
    [
        (lambda: Bins.around(here, 0.0), "bin_m is 0, expected a positive length"),
        (lambda: Bins.around(np.zeros((0, 2))), r"Bins: 0 point\(s\)"),
        (lambda: Bins.around([[0.0, np.inf]]), r"1 point\(s\), 1 not finite"),
        (lambda: Bins.around([1.0, 2.0]), r"points have shape \(2,\), expected \(n, 2\)"),
        (lambda: rate_map(here, np.ones((3, 4))), r"shape \(3, 4\), expected \(T, N\) = \(2, 4\)"),
        (lambda: rate_map(here, [1.0, np.nan]), "activity of cell 0 is not finite"),
        (lambda: RateMaps(ARENA, 2) + RateMaps(ARENA, 3), "cannot add 3 cell.* to 2 over"),
        (lambda: spike_map(here, [0.0, 0.0], [0.0]), "2 times for 2 positions; expected .* rising"),
        (lambda: spike_map(here, [0.0], [0.0]), "1 times for 2 positions"),
        (lambda: fields(np.ones(4), 0.025), r"fields: maps have shape \(4,\)"),
        (lambda: responding(np.ones(4)), r"activity has shape \(4,\), expected \(T, N\)"),
        (lambda: coverage(np.ones((2, 2)), np.zeros((2, 2))), r"shape \(2, 2\) and 0 bin"),
        (lambda: spatial_information(np.ones((2, 2)), np.ones(3)), r"occupancy has shape \(3,\)"),
        (lambda: spatial_information(-np.ones((2, 2)), np.ones((2, 2))), "a rate is negative"),
        (lambda: spatial_information(np.ones((2, 2)), np.zeros((2, 2))), "no visited bin"),
    ],
)
def test_invalid_input_is_refused_in_one_line(mistake, says):
    with pytest.raises(MapError, match=says) as refused:
        mistake()
    assert "\n" not in str(refused.value)


def test_refused_samples_change_nothing():
    maps = gathered(*wander(0))
    sums, counts = maps.sums.copy(), maps.counts.copy()
    with pytest.raises(MapError):
        maps.add(here, np.array([[1.0, 2.0, np.nan]] * 2))
    np.testing.assert_array_equal(maps.sums, sums)
    np.testing.assert_array_equal(maps.counts, counts)
