# SPDX-License-Identifier: Apache-2.0

"""What the nodes share: how they hear the messages of one period, and how they run."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile

NEWEST = QoSProfile(depth=1)
"""QoS of all topics: reliable, the newest message."""


def hear_pair(
    node: Node, first: tuple[Any, str], second: tuple[Any, str], act: Callable[[Any, Any], None]
) -> None:
    """Call `act` with two messages as soon as both are there: those with the same stamp.

    `first` and `second` are the type and the topic of each. Either may arrive first.
    """
    newest: list[Any] = [None, None]

    def take(index: int, message: Any) -> None:
        newest[index] = message
        one, other = newest
        if one is not None and other is not None and one.header.stamp == other.header.stamp:
            act(one, other)

    for index, (kind, topic) in enumerate((first, second)):
        node.create_subscription(kind, topic, partial(take, index), NEWEST)


def nanoseconds(stamp: Any) -> int:
    """Return a stamp, a message of the type Time, in ns."""
    return int(stamp.sec * 1_000_000_000 + stamp.nanosec)


def run(*kinds: Callable[[], Node]) -> None:
    """Run nodes until they are ended: each of `kinds` makes one."""
    rclpy.init()
    executor = SingleThreadedExecutor()
    try:
        for kind in kinds:
            executor.add_node(kind())
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
