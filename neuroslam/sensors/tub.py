"""Tubs, the recordings of donkeycar, version 2: images, times, steering and throttle.

``manifest.json`` has five lines of JSON, the last with the names of the catalogs and the numbers of
deleted records; each line of a catalog is a record. Steering and throttle are commands between -1
and 1, not measured motion: they are kept beside (:attr:`TubSource.controls`), and the motion comes
from the images.
"""

from pathlib import Path
from typing import Any

import numpy as np

from neuroslam.errors import SourceError, counted
from neuroslam.limits import MOST_JSON_BYTES, parse_json, read_bounded
from neuroslam.sensors.images import ImageFile, ImageSource
from neuroslam.types import GreyRule

_CONTROLS = ("user/angle", "user/throttle")


class TubSource(ImageSource):
    """The images of a tub.

    Attributes:
        controls: Steering and throttle of each frame, ``(n, 2)``, NaN where the tub has none.
    """

    controls: np.ndarray


def is_tub(path: Path) -> bool:
    """Return whether a folder is a tub: by its manifest and a catalog."""
    manifest = path / "manifest.json"
    return manifest.is_file() and next(path.glob("*.catalog"), None) is not None


def open_tub(path: Path, frame_rate_hz: float, grey: GreyRule = "luma") -> TubSource:
    """Open a tub; its records are in the order of ``_index``, without those that were deleted.

    Raises:
        SourceError: If the manifest or a catalog is damaged, or it has no records with images.
    """
    manifest = path / "manifest.json"
    try:
        lines = [parse_json(line) for line in _lines(manifest)]
        about = next(line for line in reversed(lines) if isinstance(line, dict) and "paths" in line)
        deleted = {int(number) for number in about.get("deleted_indexes", [])}
        catalogs = [path / Path(str(name)).name for name in about["paths"]]
    except (ValueError, TypeError, StopIteration):
        raise SourceError(
            f"{manifest}: is damaged; expected the manifest of a donkeycar tub"
        ) from None
    records: dict[int, dict[str, Any]] = {}
    for catalog in catalogs:
        for number, line in enumerate(_lines(catalog), start=1):
            try:
                record = parse_json(line)
                records[int(record["_index"])] = record
            except (ValueError, TypeError, KeyError):
                raise SourceError(
                    f"{catalog}: line {number} is damaged; expected a record with _index"
                ) from None
    kept = [records[index] for index in sorted(records.keys() - deleted)]
    kept = [record for record in kept if isinstance(record.get("cam/image_array"), str)]
    if not kept:
        raise SourceError(f"{path}: has no records with images; expected cam/image_array")
    names = [Path(record["cam/image_array"]).name for record in kept]
    stamps = _numbers(kept, ("_timestamp_ms",))[:, 0]
    times = None if np.isnan(stamps).any() else stamps / 1000.0
    notes = []
    if found := len(records.keys() & deleted):
        are = counted(found, "deleted record is", "deleted records are")
        notes.append(f"{path}: {are} left out")
    images = [ImageFile(name, path / "images" / name) for name in names]
    source = TubSource(str(path), images, times, frame_rate_hz, grey=grey, notes=tuple(notes))
    source.controls = _numbers(kept, _CONTROLS)
    return source


def _lines(path: Path) -> list[bytes]:
    try:
        return [line for line in read_bounded(path, MOST_JSON_BYTES).splitlines() if line.strip()]
    except OSError as error:
        raise SourceError(f"{path}: cannot be read ({error.strerror or error})") from None
    except ValueError as error:
        raise SourceError(f"{path}: {error}") from None


def _numbers(records: list[dict[str, Any]], keys: tuple[str, ...]) -> np.ndarray:
    """Return numbers of the records, ``(n, keys)``; NaN where one is missing or no number."""
    return np.array([[_number(record.get(key)) for key in keys] for record in records])


def _number(value: object) -> float:
    if isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e18:
        return float(value)
    return np.nan
