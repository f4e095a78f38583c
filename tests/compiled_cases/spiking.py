"""SSP-SLAM."""

import copy
import functools

import numpy as np
import torch

from neuroslam.config.semantic import (
    NeuronConfig,
    PathIntegratorConfig,
    SemanticMapConfig,
    SSPSLAMConfig,
    SSPSpaceConfig,
)
from neuroslam.spiking import vector_steps
from neuroslam.spiking.associative import AssociativeMap
from neuroslam.spiking.binding import SpikingBinding
from neuroslam.spiking.decoding import PositionDecoder
from neuroslam.spiking.path_integrator import PathIntegrator
from neuroslam.spiking.populations import VectorPopulation
from neuroslam.spiking.slam import SSPSLAM
from neuroslam.spiking.space import SSPSpace
from neuroslam.worlds.landmarks import LandmarkView
from tests.compiled_cases import case, with_and_without


def by_both(module, step):
    """Let copies of a module step, as defined and compiled; pairs of results and states."""

    def stepped():
        mine = copy.deepcopy(module)
        with torch.inference_mode():
            results = step(mine)
        state = [part for _, part in sorted(mine.state_dict().items())]
        return [(part * 1).numpy() for part in (*results, *state)]

    return with_and_without(stepped)


def with_state(module, draw):
    """Return a copy of a module in double precision whose neurons and filters are anywhere."""
    module = copy.deepcopy(module).double()
    for name, buffer in module.named_buffers():
        last = name.rpartition(".")[2]
        noise = torch.from_numpy(draw.standard_normal(tuple(buffer.shape)))
        if last == "deficit":
            buffer.copy_(1e-3 + torch.from_numpy(draw.random(tuple(buffer.shape))))
        elif last == "asleep":
            buffer.copy_((2.0 * noise).clamp(0.0, 2.0))
        elif last in STATE:
            buffer.copy_((0.1 if last == "pull" else 0.5) * noise)
        elif last == "activity_hz":
            buffer.copy_((200.0 * noise).clamp_min(0.0))
        elif last == "contradicted_s":
            buffer.copy_(noise.clamp_min(0.0))
    return module


STATE = {
    "recurrent", "external", "decoded", "product", "recalled", "relayed", "taught", "rule", "pull",
    "here", "there",
}  # fmt: skip


def placed(walk, draw):
    """Put animals somewhere, a little off from where their oscillators say."""
    at = torch.from_numpy(draw.uniform(-0.5, 0.5, tuple(walk.position_m.shape)))
    z = torch.view_as_real(walk.space.encode_fourier(at + 0.01))
    z = z + 0.1 * torch.from_numpy(draw.standard_normal(tuple(z.shape)))
    walk.position_m = at
    if isinstance(walk, PathIntegrator):
        walk.output = z.transpose(0, 1).contiguous()
    else:
        walk.phasor = z
    return walk


def complex_of(draw, *shape):
    return torch.from_numpy(draw.standard_normal(shape) + 1j * draw.standard_normal(shape))


@functools.cache
def made(name):
    """Return a small module of SSP-SLAM, to be copied."""
    space = SSPSpace.hexagonal(n_scales=2)
    model = NeuronConfig(model="stepped_lif" if name == "stepped" else "lif", tau_ref_s=0.0023)
    if name in ("walk", "modules", "none"):
        coupling = {"walk": "manifold"}.get(name, name)
        cells = 12 if name == "modules" else 0
        config = PathIntegratorConfig(neurons=30, coupling=coupling, velocity_neurons=cells)
        return PathIntegrator(space, config, model, 1e-3, batch=2)
    if name == "objects":
        return VectorPopulation.of_objects(space, 30, model, 1e-3, batch=2)
    if name in ("bind", "stepped"):
        return SpikingBinding(4, 12, model, 1e-3, batch=2)
    config = SemanticMapConfig(neurons=20, relay=True, voja_rate=0.1)
    memory = AssociativeMap(5, 13, config, model, 1e-3, batch=2)
    memory.decoders = torch.randn(2, 20, 13, generator=torch.Generator().manual_seed(0))
    return memory


@case("spiking.neurons.respond", "spiking.ensemble.filter_into")
def _a_population_says_what_it_is_tuned_to(draw):
    objects = with_state(made("objects"), draw)
    z = complex_of(draw, 2, objects.decoded.shape[1])
    return by_both(objects, lambda cells: [torch.view_as_real(cells(z))])


@case("spiking.binding.sums_and_differences", "spiking.binding.products_of")
def _vectors_are_bound(draw):
    a, b = complex_of(draw, 2, 4), complex_of(draw, 2, 4).conj()
    return [
        pair
        for name in ("bind", "stepped")
        for pair in by_both(
            with_state(made(name), draw), lambda bind: [torch.view_as_real(bind(a, b))]
        )
    ]


@case("spiking.learning.memorise", "spiking.learning.drive_by_keys")
def _a_memory_recalls_and_learns(draw):
    memory = with_state(made("memory"), draw)
    key, value = (torch.from_numpy(draw.standard_normal((2, n))) for n in (5, 13))
    seen, plasticity, voja = torch.from_numpy(draw.random((3, 2)).round(1))
    seen = seen.round()
    return by_both(memory, lambda m: [m(key, value, seen, plasticity, voja)])


@case("spiking.vector_steps.oscillators_before", "spiking.vector_steps.oscillators_after")
def _a_position_is_integrated_by_neurons(draw):
    velocity = torch.from_numpy(draw.uniform(-0.6, 0.6, (2, 2)))
    pairs = []
    for name in ("walk", "modules", "none"):
        walk = placed(with_state(made(name), draw), draw)
        walk.age.fill_(int(draw.choice([2, 3, 99])))
        pull = None if draw.random() < 0.3 else complex_of(draw, 2, 18)
        pairs += by_both(walk, lambda w, pull=pull: [torch.view_as_real(w(velocity, pull))])
    return pairs


@case("spiking.vector_steps.search", "spiking.vector_steps.similarity")
def _a_position_is_decoded(draw):
    space = SSPSpace.hexagonal(n_scales=2).double()
    decoder, at = PositionDecoder(space), torch.from_numpy(draw.uniform(-0.9, 0.9, 2))
    z = space.encode_fourier(at) + 0.1 * complex_of(draw, 18)
    expected, parts, x = decoder(z), torch.view_as_real(z).numpy(), np.empty(2)
    tables = decoder.tables()
    best = vector_steps.search(tuple(tables), parts, x)
    alike = vector_steps.similarity(tables.waves, parts, at.numpy())
    return [
        (expected.position_m.numpy(), x),
        (expected.similarity.numpy(), best),
        (decoder.similarity(z, at).numpy(), alike),
    ]


@functools.cache
def animals(tier):
    """Return SSP-SLAM of a tier, two animals, small."""
    places, coupling = tier == "algebraic", "modules" if tier == "algebraic" else "manifold"
    config = SSPSLAMConfig(
        tier=tier,
        time_step_s=0.01 if places else 1e-3,
        space=SSPSpaceConfig(n_rotations=3, n_scales=2, length_scale_m=0.5),
        integrator=PathIntegratorConfig(neurons=20, phase_noise_rad=0.1, coupling=coupling),
        map=SemanticMapConfig(neurons=20),
        binding="exact",
        vector_neurons=20,
        places=places,
    )
    return SSPSLAM(config, torch.eye(3, 37), batch=2)


@case(
    "spiking.vector_steps.advance", "spiking.vector_steps.times",
    *(f"spiking.vector_steps.{name}" for name in (
        "encode_each", "before_recalls", "fourier_of_recalls", "after_recalls",
    )),
)  # fmt: skip
def _animals_localise_and_map(draw):
    low = draw.uniform(-0.3, 0.3, (3, 2, 3, 2))
    view = LandmarkView(
        draw.random((3, 2, 3)) < 0.6, np.hypot(*low.T).T, low, low, np.arange(3)
    )  # fmt: skip
    velocity = torch.from_numpy(draw.uniform(-0.3, 0.3, (3, 2, 2)))
    pairs = []
    for tier in ("algebraic", "spiking"):
        slam = with_state(animals(tier), draw)
        placed(slam.integrator, draw).age.fill_(int(draw.choice([0, 2, 98])))
        if tier == "algebraic":
            slam.map.weights = torch.from_numpy(draw.standard_normal((2, 37, 37)))
        slam.attended.copy_(torch.from_numpy(draw.integers(-1, 3, 2)))
        slam.held_s.copy_(torch.from_numpy(draw.choice([0.01, 0.2], 2)))
        slam.familiar.copy_(torch.from_numpy(draw.random(2) < 0.7))

        def step(mine):
            said = mine.run(velocity, view)
            return [*said[:1], torch.view_as_real(said.z), *said[2:]]

        pairs += by_both(slam, step)
    return pairs
