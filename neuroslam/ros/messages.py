"""Messages of ROS made from the outputs of the node; ROS 1 and ROS 2 share their fields."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from neuroslam.ros.node import MapEvent, MapGraph, MapPath, MapPose, MapTransform, Output
from neuroslam.types import Pose

_LINE_LIST, _SPHERE_LIST = 5, 7  # visualization_msgs/Marker


class Messages:
    """Makes messages.

    Args:
        types: Message types by name, such as ``Path``.
        stamp: Makes a time of ROS of seconds.
    """

    def __init__(self, types: dict[str, Any], stamp: Callable[[float], Any]) -> None:
        self.types, self.stamp = types, stamp

    def of(self, out: Output) -> Any:  # noqa: ANN401
        """Return the message of an output."""
        match out:
            case MapTransform():
                return self.transform(out)
            case MapPose():
                return self.pose(out)
            case MapGraph():
                return self.graph(out)
            case MapPath():
                return self.path(out)
            case MapEvent():
                return self.event(out)

    def _stamped(self, kind: str, time_s: float, frame: str) -> Any:  # noqa: ANN401
        message = self.types[kind]()
        message.header.stamp = self.stamp(time_s)
        message.header.frame_id = frame
        return message

    def transform(self, out: MapTransform) -> Any:  # noqa: ANN401
        """Return a ``tf2_msgs/TFMessage``."""
        one = self._stamped("TransformStamped", out.time_s, out.parent)
        one.child_frame_id = out.child
        one.transform.translation.x = float(out.pose.x_m)
        one.transform.translation.y = float(out.pose.y_m)
        _turn(one.transform.rotation, out.pose.theta_rad)
        message = self.types["TFMessage"]()
        message.transforms = [one]
        return message

    def pose(self, out: MapPose) -> Any:  # noqa: ANN401
        """Return a ``geometry_msgs/PoseWithCovarianceStamped``."""
        message = self._stamped("PoseWithCovarianceStamped", out.time_s, out.frame)
        _place(message.pose.pose, out.pose)
        covariance = np.zeros((6, 6))
        covariance[[0, 1, 5], [0, 1, 5]] = out.variance
        message.pose.covariance = covariance.ravel().tolist()
        return message

    def path(self, out: MapPath) -> Any:  # noqa: ANN401
        """Return a ``nav_msgs/Path``."""
        message = self._stamped("Path", out.time_s, out.frame)
        poses = []
        for row in out.poses.tolist():
            one = self._stamped("PoseStamped", out.time_s, out.frame)
            _place(one.pose, Pose(*row))
            poses.append(one)
        message.poses = poses
        return message

    def graph(self, out: MapGraph) -> Any:  # noqa: ANN401
        """Return a ``visualization_msgs/MarkerArray``: links as lines, experiences as spheres."""
        links = self._marker(out, _LINE_LIST, "links", (0.12, 0.47, 0.71))
        links.scale.x = 0.1 * out.link_m
        links.points = [self._point(x, y) for x, y in out.poses[out.links.ravel(), :2].tolist()]
        nodes = self._marker(out, _SPHERE_LIST, "experiences", (0.9, 0.45, 0.1))
        nodes.scale.x = nodes.scale.y = nodes.scale.z = 0.3 * out.link_m
        nodes.points = [self._point(x, y) for x, y in out.poses[:, :2].tolist()]
        message = self.types["MarkerArray"]()
        message.markers = [links, nodes]
        return message

    def event(self, out: MapEvent) -> Any:  # noqa: ANN401
        """Return a ``std_msgs/String``."""
        message = self.types["String"]()
        message.data = out.text
        return message

    def _marker(
        self, out: MapGraph, kind: int, name: str, colour: tuple[float, float, float]
    ) -> Any:  # noqa: ANN401
        marker = self._stamped("Marker", out.time_s, out.frame)
        marker.ns, marker.type = name, kind
        marker.pose.orientation.w = 1.0
        marker.color.r, marker.color.g, marker.color.b = colour
        marker.color.a = 1.0
        return marker

    def _point(self, x: float, y: float) -> Any:  # noqa: ANN401
        point = self.types["Point"]()
        point.x, point.y = x, y
        return point


def _place(message: Any, pose: Pose) -> None:  # noqa: ANN401
    message.position.x, message.position.y = float(pose.x_m), float(pose.y_m)
    _turn(message.orientation, pose.theta_rad)


def _turn(quaternion: Any, heading_rad: float) -> None:  # noqa: ANN401
    quaternion.z, quaternion.w = math.sin(0.5 * heading_rad), math.cos(0.5 * heading_rad)


TYPES = {
    "geometry_msgs": ("Point", "PoseStamped", "PoseWithCovarianceStamped", "TransformStamped"),
    "nav_msgs": ("Odometry", "Path"),
    "sensor_msgs": ("CompressedImage", "Image", "LaserScan"),
    "std_msgs": ("String",),
    "tf2_msgs": ("TFMessage",),
    "visualization_msgs": ("Marker", "MarkerArray"),
}
"""Message types of the node, by package."""


NAME = "neuroslam"
"""Name of the node."""


def import_types() -> dict[str, Any]:
    """Import :data:`TYPES` from the ROS that is sourced.

    Raises:
        ImportError: If there is none.
    """
    from importlib import import_module

    return {
        name: getattr(import_module(f"{package}.msg"), name)
        for package, names in TYPES.items()
        for name in names
    }
