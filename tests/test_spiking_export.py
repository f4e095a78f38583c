"""Oscillators as a NIR graph, written, read and simulated."""

import numpy as np
import pytest
import torch

from neuroslam.config.semantic import NeuronConfig, PathIntegratorConfig
from neuroslam.errors import ConfigError
from neuroslam.spiking.export import export_nir
from neuroslam.spiking.path_integrator import PathIntegrator
from neuroslam.spiking.space import SSPSpace

nir = pytest.importorskip("nir", reason="NIR is an extra")


def integrator(model="lif"):
    space = SSPSpace.hexagonal(n_rotations=1, n_scales=1)
    # No refractory time, as NIR has none.
    neurons = NeuronConfig(model=model, tau_ref_s=0.0)
    config = PathIntegratorConfig(neurons=200, coupling="none")
    return PathIntegrator(space, config, neurons, 1e-3)


def test_a_graph_holds_the_weights(tmp_path):
    walk = integrator()
    graph = nir.read(export_nir(walk, tmp_path / "walk.nir"))
    assert len(graph.nodes) == 8 * 3
    np.testing.assert_allclose(
        graph.nodes["oscillator_1_encode"].weight, walk.neurons.weights[1], atol=1e-6
    )
    np.testing.assert_allclose(
        graph.nodes["oscillator_2_read"].weight, walk.decoders[2].T[2:] * 1e-3, atol=1e-6
    )
    assert ("oscillator_0_synapse", "oscillator_0_encode") in set(map(tuple, graph.edges))


def test_a_simulated_graph_turns_as_fast_as_the_rate_says(tmp_path):
    walk = integrator()
    graph = nir.read(export_nir(walk, tmp_path / "walk.nir"))
    node = {k.removeprefix("oscillator_0_"): v for k, v in graph.nodes.items() if "_0_" in k}
    dt, rate = 1e-4, 0.5
    v, back, read = np.zeros(200), np.array([1.0, 0.0, 0.0]), np.zeros(2)
    angles = []
    for step in range(15_000):
        told = np.array([1.0 if step < 500 else 0.0, 0.0, rate])
        told[:2] *= 0.0  # the start is in the synapse
        current = node["encode"].weight @ (back + told) + node["encode"].bias
        v = np.maximum(v + dt / node["neurons"].tau * (current - v), 0.0)
        fired = v >= 1.0
        v = np.where(fired, 0.0, v)
        impulse = fired / dt
        back = back + dt / node["synapse"].tau * (node["recur"].weight @ impulse - back)
        read = read + dt / node["filter"].tau * (node["read"].weight @ impulse - read)
        angles.append(np.arctan2(read[1], read[0]))
    turned = np.unwrap(angles)
    speed = (turned[-1] - turned[4999]) / 1.0
    assert speed == pytest.approx(rate * float(walk.fastest_rad_s[0]), rel=0.1)


def test_rates_without_spikes_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="spiking ones"):
        export_nir(integrator("lif_rate"), tmp_path / "walk.nir")
    assert torch.isfinite(integrator().z).all()
