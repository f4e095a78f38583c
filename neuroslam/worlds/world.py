"""Rendered worlds as sources: ``world:corridor?laps=2&people=1`` is a drive through a world."""

import math
from dataclasses import replace
from typing import ClassVar, NamedTuple, Self

import cv2
import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from neuroslam.config.bounds import LARGEST_SEED
from neuroslam.errors import SourceError
from neuroslam.geometry import TWO_PI, compose, wrap_angles
from neuroslam.sensors.options import parse_options
from neuroslam.sensors.source import IndexedSource
from neuroslam.types import Frame, Pose, Velocity
from neuroslam.worlds.catalogue import build_world, catalogue
from neuroslam.worlds.posts import in_sight, with_markers, words_of_posts
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
_WHEELBASE_M = 2.5
_COMPASS_S = 30.0  # time constant of the slow half of the compass error


class OdometryNoise(NamedTuple):
    r"""Noise of wheel odometry.

    :math:`\hat v = v (1 + a + b\,n)`, :math:`\hat\omega = \omega (1 + c) + d\,n' + e` with
    independent standard normal :math:`n, n'` for every frame.

    Attributes:
        speed_scale: :math:`a`, constant error as a fraction of the speed.
        speed_noise: :math:`b`, standard deviation per frame as a fraction of the speed.
        turn_scale: :math:`c`, constant error as a fraction of the turn rate.
        turn_noise_rad_s: :math:`d`, standard deviation per frame in rad/s.
        turn_bias_rad_s: :math:`e`, constant error of the turn rate in rad/s.
    """

    speed_scale: float = 0.0
    speed_noise: float = 0.0
    turn_scale: float = 0.0
    turn_noise_rad_s: float = 0.0
    turn_bias_rad_s: float = 0.0

    @classmethod
    def of_level(cls, level: float) -> Self:
        """Return noise with typical proportions; at 0.05 a lap ends metres from its start.

        Example:
            >>> OdometryNoise.of_level(0.1).turn_scale
            0.1
        """
        return cls(level, level, level, level, 0.1 * level)

    def apply(self, velocity: np.ndarray, seed: int) -> np.ndarray:
        """Add the noise to true velocities, ``(n, 2)``: m/s, rad/s.

        The first row is unchanged, as the robot stands still at the first frame. A row does not
        depend on the rows after it.
        """
        n = np.random.default_rng([seed, 1]).standard_normal(velocity.shape)
        v = velocity[:, 0] * (1.0 + self.speed_scale + self.speed_noise * n[:, 0])
        w = velocity[:, 1] * (1.0 + self.turn_scale)
        w += self.turn_noise_rad_s * n[:, 1] + self.turn_bias_rad_s
        measured = np.column_stack([v, w])
        measured[0] = velocity[0]
        return measured

    def apply_climb(self, v_z_m_s: np.ndarray, level: float, seed: int) -> np.ndarray:
        r"""Add the noise of a barometer's rate to true vertical speeds, ``(n,)``, m/s.

        .. math:: \hat v_z = v_z (1 + \ell) + \ell\, n + 0.05\, \ell

        with the level :math:`\ell` and standard normal :math:`n`; the first is unchanged.
        """
        n = np.random.default_rng([seed, 6]).standard_normal(len(v_z_m_s))
        measured = v_z_m_s * (1.0 + level) + level * n + 0.05 * level
        measured[:1] = v_z_m_s[:1]
        return np.asarray(measured)


class WorldOptions(BaseModel):
    """Options after the ``?`` of a world's name."""

    renamed: ClassVar[dict[str, str]] = {"carried": "kidnapped"}
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    laps: float | None = Field(
        default=None, gt=0, le=10_000, description="laps; none: the world's default"
    )
    start: float = Field(default=0.0, ge=0, lt=1, description="start as a fraction of a lap")
    route: int = Field(default=1, ge=1, le=100, description="number of the world's route")
    frames_per_lap: int | None = Field(
        default=None, ge=8, le=1_000_000, description="frames in one lap; sets the speed"
    )
    rate: float = Field(default=10.0, gt=0, le=10_000, description="frames per second")
    width: int | None = Field(
        default=None, ge=8, le=4096, description="columns; none: 160, panoramic 256"
    )
    height: int | None = Field(
        default=None, ge=4, le=4096, description="rows; none: 80, panoramic 64"
    )
    fov: float = Field(
        default=90.0, ge=10, le=150, description="horizontal field of view in degrees"
    )
    panoramic: bool | None = Field(
        default=None, description="panoramic camera; none: the world's default"
    )
    grey: bool = Field(default=False, description="one channel, luma, instead of RGB")
    ramps: bool = Field(
        default=True,
        description="draw ramps as ramps, on which a pinhole camera pitches as a car does; off: "
        "they are drawn level",
    )
    look: int = Field(default=0, ge=0, le=LARGEST_SEED, description="seed of the textures")
    seed: int = Field(
        default=0,
        ge=0,
        le=LARGEST_SEED,
        description="seed of odometry noise, light and pedestrians",
    )
    noise: float = Field(
        default=0.0, ge=0, le=1, description="level of odometry noise, for all terms"
    )
    speed_scale: float | None = Field(
        default=None, gt=-1, description="one term of it: fraction of the speed"
    )
    speed_noise: float | None = Field(
        default=None, ge=0, description="one term of it: fraction of the speed"
    )
    turn_scale: float | None = Field(
        default=None, gt=-1, description="one term of it: fraction of the turn rate"
    )
    turn_noise: float | None = Field(default=None, ge=0, description="one term of it, in rad/s")
    turn_bias: float | None = Field(default=None, description="one term of it, in rad/s")
    odometry: bool | None = Field(
        default=None, description="deliver odometry; none: the world's default"
    )
    light: float = Field(default=0.0, ge=0, lt=1, description="fraction by which brightness drifts")
    gain: float = Field(
        default=1.0, gt=0, le=10, description="factor on the brightness of all frames"
    )
    people: int = Field(default=0, ge=0, le=50, description="number of pedestrians")
    ranges: int = Field(
        default=0, ge=0, le=3600, description="beams of a laser scanner over the full turn"
    )
    range_noise_m: float = Field(
        default=0.01, ge=0, description="standard deviation of each beam in m"
    )
    compass_deg: float | None = Field(
        default=None,
        ge=0,
        le=90,
        description="deliver a compass; its error in degrees, half white, half slow",
    )
    markers: int = Field(
        default=0, ge=0, le=50, description="posts with ArUco markers 4X4_50 along the route"
    )
    landmark_reach: float = Field(
        default=0.0,
        ge=0,
        description="deliver visible posts up to this distance in m as landmarks; 0: none",
    )
    landmark_noise: float = Field(
        default=0.03, ge=0, description="their error: fraction of the distance, and radians"
    )
    outliers: float = Field(
        default=0.0,
        ge=0,
        le=1,
        description="fraction of landmarks at a wrong position",
    )
    labels: bool = Field(
        default=True, description="landmarks have numbers; else they are anonymous"
    )
    dark: str = Field(
        default="",
        pattern=r"^(\d+-\d+)?$",
        description="interval in s in which the camera is covered, as 60-120",
    )
    blind: str = Field(
        default="",
        pattern=r"^(\d+-\d+)?$",
        description="interval in s in which the scanner measures nothing, as 60-120",
    )
    kidnapped: str = Field(
        default="",
        pattern=r"^(\d+:0?\.\d+(,\d+:0?\.\d+)*)?$",
        description="kidnap the robot, as 60:0.5: at 60 s by half a lap; several as 60:0.5,90:0.1",
    )

    def odometry_noise(self) -> OdometryNoise:
        """Return the noise of level ``noise``, with the single terms that are set."""
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
    """Frames of a robot with a camera on a route of a rendered world.

    A lap has an integer number of frames, so every lap visits exactly the same poses, wherever it
    starts. ``n`` laps have ``n`` times as many frames and one more, which closes the loop.

    Args:
        name: A name of the :func:`catalogue`.
        options: Options of drive and sensors.
        world: A world that is not in the catalogue; then ``name`` is free.

    Attributes:
        world: Geometry and textures.
        camera: The camera.
        route: The route.
        frames_per_lap: Frames in one lap.
        noise: Noise of the odometry.
        posts_m: Positions of the posts with markers, ``(n, 2)``.
        landmark_words: Names and attributes of the posts.

    Raises:
        SourceError: If there is no such world or route.

    Example:
        >>> source = WorldSource("ellipse", WorldOptions(laps=0.5))
        >>> source.n_frames, next(iter(source)).image.shape
        (201, (80, 160, 3))
    """

    def __init__(
        self, name: str, options: WorldOptions | None = None, world: World | None = None
    ) -> None:
        options = options or WorldOptions()
        world = build_world(name, options.look) if world is None else world
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
        panoramic = world.sense.panoramic if options.panoramic is None else options.panoramic
        self.camera = Camera(
            width=options.width or (256 if panoramic else 160),
            height=options.height or (64 if panoramic else 80),
            fov_deg=options.fov,
            panoramic=panoramic,
            camera_height_m=world.sense.camera_height_m,
            horizon=world.sense.horizon,
        )
        self.noise = options.odometry_noise()
        self._has_odometry = world.sense.odometry if options.odometry is None else options.odometry

        first = round(options.start * self.frames_per_lap)
        lap = self.route.poses(self.frames_per_lap)
        lap_heights = self.route.heights(self.frames_per_lap)
        along = first + np.arange(self.n_frames)
        lap_pitches = self.route.pitches(self.frames_per_lap, _WHEELBASE_M)
        self._pitches = lap_pitches[along % self.frames_per_lap]
        self._truths = lap[along % self.frames_per_lap]
        self._heights = lap_heights[along % self.frames_per_lap]
        moved = np.diff(self._truths, axis=0, prepend=self._truths[:1])
        climbed = np.diff(self._heights, prepend=self._heights[:1])
        if options.kidnapped:
            cuts, n = [], self.frames_per_lap
            for one in options.kidnapped.split(","):
                at_s, share = one.split(":")
                cuts.append(max(1, round(float(at_s) * options.rate)))
                along[cuts[-1] :] += round(float(share) * n)
            self._truths, self._heights = lap[along % n], lap_heights[along % n]
            self._pitches = lap_pitches[along % n]
            moved = np.diff(self._truths, axis=0, prepend=self._truths[:1])
            climbed = np.diff(self._heights, prepend=self._heights[:1])
            for at in [at for at in cuts if at < self.n_frames]:  # odometry does not measure it
                before, after = along[at - 1] % n, (along[at - 1] + 1) % n
                moved[at] = lap[after] - lap[before]
                climbed[at] = lap_heights[after] - lap_heights[before]
        self.posts_m = np.empty((0, 2))
        if options.markers:
            self.world, self.posts_m = with_markers(
                world, options.markers, world.sense.camera_height_m
            )
        self.landmark_words = words_of_posts(options.markers)
        self._headings = None
        if options.compass_deg is not None:
            normals = np.random.default_rng([options.seed, 5]).standard_normal((2, self.n_frames))
            times = np.arange(self.n_frames) / options.rate
            slow = ornstein_uhlenbeck(normals[:1], times, _COMPASS_S)[0]
            error = math.radians(options.compass_deg) * math.sqrt(0.5) * (normals[1] + slow)
            self._headings = wrap_angles(self._truths[:, 2] + error)
        self._dark, self._blind = _span(options.dark), _span(options.blind)
        true = np.column_stack([np.hypot(moved[:, 0], moved[:, 1]), wrap_angles(moved[:, 2])])
        self._velocities = self.noise.apply(true * options.rate, options.seed)
        self._climbs = self.noise.apply_climb(climbed * options.rate, options.noise, options.seed)
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

    def heights(self) -> np.ndarray:
        """Return the true height of all frames, ``(n_frames,)`` in metres; 0 in the plane."""
        return self._heights.copy()

    def pitches(self) -> np.ndarray:
        """Return the true pitch of the vehicle at all frames, ``(n_frames,)``, radians upwards.

        That of a car between its axles; 0 in a world that is flown, whose camera stays level.
        """
        return np.zeros(self.n_frames) if self.world.flown else self._pitches.copy()

    def climbs(self) -> np.ndarray:
        """Return the measured speed upwards of all frames, ``(n_frames,)`` in m/s."""
        return self._climbs.copy()

    def gain(self, time_s: float) -> float:
        """Return the brightness at this time: a sum of two slow waves within ``light``."""
        slow = math.sin(TWO_PI * time_s / 47.0 + self._phases[0])
        slower = math.sin(TWO_PI * time_s / 113.0 + self._phases[1])
        return self.options.gain * (1.0 + self.options.light * (0.4 * slow + 0.6 * slower))

    def figures(self, time_s: float) -> list[Billboard]:
        """Return the pedestrians at this time; every second one walks towards the robot."""
        present = []
        for i, (start, pace) in enumerate(self._people.tolist()):
            speed = (0.6 + 0.7 * pace) * (1.0 if i % 2 else -1.0)
            along = start * self.route.length_m + speed * time_s
            lane = self.world.lanes_m[i % len(self.world.lanes_m)]
            at = compose(Pose(*self.route.at(along)[0].tolist()), Pose(0.0, lane, 0.0))
            cycle = self.world.people[i % len(self.world.people)]
            cutout = cycle[int(along // _STEP_M) % len(cycle)]
            present.append(Billboard(at.x_m, at.y_m, *_PERSON_M, cutout))
        return present

    def frame(self, index: int) -> Frame:
        """Return the frame of that index; it does not depend on earlier calls.

        Raises:
            SourceError: If there is no such frame.
        """
        if not 0 <= index < self.n_frames:
            raise SourceError(f"{self.name}: no frame {index}; expected 0 to {self.n_frames - 1}")
        time_s = index / self.options.rate
        pose = self.truth(index)
        camera = self.camera
        if self.world.flown and self.route.climbs:
            height = camera.camera_height_m + float(self._heights[index])
            camera = replace(camera, camera_height_m=height)
        inclined = self.world.ramps and self.options.ramps and not camera.panoramic
        pitch = float(self._pitches[index]) if inclined else None
        image = render(self.world, pose, camera, self.figures(time_s), self.gain(time_s), pitch)
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
            v_z_m_s=float(self._climbs[index]) if self.route.climbs and velocity else None,
        )

    def _landmarks(self, index: int, pose: Pose) -> np.ndarray:
        """Return number, distance and bearing of the visible posts, ``(n, 3)``, with noise."""
        options, camera = self.options, self.camera
        seen = in_sight(self.world, pose, self.posts_m, camera.camera_height_m)
        distance, bearing = seen.T
        half_view = math.pi if camera.panoramic else math.radians(camera.fov_deg) / 2.0
        visible = (distance <= options.landmark_reach) & (np.abs(bearing) < half_view)
        # Drawn for all posts, so that the noise of one does not depend on which are visible.
        rng = np.random.default_rng([options.seed, 4, index])
        noise = options.landmark_noise * rng.standard_normal((2, len(seen)))
        wrong = rng.uniform(size=len(seen)) < options.outliers
        elsewhere = rng.uniform(
            [[0.3], [-half_view]], [[options.landmark_reach], [half_view]], (2, len(seen))
        )
        distance = np.where(wrong, elsewhere[0], distance * (1.0 + noise[0]))
        bearing = np.where(wrong, elsewhere[1], bearing + noise[1])
        number = np.arange(len(seen)) if options.labels else np.full(len(seen), -1)
        return np.asarray(np.column_stack([number, np.maximum(distance, 0.0), bearing])[visible])

    def _measure(self, index: int, pose: Pose) -> np.ndarray:
        options = self.options
        ranges = measure_ranges(self.world, pose, options.ranges, self.camera.camera_height_m)
        noise = np.random.default_rng([options.seed, 3, index]).standard_normal(len(ranges))
        return np.asarray(np.maximum(ranges + options.range_noise_m * noise, 0.0))


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
        SourceError: If the name or an option is unknown, or a value is invalid.

    Example:
        >>> open_world("world:town?route=5&laps=1&people=2").options.people
        2
    """
    name, _, query = spec.removeprefix("world:").partition("?")
    if name not in catalogue():
        build_world(name)  # raises an error that lists the names
    return WorldSource(name, parse_options(f"world {name!r}", query, WorldOptions))
