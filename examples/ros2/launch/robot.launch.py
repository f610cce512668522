# SPDX-License-Identifier: Apache-2.0

"""Start a session and its bridge: ros2 launch cloudrc_nodes robot.launch.py [experiment:=pillars].

Nodes see the robot and steer it once the session has begun. The launch ends with the session.
"""

from __future__ import annotations

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, EmitEvent, ExecuteProcess, RegisterEventHandler
from launch.event_handlers import OnProcessExit, OnProcessIO
from launch.events import Shutdown
from launch.events.process import ProcessIO
from launch.substitutions import LaunchConfiguration

BEGUN = b"to end"
"""What a session says once missions can fly."""


def generate_launch_description() -> LaunchDescription:
    """Describe what to start."""
    session = ExecuteProcess(
        cmd=["cloudrc", "up", LaunchConfiguration("experiment")], output="screen"
    )
    bridge = ExecuteProcess(cmd=["cloudrc", "ros", "bridge", "--rep-105"], output="screen")

    def start(event: ProcessIO) -> ExecuteProcess | None:
        return bridge if BEGUN in event.text else None

    end = EmitEvent(event=Shutdown(reason="the session has ended"))
    return LaunchDescription(
        [
            DeclareLaunchArgument("experiment", default_value="paper"),
            session,
            RegisterEventHandler(
                OnProcessIO(target_action=session, on_stdout=start, on_stderr=start)
            ),
            RegisterEventHandler(OnProcessExit(target_action=session, on_exit=[end])),
        ]
    )
