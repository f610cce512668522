"""The paper's controller as a node: a proportional controller of the position.

It answers each estimate once the setpoint with the same stamp is there, and copies the stamp. So a
flight in virtual time repeats bit by bit.
"""

from __future__ import annotations

import rclpy
from geometry_msgs.msg import PoseStamped, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import QoSProfile

GAINS = (0.8, 0.8, 1.5)
"""Velocity per error of position, per axis [1/s]."""


class Controller(Node):
    """Publishes a velocity for each estimate."""

    def __init__(self) -> None:
        super().__init__("controller")
        newest = QoSProfile(depth=1)  # reliable
        self._commands = self.create_publisher(TwistStamped, "cloudrc/cmd_vel", newest)
        self.create_subscription(PoseStamped, "cloudrc/setpoint", self._take_setpoint, newest)
        self.create_subscription(Odometry, "cloudrc/estimate", self._take_estimate, newest)
        self._setpoint: PoseStamped | None = None
        self._estimate: Odometry | None = None

    def _take_setpoint(self, setpoint: PoseStamped) -> None:
        self._setpoint = setpoint
        self._answer()

    def _take_estimate(self, estimate: Odometry) -> None:
        self._estimate = estimate
        self._answer()

    def _answer(self) -> None:
        """Answer if setpoint and estimate belong together: either may arrive first."""
        if self._setpoint is None or self._estimate is None:
            return
        if self._setpoint.header.stamp != self._estimate.header.stamp:
            return
        wanted, now = self._setpoint.pose.position, self._estimate.pose.pose.position
        command = TwistStamped()
        command.header.stamp = self._estimate.header.stamp
        command.header.frame_id = "world"
        command.twist.linear.x = GAINS[0] * (wanted.x - now.x)
        command.twist.linear.y = GAINS[1] * (wanted.y - now.y)
        command.twist.linear.z = GAINS[2] * (wanted.z - now.z)
        self._commands.publish(command)


def main() -> None:
    """Run the node until it is ended."""
    rclpy.init()
    try:
        rclpy.spin(Controller())
    except (KeyboardInterrupt, ExternalShutdownException):
        pass


if __name__ == "__main__":
    main()
