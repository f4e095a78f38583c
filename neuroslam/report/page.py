"""Assembly of facts, pictures, style and scripts into one HTML file."""

import base64
import html
import json
import math
import zlib
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from neuroslam.errors import RunError
from neuroslam.report.collect import Facts, collect
from neuroslam.report.pictures import Pictures, take_pictures
from neuroslam.report.reading import read_run
from neuroslam.runs.files import run_files, write_text

SCRIPTS = (
    "data.js", "view.js", "map.js", "marks.js", "charts.js", "cells.js", "panels.js", "tables.js",
    "player.js",
)  # fmt: skip
"""Scripts of the page, in order of dependence."""

PICTURES_MB = 12.0
"""Default size of all pictures of a page, in 1e6 bytes."""

_TYPES = {"f": "<f4", "i": "<i4", "u": "<u1"}
_EXACT = ("row_time_s",)  # Unix times have more digits than four bytes hold


def write_report(
    out: str | Path,
    to: str | Path | None = None,
    *,
    pictures_mb: float = PICTURES_MB,
    source: bool = False,
) -> Path:
    """Write one HTML page about a run: its map, frames, cells and metrics.

    The page is self-contained: it needs no network, no server and no other file.

    Args:
        out: Folder that ``run``, ``resume`` or ``merge`` wrote.
        to: File to write; ``report.html`` in that folder if not given.
        pictures_mb: Largest size of all pictures of frames, in 1e6 bytes of the page; 0: no
            pictures.
        source: Open the recordings and cameras that the folder names, and the folders of the maps
            that it names, for pictures of frames. Off: nothing but the folder is opened, and only
            rendered worlds have pictures; a folder from elsewhere can name any file and address.

    Returns:
        The file written.

    Raises:
        RunError: If the folder holds no run or a damaged one, or the page cannot be written.
        CheckpointError: If the brain cannot be loaded.
    """
    out = Path(out)
    to = out / "report.html" if to is None else Path(to)
    if not (math.isfinite(pictures_mb) and pictures_mb >= 0.0):
        raise RunError(f"--pictures {pictures_mb}: expected megabytes, 0 or more; 0 for none")
    if to.is_dir():
        raise RunError(f"{to}: is a folder; expected a file to write")
    if to.resolve() in {(out / name).resolve() for name in run_files(out)}:
        raise RunError(f"{to}: is a file of the run and would be overwritten; give another name")
    run = read_run(out)
    page = make_page(collect(run), take_pictures(run, int(1e6 * pictures_mb), source))
    try:
        write_text(to, page)
    except OSError as error:
        raise RunError(f"{to}: cannot be written ({error.strerror or error})") from None
    return to


def make_page(facts: Facts, pictures: Pictures) -> str:
    """Return the HTML of a page.

    Args:
        facts: Content of the page.
        pictures: Pictures of frames.
    """
    arrays = facts.arrays | {"place_picture": pictures.place, "picture_row": pictures.row}
    index, packed = pack(arrays)
    about = facts.about | {"picture_notes": pictures.notes, "arrays": index}
    thumbnails = [base64.b64encode(file).decode() for file in pictures.files]
    folder = files("neuroslam.report")
    parts = {
        "title": html.escape(facts.about["name"]),
        "style": (folder / "page.css").read_text(encoding="utf-8"),
        "about": as_json(about),
        "arrays": packed,
        "pictures": as_json(thumbnails),
        "script": "\n".join((folder / name).read_text(encoding="utf-8") for name in SCRIPTS),
    }
    page = (folder / "page.html").read_text(encoding="utf-8")
    head, *rest = page.split("{{")
    for piece in rest:  # inserted text is not scanned again: a name may contain braces
        name, _, after = piece.partition("}}")
        head += parts[name] + after
    return head


def pack(arrays: dict[str, np.ndarray]) -> tuple[dict[str, Any], str]:
    """Pack arrays into one text: compressed bytes in base64, and the offset of each array.

    Numbers are little-endian with four bytes, except times (eight) and ``uint8`` (one).

    Returns:
        Type, shape and offset in bytes of each array; and the text.

    Example:
        >>> index, text = pack({"x": np.arange(4, dtype=np.int32)})
        >>> index, np.frombuffer(zlib.decompress(base64.b64decode(text)), "<i4").tolist()
        ({'x': ['<i4', [4], 0]}, [0, 1, 2, 3])
    """
    index, chunks, at = {}, [], 0
    for name, array in arrays.items():
        kind = "<f8" if name in _EXACT else _TYPES[array.dtype.kind]
        data = np.ascontiguousarray(array, dtype=kind).tobytes()
        data += bytes(-len(data) % 8)  # arrays begin at multiples of eight bytes
        index[name] = [kind, list(array.shape), at]
        chunks.append(data)
        at += len(data)
    return index, base64.b64encode(zlib.compress(b"".join(chunks), 9)).decode()


def as_json(value: object) -> str:
    r"""Write JSON for a script element: without ``<``, it cannot end the element.

    Example:
        >>> as_json({"name": "</script>"})
        '{"name":"\\u003c/script>"}'
    """
    text = json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c")
