# SPDX-License-Identifier: Apache-2.0

"""The paper's predictor as a node: the robot keeps its velocity, eq. (3).

It needs `--set cloud.predictor=last_sample`: then cloudrc's estimate is the newest odometry, not
predicted.
"""

from __future__ import annotations

from typing import Any

from geometry_msgs.msg import Quaternion, Vector3
from nav_msgs.msg import Odometry
from rclpy.node import Node
from sensor_msgs.msg import TimeReference

from cloudrc_nodes.pairs import NEWEST, hear_pair, nanoseconds, run


class Predictor(Node):
    """Publishes where the robot is when the command takes effect."""

    def __init__(self, **options: Any) -> None:
        super().__init__("predictor", **options)
        self._estimates = self.create_publisher(Odometry, "estimate", NEWEST)
        horizon, newest = (TimeReference, "cloudrc/horizon"), (Odometry, "cloudrc/estimate")
        hear_pair(self, horizon, newest, self._predict)

    def _predict(self, horizon: TimeReference, newest: Odometry) -> None:
        ahead = (nanoseconds(horizon.header.stamp) - nanoseconds(horizon.time_ref)) * 1e-9
        position, turn = newest.pose.pose.position, newest.pose.pose.orientation
        x, y, z = in_world(newest.twist.twist.linear, turn)
        position.x += x * ahead
        position.y += y * ahead
        position.z += z * ahead
        self._estimates.publish(newest)


def in_world(vector: Vector3, turn: Quaternion) -> tuple[float, float, float]:
    """Turn a vector from the frame `base_link` to `world`: v + 2 w (u x v) + 2 u x (u x v)."""
    x, y, z = vector.x, vector.y, vector.z
    a, b, c = turn.x, turn.y, turn.z
    p, q, r = 2 * (b * z - c * y), 2 * (c * x - a * z), 2 * (a * y - b * x)
    w = turn.w
    return (
        x + w * p + b * r - c * q,
        y + w * q + c * p - a * r,
        z + w * r + a * q - b * p,
    )


def main() -> None:
    """Run the node."""
    run(Predictor)


if __name__ == "__main__":
    main()
