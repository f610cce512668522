"""ROS 2: cloudrc as a node beside a user's nodes.

Only this folder imports rclpy, and nothing imports this folder unless an experiment asks for ROS.
"""

from __future__ import annotations

import importlib
import sys

from cloudrc.errors import MissingPrerequisiteError, to_one_line


def require_ros(purpose: str, module: str, packages: str) -> None:
    """Raise a MissingPrerequisiteError unless this process can be a node of ROS 2.

    `purpose`, such as "cloud.controller ros2", is for the error text. `module` is the module of
    this folder that is needed; its `load_messages` loads those of the ROS packages `packages`.
    """
    try:
        import rclpy  # noqa: F401  first: its error says most

        importlib.import_module(f"cloudrc.bridges.ros2.{module}").load_messages()
    except Exception as error:
        python = f"Python {sys.version_info.major}.{sys.version_info.minor}"
        raise MissingPrerequisiteError(
            f"{purpose} needs ROS 2 with {packages} ({to_one_line(str(error))}): run "
            f"'source /opt/ros/DISTRIBUTION/setup.bash' of a ROS 2 for {python}, then cloudrc again"
        ) from None
