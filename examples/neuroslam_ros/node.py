#!/usr/bin/env python3
"""The node of neuroslam under ROS 1, for roslaunch and rosrun."""

from neuroslam.ros.ros1 import main

raise SystemExit(main())
