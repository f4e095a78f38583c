"""Every spike of two networks of the reference program, replayed."""

import numpy as np
import pytest
import torch

from neuroslam.config.semantic import NeuronConfig, PathIntegratorConfig, SemanticMapConfig
from neuroslam.spiking.associative import AssociativeMap
from neuroslam.spiking.path_integrator import PathIntegrator
from neuroslam.spiking.space import SSPSpace


def loaded(file):
    """Read all arrays of a file once: the file itself decompresses one at each access."""
    with np.load(file) as arrays:
        return dict(arrays)


@pytest.fixture
def memory_run(shared):
    return loaded(shared / "refs" / "ssp" / "parity_am.npz")


def as_tensor(array):
    return torch.from_numpy(np.ascontiguousarray(array, dtype=np.float64))


POPULATIONS = {"memory": "memory", "relay": "recall", "error": "error"}


def fired(module, part):
    """Return which neurons of a population fired in the last step."""
    return getattr(module, part).spikes[..., 0, :].bool().numpy()


def put(neurons, weights, bias, voltage):
    neurons.weights, neurons.bias = as_tensor(weights), as_tensor(bias)
    neurons.deficit = (1.0 - as_tensor(voltage)).unsqueeze(1)
    neurons.asleep = torch.zeros_like(neurons.deficit)


def test_memory_fires_and_learns_as_the_reference(memory_run):
    ref = memory_run
    config = SemanticMapConfig(neurons=60, relay=True, pes_rate=5e-3, voja_rate=1e-3)
    memory = AssociativeMap(25, 25, config, NeuronConfig(), 1e-3).double()
    for part in ("memory", "relay", "error"):
        name = "recall" if part == "relay" else part
        put(
            getattr(memory, part),
            ref[f"{name}_scaled_encoders"][None],
            ref[f"{name}_bias"][None],
            ref[f"{name}_v0"][None],
        )
    memory.gain = as_tensor(ref["memory_gain"])
    memory.encoders = as_tensor(ref["memory_scaled_encoders"])[None]
    memory.relay_decoders = as_tensor(ref["recall_to_error_decoders"].T)[None] / 1e-3
    memory.error_decoders = as_tensor(ref["error_to_rule_decoders"].T)[None] / 1e-3
    wrong = dict.fromkeys(POPULATIONS, 0)
    for t in range(1000):
        phase = t // 250
        shown = phase < 3
        key, value = (
            as_tensor(ref[name][phase] if shown else np.zeros(25))[None]
            for name in ("keys", "vals")
        )
        if t % 50 == 49:
            np.testing.assert_allclose(memory.decoders[0].mT, ref["W"][t // 50], atol=1e-12)
            np.testing.assert_allclose(memory.encoders[0], ref["E"][t // 50], atol=1e-12)
        seen = torch.tensor([float(shown)], dtype=torch.float64)
        memory(key, value, seen, voja=1.0 + 10.0 * (1.0 - seen))
        for part, name in POPULATIONS.items():
            wrong[part] += int((fired(memory, part)[0] != ref[f"spikes_{name}"][t]).sum())
    assert wrong == dict.fromkeys(POPULATIONS, 0)
    assert ref["spikes_memory"].sum() > 1000


@pytest.fixture
def integrator_run(shared):
    return loaded(shared / "refs" / "ssp" / "parity_pi.npz")


def replayed(ref):
    """The reference's network: 27 oscillators, and a population for the constant term."""
    space = SSPSpace(as_tensor(ref["A"][1:28]), float(ref["length_scale"]))
    walk = PathIntegrator(
        space, PathIntegratorConfig(neurons=50, tau_s=0.05), NeuronConfig(), 1e-3
    ).double()
    encoders, bias = ref["scaled_encoders"], ref["bias"].copy()
    bias[0] += encoders[0, :, 0]  # its constant input is 1, 0, 0
    put(walk.neurons, encoders, bias, ref["v0"])
    decoders = np.zeros((28, 50, 5))
    decoders[1:, :, :2] = ref["rec_decoders"][:, :2].transpose(0, 2, 1)
    decoders[:, :, 2:] = ref["out_decoders"].transpose(0, 2, 1)
    walk.decoders = as_tensor(decoders) / 1e-3
    walk.recurrent = walk.external = torch.zeros(28, 1, 2, dtype=torch.float64)
    walk.output = torch.zeros(28, 1, 3, dtype=torch.float64)
    return walk


def test_path_integrator_fires_as_the_reference(integrator_run):
    ref = integrator_run
    walk = replayed(ref)
    wrong = 0
    for t in range(1000):
        # The length scale is in the decoders; the start is told for 49 steps.
        share = as_tensor(ref["A"][:28] @ ref["vel"][t] * ref["vsf"])[:, None]
        start = (t < 49) * (ref["to_Fourier"] @ ref["init_ssp"][t]).reshape(28, 3)
        read = ref["to_SSP"] @ walk.output.flatten().numpy()
        np.testing.assert_allclose(read, ref["ssp_out"][t], atol=1e-9)
        walk.drive(share, as_tensor(start[:, None, :2]))
        raw = torch.bmm(walk.neurons.spikes, walk.decoders)[..., 2:]
        np.testing.assert_allclose(raw.flatten(), ref["osc_out"][t], atol=1e-9)
        wrong += int((fired(walk, "neurons") != ref["spikes"][t]).sum())
    assert wrong == 0
    assert ref["spikes"].sum() == 132_195
