"""The manifest of a run's folder: a digest of every file that belongs to its last save."""

import hashlib
import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from neuroslam.errors import CheckpointError, RunError, first_line
from neuroslam.runs.saves import settle
from neuroslam.state.activity import ACTIVITY
from neuroslam.state.arrays import array_names, digest_of_rows, rows_of
from neuroslam.state.files import stored_digest, write_atomically

MANIFEST = "manifest.json"
ROWS = ("frames.csv", "trace.f64")
"""The files with one row per frame: they may be longer than they were when they were saved."""

_FORMAT = 1
_BRAIN = "brain.safetensors"


class Extent(NamedTuple):
    """The part of a file that belongs to a save: its first bytes, and their SHA-256."""

    bytes: int
    sha256: str


def extent_of(path: Path, n_bytes: int | None = None) -> Extent:
    """Measure a file, or its first bytes.

    Raises:
        OSError: If it cannot be read.
    """
    digest, n = hashlib.sha256(), 0
    with path.open("rb") as file:
        while block := file.read(1 << 20 if n_bytes is None else min(1 << 20, n_bytes - n)):
            digest.update(block)
            n += len(block)
    return Extent(n, digest.hexdigest())


def activity_entry(folder: Path) -> dict[str, Any]:
    """Return the number of samples in a record of the cells' activity, and their SHA-256.

    Raises:
        CheckpointError: If it is damaged.
    """
    rows = min((rows_of(folder, name) for name in array_names(folder)), default=0)
    return {"rows": rows, "sha256": digest_of_rows(folder, rows)}


def write_manifest(staged: Path, rows: Mapping[str, Extent], activity: Path | None = None) -> None:
    """List the files of a save.

    Args:
        staged: Folder that holds all other files of the save. Pictures are left out: they can be
            drawn again, and other versions of matplotlib draw them differently.
        rows: Files that grow by one row per frame, wherever they are: what the save has of them.
        activity: Folder of the recorded activity of a run that has ended. While the run goes on it
            has no entry, as all of it, which may be gigabytes, would be read at every save.
    """
    files: dict[str, dict[str, Any]] = {name: extent._asdict() for name, extent in rows.items()}
    for path in sorted(staged.iterdir()):
        if path.name == _BRAIN:  # it holds the digest of its content
            files[path.name] = {"sha256": stored_digest(path)}
        elif path.is_file() and path.suffix != ".png" and path.name not in rows:
            files[path.name] = extent_of(path)._asdict()
    if activity is not None:
        files[ACTIVITY] = activity_entry(activity)
    content = {"format": _FORMAT, "files": files}
    text = json.dumps(content | {"sha256": _digest(content)}, indent=2, sort_keys=True)
    write_atomically(staged / MANIFEST, lambda path: path.write_text(text, encoding="utf-8"))


def read_manifest(out: Path) -> dict[str, dict[str, Any]] | None:
    """Read what belongs to the last save of a run: ``bytes`` and ``sha256`` of each file.

    Returns:
        Entry by name; ``None`` for a folder without a manifest, as versions before it wrote.

    Raises:
        RunError: If the manifest is damaged, or of a newer version.
    """
    path = out / MANIFEST
    if not path.exists():
        return None
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        digest = content.pop("sha256")
        if digest != _digest(content):
            raise ValueError("its content does not match its SHA-256")
        if content["format"] > _FORMAT:
            raise RunError(
                f"{path}: format {content['format']}, this neuroslam reads up to {_FORMAT}; "
                "upgrade it"
            )
        files: dict[str, dict[str, Any]] = content["files"]
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise RunError(
            f"{path}: damaged ({error}); restore the folder from a copy, or remove the file to go "
            "without its digests"
        ) from None
    return files


def check_saved(path: str | Path) -> None:
    """Check that a file of a run is that of its last save, by its digest in the manifest.

    A file that the manifest does not list, and a folder without one, pass.

    Raises:
        RunError: If the file is missing, or was altered or damaged since it was saved.
    """
    path = Path(path)
    settle(path.parent)
    while True:
        files = read_manifest(path.parent)
        entry = None if files is None else files.get(path.name)
        if entry is None:
            return
        fault = _fault(path, entry)
        settle(path.parent)
        if not fault or read_manifest(path.parent) == files:
            break  # no other process has saved meanwhile
    if fault:
        raise RunError(f"{path}: {fault}")


def copy_saved(path: Path, to: Path) -> None:
    """Copy a file of a run as it was saved, without the rows that were written after.

    Raises:
        RunError: As for :func:`check_saved`.
        OSError: If it cannot be copied.
    """
    check_saved(path)
    entry = (read_manifest(path.parent) or {}).get(path.name)
    shutil.copyfile(path, to)
    if entry is not None:
        os.truncate(to, entry["bytes"])


def manifest_faults(out: Path) -> list[str]:
    """Return a line for each file of the manifest that is missing or differs."""
    files = read_manifest(out) or {}
    return [
        f"{out / name}: {fault}" for name, entry in files.items()
        if (fault := _fault(out / name, entry))
    ]  # fmt: skip


def _fault(path: Path, entry: Mapping[str, Any]) -> str:
    try:
        if path.name == _BRAIN:
            same = stored_digest(path) in ("", entry["sha256"])  # "": loading says what is wrong
        elif path.name == ACTIVITY:
            same = digest_of_rows(path, int(entry["rows"])) == entry["sha256"]
        else:
            part = entry["bytes"] if path.name in ROWS else None
            same = extent_of(path, part)._asdict() == entry
    except CheckpointError as error:
        return first_line(error)
    except (OSError, KeyError, TypeError, ValueError) as error:
        return f"cannot be read ({getattr(error, 'strerror', None) or error})"
    if same:
        return ""
    return (
        f"differs from what was saved ({MANIFEST}); restore it from a copy, or, if you changed it "
        f"yourself, remove {MANIFEST}"
    )


def _digest(content: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
