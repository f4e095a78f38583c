"""A grid score is a fact about hexagons: built maps, a recorded cell, another program's scores."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from neuroslam.errors import MapError
from neuroslam.evaluation.gridness import (
    MIN_OVERLAP_BINS,
    autocorrelogram,
    grid_stats,
    gridness,
)
from neuroslam.evaluation.ratemap import Bins, spike_map

BIN_M = 0.025
MODES = ["skip", "silent"]


def lattice(spacing_bins, orientation_rad=0.0, phase=(3.0, -2.0), n=64, waves=3):
    """Cosine waves ``pi / waves`` apart: 3 make hexagons, 2 squares; fields lie at orientation."""
    y, x = np.indices((n, n)) - (n - 1) / 2.0
    wavelength = spacing_bins * (math.sqrt(0.75) if waves == 3 else 1.0)
    across = orientation_rad + (math.pi / 6.0 if waves == 3 else 0.0)
    angles = across + np.arange(waves) * math.pi / waves
    at = [np.cos(a) * (x - phase[0]) + np.sin(a) * (y - phase[1]) for a in angles]
    total = sum(np.cos(2.0 * np.pi * along / wavelength) for along in at)
    return np.maximum(total, 0.0)


def in_a_disc(rates):
    n = rates.shape[-1]
    y, x = np.indices((n, n)) - (n - 1) / 2.0
    return np.where(np.hypot(x, y) <= n / 2.0, rates, np.nan)


def noise(seed, n=64):
    return ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=(n, n)), 2.5)


def one_field(n=64, sigma=6.0, at=(8.0, 5.0)):
    y, x = np.indices((n, n)) - (n - 1) / 2.0
    return np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / (2.0 * sigma**2))


def direct_autocorrelogram(rates):
    n_y, n_x = rates.shape
    r = np.full((2 * n_y - 1, 2 * n_x - 1), np.nan)
    for dy in range(-n_y + 1, n_y):
        for dx in range(-n_x + 1, n_x):
            here = rates[max(dy, 0) : n_y + min(dy, 0), max(dx, 0) : n_x + min(dx, 0)]
            there = rates[max(-dy, 0) : n_y + min(-dy, 0), max(-dx, 0) : n_x + min(-dx, 0)]
            both = np.isfinite(here) & np.isfinite(there)
            if both.sum() >= MIN_OVERLAP_BINS:
                r[n_y - 1 + dy, n_x - 1 + dx] = np.corrcoef(here[both], there[both])[0, 1]
    return r


def direct_gridness(r):
    """The definition, one ring and one turn at a time, over the whole plane."""
    rows, columns = r.shape
    y, x = np.indices(r.shape)
    y, x = y - rows // 2, x - columns // 2
    labels, _ = ndimage.label(np.nan_to_num(r, nan=-1.0) > 0.2)
    area = (labels == labels[rows // 2, columns // 2]).sum()
    inner = math.floor(math.sqrt(area / math.pi))
    scores = []
    for outer in range(inner + 1, int(0.8 * (min(rows, columns) + 1) / 2) + 1):
        ring = (np.hypot(x, y) > inner) & (np.hypot(x, y) <= outer)
        c = {}
        for degrees in (30, 60, 90, 120, 150):
            turn = math.radians(degrees)
            at_y = math.sin(turn) * x[ring] + math.cos(turn) * y[ring] + rows // 2
            at_x = math.cos(turn) * x[ring] - math.sin(turn) * y[ring] + columns // 2
            at = np.round([at_y, at_x], 9)
            turned = ndimage.map_coordinates(r, at, order=1, cval=np.nan)
            both = np.isfinite(turned) & np.isfinite(r[ring])
            c[degrees] = np.corrcoef(turned[both], r[ring][both])[0, 1]
        scores.append(min(c[60], c[120]) - max(c[30], c[90], c[150]))
    return np.convolve(scores, np.ones(3) / 3.0, "valid").max()


@pytest.fixture(scope="module")
def oracle(shared):
    with np.load(shared / "refs" / "slrb" / "gridness_oracle.npz") as saved:
        cropped = zip(saved["maps"], saved["shapes"], strict=True)
        maps = [rates[:n_y, :n_x] for rates, (n_y, n_x) in cropped]
        return maps, saved["opexebo_grid_score"]


@pytest.mark.parametrize("share_visited", [1.0, 0.7])
def test_the_autocorrelogram_is_pearson_over_the_bins_visited_in_both(share_visited):
    rng = np.random.default_rng(4)
    maps = rng.gamma(2.0, 3.0, size=(3, 11, 14))
    maps[rng.random(maps.shape) > share_visited] = np.nan
    expected = np.stack([direct_autocorrelogram(rates) for rates in maps])
    assert np.isnan(expected).any()
    np.testing.assert_allclose(autocorrelogram(maps), expected, atol=1e-10)


def test_silent_gives_unvisited_bins_the_lowest_rate():
    maps = in_a_disc(1.0 + np.abs(noise(0, n=16)))
    filled = np.where(np.isfinite(maps), maps, np.nanmin(maps))
    expected = direct_autocorrelogram(filled)
    np.testing.assert_allclose(autocorrelogram(maps, "silent"), expected, atol=1e-9)


@given(seed=st.integers(0, 10_000), share_visited=st.floats(0.3, 1.0))
@settings(max_examples=20, deadline=None)
def test_the_autocorrelogram_is_symmetric_under_half_a_turn(seed, share_visited):
    rng = np.random.default_rng(seed)
    rates = np.where(rng.random((12, 15)) < share_visited, rng.random((12, 15)), np.nan)
    r = autocorrelogram(rates)
    np.testing.assert_allclose(r, r[::-1, ::-1], atol=1e-9)
    assert r[11, 14] == pytest.approx(1.0)
    assert np.nanmax(np.abs(r)) <= 1.0


@pytest.mark.parametrize("mode", MODES)
def test_the_score_equals_that_of_a_loop_over_rings(mode):
    for rates in (lattice(17.0, 0.2, n=50) + 2.0 * noise(1, n=50), noise(2, n=50)):
        rates = in_a_disc(rates)[:, 3:]  # not square
        expected = direct_gridness(autocorrelogram(rates, mode))
        assert float(gridness(rates, mode)) == pytest.approx(expected, abs=1e-9)


def test_a_stack_of_maps_scores_like_single_maps():
    maps = np.stack([in_a_disc(noise(seed, n=40)) for seed in range(20)]).reshape(2, 10, 40, 40)
    maps[1, 3, 5:9, 5:9] = np.nan  # one arena differs from the others
    for mode in MODES:
        scores = gridness(maps, mode)
        assert scores.shape == (2, 10)
        alone = [float(gridness(rates, mode)) for rates in maps.reshape(-1, 40, 40)]
        np.testing.assert_allclose(scores.ravel(), alone, atol=1e-9)


def test_scores_agree_with_opexebo(oracle):
    maps, expected = oracle
    scores = np.array([float(gridness(rates)) for rates in maps])
    assert (expected > 1.0).sum() == 8
    np.testing.assert_allclose(scores, expected, atol=0.035)
    clear = np.abs(expected) > 0.01
    np.testing.assert_array_equal(np.sign(scores[clear]), np.sign(expected[clear]))
    square, field, recorded = scores[-3:]
    assert square < field < recorded < scores[:8].min()
    assert recorded == pytest.approx(0.67, abs=0.005)


def test_skipping_unvisited_bins_keeps_the_order_of_the_scores(oracle):
    maps, expected = oracle
    scores = np.array([float(gridness(rates, "skip")) for rates in maps])
    np.testing.assert_allclose(scores[:8], expected[:8], atol=0.08)
    square, field, recorded = scores[-3:]
    assert square < field < recorded < scores[:8].min()


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("spacing_bins", [12.0, 17.0, 24.0])
@pytest.mark.parametrize("degrees", [-25.0, 0.0, 7.0, 15.0, 29.0])
def test_a_hexagonal_map_scores_high_at_any_orientation(spacing_bins, degrees, mode):
    rates = lattice(spacing_bins, math.radians(degrees))
    assert gridness(rates, mode) > 1.2
    assert gridness(in_a_disc(rates), mode) > 1.2


@pytest.mark.parametrize("spacing_bins", [12.0, 17.0, 24.0])
@pytest.mark.parametrize("degrees", [-25.0, 0.0, 7.0, 15.0, 29.0])
def test_spacing_and_orientation_are_those_built_in(spacing_bins, degrees):
    stats = grid_stats(in_a_disc(lattice(spacing_bins, math.radians(degrees))), BIN_M)
    assert stats.spacing_m == pytest.approx(spacing_bins * BIN_M, abs=BIN_M)
    off = math.remainder(stats.orientation_rad - math.radians(degrees), math.pi / 3.0)
    assert abs(off) < math.radians(2.0)
    assert stats.ellipticity == pytest.approx(1.0, abs=0.05)
    np.testing.assert_allclose(stats.peaks_m[3:], -stats.peaks_m[:3])
    assert 0.0 < stats.field_diameter_m < stats.spacing_m


def test_the_ellipticity_of_a_stretched_grid_is_its_stretch():
    rates = ndimage.zoom(lattice(14.0), (1.0, 1.25), order=3)
    assert grid_stats(rates, BIN_M).ellipticity == pytest.approx(1.25, abs=0.03)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("degrees", [0.0, 20.0, 45.0])
def test_a_square_grid_scores_below_zero(degrees, mode):
    rates = lattice(14.0, math.radians(degrees), waves=2)
    assert gridness(rates, mode) < 0.2
    assert gridness(in_a_disc(rates), mode) < 0.2


@pytest.mark.parametrize("mode", MODES)
def test_one_field_scores_about_zero_and_has_no_spacing(mode):
    rates = in_a_disc(one_field())
    assert abs(float(gridness(rates, mode))) < 0.05
    assert math.isnan(grid_stats(rates, BIN_M, mode).spacing_m)
    assert np.isnan(grid_stats(rates, BIN_M, mode).peaks_m).all()


def test_noise_scores_about_zero():
    scores = gridness(np.stack([in_a_disc(noise(seed)) for seed in range(60)]))
    assert abs(np.median(scores)) < 0.2
    assert np.mean(scores > 0.5) < 0.05


@pytest.mark.parametrize("mode", MODES)
@given(seed=st.integers(0, 10_000), gain=st.floats(1e-6, 1e6), offset=st.floats(-100.0, 100.0))
@settings(max_examples=15, deadline=None)
def test_the_scale_and_offset_of_the_rates_change_nothing(mode, seed, gain, offset):
    rates = in_a_disc(lattice(13.0, 0.1, n=40) + noise(seed, n=40))
    before = float(gridness(rates, mode))
    assert float(gridness(gain * (rates + offset), mode)) == pytest.approx(before, abs=1e-6)
    stats, again = grid_stats(rates, BIN_M), grid_stats(gain * (rates + offset), BIN_M)
    np.testing.assert_allclose(again.peaks_m, stats.peaks_m, atol=1e-6)


@pytest.mark.parametrize("mode", MODES)
@given(seed=st.integers(0, 10_000), quarters=st.integers(1, 3))
@settings(max_examples=15, deadline=None)
def test_a_map_turned_by_quarters_scores_the_same(mode, seed, quarters):
    rates = in_a_disc(lattice(13.0, 0.1, n=40) + noise(seed, n=40))[:36]
    before = float(gridness(rates, mode))
    assert float(gridness(np.rot90(rates, quarters), mode)) == pytest.approx(before, abs=1e-9)
    assert float(gridness(rates[:, ::-1], mode)) == pytest.approx(before, abs=0.03)  # bilinear


def test_turning_a_grid_turns_its_orientation_and_hardly_its_score():
    scores, turned = [], np.deg2rad(np.arange(0.0, 60.0, 5.0))
    for orientation in turned:
        rates = in_a_disc(lattice(16.0, orientation))
        scores.append(float(gridness(rates)))
        off = grid_stats(rates, BIN_M).orientation_rad - orientation
        assert abs(math.remainder(off, math.pi / 3.0)) < math.radians(1.0)
    assert np.ptp(scores) < 0.06


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("rate", [0.0, 0.1, 7.3, -1e9])
def test_a_constant_map_has_no_score(rate, mode):
    constant = in_a_disc(np.full((30, 30), rate))
    assert np.isnan(autocorrelogram(constant, mode)).all()
    assert math.isnan(gridness(constant, mode))
    assert np.isnan(grid_stats(constant, BIN_M, mode)[:4]).all()


@pytest.mark.parametrize("mode", MODES)
def test_an_unvisited_map_has_no_score_and_does_not_change_others(mode):
    maps = np.stack([np.full((40, 40), np.nan), lattice(11.0, n=40)])
    scores = gridness(maps, mode)
    assert math.isnan(scores[0])
    assert scores[1] == pytest.approx(float(gridness(maps[1], mode)))


def test_a_gradient_over_the_arena_leaves_no_room_for_rings():
    assert math.isnan(gridness(np.indices((30, 30))[0] + 0.0))


@pytest.mark.parametrize("function", [autocorrelogram, gridness, lambda m: grid_stats(m, BIN_M)])
@pytest.mark.parametrize(
    ("maps", "says"),
    [
        (np.ones((9, 40)), r"maps have shape \(9, 40\), expected .* at least 10 bins"),
        (np.ones(40), r"maps have shape \(40,\)"),
        (np.ones((0, 40, 40)), r"maps have shape \(0, 40, 40\)"),
        (np.full((40, 40), np.inf), "a rate is infinite"),
    ],
)
def test_an_invalid_map_is_refused_in_one_line(function, maps, says):
    with pytest.raises(MapError, match=says) as refused:
        function(maps)
    assert "\n" not in str(refused.value)


def test_an_unknown_treatment_and_many_maps_at_once_are_refused():
    with pytest.raises(MapError, match="unvisited is 'zero', expected 'skip' or 'silent'"):
        gridness(np.ones((20, 20)), "zero")
    with pytest.raises(MapError, match=r"maps of shape \(2, 20, 20\), expected one"):
        grid_stats(np.ones((2, 20, 20)), BIN_M)


def test_a_recorded_grid_cell_has_a_grid(shared):
    with np.load(shared / "data" / "rodent" / "sargolini2006_circle1m.npz") as rat:
        rates = spike_map(
            rat["pos"], rat["t"], rat["spikes_s"], Bins.around([[-0.55, -0.55], [0.55, 0.55]])
        )
    assert float(gridness(rates)) == pytest.approx(0.75, abs=0.02)
    stats = grid_stats(rates, BIN_M)
    assert stats.spacing_m == pytest.approx(0.52, abs=BIN_M)
    assert stats.ellipticity < 1.1
