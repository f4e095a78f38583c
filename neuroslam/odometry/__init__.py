"""Self-motion from what the robot sees."""

from neuroslam.odometry.visual import VisualOdometry

__all__ = ["VisualOdometry"]
