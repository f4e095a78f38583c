"""From an image to a template by a network: its features in place of grey, column by column."""

import difflib
import hashlib
import importlib
import re
import warnings
from collections.abc import Callable
from functools import cached_property, lru_cache, partial
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import torch
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn.functional import interpolate, pad

from neuroslam.config import ViewConfig
from neuroslam.errors import BadFrame, ConfigError
from neuroslam.sensors.frames import check_image
from neuroslam.state.files import first_line, tensors_digest
from neuroslam.view import vision
from neuroslam.view.preprocess import Encoded, crop, encode

Encoder = Callable[[np.ndarray], Encoded]
"""Makes the template of an image."""

_SIDE_PX = 224  # shorter side of the images that networks of torchvision were trained on
_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # and how these were normalised
_SMALL_PX = (32, 24)  # contrast is that of a small image: noise of pixels shows nothing


class FeatureEncoder:
    r"""Makes the template of an image from the features that a network finds in it.

    The network gives a map of features, ``(1, channels, rows, columns)``. All features of a column
    of the image are one vector, scaled to length 1, and the template holds its components along
    ``template_height`` random directions, the same for every image:

    .. math:: v_{\cdot j} = \operatorname{clip}\!\left(\tfrac{1}{6} P\,
              \tfrac{f_j}{\lVert f_j \rVert} + \tfrac{1}{2},\, 0,\, 1\right),
              \qquad P_{ki} \sim \mathcal{N}(0, 1)

    Random projections keep distances (Johnson and Lindenstrauss 1984; for place recognition,
    Suenderhauf et al. 2015): two templates differ by
    :math:`\tfrac{1}{6}\sqrt{2/\pi}\,\lVert \hat f - \hat g \rVert`, on average over the columns,
    so 0.05 is a cosine of 0.93. Columns stay columns: templates are shifted, rolled, stored and
    searched as those of grey. A network without a map of features, ``(1, channels)``, fills the
    template with components of its one vector; it cannot be shifted.

    Args:
        config: ``features`` and ``weights`` name the network; crop and size of the template.
        network: In place of a named one, where ``features`` is ``"module"``: takes RGB in [0, 1],
            ``float32``, ``(1, 3, h, w)``. It is set to evaluation and keeps no gradients; an image
            is taken to the device that it is on.

    Raises:
        ConfigError: If a network is passed, and ``features`` does not say so.

    Example:
        >>> config = ViewConfig(features="module", template_width=8, template_height=4,
        ...     shift_match=2)
        >>> encode = FeatureEncoder(config, nn.Conv2d(3, 16, 5, stride=4))
        >>> encode(np.zeros((48, 64, 3), np.uint8)).template.shape
        (4, 8)
    """

    def __init__(self, config: ViewConfig, network: nn.Module | None = None) -> None:
        if network is not None and config.features != "module":
            raise ConfigError(
                f"a network was passed, but view.features is {config.features!r}; set it to "
                "'module', for what is saved must say how views were made"
            )
        self.config = config
        self._passed = network

    @cached_property
    def network(self) -> nn.Module:
        """The network; a named one is loaded when it is first used.

        Raises:
            ConfigError: If it was not passed, or its weights cannot be loaded.
        """
        config, network = self.config, self._passed
        if config.features == "module" and network is None:
            raise ConfigError(
                "view.features is 'module', and none was passed; pass it in Python, as "
                "NavigationBrain(config, features=...) or load_brain(path, features=...)"
            )
        network = network or load_network(config.features, config.weights)
        return network.eval().requires_grad_(False)

    @cached_property
    def digest(self) -> int:
        """A number that tells networks apart by their weights and parts, never 0."""
        told = tensors_digest(self.network.state_dict()) + self.config.features
        if self._passed is not None:  # what has no weights tells networks apart too
            told += re.sub(r" at 0x[0-9a-f]+", "", repr(self._passed))
        return int.from_bytes(hashlib.sha256(told.encode()).digest()[:7]) + 1

    def __call__(self, image: np.ndarray) -> Encoded:
        """Make the template of an image.

        Args:
            image: ``uint8``, ``(h, w)`` grey or ``(h, w, 3)`` RGB.

        Raises:
            BadFrame: If the image is of another type or shape, or its features not finite.
            ConfigError: If the crop leaves the image, or the network gives no features.
        """
        check_image(image, "LocalViewCells")
        config = self.config
        image = crop(image, config.crop)
        rgb = image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)
        x = torch.from_numpy(np.ascontiguousarray(rgb)).permute(2, 0, 1)[None].float() / 255.0
        around = max(1, config.template_width // 4) if config.panoramic else 0
        if around:  # what lies beyond an edge is seen at the other one
            beyond = round(x.shape[-1] * around / config.template_width)
            x = pad(x, (beyond, beyond, 0, 0), mode="circular")
        found = self._features(x)
        template = features_as_template(
            found, config.template_height, config.template_width, around
        )
        contrast = 1.0
        if config.min_contrast:
            grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
            small = cv2.resize(grey, _SMALL_PX, interpolation=cv2.INTER_AREA)
            contrast = float(small.std()) / 255.0
        return Encoded(template.numpy(force=True), contrast)

    def _features(self, x: Tensor) -> Tensor:
        config, name = self.config, self.config.features
        weights = (w for w in self.network.parameters() if w.is_floating_point())
        try:
            with torch.inference_mode():
                found = self.network(x.to(next(weights, x)))  # to their device and precision
        except (RuntimeError, ValueError, TypeError, AssertionError, LookupError) as error:
            raise ConfigError(
                f"view.features = {name!r}: the network fails on an image of "
                f"{x.shape[-1]}x{x.shape[-2]} px ({first_line(error)})"
            ) from None
        fits = isinstance(found, Tensor) and found.is_floating_point()
        if not fits or found.ndim not in (2, 4) or len(found) != 1 or not found.numel():
            got = tuple(found.shape) if isinstance(found, Tensor) else type(found).__name__
            raise ConfigError(
                f"view.features = {name!r}: the network gives {got}; expected features, "
                "(1, channels, rows, columns) or (1, channels); name an earlier layer"
            )
        if found.ndim == 2 and (config.panoramic or config.shift_match):
            raise ConfigError(
                f"view.features = {name!r}: the network gives one vector for an image, which "
                "cannot be shifted; set view.shift_match = 0 and view.panoramic = false"
            )
        if not torch.isfinite(found).all():
            raise BadFrame(f"features of {name!r} are not all finite numbers")
        return found.float()


def view_encoder(config: ViewConfig, features: nn.Module | Encoder | None = None) -> Encoder:
    """Return what makes templates of images: grey, or the features of a network.

    Args:
        config: Says which.
        features: The network, where it is passed; what this function returned is given back.

    Raises:
        ConfigError: If a network is passed, and ``config.features`` does not say so.

    Example:
        >>> view_encoder(ViewConfig())(np.zeros((120, 160), np.uint8)).template.shape
        (10, 60)
    """
    if features is not None and not isinstance(features, nn.Module):
        if not callable(features):
            raise ConfigError(
                f"features is {features!r}; expected a torch.nn.Module. One of torchvision is "
                "named in the config, as view.features"
            )
        return features
    if config.features == "grey" and features is None:
        return partial(encode, config=config)
    return FeatureEncoder(config, features)


def features_as_template(features: Tensor, height: int, width: int, around: int = 0) -> Tensor:
    """Express features along random directions, as :class:`FeatureEncoder` says.

    Args:
        features: ``(1, channels, rows, columns)`` or ``(1, channels)``.
        height: Rows of the template: directions.
        width: Its columns; those of the features are interpolated to as many.
        around: Columns, at either side and of the template's size, that are left out of a map.

    Returns:
        In [0, 1], ``(height, width)``.

    Example:
        >>> same = torch.ones(1, 5, 2, 3)
        >>> bool((features_as_template(same, 4, 6) == features_as_template(3 * same, 4, 6)).all())
        True
    """
    if features.ndim == 4:
        size = (features.shape[2], width + 2 * around)
        if size != features.shape[2:]:
            features = interpolate(
                features, size, mode="bilinear", align_corners=False, antialias=True
            )
        columns = features[0, :, :, around : around + width].reshape(-1, width)
    else:
        columns = features[0, :, None]
    unit = columns / columns.norm(dim=0).clamp_min(1e-12)
    n_directions = height if features.ndim == 4 else height * width
    along = _directions(n_directions, len(unit)).to(unit.device) @ unit
    return (along / 6.0 + 0.5).clamp(0.0, 1.0).double().reshape(height, width)


@lru_cache(maxsize=4)
def _directions(n: int, n_features: int) -> Tensor:
    """The same in every brain: they belong to the code, and not to its state."""
    draw = torch.Generator().manual_seed(0)
    return torch.randn(n, n_features, generator=draw, dtype=torch.float32)


def load_network(name: str, weights: str | Path | None) -> nn.Module:
    """Make a network of torchvision, from a file of its weights, up to a layer.

    Args:
        name: As in ``torchvision.models``, and a layer, as ``resnet18.layer3``; without a layer,
            up to the last map of features, where the network calls it ``features`` or ``layer4``.
        weights: ``state_dict`` of the whole network: ``.safetensors``, or as torch saves it.

    Returns:
        It takes RGB in [0, 1] of any size, and makes the shorter side 224 px.

    Raises:
        ConfigError: One line: no such network, layer or file, or the weights do not fit.
    """
    model_name, _, layer = name.partition(".")
    vision.load()
    models = importlib.import_module("torchvision.models")
    extraction = importlib.import_module("torchvision.models.feature_extraction")
    known = models.list_models(module=models)
    if model_name not in known:
        near = ", ".join(difflib.get_close_matches(model_name, known, n=3, cutoff=0.0))
        raise ConfigError(
            f"view.features = {name!r}: expected 'grey', 'module', or a network of torchvision and "
            f"its layer, as 'resnet18.layer3'; near it are {near}"
        )
    network = _empty(models, model_name)
    state = _read_weights(weights)
    try:
        network.load_state_dict(state, assign=True)
    except (RuntimeError, TypeError, AttributeError) as error:
        missing = set(network.state_dict()) - set(state)
        why = f"{len(missing)} tensors of it are missing" if missing else first_line(error)
        raise ConfigError(f"view.weights = {str(weights)!r}: not of {model_name} ({why})") from None
    parts = [part for part, _ in network.named_children()]
    last = ("permute", "features", "layer4")
    layer = layer or next((part for part in last if part in parts), "")
    if "permute" in parts and layer.partition(".")[0] == "features":
        raise ConfigError(
            f"view.features = {name!r}: has its channels last; name {model_name}.permute, behind it"
        )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that training and evaluation differ in their nodes
            network = network.float().eval()  # a file may hold halves
            upto = extraction.create_feature_extractor(network, {layer: "found"})
    except (ValueError, RuntimeError, AssertionError):
        raise ConfigError(
            f"view.features = {name!r}: expected a layer of {model_name} behind its name; its "
            f"parts are {', '.join(parts)}"
        ) from None
    prepare = [
        vision.transforms.Resize(_SIDE_PX, antialias=True),
        vision.transforms.Normalize(_MEAN, _STD),
    ]
    return nn.Sequential(*prepare, upto, _Found())


def _empty(models: ModuleType, name: str) -> nn.Module:
    """Make a network whose weights are to be replaced at once."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of how weights would be drawn
        try:
            with torch.device("meta"):  # then none are
                return models.get_model(name, weights=None)
        except NotImplementedError:  # RegNet reckons its widths with tensors
            with torch.random.fork_rng(devices=[]):
                return models.get_model(name, weights=None)


class _Found(nn.Module):
    def forward(self, outputs: dict[str, Tensor]) -> Tensor:
        return outputs["found"]


def _read_weights(path: str | Path | None) -> dict[str, Tensor]:
    """Read a ``state_dict`` without running what a file may hold."""
    said = f"view.weights = {str(path)!r}"
    try:
        if Path(path).suffix == ".safetensors":
            return load_file(path)
        state = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise ConfigError(f"{said}: no such file; it holds the network's state_dict") from None
    except Exception:  # torch.load: whatever a damaged file makes it run into
        raise ConfigError(
            f"{said}: cannot be read; expected the state_dict of a network, as torch.save or "
            "safetensors writes it"
        ) from None
    if not isinstance(state, dict) or not all(isinstance(t, Tensor) for t in state.values()):
        raise ConfigError(f"{said}: holds no state_dict, a dict of tensors")
    return state
