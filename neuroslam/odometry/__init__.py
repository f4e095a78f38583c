"""Visual odometry: self-motion from camera images."""

from neuroslam.config.sections import OdometryConfig
from neuroslam.odometry.flow import FlowOdometry
from neuroslam.odometry.visual import VisualOdometry
from neuroslam.types import GreyRule

__all__ = ["FlowOdometry", "VisualOdometry", "visual_odometry"]


def visual_odometry(
    config: OdometryConfig, grey: GreyRule = "luma"
) -> VisualOdometry | FlowOdometry:
    """Return the odometry that a config names.

    Args:
        config: ``method`` decides.
        grey: How colour becomes grey.

    Example:
        >>> type(visual_odometry(OdometryConfig(method="flow"))).__name__
        'FlowOdometry'
    """
    return (FlowOdometry if config.method == "flow" else VisualOdometry)(config, grey)
