"""Offboard for ROS 2: converters between numpy and messages for any node, and a planner server for nav2.

`import offboard` does not import this package, and this package does not import rclpy.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
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


def __getattr__(name: str) -> Any:
    """Names are loaded when they are first used (PEP 562), so that `robot-client ros2 --help` stays fast."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    home = "ros_messages" if name == "ROS" else "converters"
    found = globals()[name] = getattr(importlib.import_module(f"{__name__}.{home}"), name)
    return found
