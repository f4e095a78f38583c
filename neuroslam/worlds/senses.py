"""Senses of an animal on a walk: speed, heading and nearby walls, with noise."""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from neuroslam.config.bounds import LARGEST_SEED
from neuroslam.errors import BadFrame, ConfigError, SourceError, counted
from neuroslam.geometry import wrap_angles
from neuroslam.sensors.options import parse_options
from neuroslam.sensors.source import IndexedSource, OnBadFrame
from neuroslam.types import Frame, Pose, Velocity
from neuroslam.worlds.arena import Arena, named_arena
from neuroslam.worlds.rodent import Walk, ornstein_uhlenbeck, read_walk, roam

REACH_M = 0.3
N_WALLS = 4
BEAM_REACH_M = 5.0

# Each term has its own stream of random numbers, so that one does not change another.
_SCALE, _FACTOR, _ADD, _WHITE, _SLOW, _DISTANCE, _BEARING, _BEAMS = range(8)


class SenseNoise(BaseModel):
    """Noise of an animal's senses; all terms are standard deviations."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    speed_scale: float = Field(
        default=0.02, ge=0, description="share of the speed, one factor per run"
    )
    speed_factor: float = Field(default=0.10, ge=0, description="share of the speed, per sample")
    speed_add_m_s: float = Field(default=0.01, ge=0, description="m/s, per sample")
    heading_white_deg: float = Field(default=3.0, ge=0, description="degrees, per sample")
    heading_slow_deg: float = Field(
        default=2.0, ge=0, description="degrees, slow drift around zero"
    )
    heading_slow_s: float = Field(
        default=120.0, gt=0, description="time constant of the slow drift in s"
    )
    wall_distance_m: float = Field(default=0.01, ge=0, description="metres, per wall and sample")
    wall_bearing_deg: float = Field(default=2.0, ge=0, description="degrees, per wall and sample")

    def scaled(self, factor: float) -> Self:
        """Return the noise of self-motion times a factor; the noise of the walls is unchanged.

        Raises:
            ConfigError: If the factor is negative or not finite.

        Example:
            >>> SenseNoise().scaled(0.5).speed_scale, SenseNoise().scaled(0.5).wall_distance_m
            (0.01, 0.01)
        """
        if not (math.isfinite(factor) and factor >= 0):
            raise ConfigError(
                f"SenseNoise: the factor is {factor}; expected a finite number, at least 0"
            )
        return self.model_copy(update={term: factor * getattr(self, term) for term in _MOTION})


_MOTION = ("speed_scale", "speed_factor", "speed_add_m_s", "heading_white_deg", "heading_slow_deg")

NO_NOISE = SenseNoise(**dict.fromkeys((*_MOTION, "wall_distance_m", "wall_bearing_deg"), 0.0))
"""Senses without noise."""


class Senses(NamedTuple):
    """Sensed data of one walk by ``B`` animals with different noise, at ``T`` times.

    Attributes:
        time_s: Times, ``(T,)``.
        dt_s: Interval that ends at the sample, ``(T,)``; the first equals the second.
        speed_m_s: Speed over that interval, ``(B, T)``; the first is zero.
        heading_rad: Heading of the step that ends at the sample, by compass, ``(B, T)``.
        wall_m: Distances of the nearest walls in reach, ``(B, T, k)``, ``inf`` if there is none.
        wall_bearing_rad: Bearing of the foot of the perpendicular on each wall, relative to the
            heading, ``(B, T, k)``, 0 if there is none.
        position_m: True position, ``(T, 2)``.
        true_heading_rad: True heading, ``(T,)``.
    """

    time_s: np.ndarray
    dt_s: np.ndarray
    speed_m_s: np.ndarray
    heading_rad: np.ndarray
    wall_m: np.ndarray
    wall_bearing_rad: np.ndarray
    position_m: np.ndarray
    true_heading_rad: np.ndarray


def sense(
    walk: Walk,
    noise: SenseNoise = NO_NOISE,
    seeds: Sequence[int] = (0,),
    reach_m: float = REACH_M,
    k: int = N_WALLS,
    compass_free_bearings: bool = False,
) -> Senses:
    r"""Simulate the senses on a walk, once per seed; a row depends on its seed only.

    .. math:: \hat v = v (1 + \sigma_1 n_1)(1 + \sigma_2 n) + \sigma_3 n', \quad
        \hat\theta = \theta + \sigma_4 n'' + \sigma_5\,\mathrm{OU}(\tau)

    with independent standard normal :math:`n`; :math:`n_1` is drawn once per run, the others for
    every sample. The walls are sensed from the true position, :math:`\hat R = [R + \sigma_6 n]_+`,
    at bearings relative to the true heading, :math:`\hat\beta = \alpha - \theta + \sigma_7 n`, so
    that :math:`\hat\theta + \hat\beta` contains the error of the compass.

    Args:
        walk: The walk; without an arena there are no walls.
        noise: Noise of the senses.
        seeds: Seed of each row.
        reach_m: Largest distance of a sensed wall.
        k: Number of walls, nearest first.
        compass_free_bearings: Measure bearings relative to the measured heading, so that
            :math:`\hat\theta + \hat\beta = \alpha + \sigma_7 n`, as in the prototype of the
            reference figures.

    Example:
        >>> walk = Walk.along("step", [0, 0.5], [[0, 0], [0.8, 0]], named_arena("circle2m"))
        >>> senses = sense(walk)
        >>> senses.speed_m_s[0, 1].item(), senses.wall_m[0, 1].round(6).tolist()
        (1.6, [0.2, inf, inf, inf])
    """
    t, dt_s = walk.times_s, _intervals(walk.times_s)
    steps = np.diff(walk.positions, axis=0)
    speed = np.zeros(len(t))
    speed[1:] = np.hypot(*steps.T) / dt_s[1:]
    n = len(t)
    scale, factor, add = (_draw(seeds, term, n) for term in (_SCALE, _FACTOR, _ADD))
    factors = (1.0 + noise.speed_scale * scale[:, :1]) * (1.0 + noise.speed_factor * factor)
    speeds = speed * factors + noise.speed_add_m_s * add
    speeds[:, 0] = 0.0
    slow = ornstein_uhlenbeck(_draw(seeds, _SLOW, n), t, noise.heading_slow_s)
    error = math.radians(noise.heading_white_deg) * _draw(seeds, _WHITE, n)
    error += math.radians(noise.heading_slow_deg) * slow
    headings = _wrapped(walk.headings_rad + error)
    if walk.arena is None:
        wall_m, alpha = np.full((n, k), np.inf), np.zeros((n, k))
    else:
        wall_m, alpha = walk.arena.nearest_walls(walk.positions, reach_m, k)
    sensed = np.isfinite(wall_m)
    distances = np.maximum(wall_m + noise.wall_distance_m * _draw(seeds, _DISTANCE, n, k), 0.0)
    bearings = alpha + math.radians(noise.wall_bearing_deg) * _draw(seeds, _BEARING, n, k)
    reference = headings[..., None] if compass_free_bearings else walk.headings_rad[:, None]
    bearings = np.where(sensed, _wrapped(np.where(sensed, bearings, 0.0) - reference), 0.0)
    return Senses(t, dt_s, speeds, headings, distances, bearings, walk.positions, walk.headings_rad)


class ArenaSource(IndexedSource):
    """Frames of a walk: motion, compass, walls in reach or ranges, and the truth.

    Args:
        walk: The walk.
        noise: Noise of the senses.
        seed: Seed of the noise.
        beams: Number of ranges to deliver instead of walls; they reach 5 m and have the noise of
            wall distances.

    Raises:
        SourceError: If there are beams, but the walk has no arena.

    Example:
        >>> walk = Walk.along("step", [0, 0.5], [[0, 0], [0.8, 0]], named_arena("circle2m"))
        >>> frame = ArenaSource(walk).frame(1)
        >>> frame.velocity, frame.walls.round(6).tolist()
        (Velocity(v_m_s=1.6, w_rad_s=0.0), [[0.2, 0.0]])
    """

    def __init__(
        self,
        walk: Walk,
        noise: SenseNoise = NO_NOISE,
        seed: int = 0,
        beams: int | None = None,
    ) -> None:
        if beams and walk.arena is None:
            raise SourceError(
                f"{walk.name}: has no arena, so no ranges can be measured; expected vertices or "
                "arena_radius"
            )
        self.name, self.walk, self.seed, self.beams = walk.name, walk, seed, beams
        self.beam_noise_m = noise.wall_distance_m
        self.n_frames = len(walk.times_s)
        self.notes = walk.notes
        self.frame_rate_hz = walk.rate_hz
        self.senses = sense(walk, noise, [seed])
        turned = wrap_angles(np.diff(self.senses.heading_rad[0], prepend=self._heading(0)))
        self._turn_rates = turned / self.senses.dt_s

    def _heading(self, index: int) -> float:
        return float(self.senses.heading_rad[0, index])

    def frame(self, index: int) -> Frame:
        """Return the frame of that index; it does not depend on earlier calls.

        Raises:
            SourceError: If there is no such frame.
        """
        if not 0 <= index < self.n_frames:
            raise SourceError(f"{self.name}: no frame {index}; expected 0 to {self.n_frames - 1}")
        senses = self.senses
        x_m, y_m = senses.position_m[index].tolist()
        truth = Pose(x_m, y_m, float(senses.true_heading_rad[index]))
        walls = ranges = None
        if self.beams and self.walk.arena is not None:
            ranges = self._ranges(self.walk.arena, self.beams, index)
        elif self.walk.arena is not None:
            near = np.isfinite(senses.wall_m[0, index])
            walls = np.column_stack(
                [senses.wall_m[0, index, near], senses.wall_bearing_rad[0, index, near]]
            )
        return Frame(
            index,
            float(senses.time_s[index]),
            velocity=Velocity(float(senses.speed_m_s[0, index]), float(self._turn_rates[index])),
            ranges=ranges,
            walls=walls,
            heading_rad=self._heading(index),
            truth=truth,
        )

    def frames(
        self, start: int = 0, stop: int | None = None, on_bad_frame: OnBadFrame = None
    ) -> Iterator[Frame]:
        """Yield the frames ``start <= index < stop``, see :meth:`.Source.frames`.

        If rows of the walk's file were dropped, one bad frame before the first reports it.
        """
        if self.walk.n_dropped and start <= 0:
            error = BadFrame(
                f"{self.name}: {counted(self.walk.n_dropped, 'row has', 'rows have')} no numbers, "
                "or a time that does not rise, and will be skipped"
            )
            if on_bad_frame is None:
                raise error
            on_bad_frame(error)
        yield from super().frames(start, stop, on_bad_frame)

    def _ranges(self, arena: Arena, beams: int, index: int) -> np.ndarray:
        row = slice(index, index + 1)
        (true,) = arena.ranges(
            self.walk.positions[row], self.walk.headings_rad[row], beams, BEAM_REACH_M
        )
        generator = np.random.default_rng([self.seed, _BEAMS, index])
        noise = self.beam_noise_m * generator.standard_normal(beams)
        return np.asarray(np.maximum(true + noise, 0.0))


class ArenaOptions(BaseModel):
    """Options after the ``?`` of an arena's name."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    minutes: float | None = Field(
        default=None, gt=0, le=1000, description="minutes; none: 30, or as recorded"
    )
    noise: float = Field(
        default=1.0,
        ge=0,
        le=100,
        description="factor on the noise of self-motion; 0: no noise at all",
    )
    seed: int = Field(
        default=0, ge=0, le=LARGEST_SEED, description="seed of the noise, and of a simulated walk"
    )
    rate: float | None = Field(
        default=None, gt=0, le=1000, description="samples per second; none: 20, or as recorded"
    )
    speed: float = Field(default=0.08, gt=0, description="mean speed of a simulated walk in m/s")
    ranges: int | None = Field(
        default=None,
        ge=3,
        le=100_000,
        description="beams of a scan, instead of the walls in reach",
    )


def open_arena(spec: str) -> ArenaSource:
    """Open a walk in an arena from ``[arena:]NAME_OR_NPZ[?option=value&...]``.

    The name is one of :func:`neuroslam.worlds.arena.named_arena`, in which a walk is simulated, or
    the file of a recorded walk; the options are in :class:`ArenaOptions`.

    Raises:
        SourceError: If the name or an option is unknown, a value or the file cannot be used, or
            the file contains no arena.

    Example:
        >>> source = open_arena("arena:circle1m?minutes=0.1&noise=0")
        >>> source.n_frames, source.frame(5).walls is None
        (121, False)
    """
    name, _, query = spec.removeprefix("arena:").partition("?")
    options = parse_options(f"arena {name!r}", query, ArenaOptions)
    if name.lower().endswith(".npz"):
        walk = read_walk(name, options.minutes, options.rate)
        if walk.arena is None:
            raise SourceError(
                f"{name}: contains no arena; expected vertices (n, 2) or arena_radius in metres"
            )
    else:
        # A stream of random numbers separate from those of the noise, which has the same seed.
        generator = np.random.default_rng([options.seed, 100])
        minutes, rate = options.minutes or 30.0, options.rate or 20.0
        walk = roam(named_arena(name), minutes, generator, rate, options.speed)
    noise = SenseNoise().scaled(options.noise) if options.noise else NO_NOISE
    return ArenaSource(walk, noise, options.seed, options.ranges)


def _draw(seeds: Sequence[int], term: int, *shape: int) -> np.ndarray:
    return np.stack([np.random.default_rng([s, term]).standard_normal(shape) for s in seeds])


def _intervals(times_s: np.ndarray) -> np.ndarray:
    dt_s = np.diff(times_s, prepend=times_s[0])
    dt_s[0] = dt_s[1]
    return dt_s


def _wrapped(angles: np.ndarray) -> np.ndarray:
    """Wrap angles to [-pi, pi]; those inside keep their last bit."""
    return np.where(np.abs(angles) <= math.pi, angles, wrap_angles(angles))
