# SPDX-License-Identifier: Apache-2.0

"""The paper's controller as a node: a proportional controller of the position.

It answers each estimate once the setpoint with the same stamp is there, and copies the stamp. So a
flight in virtual time repeats bit by bit.
"""

from __future__ import annotations

from typing import Any

from geometry_msgs.msg import PoseStamped, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node

from cloudrc_nodes.pairs import NEWEST, hear_pair, run

GAINS = (0.8, 0.8, 1.5)
"""Velocity per error of position, per axis [1/s]."""


class Controller(Node):
    """Publishes a velocity for each estimate."""

    def __init__(self, **options: Any) -> None:
        super().__init__("controller", **options)
        self._commands = self.create_publisher(TwistStamped, "cloudrc/cmd_vel", NEWEST)
        estimate, setpoint = (Odometry, "cloudrc/estimate"), (PoseStamped, "cloudrc/setpoint")
        hear_pair(self, estimate, setpoint, self._answer)

    def _answer(self, estimate: Odometry, setpoint: PoseStamped) -> None:
        wanted, now = setpoint.pose.position, estimate.pose.pose.position
        command = TwistStamped()
        command.header.stamp = estimate.header.stamp
        command.header.frame_id = "world"
        command.twist.linear.x = GAINS[0] * (wanted.x - now.x)
        command.twist.linear.y = GAINS[1] * (wanted.y - now.y)
        command.twist.linear.z = GAINS[2] * (wanted.z - now.z)
        self._commands.publish(command)


def main() -> None:
    """Run the node."""
    run(Controller)


if __name__ == "__main__":
    main()
