"""Files that are written whole or not at all: safetensors with config and checksum. No pickle."""

import hashlib
import json
import os
import re
import struct
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, uint8

from neuroslam.errors import CheckpointError, first_line, require_utf8
from neuroslam.limits import fits, parse_json, too_much

_KEY = "neuroslam"  # one metadata key: safetensors does not keep the order of several


def write_atomically(path: Path, write: Callable[[Path], object]) -> None:
    """Write a file beside ``path``, flush it to the disk, and only then give it its name.

    Whatever goes wrong, ``path`` is the old file or the new one, never a part of one.

    Args:
        path: The file to write or to replace.
        write: Writes the content to the path it is given.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".tmp", dir=path.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        write(temporary)
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)  # mkstemp makes it private; a result is not
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def sync_folder(path: Path) -> None:
    """Write the names in a folder to the disk, so that a rename outlasts a power cut."""
    if os.name != "posix":
        return
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def tensors_digest(tensors: dict[str, Tensor]) -> str:
    """Return the SHA-256 over names, dtypes, shapes and bytes of tensors, in order of name."""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        tensor = tensors[name].contiguous().cpu()
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)};".encode())
        digest.update(tensor.reshape(-1).view(uint8).numpy().data if tensor.numel() else b"")
    return digest.hexdigest()


def content_digest(about: dict[str, Any], tensors: dict[str, Tensor]) -> str:
    """Return the SHA-256 over tensors and all that is known about them but ``sha256`` itself."""
    known = {name: value for name, value in about.items() if name != "sha256"}
    text = json.dumps(known, sort_keys=True)
    return hashlib.sha256(f"{text}{tensors_digest(tensors)}".encode()).hexdigest()


def save_checked(path: str | Path, about: dict[str, Any], tensors: dict[str, Tensor]) -> str:
    """Write tensors and what is known about them to one file.

    The file is written beside ``path``, flushed to the disk and then renamed: whatever happens,
    ``path`` is the old file or the new one.

    Args:
        path: Usually ends in ``.safetensors``.
        about: ``format``, a number, and whatever belongs to the kind of file.
        tensors: The state; it is not changed.

    Returns:
        The digest of the content, which the file holds too.

    Raises:
        OSError: If it cannot be written.
    """
    tensors = {name: t.detach().cpu().contiguous() for name, t in tensors.items()}
    digest = content_digest(about, tensors)
    text = json.dumps(about | {"sha256": digest}, sort_keys=True)

    def write(file: Path) -> None:
        try:
            save_file(tensors, file, metadata={_KEY: text})
        except SafetensorError as error:  # of a disk that is full, for one
            number = re.search(r"\(os error (\d+)\)", str(error))
            if number is None:
                raise
            raise OSError(int(number[1]), os.strerror(int(number[1]))) from None

    write_atomically(Path(path), write)
    sync_folder(Path(path).parent)
    return digest


def stored_digest(path: str | Path) -> str:
    """Read the digest that a file of :func:`save_checked` holds; empty if it is no such file."""
    try:
        with safe_open(path, framework="pt") as file:
            return str(json.loads((file.metadata() or {})[_KEY])["sha256"])
    except (SafetensorError, OSError, ValueError, KeyError, TypeError, RecursionError):
        return ""


def load_checked(
    path: str | Path, kind: str, newest: int, whole: int
) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Read and check a file: what is known about it, and its tensors.

    Args:
        path: The file.
        kind: What it should be, ``"brain"`` or another.
        newest: Highest format that can be read.
        whole: First format whose digest covers all that is known too; that of older ones covers
            the tensors only.

    Raises:
        CheckpointError: In one line, what is wrong: missing, not such a file, a pickle, truncated,
            of a newer format, or altered since it was written.
    """
    path = Path(path)
    if not path.is_file():
        raise CheckpointError(f"{path}: no such {kind} file")
    require_utf8(path, CheckpointError)
    if not fits(needed := 3 * path.stat().st_size):  # mapped, copied, and the brain's own
        raise CheckpointError(f"{path}: {too_much(needed)}")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, ValueError) as error:
        _say_if_a_pickle(path, kind)
        raise CheckpointError(
            f"{path}: damaged, not readable as safetensors ({first_line(error)}); "
            "restore it from a copy"
        ) from None
    try:
        about: dict[str, Any] = parse_json(metadata[_KEY])
        version, digest = about["format"], about["sha256"]
        if type(version) is not int:
            raise TypeError(version)
    except (KeyError, ValueError, TypeError, RecursionError):
        raise CheckpointError(
            f"{path}: a safetensors file, but not one that neuroslam wrote"
        ) from None
    if about.get("kind", "brain") != kind:
        raise CheckpointError(f"{path}: a {about.get('kind', 'brain')} file, not a {kind} file")
    if version > newest:
        raise CheckpointError(
            f"{path}: format {version}, this neuroslam reads up to {newest}; upgrade it"
        )
    if digest != (content_digest(about, tensors) if version >= whole else tensors_digest(tensors)):
        raise CheckpointError(
            f"{path}: its content does not match its SHA-256, it was altered or damaged; "
            "restore it from a copy"
        )
    return about, tensors


def _say_if_a_pickle(path: Path, kind: str) -> None:
    with path.open("rb") as file:
        head = file.read(8)
    if head[:2] == b"PK" or head[:1] == b"\x80":
        raise CheckpointError(
            f"{path}: a pickle (as torch.save writes), which can run code when read; "
            "neuroslam reads only its own safetensors files"
        )
    size = path.stat().st_size
    if len(head) < 8 or struct.unpack("<Q", head)[0] > size - 8:
        raise CheckpointError(f"{path}: truncated ({size} bytes) or not a {kind} file")
