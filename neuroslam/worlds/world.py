"""Rendered worlds as sources: ``world:corridor?laps=2&people=1`` is a camera driven through one."""

import math
from typing import ClassVar, NamedTuple, Self

import cv2
import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from neuroslam.errors import SourceError
from neuroslam.geometry import TWO_PI, wrap_angles
from neuroslam.sensors.options import parse_options
from neuroslam.sensors.source import IndexedSource
from neuroslam.types import Frame, Pose, Velocity
from neuroslam.worlds.catalogue import build_world, catalogue
from neuroslam.worlds.posts import in_sight, with_markers
from neuroslam.worlds.render import Camera, measure_ranges, render
from neuroslam.worlds.rodent import ornstein_uhlenbeck
from neuroslam.worlds.scene import Billboard, World

__all__ = [
    "Camera",
    "OdometryNoise",
    "World",
    "WorldOptions",
    "WorldSource",
    "catalogue",
    "open_world",
    "render",
]

_PERSON_M = (0.8, 1.8)
_STEP_M = 0.35
_COMPASS_S = 30.0  # within which the slow half of a compass's error changes


class OdometryNoise(NamedTuple):
    r"""What wheel odometry adds to the true motion.

    :math:`\hat v = v (1 + a + b\,n)`, :math:`\hat\omega = \omega (1 + c) + d\,n' + e` with
    independent standard normal :math:`n, n'` for every frame.

    Attributes:
        speed_scale: :math:`a`, share of the speed that is always added.
        speed_noise: :math:`b`, standard deviation as a share of the speed, each frame anew.
        turn_scale: :math:`c`, share of the turn rate that is always added.
        turn_noise_rad_s: :math:`d`, standard deviation in rad/s, each frame anew.
        turn_bias_rad_s: :math:`e`, turn rate in rad/s that is always added.
    """

    speed_scale: float = 0.0
    speed_noise: float = 0.0
    turn_scale: float = 0.0
    turn_noise_rad_s: float = 0.0
    turn_bias_rad_s: float = 0.0

    @classmethod
    def of_level(cls, level: float) -> Self:
        """Return noise in usual proportions; 0.05 makes a lap miss its start by metres.

        Example:
            >>> OdometryNoise.of_level(0.1).turn_scale
            0.1
        """
        return cls(level, level, level, level, 0.1 * level)

    def apply(self, velocity: np.ndarray, seed: int) -> np.ndarray:
        """Return measured from true velocities, both ``(n, 2)``: m/s, rad/s.

        The robot stands still at the first frame, so that its row stays as it is. A row does not
        depend on how many follow it.
        """
        n = np.random.default_rng([seed, 1]).standard_normal(velocity.shape)
        v = velocity[:, 0] * (1.0 + self.speed_scale + self.speed_noise * n[:, 0])
        w = velocity[:, 1] * (1.0 + self.turn_scale)
        w += self.turn_noise_rad_s * n[:, 1] + self.turn_bias_rad_s
        measured = np.column_stack([v, w])
        measured[0] = velocity[0]
        return measured


class WorldOptions(BaseModel):
    """What may follow the ``?`` of a world's name."""

    renamed: ClassVar[dict[str, str]] = {"carried": "kidnapped"}
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    laps: float | None = Field(None, gt=0, le=10_000, description="laps; none: as the world's")
    start: float = Field(0.0, ge=0, lt=1, description="share of a lap at which the drive starts")
    route: int = Field(1, ge=1, description="which of the world's routes")
    frames_per_lap: int | None = Field(
        None, ge=8, le=1_000_000, description="frames in one lap; sets the speed"
    )
    rate: float = Field(10.0, gt=0, description="frames per second")
    width: int | None = Field(None, ge=8, le=4096, description="columns; none: 160, panoramic 256")
    height: int | None = Field(None, ge=4, le=4096, description="rows; none: 80, panoramic 64")
    fov: float = Field(90.0, ge=10, le=150, description="horizontal view in degrees")
    panoramic: bool | None = Field(None, description="see all around; none: as the world's")
    grey: bool = Field(False, description="one channel instead of RGB")
    look: int = Field(0, ge=0, description="seed of what is painted on the walls")
    seed: int = Field(0, ge=0, description="seed of odometry noise, light and passers-by")
    noise: float = Field(0.0, ge=0, le=1, description="level of odometry noise, all terms at once")
    speed_scale: float | None = Field(None, gt=-1, description="one term of it: share of speed")
    speed_noise: float | None = Field(None, ge=0, description="one term of it: share of speed")
    turn_scale: float | None = Field(None, gt=-1, description="one term of it: share of turn rate")
    turn_noise: float | None = Field(None, ge=0, description="one term of it, in rad/s")
    turn_bias: float | None = Field(None, description="one term of it, in rad/s")
    odometry: bool | None = Field(None, description="deliver odometry; none: as the world's")
    light: float = Field(0.0, ge=0, lt=1, description="share by which brightness drifts")
    gain: float = Field(1.0, gt=0, le=10, description="factor on the brightness of all frames")
    people: int = Field(0, ge=0, le=50, description="passers-by")
    ranges: int = Field(0, ge=0, le=3600, description="beams of a range scanner all around")
    range_noise_m: float = Field(0.01, ge=0, description="error of each beam")
    compass_deg: float | None = Field(
        None, ge=0, le=90, description="deliver a compass; its error, half white, half slow"
    )
    markers: int = Field(0, ge=0, le=50, description="posts with ArUco markers 4X4_50 on the way")
    landmark_reach: float = Field(
        0.0, ge=0, description="deliver the posts in sight as landmarks up to here, m; 0: not"
    )
    landmark_noise: float = Field(
        0.03, ge=0, description="their error: as a share of the distance, and in radians"
    )
    outliers: float = Field(
        0.0, ge=0, le=1, description="share of landmarks that are said to be where they are not"
    )
    labels: bool = Field(True, description="landmarks have names; else they are to be told apart")
    dark: str = Field(
        "", pattern=r"^(\d+-\d+)?$", description="the camera is covered, seconds, as 60-120"
    )
    blind: str = Field(
        "", pattern=r"^(\d+-\d+)?$", description="the scanner measures nothing, seconds, as 60-120"
    )
    kidnapped: str = Field(
        "",
        pattern=r"^(\d+:0?\.\d+)?$",
        description="the robot is kidnapped, as 60:0.5: at 60 s on by half a lap",
    )

    def odometry_noise(self) -> OdometryNoise:
        """Return the noise that ``noise`` and the single terms ask for together."""
        level = OdometryNoise.of_level(self.noise)
        terms = (
            self.speed_scale,
            self.speed_noise,
            self.turn_scale,
            self.turn_noise,
            self.turn_bias,
        )
        return OdometryNoise(
            *(old if new is None else new for old, new in zip(level, terms, strict=True))
        )


class WorldSource(IndexedSource):
    """A camera on wheels that drives a route of a rendered world.

    A lap takes a whole number of frames, so every lap visits exactly the same poses, whatever the
    start; ``n`` laps have one frame more than ``n`` times that, and the last closes the loop.

    Args:
        name: A name of the :func:`catalogue`.
        options: How to drive and see it.

    Attributes:
        world: Its geometry and looks.
        camera: The camera.
        route: The path that is driven.
        frames_per_lap: Frames in one lap.
        noise: The odometry's noise.

    Raises:
        SourceError: If there is no such world or route.

    Example:
        >>> source = WorldSource("ellipse", WorldOptions(laps=0.5))
        >>> source.n_frames, next(iter(source)).image.shape
        (201, (80, 160, 3))
    """

    def __init__(self, name: str, options: WorldOptions | None = None) -> None:
        options = options or WorldOptions()
        world = build_world(name, options.look)
        if options.route > len(world.routes):
            raise SourceError(
                f"world {name!r}: route {options.route} does not exist; "
                f"expected 1 to {len(world.routes)}"
            )
        self.name, self.world, self.options = f"world:{name}", world, options
        self.route = world.routes[options.route - 1]
        step = world.routes[0].length_m / world.sense.frames_per_lap
        self.frames_per_lap = options.frames_per_lap or round(self.route.length_m / step)
        self.frame_rate_hz = options.rate
        laps = options.laps or world.sense.laps
        self.n_frames = round(laps * self.frames_per_lap) + 1
        wide = world.sense.panoramic if options.panoramic is None else options.panoramic
        self.camera = Camera(
            width=options.width or (256 if wide else 160),
            height=options.height or (64 if wide else 80),
            fov_deg=options.fov,
            panoramic=wide,
            camera_height_m=world.sense.camera_height_m,
            horizon=world.sense.horizon,
        )
        self.noise = options.odometry_noise()
        self._has_odometry = world.sense.odometry if options.odometry is None else options.odometry

        first = round(options.start * self.frames_per_lap)
        lap = self.route.poses(self.frames_per_lap)
        along = first + np.arange(self.n_frames)
        self._truths = lap[along % self.frames_per_lap]
        moved = np.diff(self._truths, axis=0, prepend=self._truths[:1])
        if options.kidnapped:
            at_s, share = options.kidnapped.split(":")
            at = max(1, round(float(at_s) * options.rate))
            along[at:] += round(float(share) * self.frames_per_lap)
            self._truths = lap[along % self.frames_per_lap]
            drive = np.diff(self._truths, axis=0, prepend=self._truths[:1])
            drive[at : at + 1] = moved[at : at + 1]  # wheels do not feel a kidnapping
            moved = drive
        self.places_m = np.empty((0, 2))
        if options.markers:
            self.world, self.places_m = with_markers(
                world, options.markers, world.sense.camera_height_m
            )
        self._headings = None
        if options.compass_deg is not None:
            draw = np.random.default_rng([options.seed, 5]).standard_normal((2, self.n_frames))
            times = np.arange(self.n_frames) / options.rate
            slow = ornstein_uhlenbeck(draw[:1], times, _COMPASS_S)[0]
            error = math.radians(options.compass_deg) * math.sqrt(0.5) * (draw[1] + slow)
            self._headings = wrap_angles(self._truths[:, 2] + error)
        self._dark, self._blind = _span(options.dark), _span(options.blind)
        true = np.column_stack([np.hypot(moved[:, 0], moved[:, 1]), wrap_angles(moved[:, 2])])
        self._velocities = self.noise.apply(true * options.rate, options.seed)
        rng = np.random.default_rng([options.seed, 2])
        self._phases = rng.uniform(0.0, TWO_PI, 2)
        self._people = rng.uniform(0.0, 1.0, (options.people, 2))

    def truths(self) -> np.ndarray:
        """Return the true poses of all frames, ``(n_frames, 3)``: m, m, rad in [-pi, pi)."""
        return self._truths.copy()

    def truth(self, n: int) -> Pose:
        """Return the true pose of frame ``n``."""
        return Pose(*self._truths[n].tolist())

    def odometry(self) -> np.ndarray:
        """Return the measured motion of all frames, ``(n_frames, 2)``: m/s, rad/s."""
        return self._velocities.copy()

    def gain(self, time_s: float) -> float:
        """Return the brightness at this time: two slow waves, together within ``light``."""
        slow = math.sin(TWO_PI * time_s / 47.0 + self._phases[0])
        slower = math.sin(TWO_PI * time_s / 113.0 + self._phases[1])
        return self.options.gain * (1.0 + self.options.light * (0.4 * slow + 0.6 * slower))

    def figures(self, time_s: float) -> list[Billboard]:
        """Return the passers-by at this time; every other one comes towards the robot."""
        present = []
        for i, (place, haste) in enumerate(self._people.tolist()):
            speed = (0.6 + 0.7 * haste) * (1.0 if i % 2 else -1.0)
            along = place * self.route.length_m + speed * time_s
            x, y, theta = self.route.at(along)[0].tolist()
            lane = self.world.lanes_m[i % len(self.world.lanes_m)]
            cycle = self.world.people[i % len(self.world.people)]
            x, y = x - lane * math.sin(theta), y + lane * math.cos(theta)
            present.append(Billboard(x, y, *_PERSON_M, cycle[int(along // _STEP_M) % len(cycle)]))
        return present

    def frame(self, index: int) -> Frame:
        """Return the frame of that number; it does not depend on which were asked for before.

        Raises:
            SourceError: If there is no such frame.
        """
        if not 0 <= index < self.n_frames:
            raise SourceError(f"{self.name}: no frame {index}; expected 0 to {self.n_frames - 1}")
        time_s = index / self.frame_rate_hz
        pose = self.truth(index)
        image = render(self.world, pose, self.camera, self.figures(time_s), self.gain(time_s))
        if self.options.grey:
            image = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        if _within(time_s, self._dark):
            image = np.zeros_like(image)
        velocity = Velocity(*self._velocities[index].tolist()) if self._has_odometry else None
        ranges = self._measure(index, pose) if self.options.ranges else None
        if ranges is not None and _within(time_s, self._blind):
            ranges = None
        return Frame(
            index,
            time_s,
            image=image,
            velocity=velocity,
            ranges=ranges,
            heading_rad=None if self._headings is None else float(self._headings[index]),
            landmarks=self._landmarks(index, pose) if self.options.landmark_reach else None,
            truth=pose,
        )

    def _landmarks(self, index: int, pose: Pose) -> np.ndarray:
        """Number, distance and bearing of the posts in sight, ``(n, 3)``."""
        options, camera = self.options, self.camera
        seen = in_sight(self.world, pose, self.places_m, camera.camera_height_m)
        distance, bearing = seen.T
        wide = math.pi if camera.panoramic else math.radians(camera.fov_deg) / 2.0
        there = (distance <= options.landmark_reach) & (np.abs(bearing) < wide)
        # Drawn for all: what one landmark adds does not depend on which others are in sight.
        draw = np.random.default_rng([options.seed, 4, index])
        noise = options.landmark_noise * draw.standard_normal((2, len(seen)))
        wrong = draw.uniform(size=len(seen)) < options.outliers
        elsewhere = draw.uniform(
            [[0.3], [-wide]], [[options.landmark_reach], [wide]], (2, len(seen))
        )
        distance = np.where(wrong, elsewhere[0], distance * (1.0 + noise[0]))
        bearing = np.where(wrong, elsewhere[1], bearing + noise[1])
        number = np.arange(len(seen)) if options.labels else np.full(len(seen), -1)
        return np.column_stack([number, np.maximum(distance, 0.0), bearing])[there]

    def _measure(self, index: int, pose: Pose) -> np.ndarray:
        options = self.options
        ranges = measure_ranges(self.world, pose, options.ranges, self.camera.camera_height_m)
        noise = np.random.default_rng([options.seed, 3, index]).standard_normal(len(ranges))
        return np.maximum(ranges + options.range_noise_m * noise, 0.0)


def _span(text: str) -> tuple[float, float] | None:
    if not text:
        return None
    begin, end = map(float, text.split("-"))
    return begin, end


def _within(time_s: float, span: tuple[float, float] | None) -> bool:
    return span is not None and span[0] <= time_s < span[1]


def open_world(spec: str) -> WorldSource:
    """Open a rendered world from ``[world:]NAME[?option=value&...]``.

    The names are in :func:`catalogue`, the options in :class:`WorldOptions`.

    Raises:
        SourceError: If the name or an option is unknown, or a value cannot be used.

    Example:
        >>> open_world("world:town?route=5&laps=1&people=2").options.people
        2
    """
    name, _, query = spec.removeprefix("world:").partition("?")
    if name not in catalogue():
        build_world(name)  # says which there are
    return WorldSource(name, parse_options(f"world {name!r}", query, WorldOptions))
