"""Walks of rats, recorded or simulated: positions over time, and the arena around them.

A recorded walk is an ``.npz`` with the positions ``pos``, ``(n, 2)`` in metres, and the times
``t``, ``(n,)`` in seconds. Optional are the corners of the arena, ``vertices``, or its
``arena_radius``, and the spike times ``spikes_s`` of a cell recorded with it. Or the walk is a CSV
with the columns ``time_s``, ``x_m`` and ``y_m``.
"""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from neuroslam import compiled as steps
from neuroslam.compiled import compiled
from neuroslam.errors import ConfigError, SourceError
from neuroslam.geometry import TWO_PI
from neuroslam.sensors.images import read_text
from neuroslam.sensors.tracks import motion_along, parse_table, read_positions, usable_times
from neuroslam.worlds.arena import Arena

ARENA_KEYS = ("vertices", "arena_radius")
"""Arrays of a track's file that describe its arena; either is sufficient."""

_TABLE = ("time_s", "x_m", "y_m")

# The agent of roam(). Its speed is Rayleigh distributed, as that of rats in the open field.
_SPEED_TIME_S = 0.7  # time constant of the speed
_TURN_TIME_S = 0.2  # time constant of the turn rate
_TURN_RAD_S = 0.8  # standard deviation of the turn rate
_STEER_M = 0.12  # distance below which the agent is steered along a wall
_CELL_M = 0.01  # cell of the grid of distances to the walls
_MAX_CELLS = 400_000
_ESCAPES = np.array([0.0, *(s * math.radians(a) for a in range(20, 181, 20) for s in (1.0, -1.0))])


@dataclass(frozen=True)
class Walk:
    """Positions of an animal over time.

    Attributes:
        name: Name of the walk, for messages.
        times_s: Rising times in seconds, ``(n,)``, n at least 2.
        positions: ``(n, 2)`` in metres.
        headings_rad: Direction of the step to each position, ``(n,)``; without a step it stays.
        arena: The arena, or ``None`` if it is not known.
        spikes_s: Spike times of a cell in seconds, ``(m,)``, or ``None``.
        n_dropped: Number of dropped rows of the file: no number, or a time that does not rise.
        notes: How the times of the file were read, one line each.
    """

    name: str
    times_s: np.ndarray
    positions: np.ndarray
    headings_rad: np.ndarray
    arena: Arena | None = None
    spikes_s: np.ndarray | None = None
    n_dropped: int = 0
    notes: tuple[str, ...] = ()

    @classmethod
    def along(
        cls, name: str, times_s: ArrayLike, positions: ArrayLike, arena: Arena | None = None
    ) -> Self:
        """Make a walk of times and positions, from which the headings are derived.

        Raises:
            SourceError: If there are fewer than two, one is not finite, or a time does not rise.

        Example:
            >>> walk = Walk.along("step", np.array([0.0, 0.5]), np.array([[0.0, 0.0], [0.0, 1.0]]))
            >>> walk.headings_rad.round(2).tolist()
            [1.57, 1.57]
        """
        t, p = np.asarray(times_s, np.float64), np.asarray(positions, np.float64)
        n = len(t)
        if n < 2 or p.shape != (n, 2):
            raise SourceError(
                f"{name}: times have shape {t.shape}, positions {p.shape}; "
                "expected (n,) and (n, 2), n at least 2"
            )
        if not (np.isfinite(p).all() and np.isfinite(t).all()):
            raise SourceError(f"{name}: a time or position is not finite; drop such rows")
        if not (np.diff(t) > 0.0).all():
            raise SourceError(f"{name}: times do not rise; sort them, and drop duplicates")
        return cls(name, t, p, motion_along(t, p)[1][:, 2], arena)

    @property
    def duration_s(self) -> float:
        """Time from the first to the last position in seconds."""
        return float(self.times_s[-1] - self.times_s[0])

    @property
    def rate_hz(self) -> float:
        """Positions per second: the inverse of the median interval."""
        return 1.0 / float(np.median(np.diff(self.times_s)))

    def resampled(self, rate_hz: float) -> Self:
        """Return the walk at another rate, with positions interpolated linearly.

        Raises:
            SourceError: If the rate is not positive, or results in fewer than two positions.

        Example:
            >>> walk = Walk.along("step", [0.0, 1.0], [[0.0, 0.0], [4.0, 0.0]])
            >>> walk.resampled(4).positions[:, 0]
            array([0., 1., 2., 3., 4.])
        """
        _above_0(self.name, "rate", rate_hz, "Hz")
        n = math.floor(self.duration_s * rate_hz * (1.0 + 1e-12) + 1e-9) + 1
        times_s = self.times_s[0] + np.arange(n) / rate_hz
        positions = np.column_stack([np.interp(times_s, self.times_s, p) for p in self.positions.T])
        return self._replaced(times_s, positions, self.spikes_s)

    def lasting(self, minutes: float) -> Self:
        """Return the walk forwards, backwards, forwards and so on, cut to a duration.

        Spikes are only kept if the first pass forwards is long enough.

        Raises:
            SourceError: If the duration is not positive, or results in fewer than two positions.

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
        return self._replaced(self.times_s[0] + times_s[keep], self.positions[index[keep]], spikes)

    def _replaced(
        self, times_s: np.ndarray, positions: np.ndarray, spikes: np.ndarray | None
    ) -> Self:
        made = type(self).along(self.name, times_s, positions, self.arena)
        return replace(made, spikes_s=spikes, n_dropped=self.n_dropped)


def read_walk(path: str | Path, minutes: float | None = None, rate_hz: float | None = None) -> Walk:
    """Read a recorded walk; the module's docstring describes its format.

    Rows without numbers, or with a time that does not rise, are dropped and counted.

    Args:
        path: An ``.npz`` or a CSV.
        minutes: Duration of the result, see :meth:`Walk.lasting`; ``None``: unchanged.
        rate_hz: Rate before that, see :meth:`Walk.resampled`; ``None``: unchanged.

    Raises:
        SourceError: If the file is missing, damaged, or has fewer than two usable rows.
    """
    path = Path(path)
    if not path.is_file():
        raise SourceError(f"{path}: no such file; expected an .npz with pos and t, or a CSV")
    arrays: dict[str, np.ndarray] = {}
    if path.suffix.lower() == ".npz":
        arrays, times_s, positions, notes = read_positions(path)
    else:
        table, _, notes = parse_table(
            read_text(path), str(path), _TABLE, f"expected {','.join(_TABLE)}: seconds and metres"
        )
        times_s, positions = table["time_s"], np.column_stack([table["x_m"], table["y_m"]])
    if times_s is None:
        raise SourceError(f"{path}: has no times; expected t (n,) in seconds")
    usable = np.isfinite(positions).all(axis=1)
    # The time of a row without a position does not count, so it cannot invalidate later rows.
    times_s = np.where(usable, times_s, np.nan)
    usable &= usable_times(times_s)
    n = int(usable.sum())
    if n < 2:
        raise SourceError(
            f"{path}: {n} of {len(usable)} rows have numbers and a rising time; expected at least 2"
        )
    arena = Arena.from_arrays(arrays) if any(key in arrays for key in ARENA_KEYS) else None
    walk = Walk.along(str(path), times_s[usable], positions[usable], arena)
    walk = replace(walk, spikes_s=_spikes(arrays, path), n_dropped=len(usable) - n, notes=notes)
    walk = walk if rate_hz is None else walk.resampled(rate_hz)
    return walk if minutes is None else walk.lasting(minutes)


def roam(
    arena: Arena,
    minutes: float,
    generator: np.random.Generator,
    rate_hz: float = 20.0,
    speed_m_s: float = 0.08,
) -> Walk:
    r"""Simulate the walk of a foraging rat in an arena.

    The speed is the norm of a planar Ornstein-Uhlenbeck process, so it is smooth and Rayleigh
    distributed; the turn rate is another such process. Near a wall the agent is steered along it,

    .. math:: d\theta = \pm \frac{ds}{R - m} \, (-n \cdot h)_+

    with :math:`R` the distance, :math:`n` the normal, :math:`h` the heading and :math:`m` the
    smallest distance allowed (0.02 m; more if the arena is larger than 6 m).

    Args:
        arena: The arena.
        minutes: Duration.
        generator: Source of randomness.
        rate_hz: Positions per second.
        speed_m_s: Mean speed.

    Raises:
        SourceError: If a number is not positive, or the arena is too narrow.

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
    # Enough steps per sample that the bound below shortens hardly any of them.
    fine = max(1, math.ceil(4.0 * spread / (rate_hz * room.margin_m)))
    n = max(1, round(60.0 * minutes * rate_hz)) * fine
    dt = 1.0 / (rate_hz * fine)
    times_s = np.arange(n + 1) * dt
    normals = generator.standard_normal((3, n + 1))
    planar = ornstein_uhlenbeck(normals[:2], times_s, _SPEED_TIME_S)
    # A step longer than the margin could pass through a wall.
    lengths = np.minimum(spread * dt * np.hypot(*planar), room.margin_m)[1:]
    turns = _TURN_RAD_S * dt * ornstein_uhlenbeck(normals[2], times_s, _TURN_TIME_S)[1:]
    x, y = room.free[generator.integers(len(room.free))].tolist()
    theta = generator.uniform(-math.pi, math.pi)
    path = room.walk(x, y, theta, lengths, turns)
    return Walk.along(f"walk in {arena.name}", times_s[::fine], path[::fine], arena)


@compiled
def walk_steps(
    path: np.ndarray, theta: float, lengths: np.ndarray, turns: np.ndarray,
    distance_m: np.ndarray, low_x: float, low_y: float, cell_m: float, margin_m: float,
    escapes: np.ndarray,
) -> None:  # fmt: skip
    """Walk from the first position of a path, steered along walls; write the others to it.

    Where no direction is free, the agent only turns. ``distance_m`` is the distance to the nearest
    wall on a grid; it is interpolated, once where the agent is, then where it would go.
    """
    for k in range(len(lengths)):
        x, y, length = path[k][0], path[k][1], lengths[k]
        theta += turns[k]
        to_x, to_y, heading, side, free = x, y, theta, 1.0, False
        for attempt in range(len(escapes) + 1):
            if attempt:
                heading = theta + side * escapes[attempt - 1]
                to_x, to_y = x + length * math.cos(heading), y + length * math.sin(heading)
            u, v = (to_x - low_x) / cell_m, (to_y - low_y) / cell_m
            i, j = int(u), int(v)
            a, b = u - i, v - j
            here, next_ = distance_m[i], distance_m[i + 1]
            d00, d01, d10, d11 = here[j], here[j + 1], next_[j], next_[j + 1]
            low = d00 + (d01 - d00) * b
            distance = low + (d10 + (d11 - d10) * b - low) * a
            if attempt:
                if distance >= margin_m:
                    x, y, free = to_x, to_y, True
                    break
                continue
            gx = ((d10 - d00) * (1.0 - b) + (d11 - d01) * b) / cell_m  # points away from the wall
            gy = ((d01 - d00) * (1.0 - a) + (d11 - d10) * a) / cell_m
            c, s = math.cos(-theta), math.sin(-theta)
            ahead, left = c * gx - s * gy, s * gx + c * gy  # in the agent's frame
            side = 1.0 if left > 0.0 else -1.0  # to which the smaller turn is away from the wall
            if distance < _STEER_M and ahead < 0.0:
                room = max(distance - margin_m, 0.1 * cell_m)
                theta += side * min(length / room, 1.0) * -ahead
        theta = (heading if free else theta + side) % TWO_PI
        path[k + 1][0], path[k + 1][1] = x, y


class _Room:
    """Distances to the nearest wall of an arena on a grid, negative outside, and walks in it.

    The distance changes by at most one metre per metre, so its interpolation is accurate to 0.71
    cells, and a position at two cells from the walls is at least 1.29 cells from them.
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
                f"{arena.name}: no position is {1.5 * self.margin_m:g} m from its walls; expected "
                "a larger arena"
            )
        self.distance_m = distance.reshape(nx, ny)

    def walk(
        self, x: float, y: float, theta: float, lengths: np.ndarray, turns: np.ndarray
    ) -> np.ndarray:
        """Return the positions of a walk from a pose, ``(n + 1, 2)``."""
        path = np.empty((len(lengths) + 1, 2))
        path[0] = x, y
        lengths, turns = map(np.ascontiguousarray, (lengths, turns))
        given: list[Any] = [path, theta, lengths, turns, self.distance_m]
        given += [*self.low, self.cell_m, self.margin_m, _ESCAPES]
        if steps.ENABLED:
            walk_steps(*given)
            return path
        # Nested lists: reading single numbers is five times as fast as from an array.
        slow = [part.tolist() if isinstance(part, np.ndarray) else part for part in given]
        walk_steps.plain(*slow)
        return np.array(slow[0])


def ratinabox_walk(arena: Arena, minutes: float, seed: int, rate_hz: float = 20.0) -> Walk:
    """Simulate a walk with RatInABox (George et al. 2024); needs the extra ``rodent``.

    Args:
        arena: The arena; circles are approximated by polygons.
        minutes: Duration.
        seed: Seed of numpy's global generator, which RatInABox uses; its state is restored.
        rate_hz: Positions per second.

    Raises:
        ConfigError: If RatInABox is not installed.
        SourceError: If a number is not positive.
    """
    _above_0(arena.name, "length", minutes, "minutes")
    _above_0(arena.name, "rate", rate_hz, "Hz")
    try:
        from ratinabox.Agent import Agent  # pyright: ignore[reportMissingImports]
        from ratinabox.Environment import Environment  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ConfigError(
            f"RatInABox cannot be imported ({error}); pip install neuroslam[rodent], or use roam"
        ) from None
    n = max(1, round(60.0 * minutes * rate_hz))
    before = np.random.get_state()
    np.random.seed(seed)
    try:
        boundary, *holes = (line[:-1] for line in arena.outlines[: 1 + len(arena.holes)])
        most = max(map(len, holes), default=0)  # RatInABox needs equally many corners of each hole
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
    r"""Filter white noise to an Ornstein-Uhlenbeck process of mean 0 and standard deviation 1.

    .. math:: x_0 = n_0, \quad x_k = a_k x_{k-1} + \sqrt{1 - a_k^2}\, n_k, \quad
        a_k = e^{-(t_k - t_{k-1}) / \tau}

    The recurrence is exact for any intervals [Uhlenbeck and Ornstein 1930].

    Args:
        normals: Independent standard normal numbers :math:`n`, ``(..., n)``.
        times_s: Rising times in seconds, ``(n,)``.
        time_constant_s: :math:`\tau`.

    Returns:
        The process, of the shape of ``normals``.

    Example:
        >>> ornstein_uhlenbeck(np.array([1.0, 0.0]), np.array([0.0, 2.0]), 2.0).round(4).tolist()
        [1.0, 0.3679]
    """
    out = np.array(normals, np.float64)
    last, n = 1, len(times_s)
    elapsed = np.diff(times_s, prepend=times_s[:1]) / time_constant_s
    out[..., 1:] *= np.sqrt(-np.expm1(-2.0 * elapsed[1:]))
    while last < n:
        # The recurrence as a cumulative sum of growing terms, in sections that cannot overflow.
        grown = np.cumsum(elapsed[last:])
        size = max(1, int(np.searchsorted(grown, 300.0, side="right")))
        growth = np.exp(np.minimum(grown[:size], 300.0))
        section = out[..., last : last + size]
        section[...] = (out[..., last - 1 : last] + np.cumsum(growth * section, axis=-1)) / growth
        last += size
    return out


def _spikes(arrays: dict[str, np.ndarray], path: Path) -> np.ndarray | None:
    if "spikes_s" not in arrays:
        return None
    spikes = arrays["spikes_s"]
    if spikes.ndim != 1 or spikes.dtype.kind not in "fiu":
        raise SourceError(
            f"{path}: spikes_s has shape {spikes.shape}; expected times (m,) in seconds"
        )
    return np.asarray(spikes[np.isfinite(spikes)], np.float64)


def _above_0(name: str, what: str, value: float, unit: str) -> None:
    if not (math.isfinite(value) and value > 0):
        raise SourceError(f"{name}: {what} is {value} {unit}; expected a number above 0")
