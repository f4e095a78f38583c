"""Views by a network: columns stay columns, distances stay, and maps know which it was."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import save_file
from torch import nn

from neuroslam import BrainConfig, NavigationBrain, load_brain, save_brain
from neuroslam.config import ViewConfig
from neuroslam.config.sections import SessionConfig
from neuroslam.errors import BadFrame, ConfigError
from neuroslam.experiments import run_experiment
from neuroslam.merging.match import find_match
from neuroslam.sensors import open_source
from neuroslam.types import Frame, Velocity
from neuroslam.view import LocalViewCells, vision
from neuroslam.view.features import FeatureEncoder, features_as_template, load_network

SMALL = {"features": "module", "template_width": 16, "template_height": 32, "shift_match": 3}
WORLD = "world:ellipse?laps=4&width=256&height=64"


def texture(seed=0, height=64, width=96):
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), np.uint8)


def filters(seed=0, channels=16):
    """Two layers that halve the image four times, with weights of their own."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return nn.Sequential(
            nn.Conv2d(3, channels, 7, 4, 3), nn.ReLU(), nn.Conv2d(channels, channels, 5, 4, 2)
        )


@pytest.fixture(scope="module")
def squeezenet(tmp_path_factory):
    """Its weights, drawn and not learnt, as torch and as safetensors keep them."""
    vision.load()
    from torchvision.models import squeezenet1_1

    folder = tmp_path_factory.mktemp("weights")
    with torch.random.fork_rng():
        torch.manual_seed(0)
        state = squeezenet1_1().state_dict()
    torch.save(state, folder / "squeezenet.pth")
    save_file(state, folder / "squeezenet.safetensors")
    return folder


# --- templates --------------------------------------------------------------------------------


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.05, 1.0))
def test_templates_differ_as_the_unit_features_do(seed, apart):
    r"""On average by sqrt(2/pi)/6 of the distance: 4000 directions know it to 2 %."""
    draw = torch.Generator().manual_seed(seed)
    f = torch.randn(1, 20, 3, 5, generator=draw)
    g = f + apart * torch.randn(1, 20, 3, 5, generator=draw)
    one, other = (features_as_template(x, 4000, 5) for x in (f, g))
    unit = [x[0].reshape(60, 5) / x[0].reshape(60, 5).norm(dim=0) for x in (f, g)]
    wanted = math.sqrt(2 / math.pi) / 6 * (unit[0] - unit[1]).norm(dim=0)
    torch.testing.assert_close((one - other).abs().mean(0).float(), wanted, rtol=0.06, atol=0)


def test_brightness_of_features_does_not_matter_and_silence_is_grey():
    f = torch.randn(1, 8, 2, 6, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(features_as_template(f, 9, 6), features_as_template(2.5 * f, 9, 6))
    assert (features_as_template(torch.zeros(1, 8, 2, 6), 9, 6) == 0.5).all()
    assert features_as_template(f[:, :, 0, 0], 9, 6).shape == (9, 6)


@pytest.mark.parametrize("grey", [False, True])
def test_a_view_is_learnt_once_and_matched_afterwards(grey):
    cells = LocalViewCells(ViewConfig(**SMALL), filters())
    images = [texture(seed)[..., 0] if grey else texture(seed) for seed in range(6)]
    first, again = [[cells(p) for p in images] for _ in range(2)]
    assert [m.template for m in first] == [m.template for m in again] == list(range(6))
    assert all(m.is_new for m in first)
    assert all(m.error == 0.0 for m in again)
    assert cells(np.full((64, 96), 9, np.uint8)).template == -1  # it shows nothing


def test_a_shifted_image_is_recognised_within_the_range():
    cells = LocalViewCells(ViewConfig(**SMALL, threshold=0.03), filters())
    wide = texture(3, width=256 + 128)
    cells(wide[:, 64:320])
    assert cells(wide[:, 96:352]).template == 0  # two columns of 16 px
    assert cells(wide[:, 128:384]).is_new


@pytest.mark.parametrize("turn", [-5, 1, 7])
def test_a_turned_panorama_is_a_rolled_template(turn):
    """Exactly, where a column of the template is one of the features: edges are not seen."""
    config = ViewConfig(**SMALL | {"shift_match": 0}, panoramic=True)
    cells = LocalViewCells(config, filters())
    image = texture(2, width=16 * 16)
    ahead, turned = cells.encode(image), cells.encode(np.roll(image, -16 * turn, axis=1))
    np.testing.assert_allclose(turned, np.roll(ahead, -turn, axis=1), atol=1e-5)
    cells(image)
    match = cells(np.roll(image, -16 * turn, axis=1))
    assert not match.is_new
    assert match.relative_heading_rad == pytest.approx(-2 * math.pi * turn / 16)


def test_a_network_of_one_vector_fills_the_template():
    network = nn.Sequential(filters(), nn.AdaptiveAvgPool2d(1), nn.Flatten())
    cells = LocalViewCells(ViewConfig(**SMALL | {"shift_match": 0}), network)
    assert [cells(texture(seed)).template for seed in (0, 1, 0, 1)] == [0, 1, 0, 1]
    with pytest.raises(ConfigError, match=r"one vector .* set view.shift_match = 0"):
        LocalViewCells(ViewConfig(**SMALL), network)(texture())


# --- networks of torchvision ------------------------------------------------------------------


def test_a_named_network_is_read_from_either_file_and_draws_nothing(squeezenet):
    before = torch.get_rng_state()
    small = SMALL | {"features": "squeezenet1_1.features.5"}
    found = [
        FeatureEncoder(ViewConfig(**small, weights=str(squeezenet / name)))
        for name in ("squeezenet.pth", "squeezenet.safetensors")
    ]
    one, other = (encoder(texture()) for encoder in found)
    np.testing.assert_array_equal(one.template, other.template)
    assert one.template.std() > 0.01
    assert found[0].digest == found[1].digest
    assert torch.equal(torch.get_rng_state(), before)


def test_a_network_without_a_layer_ends_at_its_last_features(squeezenet):
    weights = squeezenet / "squeezenet.pth"
    whole = load_network("squeezenet1_1", weights)
    last = load_network("squeezenet1_1.features.12", weights)
    x = torch.rand(1, 3, 64, 96, generator=torch.Generator().manual_seed(0))
    assert whole(x).shape[1] == 512
    torch.testing.assert_close(whole(x), last(x), rtol=0, atol=0)


@pytest.mark.parametrize(
    ("features", "weights", "message"),
    [
        ("squeezenet1_1", "none.pth", "no such file"),
        ("squeezenet1_1", "text.pth", "cannot be read; expected the state_dict"),
        ("squeezenet1_1", "list.pth", "contains no state_dict"),
        ("squeezenet9", "squeezenet.pth", "similar names: squeezenet1_1"),
        ("squeezenet1_1.features.77", "squeezenet.pth", "after its name: features, classifier"),
        ("resnet18", "squeezenet.pth", "not of resnet18"),
    ],
)
def test_errors_of_weights_are_reported(features, weights, message, squeezenet):
    (squeezenet / "text.pth").write_text("no weights")
    torch.save([torch.zeros(2)], squeezenet / "list.pth")
    with pytest.raises(ConfigError, match=message) as error:
        load_network(features, squeezenet / weights)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("view", "message"),
    [
        ({"features": "resnet18"}, "features resnet18 needs weights"),
        ({"weights": "a.pth"}, "weights belong to a named network, but features is grey"),
        ({"features": "module", "weights": "a.pth"}, "but features is module"),
    ],
)
def test_name_and_weights_belong_together(view, message):
    with pytest.raises(ValueError, match=message):
        ViewConfig(**view)


class Gives(nn.Module):
    def __init__(self, found):
        super().__init__()
        self.found = found

    def forward(self, x):
        return self.found(x) if callable(self.found) else self.found


@pytest.mark.parametrize(
    ("found", "error", "message"),
    [
        (torch.zeros(1, 4, 5), ConfigError, r"returns \(1, 4, 5\); expected features"),
        ({"out": 1}, ConfigError, "returns dict; expected features"),
        (torch.zeros(1, 4, 3, 5, dtype=torch.int64), ConfigError, "expected features"),
        (torch.full((1, 4, 3, 5), math.nan), BadFrame, "are not finite"),
        (nn.Conv2d(3, 4, 200), ConfigError, "fails on an image of 96x64 px"),
    ],
)
def test_errors_of_a_network_are_reported(found, error, message):
    with pytest.raises(error, match=message):
        LocalViewCells(ViewConfig(**SMALL), Gives(found))(texture())


# --- brains -----------------------------------------------------------------------------------


def config_of(**view):
    return BrainConfig(view=SMALL | {"panoramic": True, "shift_match": 0} | view)


def lived(frames, network, stored=()):
    brain = NavigationBrain(config_of(), features=network)
    for one in stored:
        brain.store(one)
    for frame in frames:
        brain(frame)
    return brain


@pytest.fixture(scope="module")
def tour():
    return list(open_source(WORLD).frames(0, 700))


@pytest.fixture(scope="module")
def first(tour):
    return lived(tour[:300], filters())


def test_a_saved_brain_goes_on_bit_for_bit_when_it_is_given_its_network(first, tour, tmp_path):
    path = tmp_path / "brain.safetensors"
    half = lived(tour[:150], filters())
    save_brain(half, path)
    loaded = load_brain(path, features=filters())
    for frame in tour[150:300]:
        loaded(frame)
    assert first.view.n > 10
    for name, value in first.state_dict().items():
        assert torch.equal(value, loaded.state_dict()[name]), name
    assert not any("weight" in name for name in first.state_dict())  # files hold maps


def test_a_brain_says_which_network_it_needs(tour, tmp_path):
    path = tmp_path / "brain.safetensors"
    brain = lived(tour[:50], filters())
    save_brain(brain, path)
    assert load_brain(path).map.n == brain.map.n  # to look at it, no network is needed
    with pytest.raises(
        ConfigError, match=r"no network was passed; pass it .*load_brain\(path, feat"
    ):
        load_brain(path)(tour[50])
    with pytest.raises(ConfigError, match="views of the map were made with other weights"):
        load_brain(path, features=filters(seed=1))(tour[50])
    with pytest.raises(ConfigError, match=r"view.features is 'grey'; set it to 'module'"):
        NavigationBrain(features=filters())


def test_a_session_joins_the_map_of_its_network_and_keeps_the_network(first, tour):
    brain = lived(tour[380:], filters(), [first])
    assert not len(brain.stored)
    assert [merge["merged"] for merge in brain.sessions.merges] == [True]
    n = brain.view.n
    brain(tour[-1]._replace(index=700, time_s=tour[-1].time_s + 0.05))
    assert brain.view.n == n
    brain.start_new_map()
    brain(tour[0]._replace(index=701, time_s=tour[-1].time_s + 0.1))
    assert (brain.view.n, len(brain.stored)) == (1, 1)


def test_after_a_gap_the_network_makes_the_views_of_a_new_map(tour):
    """The first frame of a new map was looked at before that was begun."""
    config = config_of().model_copy(update={"sessions": SessionConfig(after_gap="new_map")})
    brain = NavigationBrain(config, features=filters())
    for frame in tour[:40]:
        brain(frame)
    later = [f._replace(time_s=f.time_s + 600.0) for f in tour[40:80]]
    for frame in later:
        brain(frame)
    assert len(brain.stored) == 1
    assert brain.view.n > 1
    assert brain.view.network_digest == brain.stored[0].view.network_digest != 0


def test_networks_without_weights_are_distinguished_by_their_parts():
    pooled = [FeatureEncoder(ViewConfig(**SMALL), nn.AvgPool2d(size)).digest for size in (4, 8, 4)]
    assert pooled[0] == pooled[2] != pooled[1]


@pytest.mark.parametrize("precision", [torch.float16, torch.bfloat16, torch.float64])
def test_weights_may_be_kept_in_another_precision(precision, squeezenet, tmp_path):
    state = torch.load(squeezenet / "squeezenet.pth", weights_only=True)
    torch.save({name: w.to(precision) for name, w in state.items()}, tmp_path / "other.pth")
    x = torch.rand(1, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    plain, other = (
        load_network("squeezenet1_1.features.4", path)(x)
        for path in (squeezenet / "squeezenet.pth", tmp_path / "other.pth")
    )
    assert other.dtype == torch.float32
    assert float((plain - other).detach().abs().max()) < 0.02 * float(plain.detach().abs().max())
    encoded = FeatureEncoder(ViewConfig(**SMALL), filters().to(precision))(texture())
    assert encoded.template.shape == (32, 16)


def weights_of(name, folder):
    """Write weights of a network of torchvision that were drawn and not learnt."""
    vision.load()
    from torchvision import models

    with torch.random.fork_rng():
        torch.save(models.get_model(name).state_dict(), folder / f"{name}.pth")
    return folder / f"{name}.pth"


def test_a_transformer_that_has_its_channels_last_is_taken_where_they_are_first(tmp_path):
    path = weights_of("swin_t", tmp_path)
    assert load_network("swin_t", path)(torch.rand(1, 3, 96, 192)).shape == (1, 768, 7, 14)
    with pytest.raises(ConfigError, match=r"channels last; use swin_t\.permute"):
        load_network("swin_t.features", path)


def test_a_network_that_computes_its_widths_with_tensors_can_be_made(tmp_path):
    path = weights_of("regnet_y_400mf", tmp_path)
    assert load_network("regnet_y_400mf.trunk_output", path)(torch.rand(1, 3, 64, 64)).ndim == 4


class Transformer(nn.Module):
    """Takes one size, as transformers do."""

    def forward(self, x):
        assert x.shape[-1] == 224, "Wrong image width!"
        return x


def test_a_network_that_only_takes_its_own_size_is_one_line():
    with pytest.raises(ConfigError, match=r"fails on an image of 96x64 px \(Wrong image width!"):
        FeatureEncoder(ViewConfig(**SMALL), Transformer())(texture())


def test_a_name_is_no_network():
    with pytest.raises(ConfigError, match=r"expected a torch\.nn\.Module"):
        NavigationBrain(config_of(), features="resnet18")


def test_maps_of_two_networks_are_not_merged(first, tour):
    other = lived(tour[:60], filters(seed=1))
    assert (
        "the weights of the network of views, 'module', differ" in find_match(first, other).reason
    )
    for brain in (other, NavigationBrain(config_of(), features=filters(seed=1))):
        with pytest.raises(ConfigError, match="weights of the network of views, 'module'"):
            brain.store(first)


def test_where_the_weights_lie_does_not_matter(squeezenet):
    named = {"features": "squeezenet1_1.features.4"}
    frame = Frame(0, 0.0, texture(), Velocity(0.1, 0.0))
    brains = []
    for file in ("squeezenet.pth", "squeezenet.safetensors"):
        brains.append(NavigationBrain(config_of(**named, weights=str(squeezenet / file))))
        brains[-1](frame)
    assert "config" not in find_match(*brains).reason


def test_a_run_with_a_network(call, mistake, squeezenet, tmp_path, monkeypatch):
    given = ["--set", "view.features=squeezenet1_1.features.4", "--set", "view.shift_match=0"]
    weights = ["--set", f"view.weights={squeezenet / 'squeezenet.pth'}"]
    out = tmp_path / "run"
    assert call("run", WORLD, "--out", out, "--stop", 40, *given, *weights).code == 0
    assert load_brain(out / "brain.safetensors").view.n > 3
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(squeezenet)
    near = ["--set", "view.weights=squeezenet.pth"]
    assert call("run", WORLD, "--out", tmp_path / "near", "--stop", 9, *given, *near).code == 0
    monkeypatch.chdir(elsewhere)  # the weights are where they were
    assert call("resume", tmp_path / "near", "--stop", 12).code == 0
    missing = ["--set", "view.weights=none.pth"]
    message = mistake("run", WORLD, "--out", tmp_path / "other", *given, *missing)
    assert f"view.weights = '{elsewhere / 'none.pth'}': no such file" in message


def test_networks_are_compared_on_the_corridor(shared, squeezenet, tmp_path, mistake):
    name = "squeezenet1_1.features.5"
    networks = {name: squeezenet / "squeezenet.pth"}
    rows = run_experiment("view-matching", shared / "data", tmp_path, networks=networks)
    rows = [row for row in rows if row["templates"] == name]
    assert [(row["width_px"], row["height_px"]) for row in rows] == [(16, 64), (32, 24)]
    # Weights that were not learnt tell more than chance, 0.11, and less than grey does.
    assert all(0.2 < row["pairs_average_precision"] < 0.5 for row in rows)
    message = mistake("experiment", "compare", "--out", tmp_path, "--network", f"{name}=x.pth")
    assert "compares no views; leave --network out" in message
    message = mistake("experiment", "view-matching", "--out", tmp_path, "--network", name)
    assert "expected NAME=FILE" in message
