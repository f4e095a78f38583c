"""Walks of rats, recorded or made: where an animal was, and the walls around it.

A recorded walk is an ``.npz`` with the positions ``pos``, ``(n, 2)`` in metres, and the times
``t``, ``(n,)`` in seconds; it may have the corners of its arena, ``vertices``, or its
``arena_radius``, and the times ``spikes_s`` of a cell that was recorded with it. Or it is a CSV
with the columns ``time_s``, ``x_m`` and ``y_m``.
"""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np

from neuroslam.errors import ConfigError, SourceError
from neuroslam.geometry import TWO_PI
from neuroslam.sensors.images import read_text
from neuroslam.sensors.tracks import motion_along, parse_table, read_positions, rising
from neuroslam.worlds.arena import Arena

ARENA_KEYS = ("vertices", "arena_radius")
"""The arrays of a track's file that describe its arena; either will do."""

_TABLE = ("time_s", "x_m", "y_m")

# The agent of roam. Speed is Rayleigh distributed, as that of rats in the open field is.
_SPEED_TIME_S = 0.7  # over which it forgets its speed
_TURN_TIME_S = 0.2  # over which it forgets its turn rate
_TURN_RAD_S = 0.8  # standard deviation of the turn rate
_STEER_M = 0.12  # nearer walls are steered along
_CELL_M = 0.01  # of the grid on which the distance to the walls is looked up
_MAX_CELLS = 400_000
_ESCAPES = [s * math.radians(a) for a in range(20, 181, 20) for s in (1.0, -1.0)]


@dataclass(frozen=True)
class Walk:
    """Positions of an animal over time.

    Attributes:
        name: Where it comes from, for messages.
        times_s: ``(n,)``, rising, n at least 2.
        positions: ``(n, 2)`` in metres.
        headings_rad: Direction of the step into each position, ``(n,)``; who stands keeps it.
        arena: The walls around it, or ``None`` if they are not known.
        spikes_s: Times at which a cell fired, ``(m,)``, or ``None``.
        n_dropped: Rows of the file that were left out: no number, or a time that did not rise.
    """

    name: str
    times_s: np.ndarray
    positions: np.ndarray
    headings_rad: np.ndarray
    arena: Arena | None = None
    spikes_s: np.ndarray | None = None
    n_dropped: int = 0

    @classmethod
    def along(
        cls, name: str, times_s: np.ndarray, positions: np.ndarray, arena: Arena | None = None
    ) -> Self:
        """Make a walk of times and positions; the headings follow.

        Raises:
            SourceError: If there are fewer than two, or one is not finite, or a time not rising.

        Example:
            >>> walk = Walk.along("step", np.array([0.0, 0.5]), np.array([[0.0, 0.0], [0.0, 1.0]]))
            >>> walk.headings_rad.round(2).tolist()
            [1.57, 1.57]
        """
        times_s, positions = np.asarray(times_s, np.float64), np.asarray(positions, np.float64)
        n = len(times_s)
        if n < 2 or positions.shape != (n, 2):
            raise SourceError(
                f"{name}: times have shape {times_s.shape}, positions {positions.shape}; "
                "expected (n,) and (n, 2), n at least 2"
            )
        if not (np.isfinite(positions).all() and np.isfinite(times_s).all()):
            raise SourceError(f"{name}: not all its times and positions are finite; drop the rest")
        if not (np.diff(times_s) > 0.0).all():
            raise SourceError(f"{name}: its times do not rise; sort them and drop doubles")
        return cls(name, times_s, positions, motion_along(times_s, positions)[1][:, 2], arena)

    @property
    def duration_s(self) -> float:
        """Seconds from the first to the last position."""
        return float(self.times_s[-1] - self.times_s[0])

    @property
    def rate_hz(self) -> float:
        """Positions per second: one over the median interval."""
        return 1.0 / float(np.median(np.diff(self.times_s)))

    def resampled(self, rate_hz: float) -> Self:
        """Return the walk at this rate, positions interpolated along straight lines.

        Raises:
            SourceError: If the rate is not above 0, or leaves fewer than two positions.

        Example:
            >>> walk = Walk.along("step", [0.0, 1.0], [[0.0, 0.0], [4.0, 0.0]])
            >>> walk.resampled(4).positions[:, 0]
            array([0., 1., 2., 3., 4.])
        """
        _above_0(self.name, "rate", rate_hz, "Hz")
        n = math.floor(self.duration_s * rate_hz * (1.0 + 1e-12) + 1e-9) + 1
        times_s = self.times_s[0] + np.arange(n) / rate_hz
        positions = np.column_stack([np.interp(times_s, self.times_s, p) for p in self.positions.T])
        return self._with(times_s, positions, self.spikes_s)

    def lasting(self, minutes: float) -> Self:
        """Return the walk forward, reversed, forward and so on, cut to this length.

        Spikes are kept while the walk goes forward for the first time; of a longer walk they would
        be too few, and there are none.

        Raises:
            SourceError: If the length is not above 0, or leaves fewer than two positions.

        Example:
            >>> walk = Walk.along("step", [0.0, 2.0, 3.0], [[0.0, 0.0], [2.0, 0.0], [3.0, 0.0]])
            >>> long = walk.lasting(0.1)
            >>> long.times_s.tolist(), long.positions[:, 0].tolist()
            ([0.0, 2.0, 3.0, 4.0, 6.0], [0.0, 2.0, 3.0, 2.0, 0.0])
        """
        _above_0(self.name, "length", minutes, "minutes")
        wanted_s = 60.0 * minutes * (1.0 + 1e-12)
        since = self.times_s - self.times_s[0]
        passes = max(1, math.ceil(60.0 * minutes / self.duration_s))
        back = since[-1] - since[::-1]
        times = [
            since[:1],
            *(p * since[-1] + (back if p % 2 else since)[1:] for p in range(passes)),
        ]
        order = np.arange(len(since))
        index = np.concatenate(
            [order[:1], *((order[::-1] if p % 2 else order)[1:] for p in range(passes))]
        )
        times_s = np.concatenate(times)
        keep = times_s <= wanted_s
        spikes = self.spikes_s if passes == 1 else None
        if spikes is not None:
            spikes = spikes[spikes <= self.times_s[0] + wanted_s]
        return self._with(self.times_s[0] + times_s[keep], self.positions[index[keep]], spikes)

    def _with(self, times_s: np.ndarray, positions: np.ndarray, spikes: np.ndarray | None) -> Self:
        made = type(self).along(self.name, times_s, positions, self.arena)
        return replace(made, spikes_s=spikes, n_dropped=self.n_dropped)


def read_walk(path: str | Path, minutes: float | None = None, rate_hz: float | None = None) -> Walk:
    """Read a recorded walk, as the head of this module describes it.

    Rows without numbers, or whose time is not later than all before, are dropped and counted.

    Args:
        path: An ``.npz`` or a CSV.
        minutes: Length to bring it to, see :meth:`Walk.lasting`; ``None``: as it is.
        rate_hz: Rate to bring it to before, see :meth:`Walk.resampled`; ``None``: as it is.

    Raises:
        SourceError: If it is missing, damaged, or has fewer than two usable rows.
    """
    path = Path(path)
    if not path.is_file():
        raise SourceError(f"{path}: no such file; expected an .npz with pos and t, or a CSV")
    arrays: dict[str, np.ndarray] = {}
    if path.suffix.lower() == ".npz":
        arrays, times_s, positions = read_positions(path)
    else:
        table, _ = parse_table(
            read_text(path), str(path), _TABLE, f"expected {','.join(_TABLE)}: seconds and metres"
        )
        times_s, positions = table["time_s"], np.column_stack([table["x_m"], table["y_m"]])
    good = np.isfinite(positions).all(axis=1)
    # A time far ahead on a row without a position must not make all later times too early.
    times_s = np.where(good, times_s, np.nan)
    good &= rising(times_s)
    n = int(good.sum())
    if n < 2:
        raise SourceError(
            f"{path}: {n} of its {len(good)} rows have numbers and a time that rises; "
            "expected two or more"
        )
    arena = Arena.from_arrays(arrays) if any(key in arrays for key in ARENA_KEYS) else None
    walk = Walk.along(str(path), times_s[good], positions[good], arena)
    walk = replace(walk, spikes_s=_spikes(arrays, path), n_dropped=len(good) - n)
    walk = walk if rate_hz is None else walk.resampled(rate_hz)
    return walk if minutes is None else walk.lasting(minutes)


def roam(
    arena: Arena,
    minutes: float,
    generator: np.random.Generator,
    rate_hz: float = 20.0,
    speed_m_s: float = 0.08,
) -> Walk:
    r"""Let an agent walk about in an arena as a foraging rat does.

    Its speed is the length of a planar Ornstein-Uhlenbeck process, so it is smooth and Rayleigh
    distributed; its turn rate is another one. Near a wall it is steered along it,

    .. math:: d\theta = \pm \frac{ds}{R - m} \, (-n \cdot h)_+

    with :math:`R` the distance, :math:`n` the normal, :math:`h` the heading and :math:`m` the
    distance it never goes below (0.02 m; more where the arena is larger than 6 m).

    Args:
        arena: Where.
        minutes: How long.
        generator: Of its randomness.
        rate_hz: Positions per second.
        speed_m_s: Mean speed.

    Raises:
        SourceError: If a number is not above 0, or the arena has no room for it.

    Example:
        >>> walk = roam(Arena.circle(1.0), 0.1, np.random.default_rng(0))
        >>> walk.positions.shape, bool(walk.arena.contains(walk.positions).all())
        ((121, 2), True)
    """
    for what, value, unit in (
        ("length", minutes, "minutes"),
        ("rate", rate_hz, "Hz"),
        ("speed", speed_m_s, "m/s"),
    ):
        _above_0(arena.name, what, value, unit)
    room = _Room(arena)
    spread = speed_m_s / math.sqrt(math.pi / 2.0)
    # So many steps a sample that hardly any is cut by the bound below.
    fine = max(1, math.ceil(4.0 * spread / (rate_hz * room.margin_m)))
    n = max(1, round(60.0 * minutes * rate_hz)) * fine
    dt = 1.0 / (rate_hz * fine)
    times_s = np.arange(n + 1) * dt
    normals = generator.standard_normal((3, n + 1))
    planar = ornstein_uhlenbeck(normals[:2], times_s, _SPEED_TIME_S)
    # Longer steps could pass through a wall from one side of the margin to the other.
    lengths = np.minimum(spread * dt * np.hypot(*planar), room.margin_m)[1:]
    turns = _TURN_RAD_S * dt * ornstein_uhlenbeck(normals[2], times_s, _TURN_TIME_S)[1:]
    x, y = room.free[generator.integers(len(room.free))].tolist()
    theta = generator.uniform(-math.pi, math.pi)
    path = [(x, y)]
    for length, turn in zip(lengths.tolist(), turns.tolist(), strict=True):
        x, y, theta = room.step(x, y, theta + turn, length)
        path.append((x, y))
    return Walk.along(f"walk in {arena.name}", times_s[::fine], np.array(path)[::fine], arena)


class _Room:
    """An arena's distance to the nearest wall on a grid, negative outside, and steps in it.

    The distance changes by no more than one metre a metre, so between the nodes it is right to
    0.71 cells, and a place said to be two cells from the walls is at least 1.29 cells from them.
    """

    def __init__(self, arena: Arena) -> None:
        low, high = np.reshape(arena.bounds, (2, 2)).T
        self.cell_m = max(_CELL_M, math.sqrt(float(np.prod(high - low)) / _MAX_CELLS))
        self.margin_m = 2.0 * self.cell_m
        self.low = (low - 2.0 * self.cell_m).tolist()
        nx, ny = np.ceil((high - low) / self.cell_m).astype(int) + 5
        grid = np.stack(
            np.meshgrid(
                self.low[0] + self.cell_m * np.arange(nx),
                self.low[1] + self.cell_m * np.arange(ny),
                indexing="ij",
            ),
            axis=-1,
        ).reshape(-1, 2)
        distance = arena.clearance(grid)
        distance = np.where(arena.contains(grid), distance, -distance)
        self.free = grid[distance >= 1.5 * self.margin_m]
        if not len(self.free):
            raise SourceError(
                f"{arena.name}: no place in it is {1.5 * self.margin_m:g} m from its walls; "
                "expected a larger arena"
            )
        # Lists: single numbers come out of them five times as fast as out of arrays.
        self.distance_m = distance.reshape(nx, ny).tolist()

    def look(self, x: float, y: float) -> tuple[float, float, float]:
        """Return the distance to the nearest wall and its gradient, which leads away from it."""
        u, v = (x - self.low[0]) / self.cell_m, (y - self.low[1]) / self.cell_m
        i, j = int(u), int(v)
        a, b = u - i, v - j
        here, next_ = self.distance_m[i], self.distance_m[i + 1]
        d00, d01, d10, d11 = here[j], here[j + 1], next_[j], next_[j + 1]
        gx = ((d10 - d00) * (1.0 - b) + (d11 - d01) * b) / self.cell_m
        gy = ((d01 - d00) * (1.0 - a) + (d11 - d10) * a) / self.cell_m
        low = d00 + (d01 - d00) * b
        return low + (d10 + (d11 - d10) * b - low) * a, gx, gy

    def step(self, x: float, y: float, theta: float, length: float) -> tuple[float, float, float]:
        """Go one step, steered along the walls; where no direction is free, only turn."""
        distance, gx, gy = self.look(x, y)
        c, s = math.cos(theta), math.sin(theta)
        nearing = -(c * gx + s * gy)
        side = 1.0 if c * gy - s * gx > 0.0 else -1.0  # where the way along the wall is shorter
        if distance < _STEER_M and nearing > 0.0:
            room = max(distance - self.margin_m, 0.1 * self.cell_m)
            theta += side * min(length / room, 1.0) * nearing
        for escape in (0.0, *_ESCAPES):
            turned = theta + side * escape
            to_x, to_y = x + length * math.cos(turned), y + length * math.sin(turned)
            if self.look(to_x, to_y)[0] >= self.margin_m:
                return to_x, to_y, turned % TWO_PI
        return x, y, (theta + side) % TWO_PI


def ratinabox_walk(arena: Arena, minutes: float, seed: int, rate_hz: float = 20.0) -> Walk:
    """Let an agent of RatInABox (George et al. 2024) walk about in an arena; the extra ``rodent``.

    Args:
        arena: Where; circles are given to it as polygons.
        minutes: How long.
        seed: Of its randomness. RatInABox draws from numpy's global generator, whose state is put
            back afterwards.
        rate_hz: Positions per second.

    Raises:
        ConfigError: If RatInABox is not installed.
        SourceError: If a number is not above 0.
    """
    _above_0(arena.name, "length", minutes, "minutes")
    _above_0(arena.name, "rate", rate_hz, "Hz")
    try:
        from ratinabox.Agent import Agent
        from ratinabox.Environment import Environment
    except ImportError as error:
        raise ConfigError(
            f"RatInABox cannot be imported ({error}); pip install neuroslam[rodent], or use roam"
        ) from None
    n = max(1, round(60.0 * minutes * rate_hz))
    before = np.random.get_state()
    np.random.seed(seed)
    try:
        boundary, *holes = (line[:-1] for line in arena.outlines[: 1 + len(arena.holes)])
        most = max(map(len, holes), default=0)  # it wants as many corners of every hole
        holes = [np.vstack([h, np.linspace(h[-1], h[0], most - len(h) + 2)[1:-1]]) for h in holes]
        outline = {"boundary": boundary.tolist(), "holes": holes, "walls": arena.walls}
        environment = Environment(outline)
        agent = Agent(environment, {"dt": 1.0 / rate_hz})
        for _ in range(n + 1):
            agent.update()
        positions = np.array(agent.history["pos"])
    finally:
        np.random.set_state(before)
    return Walk.along(f"ratinabox in {arena.name}", np.arange(n + 1) / rate_hz, positions, arena)


def ornstein_uhlenbeck(
    normals: np.ndarray, times_s: np.ndarray, time_constant_s: float
) -> np.ndarray:
    r"""Turn white noise into noise that is forgotten over a time, of mean 0 and deviation 1.

    .. math:: x_0 = n_0, \quad x_k = a_k x_{k-1} + \sqrt{1 - a_k^2}\, n_k, \quad
        a_k = e^{-(t_k - t_{k-1}) / \tau}

    It is exact, whatever the intervals are [Uhlenbeck and Ornstein 1930].

    Args:
        normals: Independent standard normal numbers :math:`n`, ``(..., n)``.
        times_s: Rising, ``(n,)``.
        time_constant_s: :math:`\tau`.

    Returns:
        Noise of the shape of ``normals``.

    Example:
        >>> ornstein_uhlenbeck(np.array([1.0, 0.0]), np.array([0.0, 2.0]), 2.0).round(4).tolist()
        [1.0, 0.3679]
    """
    out = np.array(normals, np.float64)
    last, n = 1, len(times_s)
    passed = np.diff(times_s, prepend=times_s[:1]) / time_constant_s
    out[..., 1:] *= np.sqrt(-np.expm1(-2.0 * passed[1:]))
    while last < n:
        # The recurrence as a cumulative sum of growing terms, in stretches that cannot overflow.
        grown = np.cumsum(passed[last:])
        size = max(1, int(np.searchsorted(grown, 300.0, side="right")))
        growth = np.exp(np.minimum(grown[:size], 300.0))
        stretch = out[..., last : last + size]
        stretch[...] = (out[..., last - 1 : last] + np.cumsum(growth * stretch, axis=-1)) / growth
        last += size
    return out


def _spikes(arrays: dict[str, np.ndarray], path: Path) -> np.ndarray | None:
    if "spikes_s" not in arrays:
        return None
    spikes = arrays["spikes_s"]
    if spikes.ndim != 1 or spikes.dtype.kind not in "fiu":
        raise SourceError(f"{path}: spikes_s is {spikes.shape}; expected (m,) in seconds")
    return spikes[np.isfinite(spikes)].astype(np.float64)


def _above_0(name: str, what: str, value: float, unit: str) -> None:
    if not (math.isfinite(value) and value > 0):
        raise SourceError(f"{name}: {what} is {value} {unit}; expected a number above 0")
