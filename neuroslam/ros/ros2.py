"""The node under ROS 2: ``python -m neuroslam.ros.ros2 --ros-args -p image_topic:=/camera``.

Topics ``~/pose``, ``~/graph``, ``~/path``, ``~/event`` and ``/tf``; services ``~/save``,
``~/load``, ``~/localise`` and ``~/goal``. Parameters are those of
:class:`~neuroslam.ros.settings.RosSettings`.
"""

from collections.abc import Callable, Sequence
from typing import Any

from neuroslam.errors import NeuroslamError
from neuroslam.ros.messages import NAME, Messages, import_types
from neuroslam.ros.node import (
    Answer,
    MapEvent,
    MapGraph,
    MapPath,
    MappingNode,
    MapPose,
    MapTransform,
    Output,
)
from neuroslam.ros.settings import RosSettings
from neuroslam.runs.foxglove import stamp_of
from neuroslam.sensors.bag_topics import time_of


class Ros2Shell:
    """Subscribes, publishes and answers for a :class:`~neuroslam.ros.node.MappingNode`.

    Args:
        ros: A node of ``rclpy``.
    """

    def __init__(self, ros: Any) -> None:  # noqa: ANN401
        from builtin_interfaces.msg import Time  # pyright: ignore[reportMissingImports]
        from nav_msgs.srv import GetPlan  # pyright: ignore[reportMissingImports]
        from rclpy.qos import (  # pyright: ignore[reportMissingImports]
            DurabilityPolicy,
            HistoryPolicy,
            QoSProfile,
            ReliabilityPolicy,
        )
        from std_srvs.srv import Trigger  # pyright: ignore[reportMissingImports]

        self.ros = ros
        types = import_types()
        self.messages = Messages(types, lambda time_s: Time(**stamp_of(time_s)))
        fields = RosSettings.model_fields
        given = {name: ros.declare_parameter(name, of.default).value for name, of in fields.items()}
        self.node = MappingNode(RosSettings.of(given), ros.get_logger().info)
        self.node.warm_up()  # before messages wait for it
        settings = self.node.settings
        # Best effort receives from any publisher; a depth for what comes during a slow step.
        sensors = QoSProfile(
            history=HistoryPolicy.KEEP_LAST,
            depth=100,
            reliability=ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.VOLATILE,
        )
        latched = QoSProfile(
            history=HistoryPolicy.KEEP_LAST,
            depth=1,
            reliability=ReliabilityPolicy.RELIABLE,
            durability=DurabilityPolicy.TRANSIENT_LOCAL,
        )
        self.publishers = {
            MapTransform: ros.create_publisher(types["TFMessage"], "/tf", 100),
            MapPose: ros.create_publisher(types["PoseWithCovarianceStamped"], "~/pose", 10),
            MapGraph: ros.create_publisher(types["MarkerArray"], "~/graph", latched),
            MapPath: ros.create_publisher(types["Path"], "~/path", latched),
            MapEvent: ros.create_publisher(types["String"], "~/event", 10),
        }
        if settings.image_topic:
            kind = types["CompressedImage" if settings.is_compressed else "Image"]
            ros.create_subscription(kind, settings.image_topic, self._on_image, sensors)
        if settings.odometry_topic:
            kind = types["Odometry"]
            ros.create_subscription(kind, settings.odometry_topic, self._on_odometry, sensors)
        if settings.scan_topic:
            kind = types["LaserScan"]
            ros.create_subscription(kind, settings.scan_topic, self.node.on_scan, sensors)
        for name in ("save", "load", "localise"):
            ros.create_service(Trigger, f"~/{name}", _trigger(getattr(self.node, name)))
        ros.create_service(GetPlan, "~/goal", self._goal)
        ros.create_timer(5.0, self._say_what_is_missing)

    def _time_s(self, message: Any) -> float:  # noqa: ANN401
        return time_of(message, self.ros.get_clock().now().nanoseconds)

    def _on_image(self, message: Any) -> None:  # noqa: ANN401
        self.publish(self.node.on_image(message, self._time_s(message)))

    def _on_odometry(self, message: Any) -> None:  # noqa: ANN401
        self.publish(self.node.on_odometry(message, self._time_s(message)))

    def publish(self, outputs: Sequence[Output]) -> None:
        """Publish what the node returned."""
        for out in outputs:
            self.publishers[type(out)].publish(self.messages.of(out))

    def _goal(self, request: Any, response: Any) -> Any:  # noqa: ANN401
        at = request.goal.pose.position
        answer = self.node.goal(at.x, at.y)
        self.ros.get_logger().info(answer.text)
        if answer.path is not None:
            response.plan = self.messages.path(answer.path)
        return response

    def _say_what_is_missing(self) -> None:
        if text := self.node.waiting:
            self.ros.get_logger().warning(text)


def _trigger(service: Callable[[], Answer]) -> Callable[[Any, Any], Any]:
    def answer(_request: Any, response: Any) -> Any:  # noqa: ANN401
        done = service()
        response.success, response.message = done.done, done.text
        return response

    return answer


def main(args: list[str] | None = None) -> int:
    """Run the node until ROS shuts down; the map is saved then. Return 2 for a user's mistake."""
    try:
        import rclpy  # pyright: ignore[reportMissingImports]
        from rclpy.executors import ExternalShutdownException  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        print(f"neuroslam: needs ROS 2 ({error}); source its setup.bash first")
        return 2
    rclpy.init(args=args)
    ros = rclpy.create_node(NAME)
    try:
        shell = Ros2Shell(ros)
    except NeuroslamError as error:
        ros.get_logger().fatal(str(error))
        ros.destroy_node()
        rclpy.try_shutdown()
        return 2
    try:
        rclpy.spin(ros)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        print(shell.node.close().text)
        ros.destroy_node()
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
