"""One file for a whole semantic map: config, landmarks' names, everything learnt."""

from pathlib import Path

from pydantic import ValidationError

from neuroslam.config.semantic import SSPSLAMConfig
from neuroslam.errors import CheckpointError
from neuroslam.spiking.slam import SSPSLAM
from neuroslam.state.files import first_line, load_checked, save_checked

FORMAT_VERSION = 2
_KIND = "semantic map"


def save_semantic_map(slam: SSPSLAM, path: str | Path) -> None:
    """Write config and complete state to one file, at once or not at all.

    Args:
        slam: It is not changed.
        path: Usually ends in ``.safetensors``.
    """
    about = {
        "format": FORMAT_VERSION,
        "kind": _KIND,
        # The semantic map of a brain has a config with more keys: what its landmarks are.
        "config": slam.given.model_dump(mode="json", include=set(SSPSLAMConfig.model_fields)),
        "names": list(slam.names),
        "batch": slam.batch,
    }
    save_checked(path, about, slam.state_dict())


def load_semantic_map(path: str | Path) -> SSPSLAM:
    """Load a semantic map; going on with it is bit-equal to never having stopped.

    Raises:
        CheckpointError: If the file cannot be used; one line says why.
    """
    about, tensors = load_checked(path, _KIND, FORMAT_VERSION, whole=2)
    try:
        config = SSPSLAMConfig.model_validate(about["config"])
        slam = SSPSLAM(config, tensors["pointers"], about["names"], about["batch"])
        slam.load_state_dict(tensors)
    except (ValidationError, KeyError, RuntimeError, ValueError, TypeError) as error:
        raise CheckpointError(
            f"{path}: its state does not fit its config ({first_line(error)})"
        ) from None
    return slam
