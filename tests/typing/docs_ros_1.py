from pathlib import Path

from neuroslam.ros.node import MappingNode, MapTransform
from neuroslam.ros.settings import RosSettings
from neuroslam.sensors.bag_topics import time_of

node = MappingNode(RosSettings(preset="auto", image_topic="/camera", odometry_topic="/odom"))
if Path("drive.mcap").exists():
    from rosbags.highlevel import AnyReader

    with AnyReader([Path("drive.mcap")]) as bag:
        for connection, received_ns, data in bag.messages():
            message = bag.deserialize(data, connection.msgtype)
            if connection.topic == "/camera":
                found = node.on_image(message, time_of(message, received_ns))
            elif connection.topic == "/odom":
                found = node.on_odometry(message, time_of(message, received_ns))
            else:
                continue
            print([out.pose for out in found if isinstance(out, MapTransform)])
