"""Files of an animal's track, and what is in them: positions, times, head direction, an arena."""

import math
import re
import warnings
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from neuroslam.errors import ConfigError, SourceError, first_line
from neuroslam.geometry import TWO_PI
from neuroslam.limits import NotReadableError, check_regular, fits, too_much
from neuroslam.sensors.images import read_text
from neuroslam.sensors.times import in_seconds, parse_time, time_column, unit_note
from neuroslam.sensors.tracks import header_and_rows, read_positions, separator_note
from neuroslam.worlds.arena import Arena
from neuroslam.worlds.rodent import ARENA_KEYS

NAMES = {
    "t": ("time_s", "time", "t", "timestamp", "timestamps", "seconds", "time_ms"),
    "x": ("x", "px", "pos_x", "x_pos", "position_x", "posx", "xpos"),
    "y": ("y", "py", "pos_y", "y_pos", "position_y", "posy", "ypos"),
    "hd": ("hd", "head_direction", "heading", "theta", "head", "head_dir", "yaw", "angle"),
}
"""Usual names of the columns of a table, without units."""

_LENGTHS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "meters": 1.0, "metres": 1.0, "meter": 1.0,
            "centimeters": 0.01, "centimetres": 0.01, "millimeters": 0.001}  # fmt: skip
_ANGLES = {"rad": 1.0, "deg": math.pi / 180.0, "radians": 1.0, "degrees": math.pi / 180.0}
_TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_PIXELS = ("px", "pix", "pixel", "pixels")
_UNIT = re.compile(
    rf"^(.+?)(?:_| *[\[(] *)({'|'.join(sorted((*_LENGTHS, *_ANGLES, *_PIXELS), key=len)[::-1])})"
    r" *[\])]?$"
)
FASTEST_M_S = 2.0
"""Speed above which a step of a rat is reported as a jump of the tracking."""

_ENOUGH = 20  # steps whose median speed shows a wrong unit
_MOST_RAD = TWO_PI + 0.1
"""A larger head direction is in degrees, or unwrapped."""


class RawTrack(NamedTuple):
    """A track as it was stored: metres, seconds and radians, NaN where tracking was lost."""

    name: str
    times_s: np.ndarray
    positions: np.ndarray
    headings_rad: np.ndarray | None
    arena: Arena | None
    notes: tuple[str, ...] = ()
    walled: bool = True  # a track without an arena may have walls


def read_track_file(path: Path, columns: dict[str, str], units: str) -> RawTrack:
    """Read a CSV, an ``.npz`` or an ``.nwb``, by its suffix.

    Raises:
        SourceError: If it cannot be read, or lacks times or positions.
        ConfigError: If a column or a unit is unknown, or a package is missing.
    """
    suffix = path.suffix.lower()
    if suffix == ".nwb":
        return _read_nwb(path)
    if suffix == ".npy":
        raise SourceError(f"{path}: an .npy has no times; expected an .npz with pos and t")
    return _read_npz(path, units) if suffix == ".npz" else _read_csv(path, columns, units)


class Units(NamedTuple):
    """Units that a user gives, as factors to metres, radians and seconds; ``None``: not given."""

    length: float | None
    angle: float | None
    time: float | None


def parse_units(units: str) -> Units:
    """Read ``cm,deg,ms``.

    Raises:
        ConfigError: If a unit is unknown, or two of one quantity are given.

    Example:
        >>> parse_units("cm,ms")
        Units(length=0.01, angle=None, time=0.001)
    """
    found: dict[str, float] = {}
    for unit in filter(None, (u.strip().lower() for u in units.split(","))):
        kind = next((k for k, known in (("length", _LENGTHS), ("angle", _ANGLES), ("time", _TIMES))
                     if unit in known), "")  # fmt: skip
        if not kind:
            raise ConfigError(
                f"units: unknown {unit!r}; expected m, cm, mm, rad, deg, s, ms, us, ns"
            )
        factor = (_LENGTHS | _ANGLES | _TIMES)[unit]
        if found.setdefault(kind, factor) != factor:
            raise ConfigError(f"units: {units} has two units of {kind}; give one")
    return Units(found.get("length"), found.get("angle"), found.get("time"))


def _read_csv(path: Path, columns: dict[str, str], units: str) -> RawTrack:
    header, numbered = header_and_rows(read_text(path), str(path))
    header = [field.strip().lstrip("#").strip() for field in header]
    if not header or not numbered:
        raise SourceError(f"{path}: has no rows; expected a header and positions")
    found = find_columns(str(path), header, columns)
    table = {key: np.full(len(numbered), np.nan) for key in found}
    places = {key: header.index(name) for key, name in found.items()}
    for i, (line, row) in enumerate(numbered):
        if len(row) > len(header) and any(field.strip() for field in row[len(header) :]):
            raise SourceError(
                f"{path}: line {line} has {len(row)} values; expected {len(header)}, with points "
                "in numbers"
            )
        for key, place in places.items():
            text = row[place] if place < len(row) else ""
            try:
                number = parse_time(text) if key == "t" else float(text)
            except ValueError:  # a lost sample
                continue
            table[key][i] = np.nan if number is None else number
    return as_raw(str(path), table, found, parse_units(units))


def find_columns(name: str, header: Sequence[str], columns: Mapping[str, str]) -> dict[str, str]:
    """Find the columns of a table by the names that are given, or else by usual ones.

    Raises:
        ConfigError: If a given column does not exist.
        SourceError: If there is none for ``t``, ``x`` or ``y``, or its name is that of two.
    """
    bare: dict[str, str] = {}
    for field in sorted(header, key=lambda field: _unit_of(field) in _PIXELS):  # those last
        lowered = field.lower()
        for key in (lowered, match[1] if (match := _UNIT.match(lowered)) else lowered):
            bare.setdefault(key, field)
    found = {}
    for key, usual in NAMES.items():
        if key in columns:
            if columns[key] not in header:
                raise ConfigError(
                    f"{name}: has no column {columns[key]!r}; it has: {', '.join(header)[:200]}"
                )
            found[key] = columns[key]
        elif (there := next((bare[one] for one in usual if one in bare), None)) is not None:
            found[key] = there
        elif key == "t" and (time := time_column(header)) is not None:
            found[key] = header[time.index]
    missing = [key for key in ("t", "x", "y") if key not in found]
    if missing:
        raise SourceError(
            f"{name}: no column for {', '.join(missing)} among {', '.join(header)[:200]}; name "
            f"them: --columns {','.join(f'{key}=NAME' for key in missing)}" + separator_note(header)
        )
    for field in found.values():
        if list(header).count(field) > 1:
            raise SourceError(f"{name}: has {header.count(field)} columns {field!r}; expected one")
    return found


def as_raw(
    name: str, table: Mapping[str, np.ndarray], names: Mapping[str, str], units: Units
) -> RawTrack:
    """Convert the columns of a table to metres, seconds and radians.

    A unit that the user gives holds; otherwise that in the name of the column, or else metres,
    radians, and for times what their steps and size show.

    Args:
        name: Of the table, for messages.
        table: The columns ``t``, ``x``, ``y`` and optionally ``hd``, ``(n,)`` each.
        names: How the table calls them.
        units: Given by the user.

    Raises:
        SourceError: If positions are in pixels, or in no stated unit and too fast for metres, or
            head directions in no known unit.
    """
    which = ", ".join(f"{key} = {column}" for key, column in names.items())
    notes = [f"{name}: columns {which}"]
    if units.time:
        times = table["t"] * units.time
    else:
        stated = column.unit if (column := time_column([names["t"]])) else None
        times, unit = in_seconds(table["t"], stated)
        if unit != "s":
            notes.append(unit_note(f"{name}: {names['t']}", stated, unit))
    positions = np.column_stack(
        [table[key] * _metres(name, names[key], units.length) for key in "xy"]
    )
    if units.length is None and not _unit_of(names["x"]):
        _check_speed(name, times, positions)
    heading = None
    if "hd" in table:
        stated_angle = units.angle or _ANGLES.get(_unit_of(names["hd"]))
        heading, found = _radians(f"{name}: {names['hd']}", table["hd"], stated_angle)
        notes += found
    return RawTrack(name, times, positions, heading, None, tuple(notes))


def _unit_of(field: str) -> str:
    match = _UNIT.match(field.lower())
    return match[2] if match else ""


def _check_speed(name: str, times_s: np.ndarray, positions: np.ndarray) -> None:
    """Refuse positions without a stated unit that would be too fast if they were in metres."""
    steps_s = np.diff(times_s)
    moved = np.hypot(*np.diff(positions, axis=0).T)
    usable = np.isfinite(moved) & (steps_s > 0.0)
    if usable.sum() < _ENOUGH:
        return
    speed = float(np.median(moved[usable] / steps_s[usable]))
    if speed > FASTEST_M_S:
        raise SourceError(
            f"{name}: in metres, its median speed is {speed:.3g} m/s; expected at most "
            f"{FASTEST_M_S:g} m/s; state the unit: --units cm, or m (in Python units='cm')"
        )


def _metres(name: str, field: str, given: float | None) -> float:
    unit = _unit_of(field)
    if given is None and unit in _PIXELS:
        raise SourceError(
            f"{name}: column {field!r} is in pixels; convert it, or say of which length a pixel "
            "is: units=cm, units=mm"
        )
    return given or _LENGTHS.get(unit, 1.0)


def _radians(
    what: str, values: np.ndarray, factor: float | None
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Convert head directions to radians; without a known unit their size shows degrees."""
    known = values[np.isfinite(values)]
    if factor not in (None, 1.0) or not len(known) or np.abs(known).max() <= _MOST_RAD:
        return values * (factor or 1.0), ()
    if factor is not None:
        most = known[np.abs(known).argmax()]
        return values, (f"{what}: reaches {most:.4g} rad, more than a turn: is it in degrees?",)
    if known.min() < -180.5 or known.max() > 360.5:
        raise SourceError(
            f"{what} reaches {known[np.abs(known).argmax()]:.4g}; expected radians or degrees of "
            "one turn; say which: units=deg or units=rad"
        )
    return np.radians(values), (f"{what}: head directions are in degrees, as their size shows",)


def _read_npz(path: Path, units: str) -> RawTrack:
    arrays, times, positions, notes = read_positions(path)
    given = parse_units(units)
    raw_times = np.asarray(arrays["t"], np.float64) * given.time if given.time else times
    arena = Arena.from_arrays(arrays) if any(key in arrays for key in ARENA_KEYS) else None
    heading = None
    if "hd" in arrays:
        if arrays["hd"].shape != (len(positions),) or arrays["hd"].dtype.kind not in "fiu":
            raise SourceError(
                f"{path}: hd has shape {arrays['hd'].shape} of {arrays['hd'].dtype}; expected "
                f"numbers ({len(positions)},), as many as positions"
            )
        directions = np.asarray(arrays["hd"], np.float64)
        heading, found = _radians(f"{path}: hd", directions, given.angle)
        notes += found
    assert raw_times is not None  # an .npz has t
    return RawTrack(str(path), raw_times, (given.length or 1.0) * positions, heading, arena, notes)


# --- Neurodata Without Borders --------------------------------------------------------------------


def _read_nwb(path: Path) -> RawTrack:
    try:
        pynwb: Any = import_module("pynwb")
    except ImportError as error:
        raise ConfigError(
            f"pynwb cannot be imported ({error}); pip install neuroslam[neuro]"
        ) from None
    try:
        check_regular(path)
        _require_own_data(path)
        with warnings.catch_warnings(action="ignore"), pynwb.NWBHDF5IO(str(path), "r") as io:
            series = [each for each in io.read().objects.values()
                      if type(each).__name__ == "SpatialSeries"]  # fmt: skip
            return _of_series(path, series)
    except SourceError:
        raise
    except Exception as error:  # HDF5, pynwb and hdmf raise of every kind
        reason = first_line(error) or type(error).__name__
        raise SourceError(f"{path}: is no readable NWB file ({reason[:200]})") from None


def _require_own_data(path: Path) -> None:
    """Refuse a file that names data in other files, which would be opened."""
    import h5py

    def look(group: Any) -> None:  # noqa: ANN401 - of h5py, which has no types
        for name in group:
            link = group.get(name, getlink=True)
            if isinstance(link, h5py.ExternalLink):
                raise NotReadableError(f"{group.name}/{name} is a link to another file")
            if not isinstance(link, h5py.HardLink):
                continue
            item = group[name]
            if item.id in seen:
                continue
            seen.add(item.id)
            if isinstance(item, h5py.Group):
                look(item)
            elif isinstance(item, h5py.Dataset) and (item.external or item.is_virtual):
                raise NotReadableError(f"{item.name} has its data in another file")

    seen: set[Any] = set()
    with h5py.File(path, "r") as file:
        look(file)


def _of_series(path: Path, series: Sequence[Any]) -> RawTrack:
    place = heading = None
    for one in series:
        parent = type(one.parent).__name__
        n_axes = len(one.data.shape)
        turns = parent == "CompassDirection"
        if not turns and (n_axes != 2 or one.data.shape[1] < 2):
            continue
        if not turns and place is not None and parent != "Position":
            continue
        times, data = _samples(path, one)
        if turns:
            heading = times, data.reshape(len(data), -1), one
        else:
            place = times, data[:, :2], one
    if place is None:
        raise SourceError(f"{path}: has no SpatialSeries with x and y; expected Position")
    times, positions, one = place
    notes = [f"{path}: positions of {one.name!r}"]
    seconds, time_unit = in_seconds(times)
    if time_unit != "s":
        notes.append(unit_note(f"{path}: {one.name}", None, time_unit))
    unit = str(one.unit).lower().strip()
    if unit in _PIXELS:
        raise SourceError(f"{path}: positions of {one.name!r} are in {unit}; expected metres")
    if unit not in _LENGTHS:
        notes.append(f"{path}: unit {unit[:40]!r} of {one.name!r} is no length; metres assumed")
    turned = None
    if heading is not None and heading[1].shape[1] == 1:
        at, direction, one = heading
        angle = _ANGLES.get(str(one.unit).lower().strip())
        rad, found = _radians(f"{path}: {one.name}", direction[:, 0], angle)
        notes += found
        turned = _at_times(times, at, rad)
        if not np.isfinite(turned).any():
            raise SourceError(
                f"{path}: no {one.name!r} at the times of {place[2].name!r}; expected one clock"
            )
    elif heading is not None:
        notes.append(f"{path}: {heading[2].name!r} has several columns and is not read")
    positions = positions * _LENGTHS.get(unit, 1.0)
    return RawTrack(str(path), seconds, positions, turned, None, tuple(notes))


def _samples(path: Path, series: Any) -> tuple[np.ndarray, np.ndarray]:  # noqa: ANN401
    """Return times and data of a series of NWB, if they fit into memory and each other."""
    stored = (series.data, series.timestamps)
    needed = 4 * 8 * sum(math.prod(each.shape) for each in stored if each is not None)
    if not fits(needed):
        raise SourceError(f"{path}: {series.name!r} {too_much(needed)}")
    data = np.asarray(series.data[:], np.float64) * series.conversion + (series.offset or 0.0)
    if series.timestamps is not None:
        times = np.asarray(series.timestamps[:], np.float64)
    else:
        times = (series.starting_time or 0.0) + np.arange(len(data)) / series.rate
    if times.shape != (len(data),):
        raise SourceError(f"{path}: {series.name!r} has {len(times)} times for {len(data)} samples")
    return times, data


def _at_times(times_s: np.ndarray, known_s: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Interpolate angles at given times; NaN before the first that is known and after the last."""
    usable = np.isfinite(known_s) & np.isfinite(angles)
    order = np.flatnonzero(usable)[np.argsort(known_s[usable], kind="stable")]
    if not len(order):
        return np.full(len(times_s), np.nan)
    unwrapped = np.unwrap(angles[order])
    return np.interp(times_s, known_s[order], unwrapped, left=np.nan, right=np.nan)
