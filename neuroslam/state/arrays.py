"""A folder of arrays that grow by rows, in the public format Zarr version 2, uncompressed.

An array is a folder with its shape in ``.zarray`` and one file of raw numbers for each block of
rows and columns; a block that is missing holds zeros. Rows are written into their blocks before the
shape counts them, so a process that is killed leaves whole rows, and no index to repair.
"""

import hashlib
import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from neuroslam.errors import CheckpointError
from neuroslam.limits import (
    MOST_JSON_BYTES,
    check_regular,
    fits,
    parse_json,
    read_bounded,
    too_much,
)

ROWS = 512
"""Rows of a block."""

_NARROW = 64  # columns of a block of an array that begins with fewer


class ArrayFolder:
    """Writes arrays that grow by rows, and by columns, which are 0 in the rows before.

    Args:
        path: The folder, created if missing; it must be empty.
        attributes: Of the whole folder, stored as JSON.
    """

    def __init__(self, path: Path, attributes: Mapping[str, Any]) -> None:
        self.path = path
        self._arrays: dict[str, dict[str, Any]] = {}
        path.mkdir(parents=True, exist_ok=True)
        _write_json(path / ".zgroup", {"zarr_format": 2})
        self.describe(attributes)

    @classmethod
    def reopen(cls, path: Path, rows: int) -> "ArrayFolder":
        """Open a folder to write on after so many rows; the rows after them are forgotten."""
        folder = cls.__new__(cls)
        folder.path, folder._arrays = path, {}
        for name in array_names(path):
            about = _about(path, name)
            about["shape"][0] = rows
            folder._arrays[name] = about
            # The blocks after the last row may hold numbers, where a missing cell has to be 0.
            for block in (path / name).glob("[0-9]*"):
                first = int(block.name.partition(".")[0]) * about["chunks"][0]
                if first >= rows:
                    block.unlink()
                elif first + about["chunks"][0] > rows:
                    size = block.stat().st_size
                    with block.open("r+b") as file:
                        file.truncate((rows - first) * (size // about["chunks"][0]))
                        file.truncate(size)
            _write_json(path / name / ".zarray", about)
        return folder

    def describe(self, attributes: Mapping[str, Any], name: str = "") -> None:
        """Store the attributes of the folder, or of one of its arrays."""
        _write_json(self.path / name / ".zattrs", dict(attributes))

    def append(self, start: int, blocks: Mapping[str, np.ndarray]) -> None:
        """Write rows of some arrays from a row on, and count them in all arrays.

        Args:
            start: Number of the first row.
            blocks: Rows by the name of the array, ``(n,)`` or ``(n, columns)``.

        Raises:
            OSError: If the folder cannot be written.
        """
        end = start
        for name, rows in blocks.items():
            end = start + len(rows)
            about = self._arrays.setdefault(name, {}) or self._begin(name, rows)
            if rows.ndim > 1:
                about["shape"][1] = max(about["shape"][1], rows.shape[1])
            self._write(name, about, start, rows)
        for name, about in self._arrays.items():
            about["shape"][0] = end
            _write_json(self.path / name / ".zarray", about)

    def _begin(self, name: str, rows: np.ndarray) -> dict[str, Any]:
        (self.path / name).mkdir(exist_ok=True)
        width = list(rows.shape[1:])
        about = self._arrays[name] = {
            "zarr_format": 2,
            "shape": [0, *width],
            "chunks": [ROWS, *(max(w, min(_NARROW, 4 * w)) if w > 2 else w for w in width)],
            "dtype": rows.dtype.str,
            "compressor": None,
            "fill_value": 0,
            "order": "C",
            "filters": None,
        }
        return about

    def _write(self, name: str, about: dict[str, Any], start: int, rows: np.ndarray) -> None:
        columns = about["chunks"][1] if rows.ndim > 1 else 1
        row_bytes = columns * rows.dtype.itemsize
        table = rows if rows.ndim > 1 else rows[:, None]
        first = 0
        while first < len(table):
            block, offset = divmod(start + first, ROWS)
            part = table[first : first + ROWS - offset]
            for c in range(math.ceil(table.shape[1] / columns)):
                some = part[:, c * columns : (c + 1) * columns]
                if some.shape[1] < columns:
                    some = np.pad(some, ((0, 0), (0, columns - some.shape[1])))
                file_name = f"{block}.{c}" if rows.ndim > 1 else str(block)
                path = self.path / name / file_name
                with path.open("r+b" if path.exists() else "w+b") as file:
                    file.seek(offset * row_bytes)
                    file.write(np.ascontiguousarray(some).data)
                    if offset + len(part) < ROWS:
                        file.truncate(ROWS * row_bytes)  # a block is whole, or absent
            first += len(part)


def array_names(path: Path) -> list[str]:
    """Return the names of the arrays in a folder, sorted."""
    return sorted(each.parent.name for each in path.glob("*/.zarray"))


def attributes_of(path: Path, name: str = "") -> dict[str, Any]:
    """Return the attributes of a folder of arrays, or of one of them.

    Raises:
        CheckpointError: If it is none.
    """
    return _read_json(path / name / ".zattrs")


def rows_of(path: Path, name: str) -> int:
    """Return the number of rows of an array.

    Raises:
        CheckpointError: If it does not say.
    """
    try:
        rows = int(_about(path, name)["shape"][0])
        if rows < 0:
            raise ValueError(f"{rows} rows")
    except (LookupError, TypeError, ValueError, OverflowError) as error:
        raise CheckpointError(f"{path}/{name}: damaged ({error}); record it again") from None
    return rows


def digest_of_rows(path: Path, rows: int) -> str:
    """Return the SHA-256 of the first rows of all arrays in a folder.

    It stays the same while rows, columns and arrays are added. Blocks are read one by one.

    Raises:
        CheckpointError: If an array is damaged.
    """
    digest = hashlib.sha256()
    for name in array_names(path):
        about = _about(path, name)
        try:
            chunks, dtype = [int(n) for n in about["chunks"]], np.dtype(about["dtype"])
            row_bytes = math.prod(chunks[1:]) * dtype.itemsize
            blocks = {_block_index(block.name, len(chunks)): block
                      for block in (path / name).iterdir()}  # fmt: skip
            for index in sorted(index for index in blocks if index is not None):
                size = check_regular(blocks[index])
                if size > chunks[0] * row_bytes:
                    raise ValueError(f"block {blocks[index].name} has {size} bytes")
                with blocks[index].open("rb") as file:
                    data = file.read(
                        max(0, min(chunks[0], rows - index[0] * chunks[0])) * row_bytes
                    )
                if any(data):
                    digest.update(json.dumps([name, index, chunks, dtype.str]).encode())
                    digest.update(data)
        except (LookupError, TypeError, ValueError, OSError, SyntaxError) as error:
            raise CheckpointError(f"{path}/{name}: damaged ({error}); record it again") from None
    return digest.hexdigest()


def _block_index(name: str, n_axes: int) -> tuple[int, ...] | None:
    """Return the place of a block by the name of its file; ``None`` if it is no block."""
    words = name.split(".")
    if len(words) != n_axes or not all(w.isascii() and w.isdigit() and len(w) < 10 for w in words):
        return None
    return tuple(map(int, words))


def read_array(path: Path, name: str, rows: int | None = None) -> np.ndarray:
    """Read an array, or its first rows, into memory.

    Raises:
        CheckpointError: If it is damaged, or does not fit into the memory that may be used.
    """
    about = _about(path, name)
    try:
        shape = [int(about["shape"][0]) if rows is None else rows, *map(int, about["shape"][1:])]
        chunks, dtype = [int(c) for c in about["chunks"]], np.dtype(about["dtype"])
        if dtype.kind not in "fiu" or min([*shape, *chunks]) < 0 or len(chunks) != len(shape):
            raise ValueError(f"dtype {dtype}, shape {shape}, blocks {chunks}")
        if about["compressor"] is not None or about["order"] != "C":
            raise ValueError("compressed blocks, or columns first")
        needed = math.prod(shape) * dtype.itemsize
        if not fits(needed):
            raise CheckpointError(f"{path}/{name}: {too_much(needed)}")
        whole, block_bytes = np.zeros(shape, dtype), math.prod(chunks) * dtype.itemsize
        for block in (path / name).iterdir():  # not all that there could be
            index = _block_index(block.name, len(shape))
            if index is None or any(
                i * c >= n for i, c, n in zip(index, chunks, shape, strict=True)
            ):
                continue
            if check_regular(block) != block_bytes:
                raise ValueError(f"block {block.name}; expected {block_bytes} bytes")
            part = np.fromfile(block, dtype).reshape(chunks)
            room = whole[
                tuple(slice(i * c, (i + 1) * c) for i, c in zip(index, chunks, strict=True))
            ]
            room[...] = part[tuple(slice(0, n) for n in room.shape)]
    except (LookupError, TypeError, ValueError, OSError, ArithmeticError, SyntaxError) as error:
        raise CheckpointError(f"{path}/{name}: damaged ({error}); record it again") from None
    return whole


def _about(path: Path, name: str) -> dict[str, Any]:
    return _read_json(path / name / ".zarray")


def _read_json(path: Path) -> dict[str, Any]:
    try:
        found = parse_json(read_bounded(path, MOST_JSON_BYTES))
        if not isinstance(found, dict):
            raise ValueError(f"{type(found).__name__} instead of an object")
    except (OSError, ValueError) as error:
        raise CheckpointError(
            f"{path.parent}: no recorded activity ({error}); expected a folder that "
            "`neuroslam run ... --record cells` has written"
        ) from None
    return found


def _write_json(path: Path, value: dict[str, Any]) -> None:
    """Replace a small file; a reader sees the old one or the new one."""
    beside = path.with_name(f"{path.name}.new")
    beside.write_text(json.dumps(value), encoding="utf-8")
    os.replace(beside, path)
