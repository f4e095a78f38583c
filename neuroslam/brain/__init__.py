"""The brain: odometry, views, map and populations in one module, and its checkpoint file."""

from neuroslam.brain.brain import NavigationBrain
from neuroslam.brain.checkpoint import load_brain, read_checkpoint, save_brain

__all__ = ["NavigationBrain", "load_brain", "read_checkpoint", "save_brain"]
