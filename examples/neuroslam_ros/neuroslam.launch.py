"""Start the node under ROS 2: ``ros2 launch neuroslam.launch.py image:=/camera/image_raw``."""

import sys

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess
from launch.substitutions import LaunchConfiguration

PARAMETERS = {
    "image_topic": "/camera/image_raw",
    "odometry_topic": "/odom",
    "scan_topic": "",
    "preset": "auto",
    "set": "",
    "map_file": "",
}


def generate_launch_description() -> LaunchDescription:
    """Return the node, with an argument for each parameter."""
    words = [sys.executable, "-m", "neuroslam.ros.ros2", "--ros-args"]
    for name in PARAMETERS:
        words += ["-p", [f"{name}:='", LaunchConfiguration(name), "'"]]
    arguments = [DeclareLaunchArgument(name, default_value=v) for name, v in PARAMETERS.items()]
    return LaunchDescription([*arguments, ExecuteProcess(cmd=words, output="screen")])
