"""Trajectories of animals as laboratories store them: tables, NWB, RatInABox, pynapple.

:func:`read_animal_track` reads all of them by one rule, and :func:`open_animal_track` does by name:
``track:FILE?x=px&y=py&units=cm,deg,ms``, which is what ``--columns`` and ``--units`` stand for.
"""

import csv
import math
from collections.abc import Mapping
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from neuroslam.errors import ConfigError, SourceError, counted
from neuroslam.geometry import TWO_PI
from neuroslam.sensors.images import read_text
from neuroslam.sensors.times import in_seconds
from neuroslam.sensors.tracks import SLOWEST_S, read_positions, rising
from neuroslam.worlds.arena import Arena, named_arena
from neuroslam.worlds.rodent import ARENA_KEYS, Walk
from neuroslam.worlds.senses import NO_NOISE, ArenaSource

FASTEST_M_S = 2.0
"""Speed above which a step of a rat is reported as a jump of the tracking."""

_HULL_M = 0.02  # by how much the outline of a track may differ from its hull
_NAMES = {
    "t": ("time_s", "time", "t", "timestamp", "timestamps", "seconds", "time_ms"),
    "x": ("x_m", "x", "px", "pos_x", "x_cm", "x_pos", "position_x", "posx", "xpos"),
    "y": ("y_m", "y", "py", "pos_y", "y_cm", "y_pos", "position_y", "posy", "ypos"),
    "hd": ("hd", "head_direction", "hd_rad", "heading", "heading_rad", "theta_rad", "hd_deg",
           "head", "head_dir", "yaw", "angle"),
}  # fmt: skip
_LENGTHS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "meters": 1.0, "metres": 1.0, "meter": 1.0,
            "centimeters": 0.01, "centimetres": 0.01, "millimeters": 0.001}  # fmt: skip
_ANGLES = {"rad": 1.0, "deg": math.pi / 180.0, "radians": 1.0, "degrees": math.pi / 180.0}
_TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}


class _Raw(NamedTuple):
    """A track as it was stored: metres, seconds and radians, NaN where tracking was lost."""

    name: str
    times_s: np.ndarray
    positions: np.ndarray
    headings_rad: np.ndarray | None
    arena: Arena | None
    notes: tuple[str, ...] = ()
    walled: bool = True  # a track without an arena may have walls


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
    usable = np.isfinite(raw.positions).all(axis=1)
    usable &= rising(np.where(usable, raw.times_s, np.nan))
    if usable.sum() < 2:
        raise SourceError(
            f"{raw.name}: {int(usable.sum())} of {counted(len(usable), 'row')} have a position and "
            "a rising time; expected at least 2"
        )
    times, positions = raw.times_s[usable], raw.positions[usable]
    notes = [*raw.notes, *_gaps(raw.name, raw.times_s, usable)]
    if not (math.isfinite(smooth_s) and smooth_s >= 0.0):
        raise SourceError(f"{raw.name}: smoothing is {smooth_s} s; expected 0 or more")
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
        walk = replace(walk, headings_rad=_filled(times, raw.headings_rad[usable]))
    return replace(walk, notes=tuple(notes))


def hull_of(positions: np.ndarray, name: str = "track") -> Arena:
    """Return the arena around positions: their convex hull with few corners, which holds them all.

    Example:
        >>> box = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0.5, 0.5], [0.5, 0.0]])
        >>> hull_of(box).n_walls
        4
    """
    import cv2

    points = np.ascontiguousarray(positions, np.float32)
    hull = cv2.convexHull(points[:, None])
    few = cv2.approxPolyDP(hull, _HULL_M, True)[:, 0].astype(np.float64)
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
    name, _, query = spec.removeprefix("track:").partition("?")
    options: dict[str, str] = {}
    for part in filter(None, query.split("&")):
        key, _, value = part.partition("=")
        options[key] = value
    columns = {key: options.pop(key) for key in _NAMES if key in options}
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
        if part.partition("=")[0] not in _NAMES or not part.partition("=")[2]:
            raise SourceError(f"--columns {columns}: expected t=NAME,x=NAME,y=NAME,hd=NAME")
    for key, value in (("units", units), ("arena", arena), ("smooth", smooth_s)):
        parts += [] if value is None else [f"{key}={value}"]
    name, _, query = source.removeprefix("track:").partition("?")
    return f"track:{name}?{'&'.join([*filter(None, [query]), *parts])}"


def _read(track: Any, columns: dict[str, str], units: str) -> _Raw:  # noqa: ANN401
    unknown = columns.keys() - _NAMES.keys()
    if unknown:
        raise ConfigError(f"columns: unknown {min(unknown)!r}; expected t, x, y, hd")
    if isinstance(track, str | Path):
        path = Path(track)
        suffix = path.suffix.lower()
        if suffix == ".nwb":
            return _read_nwb(path)
        return _read_npz(path, units) if suffix == ".npz" else _read_csv(path, columns, units)
    if hasattr(track, "history") and hasattr(track, "Environment"):
        return _of_agent(track)
    if hasattr(track, "as_dataframe") and hasattr(track, "columns"):
        return _of_pynapple(track, columns, units)
    raise SourceError(
        f"{type(track).__name__}: is no trajectory; expected a path, a RatInABox Agent or a "
        "pynapple TsdFrame"
    )


def _scales(units: str) -> tuple[float, float, float | None]:
    length, angle, time = 1.0, 1.0, None
    for unit in filter(None, (u.strip().lower() for u in units.split(","))):
        if unit in _LENGTHS:
            length = _LENGTHS[unit]
        elif unit in _ANGLES:
            angle = _ANGLES[unit]
        elif unit in _TIMES:
            time = _TIMES[unit]
        else:
            raise ConfigError(
                f"units: unknown {unit!r}; expected m, cm, mm, rad, deg, s, ms, us, ns"
            )
    return length, angle, time


def _read_csv(path: Path, columns: dict[str, str], units: str) -> _Raw:
    rows = [row for row in csv.reader(read_text(path).splitlines()) if row]
    if len(rows) < 3:
        raise SourceError(
            f"{path}: has {counted(len(rows), 'row')}; expected a header and positions"
        )
    header = [field.strip().lstrip("#").strip() for field in rows[0]]
    table = np.full((len(rows) - 1, len(header)), np.nan)
    for i, row in enumerate(rows[1:]):
        for k, field in enumerate(row[: len(header)]):
            try:
                table[i, k] = float(field)
            except ValueError:  # a lost sample
                continue
    found = _found(str(path), header, columns)
    return _scaled(str(path), {key: table[:, header.index(n)] for key, n in found.items()},
                   found, units, None)  # fmt: skip


def _found(name: str, header: list[str], columns: dict[str, str]) -> dict[str, str]:
    lowered = {field.lower(): field for field in header}
    found = {}
    for key, usual in _NAMES.items():
        if key in columns:
            if columns[key] not in header:
                raise ConfigError(
                    f"{name}: has no column {columns[key]!r}; it has: {', '.join(header)[:200]}"
                )
            found[key] = columns[key]
        else:
            there = next((lowered[one] for one in usual if one in lowered), None)
            if there is not None:
                found[key] = there
    missing = [key for key in ("t", "x", "y") if key not in found]
    if missing:
        raise SourceError(
            f"{name}: no column for {', '.join(missing)} among {', '.join(header)[:200]}; name "
            f"them: --columns {','.join(f'{key}=NAME' for key in missing)}"
        )
    return found


def _scaled(
    name: str,
    table: dict[str, np.ndarray],
    names: dict[str, str],
    units: str,
    arena: Arena | None,
) -> _Raw:
    length, angle, time = _scales(units)
    given = {unit.strip().lower() for unit in units.split(",")}
    if not given & _LENGTHS.keys() and names.get("x", "").lower().endswith("_cm"):
        length = 0.01
    if not given & _ANGLES.keys() and names.get("hd", "").lower().endswith("_deg"):
        angle = _ANGLES["deg"]
    times = table["t"] * time if time else in_seconds(table["t"], slowest_s=SLOWEST_S)[0]
    heading = table["hd"] * angle if "hd" in table else None
    positions = length * np.column_stack([table["x"], table["y"]])
    which = ", ".join(f"{key} = {column}" for key, column in names.items())
    return _Raw(name, times, positions, heading, arena, (f"{name}: columns {which}",))


def _read_npz(path: Path, units: str) -> _Raw:
    arrays, times, positions, notes = read_positions(path)
    length, angle, time = _scales(units)
    raw_times = np.asarray(arrays["t"], np.float64) * time if time else times
    arena = Arena.from_arrays(arrays) if any(key in arrays for key in ARENA_KEYS) else None
    heading = np.asarray(arrays["hd"], np.float64) * angle if "hd" in arrays else None
    assert raw_times is not None  # an .npz has t
    return _Raw(str(path), raw_times, length * positions, heading, arena, notes)


def _read_nwb(path: Path) -> _Raw:
    try:
        pynwb: Any = import_module("pynwb")
    except ImportError as error:
        raise ConfigError(
            f"pynwb cannot be imported ({error}); pip install neuroslam[neuro]"
        ) from None
    try:
        with pynwb.NWBHDF5IO(str(path), "r") as io:
            series = [each for each in io.read().objects.values()
                      if type(each).__name__ == "SpatialSeries"]  # fmt: skip
            place = heading = None
            for one in series:
                parent = type(one.parent).__name__
                data = np.asarray(one.data[:], np.float64) * one.conversion
                data = data + (one.offset or 0.0)
                if one.timestamps is not None:
                    times = np.asarray(one.timestamps[:], np.float64)
                else:
                    times = (one.starting_time or 0.0) + np.arange(len(data)) / one.rate
                unit = str(one.unit).lower()
                if data.ndim == 2 and data.shape[1] >= 2 and parent != "CompassDirection":
                    if place is None or parent == "Position":
                        place = times, data[:, :2] * _LENGTHS.get(unit, 1.0), one.name
                elif parent == "CompassDirection":
                    heading = times, data.reshape(len(data)) * _ANGLES.get(unit, 1.0)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise SourceError(f"{path}: is no readable NWB file ({error})") from None
    if place is None:
        raise SourceError(f"{path}: has no SpatialSeries with x and y; expected Position")
    times, positions, name = place
    turned = None
    if heading is not None:
        turned = heading[1]
        if len(turned) != len(times) or not np.array_equal(heading[0], times):
            turned = np.interp(times, heading[0], np.unwrap(turned))
    return _Raw(str(path), times, positions, turned, None, (f"{path}: positions of {name!r}",))


def _of_agent(agent: Any) -> _Raw:  # noqa: ANN401
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
    return _Raw(name, np.array(history["t"], np.float64), positions, heading, arena, notes, walled)


def _of_pynapple(frame: Any, columns: dict[str, str], units: str) -> _Raw:  # noqa: ANN401
    values, times = np.asarray(frame.values, np.float64), np.asarray(frame.times(), np.float64)
    header = [str(column) for column in frame.columns]
    found = _found("TsdFrame", ["t", *header], {"t": "t"} | columns)
    table = {"t": times} | {k: values[:, header.index(n)] for k, n in found.items() if k != "t"}
    _, _, time = _scales(units)
    return _scaled("TsdFrame", table, found, units if time else f"{units},s", None)


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


def _filled(times_s: np.ndarray, headings_rad: np.ndarray) -> np.ndarray:
    """Interpolate the headings that are missing, and wrap all to [-pi, pi)."""
    known = np.isfinite(headings_rad)
    if not known.any():
        raise SourceError("the recorded head direction has no number")
    if not known.all():
        unwrapped = np.unwrap(headings_rad[known])
        headings_rad = np.interp(times_s, times_s[known], unwrapped)
    return (headings_rad + math.pi) % TWO_PI - math.pi
