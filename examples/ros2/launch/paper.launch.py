# SPDX-License-Identifier: Apache-2.0

"""Start the paper's applications: ros2 launch cloudrc_nodes paper.launch.py [teleop:=false].

An application that is false stays built into cloudrc.
"""

from __future__ import annotations

from cloudrc_nodes import HEARS, remaps
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description() -> LaunchDescription:
    """Describe what to start."""
    arguments = [
        DeclareLaunchArgument(name, default_value="true", choices=["true", "false"])
        for name in HEARS
    ]
    namespace = DeclareLaunchArgument("namespace", default_value="")
    return LaunchDescription([*arguments, namespace, OpaqueFunction(function=start)])


def start(context: LaunchContext) -> list[Node]:
    """Return the nodes to start, which hear each other."""
    running = [name for name in HEARS if LaunchConfiguration(name).perform(context) == "true"]
    return [
        Node(
            package="cloudrc_nodes",
            executable=name,
            name=name,
            namespace=LaunchConfiguration("namespace"),
            remappings=remaps(name, running),
            output="screen",
        )
        for name in running
    ]
