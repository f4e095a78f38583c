"""One file for a whole brain: safetensors, checked, written at once or not at all. No pickle."""

import hashlib
import json
import struct
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from neuroslam.brain.brain import NavigationBrain
from neuroslam.brain.sessions import Session, session_id
from neuroslam.config import BrainConfig, build_config
from neuroslam.errors import CheckpointError, ConfigError
from neuroslam.storage import write_atomically

FORMAT_VERSION = 2
_KEY = "neuroslam"  # one metadata key: safetensors does not keep the order of several


def tensors_digest(tensors: dict[str, Tensor]) -> str:
    """Return the SHA-256 over names, dtypes, shapes and bytes of tensors, in order of name."""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        tensor = tensors[name].contiguous().cpu()
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)};".encode())
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy() if tensor.numel() else b"")
    return digest.hexdigest()


def save_brain(brain: NavigationBrain, path: str | Path) -> None:
    """Write config and complete state of a brain to one file.

    The file is written beside ``path``, flushed to the disk and then renamed: whatever happens,
    ``path`` is the old brain or the new one.

    Args:
        brain: The brain; it is not changed.
        path: Usually ends in ``.safetensors``.
    """
    tensors = {name: t.detach().cpu().contiguous() for name, t in brain.state_dict().items()}
    about = {
        "format": FORMAT_VERSION,
        "config": brain.config.model_dump(mode="json"),
        "sha256": tensors_digest(tensors),
    }
    text = json.dumps(about, sort_keys=True)
    write_atomically(Path(path), lambda file: save_file(tensors, file, metadata={_KEY: text}))


def read_checkpoint(path: str | Path) -> tuple[BrainConfig, dict[str, Tensor]]:
    """Read and check a brain file: its config and its state dict.

    Raises:
        CheckpointError: In one line, what is wrong: missing, not a brain file, a pickle,
            truncated, of a newer format, altered since it was written, or an unusable config.
    """
    path = Path(path)
    if not path.is_file():
        raise CheckpointError(f"{path}: no such brain file")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, ValueError) as error:
        _say_if_a_pickle(path)
        raise CheckpointError(
            f"{path}: damaged, not readable as safetensors ({_first_line(error)}); "
            "restore it from a copy"
        ) from None
    try:
        about: dict[str, Any] = json.loads(metadata[_KEY])
        version, digest = int(about["format"]), str(about["sha256"])
    except (KeyError, ValueError, TypeError):
        raise CheckpointError(
            f"{path}: a safetensors file, but not one that neuroslam wrote"
        ) from None
    if version > FORMAT_VERSION:
        raise CheckpointError(
            f"{path}: format {version}, this neuroslam reads up to {FORMAT_VERSION}; upgrade it"
        )
    if tensors_digest(tensors) != digest:
        raise CheckpointError(
            f"{path}: its content does not match its SHA-256, it was altered or damaged; "
            "restore it from a copy"
        )
    try:
        config = build_config(about.get("config", {}), origin=str(path))
    except ConfigError as error:
        raise CheckpointError(str(error)) from None
    return config, tensors if version == FORMAT_VERSION else _upgraded(tensors, config, digest)


def load_brain(path: str | Path) -> NavigationBrain:
    """Load a brain; going on with it is bit-equal to never having stopped.

    Raises:
        CheckpointError: If the file cannot be used; one line says why.
    """
    config, tensors = read_checkpoint(path)
    brain = NavigationBrain(config)
    try:
        brain.load_state_dict(tensors)
    except (RuntimeError, ValueError, KeyError, TypeError) as error:
        raise CheckpointError(
            f"{path}: its state does not fit its config ({_first_line(error)})"
        ) from None
    return brain


def _upgraded(tensors: dict[str, Tensor], config: BrainConfig, digest: str) -> dict[str, Tensor]:
    """Bring a state of format 1, which knew no sessions, to the present one: it is one session."""
    brain = NavigationBrain(config)
    session = session_id(digest)
    brain.sessions.sessions.append(Session(session, frames=int(tensors["clock.frames_seen"])))
    fresh = brain.state_dict()
    places, blocks = "map.experiences.template", "view.templates.blocks"
    tensors = {name: tensors.get(name, value) for name, value in fresh.items()}
    n = len(tensors[places])
    tensors["map.experiences.session"] = torch.full((n,), session)
    tensors["map.experiences.number"] = torch.arange(n)
    tensors["map.state.session"] = torch.tensor(session)
    tensors["map.state.made"] = torch.tensor(n)
    more = fresh[blocks].shape[1] - tensors[blocks].shape[1]
    tensors[blocks] = torch.nn.functional.pad(tensors[blocks], (0, more))
    return tensors


def _say_if_a_pickle(path: Path) -> None:
    with path.open("rb") as file:
        head = file.read(8)
    if head[:2] == b"PK" or head[:1] == b"\x80":
        raise CheckpointError(
            f"{path}: a pickle (as torch.save writes), which can run code when read; "
            "neuroslam reads only its own safetensors files"
        )
    size = path.stat().st_size
    if len(head) < 8 or struct.unpack("<Q", head)[0] > size - 8:
        raise CheckpointError(f"{path}: truncated ({size} bytes) or not a brain file")


def _first_line(error: Exception) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[1] if len(lines) > 1 and lines[0].endswith(":") else (lines or ["?"])[0]
