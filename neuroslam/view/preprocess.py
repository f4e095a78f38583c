"""Makes templates of images: crop, grey block means and their normalisation, or gradients."""

from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np

from neuroslam.compiled import compiled, plain_array, runs_compiled
from neuroslam.config import ViewConfig
from neuroslam.config.sections import region_in
from neuroslam.errors import ConfigError
from neuroslam.geometry import TWO_PI
from neuroslam.sensors.frames import check_image
from neuroslam.sensors.grey import to_grey

_CELL_PX = 4  # pixels of the reduced image across a cell of gradients
_SMOOTH_PX, _POOL_PX = 2.0, 2.5  # standard deviations of the blur before and after the gradient
_FLAT_LEVELS = 1.5  # gradient, in grey levels, of which a cell counts half
_LARGEST = 0.4  # share of an orientation in a cell from which on it is white


class Encoded(NamedTuple):
    """Template of an image.

    Attributes:
        template: In [0, 1], ``float64``, shape ``(template_height, template_width)``.
        contrast: Standard deviation of the reduced grey view, before normalisation or gradients.
    """

    template: np.ndarray
    contrast: float


def encode(image: np.ndarray, config: ViewConfig) -> Encoded:
    """Make the template of an image.

    Args:
        image: ``uint8``, ``(h, w)`` grey or ``(h, w, 3)`` RGB.
        config: Rule of grey, crop, size, normalisation and orientations.

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
    image = crop(to_grey(image, config.grey), config.crop)
    height, width = config.template_height, config.template_width
    if config.orientations:
        view, contrast = oriented_gradients(
            image, height, width, config.orientations, config.panoramic
        )
        return Encoded(view, contrast if config.min_contrast else 1.0)
    if runs_compiled():
        view, contrast = encode_step(
            plain_array(image),
            height,
            width,
            *_block_of(image, height, width),
            config.normalisation,
            config.patch_radius,
            config.patch_min_std,
        )
        return Encoded(view, contrast if config.min_contrast else 1.0)
    view = block_mean(image, height, width)
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
    block_h, block_w = _block_of(image, height, width)
    blocks = image[: height * block_h, : width * block_w].reshape(height, block_h, -1)
    rows = np.add.reduce(blocks, axis=1, dtype=np.uint32)
    sums = rows[:, ::block_w].copy()  # adding columns is faster than reducing a short axis
    for column in range(1, block_w):
        sums += rows[:, column::block_w]
    return np.asarray(sums / (255.0 * block_h * block_w))


def _block_of(image: np.ndarray, height: int, width: int) -> tuple[int, int]:
    h, w = image.shape
    block_h, block_w = h // height, w // width
    if not block_h or not block_w:
        raise ConfigError(
            f"view.template_width x template_height = {width}x{height} is larger than the "
            f"cropped image of {w}x{h} px; make the template smaller or the crop larger"
        )
    return block_h, block_w


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


def oriented_gradients(
    image: np.ndarray, height: int, width: int, orientations: int, panoramic: bool = False
) -> Encoded:
    r"""Make a template of the orientations of the gradients in each cell of an image.

    .. math:: v_{co} = \min\!\Big(1,\; \frac{h_{co}}{0.4\,(\lVert h_c \rVert + \epsilon)}\Big),
              \qquad h_{co} = \sum_x w_c(x)\, \lVert \nabla g(x) \rVert\, a_o(x)

    The gradient of a blurred image :math:`g` at :math:`x` is shared by the two nearest of the
    orientations :math:`o`, which do not tell bright from dark sides (:math:`a_o`), and each cell
    :math:`c` sums what lies in and around it (:math:`w_c`): histograms of oriented gradients (N.
    Dalal, B. Triggs, CVPR 2005), normalised per cell and clipped low, so that a template states
    which orientations are present rather than how strong they are. :math:`\epsilon` is 1.5 grey
    levels. Brightness and contrast of the light cancel; blur and pooling forgive small shifts in
    every direction and of scale.

    Args:
        image: Grey, ``uint8``, ``(h, w)``.
        height: Rows of the template: ``orientations`` maps of the cells, one below the other.
        width: Columns of the template, and of the cells.
        orientations: Number of orientations in half a turn; it divides ``height``.
        panoramic: The columns wrap around.

    Returns:
        Template in [0, 1], ``(height, width)``, and contrast of the reduced image.

    Example:
        >>> stripes = np.tile(np.array([0, 0, 0, 0, 200, 200, 200, 200], np.uint8), (32, 4))
        >>> found = oriented_gradients(stripes, 8, 4, 2).template
        >>> found[[0, 4]].tolist()  # across the stripes, and along them
        [[1.0, 1.0, 1.0, 1.0], [0.0, 0.0, 0.0, 0.0]]
    """
    rows = height // orientations
    size = (width * _CELL_PX, rows * _CELL_PX)
    grey = cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    contrast = float(cv2.resize(grey, (width, rows), interpolation=cv2.INTER_AREA).std()) / 255.0
    wrapped = min(size[0], 4 * _CELL_PX) if panoramic else 0
    if wrapped:
        grey = cv2.copyMakeBorder(grey, 0, 0, wrapped, wrapped, cv2.BORDER_WRAP)
    pooled = _pooled_gradients(grey, rows, width, orientations, np.pi, _SMOOTH_PX, wrapped)
    energy = np.sqrt((pooled * pooled).sum(axis=0)) + _FLAT_LEVELS
    view = np.minimum(pooled / (_LARGEST * energy), 1.0)
    return Encoded(view.reshape(height, width).astype(np.float64), contrast)


def directed_gradients(image: np.ndarray, rows: int, columns: int, directions: int) -> np.ndarray:
    """Return the directions of the gradients in each cell of an image, as those of its template.

    Unlike :func:`oriented_gradients`, bright and dark sides are distinguished.

    Args:
        image: Grey, ``uint8``, ``(h, w)``.
        rows: Rows of cells.
        columns: Columns of cells.
        directions: Number of directions in a full turn.

    Returns:
        In [0, 1], ``float32``, ``(rows, columns, directions)``.

    Example:
        >>> step = np.repeat(np.array([[0, 200]], np.uint8), 32, axis=1).repeat(32, axis=0)
        >>> directed_gradients(step, 1, 2, 4)[0, 0].round(2).tolist()
        [1.0, 0.0, 0.0, 0.0]
    """
    size = (columns * _CELL_PX, rows * _CELL_PX)
    grey = cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    pooled = _pooled_gradients(grey, rows, columns, directions, TWO_PI, 1.0, 0)
    energy = np.sqrt((pooled * pooled).sum(axis=0)) + _FLAT_LEVELS
    return np.minimum(pooled / (_LARGEST * energy), 1.0).transpose(1, 2, 0)


def _pooled_gradients(
    grey: np.ndarray, rows: int, columns: int, parts: int, turn: float, blur_px: float, wrapped: int
) -> np.ndarray:
    """Sum the gradients of a reduced image by cell and direction, ``(parts, rows, columns)``."""
    size = (columns * _CELL_PX, rows * _CELL_PX)
    grey = cv2.GaussianBlur(grey, (0, 0), blur_px)
    across = cv2.Sobel(grey, cv2.CV_32F, 1, 0, ksize=1)  # differences of two pixels
    down = cv2.Sobel(grey, cv2.CV_32F, 0, 1, ksize=1)
    strength, angle = np.hypot(across, down), np.arctan2(down, across)
    at = angle % turn * (parts / turn)
    pooled = np.empty((parts, rows, columns), np.float32)
    for o in range(parts):
        apart = np.abs(at - o)
        apart = np.minimum(apart, parts - apart)
        part = cv2.GaussianBlur(strength * np.maximum(1.0 - apart, 0.0), (0, 0), _POOL_PX)
        part = part[:, wrapped : wrapped + size[0]]
        pooled[o] = cv2.resize(part, (columns, rows), interpolation=cv2.INTER_AREA)
    return pooled


@compiled
def encode_step(
    image: np.ndarray,
    height: int,
    width: int,
    block_h: int,
    block_w: int,
    mean: float,
    radius: int,
    min_std: float,
) -> tuple[np.ndarray, float]:
    """Make the template of a cropped grey image, as :func:`encode` does.

    Args:
        image: ``uint8``, ``(h, w)``.
        height: Rows of the template.
        width: Columns of the template.
        block_h: Rows of the image that become one.
        block_w: Columns of the image that become one.
        mean: Grey to which the mean is scaled; 0: no scaling.
        radius: Half width of a patch in px; 0: no patches.
        min_std: See :func:`normalise_patches`.

    Returns:
        Template, ``(height, width)``, and contrast.
    """
    view = np.empty(height * width)
    sums = np.empty(width * block_w, np.uint32)
    for row in range(height):
        for x in range(width * block_w):
            sums[x] = 0
        for y in range(row * block_h, (row + 1) * block_h):
            for x in range(width * block_w):
                sums[x] += image[y, x]
        for column in range(width):
            total = 0
            for x in range(column * block_w, (column + 1) * block_w):
                total += np.int64(sums[x])
            view[row * width + column] = total / (255.0 * block_h * block_w)
    present = _sum(view) / (height * width)
    squares = np.empty(height * width)
    for i in range(height * width):
        squares[i] = (view[i] - present) * (view[i] - present)
    contrast = np.sqrt(_sum(squares) / (height * width))
    if mean > 0.0 and present > 0.0:
        for i in range(height * width):
            view[i] = min(view[i] * mean / present, 1.0)
        present = _sum(view) / (height * width)
    found = view.reshape(height, width)
    if radius > 0:
        _normalise_patches(found, present, radius, max(min_std, 1e-6))
    return found, contrast


@compiled
def _sum(values: np.ndarray) -> float:
    """Add numbers in the order in which numpy adds them, so that means are equal to the last bit.

    Parts of at most 128 numbers are added in eight sums; longer ones are halved, at a multiple of
    eight, and their sums added.
    """
    eight, total, depth = np.empty(8), 0.0, 0
    starts, sizes = np.zeros(64, np.int64), np.zeros(64, np.int64)  # of parts in each other
    halved, half_sums = np.zeros(64, np.int64), np.zeros(64)  # whether a first half is added
    sizes[0] = values.shape[0]
    while depth >= 0:
        start, n = starts[depth], sizes[depth]
        if n > 128:
            depth += 1
            starts[depth], sizes[depth], halved[depth] = start, n // 16 * 8, 0
            continue
        total, whole = 0.0, n // 8 * 8
        if n >= 8:
            for k in range(8):
                eight[k] = values[start + k]
            for first in range(start + 8, start + whole, 8):
                for k in range(8):
                    eight[k] += values[first + k]
            total = ((eight[0] + eight[1]) + (eight[2] + eight[3])) + (
                (eight[4] + eight[5]) + (eight[6] + eight[7])
            )
        for k in range(start + whole, start + n):
            total += values[k]
        depth -= 1
        while depth >= 0 and halved[depth] == 1:
            total = half_sums[depth] + total
            depth -= 1
        if depth >= 0:  # the second half of this part
            half_sums[depth], halved[depth] = total, 1
            half = sizes[depth] // 16 * 8
            depth += 1
            starts[depth], halved[depth] = starts[depth - 1] + half, 0
            sizes[depth] = sizes[depth - 1] - half
    return total


@compiled
def _normalise_patches(view: np.ndarray, present: float, radius: int, flat: float) -> None:
    """Normalise a view of mean ``present`` in place; sums run on as in OpenCV's box filter."""
    height, width = view.shape
    sums, squares = np.zeros((height, width)), np.zeros((height, width))
    for row in range(height):  # sums over the columns of the patches
        sum_ = square = 0.0
        for column in range(-radius, width):
            new = old = 0.0
            if column + radius < width:
                new = view[row, column + radius] - present
            if column > radius:
                old = view[row, column - radius - 1] - present
            sum_ += new - old
            square += new * new - old * old
            if column >= 0:
                sums[row, column], squares[row, column] = sum_, square
    sum_of, square_of = np.zeros(width), np.zeros(width)
    for row in range(-radius, height):
        if row > radius:
            for column in range(width):
                sum_of[column] -= sums[row - radius - 1, column]
                square_of[column] -= squares[row - radius - 1, column]
        if row + radius < height:
            for column in range(width):
                sum_of[column] += sums[row + radius, column]
                square_of[column] += squares[row + radius, column]
        if row < 0:
            continue
        rows = min(row + radius + 1, height) - max(row - radius, 0)
        for column in range(width):
            columns = min(column + radius + 1, width) - max(column - radius, 0)
            weight = 1.0 / (rows * columns)
            mean = sum_of[column] * weight
            std = np.sqrt(max(square_of[column] * weight - mean * mean, 0.0))
            if std <= flat:
                view[row, column] = 0.5
            else:
                level = (view[row, column] - present - mean) / (6.0 * std) + 0.5
                view[row, column] = min(max(level, 0.0), 1.0)
