"""Visual odometry: self-motion from camera images."""

from neuroslam.odometry.visual import VisualOdometry

__all__ = ["VisualOdometry"]
