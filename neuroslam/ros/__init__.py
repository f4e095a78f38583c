"""A node for ROS 1 and ROS 2: logic without ROS in it, under a shell for each."""
