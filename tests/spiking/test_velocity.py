"""Cells of the velocity: what they say of it, and what oscillators make of that."""

import numpy as np
import pytest
import torch

from neuroslam.config.semantic import NeuronConfig, PathIntegratorConfig
from neuroslam.spiking.path_integrator import PathIntegrator
from neuroslam.spiking.populations import VelocityPopulation
from neuroslam.spiking.quantise import quantised, rounded
from neuroslam.spiking.space import SSPSpace

FASTEST = 0.5


def said(neurons, model="lif", velocity=None, steps=400):
    """Velocities in the disc of allowed ones, and what cells say of them after 0.1 s."""
    if velocity is None:
        draw = torch.Generator().manual_seed(7)
        angle, share = 2 * torch.pi * torch.rand(16, generator=draw), torch.rand(16, generator=draw)
        velocity = FASTEST * share.sqrt()[:, None] * torch.stack([angle.cos(), angle.sin()], -1)
    config = NeuronConfig(model=model)
    cells = VelocityPopulation(neurons, 2, FASTEST, config, 1e-3, batch=len(velocity))
    return velocity, torch.stack([cells(velocity) for _ in range(100 + steps)])[100:]


def walk_of(velocity_neurons, model="lif", neurons=300, batch=1, **more):
    space = SSPSpace.hexagonal(n_rotations=2, n_scales=2)
    config = PathIntegratorConfig(neurons=neurons, velocity_neurons=velocity_neurons, **more)
    walk = PathIntegrator(space, config, NeuronConfig(model=model), 1e-3, batch=batch)
    walk.start(torch.zeros(batch, 2))
    return walk


@torch.inference_mode()
def walked(walk, velocity, steps=300):
    velocity = torch.tensor(velocity).expand(len(walk.position_m), 2)
    for _ in range(steps):
        walk(velocity)
    return walk.position_m.numpy().copy()


@pytest.mark.parametrize("velocity_neurons", [0, 100])
@pytest.mark.parametrize("batch", [1, 3])
def test_many_steps_at_once_are_the_steps_one_by_one(velocity_neurons, batch):
    draw = torch.Generator().manual_seed(3)
    velocity = 0.2 * torch.randn(150, batch, 2, generator=draw)
    once, singly = (walk_of(velocity_neurons, batch=batch) for _ in range(2))
    with torch.inference_mode():
        each = torch.stack([singly(v) for v in velocity])
    assert torch.equal(once.run(velocity), each)
    assert once.run(velocity[:0]).shape == (0, batch, each.shape[-1])
    for name, value in singly.state_dict().items():
        assert torch.equal(once.state_dict()[name], value), name


@pytest.mark.parametrize("model", ["lif", "stepped_lif", "lif_rate", "relu"])
def test_the_mean_decoded_velocity_is_right_to_a_hundredth_of_the_highest_speed(model):
    velocity, decoded = said(500, model)
    wrong = (decoded.mean(0) - velocity).norm(dim=-1).square().mean().sqrt()
    assert 0.0 < float(wrong) < 0.01 * FASTEST


def test_more_neurons_say_it_better():
    bias, noise = {}, {}
    for n in (50, 200, 800):
        velocity, decoded = said(n)
        bias[n] = float((decoded.mean(0) - velocity).norm(dim=-1).square().mean())
        noise[n] = float((decoded - decoded.mean(0)).square().mean())
    assert bias[50] > 4 * bias[200] > 8 * bias[800]
    assert noise[50] > 3 * noise[200] > 9 * noise[800]


@pytest.mark.parametrize("model", ["lif", "stepped_lif"])
def test_a_still_animal_hears_bounded_noise_and_stays(model):
    _, decoded = said(500, model, torch.zeros(1, 2))
    assert 0.0 < float(decoded.norm(dim=-1).max()) < 0.1 * FASTEST
    assert float(decoded.mean(0).norm()) < 0.01 * FASTEST
    ends = [walked(walk_of(n, model), [0.0, 0.0], 1000) for n in (0, 500)]
    assert np.linalg.norm(ends[1] - ends[0]) < 0.02


def test_speeds_above_the_highest_are_said_to_be_lower():
    _, decoded = said(500, velocity=torch.tensor([[4 * FASTEST, 0.0]]))
    assert FASTEST < float(decoded.mean(0)[0, 0]) < 3 * FASTEST


@pytest.mark.parametrize("model", ["lif", "lif_rate"])
def test_a_walk_by_cells_is_near_the_exact_one_but_not_equal(model):
    velocity, steps = [0.3, -0.1], 600
    ends = {n: walked(walk_of(n, model), velocity, steps) for n in (0, 500)}
    np.testing.assert_allclose(ends[500], [[0.18, -0.06]], atol=0.01)
    assert 1e-5 < np.abs(ends[500] - ends[0]).max() < 0.01


def test_fewer_cells_dead_reckon_worse():
    ends = {}
    for n in (0, 20, 1000):
        walk = walk_of(n, "lif_rate")
        walked(walk, [0.3, -0.2], 600)
        ends[n] = walked(walk, [0.0, 0.0], 100)  # what the synapse still holds arrives
    assert np.linalg.norm(ends[20] - ends[0]) > 4 * np.linalg.norm(ends[1000] - ends[0])


@pytest.mark.parametrize("model", ["lif", "lif_rate"])
def test_oscillators_know_of_the_velocity_by_the_cells_alone(model):
    walk = walk_of(100, model)
    walk.velocity.decoders = torch.zeros_like(walk.velocity.decoders)
    assert np.linalg.norm(walked(walk, [0.4, 0.0])) < 0.01
    assert np.linalg.norm(walked(walk_of(0, model), [0.4, 0.0])) > 0.1


def test_without_cells_nothing_else_is_different():
    exact, spoken = walk_of(0), walk_of(60)
    assert exact.velocity is None
    assert spoken.n_neurons == exact.n_neurons + 60
    state = spoken.state_dict()
    more = {name for name in state if name.startswith("velocity.")}
    assert more == {
        f"velocity.{name}"
        for name in (
            "decoders", "decoded", "neurons.weights", "neurons.bias", "neurons.deficit",
            "neurons.asleep",
        )
    }  # fmt: skip
    assert state.keys() - more == exact.state_dict().keys()
    for name, value in exact.state_dict().items():
        assert torch.equal(value, state[name]), name


@pytest.mark.parametrize("model", ["lif", "stepped_lif", "lif_rate"])
def test_cells_resume_bit_for_bit(model):
    walk, other = walk_of(80, model, neurons=60), walk_of(80, model, neurons=60)
    walked(walk, [0.3, 0.1], 70)
    other.load_state_dict(walk.state_dict())
    np.testing.assert_array_equal(walked(walk, [0.1, 0.2], 70), walked(other, [0.1, 0.2], 70))
    for name, value in walk.state_dict().items():
        assert torch.equal(value, other.state_dict()[name]), name


def test_a_start_puts_the_animal_at_rest():
    walk = walk_of(80, neurons=60)
    walked(walk, [0.3, 0.1], 50)
    assert float(walk.velocity.decoded.norm()) > 0.1
    walk.start(torch.zeros(1, 2))
    assert not walk.velocity.decoded.any()


def test_each_animal_of_a_batch_hears_its_own_velocity():
    velocity = torch.tensor([[0.3, 0.0], [0.0, -0.3]])
    walk = walk_of(300, batch=2)
    with torch.inference_mode():
        for _ in range(400):
            walk(velocity)
    np.testing.assert_allclose(walk.position_m, 0.4 * velocity, atol=0.012)


def test_quantised_cells_have_whole_weights_and_still_say_the_velocity():
    walk = quantised(walk_of(500, "stepped_lif", coupling="none"))
    for part in (walk.velocity.decoders, walk.velocity.neurons.weights):
        assert torch.equal(part, rounded(part))
    walked(walk, [0.3, -0.1], 200)
    heard = []
    for _ in range(200):
        walked(walk, [0.3, -0.1], 1)
        heard.append(walk.velocity.decoded[0].clone())
    np.testing.assert_allclose(torch.stack(heard).mean(0), [0.3, -0.1], atol=0.03 * FASTEST)


def test_gradients_reach_the_space_through_decoded_velocities():
    walk = walk_of(60, "lif_rate", neurons=60)
    walk.space.length_scale_m.requires_grad_(True)
    walk.start(torch.zeros(1, 2))
    for _ in range(20):
        z = walk(torch.tensor([[0.3, 0.1]]))
    z.real.sum().backward()
    assert float(walk.space.length_scale_m.grad.abs().max()) > 0
