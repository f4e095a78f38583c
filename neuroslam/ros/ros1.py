"""The node under ROS 1: ``python -m neuroslam.ros.ros1 _image_topic:=/camera``.

Topics ``~pose``, ``~graph``, ``~path``, ``~event`` and ``/tf``; services ``~save``, ``~load``,
``~localise`` and ``~goal``. Parameters are those of
:class:`~neuroslam.ros.settings.RosSettings`.
"""

import threading
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

_BUFFER = 2**24  # bytes: a smaller buffer keeps old images


class Ros1Shell:
    """Subscribes, publishes and answers for a :class:`~neuroslam.ros.node.MappingNode`.

    Args:
        rospy: The module, with its node begun.
    """

    def __init__(self, rospy: Any) -> None:  # noqa: ANN401
        from nav_msgs.srv import GetPlan, GetPlanResponse  # pyright: ignore[reportMissingImports]
        from std_srvs.srv import Trigger, TriggerResponse  # pyright: ignore[reportMissingImports]

        self.rospy = rospy
        self._in_order = threading.Lock()  # each topic has a thread of its own
        types = import_types()
        self._plan_response = GetPlanResponse
        self.messages = Messages(types, lambda s: rospy.Time(*stamp_of(s).values()))
        fields = RosSettings.model_fields
        given = {name: rospy.get_param(f"~{name}", of.default) for name, of in fields.items()}
        self.node = MappingNode(RosSettings.of(given), rospy.loginfo)
        self.node.warm_up()  # before messages wait for it
        settings = self.node.settings
        publisher = rospy.Publisher
        self.publishers = {
            MapTransform: publisher("/tf", types["TFMessage"], queue_size=100),
            MapPose: publisher("~pose", types["PoseWithCovarianceStamped"], queue_size=10),
            MapGraph: publisher("~graph", types["MarkerArray"], queue_size=1, latch=True),
            MapPath: publisher("~path", types["Path"], queue_size=1, latch=True),
            MapEvent: publisher("~event", types["String"], queue_size=10),
        }
        for name in ("save", "load", "localise"):
            service = getattr(self.node, name)
            rospy.Service(f"~{name}", Trigger, _trigger(service, TriggerResponse))
        rospy.Service("~goal", GetPlan, self._goal)
        rospy.Timer(rospy.Duration(5.0), self._say_what_is_missing)
        if settings.scan_topic:  # before odometry, which takes the latest scan
            self._subscribe(settings.scan_topic, types["LaserScan"], self.node.on_scan)
        if settings.image_topic:
            kind = types["CompressedImage" if settings.is_compressed else "Image"]
            self._subscribe(settings.image_topic, kind, self._on_image)
        if settings.odometry_topic:
            self._subscribe(settings.odometry_topic, types["Odometry"], self._on_odometry)

    def _subscribe(self, topic: str, kind: Any, call: Callable[[Any], None]) -> None:  # noqa: ANN401
        self.rospy.Subscriber(topic, kind, call, queue_size=100, buff_size=_BUFFER)

    def _time_s(self, message: Any) -> float:  # noqa: ANN401
        stamp = message.header.stamp
        stamped: float = stamp.secs + stamp.nsecs * 1e-9
        return stamped if stamped > 0.0 else self.rospy.get_time()

    def _on_image(self, message: Any) -> None:  # noqa: ANN401
        with self._in_order:
            self.publish(self.node.on_image(message, self._time_s(message)))

    def _on_odometry(self, message: Any) -> None:  # noqa: ANN401
        with self._in_order:
            self.publish(self.node.on_odometry(message, self._time_s(message)))

    def publish(self, outputs: Sequence[Output]) -> None:
        """Publish what the node returned."""
        for out in outputs:
            self.publishers[type(out)].publish(self.messages.of(out))

    def _goal(self, request: Any) -> Any:  # noqa: ANN401
        at = request.goal.pose.position
        answer = self.node.goal(at.x, at.y)
        self.rospy.loginfo(answer.text)
        response = self._plan_response()
        if answer.path is not None:
            response.plan = self.messages.path(answer.path)
        return response

    def _say_what_is_missing(self, _event: object) -> None:
        if text := self.node.waiting:
            self.rospy.logwarn(text)


def _trigger(service: Callable[[], Answer], response: Any) -> Callable[[Any], Any]:  # noqa: ANN401
    def answer(_request: object) -> Any:  # noqa: ANN401
        done = service()
        return response(success=done.done, message=done.text)

    return answer


def main() -> int:
    """Run the node until ROS shuts down; the map is saved then. Return 2 for a user's mistake."""
    try:
        import rospy  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        print(f"neuroslam: needs ROS 1 ({error}); source its setup.bash first")
        return 2
    rospy.init_node(NAME)
    try:
        shell = Ros1Shell(rospy)
    except NeuroslamError as error:
        rospy.logfatal(str(error))
        return 2
    rospy.spin()
    print(shell.node.close().text)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
