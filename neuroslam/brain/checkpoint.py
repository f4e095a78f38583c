"""One file for a whole brain: safetensors, checked, written at once or not at all. No pickle."""

import warnings
from pathlib import Path

import torch
from torch import Tensor, nn

from neuroslam.brain.brain import NavigationBrain
from neuroslam.config import BrainConfig, build_config
from neuroslam.errors import CheckpointError, ConfigError, RenamedKeyWarning
from neuroslam.state.files import first_line, load_checked, save_checked
from neuroslam.state.sessions import Session, session_id

FORMAT_VERSION = 4


def save_brain(brain: NavigationBrain, path: str | Path) -> None:
    """Write config and complete state of a brain to one file, at once or not at all.

    Args:
        brain: The brain; it is not changed.
        path: Usually ends in ``.safetensors``.
    """
    about = {"format": FORMAT_VERSION, "config": brain.config.model_dump(mode="json")}
    save_checked(path, about, brain.state_dict())


def read_checkpoint(path: str | Path) -> tuple[BrainConfig, dict[str, Tensor]]:
    """Read and check a brain file: its config and its state dict.

    Raises:
        CheckpointError: In one line, what is wrong: missing, not a brain file, a pickle,
            truncated, of a newer format, altered since it was written, or an unusable config.
    """
    about, tensors = load_checked(path, "brain", FORMAT_VERSION)
    try:
        with warnings.catch_warnings(action="ignore", category=RenamedKeyWarning):
            config = build_config(about.get("config", {}), origin=str(path))
    except ConfigError as error:
        raise CheckpointError(str(error)) from None
    if about["format"] == 1:
        tensors = _of_one_session(tensors, config, about["sha256"])
    elif about["format"] == 2:
        tensors = _with_compass(tensors, config)
    if about["format"] < 4:
        tensors = _without_unused(tensors, config)
    return config, tensors


def load_brain(path: str | Path, *, features: nn.Module | None = None) -> NavigationBrain:
    """Load a brain; going on with it is bit-equal to never having stopped.

    Args:
        path: The file.
        features: The network that makes its views, where it was passed to the brain that was
            saved: files hold maps, and of a network only which it was.

    Raises:
        ConfigError: If a network is passed to a brain that has another.
        CheckpointError: If the file cannot be used; one line says why.
    """
    config, tensors = read_checkpoint(path)
    brain = NavigationBrain(config, features=features)
    try:
        brain.load_state_dict(tensors)
    except (RuntimeError, ValueError, KeyError, TypeError) as error:
        raise CheckpointError(
            f"{path}: its state does not fit its config ({first_line(error)})"
        ) from None
    return brain


def _with_compass(tensors: dict[str, Tensor], config: BrainConfig) -> dict[str, Tensor]:
    """Bring a state of format 2, which knew no compass, to the present one."""
    brains = [name.removesuffix("clock.frame") for name in tensors if name.endswith("clock.frame")]
    fresh = NavigationBrain(config).compass.state_dict()
    return tensors | {f"{one}compass.{name}": v for one in brains for name, v in fresh.items()}


def _without_unused(tensors: dict[str, Tensor], config: BrainConfig) -> dict[str, Tensor]:
    """Drop what formats up to 3 had besides: the time of a gap, pose cells that nothing used."""
    unused = (".after_gap_s",) if "pose" in config.cells else (".after_gap_s", ".pose_cells")
    return {
        name: value
        for name, value in tensors.items()
        if not any(f"{part}." in f".{name}." for part in unused)
    }


def _of_one_session(
    tensors: dict[str, Tensor], config: BrainConfig, digest: str
) -> dict[str, Tensor]:
    """Bring a state of format 1, which knew no sessions, to the present one: it is one session."""
    brain = NavigationBrain(config)
    session = session_id(digest)
    brain.sessions.sessions.append(Session(session, frames=int(tensors["clock.frames_seen"])))
    fresh = brain.state_dict()
    places, blocks = "map.experiences.template", "view.templates.blocks"
    tensors = {name: tensors[name] if name in tensors else fresh[name] for name in fresh}
    n = len(tensors[places])
    tensors["map.experiences.session"] = torch.full((n,), session)
    tensors["map.experiences.number"] = torch.arange(n)
    tensors["map.state.session"] = torch.tensor(session)
    tensors["map.state.made"] = torch.tensor(n)
    more = fresh[blocks].shape[1] - tensors[blocks].shape[1]
    tensors[blocks] = torch.nn.functional.pad(tensors[blocks], (0, more))
    return tensors
