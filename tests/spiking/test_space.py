"""Positions as vectors: the algebra holds, and the reference's numbers come out."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neuroslam.config.semantic import SSPSpaceConfig
from neuroslam.errors import SpaceError
from neuroslam.spiking.algebra import bind, identity, invert, make_unitary, similarity, unbind
from neuroslam.spiking.decoding import LearnedDecoder, PositionDecoder, probability
from neuroslam.spiking.frequencies import simplex
from neuroslam.spiking.space import SSPSpace

coordinates = st.floats(-1, 1).map(lambda x: round(x, 3))
positions = st.tuples(coordinates, coordinates).map(lambda x: torch.tensor(x, dtype=torch.float64))
SPACE = SSPSpace.hexagonal().double()


@settings(deadline=None, max_examples=50)
@given(positions, positions)
def test_binding_adds_positions(x, y):
    torch.testing.assert_close(
        bind(SPACE.encode(x), SPACE.encode(y)), SPACE.encode(x + y), atol=1e-6, rtol=0
    )
    torch.testing.assert_close(invert(SPACE.encode(x)), SPACE.encode(-x), atol=1e-9, rtol=0)


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 1000))
def test_binding_is_an_algebra(seed):
    draw = torch.Generator().manual_seed(seed)
    a, b, c = (torch.randn(55, generator=draw, dtype=torch.float64) for _ in range(3))
    torch.testing.assert_close(bind(a, b), bind(b, a))
    torch.testing.assert_close(bind(a, bind(b, c)), bind(bind(a, b), c))
    torch.testing.assert_close(bind(a, b + c), bind(a, b) + bind(a, c))
    torch.testing.assert_close(bind(a, identity(55).double()), a)
    u = make_unitary(a)
    torch.testing.assert_close(unbind(bind(b, u), u), b)
    assert float(u.norm()) == pytest.approx(1.0)


@pytest.fixture
def oracle(shared):
    return shared / "refs" / "ssp"


def test_vectors_are_those_of_the_reference(oracle):
    ref = np.load(oracle / "encode_check.npz")
    space = SSPSpace(torch.from_numpy(ref["A"][1:28]), float(ref["ls"])).double()
    space.frequencies.copy_(torch.from_numpy(ref["A"][1:28]))
    space.length_scale_m.fill_(float(ref["ls"]))
    found = space.encode(torch.from_numpy(ref["x"]))
    np.testing.assert_allclose(found, ref["phi"], atol=1e-12)


@pytest.mark.parametrize(("name", "n"), [("A55", 3), ("A151", 5)])
def test_waves_of_odd_numbers_of_orientations_are_those_of_the_reference(oracle, name, n):
    ref = np.load(oracle / "inputs_T120_limit0.08.npz")[name]
    space = SSPSpace.hexagonal(n_rotations=n, n_scales=n)
    np.testing.assert_allclose(space.frequencies, ref[1 : (len(ref) + 1) // 2], atol=1e-6)


@pytest.mark.parametrize("dimension", [1, 2, 3, 4])
@pytest.mark.parametrize("n_rotations", [1, 2, 3, 4, 6])
@pytest.mark.parametrize("make", [SSPSpace.hexagonal, SSPSpace.rectangular])
def test_all_waves_differ(make, dimension, n_rotations):
    space = make(dimension, n_rotations if dimension > 1 else 1, 3)
    w = space.frequencies
    same = torch.cdist(w, w) + 9 * torch.eye(len(w))
    assert float(torch.minimum(same, torch.cdist(w, -w)).min()) > 1e-3


@pytest.mark.parametrize("dimension", [2, 3, 5])
def test_waves_of_a_module_close(dimension):
    space = SSPSpace.hexagonal(dimension, 2, 2)
    sums = space.frequencies[space.grid_modules].sum(1)
    torch.testing.assert_close(sums, torch.zeros_like(sums), atol=1e-5, rtol=0)
    torch.testing.assert_close(simplex(dimension).norm(dim=-1), torch.ones(dimension + 1).double())


def test_random_waves_follow_from_the_seed():
    same, again, other = (SSPSpace.hexagonal(3, 3, 3, seed=s) for s in (1, 1, 2))
    assert torch.equal(same.frequencies, again.frequencies)
    assert not torch.equal(same.frequencies, other.frequencies)


def test_a_box_is_the_mean_of_its_points():
    low, high = torch.tensor([-0.3, 0.1]).double(), torch.tensor([0.2, 0.15]).double()
    x, w = np.polynomial.legendre.leggauss(24)
    share, weight = torch.from_numpy((x + 1) / 2), torch.from_numpy(w / 2)
    at = torch.stack(torch.meshgrid(share, share, indexing="ij"), -1) * (high - low) + low
    mean = (SPACE.encode_fourier(at) * (weight[:, None] * weight)[..., None]).sum((0, 1))
    torch.testing.assert_close(SPACE.region_fourier(low, high), mean, atol=1e-9, rtol=0)
    torch.testing.assert_close(SPACE.region_fourier(low, low), SPACE.encode_fourier(low))
    assert float(SPACE.region(low, high).norm()) == pytest.approx(1.0)


def test_the_gradient_is_that_of_the_vector():
    x = torch.tensor([0.2, -0.4], dtype=torch.float64)
    slope = torch.autograd.functional.jacobian(SPACE.encode, x)
    torch.testing.assert_close(SPACE.gradient(x), slope)


def test_the_kernel_is_the_dot_product_and_follows_the_length_scale():
    x, y = torch.tensor([[0.1, 0.2]]).double(), torch.tensor([[0.25, 0.1]]).double()
    dot = (SPACE.encode(x) * SPACE.encode(y)).sum(-1)
    torch.testing.assert_close(SPACE.kernel(y - x), dot)
    wide = SSPSpace.hexagonal(length_scale_m=(0.4, 0.2)).double()
    torch.testing.assert_close(
        wide.kernel(torch.tensor([0.2, 0.0]).double()),
        SPACE.kernel(torch.tensor([0.1, 0.0]).double()),
        atol=1e-6,
        rtol=0,
    )


@settings(deadline=None, max_examples=40)
@given(positions)
def test_a_vector_is_decoded_to_its_position(x):
    found = PositionDecoder(SPACE)(SPACE.encode_fourier(x).unsqueeze(0))
    torch.testing.assert_close(found.position_m[0], x, atol=1e-6, rtol=0)
    assert float(found.similarity) == pytest.approx(1.0)


@pytest.mark.parametrize("dimension", [1, 3])
def test_decoding_works_in_other_dimensions(dimension):
    space = SSPSpace.hexagonal(dimension, 3 if dimension > 1 else 1, 4, length_scale_m=0.3)
    draw = torch.Generator().manual_seed(0)
    x = 1.8 * torch.rand(20, dimension, generator=draw) - 0.9
    found = PositionDecoder(space)(space.encode_fourier(x)).position_m
    torch.testing.assert_close(found, x, atol=1e-3, rtol=0)


def test_noise_moves_the_decoded_position_by_a_little():
    draw = torch.Generator().manual_seed(0)
    x = 1.8 * torch.rand(50, 2, generator=draw, dtype=torch.float64) - 0.9
    noise = 0.3 * torch.randn(50, 27, 2, generator=draw, dtype=torch.float64)
    z = SPACE.encode_fourier(x) + torch.view_as_complex(noise)
    error = (PositionDecoder(SPACE)(z).position_m - x).norm(dim=-1)
    # 0.3 rad a wave, over root of 27 waves of about 10 rad/m: 6 mm along each axis.
    assert float(error.mean()) < 0.015


def test_a_network_learns_to_decode():
    decoder = LearnedDecoder(SSPSpace.hexagonal(), steps=600)
    x = 1.8 * torch.rand(200, 2, generator=torch.Generator().manual_seed(1)) - 0.9
    error = (decoder(SSPSpace.hexagonal().encode(x)) - x).norm(dim=-1)
    assert float(error.mean()) < 0.1


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 10_000), st.floats(0.01, 3))
def test_densities_integrate_to_one(seed, cell):
    alike = torch.randn(3, 40, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    density, bias = probability(alike, cell)
    torch.testing.assert_close(density.sum(-1) * cell, torch.ones(3, dtype=torch.float64))
    torch.testing.assert_close(density, (alike - bias.unsqueeze(-1)).clamp_min(0))


def test_gradients_reach_scales_and_frequencies():
    space = SSPSpace.hexagonal().double().requires_grad_(True)
    space.encode(torch.tensor([0.3, 0.2]).double()).square().sum().backward()
    phi = space.encode(torch.tensor([0.3, 0.2]).double())
    phi[3].backward()
    assert float(space.frequencies.grad.abs().max()) > 0
    assert float(space.length_scale_m.grad.abs().max()) > 0


def test_configs_make_each_kind_of_space():
    for kind, k in (("hexagonal", 27), ("rectangular", 18), ("random", 31)):
        space = SSPSpace.from_config(SSPSpaceConfig(kind=kind, n_random=31, reach_m=(2.0, 1.0)))
        assert space.n_frequencies == k
        assert space.bounds_m.tolist() == [[-2, 2], [-1, 1]]


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: SPACE.encode(torch.zeros(3)), r"expected \(\.\.\., 2\)"),
        (lambda: SPACE.to_fourier(torch.zeros(54)), "this space has 55"),
        (lambda: SSPSpace(torch.full((3, 2), math.nan)), "expected finite"),
        (lambda: SSPSpace(torch.ones(3, 2), -1.0), "must be positive"),
        (lambda: SSPSpace(torch.ones(3, 2), 1.0, torch.tensor([[0.0, 1], [1, 0]])), "bounds"),
        (lambda: PositionDecoder(SPACE)(torch.zeros(1, 5) + 0j), "this space has 27"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line(call, said):
    with pytest.raises(SpaceError, match=said) as error:
        call()
    assert "\n" not in str(error.value)


def test_similarity_of_nothing_is_zero():
    assert float(similarity(torch.zeros(5), torch.ones(5))) == 0.0


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_a_space_computes_in_its_own_types_under_autocast(dtype):
    space = SSPSpace.hexagonal()
    x = torch.rand(3, 2, generator=torch.Generator().manual_seed(0))
    plain = space.encode(x), space.gradient(x), space.kernel(x), space.region(x, x + 0.1)
    decode = PositionDecoder(space)
    found = decode(space.encode_fourier(x)).position_m
    with torch.autocast("cpu", dtype=dtype):
        again = space.encode(x), space.gradient(x), space.kernel(x), space.region(x, x + 0.1)
        assert torch.equal(decode(space.encode_fourier(x)).position_m, found)
    for one, other in zip(plain, again, strict=True):
        assert torch.equal(one, other)
        assert other.dtype == torch.float32
