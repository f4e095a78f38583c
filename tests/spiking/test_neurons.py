"""Neurons fire at their analytic rates, and populations say what they are asked to."""

import math

import pytest
import torch
from pydantic import ValidationError

from neuroslam.config.semantic import NeuronConfig, PathIntegratorConfig
from neuroslam.spiking.binding import SpikingBinding
from neuroslam.spiking.decoding import PositionDecoder
from neuroslam.spiking.ensemble import NeuronArray, sample_tuning, solve_decoders
from neuroslam.spiking.neurons import (
    Membrane,
    lif_rate,
    lif_step,
    resting,
    stepped_lif,
    stepped_lif_rate,
)
from neuroslam.spiking.path_integrator import PathIntegrator
from neuroslam.spiking.populations import VectorPopulation
from neuroslam.spiking.quantise import quantised, rounded
from neuroslam.spiking.space import SSPSpace


def fired_in(seconds, current, membrane, dt, step=lif_step):
    state = resting(torch.zeros_like(current))
    drive = (1.0 - current) * (1.0 - membrane.keeps(dt))
    spikes = torch.zeros_like(current)
    for _ in range(round(seconds / dt)):
        state, fired = step(state, drive, membrane, dt)
        spikes += fired
    return spikes


CURRENTS = torch.tensor([0.2, 0.99, 1.01, 1.2, 2.0, 5.0, 12.0], dtype=torch.float64)


@pytest.mark.parametrize("dt", [1e-3, 5e-4, 2e-3])
@pytest.mark.parametrize("membrane", [Membrane(), Membrane(0.03, 0.0033), Membrane(0.02, 0.004)])
def test_rates_are_the_analytic_ones_at_any_time_step(dt, membrane):
    spikes = fired_in(8.0, CURRENTS, membrane, dt)
    # A spike falls at its exact time, so a count is off by one at most, whatever the step.
    assert float((spikes - 8.0 * lif_rate(CURRENTS, membrane)).abs().max()) <= 1.0


def test_a_pause_of_any_length_is_kept_exactly():
    """The closed form beside the exponential and logarithm that it replaces."""
    membrane, dt = Membrane(0.02, 0.0023), 1e-3
    draw = torch.Generator().manual_seed(0)
    current = 1.0 + 6.0 * torch.rand(200, generator=draw, dtype=torch.float64)
    state = resting(torch.rand(200, generator=draw, dtype=torch.float64))
    v, pause = 1.0 - state.deficit, torch.zeros(200, dtype=torch.float64)
    drive = (1.0 - current) * (1.0 - membrane.keeps(dt))
    for _ in range(400):
        state, fired = lif_step(state, drive, membrane, dt)
        pause = pause - dt
        awake = (dt - pause).clamp(0.0, dt)
        v = v - (current - v) * torch.expm1(-awake / membrane.tau_rc_s)
        spike = v > 1
        late = dt + membrane.tau_rc_s * torch.log1p(-(v - 1) / (current - 1))
        v = torch.where(spike, 0.0, v.clamp_min(0.0))
        pause = torch.where(spike, membrane.tau_ref_s + late, pause)
        assert torch.equal(fired.bool(), spike)
        torch.testing.assert_close(1.0 - state.deficit, v, atol=1e-9, rtol=0)


def test_neurons_of_a_chip_have_the_rates_of_whole_steps():
    spikes = fired_in(8.0, CURRENTS, Membrane(), 1e-3, stepped_lif)
    assert float((spikes - 8.0 * stepped_lif_rate(CURRENTS, Membrane(), 1e-3)).abs().max()) <= 1.0


def test_inhibited_neurons_are_silent_and_come_back():
    low, high = (torch.full((5,), c, dtype=torch.float64) for c in (-25.0, 3.0))
    state, membrane = resting(torch.zeros(5, dtype=torch.float64)), Membrane()
    share = 1.0 - membrane.keeps(1e-3)
    for _ in range(100):
        state, fired = lif_step(state, (1.0 - low) * share, membrane, 1e-3)
        assert not fired.any()
    assert torch.equal(state.deficit, torch.ones(5, dtype=torch.float64))
    spikes = sum(lif_step(state, (1.0 - high) * share, membrane, 1e-3)[1] for _ in range(1))
    assert not spikes.any()


@pytest.mark.parametrize("model", ["lif", "stepped_lif", "lif_rate", "relu"])
def test_a_population_decodes_its_vector(model):
    config = NeuronConfig(model=model)
    draw = torch.Generator().manual_seed(0)
    tuning = sample_tuning(2, 300, 2, config, draw)
    neurons = NeuronArray(tuning, config, 1e-3, draw)
    points = 2.0 * torch.rand(2, 1500, 2, generator=draw) - 1.0
    points = points / points.norm(dim=-1, keepdim=True).clamp_min(1.0)
    decoders = solve_decoders(neurons.rates(points), points, 0.05) / 1e-3
    x = torch.tensor([[[0.5, -0.3]], [[-0.2, 0.6]]])
    said = sum(neurons(x) @ decoders for _ in range(400)) / 400
    torch.testing.assert_close(said, x, atol=0.03, rtol=0)


def test_decoders_are_those_of_ridge_regression():
    draw = torch.Generator().manual_seed(0)
    a = torch.rand(1, 80, 20, generator=draw, dtype=torch.float64)
    y = torch.rand(1, 80, 3, generator=draw, dtype=torch.float64)
    ridge = 80 * (0.1 * a.max()) ** 2 * torch.eye(20, dtype=torch.float64)
    by_hand = torch.linalg.inv(a[0].T @ a[0] + ridge) @ a[0].T @ y[0]
    torch.testing.assert_close(solve_decoders(a, y, 0.1)[0], by_hand)


def test_bound_vectors_are_products_of_their_coefficients():
    bind = SpikingBinding(20, 200, NeuronConfig(), 1e-3, batch=2)
    angle = 2 * math.pi * torch.rand(2, 2, 20, generator=torch.Generator().manual_seed(0))
    a, b = torch.polar(torch.ones(2, 20), angle[0]), torch.polar(torch.ones(2, 20), angle[1])
    said = [bind(a, b) for _ in range(500)][200:]
    assert float((torch.stack(said).mean(0) - a * b).abs().max()) < 0.06


def test_cells_are_tuned_to_places_vectors_and_modules():
    space = SSPSpace.hexagonal(length_scale_m=0.15)
    places = VectorPopulation.of_places(space, 200, NeuronConfig(), 1e-3)
    grid = VectorPopulation.of_grid_cells(space, 198, NeuronConfig(), 1e-3)
    x = torch.linspace(-1, 1, 61)
    at = torch.cartesian_prod(x, x)
    z = torch.view_as_real(space.encode_fourier(at)).flatten(-2)[None]
    fields = {}
    for name, cells in (("places", places), ("grid", grid)):
        rates = cells.neurons.rates(z)[0].T.reshape(-1, 61, 61)
        peaks = (
            (rates == torch.nn.functional.max_pool2d(rates[:, None], 9, 1, 4)[:, 0])
            & (rates > 0.5 * rates.amax((1, 2), keepdim=True))
            & (rates > 20)
        )
        fields[name] = peaks.sum((1, 2)).float()
    assert float(fields["places"][fields["places"] > 0].median()) == 1.0
    assert float(fields["grid"][fields["grid"] > 0].median()) >= 5.0
    at = torch.tensor([[0.3, 0.2]])
    said = torch.stack([places(space.encode_fourier(at)) for _ in range(300)])[100:].mean(0)
    torch.testing.assert_close(PositionDecoder(space)(said).position_m, at, atol=0.05, rtol=0)


def test_rounded_weights_are_whole_multiples_and_near():
    w = torch.randn(3, 40, 5, generator=torch.Generator().manual_seed(0))
    r = rounded(w)
    for group, exact in zip(r, w, strict=True):
        assert len(group.unique()) <= 256
        assert float((group - exact).abs().max()) <= float(exact.abs().max()) / 127
    draw = torch.Generator().manual_seed(0)
    neurons = NeuronArray(sample_tuning(2, 9, 2, NeuronConfig(), draw), NeuronConfig(), 1e-3, draw)
    chip = quantised(neurons)
    assert torch.equal(chip.weights, rounded(neurons.weights))
    assert not torch.equal(chip.weights, neurons.weights)


def test_decoders_are_solved_for_rounded_neurons():
    """Rounded after that, the oscillators of SSP-SLAM drifted 0.5 m in 20 s, and not 0.01 m."""
    space, config = SSPSpace.hexagonal(), PathIntegratorConfig(neurons=300, coupling="none")
    exact, solved = (
        PathIntegrator(space, config, NeuronConfig(model="stepped_lif", weight_bits=bits), 1e-3)
        for bits in (0, 8)
    )
    chip = quantised(solved)
    assert torch.equal(chip.neurons.weights, solved.neurons.weights)
    assert torch.equal(chip.neurons.bias, solved.neurons.bias)
    velocity, off_rad = torch.tensor([[0.2, 0.1]]), []
    there = space.encode_fourier(2.0 * velocity)
    for walk in (exact, quantised(exact), chip):
        walk.start(torch.zeros(1, 2))
        with torch.inference_mode():
            for _ in range(2000):
                z = walk(velocity)
        off_rad.append(float((z * there.conj()).angle().abs().mean()))
    assert off_rad[2] < 1.5 * off_rad[0]
    assert off_rad[1] > 3.0 * off_rad[2]


def test_impossible_neurons_are_refused():
    for wrong in (
        {"max_rate_hz": (200, 600)},
        {"intercept": (0.5, 0.2)},
        {"model": "spike"},
        {"weight_bits": 1},
        {"weight_bits": -1},
    ):
        with pytest.raises(ValidationError):
            NeuronConfig(**wrong)
