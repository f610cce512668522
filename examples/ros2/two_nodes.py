# SPDX-License-Identifier: Apache-2.0

"""Two plain nodes that count messages: a talker that numbers them, and a listener.

python two_nodes.py talker [COUNT] [HZ] [BYTES] [best_effort]
python two_nodes.py listener [best_effort]

The listener prints what has come once nothing has come for 5 s. Start it as the client of
`cloudrc link exec`, which ends with its client.
"""

from __future__ import annotations

import sys
from contextlib import suppress

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import String

QUIET = 5.0
"""Time without a message after which the listener ends [s]."""


def main(role: str, *words: str) -> None:
    """Run one of the nodes."""
    reliability = ReliabilityPolicy.RELIABLE
    if "best_effort" in words:
        reliability = ReliabilityPolicy.BEST_EFFORT
    numbers = [int(word) for word in words if word.isdigit()]
    qos = QoSProfile(depth=10, reliability=reliability)
    rclpy.init()
    node = rclpy.create_node(role)
    with suppress(ExternalShutdownException):  # the other end has ended
        talk(node, qos, *numbers) if role == "talker" else listen(node, qos)


def talk(
    node: rclpy.node.Node, qos: QoSProfile, count: int = 330, hz: int = 30, size: int = 20
) -> None:
    """Publish `count` messages of `size` bytes, `hz` per second, once there is a listener."""
    publisher = node.create_publisher(String, "chat", qos)
    while not publisher.get_subscription_count():
        rclpy.spin_once(node, timeout_sec=0.1)
    for number in range(count):
        publisher.publish(String(data=f"{number}".ljust(size)))
        rclpy.spin_once(node, timeout_sec=1 / hz)
    rclpy.spin(node)  # a lost message can be sent again


def listen(node: rclpy.node.Node, qos: QoSProfile) -> None:
    """Count messages until none has come for a while."""
    times = dict[str, float]()  # message -> when it has come [s]

    def now() -> float:
        return float(node.get_clock().now().nanoseconds * 1e-9)

    def note(message: String) -> None:
        times[message.data.strip()] = now()

    node.create_subscription(String, "chat", note, qos)
    while not times or now() - max(times.values()) < QUIET:
        rclpy.spin_once(node, timeout_sec=0.1)
    print(f"{len(times)} messages within {max(times.values()) - min(times.values()):.1f} s")


if __name__ == "__main__":
    main(*sys.argv[1:])
