"""Measures of fields, directions and decoding, against pynapple, RatInABox, scipy and formulas."""

import warnings

import numpy as np
import pytest
from scipy import special, stats

from neuroslam.errors import MapError
from neuroslam.evaluation.decoding import decode_position, posterior
from neuroslam.evaluation.directions import head_direction_tuning, mean_direction
from neuroslam.evaluation.ratemap import Bins, RateMaps, spatial_information
from neuroslam.evaluation.selectivity import border_score, coherence, sparsity

BINS = Bins(0.0, 0.0, 10, 10, 0.1)
RATE_HZ = 20.0


@pytest.fixture(scope="module")
def recording():
    """Positions of 100 s in a square metre, rates of five cells, and their spikes."""
    rng = np.random.default_rng(0)
    positions = rng.uniform(0.0, 1.0, (2000, 2))  # every bin is visited
    centres = rng.uniform(0.1, 0.9, (5, 2))
    far = ((positions[:, None] - centres) ** 2).sum(-1)
    rates = 1.0 + 15.0 * np.exp(-far / (2 * 0.15**2))
    counts = rng.poisson(rates / RATE_HZ)
    return positions, rates, counts


@pytest.fixture(scope="module")
def nap():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return pytest.importorskip("pynapple", reason="needs the extra neuro")


@pytest.fixture(scope="module")
def ours(recording):
    positions, rates, _ = recording
    maps = RateMaps(BINS, 5)
    maps.add(positions, rates)
    return maps


@pytest.fixture(scope="module")
def theirs(recording, nap):
    positions, rates, _ = recording
    times = np.arange(len(positions)) / RATE_HZ
    edges = np.arange(11) / 10.0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return nap.compute_tuning_curves(
            nap.TsdFrame(times, rates),
            nap.TsdFrame(times, positions, columns=["x", "y"]),
            bins=[edges, edges],
            feature_names=["x", "y"],
        )


def test_rate_maps_are_those_of_pynapple(ours, theirs):
    # Its axes are x, y; ours are rows of y, columns of x.
    np.testing.assert_allclose(
        ours.maps(sigma_bins=0.0), theirs.values.transpose(0, 2, 1), rtol=1e-9
    )


def test_rate_maps_are_those_of_ratinabox(recording, ours):
    utils = pytest.importorskip("ratinabox.utils", reason="needs the extra rodent")
    positions, rates, _ = recording
    for cell in range(5):
        binned = utils.bin_data_for_histogramming(
            positions, np.array([0, 1, 0, 1]), 0.1, weights=rates[:, cell], norm_by_bincount=True
        )
        visited = np.isfinite(ours.maps(0.0)[cell])
        # Row 0 of its maps is the largest y.
        np.testing.assert_allclose(binned[::-1][visited], ours.maps(0.0)[cell][visited], rtol=1e-9)


def test_spatial_information_is_that_of_pynapple(ours, theirs, nap):
    wanted = nap.compute_mutual_information(theirs, rates=ours.sums.sum((1, 2)) / 2000)
    got = spatial_information(ours.maps(0.0), ours.counts)
    np.testing.assert_allclose(got, wanted["bits/spike"], rtol=1e-9)


@pytest.mark.parametrize("uniform", [True, False])
def test_the_posterior_is_that_of_pynapple(recording, ours, theirs, nap, uniform):
    _, _, counts = recording
    times = np.arange(300) / RATE_HZ
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        decoded, wanted = nap.decode_bayes(
            theirs,
            nap.TsdFrame(times, counts[:300]),
            nap.IntervalSet(times[0], times[-1]),
            bin_size=1.0 / RATE_HZ,
            uniform_prior=uniform,
        )
    got = posterior(counts[:300], ours.maps(0.0), 1.0 / RATE_HZ, None if uniform else ours.counts)
    np.testing.assert_allclose(got.transpose(0, 2, 1), wanted.values, atol=1e-9)
    best = decode_position(
        counts[:300], ours.maps(0.0), BINS, 1.0 / RATE_HZ, None if uniform else ours.counts
    )
    np.testing.assert_allclose(best.position_m, decoded.values, atol=1e-9)


def test_decoding_in_parts_is_decoding_at_once(recording, ours, monkeypatch):
    _, _, counts = recording
    whole = decode_position(counts[:50], ours.maps(0.0), BINS, 0.05)
    monkeypatch.setattr("neuroslam.evaluation.decoding._ROWS", 7)
    parts = decode_position(counts[:50], ours.maps(0.0), BINS, 0.05)
    for one, other in zip(whole, parts, strict=True):
        np.testing.assert_allclose(one, other)


def test_unvisited_bins_are_never_decoded():
    maps = np.array([[10.0, np.nan, 0.0]])
    assert posterior([[0]], maps, 0.1).round(3).tolist() == [[0.269, 0.0, 0.731]]


def test_decoding_many_cells_finds_the_animal(recording):
    positions, _, _ = recording
    rng = np.random.default_rng(1)
    centres = rng.uniform(0.0, 1.0, (60, 2))
    far = ((positions[:, None] - centres) ** 2).sum(-1)
    rates = 20.0 * np.exp(-far / (2 * 0.12**2))
    maps = RateMaps(BINS, 60)
    maps.add(positions[:1000], rates[:1000])
    counts = rng.poisson(rates[1000:] * 0.25)  # windows of 250 ms, held out
    decoded = decode_position(counts, maps.maps(0.0), BINS, 0.25)
    error = np.linalg.norm(decoded.position_m - positions[1000:], axis=1)
    assert np.median(error) < 0.08  # the diagonal of half a bin is 0.07 m


def test_what_cannot_be_decoded_is_refused():
    with pytest.raises(MapError, match=r"counts \(1, 2\), maps \(1, 3\)"):
        posterior([[0, 0]], np.ones((1, 3)), 0.1)
    with pytest.raises(MapError, match="is negative"):
        posterior([[-1]], np.ones((1, 3)), 0.1)
    with pytest.raises(MapError, match="no bin was visited"):
        posterior([[1]], np.full((1, 3), np.nan), 0.1)


def test_sparsity_is_the_share_of_the_time_in_a_field_of_one_rate():
    occupancy = np.random.default_rng(2).uniform(1.0, 3.0, (6, 6))
    field = np.zeros((6, 6))
    field[1:4, 2:5] = 7.0
    share = occupancy[field > 0].sum() / occupancy.sum()
    assert sparsity(field, occupancy)[0] == pytest.approx(share)
    assert np.isnan(sparsity(np.zeros((6, 6)), occupancy)[0])


def test_coherence_is_pearsons_correlation_with_the_mean_of_the_visited_neighbours():
    rng = np.random.default_rng(3)
    one = rng.random((8, 9))
    one[2, 3] = one[0, 0] = np.nan
    here, around = [], []
    for y, x in np.argwhere(np.isfinite(one)):
        patch = one[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2]
        here.append(one[y, x])
        around.append((np.nansum(patch) - one[y, x]) / (np.isfinite(patch).sum() - 1))
    assert coherence(one)[0] == pytest.approx(stats.pearsonr(here, around).statistic)
    assert np.isnan(coherence(np.ones((5, 5)))[0])


def test_the_border_score_of_a_hand_worked_case():
    # A field along 12 of 20 bins of the west wall, two bins deep: c = 0.6; bins at 0.5 and 1.5
    # from the wall, of 10: d = 0.1; b = 0.5 / 0.7. A second, small field does not count.
    one = np.zeros((20, 20))
    one[4:16, :2] = 5.0
    one[10, 10] = 5.0
    border = border_score(one, bin_m=0.05)
    assert border.coverage[0] == pytest.approx(0.6)
    assert border.distance[0] == pytest.approx(0.1)
    assert border.score[0] == pytest.approx(0.5 / 0.7)
    assert np.isnan(border_score(np.zeros((20, 20)), 0.05).score[0])


def test_the_border_score_does_not_depend_on_which_wall():
    one = np.random.default_rng(4).random((20, 20)) * 0.1
    one[:15, 0] = 1.0
    turned = np.stack([np.rot90(one, k) for k in range(4)])
    np.testing.assert_allclose(border_score(turned, 0.05).score, border_score(one, 0.05).score[0])


def test_mean_vectors_are_those_of_scipy():
    angles = np.random.default_rng(5).vonmises(2.0, 1.5, 400)
    ours = mean_direction(angles)
    vectors = np.column_stack([np.cos(angles), np.sin(angles)])
    theirs = stats.directional_stats(vectors)
    assert ours.length == pytest.approx(theirs.mean_resultant_length, abs=1e-12)
    assert ours.mean_rad == pytest.approx(stats.circmean(angles), abs=1e-9)
    assert ours.z == pytest.approx(400 * ours.length**2)
    twice = mean_direction(angles[:3], np.array([2.0, 1.0, 1.0]))
    assert twice == pytest.approx(mean_direction(angles[[0, 0, 1, 2]]))


def test_rayleighs_p_is_how_often_uniform_angles_have_as_long_a_vector():
    rng = np.random.default_rng(6)
    uniform = np.exp(1j * rng.uniform(0.0, 2 * np.pi, (50_000, 20)))
    lengths = np.abs(uniform.mean(axis=1))
    for length in (0.3, 0.4):
        # Angles of just this length: half of each at plus and minus arccos R.
        one = np.repeat([np.arccos(length), -np.arccos(length)], 10)
        assert mean_direction(one).p == pytest.approx((lengths >= length).mean(), abs=0.004)


def test_tuning_of_a_von_mises_cell_has_its_mean_vector_and_pynapples_curve(nap):
    heading = np.random.default_rng(7).uniform(0.0, 2 * np.pi, 20_000)
    kappa = 3.0
    rates = np.exp(kappa * (np.cos(heading - 1.0) - 1.0))
    tuned = head_direction_tuning(heading, rates, n_bins=60)
    assert tuned.preferred_rad[0] == pytest.approx(1.0, abs=0.02)
    assert tuned.length[0] == pytest.approx(special.i1(kappa) / special.i0(kappa), abs=0.01)
    times = np.arange(len(heading)) / RATE_HZ
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        theirs = nap.compute_tuning_curves(
            nap.TsdFrame(times, rates[:, None]), nap.Tsd(times, heading),
            bins=[np.linspace(0.0, 2 * np.pi, 61)],
        )  # fmt: skip
    np.testing.assert_allclose(tuned.curves, theirs.values, rtol=1e-9)


def test_looking_somewhere_more_often_does_not_make_a_cell_tuned():
    heading = np.concatenate([np.full(5000, 0.05), np.linspace(0.0, 2 * np.pi, 601)[:-1]])
    assert head_direction_tuning(heading, np.ones(len(heading))).length[0] < 1e-9
    with pytest.raises(MapError, match="expected finite"):
        head_direction_tuning([np.nan], [1.0])
