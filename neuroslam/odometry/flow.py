r"""Visual odometry by sparse optical flow: turn rate and, over a flat floor, speed in metres.

Corners are followed from one image to the next (B. Lucas, T. Kanade, IJCAI 1981) and back; those
that do not come back are dropped. A wheeled robot that turns by :math:`\varphi` moves along the
bisector of its two headings, so one correspondence of level rays :math:`(x, y, z)` (right, down,
ahead) determines the turn, to the left, whatever its distance (D. Scaramuzza, IJCV 95, 2011):

.. math:: \tan \frac{\varphi}{2} = \frac{x_2 y_1 - x_1 y_2}{z_2 y_1 + z_1 y_2}

The estimate is the turn on which most corners agree (a kernel vote), refined by iteratively
reweighted least squares. The displacement is that of the floor (:mod:`neuroslam.odometry.floor`).
"""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from neuroslam.config.sections import OdometryConfig
from neuroslam.errors import BadFrame
from neuroslam.odometry.floor import floor_motion
from neuroslam.odometry.fusion import Measured, fused
from neuroslam.sensors.frames import check_image
from neuroslam.sensors.grey import to_grey
from neuroslam.state.mergeable import AboutNow
from neuroslam.state.tables import Scalars
from neuroslam.types import GreyRule, Velocity

_WIDEST_PX = 320  # wider images are reduced
_CORNERS = 120  # in the upper and in the lower half of an image
_WINDOW_PX, _LEVELS = 15, 2
_BACK_PX = 0.3  # distance from a corner to where following it back ends
_PIXEL_ERROR = 0.15  # standard deviation of a followed corner, px
_FEWEST = 8  # points that determine an estimate
_VOTE = 1.5  # width of the kernel of the vote, in standard deviations of a point
_HUBER = 1.345
_ITERATIONS = 5
_SYSTEMATIC = 0.01  # share of an estimate that is uncertain whatever the number of points
_SLOWLY = 1.0, 4.0  # standard deviations of m/s^2 and rad/s^2 between two images
_HOLD_S = 0.5  # for which the last motion is believed without an estimate
_PINHOLE_DEG = 150.0  # field of view up to which an image is a plane, not equal angles


class Flow(NamedTuple):
    """Motion between two images.

    Attributes:
        turn: Turn to the left, rad, and its standard deviation.
        forward: Displacement along the bisector of the headings, m, and its standard deviation;
            a camera of unknown height counts as 1 m high. Infinite deviation: not measured.
        points: Corners that were followed.
    """

    turn: Measured
    forward: Measured
    points: int


class Picture(NamedTuple):
    """What the measurement of the next image needs: a grey image, and the motion it ended.

    Attributes:
        height: Height of the source's image in px.
        width: Its width.
        grey: Reduced grey image, ``uint8``.
        velocity: Motion that the image showed.
        sigma: Standard deviations of it, m/s and rad/s.
        held_s: Time since a motion was measured.
    """

    height: int
    width: int
    grey: np.ndarray
    velocity: Velocity
    sigma: tuple[float, float]
    held_s: float


def follow_corners(
    before: np.ndarray,
    now: np.ndarray,
    window_px: int = _WINDOW_PX,
    expected: Callable[[np.ndarray], np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Follow corners from one grey image to the next, and back.

    Args:
        before: ``uint8``, ``(h, w)``.
        now: The same size.
        window_px: Width of what is compared; larger: corners are followed farther, and their
            positions on inclined surfaces are less accurate.
        expected: Where corners at ``(n, 2)`` are looked for first; ``None``: where they were.

    Returns:
        Positions in both, px, each ``(n, 2)``, of the corners that come back to where they began.

    Example:
        >>> image = np.random.default_rng(0).integers(0, 255, (60, 80)).astype(np.uint8)
        >>> image = cv2.GaussianBlur(image, (0, 0), 2.0)
        >>> a, b = follow_corners(image, np.roll(image, 2, axis=1))
        >>> bool(np.allclose(np.median(b - a, axis=0), [2.0, 0.0], atol=0.05))
        True
    """
    middle = before.shape[0] // 2
    distance = max(2.0, before.shape[1] / 40.0)
    found = []
    for top, part in ((0, before[:middle]), (middle, before[middle:])):
        corners = cv2.goodFeaturesToTrack(part, _CORNERS, 0.01, distance, blockSize=5)
        if corners is not None:
            found.append(corners.reshape(-1, 2) + np.array([0.0, top], np.float32))
    if not found:
        return np.empty((0, 2)), np.empty((0, 2))
    start = np.concatenate(found).astype(np.float32)[:, None]
    window = {"winSize": (window_px, window_px), "maxLevel": _LEVELS}
    guess, undo = start.copy(), np.zeros_like(start)
    if expected is not None:
        window["flags"] = cv2.OPTFLOW_USE_INITIAL_FLOW
        guess = np.array(expected(start[:, 0]), np.float32, order="C").reshape(-1, 1, 2)
        undo = guess - start
    end, there, _ = cv2.calcOpticalFlowPyrLK(before, now, start, guess, **window)
    back, again, _ = cv2.calcOpticalFlowPyrLK(now, before, end, end - undo, **window)
    kept = (there[:, 0] == 1) & (again[:, 0] == 1)
    kept &= np.hypot(*(back - start)[:, 0].T) < _BACK_PX
    kept &= ((end[:, 0] >= 0) & (end[:, 0] <= np.array(now.shape)[::-1] - 1)).all(axis=1)
    return start[kept, 0].astype(float), end[kept, 0].astype(float)


def level_rays(
    points_px: np.ndarray, size: tuple[int, int], fov_deg: float, tilt_deg: float
) -> np.ndarray:
    """Return the rays of pixels in level axes: right, down, ahead, ``(n, 3)``.

    Args:
        points_px: Column and row, ``(n, 2)``; the middle of the first pixel is at 0.
        size: Height and width of the image in px.
        fov_deg: Horizontal field of view; above 150 degrees the columns are equal angles, up to it
            the image is a plane. Pixels are square.
        tilt_deg: Tilt of the camera downwards.

    Example:
        >>> level_rays(np.array([[79.5, 59.5]]), (120, 160), 90.0, 45.0).round(3).tolist()
        [[0.0, 0.707, 0.707]]
    """
    height, width = size
    right = points_px[:, 0] + 0.5 - 0.5 * width
    down = points_px[:, 1] + 0.5 - 0.5 * height
    field = math.radians(fov_deg)
    if fov_deg > _PINHOLE_DEG:
        angle, focal = right * field / width, width / field
        x, z = np.sin(angle), np.cos(angle)
    else:
        focal = 0.5 * width / math.tan(0.5 * field)
        x, z = right / focal, np.ones(len(points_px))
    y, tilt = down / focal, math.radians(tilt_deg)
    return np.column_stack(
        [x, y * math.cos(tilt) + z * math.sin(tilt), z * math.cos(tilt) - y * math.sin(tilt)]
    )


def agreed(values: np.ndarray, sigma: np.ndarray) -> Measured | None:
    r"""Return the value on which most measurements agree, and its standard deviation.

    The start is the measurement with the largest sum :math:`\sum_j e^{-(v_i - v_j)^2 / 2 b_j^2}
    / \sigma_j`, with :math:`b` of 1.5 standard deviations; then Huber's weights, with the scale by
    the median absolute residual of the measurements within 4 standard deviations.

    Args:
        values: ``(n,)``.
        sigma: Standard deviations, above 0.

    Returns:
        ``None`` if fewer than 8 measurements agree.

    Example:
        >>> values = np.r_[np.linspace(0.99, 1.01, 20), 3.0, 4.0, 5.0]
        >>> found = agreed(values, np.full(23, 0.01))
        >>> round(found.value, 3), found.sigma < 0.005
        (1.0, True)
    """
    if len(values) < _FEWEST:
        return None
    width = _VOTE * sigma
    apart = (values[:, None] - values[None, :]) / width[None, :]
    votes = (np.exp(-0.5 * apart * apart) / sigma[None, :]).sum(axis=1)
    found, scale = float(values[votes.argmax()]), 1.0
    inside = np.zeros(len(values), dtype=bool)
    for _ in range(_ITERATIONS):
        residual = np.abs(values - found) / sigma
        inside = residual < 4.0 * max(scale, 1.0)
        if inside.sum() < _FEWEST:
            return None
        scale = max(1.4826 * float(np.median(residual[inside])), 1e-3)
        huber = np.minimum(1.0, _HUBER * scale / np.maximum(residual, 1e-12))
        weight = np.where(inside, huber / sigma**2, 0.0)
        found = float((weight * values).sum() / weight.sum())
    return Measured(found, max(scale, 0.3) / math.sqrt(float(weight.sum())))


def turn_of_rays(before: np.ndarray, now: np.ndarray, pixel_rad: float) -> Measured | None:
    """Return the turn of the camera by the rays of points in two images.

    Args:
        before: Level rays, ``(n, 3)``: right, down, ahead.
        now: The same points in the next image.
        pixel_rad: Standard deviation of a ray.

    Returns:
        Turn to the left in rad; ``None`` where too few points agree.

    Example:
        >>> points = np.array([[x, 1.0, z] for x in (-1.0, 0.5, 1.0) for z in (2.0, 3.0, 4.0)])
        >>> abs(turn_of_rays(points, points - [0.0, 0.0, 0.1], 0.001).value) < 1e-9
        True
    """
    (x1, y1, z1), (x2, y2, z2) = before.T, now.T
    across, along = x2 * y1 - x1 * y2, z2 * y1 + z1 * y2
    turns = 2.0 * np.arctan2(across * np.sign(along), np.abs(along))
    reach = np.hypot(x1, y1) * math.sqrt(2.0)
    sigma = 2.0 * pixel_rad * reach / np.maximum(np.abs(along), 1e-9)
    near = np.abs(along) > 20.0 * pixel_rad * reach
    return agreed(turns[near], np.maximum(sigma[near], 1e-6))


class Reckoned(NamedTuple):
    """Motion at an instant without an image, by wheels and gyroscope.

    Attributes:
        velocity: Speed and turn rate.
        dt_s: Time since the instant before.
    """

    velocity: Velocity
    dt_s: float


class _Before(Scalars):
    """Size of the images in px, zero before the first; the last motion and the time since.

    ``reckoned_s``, ``reckoned_m`` and ``reckoned_rad`` add up the instants since the last image.
    """

    height: int
    width: int
    v_m_s: float
    w_rad_s: float
    v_sigma: float
    w_sigma: float
    held_s: float
    reckoned_s: float
    reckoned_m: float
    reckoned_rad: float


class FlowOdometry(AboutNow):
    """Measures self-motion by following corners from image to image.

    The last image, reduced to at most 320 columns, is a buffer, so ``state_dict`` is complete.

    Args:
        config: Field of view, height and tilt of the camera, bounds of the speed, and the errors
            of given odometry where it is fused.
        grey: How colour becomes grey; in a brain, ``view.grey``.

    Example:
        >>> from neuroslam.sensors import open_source
        >>> odometry = FlowOdometry(OdometryConfig(method="flow", camera_height_m=1.1))
        >>> frames = open_source("world:corridor").frames(stop=3)
        >>> speeds = [odometry(frame.image, 0.1).v_m_s for frame in frames]  # it drives 1 m/s
        >>> bool(np.allclose(speeds, [0.0, 1.0, 1.0], atol=0.2))
        True
    """

    image: Tensor

    def __init__(self, config: OdometryConfig, grey: GreyRule = "luma") -> None:
        super().__init__()
        self.config = config
        self.grey: GreyRule = grey
        self.before = _Before(
            height=0, width=0, v_m_s=0.0, w_rad_s=0.0, v_sigma=0.0, w_sigma=0.0, held_s=0.0,
            reckoned_s=0.0, reckoned_m=0.0, reckoned_rad=0.0,
        )  # fmt: skip
        self.register_buffer("image", torch.zeros((0, 0), dtype=torch.uint8))
        self.register_load_state_dict_pre_hook(_resize_to_saved)

    if TYPE_CHECKING:

        def __call__(
            self,
            image: np.ndarray,
            dt_s: float,
            given: Velocity | None = None,
            turn_rate_rad_s: float | None = None,
        ) -> Velocity:
            """Call :meth:`forward`."""
            ...

    def forward(
        self,
        image: np.ndarray,
        dt_s: float,
        given: Velocity | None = None,
        turn_rate_rad_s: float | None = None,
    ) -> Velocity:
        """Measure the motion since the image before this one, and remember this one.

        Args:
            image: ``uint8``, ``(h, w)`` grey or ``(h, w, 3)`` RGB.
            dt_s: Time since the previous image in seconds.
            given: Wheel odometry, fused with what the images show.
            turn_rate_rad_s: Turn rate of a gyroscope, fused as well.

        Raises:
            BadFrame: If the image has another type or size than those before it, or ``dt_s`` is
                not positive.
        """
        velocity, picture = self.measure(image, dt_s, given, turn_rate_rad_s)
        self.remember(picture)
        return velocity

    def measure(
        self,
        image: np.ndarray,
        dt_s: float,
        given: Velocity | None = None,
        turn_rate_rad_s: float | None = None,
    ) -> tuple[Velocity, Picture]:
        """Measure the motion as :meth:`forward` does, without changing the state.

        ``dt_s`` is the time since the last image or :meth:`reckon`. What was reckoned since that
        image is corrected too: the motion that is returned is that which leads to where the images
        say that the robot is.
        """
        if not dt_s > 0.0:
            raise BadFrame(f"FlowOdometry: {dt_s} s since the last image; expected more than 0")
        check_image(image, "FlowOdometry")
        height, width = image.shape[:2]
        before = self.before
        if before.height and (height, width) != (before.height, before.width):
            raise BadFrame(
                f"FlowOdometry: image is {width} x {height} px; expected "
                f"{before.width} x {before.height} px as in the frames before it"
            )
        grey, flow = self._reduced(image), None
        since_s = before.reckoned_s + dt_s
        if before.height:
            flow = self.flow(grey, since_s)
        wheels = self._wheels(given, turn_rate_rad_s)
        if before.reckoned_s:
            moved = before.reckoned_m, before.reckoned_rad
            wheels = [
                None if one is None else Measured((done + dt_s * one.value) / since_s, one.sigma)
                for one, done in zip(wheels, moved, strict=True)
            ]
        velocity, held_s, sigma = self._velocity(flow, since_s, *wheels)
        picture = Picture(height, width, grey, velocity, sigma, held_s)
        if not before.reckoned_s:
            return velocity, picture
        v = (velocity.v_m_s * since_s - before.reckoned_m) / dt_s
        return Velocity(v, (velocity.w_rad_s * since_s - before.reckoned_rad) / dt_s), picture

    def reckon(
        self, dt_s: float, given: Velocity, turn_rate_rad_s: float | None = None
    ) -> tuple[Velocity, Reckoned]:
        """Return the motion at an instant without an image, without changing the state."""
        speed, turn = self._wheels(given, turn_rate_rad_s)
        assert speed is not None
        assert turn is not None
        velocity = Velocity(speed.value, turn.value)
        return velocity, Reckoned(velocity, dt_s)

    def flow(self, grey: np.ndarray, dt_s: float) -> Flow | None:
        """Return the motion from the last image to a reduced grey one; ``None``: not determined."""
        c = self.config
        a, b = follow_corners(self.image.numpy(force=True), grey)
        if len(a) < _FEWEST:
            return None
        before, now = (level_rays(p, grey.shape, c.fov_deg, c.camera_tilt_deg) for p in (a, b))
        pixel_rad = _PIXEL_ERROR * math.radians(c.fov_deg) / grey.shape[1]
        turn = turn_of_rays(before, now, pixel_rad)
        if turn is None:
            return None
        forward = None
        if c.fov_deg <= _PINHOLE_DEG:
            height_m = c.camera_height_m or 1.0
            focal_px = 0.5 * grey.shape[1] / math.tan(0.5 * math.radians(c.fov_deg))
            tilt, largest = math.radians(c.camera_tilt_deg), c.max_speed_m_s * dt_s / height_m
            forward = floor_motion(
                self.image.numpy(force=True), grey, turn.value, focal_px, tilt, largest
            )
            forward = None if forward is None else forward.times(height_m)
        forward = forward or Measured(0.0, math.inf)
        return Flow(turn.widened(_SYSTEMATIC), forward.widened(_SYSTEMATIC), len(a))

    def remember(self, picture: Picture | Reckoned) -> None:
        """Keep an image for the comparison with the next, or add up what was reckoned."""
        before = self.before
        if isinstance(picture, Reckoned):
            before.reckoned_s += picture.dt_s
            before.reckoned_m += picture.velocity.v_m_s * picture.dt_s
            before.reckoned_rad += picture.velocity.w_rad_s * picture.dt_s
            return
        before.reckoned_s = before.reckoned_m = before.reckoned_rad = 0.0
        before.height, before.width = picture.height, picture.width
        before.v_m_s, before.w_rad_s = picture.velocity
        before.v_sigma, before.w_sigma = picture.sigma
        before.held_s = picture.held_s
        self.image = torch.from_numpy(picture.grey).to(self.image.device)

    def _reduced(self, image: np.ndarray) -> np.ndarray:
        grey = to_grey(image, self.grey)
        factor = -(-grey.shape[1] // _WIDEST_PX)
        if factor == 1:
            return np.array(grey, order="C")
        size = (grey.shape[1] // factor, grey.shape[0] // factor)
        return cv2.resize(grey, size, interpolation=cv2.INTER_AREA)

    def _wheels(self, given: Velocity | None, gyroscope: float | None) -> list[Measured | None]:
        """Return speed and turn rate by wheels and gyroscope."""
        c, turns = self.config, []
        speed = None
        if given is not None:
            error = c.given_speed_error * abs(given.v_m_s) + 0.5 * c.min_speed_m_s + 1e-6
            speed = Measured(given.v_m_s, error)
            turns.append(Measured(given.w_rad_s, c.given_turn_error_rad_s))
        if gyroscope is not None:
            turns.append(Measured(gyroscope, c.gyroscope_error_rad_s))
        return [speed, fused(turns)]

    def _velocity(
        self, flow: Flow | None, dt_s: float, speed: Measured | None, turn: Measured | None
    ) -> tuple[Velocity, float, tuple[float, float]]:
        """Return the motion by all measurements, the time since there was one, and its errors."""
        c, before = self.config, self.before
        speeds = [] if speed is None else [speed]
        turns = [] if turn is None else [turn]
        if flow is not None:
            turns.append(flow.turn.times(1.0 / dt_s))
            if c.camera_height_m is not None or speed is None:
                speeds.append(flow.forward.times(1.0 / dt_s))
        found = [fused(speeds), fused(turns)]
        held_s = before.held_s + dt_s if None in found else 0.0
        if before.height and held_s <= _HOLD_S:  # the last motion, as it cannot change at once
            last = (before.v_m_s, before.v_sigma), (before.w_rad_s, before.w_sigma)
            kept = [
                Measured(value, math.hypot(sigma, rate * dt_s))
                for (value, sigma), rate in zip(last, _SLOWLY, strict=True)
            ]
            found = [
                fused([one, now]) if now is not None else one
                for one, now in zip(kept, found, strict=True)
            ]
        v, w = (one or Measured(0.0, 10.0) for one in found)
        limited = min(max(v.value, -c.max_speed_m_s), c.max_speed_m_s)
        velocity = Velocity(limited if abs(limited) >= c.min_speed_m_s else 0.0, w.value)
        return velocity, held_s, (v.sigma, w.sigma)


def _resize_to_saved(
    module: FlowOdometry, state: dict[str, Tensor], prefix: str, *_unused: object
) -> None:
    saved = state.get(prefix + "image")
    if saved is not None and saved.ndim == 2:  # torch rejects another shape
        module.image = module.image.new_empty(saved.shape)
