"""Makes templates from the features of a network instead of grey, column by column."""

import difflib
import hashlib
import importlib
import re
import warnings
from collections.abc import Callable
from functools import cached_property, lru_cache, partial
from pathlib import Path
from types import ModuleType
from typing import cast

import cv2
import numpy as np
import torch
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn.functional import interpolate, pad

from neuroslam.config import ViewConfig
from neuroslam.errors import BadFrame, ConfigError, first_line
from neuroslam.sensors.frames import check_image
from neuroslam.sensors.grey import to_grey
from neuroslam.state.files import tensors_digest
from neuroslam.view import vision
from neuroslam.view.preprocess import Encoded, crop, encode

Encoder = Callable[[np.ndarray], Encoded]
"""Function that makes the template of an image."""

_SIDE_PX = 224  # shorter side of the training images of torchvision's networks
_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # and their normalisation
_SMALL_PX = (32, 24)  # contrast is measured on a small image, without pixel noise


class FeatureEncoder:
    r"""Makes the template of an image from the features of a network.

    The network returns a feature map, ``(1, channels, rows, columns)``. All features of one column
    form a vector :math:`f_j`, normalised to length 1; the template contains its projections on
    ``template_height`` random directions, the same for every image:

    .. math:: v_{\cdot j} = \operatorname{clip}\!\left(\tfrac{1}{6} P\,
              \tfrac{f_j}{\lVert f_j \rVert} + \tfrac{1}{2},\, 0,\, 1\right),
              \qquad P_{ki} \sim \mathcal{N}(0, 1)

    Random projections preserve distances (Johnson and Lindenstrauss 1984; for place recognition,
    Suenderhauf et al. 2015): two templates differ by
    :math:`\tfrac{1}{6}\sqrt{2/\pi}\,\lVert \hat f - \hat g \rVert`, averaged over the columns,
    so 0.05 corresponds to a cosine of 0.93. Columns remain columns: templates are shifted, rolled,
    stored and searched like those of grey images. If the network returns one vector,
    ``(1, channels)``, its projections fill the template, which cannot be shifted.

    Args:
        config: ``features`` and ``weights`` name the network; crop and size of the template.
        network: The network, if ``features`` is ``"module"``; its input is RGB in [0, 1],
            ``float32``, ``(1, 3, h, w)``. It is set to evaluation mode without gradients; images
            are moved to its device.

    Raises:
        ConfigError: If a network is passed, but ``features`` is not ``"module"``.

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
                "'module', so that a saved brain states how its views were made"
            )
        self.config = config
        self._passed = network

    @cached_property
    def network(self) -> nn.Module:
        """The network; a named one is loaded on first use.

        Raises:
            ConfigError: If no network was passed, or its weights cannot be loaded.
        """
        config, network = self.config, self._passed
        if config.features == "module" and network is None:
            raise ConfigError(
                "view.features is 'module', but no network was passed; pass it in Python, as "
                "NavigationBrain(config, features=...) or load_brain(path, features=...)"
            )
        network = network or load_network(config.features, config.weights)
        return network.eval().requires_grad_(False)

    @cached_property
    def digest(self) -> int:
        """Number that identifies the network by its weights and parts; never 0."""
        identity = tensors_digest(self.network.state_dict()) + self.config.features
        if self._passed is not None:  # networks may differ in parts without weights
            identity += re.sub(r" at 0x[0-9a-f]+", "", repr(self._passed))
        return int.from_bytes(hashlib.sha256(identity.encode()).digest()[:7]) + 1

    def __call__(self, image: np.ndarray) -> Encoded:
        """Make the template of an image.

        Args:
            image: ``uint8``, ``(h, w)`` grey or ``(h, w, 3)`` RGB.

        Raises:
            BadFrame: If the image has another type or shape, or its features are not finite.
            ConfigError: If the crop exceeds the image, or the network returns no features.
        """
        check_image(image, "LocalViewCells")
        config = self.config
        image = crop(image, config.crop)
        rgb = image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)
        x = torch.from_numpy(np.ascontiguousarray(rgb)).permute(2, 0, 1)[None].float() / 255.0
        around = max(1, config.template_width // 4) if config.panoramic else 0
        if around:  # a panorama continues at its other edge
            margin = round(x.shape[-1] * around / config.template_width)
            x = pad(x, (margin, margin, 0, 0), mode="circular")
        template = features_as_template(
            self._features(x), config.template_height, config.template_width, around
        )
        contrast = 1.0
        if config.min_contrast:
            grey = to_grey(rgb, config.grey)
            small = cv2.resize(grey, _SMALL_PX, interpolation=cv2.INTER_AREA)
            contrast = float(small.std()) / 255.0
        return Encoded(template.numpy(force=True), contrast)

    def _features(self, x: Tensor) -> Tensor:
        config, name = self.config, self.config.features
        weights = (w for w in self.network.parameters() if w.is_floating_point())
        try:
            with torch.inference_mode():
                features = self.network(x.to(next(weights, x)))  # to their device and precision
        except (RuntimeError, ValueError, TypeError, AssertionError, LookupError) as error:
            raise ConfigError(
                f"view.features = {name!r}: the network fails on an image of "
                f"{x.shape[-1]}x{x.shape[-2]} px ({first_line(error)})"
            ) from None
        is_tensor = isinstance(features, Tensor)
        fits = is_tensor and features.is_floating_point() and features.ndim in (2, 4)
        if not fits or len(features) != 1 or not features.numel():
            got = tuple(features.shape) if is_tensor else type(features).__name__
            raise ConfigError(
                f"view.features = {name!r}: the network returns {got}; expected features, "
                "(1, channels, rows, columns) or (1, channels); name an earlier layer"
            )
        if features.ndim == 2 and (config.panoramic or config.shift_match):
            raise ConfigError(
                f"view.features = {name!r}: the network returns one vector per image, which "
                "cannot be shifted; set view.shift_match = 0 and view.panoramic = false"
            )
        if not torch.isfinite(features).all():
            raise BadFrame(f"features of {name!r} are not finite; expected finite numbers")
        return cast(Tensor, features.float())


def view_encoder(config: ViewConfig, features: nn.Module | Encoder | None = None) -> Encoder:
    """Return the function that makes templates of images: of grey, or of a network's features.

    Args:
        config: Its ``features`` selects the function.
        features: The network, if ``config.features`` is ``"module"``; an earlier result of this
            function is returned as it is.

    Raises:
        ConfigError: If a network is passed, but ``config.features`` is not ``"module"``.

    Example:
        >>> view_encoder(ViewConfig())(np.zeros((120, 160), np.uint8)).template.shape
        (10, 60)
    """
    if features is not None and not isinstance(features, nn.Module):
        if not callable(features):
            raise ConfigError(
                f"features is {features!r}; expected a torch.nn.Module. A network of torchvision "
                "is named in the config, as view.features"
            )
        return features
    if config.features == "grey" and features is None:
        return partial(encode, config=config)
    return FeatureEncoder(config, features)


def features_as_template(features: Tensor, height: int, width: int, around: int = 0) -> Tensor:
    """Project features on random directions, see :class:`FeatureEncoder`.

    Args:
        features: ``(1, channels, rows, columns)`` or ``(1, channels)``.
        height: Rows of the template: number of directions.
        width: Columns of the template; the columns of the features are interpolated to as many.
        around: Margin at either side of a feature map, in columns of the template, that is cut.

    Returns:
        Template in [0, 1], ``(height, width)``.

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
    projections = _directions(n_directions, len(unit)).to(unit.device) @ unit
    return (projections / 6.0 + 0.5).clamp(0.0, 1.0).double().reshape(height, width)


@lru_cache(maxsize=4)
def _directions(n: int, n_features: int) -> Tensor:
    """Return random directions; they are the same in every brain, and no part of its state."""
    generator = torch.Generator().manual_seed(0)
    return torch.randn(n, n_features, generator=generator, dtype=torch.float32)


def load_network(name: str, weights: str | Path | None) -> nn.Module:
    """Load a network of torchvision from a file of weights, and cut it after a layer.

    Args:
        name: Name in ``torchvision.models`` and layer, as ``resnet18.layer3``; without a layer, the
            last feature map, if the network calls it ``features`` or ``layer4``.
        weights: File of the ``state_dict`` of the whole network: ``.safetensors``, or torch's.

    Returns:
        Network for RGB in [0, 1] of any size; it resizes the shorter side to 224 px.

    Raises:
        ConfigError: If there is no such network, layer or file, or the weights do not fit.
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
            f"its layer, as 'resnet18.layer3'; similar names: {near}"
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
            f"view.features = {name!r}: has its channels last; use {model_name}.permute, after it"
        )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # training and evaluation have different nodes
            network = network.float().eval()  # the weights may be half precision
            upto = extraction.create_feature_extractor(network, {layer: "features"})
    except (ValueError, RuntimeError, AssertionError):
        raise ConfigError(
            f"view.features = {name!r}: expected a layer of {model_name} after its name: "
            f"{', '.join(parts)}"
        ) from None
    prepare = [
        vision.transforms.Resize(_SIDE_PX, antialias=True),
        vision.transforms.Normalize(_MEAN, _STD),
    ]
    return nn.Sequential(*prepare, upto, _Features())


def _empty(models: ModuleType, name: str) -> nn.Module:
    """Make a network without weights; they are replaced at once."""
    make = cast(Callable[..., nn.Module], models.get_model)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about the initialisation of weights
        try:
            with torch.device("meta"):  # which initialises none
                return make(name, weights=None)
        except NotImplementedError:  # RegNet computes its widths with tensors
            with torch.random.fork_rng(devices=[]):
                return make(name, weights=None)


class _Features(nn.Module):
    """Picks the feature map from the outputs of the cut network."""

    def forward(self, outputs: dict[str, Tensor]) -> Tensor:
        return outputs["features"]


def _read_weights(path: str | Path | None) -> dict[str, Tensor]:
    """Read a ``state_dict`` without executing code in the file."""
    key = f"view.weights = {str(path)!r}"
    try:
        if path is None:
            raise FileNotFoundError
        if Path(path).suffix == ".safetensors":
            return load_file(path)
        state = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise ConfigError(f"{key}: no such file; expected the network's state_dict") from None
    except Exception:  # torch.load raises many types for a damaged file
        raise ConfigError(
            f"{key}: cannot be read; expected the state_dict of a network, as torch.save or "
            "safetensors writes it"
        ) from None
    if not isinstance(state, dict) or not all(isinstance(t, Tensor) for t in state.values()):
        raise ConfigError(f"{key}: contains no state_dict; expected a dict of tensors")
    return state
