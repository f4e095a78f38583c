"""Makes templates of images: grey, crop, block mean, mean and patch normalisation."""

from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np

from neuroslam.config import ViewConfig
from neuroslam.config.sections import region_in
from neuroslam.errors import ConfigError
from neuroslam.sensors.frames import check_image
from neuroslam.sensors.grey import to_grey


class Encoded(NamedTuple):
    """Template of an image.

    Attributes:
        template: Grey in [0, 1], ``float64``, shape ``(template_height, template_width)``.
        contrast: Standard deviation of the grey view before normalisation.
    """

    template: np.ndarray
    contrast: float


def encode(image: np.ndarray, config: ViewConfig) -> Encoded:
    """Make the template of an image.

    Args:
        image: ``uint8``, ``(h, w)`` grey or ``(h, w, 3)`` RGB.
        config: Rule of grey, crop, size and normalisation.

    Raises:
        BadFrame: If the image has another type or shape.
        ConfigError: If the crop exceeds the image, or is smaller than the template.

    Example:
        >>> image = np.arange(48, dtype=np.uint8).reshape(6, 8)
        >>> config = ViewConfig(
        ...     template_width=4, template_height=3, shift_match=1, normalisation=0
        ... )
        >>> (encode(image, config).template[0] * 255).tolist()
        [4.5, 6.5, 8.5, 10.5]
    """
    check_image(image, "LocalViewCells")
    image = to_grey(image, config.grey)
    view = block_mean(crop(image, config.crop), config.template_height, config.template_width)
    contrast = float(view.std()) if config.min_contrast else 1.0
    if config.normalisation:
        view = normalise_mean(view, config.normalisation)
    if config.patch_radius:
        view = normalise_patches(view, config.patch_radius, config.patch_min_std)
    return Encoded(view, contrast)


def crop(image: np.ndarray, region: tuple[int, int, int, int] | None) -> np.ndarray:
    """Crop an image to ``x_min, x_max, y_min, y_max``, -1: its edge; ``None`` keeps all of it.

    Raises:
        ConfigError: If the region exceeds the image.
    """
    if region is None:
        return image
    height, width = image.shape[:2]
    x_min, x_max, y_min, y_max = region_in(region, height, width)
    if not (0 <= x_min < x_max <= width and 0 <= y_min < y_max <= height):
        raise ConfigError(
            f"view.crop = {list(region)} (x_min, x_max, y_min, y_max) is not inside the image "
            f"of {width}x{height} px; change it, or leave it out to use the whole image"
        )
    return image[y_min:y_max, x_min:x_max]


def block_mean(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """Shrink an image to ``(height, width)`` by the mean of whole blocks, without the remainder.

    The sums are of integers, so they are exact; each is divided once.

    Raises:
        ConfigError: If the image is smaller than the result.
    """
    h, w = image.shape
    block_h, block_w = h // height, w // width
    if not block_h or not block_w:
        raise ConfigError(
            f"view.template_width x template_height = {width}x{height} is larger than the "
            f"cropped image of {w}x{h} px; make the template smaller or the crop larger"
        )
    blocks = image[: height * block_h, : width * block_w].reshape(height, block_h, -1)
    rows = np.add.reduce(blocks, axis=1, dtype=np.uint32)
    sums = rows[:, ::block_w].copy()  # adding columns is faster than reducing a short axis
    for column in range(1, block_w):
        sums += rows[:, column::block_w]
    return np.asarray(sums / (255.0 * block_h * block_w))


def normalise_mean(view: np.ndarray, mean: float) -> np.ndarray:
    """Scale grey to a given mean, and clip to [0, 1]; a black view stays black.

    Example:
        >>> normalise_mean(np.array([[0.1, 0.3]]), 0.5).round(6).tolist()
        [[0.25, 0.75]]
    """
    present = view.mean()
    return np.clip(view * mean / present, 0.0, 1.0) if present > 0.0 else view


def normalise_patches(view: np.ndarray, radius: int, min_std: float) -> np.ndarray:
    r"""Express each pixel in standard deviations of the patch around it.

    .. math:: z = (x - \mu) / \sigma, \qquad v = \operatorname{clip}((z + 3) / 6,\, 0,\, 1)

    with the mean and standard deviation of the pixels of the view within ``radius``.

    Args:
        view: Grey in [0, 1].
        radius: Half width of a patch, px.
        min_std: Patches with a smaller standard deviation become 0.5.
    """
    weight = _patch_weights(view.shape[:2], radius)
    centred = view - view.mean()  # near zero, so that the variance loses no digits
    mean = _patch_sums(centred, radius) * weight
    variance = _patch_sums(centred * centred, radius) * weight - mean * mean
    std = np.sqrt(np.maximum(variance, 0.0))
    flat = std <= max(min_std, 1e-6)
    std[flat] = 1.0
    normalised = np.clip((centred - mean) / (6.0 * std) + 0.5, 0.0, 1.0)
    normalised[flat] = 0.5
    return np.asarray(normalised)


def _patch_sums(values: np.ndarray, radius: int) -> np.ndarray:
    size = (2 * radius + 1, 2 * radius + 1)
    return cv2.boxFilter(values, -1, size, normalize=False, borderType=cv2.BORDER_CONSTANT)


@lru_cache(maxsize=8)
def _patch_weights(shape: tuple[int, int], radius: int) -> np.ndarray:
    """Return one over the number of pixels of each patch that lie in the view."""
    return 1.0 / _patch_sums(np.ones(shape), radius)
