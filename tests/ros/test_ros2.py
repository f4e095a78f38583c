"""The shell for ROS 2 with a fake of the methods of rclpy that it uses, and recorded messages.

The types of messages are made from the definitions of ROS 2 Humble. As the real ones do, they have
defaults, no other fields, and refuse a value of another type.
"""

import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from neuroslam.ros.messages import TYPES
from neuroslam.ros.ros2 import Ros2Shell, main

ZEROS = {"string": "", "bool": False, "float64": 0.0, "float32": 0.0}
KINDS = {"bool": bool, "string": str, "float32": float, "float64": float}
BASE, NAME, ARRAY, SEQUENCE = 1, 2, 3, 4  # of rosbags.interfaces.Nodetype


class Types:
    """Classes like those that ROS 2 generates from definitions."""

    def __init__(self, store):
        self.store, self.made = store, {}

    def __getitem__(self, name):
        if name not in self.made:
            self.made[name] = self._class(name, dict(self.store.fielddefs[name][1]))
        return self.made[name]

    def _default(self, node, spec):
        if node == BASE:
            return ZEROS.get(spec[0], 0)
        if node == NAME:
            return self[spec]()
        return [self._default(*spec[0]) for _ in range(spec[1])] if node == ARRAY else []

    def _check(self, node, spec, value, where):
        if node == BASE:
            assert type(value) is KINDS.get(spec[0], int), f"{where} is {value!r}"
        elif node == NAME:
            assert type(value) is self[spec], f"{where} is {value!r}"
        else:
            assert isinstance(value, list), where
            assert node == SEQUENCE or len(value) == spec[1], where
            for item in value:
                self._check(*spec[0], item, where)

    def _class(self, name, fields):
        types = self

        class Message:
            __slots__ = tuple(fields)

            def __init__(self, **values):
                for field, of in fields.items():
                    value = values.pop(field) if field in values else types._default(*of)
                    setattr(self, field, value)
                assert not values

            def __setattr__(self, field, value):
                assert field in fields, f"{name} has no field {field}"
                types._check(*fields[field], value, f"{name}.{field}")
                object.__setattr__(self, field, value)

        Message.__name__ = name
        return Message

    def to_store(self, message):
        """The message as rosbags has it, for its bytes."""
        name, values = type(message).__name__, {}
        for field, (node, spec) in self.store.fielddefs[name][1]:
            value = getattr(message, field)
            if node == NAME:
                value = self.to_store(value)
            elif node != BASE and spec[0][0] == NAME:
                value = [self.to_store(item) for item in value]
            elif node != BASE and spec[0][1][0] != "string":
                value = np.array(value, spec[0][1][0])
            values[field] = value
        return self.store.types[name](**values)


class FakeNode:
    """The methods of ``rclpy.node.Node`` that the shell uses."""

    def __init__(self, parameters):
        self.parameters, self.declared = parameters, {}
        self.subscriptions, self.topics, self.services, self.timers = {}, {}, {}, []
        self.said = []

    def declare_parameter(self, name, default):
        value = self.parameters.get(name, default)
        assert type(value) is type(default), name  # rclpy refuses another type
        self.declared[name] = value
        return SimpleNamespace(value=value)

    def get_logger(self):
        return SimpleNamespace(**dict.fromkeys(("info", "warning", "fatal"), self.said.append))

    def get_clock(self):
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=5_000_000_000))

    def create_subscription(self, kind, topic, call, qos):
        self.subscriptions[topic] = kind, call, qos

    def create_publisher(self, kind, topic, qos):
        sent = []
        self.topics[topic] = kind, sent, qos

        def publish(message):
            assert type(message) is kind, topic
            sent.append(message)

        return SimpleNamespace(publish=publish)

    def create_service(self, kind, name, call):
        self.services[name] = kind, call

    def create_timer(self, period_s, call):
        assert type(period_s) is float
        self.timers.append(call)

    def destroy_node(self):
        self.said.append("destroyed")


@pytest.fixture
def rclpy(monkeypatch):
    """Modules of ROS 2 in place of those that are not there."""
    typesys = pytest.importorskip("rosbags.typesys", reason="needs the extra rosbag")
    types = Types(typesys.get_typestore(typesys.Stores.ROS2_HUMBLE))

    def module(name, **names):
        made = ModuleType(name)
        vars(made).update(names)
        monkeypatch.setitem(sys.modules, name, made)
        return made

    for package, names in (TYPES | {"builtin_interfaces": ("Time",)}).items():
        module(package)
        module(f"{package}.msg", **{name: types[f"{package}/msg/{name}"] for name in names})
    module("std_srvs")
    module("std_srvs.srv", Trigger="Trigger")
    module("nav_msgs.srv", GetPlan="GetPlan")
    module(
        "rclpy.qos",
        QoSProfile=SimpleNamespace,
        HistoryPolicy=SimpleNamespace(KEEP_LAST="keep last"),
        ReliabilityPolicy=SimpleNamespace(RELIABLE="reliable", BEST_EFFORT="best effort"),
        DurabilityPolicy=SimpleNamespace(VOLATILE="volatile", TRANSIENT_LOCAL="transient local"),
    )
    stop = type("ExternalShutdownException", (Exception,), {})
    module("rclpy.executors", ExternalShutdownException=stop)
    return module("rclpy", types=types, stop=stop)


def play(ros, conversation):
    for topic, _, message in conversation:
        if topic in ros.subscriptions:
            ros.subscriptions[topic][1](message)


SETTINGS = {
    "image_topic": "/camera", "odometry_topic": "/odom", "scan_topic": "/scan",
    "set": "frame_rate_hz=10 view.threshold=0.06",
}  # fmt: skip


def test_recorded_messages_come_out_as_poses_transforms_graph_and_path(rclpy, conversation):
    ros = FakeNode(SETTINGS)
    shell = Ros2Shell(ros)
    assert {topic: kind.__name__ for topic, (kind, *_) in ros.subscriptions.items()} == {
        "/camera": "sensor_msgs/msg/Image",
        "/odom": "nav_msgs/msg/Odometry",
        "/scan": "sensor_msgs/msg/LaserScan",
    }
    assert {qos.reliability for *_, qos in ros.subscriptions.values()} == {"best effort"}
    assert ros.topics["~/graph"][2].durability == "transient local"
    ros.timers[0]()
    assert ros.said[-1] == "no image on /camera yet; no odometry on /odom yet"
    play(ros, conversation)
    node, store = shell.node, rclpy.types.store
    n = node.robot.brain.clock.frames_seen
    sent = {topic: messages for topic, (_, messages, _) in ros.topics.items()}
    assert len(sent["~/pose"]) == n > 200
    assert 100 < len(sent["/tf"]) < n
    assert len(sent["~/graph"]) == len(sent["~/path"]) > 2
    assert any(m.data.startswith("loop_closed") for m in sent["~/event"])
    for messages in sent.values():
        name = type(messages[-1]).__name__
        data = store.serialize_cdr(rclpy.types.to_store(messages[-1]), name)
        again = store.deserialize_cdr(data, name)
        assert type(again).__name__ == name.replace("/", "__")
    here, last = node.robot.located, sent["~/pose"][-1]
    assert (last.header.frame_id, last.pose.pose.position.x) == ("map", here.pose.x_m)
    stamp = last.header.stamp
    assert stamp.sec + 1e-9 * stamp.nanosec == pytest.approx(here.result.time_s)
    covariance = np.reshape(last.pose.covariance, (6, 6))
    assert covariance[0, 0] == covariance[1, 1] > 0.0
    assert np.count_nonzero(covariance) == 3
    one = sent["/tf"][-1].transforms[0]
    assert (one.header.frame_id, one.child_frame_id) == ("map", "odom")
    turn = one.transform.rotation
    assert turn.z**2 + turn.w**2 == pytest.approx(1.0)
    links, nodes = shell.messages.of(node.graph(1.5)).markers
    assert (links.type, nodes.type) == (5, 7)  # LINE_LIST, SPHERE_LIST
    assert len(links.points) == 2 * node.robot.brain.map.n_links
    assert len(nodes.points) == node.robot.brain.map.n


def test_services_answer_and_a_goal_gives_a_path(rclpy, conversation, tmp_path):
    ros = FakeNode(SETTINGS | {"map_file": str(tmp_path / "map.safetensors")})
    shell = Ros2Shell(ros)

    def call(name):
        response = SimpleNamespace(success=None, message=None)
        return ros.services[f"~/{name}"][1](None, response)

    assert [call(name).success for name in ("save", "load", "localise")] == [False, False, False]
    play(ros, conversation[:300])
    x, y = shell.node.robot.brain.map.poses[4, :2].tolist()
    at = SimpleNamespace(position=SimpleNamespace(x=x, y=y))
    request = SimpleNamespace(goal=SimpleNamespace(pose=at))
    plan = ros.services["~/goal"][1](request, SimpleNamespace(plan=None)).plan
    end = plan.poses[-1].pose.position
    assert (end.x, end.y) == (x, y)
    assert call("save").success
    assert (tmp_path / "map.safetensors").exists()
    assert call("load").success
    assert not call("localise").success  # the map that was loaded waits already


def test_the_program_saves_at_the_end_and_tells_what_is_wrong(
    rclpy, conversation, tmp_path, capsys
):
    stored = tmp_path / "map.safetensors"
    ros = FakeNode(SETTINGS | {"map_file": str(stored)})
    rclpy.init, rclpy.try_shutdown = (lambda args: None), (lambda: None)
    rclpy.create_node = lambda _name: ros

    def spin(_node):
        play(ros, conversation[:40])
        raise rclpy.stop

    rclpy.spin = spin
    assert main([]) == 0
    assert stored.exists()
    assert f"in {stored}" in capsys.readouterr().out
    rclpy.create_node = lambda _name: FakeNode({"motion": "wheels"})
    assert main([]) == 2


def test_without_ros_the_program_says_what_it_needs(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "rclpy", None)
    assert main([]) == 2
    assert "source its setup.bash first" in capsys.readouterr().out


def test_the_launch_file_starts_the_program_with_its_parameters(monkeypatch):
    import runpy
    from pathlib import Path

    from neuroslam.ros.settings import RosSettings

    made = {name: ModuleType(name) for name in ("launch", "launch.actions", "launch.substitutions")}
    for name, module in made.items():
        monkeypatch.setitem(sys.modules, name, module)
    made["launch"].LaunchDescription = list
    made["launch.actions"].DeclareLaunchArgument = lambda name, default_value: name
    made["launch.actions"].ExecuteProcess = lambda cmd, output: cmd
    made["launch.substitutions"].LaunchConfiguration = lambda name: f"<{name}>"
    root = Path(__file__).resolve().parents[2]
    path = root / "examples/neuroslam_ros/neuroslam.launch.py"
    *names, words = runpy.run_path(str(path))["generate_launch_description"]()
    assert set(names) <= RosSettings.model_fields.keys()
    assert words[1:4] == ["-m", "neuroslam.ros.ros2", "--ros-args"]
    assert ["".join(word) for word in words[5::2]] == [f"{name}:='<{name}>'" for name in names]
