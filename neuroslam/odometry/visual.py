"""Visual odometry: speed and turn rate of the robot from two consecutive images.

A turn to the left shifts the image to the right: see ``docs/sign_conventions.md``.
"""

import math
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple, cast

import cv2
import numpy as np
import torch
from torch import Tensor

from neuroslam.compiled import compiled, plain_array, runs_compiled
from neuroslam.config.sections import OdometryConfig, Region, region_in
from neuroslam.errors import BadFrame, ConfigError
from neuroslam.sensors.frames import check_image
from neuroslam.sensors.grey import to_grey
from neuroslam.state.mergeable import AboutNow
from neuroslam.state.tables import Scalars
from neuroslam.types import GreyRule, Velocity


def profile(image: np.ndarray, region: Region) -> np.ndarray:
    """Return the mean of each column of an image region, grey in [0, 1].

    Args:
        image: ``uint8``, ``(h, w)``.
        region: ``x_min, x_max, y_min, y_max`` in px; the maxima are excluded.

    Returns:
        ``float64``, ``(x_max - x_min,)``.

    Example:
        >>> profile(np.array([[0, 255, 0], [0, 0, 0]], np.uint8), (0, 2, 0, 2)).tolist()
        [0.0, 0.5]
    """
    return column_sums(image, region) / (255.0 * (region[3] - region[2]))


def column_sums(image: np.ndarray, region: Region) -> np.ndarray:
    """Return the sum of each column of an image region: :func:`profile` before the division.

    Returns:
        ``int32``, ``(x_max - x_min,)``.
    """
    x_min, x_max, y_min, y_max = region
    part = image[y_min:y_max, x_min:x_max]
    return cv2.reduce(part, 0, cv2.REDUCE_SUM, dtype=cv2.CV_32S)[0]


def match_profiles(now: np.ndarray, previous: np.ndarray, max_shift: int) -> tuple[int, float]:
    r"""Find the shift that best aligns the previous profile with the present one.

    .. math:: d(s) = \frac{1}{n - |s|} \sum_i |p_t(i) - p_{t-1}(i - s)|, \quad |s| < S

    Args:
        now: :math:`p_t`, ``(n,)``.
        previous: :math:`p_{t-1}`, ``(n,)``.
        max_shift: :math:`S`, at most ``n``.

    Returns:
        The shift :math:`s` of the smallest :math:`d`, positive if the image moved to the right, and
        that :math:`d`. Ties are resolved in the order 0, -1, ..., -(S-1), 1, ..., S-1; the sums are
        of integers, so ties are exact.

    Example:
        >>> match_profiles(np.array([9.0, 1, 2, 7, 3]), np.array([1.0, 2, 7, 3, 5]), 3)
        (1, 0.0)
    """
    if runs_compiled() and now.dtype == previous.dtype == np.int32:
        return match_step(plain_array(now), plain_array(previous), max_shift)
    n = len(now)
    overlap, counts, shifts, order = _offsets(n, max_shift)
    padded = np.zeros(n + 2 * (max_shift - 1))
    padded[max_shift - 1 : max_shift - 1 + n] = previous
    step = padded.strides[0]
    shifted = np.ndarray(overlap.shape, padded.dtype, padded, strides=(step, step))
    differences = np.subtract(shifted, np.asarray(now, np.float64))
    np.abs(differences, out=differences)
    totals = np.einsum("ij,ij->i", differences, overlap)
    means = (totals / counts)[order]
    best = int(means.argmin())
    return int(shifts[order[best]]), float(means[best])


@lru_cache(maxsize=16)
def _offsets(n: int, max_shift: int) -> tuple[np.ndarray, ...]:
    """Return overlapping columns, their number and the shift, row by row; and the order of ties."""
    shifts = np.arange(max_shift - 1, -max_shift, -1)
    source = np.arange(n)[None, :] - shifts[:, None]
    overlap = ((source >= 0) & (source < n)).astype(np.float64)
    zero = max_shift - 1
    order = np.concatenate([np.arange(zero, 2 * max_shift - 1), np.arange(zero - 1, -1, -1)])
    return overlap, overlap.sum(axis=1), shifts, order


@compiled
def match_step(now: np.ndarray, previous: np.ndarray, max_shift: int) -> tuple[int, float]:
    """Match column sums, ``int32``, as :func:`match_profiles` does."""
    n = now.shape[0]
    best, smallest = 0, math.inf
    for trial in range(2 * max_shift - 1):  # 0, -1, ..., and then 1, 2, ...
        shift = -trial if trial < max_shift else trial - max_shift + 1
        count = n - abs(shift)
        first, second = now[max(0, shift) :], previous[max(0, -shift) :]
        total = np.int64(0)
        for i in range(count):
            total += abs(np.int64(first[i]) - np.int64(second[i]))
        mean = total / count
        if mean < smallest:
            best, smallest = shift, mean
    return best, smallest


@compiled
def measure_step(
    image: np.ndarray,
    speed_region: Region,
    turn_region: Region,
    speed_before: np.ndarray,
    turn_before: np.ndarray,
    max_shift: int,
) -> tuple[np.ndarray, np.ndarray, int, float]:
    """Sum the columns of both regions of an image, and match them with those before.

    Args:
        image: ``uint8``, ``(h, w)``.
        speed_region: As for :func:`profile`.
        turn_region: The same.
        speed_before: Column sums of the image before, ``int32``; empty: there is none.
        turn_before: The same of the other region.
        max_shift: As for :func:`match_profiles`.

    Returns:
        Column sums of both regions; shift of the turn region; difference of the speed region.
    """
    speed, turn = _column_sums(image, speed_region), _column_sums(image, turn_region)
    if speed_before.shape[0] == 0:
        speed_before, turn_before = np.zeros_like(speed), np.zeros_like(turn)
    shift, _ = match_step(turn, turn_before, max_shift)
    _, difference = match_step(speed, speed_before, max_shift)
    return speed, turn, shift, difference


@compiled
def _column_sums(image: np.ndarray, region: Region) -> np.ndarray:
    x_min, x_max, y_min, y_max = region
    sums = np.zeros(x_max - x_min, np.int32)
    for y in range(y_min, y_max):
        row = image[y, x_min:x_max]
        for x in range(sums.shape[0]):
            sums[x] += row[x]
    return sums


def motion_from_match(
    shift_px: int, difference: float, image_width: int, dt_s: float, config: OdometryConfig
) -> Velocity:
    r"""Convert a shift and a difference of profiles to motion.

    .. math:: \omega = s \cdot \mathrm{fov} / (\mathrm{width} \cdot \Delta t), \quad
              v = \min(c \cdot d, v_{\max}), \text{ 0 below } v_{\min}

    Args:
        shift_px: Shift :math:`s` of the turn region, positive to the right.
        difference: Smallest difference :math:`d` of the speed region, grey in [0, 1].
        image_width: Width of the whole image in px.
        dt_s: Time between the images in seconds.
        config: Field of view, scale :math:`c` and bounds of the speed.

    Example:
        >>> motion_from_match(8, 0.01, 160, 0.05, OdometryConfig(fov_deg=90))
        Velocity(v_m_s=1.0, w_rad_s=1.5707963267948966)
    """
    w_deg_s = shift_px * config.fov_deg / image_width * (1.0 / dt_s)
    v = min(difference * config.speed_scaling_m_s, config.max_speed_m_s)
    # Degrees first, which rounds as the reference implementation does, to the last bit.
    return Velocity(v if v >= config.min_speed_m_s else 0.0, w_deg_s * math.pi / 180.0)


class _Size(Scalars):
    """Size of the images in px; zero before the first image."""

    height: int
    width: int


class Profiles(NamedTuple):
    """Size of an image in px, and the column sums of its speed and turn regions."""

    height: int
    width: int
    speed: np.ndarray
    turn: np.ndarray


class VisualOdometry(AboutNow):
    """Measures self-motion by matching the profiles of consecutive images.

    The column sums of the last image's two regions are buffers, so ``state_dict`` is complete.

    Args:
        config: Regions, field of view and scale.
        grey: How colour becomes grey; in a brain, ``view.grey``.

    Example:
        >>> odometry = VisualOdometry(OdometryConfig(max_shift_px=4))
        >>> image = np.tile(np.array([0, 9, 50, 200, 90, 0, 30, 7], np.uint8), (6, 1))
        >>> odometry(image, dt_s=0.1)  # the first image
        Velocity(v_m_s=0.0, w_rad_s=0.0)
        >>> odometry(np.roll(image, 2, axis=1), dt_s=0.1).w_rad_s > 0  # a left turn
        True
    """

    speed_sums: Tensor
    turn_sums: Tensor

    def __init__(self, config: OdometryConfig, grey: GreyRule = "luma") -> None:
        super().__init__()
        self.config = config
        self.grey: GreyRule = grey
        self.size = _Size(height=0, width=0)
        # Regions are derived from the config and the size of an image.
        self._regions: tuple[tuple[int, int], tuple[Region, Region]] | None = None
        self.register_buffer("speed_sums", torch.zeros(0, dtype=torch.int32))
        self.register_buffer("turn_sums", torch.zeros(0, dtype=torch.int32))
        self.register_load_state_dict_pre_hook(_resize_to_saved)

    if TYPE_CHECKING:

        def __call__(self, image: np.ndarray, dt_s: float) -> Velocity:
            """Call :meth:`forward`."""
            ...

    def forward(self, image: np.ndarray, dt_s: float) -> Velocity:
        """Measure the motion since the image before this one, and remember this one.

        Args:
            image: ``uint8``, ``(h, w)`` grey or ``(h, w, 3)`` RGB.
            dt_s: Time since the previous image in seconds.

        Raises:
            ConfigError: If a region does not lie in the image, or is too narrow for the shifts.
            BadFrame: If the image has another type or size than those before it, or ``dt_s`` is
                not positive.
        """
        velocity, profiles = self.measure(image, dt_s)
        self.remember(profiles)
        return velocity

    def measure(self, image: np.ndarray, dt_s: float) -> tuple[Velocity, Profiles]:
        """Measure the motion as :meth:`forward` does, without changing the state."""
        if not dt_s > 0.0:
            raise BadFrame(f"VisualOdometry: {dt_s} s since the last image; expected more than 0")
        check_image(image, "VisualOdometry")
        image = to_grey(image, self.grey)
        height, width = image.shape
        size = self.size
        first = size.height == 0
        if not first and (height, width) != (size.height, size.width):
            raise BadFrame(
                f"VisualOdometry: image is {width} x {height} px; expected "
                f"{size.width} x {size.height} px as in the frames before it"
            )
        if self._regions is None or self._regions[0] != (height, width):
            self._regions = (height, width), regions_in(height, width, self.config)
        speed_region, turn_region = self._regions[1]
        max_shift, still = self.config.max_shift_px, first and self.config.first_frame == "still"
        before = self._last
        if runs_compiled(*before):
            speed, turn, shift, difference = measure_step(
                plain_array(image),
                speed_region,
                turn_region,
                before[0].numpy(),
                before[1].numpy(),
                max_shift,
            )
            now = Profiles(height, width, speed, turn)
            if still:
                return Velocity(0.0, 0.0), now
        else:
            now = Profiles(
                height, width, column_sums(image, speed_region), column_sums(image, turn_region)
            )
            if still:
                return Velocity(0.0, 0.0), now
            speed_before = np.zeros_like(now.speed) if first else before[0].cpu().numpy()
            turn_before = np.zeros_like(now.turn) if first else before[1].cpu().numpy()
            shift, _ = match_profiles(now.turn, turn_before, max_shift)
            _, difference = match_profiles(now.speed, speed_before, max_shift)
        difference /= 255.0 * (speed_region[3] - speed_region[2])
        return motion_from_match(shift, difference, width, dt_s, self.config), now

    def remember(self, profiles: Profiles) -> None:
        """Keep the profiles of an image for the comparison with the next."""
        size = self.size
        if size.height == 0:
            size.height, size.width = profiles.height, profiles.width
        device = self._last[0].device
        for name, sums in (("speed_sums", profiles.speed), ("turn_sums", profiles.turn)):
            self._buffers[name] = torch.from_numpy(sums).to(device)

    @property
    def _last(self) -> tuple[Tensor, Tensor]:
        """Buffers, past ``nn.Module``, whose attributes take longer than matching a profile."""
        buffers = cast(dict[str, Tensor], self._buffers)
        return buffers["speed_sums"], buffers["turn_sums"]


def regions_in(height: int, width: int, config: OdometryConfig) -> tuple[Region, Region]:
    """Return the speed and turn regions of an image: the config's, or its lower and upper half.

    Raises:
        ConfigError: If a region does not lie in the image, or is narrower than ``max_shift_px``.

    Example:
        >>> regions_in(120, 160, OdometryConfig())
        ((0, 160, 60, 120), (0, 160, 0, 60))
    """
    halves = {
        "speed_region": (0, width, height // 2, height),
        "turn_region": (0, width, 0, height // 2),
    }
    for name, half in halves.items():
        region = region_in(getattr(config, name) or half, height, width)
        x_min, x_max, y_min, y_max = region
        if not (0 <= x_min < x_max <= width and 0 <= y_min < y_max <= height):
            raise ConfigError(
                f"odometry.{name} = {list(region)} does not lie in an image of {width} x {height} "
                "px; expected x_min, x_max, y_min, y_max inside it"
            )
        if x_max - x_min < config.max_shift_px:
            raise ConfigError(
                f"odometry.max_shift_px = {config.max_shift_px} is more than the {x_max - x_min} "
                f"columns of {name}; set it to half of them or fewer"
            )
        halves[name] = region
    return halves["speed_region"], halves["turn_region"]


def _resize_to_saved(
    module: VisualOdometry, state: dict[str, Tensor], prefix: str, *_unused: object
) -> None:
    for name in ("speed_sums", "turn_sums"):
        saved = state.get(prefix + name)
        if saved is not None and saved.ndim == 1:  # torch rejects another shape
            setattr(module, name, getattr(module, name).new_empty(saved.shape))
