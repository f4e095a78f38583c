"""Densities as semantic pointers: sums of samples, conditioning, noise as damping."""

import math

import numpy as np
import pytest
import torch

from neuroslam.errors import MapError, SpaceError
from neuroslam.spiking.density import (
    DensityEstimator,
    encode_joint,
    encode_samples,
    given_coordinates,
    given_label,
    given_position,
    grid_of,
    maximum_entropy_density,
    rectified_density,
)
from neuroslam.spiking.gaussian import (
    encode_gaussian,
    fit_gaussian,
    gaussian_damping,
    sighting_covariance,
)
from neuroslam.spiking.pointers import SemanticPointers
from neuroslam.spiking.space import SSPSpace
from neuroslam.state.join import Join
from neuroslam.types import Pose

SPACES = {
    "hexagonal": SSPSpace.hexagonal(n_rotations=5, n_scales=5),
    "rectangular": SSPSpace.rectangular(n_rotations=5, n_scales=5),
    "random": SSPSpace.random(n_frequencies=100),
}
MEAN = torch.tensor([0.2, -0.1])


def cloud(sd, n=4000, mean=MEAN, seed=0):
    draw = torch.Generator().manual_seed(seed)
    return mean + torch.tensor(sd) * torch.randn(n, len(mean), generator=draw)


def moved(dx, dy, turn=0.0):
    return Join.nothing()._replace(onto=Pose(dx, dy, turn))


# --- densities -----------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [rectified_density, maximum_entropy_density])
@pytest.mark.parametrize("name", SPACES)
def test_a_density_is_positive_and_integrates_to_one(kind, name):
    space = SPACES[name]
    for sd in (0.02, 0.1, 0.3):
        f = kind(space, encode_samples(space, cloud((sd, sd))))
        assert f.integral == pytest.approx(1.0, abs=1e-4)
        assert bool((f.density >= 0).all())


@pytest.mark.parametrize("dimension", [1, 2, 3])
def test_a_density_has_any_dimension_and_its_cells_fill_the_bounds(dimension):
    space = SSPSpace.random(dimension, n_frequencies=50 * dimension)
    at, cell, shape = grid_of(space)
    assert cell * len(at) == pytest.approx(2.0**dimension, rel=1e-5)
    assert at.shape == (math.prod(shape), dimension)
    samples = cloud((0.1,) * dimension, mean=torch.full((dimension,), 0.3))
    f = maximum_entropy_density(space, encode_samples(space, samples), 25)
    assert f.integral == pytest.approx(1.0, abs=1e-4)
    torch.testing.assert_close(f.mean_m, torch.full((dimension,), 0.3), atol=0.02, rtol=0)


@pytest.mark.parametrize("name", SPACES)
@pytest.mark.parametrize("sd", [(0.1, 0.1), (0.2, 0.1)])
def test_mean_and_covariance_of_a_cloud_are_found_within_a_few_per_cent(name, sd):
    space, samples = SPACES[name], cloud(sd)
    z = encode_samples(space, samples)
    f = maximum_entropy_density(space, z)
    for mean, covariance in ((f.mean_m, f.covariance_m2), fit_gaussian(space, z)[:2]):
        torch.testing.assert_close(mean, samples.mean(0), atol=0.06 * sd[1], rtol=0)
        apart = (covariance - torch.cov(samples.T)).abs()
        assert float(apart.max()) < 0.04 * sd[0] ** 2


def test_rectified_similarity_is_wider_than_its_samples_and_as_wide_in_any_unit():
    z = encode_samples(SPACES["hexagonal"], cloud((0.1, 0.1)))
    f = rectified_density(SPACES["hexagonal"], z)
    assert f.points_m[f.density.argmax()] == pytest.approx(MEAN.numpy(), abs=0.05)
    assert float(f.covariance_m2[0, 0]) > 0.1**2
    wide = SSPSpace.hexagonal(
        n_rotations=5, n_scales=5, length_scale_m=200.0,
        bounds_m=torch.tensor([[-1000.0, 1000.0]] * 2),
    )  # fmt: skip
    far = rectified_density(wide, encode_samples(wide, 1000.0 * cloud((0.1, 0.1))))
    torch.testing.assert_close(1e6 * far.density, f.density, atol=2e-3, rtol=2e-3)


def test_the_entropy_of_a_wide_cloud_is_above_that_of_a_narrow_one_and_that_of_its_formula():
    space, found = SPACES["hexagonal"], []
    for sd in (0.07, 0.1, 0.15, 0.2):
        f = maximum_entropy_density(space, encode_samples(space, cloud((sd, sd))))
        found.append(f.entropy)
        assert f.entropy == pytest.approx(math.log(2 * math.pi * math.e * sd**2), abs=0.1)
    assert found == sorted(found)
    low, high = space.bounds_m.T
    flat = maximum_entropy_density(space, space.region_fourier(low, high).detach())
    assert flat.entropy == pytest.approx(math.log(4.0), abs=1e-3)  # uniform in its bounds


def test_expectations_are_those_of_the_samples():
    space, samples = SPACES["hexagonal"], cloud((0.15, 0.1))
    f = maximum_entropy_density(space, encode_samples(space, samples))
    distance = float(f.expectation(lambda x: x.norm(dim=-1)))
    assert distance == pytest.approx(float(samples.norm(dim=-1).mean()), rel=0.03)
    left = float(f.expectation(lambda x: (x[:, 0] < 0.2).double()))
    assert left == pytest.approx(0.5, abs=0.05)


def test_two_clouds_are_two_modes():
    space = SPACES["hexagonal"]
    both = torch.cat([cloud((0.08, 0.08)), cloud((0.08, 0.08), 2000, torch.tensor([-0.5, 0.6]))])
    f = maximum_entropy_density(space, encode_samples(space, both))
    upper = float(f.expectation(lambda x: (x[:, 1] > 0.25).double()))
    assert upper == pytest.approx(1 / 3, abs=0.03)


def test_weights_count_like_repetitions():
    space, x = SPACES["hexagonal"], cloud((0.2, 0.2), 3)
    twice = encode_samples(space, torch.cat([x, x[:1]]))
    torch.testing.assert_close(encode_samples(space, x, torch.tensor([2.0, 1.0, 1.0])), twice)


# --- conditioning --------------------------------------------------------------------------------

PLACES = torch.tensor([[0.6, 0.2], [-0.6, -0.6], [-0.2, 0.6], [0.5, -0.5]])
SHARES = (400, 300, 200, 100)


@pytest.fixture(scope="module")
def joint():
    space = SSPSpace.hexagonal(n_rotations=7, n_scales=7)
    names = SemanticPointers(["DOOR", "LAMP", "DESK", "BIN"], space.n_features, how="unitary")
    which = torch.repeat_interleave(torch.arange(4), torch.tensor(SHARES))
    samples = cloud((0.05, 0.05), 1000, torch.zeros(2)) + PLACES[which]
    return space, names.vectors, encode_joint(space, names.vectors[which], samples)


@pytest.mark.parametrize("k", range(4))
def test_given_a_landmark_the_density_is_where_it_is(joint, k):
    space, pointers, j = joint
    z = given_label(space, j, pointers[k], SHARES[k] / 1000)
    f = rectified_density(space, z)
    assert float((f.points_m[f.density.argmax()] - PLACES[k]).norm()) < 0.1
    whole = fit_gaussian(space, given_label(space, j, pointers[k]), free_strength=True)
    assert float((whole.mean_m - PLACES[k]).norm()) < 0.08  # of a tenth, amid the noise of the rest
    assert float(whole.strength) == pytest.approx(SHARES[k] / 1000, abs=0.1)


@pytest.mark.parametrize("k", range(4))
def test_given_a_position_the_landmark_there_is_the_likely_one(joint, k):
    space, pointers, j = joint
    likely = given_position(space, j, PLACES[k], pointers)
    assert float(likely.sum()) == pytest.approx(1.0, abs=1e-5)
    assert int(likely.argmax()) == k
    assert float(likely[k]) > 0.9
    assert not given_position(space, j, torch.tensor([-0.9, 0.1]), pointers).any()


def test_given_one_coordinate_the_other_follows_their_line():
    space = SSPSpace.hexagonal(n_rotations=7, n_scales=7)
    draw = torch.Generator().manual_seed(1)
    x = 2.0 * torch.rand(5000, generator=draw) - 1.0
    samples = torch.stack([x, -0.7 * x + 0.02 * torch.randn(5000, generator=draw)], dim=-1)
    z = encode_samples(space, samples)
    for given in (-0.6, 0.0, 0.5):
        rest, one = given_coordinates(space, z, {0: given})
        f = rectified_density(rest, one)
        assert float(f.points_m[f.density.argmax()]) == pytest.approx(-0.7 * given, abs=0.06)


# --- the module ----------------------------------------------------------------------------------


def test_a_mixture_of_two_halves_is_the_density_of_the_whole():
    space, samples = SPACES["hexagonal"], cloud((0.2, 0.1))
    first, second, whole = (DensityEstimator(space) for _ in range(3))
    first(samples[:1000])
    second(samples[1000:])
    whole(samples)
    state = first.merged(first.state_dict(), second.state_dict(), Join.nothing())
    merged = DensityEstimator(space)
    merged.load_state_dict(state)
    torch.testing.assert_close(merged.z, whole.z)
    torch.testing.assert_close(merged.density().density, whole.density().density)
    mixed = 0.25 * first.z + 0.75 * second.z
    torch.testing.assert_close(mixed, whole.z)


def test_a_merge_moves_the_samples_into_the_loaded_frame_and_refuses_to_turn_them():
    space = SPACES["hexagonal"]
    here, there, both = (DensityEstimator(space) for _ in range(3))
    here(cloud((0.1, 0.1)))
    there(cloud((0.1, 0.1)) - torch.tensor([0.3, 0.4]))
    both.load_state_dict(here.merged(here.state_dict(), there.state_dict(), moved(0.3, 0.4)))
    torch.testing.assert_close(both.z, here.z, atol=1e-5, rtol=1e-5)
    with pytest.raises(MapError, match=r"turned by 0\.500 rad.*frame of a compass"):
        here.merged(here.state_dict(), there.state_dict(), moved(0.0, 0.0, 0.5))


def test_a_density_is_saved_and_goes_on_bit_for_bit():
    space, samples = SPACES["hexagonal"], cloud((0.2, 0.1), 200)
    one, again = DensityEstimator(space), DensityEstimator(space)
    one(samples[:100])
    again.load_state_dict(one.state_dict())
    for estimator in (one, again):
        estimator(samples[100:])
    assert torch.equal(one.total, again.total)
    assert float(again.count) == 200.0


def test_what_is_no_density_is_refused():
    space = SPACES["hexagonal"]
    with pytest.raises(SpaceError, match="no samples yet"):
        _ = DensityEstimator(space).z
    with pytest.raises(SpaceError, match="at least one row of finite numbers"):
        encode_samples(space, torch.full((2, 2), math.nan))
    with pytest.raises(SpaceError, match="none negative"):
        encode_samples(space, torch.zeros(2, 2), torch.tensor([1.0, -1.0]))
    with pytest.raises(SpaceError, match="75 complex"):
        rectified_density(space, torch.zeros(3, dtype=torch.complex64))
    with pytest.raises(SpaceError, match="positive variance"):
        maximum_entropy_density(space, torch.zeros(75, dtype=torch.complex64), noise=0.0)
    with pytest.raises(SpaceError, match="at most 200000"):
        grid_of(space, 5000)
    with pytest.raises(SpaceError, match=r"axes \[7\] are known of a space of 2"):
        given_coordinates(space, torch.zeros(75, dtype=torch.complex64), {7: 0.0})
    with pytest.raises(SpaceError, match="a probability above 0"):
        given_label(space, torch.zeros(151), torch.zeros(151), 0.0)
    with pytest.raises(SpaceError, match="one of the space's features for each sample"):
        encode_joint(space, torch.zeros(3, 4), torch.zeros(3, 2))


# --- normal distributions ------------------------------------------------------------------------


def test_damping_is_the_mean_of_the_pointers_of_noisy_positions():
    space = SPACES["hexagonal"]
    spread = torch.tensor([[0.01, 0.004], [0.004, 0.006]])
    draw = torch.Generator().manual_seed(0)
    noise = torch.randn(200_000, 2, generator=draw) @ torch.linalg.cholesky(spread).T
    mean = space.encode_fourier(MEAN + noise).mean(0)
    torch.testing.assert_close(encode_gaussian(space, MEAN, spread), mean, atol=0.01, rtol=0)
    assert torch.equal(gaussian_damping(space, torch.zeros(2, 2)), torch.ones(75))


@pytest.mark.parametrize("strength", [1.0, 0.6])
def test_the_fit_finds_a_normal_distribution_again(strength):
    space = SPACES["hexagonal"]
    draw = torch.Generator().manual_seed(0)
    mean = 1.4 * torch.rand(20, 2, generator=draw) - 0.7
    root = 0.12 * torch.randn(20, 2, 2, generator=draw)
    covariance = root @ root.mT
    z = strength * encode_gaussian(space, mean, covariance)
    found = fit_gaussian(space, z, free_strength=strength < 1.0)
    torch.testing.assert_close(found.mean_m, mean, atol=1e-4, rtol=0)
    torch.testing.assert_close(found.covariance_m2, covariance, atol=2e-5, rtol=1e-3)
    torch.testing.assert_close(found.strength, torch.full((20,), strength), atol=1e-3, rtol=0)


def test_the_fit_bears_the_noise_of_neurons():
    space = SPACES["hexagonal"]
    draw = torch.Generator().manual_seed(0)
    z = encode_gaussian(space, MEAN, torch.diag(torch.tensor([0.04, 0.01])))
    noise = torch.complex(torch.randn(75, generator=draw), torch.randn(75, generator=draw))
    found = fit_gaussian(space, z + 0.05 * noise, free_strength=True)
    sd = found.covariance_m2.diagonal().sqrt()
    torch.testing.assert_close(sd, torch.tensor([0.2, 0.1]), atol=0.03, rtol=0)


def test_a_sighting_is_uncertain_along_and_across():
    v = torch.tensor([3.0, 4.0])
    values, vectors = torch.linalg.eigh(sighting_covariance(v, 0.1, 0.04))
    torch.testing.assert_close(values.sqrt(), torch.tensor([0.1, 0.2]))
    assert abs(float(vectors[:, 0] @ v)) == pytest.approx(5.0, rel=1e-4)
    draw = np.random.default_rng(0)
    r, a = 5.0 + 0.1 * draw.standard_normal(200_000), 0.04 * draw.standard_normal(200_000)
    turned = math.atan2(4.0, 3.0) + a
    points = np.stack([r * np.cos(turned), r * np.sin(turned)])
    np.testing.assert_allclose(sighting_covariance(v, 0.1, 0.04), np.cov(points), atol=4e-4)
    assert not sighting_covariance(torch.zeros(2), 0.1, 0.1).any()
    with pytest.raises(SpaceError, match="one row and column for each dimension"):
        gaussian_damping(SPACES["hexagonal"], torch.zeros(3, 3))
