# SPDX-License-Identifier: Apache-2.0

"""The transport to a user's node; an entry point in pyproject.toml names this file."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from cloudrc.doors.bridges.ros2 import require_ros

if TYPE_CHECKING:
    from cloudrc.doors.bridges.ros2.driver import RosDriver
    from cloudrc.doors.bridges.ros2.lock_step import RosLockStep
    from cloudrc.flight.pod.teleop_link import UnixDatagrams


def check() -> None:
    """Raise a MissingPrerequisiteError unless this process can be a node of ROS 2."""
    packages = "nav_msgs, geometry_msgs and sensor_msgs"
    require_ros("cloud.controller ros2", "node", packages)


def lock_step(namespace: str, start_limit: float, gone: Callable[[], bool]) -> RosLockStep:
    """Wait for a node below `namespace`, in virtual time, for at most `start_limit` [s]."""
    from cloudrc.doors.bridges.ros2.lock_step import RosLockStep

    return RosLockStep(namespace, start_limit, gone)


def driver(
    peer: UnixDatagrams, namespace: str, start_limit: float, tell: Callable[[str], None]
) -> RosDriver:
    """Exchange messages with a node below `namespace`, in real time.

    A node may start at any time: `start_limit` [s] is for a program that has to answer.
    """
    from cloudrc.doors.bridges.ros2.driver import RosDriver

    return RosDriver(peer, namespace, tell)
