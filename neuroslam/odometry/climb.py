r"""Speed upwards from images: the pitch of a car on ramps, or the slope of a drone's path.

Corners are followed from one image to the next (:mod:`neuroslam.odometry.flow`), looked for where
the turn by odometry takes them. With that turn taken out, the level rays
:math:`r_k = (x_k, y_k, z_k)` (right, down, ahead) of a corner before and after a motion are in one
plane with the displacement, whatever the distance. For a further turn :math:`\varphi` to the left,
a pitch :math:`\psi` upwards and a path of slope :math:`\tau` against the axis of the vehicle, each
about the middle of the motion,

.. math:: x_1 y_2 - y_1 x_2 = \frac{\psi}{2} (x_1 z_2 + x_2 z_1) + \tau (z_1 x_2 - x_1 z_2)
          - \frac{\varphi}{2} (z_2 y_1 + z_1 y_2)

to first order, so corners to the left and right of the direction of travel determine pitch and
slope. The estimate begins with the value on which most corners agree, and is refined by
iteratively reweighted least squares with prior deviations. A car moves along its axis, but for the
ends of ramps and the mounting of its camera: :math:`\tau` is 0 with a deviation of 0.02. A camera
that stays level has no :math:`\psi`, and :math:`\tau = v_z / v`.

Pitch is integrated, so it drifts. Floors of buildings are level: where the pitch :math:`p` is below
:math:`p_0`, it decays and nothing is climbed,

.. math:: p \leftarrow (p + \psi)\, e^{-\Delta t / T} \text{ if } |p + \psi| < p_0, \qquad
          v_z = v \tan p \text{ if } |p| \ge p_0 \text{, else } 0

With ``method = "profiles"`` the vertical shift :math:`s` of the intensity profile of the rows
measures the speed upwards of a level camera, as NeuroSLAM's visual odometry does (Yu, Shang, Hu,
Milford et al., Biological Cybernetics 113, 2019): :math:`v_z = s D / (f \Delta t)` for a scene at
the distance :math:`D`.
"""

import math
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from neuroslam.compiled import plain_array, runs_compiled
from neuroslam.config.sections import OdometryConfig
from neuroslam.errors import BadFrame
from neuroslam.odometry.flow import agreed, follow_corners, level_rays
from neuroslam.odometry.visual import match_profiles, match_step
from neuroslam.sensors.frames import check_image
from neuroslam.sensors.grey import to_grey
from neuroslam.state.mergeable import AboutNow
from neuroslam.state.tables import Scalars
from neuroslam.types import GreyRule

_WIDEST_PX = 320
_PIXEL_ERROR = 0.15  # standard deviation of a followed corner, px
_NEAR = 20.0  # standard deviations of a ray that the denominator of an estimate exceeds
_HOLD_S = 0.5  # for which the last rate is believed without an estimate
_FEWEST, _HUBER, _ITERATIONS = 8, 1.345, 5
_QUARTER = 0.3186  # of normal errors, in standard deviations, a quarter is below it
_PRIOR = {  # inverse variances of pitch, slope and turn, of a car and of a level camera
    True: (1e-6, 0.02**-2, 0.03**-2),
    False: (1e10, 1e-6, 0.03**-2),
}
_WINDOW_PX = 9  # compared around a corner; of a large one the lower half moves faster over a floor


class Seen(NamedTuple):
    """What two images show of the vertical motion.

    Attributes:
        pitch_rad: Change of pitch upwards; 0 for a level camera.
        slope: Vertical over horizontal displacement; 0 for a car.
        rise_m: Displacement upwards, where the images measure it without a speed; else 0.
    """

    pitch_rad: float = 0.0
    slope: float = 0.0
    rise_m: float = 0.0


class Outlook(NamedTuple):
    """What the measurement of the next image needs.

    Attributes:
        height: Height of the source's image in px.
        width: Its width.
        grey: Reduced grey image, ``uint8``.
        pitch_rad: Pitch of the vehicle.
        rate: Its last measured change, rad/s; of a level camera the slope of its path, or by
            profiles its speed upwards.
        held_s: Time since it was measured.
    """

    height: int
    width: int
    grey: np.ndarray
    pitch_rad: float
    rate: float
    held_s: float


def vertical_of_rays(
    before: np.ndarray, now: np.ndarray, pixel_rad: float, pitches: bool
) -> tuple[float, float] | None:
    """Return the change of pitch, and the slope of the path against the axis of the camera.

    Args:
        before: Level rays in which the turn by odometry was taken out, ``(n, 3)``.
        now: The same points in the next image.
        pixel_rad: Standard deviation of a ray.
        pitches: Whether the camera pitches with its vehicle; else it stays level.

    Returns:
        Upwards, rad, and vertical over horizontal displacement; ``None`` where too few points
        agree.

    Example:
        >>> points = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 0.3) for z in (2, 4)])
        >>> inclined = (points - [0.0, 0.0, 0.5]) @ pitched(0.02).T
        >>> round(vertical_of_rays(points, inclined, 1e-3, pitches=True)[0], 2)
        0.02
        >>> raised = points - [0.0, 0.1, 0.5]
        >>> round(vertical_of_rays(points, raised, 1e-4, pitches=False)[1], 2)
        -0.2
    """
    (x1, y1, z1), (x2, y2, z2) = before.T, now.T
    noise = np.maximum(pixel_rad * np.sqrt(x1**2 + y1**2 + x2**2 + y2**2), 1e-9)
    factors = np.column_stack(
        [0.5 * (x1 * z2 + x2 * z1), z1 * x2 - x1 * z2, -0.5 * (z2 * y1 + z1 * y2)]
    )
    measured, of = (x1 * y2 - y1 * x2) / noise, 0 if pitches else 1
    factors /= noise[:, None]
    near = np.abs(factors[:, of]) > (_NEAR if pitches else 3.0)
    others = factors * (np.arange(3) != of) / np.sqrt(_PRIOR[pitches])  # by what is not known yet
    slack = np.sqrt(1.0 + (others**2).sum(axis=1))
    if near.sum() < _FEWEST:
        return None
    sigma = slack[near] / np.abs(factors[near, of])
    # A false match of a large displacement must not outvote all others.
    sigma = np.maximum(sigma, 0.5 * np.median(sigma))
    first = agreed(measured[near] / factors[near, of], sigma)
    if first is None:
        return None
    found = np.zeros(3)
    found[of] = first.value
    prior = np.diag(_PRIOR[pitches])
    # The first residuals are large by the turn; false matches are most of the other three quarters.
    lowest = float(np.quantile(np.abs(measured - factors @ found) / slack, 0.25))
    scale = max(1.0, lowest / _QUARTER)
    for _ in range(_ITERATIONS):
        residual = np.abs(measured - factors @ found)
        inside = residual < 4.0 * scale * slack
        if inside.sum() < _FEWEST:
            return None
        spread = max(1.4826 * float(np.median(residual[inside])), 1e-3)
        huber = np.minimum(1.0, _HUBER * spread / np.maximum(residual, 1e-12))
        scale, slack = max(spread, 1.0), np.ones_like(slack)
        weighted = factors * np.where(inside, huber / scale**2, 0.0)[:, None]
        found = np.linalg.solve(weighted.T @ factors + prior, weighted.T @ measured)
    return float(found[0]), float(found[1])


def pitched(angle_rad: float) -> np.ndarray:
    """Return the matrix that rays turn by when the camera pitches upwards by an angle."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, s], [0.0, -s, c]])


def turned(angle_rad: float) -> np.ndarray:
    """Return the matrix that rays turn by when the camera turns to the left by an angle."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def turned_pixels(
    points_px: np.ndarray, size: tuple[int, ...], focal_px: float, turn_rad: float
) -> np.ndarray:
    """Return where pixels are after a turn of a level camera to the left, ``(n, 2)``.

    Example:
        >>> seen = np.array([[79.5, 9.5]])
        >>> turned_pixels(seen, (60, 160), 80.0, math.atan(0.5)).round(1).tolist()
        [[119.5, 7.1]]
    """
    middle = np.array([0.5 * size[1] - 0.5, 0.5 * size[0] - 0.5])
    rays = np.column_stack([(points_px - middle) / focal_px, np.ones(len(points_px))])
    x, y, z = (rays @ turned(turn_rad).T).T
    z = np.maximum(z, 0.1)
    return np.column_stack([x / z, y / z]) * focal_px + middle


def next_pitch(
    pitch_rad: float, change_rad: float, dt_s: float, level_rad: float, level_s: float
) -> tuple[float, float]:
    """Return the pitch after a frame, and the tangent that climbs; the equation is at the top.

    Example:
        >>> [round(a, 4) for a in next_pitch(0.19, 0.01, 0.1, 0.05, 2.0)]
        [0.2, 0.2027]
        >>> [round(a, 4) for a in next_pitch(0.0, 0.01, 0.1, 0.05, 2.0)]
        [0.0095, 0.0]
    """
    pitch = pitch_rad + change_rad
    if abs(pitch) < level_rad:
        return pitch * math.exp(-dt_s / level_s), 0.0
    return pitch, math.tan(pitch)


def shift_of_rows(now: np.ndarray, before: np.ndarray, max_shift: int) -> float:
    """Return by how many rows the picture moved downwards, between rows by the lines of the errors.

    Args:
        now: Grey image, ``uint8 (h, w)``; the middle half of its columns counts.
        before: The image before.
        max_shift: Shifts are below it.

    Example:
        >>> image = np.random.default_rng(0).integers(0, 255, (60, 80)).astype(np.uint8)
        >>> image = cv2.GaussianBlur(image, (0, 0), 3.0)
        >>> abs(shift_of_rows(np.roll(image, 2, axis=0), image, 10) - 2.0) < 0.2
        True
    """
    width = now.shape[1]
    sums = [
        image[:, width // 4 : width - width // 4].sum(axis=1, dtype=np.int32)
        for image in (now, before)
    ]
    match = match_step if runs_compiled() else match_profiles
    present, past = (plain_array(s) for s in sums)
    best, least = match(present, past, max_shift)
    if abs(best) >= max_shift - 1:
        return float(best)
    below, above = (_difference(present, past, best + by) for by in (-1, 1))
    steeper = max(below, above) - least
    return float(best) + (0.5 * (below - above) / steeper if steeper > 0.0 else 0.0)


def _difference(now: np.ndarray, before: np.ndarray, shift: int) -> float:
    n = len(now)
    a, b = now[max(0, shift) : n + min(0, shift)], before[max(0, -shift) : n - max(0, shift)]
    return float(np.abs(a.astype(np.int64) - b).mean())


class _Before(Scalars):
    """Size of the images in px, zero before the first; since_s: time without an image.

    The others are those of :class:`Outlook`.
    """

    height: int
    width: int
    pitch_rad: float
    rate: float
    held_s: float
    since_s: float


class VisualClimb(AboutNow):
    """Measures the speed upwards from images and a horizontal speed.

    The last image, reduced to at most 320 columns, is a buffer, so ``state_dict`` is complete.

    Args:
        config: ``climb`` says what moves with the ground, ``method`` how images are compared.
        grey: How colour becomes grey; in a brain, ``view.grey``.

    Example:
        >>> from neuroslam.sensors import open_source
        >>> climb = VisualClimb(OdometryConfig(method="flow", climb="slope"))
        >>> drone = open_source("world:atrium?rate=5&frames_per_lap=900")
        >>> frames = list(drone.frames(start=100, stop=130))
        >>> seen = [climb(frame.image, 0.2, frame.velocity.v_m_s) for frame in frames]
        >>> bool(abs(np.mean(seen[1:]) - np.mean(drone.climbs()[101:130])) < 0.06)
        True
    """

    image: Tensor

    def __init__(self, config: OdometryConfig, grey: GreyRule = "luma") -> None:
        super().__init__()
        self.config = config
        self.grey: GreyRule = grey
        self.before = _Before(height=0, width=0, pitch_rad=0.0, rate=0.0, held_s=0.0, since_s=0.0)
        self.register_buffer("image", torch.zeros((0, 0), dtype=torch.uint8))
        self.register_load_state_dict_pre_hook(_resize_to_saved)

    if TYPE_CHECKING:

        def __call__(
            self, image: np.ndarray, dt_s: float, v_m_s: float, w_rad_s: float = 0.0
        ) -> float:
            """Call :meth:`forward`."""
            ...

    def forward(self, image: np.ndarray, dt_s: float, v_m_s: float, w_rad_s: float = 0.0) -> float:
        """Measure the speed upwards since the image before this one, and remember this one.

        Args:
            image: ``uint8``, ``(h, w)`` grey or ``(h, w, 3)`` RGB.
            dt_s: Time since the previous image in seconds.
            v_m_s: Horizontal speed.
            w_rad_s: Turn rate, by which corners are looked for; the images measure the turn.

        Returns:
            m/s.

        Raises:
            BadFrame: If the image has another type or size than those before it, or ``dt_s`` is
                not positive.
        """
        climb, outlook = self.measure(image, dt_s, v_m_s, w_rad_s)
        self.remember(outlook)
        return climb

    def measure(
        self, image: np.ndarray, dt_s: float, v_m_s: float, w_rad_s: float = 0.0
    ) -> tuple[float, Outlook]:
        """Measure the speed as :meth:`forward` does, without changing the state."""
        if not dt_s > 0.0:
            raise BadFrame(f"VisualClimb: {dt_s} s since the last image; expected more than 0")
        check_image(image, "VisualClimb")
        height, width = image.shape[:2]
        before, c = self.before, self.config
        if before.height and (height, width) != (before.height, before.width):
            raise BadFrame(
                f"VisualClimb: image is {width} x {height} px; expected "
                f"{before.width} x {before.height} px as in the frames before it"
            )
        grey, dt_s = _reduced(to_grey(image, self.grey)), dt_s + before.since_s
        seen: Seen | None = Seen()
        if before.height:
            seen = self.compare(self.image.numpy(force=True), grey, w_rad_s * dt_s)
        held_s = before.held_s + dt_s if seen is None else 0.0
        rate = before.rate if held_s <= _HOLD_S else 0.0
        if c.climb == "pitch":
            rate = rate if seen is None else seen.pitch_rad / dt_s
            pitch, tangent = next_pitch(
                before.pitch_rad, rate * dt_s, dt_s, self._level_rad, c.level_s
            )
            return v_m_s * tangent, Outlook(height, width, grey, pitch, rate, held_s)
        if c.method == "profiles":
            climb = 0.0 if seen is None else seen.rise_m / dt_s
            return climb, Outlook(height, width, grey, 0.0, climb, 0.0)
        slope = rate if seen is None else seen.slope
        return v_m_s * slope, Outlook(height, width, grey, 0.0, slope, held_s)

    def compare(self, before: np.ndarray, now: np.ndarray, turn_rad: float = 0.0) -> Seen | None:
        """Return what two reduced grey images show; ``None``: not determined."""
        c, (rows, columns) = self.config, now.shape
        focal_px = 0.5 * columns / math.tan(0.5 * math.radians(min(c.fov_deg, 150.0)))
        if c.method == "profiles":
            most = max(2, min(c.max_shift_px, rows // 4))
            return Seen(rise_m=shift_of_rows(now, before, most) / focal_px * c.view_distance_m)
        size, focal = now.shape, focal_px
        a, b = follow_corners(
            before, now, _WINDOW_PX, lambda px: turned_pixels(px, size, focal, turn_rad)
        )
        if len(a) < _FEWEST:
            return None
        half = turned(0.5 * turn_rad)
        rays = [level_rays(p, now.shape, c.fov_deg, c.camera_tilt_deg) for p in (a, b)]
        pixel_rad = _PIXEL_ERROR * math.radians(c.fov_deg) / columns
        found = vertical_of_rays(rays[0] @ half.T, rays[1] @ half, pixel_rad, c.climb == "pitch")
        if found is None:
            return None
        return Seen(pitch_rad=found[0]) if c.climb == "pitch" else Seen(slope=found[1])

    def reckon(self, v_m_s: float) -> float:
        """Return the speed upwards at an instant without an image: as at the last one."""
        before = self.before
        if self.config.climb == "slope":
            return before.rate * (1.0 if self.config.method == "profiles" else v_m_s)
        return v_m_s * next_pitch(before.pitch_rad, 0.0, 1.0, self._level_rad, 1.0)[1]

    def remember(self, outlook: Outlook | None, dt_s: float = 0.0, broken: bool = False) -> None:
        """Keep an image for the comparison with the next.

        Args:
            outlook: Of the image; ``None``: there was none.
            dt_s: Time that passed without one.
            broken: The camera did not move from the last image to this one: the pitch is that of
                before, and no rate is known.
        """
        before = self.before
        if outlook is None:
            before.since_s += dt_s
            return
        before.height, before.width, before.since_s = outlook.height, outlook.width, 0.0
        if broken:
            before.rate = before.held_s = 0.0
        else:
            before.pitch_rad, before.rate = outlook.pitch_rad, outlook.rate
            before.held_s = outlook.held_s
        self.image = torch.from_numpy(outlook.grey).to(self.image.device)

    @property
    def _level_rad(self) -> float:
        return math.radians(self.config.level_deg)


def _reduced(grey: np.ndarray) -> np.ndarray:
    factor = -(-grey.shape[1] // _WIDEST_PX)
    if factor == 1:
        return np.array(grey, order="C")
    size = (grey.shape[1] // factor, grey.shape[0] // factor)
    return cv2.resize(grey, size, interpolation=cv2.INTER_AREA)


def _resize_to_saved(
    module: VisualClimb, state: dict[str, Tensor], prefix: str, *_unused: object
) -> None:
    saved = state.get(prefix + "image")
    if saved is not None and saved.ndim == 2:  # torch rejects another shape
        module.image = module.image.new_empty(saved.shape)
