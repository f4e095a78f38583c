"""SSP-SLAM: three tiers of one interface, a state that is complete, maps that merge."""

from copy import deepcopy
from functools import cache

import numpy as np
import pytest
import torch

from neuroslam.config.semantic import (
    NeuronConfig,
    PathIntegratorConfig,
    SemanticMapConfig,
    SSPSLAMConfig,
    SSPSpaceConfig,
)
from neuroslam.errors import CheckpointError, SpaceError
from neuroslam.experiments.ssp_simulation import integrate, recalled, simulate, slam_in, views
from neuroslam.spiking import queries
from neuroslam.spiking.files import load_semantic_map, save_semantic_map
from neuroslam.spiking.joining import merge_semantic_maps
from neuroslam.spiking.path_integrator import PathIntegrator, module_pull
from neuroslam.spiking.slam import SSPSLAM
from neuroslam.spiking.space import SSPSpace
from neuroslam.worlds.landmark_paths import LandmarkPath, band_limited_path
from neuroslam.worlds.landmarks import make_world, paper_world, point, random_world

VECTORS = {"tier": "algebraic", "time_step_s": 0.01}
SMALL = {
    "integrator": PathIntegratorConfig(neurons=200),
    "map": SemanticMapConfig(neurons=150),
    "binding": "exact",
    "vector_neurons": 150,
}
TIERS = {
    "algebraic": VECTORS,
    "rate": {"tier": "rate", **SMALL},
    "spiking": {"tier": "spiking", **SMALL},
    "spiking, all of it": {
        **SMALL,
        "binding": "neurons",
        "binding_neurons": 20,
        "grid_neurons": 90,
        "places": True,
        "map": SemanticMapConfig(neurons=120, relay=True),
        "integrator": PathIntegratorConfig(neurons=200, velocity_neurons=200),
    },
    "quantised": {
        **SMALL,
        "quantised": True,
        "integrator": PathIntegratorConfig(neurons=300, velocity_neurons=200),
    },
}


def circle(seconds=5.0, dt=0.01, radius=0.3, laps=1.0, start=0.0):
    angle = 2 * np.pi * (start + laps * np.linspace(0, 1, round(seconds / dt)))
    return LandmarkPath(dt, radius * np.stack([np.cos(angle), np.sin(angle)], -1))


WORLD = make_world([point("A", (0.4, 0.0)), point("B", (-0.3, 0.15)), point("C", (0, -0.8))])


@cache
def walked(tier):
    """A walk past A and B: the map at its end, to be copied by who goes on, and its record."""
    slam = slam_in(SSPSLAMConfig(**TIERS[tier]), WORLD)
    return slam, simulate(slam, [WORLD], [circle(3.5, laps=0.7, start=-0.1)])


@pytest.mark.parametrize("tier", TIERS)
def test_a_walk_is_followed_and_what_was_seen_is_recalled(tier):
    slam, life = walked(tier)
    assert life.error_m.mean() < (1e-3 if tier == "algebraic" else 0.05)
    assert life.seen_s[0, 0] > 0.5
    wrong = np.linalg.norm(recalled(slam)[0] - [m.position_m for m in WORLD.landmarks], axis=-1)
    assert (wrong[:2] < (2e-3 if tier == "algebraic" else 0.06)).all()
    strength = slam.space.to_fourier(slam.map.read(slam.pointers)).abs().mean(-1)[0]
    assert float(strength[:2].min()) > 0.5 > float(strength[2])


@pytest.mark.parametrize("tier", TIERS)
def test_a_map_that_was_saved_goes_on_bit_for_bit(tier, tmp_path):
    config = SSPSLAMConfig(**TIERS[tier])
    path = circle(0.6, config.time_step_s, laps=0.15)
    velocity = torch.from_numpy(path.velocity_m_s[:, None])
    view = views([WORLD], path.position_m[:, None])
    n = len(velocity) // 2

    def cut(part):
        fields = (f for f in view._fields if f != "box_landmark")
        return view._replace(**{f: getattr(view, f)[part] for f in fields})

    whole = slam_in(config, WORLD)
    whole.start(torch.from_numpy(path.position_m[:1]))
    whole.run(velocity[:n], cut(slice(0, n)))
    save_semantic_map(whole, tmp_path / "map.safetensors")
    said = whole.run(velocity[n:], cut(slice(n, None)))
    loaded = load_semantic_map(tmp_path / "map.safetensors")
    again = loaded.run(velocity[n:], cut(slice(n, None)))
    for a, b in zip(said, again, strict=True):
        assert torch.equal(a, b)
    for name, value in whole.state_dict().items():
        assert torch.equal(value, loaded.state_dict()[name]), name
    assert loaded.names == WORLD.names


def still(slam, steps):
    at = np.tile([0.4, 0.05], (steps, 1, 1))
    return slam.run(torch.zeros(steps, 1, 2), views([WORLD], at))


@pytest.mark.parametrize("tier", ["algebraic", "spiking"])
def test_a_copy_steps_without_the_original(tier):
    slam = slam_in(SSPSLAMConfig(**TIERS[tier]), WORLD)
    still(slam, 5)
    before = {name: value.clone() for name, value in slam.state_dict().items()}
    other = deepcopy(slam)
    still(other, 5)
    for name, value in slam.state_dict().items():
        assert torch.equal(value, before[name]), name
    still(slam, 5)
    for name, value in slam.state_dict().items():
        assert torch.equal(value, other.state_dict()[name]), name


@pytest.mark.parametrize("tier", ["algebraic", "spiking"])
def test_steps_follow_a_space_that_changes(tier, monkeypatch):
    slam = slam_in(SSPSLAMConfig(**TIERS[tier]), WORLD)
    slam.start(torch.tensor([[0.4, 0.3]]))
    still(slam, 5)
    with torch.no_grad():
        slam.space.length_scale_m.mul_(1.1)
    other, found = deepcopy(slam), []
    for each, enabled in ((slam, True), (other, False)):
        monkeypatch.setattr("neuroslam.compiled.ENABLED", enabled)
        found.append(still(each, 20).position_m)
    torch.testing.assert_close(*found, atol=2e-3, rtol=0)
    assert float((found[0][-1] - torch.tensor([[0.4, 0.3]])).norm()) > 0.02


@pytest.mark.parametrize(("steps", "every", "returned"), [(3, 5, 1), (5, 5, 1), (11, 5, 2)])
def test_a_run_returns_every_nth_step_or_the_last_of_fewer(steps, every, returned):
    path = circle(0.01 * steps, 0.01, laps=0.02)
    runs = []
    for n in (1, every):
        slam = slam_in(SSPSLAMConfig(**VECTORS), WORLD)
        slam.start(torch.from_numpy(path.position_m[:1]))
        runs.append(slam.run(torch.from_numpy(path.velocity_m_s[:, None]), every=n).position_m)
    assert len(runs[0]) == len(path.velocity_m_s) == steps
    assert len(runs[1]) == returned
    last = (steps // every) * every or steps
    assert torch.equal(runs[1][-1], runs[0][last - 1])


def test_files_that_are_no_maps_are_refused(tmp_path):
    slam = slam_in(SSPSLAMConfig(**VECTORS), WORLD)
    file = tmp_path / "map.safetensors"
    save_semantic_map(slam, file)
    damaged = file.read_bytes()
    file.write_bytes(damaged[:-7])
    with pytest.raises(CheckpointError, match=r"damaged|truncated"):
        load_semantic_map(file)
    with pytest.raises(CheckpointError, match="no such semantic map file"):
        load_semantic_map(tmp_path / "none")


def test_phase_noise_is_part_of_the_state():
    config = SSPSLAMConfig(**VECTORS, integrator=PathIntegratorConfig(phase_noise_rad=0.3))
    lives = [simulate(slam_in(config, WORLD), [WORLD], [circle()]) for _ in range(2)]
    np.testing.assert_array_equal(lives[0].position_m, lives[1].position_m)
    other = slam_in(config.model_copy(update={"seed": 1}), WORLD)
    assert not np.allclose(simulate(other, [WORLD], [circle()]).position_m, lives[0].position_m)


@pytest.fixture
def double():
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(before)


@pytest.mark.usefixtures("double")  # in single precision a rounding can move a spike
def test_animals_of_a_batch_are_as_if_alone():
    config = SSPSLAMConfig(**TIERS["spiking"])
    worlds = [random_world(3, seed=k) for k in range(2)]
    paths = [circle(0.4, 1e-3, laps=0.1), circle(0.4, 1e-3, radius=0.5, laps=-0.1)]
    both = simulate(slam_in(config, worlds[0], 2), worlds, paths)
    for k in range(2):
        alone = simulate(slam_in(config, worlds[0]), worlds[k : k + 1], paths[k : k + 1])
        np.testing.assert_allclose(alone.position_m[:, 0], both.position_m[:, k], atol=1e-12)


@pytest.mark.parametrize("tier", ["algebraic", "rate"])
def test_gradients_reach_scales_gate_and_gain(tier):
    more = {"attention": "nearest"} if tier == "rate" else {}
    slam = slam_in(SSPSLAMConfig(**TIERS[tier], **more), WORLD)
    path = circle(1.2, slam.config.time_step_s, laps=0.02)
    simulate(slam, [WORLD], [path])
    state = slam.state_dict()
    slam = slam_in(slam.config, WORLD)
    slam.load_state_dict(state)
    for p in (slam.space.length_scale_m, slam.space.frequencies, slam.gate, slam.gain):
        p.requires_grad_(True)
    slam.start(torch.tensor([[0.33, 0.02]]))
    view = views([WORLD], path.position_m[:, None])
    velocity = torch.from_numpy(path.velocity_m_s[:, None])
    for k in range(len(path.position_m) if tier == "algebraic" else 200):
        fields = (f for f in view._fields if f != "box_landmark")
        said = slam(velocity[k], view._replace(**{f: getattr(view, f)[k] for f in fields}))
    target = slam.space.encode_fourier(torch.tensor([[0.3, 0.0]])).detach()
    (1.0 - (said.z * target.conj()).real.mean()).backward()
    for p in (slam.space.length_scale_m, slam.space.frequencies, slam.gate, slam.gain):
        assert p.grad is not None
        assert torch.isfinite(p.grad).all()
    assert float(slam.space.length_scale_m.grad.abs().max()) > 0
    assert float(slam.gain.grad.abs()) > 0


def test_waves_of_a_module_pull_each_other_until_they_close():
    space = SSPSpace.hexagonal().double()
    z = space.encode_fourier(torch.tensor([[0.2, 0.3]]).double())
    torch.testing.assert_close(
        module_pull(z, space.grid_modules), torch.zeros(1, 27).double(), atol=1e-6, rtol=0
    )
    noise = 0.2 * torch.randn(1, 27, generator=torch.Generator().manual_seed(0)).double()
    off = z * torch.polar(torch.ones_like(noise), noise)
    turn = module_pull(off, space.grid_modules)
    closed = off * torch.polar(torch.ones_like(turn), turn)
    sums = closed[0, space.grid_modules].prod(-1).angle()
    torch.testing.assert_close(sums, torch.zeros(9).double(), atol=1e-9, rtol=0)


def test_coupled_oscillators_drift_less():
    errors = {}
    path = band_limited_path(120.0, 0.08, seed=2, time_step_s=0.01).first(60.0)
    for coupling in ("none", "modules", "manifold"):
        noisy = PathIntegratorConfig(phase_noise_rad=0.2, coupling=coupling)
        slam = slam_in(SSPSLAMConfig(**VECTORS, integrator=noisy), WORLD, batch=8)
        errors[coupling] = integrate(slam, [path] * 8).ate_m.mean()
    assert errors["manifold"] < 0.9 * errors["modules"] < 0.5 * errors["none"]


def test_a_walk_is_the_same_at_two_time_steps():
    space = SSPSpace.hexagonal()
    ends = []
    for dt in (1e-3, 5e-4):
        walk = PathIntegrator(space, PathIntegratorConfig(neurons=400), NeuronConfig(), dt)
        walk.start(torch.zeros(1, 2))
        with torch.inference_mode():
            for _ in range(round(1.5 / dt)):
                walk(torch.tensor([[0.2, -0.1]]))
        ends.append(walk.position_m.numpy())
        np.testing.assert_allclose(ends[-1], [[0.3, -0.15]], atol=0.012)
    np.testing.assert_allclose(ends[0], ends[1], atol=0.012)


@pytest.mark.parametrize("tier", ["algebraic", "spiking"])
def test_a_kidnapped_animal_relocalises_at_a_known_landmark(tier):
    slam = deepcopy(walked(tier)[0])
    true = np.array([0.4, 0.05])
    path = LandmarkPath(
        slam.config.time_step_s, np.tile(true, (round(2.5 / slam.config.time_step_s), 1))
    )
    slam.start(torch.tensor([[-0.6, 0.7]]))
    view = views([WORLD], path.position_m[:, None])
    said = slam.run(torch.zeros(len(path.position_m), 1, 2), view)
    assert bool(said.lost.any())
    assert not bool(said.lost[-1])
    # It is where the map puts it; that is as near as a few neurons have the landmark.
    off = recalled(slam)[0, 0] - [0.4, 0.0]
    assert np.linalg.norm(off) < 0.1
    np.testing.assert_allclose(slam.integrator.position_m[0], true + off, atol=0.03)


def test_without_relocalisation_the_animal_stays_lost():
    config = SSPSLAMConfig(**VECTORS, relocalise_after_s=0.0)
    slam = slam_in(config, WORLD)
    simulate(slam, [WORLD], [circle()])
    slam.start(torch.tensor([[-0.6, 0.7]]))
    still(slam, 300)
    assert float((slam.integrator.position_m - torch.tensor([[0.4, 0.05]])).norm()) > 0.5


def two_sessions(tier, offset, names=("ABC", "BCD")):
    at = {"A": (0.4, 0.3), "B": (-0.3, 0.15), "C": (0.1, -0.35), "D": (-0.4, -0.3)}
    config = SSPSLAMConfig(**TIERS[tier])
    maps = []
    for known, moved in zip(names, ((0, 0), offset), strict=True):
        world = make_world([point(k, np.add(at[k], moved)) for k in known])
        words = make_world([point(k, x) for k, x in at.items()])
        full = slam_in(config, words)
        keys = torch.stack([full.pointers[words.names.index(k)] for k in known])
        slam = SSPSLAM(config, keys, list(known))
        slam.map.write(
            keys,
            slam.space.encode(
                torch.from_numpy(np.array([world.named(k).position_m for k in known]))
            ).detach(),
        )
        slam.start(torch.tensor([[0.1, 0.1]]) + torch.tensor([moved]).float())
        maps.append(slam)
    return at, maps


@pytest.mark.parametrize("tier", ["algebraic", "spiking"])
def test_two_maps_are_aligned_by_landmarks_that_both_know(tier):
    at, (loaded, partial) = two_sessions(tier, (0.2, -0.1))
    before = [{k: v.clone() for k, v in m.state_dict().items()} for m in (loaded, partial)]
    merged, report = merge_semantic_maps(loaded, partial)
    assert report.joined
    assert (report.agree, report.added, report.kept, report.moved) == (
        ("B", "C"),
        ("D",),
        ("A",),
        (),
    )
    np.testing.assert_allclose(report.offset_m, [-0.2, 0.1], atol=0.01)
    assert merged.names == ("A", "B", "C", "D")
    np.testing.assert_allclose(recalled(merged)[0], [at[k] for k in "ABCD"], atol=0.02)
    np.testing.assert_allclose(merged.integrator.position_m[0], [0.1, 0.1], atol=0.02)
    for slam, old in zip((loaded, partial), before, strict=True):
        assert all(torch.equal(v, old[k]) for k, v in slam.state_dict().items())


def test_a_map_merged_with_itself_gains_nothing():
    _, (loaded, _) = two_sessions("algebraic", (0, 0))
    merged, report = merge_semantic_maps(loaded, loaded)
    assert report.agree == ("A", "B", "C")
    np.testing.assert_allclose(recalled(merged)[0], recalled(loaded)[0], atol=1e-4)


def test_merges_that_cannot_be_say_why():
    _, (loaded, partial) = two_sessions("algebraic", (0, 0), ("AB", "CD"))
    assert "0 landmarks are known to both" in merge_semantic_maps(loaded, partial)[1].reason
    _, (loaded, partial) = two_sessions("algebraic", (0.1, 0), ("ABC", "ABC"))
    places = torch.tensor([[0.5, 0.3], [-0.7, 0.2], [0.1, 0.6]])
    partial.map.write(partial.pointers, partial.space.encode(places).detach())
    merged, report = merge_semantic_maps(loaded, partial)
    assert merged is None
    assert "shared landmarks agree" in report.reason
    _, (loaded, partial) = two_sessions("algebraic", (0.55, 0.0), ("BCD", "BCD"))
    partial.start(torch.tensor([[-0.9, 0.0]]))
    assert "outside the bounds" in merge_semantic_maps(loaded, partial)[1].reason
    other = slam_in(SSPSLAMConfig(**VECTORS, gain=0.1), WORLD)
    with pytest.raises(SpaceError, match="differ in gain"):
        merge_semantic_maps(loaded, other)
    strange = slam_in(SSPSLAMConfig(**VECTORS, seed=5), WORLD)
    with pytest.raises(SpaceError, match="differ in seed"):
        merge_semantic_maps(loaded, strange)


def test_questions_to_a_map_of_attributes_and_walls():
    world = paper_world()
    space = SSPSpaceConfig(n_rotations=5, n_scales=5, length_scale_m=0.3, reach_m=1.2)
    slam = slam_in(SSPSLAMConfig(**VECTORS, space=space, places=True), world)
    stops = np.array([[0.5, 0.3], [0.1, -0.5], [-0.1, 0.3], [-0.5, 0.8]])
    for at in stops:
        slam.start(torch.from_numpy(at[None]))
        still = np.tile(at, (200, 1, 1))
        slam.run(torch.zeros(200, 1, 2), views([world], still))
    blue = queries.where(slam, slam.pointers[0] + slam.pointers[1])
    truth = np.array([world.landmarks[k].position_m for k in (0, 1)])
    far = np.linalg.norm(blue.position_m.numpy()[:, None] - truth, axis=-1)
    assert far.shape == (2, 2)
    assert (far.min(0) < 0.02).all()
    amounts = queries.what(slam, (0.3, -0.1), (0.9, 0.5))
    assert amounts["BLUE_SQUARE"] > 0.5 > amounts["BLUE_TRIANGLE"]
    assert set(queries.landmarks_in(slam, (-0.5, -0.5), (0.9, 0.5))) >= {
        "BLUE_SQUARE",
        "ORANGE_TRIANGLE",
    }
    wall = queries.recall(slam, slam.pointers[3])
    boxes = torch.from_numpy(world.named("WALL").boxes_m).float()
    size = (boxes[:, 1] - boxes[:, 0]).prod(-1)
    true = (slam.space.region_fourier(boxes[:, 0], boxes[:, 1]) * size[:, None]).sum(0)
    alike = (wall * true.conj()).real.sum() / (wall.norm() * true.norm())
    assert float(alike) > 0.95
    whole = queries.whole_map(slam)
    z = torch.fft.rfft(whole) * torch.fft.rfft(slam.pointers[2]).conj()
    found = slam.integrator.decoder(z[None, 1:]).position_m[0]
    np.testing.assert_allclose(found, [-0.2, 0.2], atol=0.05)  # the others are noise in one vector
    to = queries.vectors_to(slam, slam.integrator.z[0])
    there = slam.integrator.decoder(to[0][None]).position_m[0]
    np.testing.assert_allclose(there, truth[0] - stops[-1], atol=0.02)


def test_near_landmarks_are_distinguished():
    space = SSPSpace.hexagonal(n_rotations=5, n_scales=5)
    at = torch.tensor([[0.3, 0.2], [0.36, 0.24], [-0.5, 0.0]])
    found = queries.places_in(space, space.encode_fourier(at).sum(0)).position_m
    assert len(found) == 3
    assert float(torch.cdist(at, found).min(1).values.max()) < 0.01


NOTHING = torch.zeros(1, 1, 2)
WRONG = {
    "not a finite number": lambda s, v: s.run(NOTHING + torch.nan, v),
    r"\(batch, dimension\) = \(1, 2\)": lambda s, v: s.run(torch.zeros(1, 1, 3), v),
    "velocities of shape": lambda s, v: s.run(torch.zeros(1, 2, 2), v),
    "one column": lambda s, v: s.run(NOTHING, v._replace(in_view=v.in_view[..., :2])),
    "in view is not": lambda s, v: s.run(NOTHING, v._replace(low_m=v.low_m + np.nan)),
    "in 1 dimensions": lambda s, v: s.run(NOTHING, v._replace(low_m=v.low_m[..., :1])),
    "outside the bounds": lambda s, _: s.start(torch.tensor([[3.0, 0.0]])),
    "position of shape": lambda s, _: s.start(torch.zeros(2, 2)),
    "places = true": lambda s, _: queries.what(s, (0, 0), (1, 1)),
    "55 features": lambda s, _: queries.recall(s, torch.zeros(3)),
    r"\(landmarks, features\)": lambda s, _: SSPSLAM(s.config, torch.zeros(3)),
    "as many features as the space": lambda s, _: queries.whole_map(
        SSPSLAM(s.config, torch.eye(3, 5))
    ),
    "2 names for 3": lambda s, _: SSPSLAM(s.config, s.pointers, ["A", "B"]),
}


@pytest.mark.parametrize("said", WRONG)
def test_bad_input_is_refused_and_changes_nothing(said):
    slam = slam_in(SSPSLAMConfig(**VECTORS), WORLD)
    simulate(slam, [WORLD], [circle(1.0)])
    before = {k: v.clone() for k, v in slam.state_dict().items()}
    view = views([WORLD], np.array([[[0.4, 0.0]]]))
    with pytest.raises(SpaceError, match=said) as error:
        WRONG[said](slam, view)
    assert "\n" not in str(error.value)
    for name, value in slam.state_dict().items():
        assert torch.equal(value, before[name]), name
