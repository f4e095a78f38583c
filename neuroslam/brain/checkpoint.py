"""Checkpoints: one safetensors file per brain, checked, written atomically, without pickle."""

import warnings
from pathlib import Path

import torch
from torch import Tensor, nn

from neuroslam.brain.brain import NavigationBrain
from neuroslam.brain.soundness import faults_of
from neuroslam.brain.stored_sequence import StoredSequence
from neuroslam.config import BrainConfig, build_config
from neuroslam.errors import CheckpointError, ConfigError, RenamedKeyWarning, first_line
from neuroslam.state.files import load_checked, save_checked
from neuroslam.state.sessions import Session, session_id

FORMAT_VERSION = 8


def save_brain(brain: NavigationBrain, path: str | Path) -> str:
    """Write config and complete state of a brain to one file, atomically.

    Args:
        brain: The brain; it is not changed.
        path: File, usually with the suffix ``.safetensors``.

    Returns:
        SHA-256 of config and state.
    """
    about = {"format": FORMAT_VERSION, "config": brain.config.model_dump(mode="json")}
    return save_checked(path, about, brain.state_dict())


def read_checkpoint(path: str | Path) -> tuple[BrainConfig, dict[str, Tensor]]:
    """Read and check a brain file; return its config and state dict.

    Raises:
        CheckpointError: If the file is missing, no brain file, a pickle, truncated, of a newer
            format, altered since it was written, or has an invalid config.
    """
    about, tensors = load_checked(path, "brain", FORMAT_VERSION, whole=5)
    if not isinstance(about.get("config"), dict):
        raise CheckpointError(f"{path}: has no config; restore it from a copy")
    try:
        with warnings.catch_warnings(action="ignore", category=RenamedKeyWarning):
            config = build_config(about["config"], origin=str(path))
    except ConfigError as error:
        raise CheckpointError(str(error)) from None
    if about["format"] == 1:
        tensors = _of_one_session(tensors, config, about["sha256"])
    elif about["format"] == 2:
        tensors = _with_compass(tensors, config)
    if about["format"] < 4:
        tensors = _without_unused(tensors, config)
    if about["format"] < 6:
        tensors = _beside_paths(tensors)
    if about["format"] < 7:
        tensors = _after_calm(tensors)
    if about["format"] < 8:
        tensors = _without_stored_sequence(tensors, config)
    return config, tensors


def load_brain(path: str | Path, *, features: nn.Module | None = None) -> NavigationBrain:
    """Load a brain, which continues bit for bit like one that never stopped.

    Args:
        path: The file.
        features: The network that computes its views, if one was passed to the saved brain: the
            file holds only a digest of the network.

    Raises:
        ConfigError: If another network is passed than the brain was saved with.
        CheckpointError: If the file cannot be used.
    """
    config, tensors = read_checkpoint(path)
    brain = NavigationBrain(config, features=features)
    faults = faults_of(tensors, brain)
    if faults:
        more = f"; {len(faults) - 1} more, see neuroslam verify" if len(faults) > 1 else ""
        raise CheckpointError(f"{path}: its state does not fit its config ({faults[0]}{more})")
    try:
        brain.load_state_dict(tensors)
    except (RuntimeError, ValueError, KeyError, TypeError) as error:
        raise CheckpointError(
            f"{path}: its state does not fit its config ({first_line(error)})"
        ) from None
    return brain


def _with_compass(tensors: dict[str, Tensor], config: BrainConfig) -> dict[str, Tensor]:
    """Convert a state of format 2, which has no compass."""
    brains = [name.removesuffix("clock.frame") for name in tensors if name.endswith("clock.frame")]
    fresh = NavigationBrain(config).compass.state_dict()
    return tensors | {f"{one}compass.{name}": v for one in brains for name, v in fresh.items()}


def _without_unused(tensors: dict[str, Tensor], config: BrainConfig) -> dict[str, Tensor]:
    """Drop what formats up to 3 had in addition: the time of a gap, unused pose cells."""
    unused = (".after_gap_s",) if "pose" in config.cells else (".after_gap_s", ".pose_cells")
    return {
        name: value
        for name, value in tensors.items()
        if not any(f"{part}." in f".{name}." for part in unused)
    }


def _beside_paths(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Convert a state of formats up to 5, whose maps place the robot by odometry alone."""
    maps = [name.removesuffix("current") for name in tensors if name.endswith("map.state.current")]
    return tensors | {f"{one}on_path": torch.tensor(0) for one in maps}


def _after_calm(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Convert a state of formats up to 6, which have no largest recent change of the view."""
    ends = "continuity.state.usual"
    calm = torch.tensor(0.0, dtype=torch.float64)
    known = [name.removesuffix("usual") for name in tensors if name.endswith(ends)]
    return tensors | {f"{one}recent": calm.clone() for one in known}


def _without_stored_sequence(tensors: dict[str, Tensor], config: BrainConfig) -> dict[str, Tensor]:
    """Convert a state of formats up to 7, without evidence for the stored maps."""
    ends = "tracker.state.mode"
    tracked = [name.removesuffix(ends) for name in tensors if name.endswith(ends)]
    fresh = StoredSequence(config.sequence).state_dict()
    return tensors | {
        f"{one}recognition.sequence.{name}": value.clone()
        for one in tracked
        for name, value in fresh.items()
    }


def _of_one_session(
    tensors: dict[str, Tensor], config: BrainConfig, digest: str
) -> dict[str, Tensor]:
    """Convert a state of format 1, which has no sessions, to one session."""
    brain = NavigationBrain(config)
    session = session_id(digest)
    brain.sessions.sessions.append(Session(session, frames=int(tensors["clock.frames_seen"])))
    fresh = brain.state_dict()
    experiences, blocks = "map.experiences.template", "view.templates.blocks"
    tensors = {name: tensors[name] if name in tensors else fresh[name] for name in fresh}
    n = len(tensors[experiences])
    tensors["map.experiences.session"] = torch.full((n,), session)
    tensors["map.experiences.number"] = torch.arange(n)
    tensors["map.state.session"] = torch.tensor(session)
    tensors["map.state.made"] = torch.tensor(n)
    more = fresh[blocks].shape[1] - tensors[blocks].shape[1]
    tensors[blocks] = torch.nn.functional.pad(tensors[blocks], (0, more))
    return tensors
