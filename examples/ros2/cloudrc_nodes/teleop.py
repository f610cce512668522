# SPDX-License-Identifier: Apache-2.0

"""The paper's teleoperation as a node: it leads the robot from waypoint to waypoint.

cloudrc's own teleoperation still starts and ends the flight, and judges it: give both the same
waypoints.
"""

from __future__ import annotations

from math import dist
from typing import Any

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node

from cloudrc_nodes.pairs import NEWEST, nanoseconds, run

WAYPOINTS = [
    *(0.5, 0.0, 0.7, 0.15, 0.2),
    *(0.5, 3.6, 0.7, 0.30, 0.0),
    *(-1.0, 3.6, 0.7, 0.10, 0.5),
    *(-1.0, -2.706, 0.7, 0.10, 0.5),
    *(2.821, -6.418, 0.7, 0.10, 0.5),
    *(7.5, -6.4215, 0.7, 0.10, 0.5),
    *(8.235, -6.422, 0.7, 0.25, 4.0),
]
"""The mission `pipes`; per waypoint x, y, z [m], tolerance [m], and time to stay there [s]."""
JUMP = 2.0
"""Distance between two estimates, above which the robot was set back for another flight [m]."""


class Teleop(Node):
    """Publishes a setpoint for each estimate. The parameter `waypoints` is as WAYPOINTS."""

    def __init__(self, **options: Any) -> None:
        super().__init__("teleop", **options)
        numbers = list(self.declare_parameter("waypoints", WAYPOINTS).value)
        self._waypoints = [numbers[first : first + 5] for first in range(0, len(numbers), 5)]
        self._setpoints = self.create_publisher(PoseStamped, "setpoint", NEWEST)
        self.create_subscription(Odometry, "cloudrc/estimate", self._lead, NEWEST)
        self._index, self._stamp_ns = 0, 0
        self._place = (0.0, 0.0, 0.0)  # of the robot [m]
        self._near_ns: int | None = None  # time at which the robot came near the waypoint

    def _lead(self, estimate: Odometry) -> None:
        now, stamp_ns = estimate.pose.pose.position, nanoseconds(estimate.header.stamp)
        place = now.x, now.y, now.z
        if stamp_ns < self._stamp_ns or dist(place, self._place) > JUMP:  # another flight
            self._index, self._near_ns = 0, None
        self._stamp_ns, self._place = stamp_ns, place
        *position, tolerance, dwell = self._waypoints[self._index]
        if dist(position, place) > tolerance:
            self._near_ns = None
        elif self._near_ns is None:
            self._near_ns = stamp_ns
        is_last = self._index == len(self._waypoints) - 1
        if self._near_ns is not None and not is_last and stamp_ns - self._near_ns >= dwell * 1e9:
            self._index, self._near_ns = self._index + 1, None
        self._publish(estimate)

    def _publish(self, estimate: Odometry) -> None:
        setpoint = PoseStamped(header=estimate.header)
        point = setpoint.pose.position
        point.x, point.y, point.z, *_ = self._waypoints[self._index]
        self._setpoints.publish(setpoint)


def main() -> None:
    """Run the node."""
    run(Teleop)


if __name__ == "__main__":
    main()
