"""ROS 2: cloudrc as a node beside a user's nodes.

Only this folder imports rclpy, and nothing imports this folder unless an experiment asks for ROS.
"""

from __future__ import annotations

import importlib.util
import os
import sys

from cloudrc.errors import BadInputError, MissingPrerequisiteError, to_one_line

DOMAIN_MAX = 232
"""Largest number of a domain of ROS 2: larger ones would need ports that do not exist."""


def require_ros() -> None:
    """Raise a MissingPrerequisiteError unless this process can be a node of ROS 2."""
    domain = os.environ.get("ROS_DOMAIN_ID", "") or "0"
    if not domain.isdecimal() or int(domain) > DOMAIN_MAX:
        raise BadInputError(f"ROS_DOMAIN_ID={domain}: give a number from 0 to {DOMAIN_MAX}")
    python = f"Python {sys.version_info.major}.{sys.version_info.minor}"
    if importlib.util.find_spec("rclpy") is None:
        raise MissingPrerequisiteError(
            "cloud.controller ros2 needs ROS 2, and there is no rclpy here: run "
            f"'source /opt/ros/DISTRIBUTION/setup.bash' of a ROS 2 for {python}, then cloudrc again"
        )
    try:
        import rclpy  # noqa: F401  first: its error says most

        from cloudrc.bridges.ros2.node import load_messages

        load_messages()
    except Exception as error:
        ros = os.environ.get("ROS_DISTRO", "this ROS 2")
        raise MissingPrerequisiteError(
            f"rclpy of {ros} cannot be used in {python}: {to_one_line(str(error))}; use cloudrc "
            "in the Python of this ROS, with nav_msgs, geometry_msgs and sensor_msgs"
        ) from None
