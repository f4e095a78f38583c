"""The brain: everything composed, and its one-file checkpoint."""

from neuroslam.brain.brain import NavigationBrain
from neuroslam.brain.checkpoint import load_brain, read_checkpoint, save_brain

__all__ = ["NavigationBrain", "load_brain", "read_checkpoint", "save_brain"]
