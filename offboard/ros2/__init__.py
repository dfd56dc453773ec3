"""Offboard for ROS 2: converters between numpy and messages for any node, and a planner server for nav2.

`import offboard` does not import this package, and this package does not import rclpy.
"""

from offboard.ros2.converters import (
    Header,
    Library,
    cloud_message,
    cloud_points,
    grid_message,
    grid_of,
    header_of,
    image_array,
    image_message,
    path_message,
    path_poses,
    scan_message,
    scan_of,
)
from offboard.ros2.ros_messages import ROS

__all__ = [
    "ROS",
    "Header",
    "Library",
    "cloud_message",
    "cloud_points",
    "grid_message",
    "grid_of",
    "header_of",
    "image_array",
    "image_message",
    "path_message",
    "path_poses",
    "scan_message",
    "scan_of",
]
