"""Files that are written whole or not at all: safetensors with config and checksum. No pickle."""

import hashlib
import json
import os
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


def tensors_digest(tensors: dict[str, Tensor]) -> str:
    """Return the SHA-256 over names, dtypes, shapes and bytes of tensors, in order of name."""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        tensor = tensors[name].contiguous().cpu()
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)};".encode())
        digest.update(tensor.reshape(-1).view(uint8).numpy().data if tensor.numel() else b"")
    return digest.hexdigest()


def save_checked(path: str | Path, about: dict[str, Any], tensors: dict[str, Tensor]) -> None:
    """Write tensors and what is known about them to one file.

    The file is written beside ``path``, flushed to the disk and then renamed: whatever happens,
    ``path`` is the old file or the new one.

    Args:
        path: Usually ends in ``.safetensors``.
        about: ``format``, a number, and whatever belongs to the kind of file.
        tensors: The state; it is not changed.
    """
    tensors = {name: t.detach().cpu().contiguous() for name, t in tensors.items()}
    text = json.dumps(about | {"sha256": tensors_digest(tensors)}, sort_keys=True)
    write_atomically(Path(path), lambda file: save_file(tensors, file, metadata={_KEY: text}))


def load_checked(
    path: str | Path, kind: str, newest: int
) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Read and check a file: what is known about it, and its tensors.

    Args:
        path: The file.
        kind: What it should be, ``"brain"`` or another.
        newest: Highest format that can be read.

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
        version, digest = int(about["format"]), str(about["sha256"])
    except (KeyError, ValueError, TypeError, OverflowError):
        raise CheckpointError(
            f"{path}: a safetensors file, but not one that neuroslam wrote"
        ) from None
    if about.get("kind", "brain") != kind:
        raise CheckpointError(f"{path}: a {about.get('kind', 'brain')} file, not a {kind} file")
    if version > newest:
        raise CheckpointError(
            f"{path}: format {version}, this neuroslam reads up to {newest}; upgrade it"
        )
    if tensors_digest(tensors) != digest:
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
