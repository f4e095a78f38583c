"""Trajectories of animals as laboratories store them: tables, NWB, RatInABox, pynapple.

:func:`read_animal_track` reads all of them by one rule, and :func:`open_animal_track` does by name:
``track:FILE?x=px&y=py&units=cm,deg,ms``, which is what ``--columns`` and ``--units`` stand for.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from neuroslam.errors import ConfigError, SourceError, counted
from neuroslam.geometry import TWO_PI
from neuroslam.sensors.options import split_track
from neuroslam.sensors.tracks import usable_times
from neuroslam.worlds.arena import Arena, named_arena
from neuroslam.worlds.rodent import Walk
from neuroslam.worlds.senses import NO_NOISE, ArenaSource
from neuroslam.worlds.track_files import (
    FASTEST_M_S,
    NAMES,
    RawTrack,
    as_raw,
    find_columns,
    parse_units,
    read_track_file,
)

_FARTHEST_M = 1e8  # farther than coordinates of any map
_HULL_M = 0.02  # by how much the outline of a track may differ from its hull


def read_animal_track(
    track: Any,  # noqa: ANN401 - a path, or an object of another package
    *,
    columns: Mapping[str, str] | None = None,
    units: str = "",
    arena: Arena | str | None = "hull",
    smooth_s: float = 0.0,
    fastest_m_s: float = FASTEST_M_S,
) -> Walk:
    r"""Read the trajectory of an animal.

    Samples without a position (tracking lost) are left out: the animal goes straight to the next
    one. What was found, left out or cannot be is in ``notes`` of the walk.

    Args:
        track: A CSV, an ``.npz`` with ``pos`` and ``t`` (and ``hd``), an ``.nwb``; or a RatInABox
            ``Agent`` with a history; or a pynapple ``TsdFrame``.
        columns: Name of the column of ``t``, ``x``, ``y`` and ``hd`` (head direction); those that
            are not given are found by usual names.
        units: Units of a table, as ``cm,deg,ms``; those not given are metres, radians, seconds.
        arena: The arena, or the name of one; ``"hull"``: that of the track, or the outline of the
            positions, where it has none; ``None``: no walls.
        smooth_s: Standard deviation of a Gaussian that smooths the positions; 0: none.
        fastest_m_s: Faster steps are counted and reported.

    Raises:
        SourceError: If the track cannot be read, has fewer than two samples, or leaves the arena.
        ConfigError: If a unit or a column is unknown, or a package is missing.

    Example:
        >>> import tempfile, pathlib
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "rat.csv"
        >>> _ = path.write_text("time,px,py\n0,0,0\n500,10,0\n1000,10,10\n")
        >>> walk = read_animal_track(path, units="cm,ms", arena=None)
        >>> walk.times_s.tolist(), walk.positions.tolist()
        ([0.0, 0.5, 1.0], [[0.0, 0.0], [0.1, 0.0], [0.1, 0.1]])
    """
    raw = _read(track, dict(columns or {}), units)
    usable = (np.abs(raw.positions) < _FARTHEST_M).all(axis=1)  # not NaN
    usable &= usable_times(np.where(usable, raw.times_s, np.nan))
    if usable.sum() < 2:
        raise SourceError(
            f"{raw.name}: {int(usable.sum())} of {counted(len(usable), 'row')} have a position and "
            "a rising time; expected at least 2"
        )
    times, positions = raw.times_s[usable], raw.positions[usable]
    notes = [*raw.notes, *_gaps(raw.name, raw.times_s, usable)]
    if not (math.isfinite(smooth_s) and smooth_s >= 0.0):
        raise SourceError(f"{raw.name}: smoothing is {smooth_s} s; expected 0 or more")
    if smooth_s > times[-1] - times[0]:
        raise SourceError(
            f"{raw.name}: smoothing is {smooth_s:g} s, and the track lasts "
            f"{times[-1] - times[0]:.3g} s; expected less"
        )
    if smooth_s > 0.0:
        from scipy.ndimage import gaussian_filter1d

        sigma = smooth_s / float(np.median(np.diff(times)))
        positions = gaussian_filter1d(positions, sigma, axis=0, mode="nearest")
    speeds = np.linalg.norm(np.diff(positions, axis=0), axis=1) / np.diff(times)
    fast = np.flatnonzero(speeds > fastest_m_s)
    if len(fast):
        notes.append(
            f"{raw.name}: {counted(len(fast), 'step')} faster than {fastest_m_s:g} m/s, "
            f"the fastest {speeds.max():.3g} m/s at "
            f"{times[speeds.argmax() + 1]:.3f} s: jumps of the tracking, or "
            "another unit (units=cm); smooth=0.1 smooths them"
        )
    place = raw.arena if arena == "hull" else arena
    if isinstance(place, str):
        place = named_arena(place)
    if arena == "hull" and place is None and raw.walled:
        place = hull_of(positions, raw.name)
        x_min, x_max, y_min, y_max = place.bounds
        notes.append(
            f"{raw.name}: has no arena; the outline of the track is taken, "
            f"{counted(place.n_walls, 'wall')}, {x_max - x_min:.2f} m by {y_max - y_min:.2f} m"
        )
    if place is not None:
        place.check_inside(positions)
    walk = Walk.along(raw.name, times, positions, place)
    if raw.headings_rad is not None:
        headings = _filled(raw.name, times, raw.headings_rad[usable])
        walk = replace(walk, headings_rad=headings)
    return replace(walk, notes=tuple(notes))


def hull_of(positions: np.ndarray, name: str = "track") -> Arena:
    """Return the arena around positions: their convex hull with few corners, which holds them all.

    Example:
        >>> box = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0.5, 0.5], [0.5, 0.0]])
        >>> hull_of(box).n_walls
        4
    """
    import cv2

    origin = positions.mean(axis=0)
    points = np.ascontiguousarray(positions - origin, np.float32)
    hull = cv2.convexHull(points[:, None])
    few = np.empty((0, 2))
    if len(hull) >= 3:
        few = cv2.approxPolyDP(hull, _HULL_M, True)[:, 0].astype(np.float64) + origin
    if len(few) < 3:
        raise SourceError(f"{name}: its positions lie on a line; give the arena")
    middle = few.mean(axis=0)
    for widened in np.linspace(1.0 + 1e-6, 2.0, 201):
        arena = Arena(middle + widened * (few - middle), name=f"outline of {name}")
        if arena.contains(positions).all():
            return arena
    raise SourceError(f"{name}: no outline of its positions was found; give the arena")


def open_animal_track(spec: str) -> ArenaSource:
    """Open ``track:FILE?t=time&x=px&y=py&hd=head&units=cm,deg,ms&arena=hull&smooth=0.1``.

    Raises:
        SourceError, ConfigError: If the track cannot be read, or an option is unknown.
    """
    name, _, query = split_track(spec)
    options: dict[str, str] = {}
    for part in filter(None, query.split("&")):
        key, _, value = part.partition("=")
        options[key] = value
    columns = {key: options.pop(key) for key in NAMES if key in options}
    arena = options.pop("arena", "hull")
    units, smooth = options.pop("units", ""), options.pop("smooth", "0")
    if options:
        raise SourceError(
            f"{spec}: unknown option {next(iter(options))!r}; expected t, x, y, hd, units, arena, "
            "smooth"
        )
    try:
        smooth_s = float(smooth)
    except ValueError:
        raise SourceError(f"{spec}: smooth is {smooth!r}; expected seconds") from None
    path = Path(name)
    if not path.is_file():
        raise SourceError(f"{path}: no such file; expected a CSV, an .npz or an .nwb")
    walk = read_animal_track(
        path, columns=columns, units=units, arena=None if arena == "none" else arena,
        smooth_s=smooth_s,
    )  # fmt: skip
    return ArenaSource(walk, NO_NOISE)


def track_spec(
    source: str,
    columns: str | None = None,
    units: str | None = None,
    arena: str | None = None,
    smooth_s: float | None = None,
) -> str:
    """Return the name of a track for :func:`open_animal_track` from options of the command line.

    Raises:
        SourceError: If the columns are not ``t=NAME,x=NAME,...``.

    Example:
        >>> track_spec("rat.csv", "x=px,y=py", "cm")
        'track:rat.csv?x=px&y=py&units=cm'
    """
    parts = [part.strip() for part in (columns or "").split(",") if part.strip()]
    for part in parts:
        if part.partition("=")[0] not in NAMES or not part.partition("=")[2]:
            raise SourceError(f"--columns {columns}: expected t=NAME,x=NAME,y=NAME,hd=NAME")
    for key, value in (("units", units), ("arena", arena), ("smooth", smooth_s)):
        parts += [] if value is None else [f"{key}={value}"]
    name, _, query = split_track(source)
    return f"track:{name}?{'&'.join([*filter(None, [query]), *parts])}"


def _read(track: Any, columns: dict[str, str], units: str) -> RawTrack:  # noqa: ANN401
    unknown = columns.keys() - NAMES.keys()
    if unknown:
        raise ConfigError(f"columns: unknown {min(unknown)!r}; expected t, x, y, hd")
    if isinstance(track, str | Path):
        return read_track_file(Path(track), columns, units)
    if hasattr(track, "history") and hasattr(track, "Environment"):
        return _of_agent(track)
    if hasattr(track, "as_dataframe") and hasattr(track, "columns"):
        return _of_pynapple(track, columns, units)
    raise SourceError(
        f"{type(track).__name__}: is no trajectory; expected a path, a RatInABox Agent or a "
        "pynapple TsdFrame"
    )


def _of_agent(agent: Any) -> RawTrack:  # noqa: ANN401
    history, environment = agent.history, agent.Environment
    name = str(getattr(agent, "name", "agent"))
    positions = np.array(history["pos"], np.float64)
    if len(positions) < 2 or positions.shape[1] != 2:
        raise SourceError(f"{name}: its history has no path in two dimensions; update it first")
    directions = np.array(history.get("head_direction", ()), np.float64)
    heading = (
        np.arctan2(directions[:, 1], directions[:, 0])
        if len(directions) == len(positions)
        else None
    )
    notes: tuple[str, ...] = ()
    arena, walled = None, True
    if environment.boundary_conditions == "periodic":
        size = np.asarray(environment.extent, np.float64).reshape(2, 2)
        period = size[:, 1] - size[:, 0]
        positions = np.column_stack(
            [np.unwrap(x, period=float(p)) for x, p in zip(positions.T, period, strict=True)]
        )
        notes, walled = (f"{name}: a periodic environment; the path is unwrapped, no walls",), False
    else:
        n_outer = len(environment.boundary)
        inner = sum(len(hole) for hole in environment.holes)
        arena = Arena(
            environment.boundary,
            [np.asarray(hole) for hole in environment.holes],
            list(np.asarray(environment.walls).reshape(-1, 2, 2)[n_outer + inner :]),
            name=name,
        )
    return RawTrack(
        name, np.array(history["t"], np.float64), positions, heading, arena, notes, walled
    )


def _of_pynapple(frame: Any, columns: dict[str, str], units: str) -> RawTrack:  # noqa: ANN401
    values, times = np.asarray(frame.values, np.float64), np.asarray(frame.times(), np.float64)
    header = [str(column) for column in frame.columns]
    found = find_columns("TsdFrame", ["t", *header], {"t": "t"} | columns)
    table = {"t": times} | {k: values[:, header.index(n)] for k, n in found.items() if k != "t"}
    given = parse_units(units)
    return as_raw("TsdFrame", table, found, given._replace(time=given.time or 1.0))


def _gaps(name: str, times_s: np.ndarray, usable: np.ndarray) -> list[str]:
    lost = int((~usable).sum())
    if not lost:
        return []
    kept = times_s[usable]
    steps = np.diff(kept)
    longest = float(steps[np.diff(np.flatnonzero(usable)) > 1].max(initial=0.0))
    return [
        f"{name}: {counted(lost, 'sample')} of {len(usable)} without a position or a rising time, "
        f"left out; the longest gap is {longest:.2f} s"
    ]


def _filled(name: str, times_s: np.ndarray, headings_rad: np.ndarray) -> np.ndarray:
    """Interpolate the headings that are missing, and wrap all to [-pi, pi)."""
    known = np.isfinite(headings_rad)
    if not known.any():
        raise SourceError(f"{name}: its head direction has no number; leave out the column")
    if not known.all():
        unwrapped = np.unwrap(headings_rad[known])
        headings_rad = np.interp(times_s, times_s[known], unwrapped)
    return (headings_rad + math.pi) % TWO_PI - math.pi
