"""A recorded ROS conversation: camera, odometry and scans of a robot in a rendered world."""

import math

import cv2
import numpy as np
import pytest

from neuroslam.sensors import open_source

CAMERA = "world:corridor?width=64&height=40&frames_per_lap=60&laps=1.3&rate=10"
EPOCH_S = 1_700_000_000.3
LATE_S = {"/camera": 0.03, "/camera/compressed": 0.03, "/odom": 0.004, "/scan": 0.01}
"""Time from the stamp of a message until it is received."""


def write_bag(path):
    """Write a bag of ROS 1 (``.bag``) or ROS 2; odometry comes twice as often as images."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    first = path.suffix == ".bag"
    store = get_typestore(Stores.ROS1_NOETIC if first else Stores.ROS2_HUMBLE)
    kind = store.types
    vector, point = kind["geometry_msgs/msg/Vector3"], kind["geometry_msgs/msg/Point"]

    def header(time_s, frame):
        stamp = kind["builtin_interfaces/msg/Time"](int(time_s), round((time_s % 1) * 1e9))
        more = {"seq": 0} if first else {}
        return kind["std_msgs/msg/Header"](stamp=stamp, frame_id=frame, **more)

    def image(frame, time_s):
        h, w = frame.image.shape[:2]
        return kind["sensor_msgs/msg/Image"](
            header(time_s, "camera"), h, w, "rgb8", 0, 3 * w, frame.image.reshape(-1)
        )

    def compressed(frame, time_s):
        data = cv2.imencode(".png", frame.image[:, :, ::-1])[1].ravel()
        return kind["sensor_msgs/msg/CompressedImage"](header(time_s, "camera"), "png", data)

    def odometry(pose, velocity, time_s):
        turn = kind["geometry_msgs/msg/Quaternion"](
            0.0, 0.0, math.sin(pose[2] / 2), math.cos(pose[2] / 2)
        )
        place = kind["geometry_msgs/msg/Pose"](point(*pose[:2], 0.0), turn)
        speed = kind["geometry_msgs/msg/Twist"](
            vector(float(velocity[0]), 0.0, 0.0), vector(0.0, 0.0, float(velocity[1]))
        )
        return kind["nav_msgs/msg/Odometry"](
            header(time_s, "odom"), "base_link",
            kind["geometry_msgs/msg/PoseWithCovariance"](place, np.zeros(36)),
            kind["geometry_msgs/msg/TwistWithCovariance"](speed, np.zeros(36)),
        )  # fmt: skip

    def scan(k, time_s):
        ranges = np.linspace(1.0, 2.0 + 0.01 * k, 8).astype(np.float32)
        return kind["sensor_msgs/msg/LaserScan"](
            header(time_s, "laser"), -1.0, 1.0, 2.0 / 7, 0.0, 0.1, 0.05, 30.0,
            ranges, np.zeros(0, np.float32),
        )  # fmt: skip

    messages = []

    def add(topic, time_s, message):
        messages.append((time_s + LATE_S[topic], topic, message))

    pose = np.array([5.0, -2.0, 0.7])  # the frame of odometry begins anywhere
    before = None
    for frame in open_source(CAMERA):
        time_s = EPOCH_S + frame.time_s
        add("/camera", time_s, image(frame, time_s))
        add("/camera/compressed", time_s, compressed(frame, time_s))
        if before is not None:  # the motion between two pictures, in two samples
            v, w = frame.velocity
            for part in (0.4, 0.9):
                at_s = before + part * (frame.time_s - before)
                dt = 0.5 * (frame.time_s - before)
                heading = pose[2] + 0.5 * w * dt
                moved = [v * dt * math.cos(heading), v * dt * math.sin(heading), w * dt]
                pose = pose + np.array(moved)
                sample = odometry(pose.tolist(), (v, w), EPOCH_S + at_s)
                add("/odom", EPOCH_S + at_s, sample)
            add("/scan", time_s - 0.02, scan(frame.index, time_s - 0.02))
        before = frame.time_s
    with Writer1(path) if first else Writer2(path, version=9) as writer:
        connections = {}
        for time_s, topic, message in sorted(messages, key=lambda m: m[:2]):
            name = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=store)
            serialize = store.serialize_ros1 if first else store.serialize_cdr
            writer.write(connections[topic], round(time_s * 1e9), serialize(message, name))
    return path


@pytest.fixture(scope="session")
def ros2_bag(tmp_path_factory):
    pytest.importorskip("rosbags", reason="needs the extra rosbag")
    return write_bag(tmp_path_factory.mktemp("ros2") / "drive")


@pytest.fixture(scope="session")
def ros1_bag(tmp_path_factory):
    pytest.importorskip("rosbags", reason="needs the extra rosbag")
    return write_bag(tmp_path_factory.mktemp("ros1") / "drive.bag")


@pytest.fixture(scope="session")
def conversation(ros2_bag):
    """Topic, time of reception (ns) and message, as they were received."""
    from rosbags.highlevel import AnyReader

    with AnyReader([ros2_bag]) as reader:
        return [
            (connection.topic, received_ns, reader.deserialize(data, connection.msgtype))
            for connection, received_ns, data in reader.messages()
        ]
