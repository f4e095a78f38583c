"""Brain-inspired SLAM in PyTorch: from a video to a map that can be saved, queried and drawn."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from neuroslam.brain import NavigationBrain, load_brain, save_brain
    from neuroslam.config import BrainConfig
    from neuroslam.runs.activity import record
    from neuroslam.runs.run import run
    from neuroslam.sensors import open_source
    from neuroslam.state.activity import ActivityLog

__version__ = "0.1.0"

_HOME = {
    "ActivityLog": "neuroslam.state.activity",
    "NavigationBrain": "neuroslam.brain",
    "load_brain": "neuroslam.brain",
    "save_brain": "neuroslam.brain",
    "BrainConfig": "neuroslam.config",
    "open_source": "neuroslam.sensors",
    "record": "neuroslam.runs.activity",
    "run": "neuroslam.runs.run",
}

__all__ = [
    "ActivityLog", "BrainConfig", "NavigationBrain", "load_brain", "open_source", "record", "run",
    "save_brain",
]  # fmt: skip


def __getattr__(name: str) -> Any:  # noqa: ANN401
    """Import the public names when they are first used: ``neuroslam --help`` needs no torch."""
    if name in _HOME:
        return getattr(import_module(_HOME[name]), name)
    raise AttributeError(f"module 'neuroslam' has no attribute {name!r}")
