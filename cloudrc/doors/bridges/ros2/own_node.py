# SPDX-License-Identifier: Apache-2.0

"""What all nodes of cloudrc in ROS 2 share: a context, QoS, and words about the nodes of others."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from cloudrc.doors.bridges.ros2 import saying

RELIABLE = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)
"""QoS of what cloudrc publishes for a controller, which all subscriptions match."""
QUEUED = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
"""QoS of the bridge's topics, and of answers in lock step, of which none may replace another."""
NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
"""QoS of /clock, and of what arrives in real time: no message waits for an older one."""
LINGERS = "a killed node stays for 20 s"
"""What a user should know who sees a node that has ended."""


class OwnNode:
    """A node of cloudrc, with a context of its own: others in this process may have theirs.

    Attributes:
        node: The node of rclpy.
        context: Its context.
        domain: Its domain in words.
    """

    def __init__(self, name: str, namespace: str = "") -> None:
        """Join ROS as the node `name` in `namespace`, such as "drone1"."""
        self.context = rclpy.Context()
        with saying("ROS 2 does not start here: WHY"):
            rclpy.init(args=[], context=self.context)
        self.node = rclpy.create_node(
            name,
            context=self.context,
            namespace=namespace,
            use_global_arguments=False,
            enable_rosout=False,
            start_parameter_services=False,
        )
        self.domain = f"ROS domain {self.context.get_domain_id()} (ROS_DOMAIN_ID)"

    def close(self) -> None:
        """Leave ROS; a handler of signals of a user's plug-in may have done so already."""
        self.node.destroy_node()
        self.context.try_shutdown()

    def topic(self, name: str) -> str:
        """Return the full name of the topic `name` below cloudrc's, in the node's namespace."""
        return f"{self.node.get_namespace().rstrip('/')}/cloudrc/{name}"


def known(infos: Iterable[Any]) -> list[Any]:
    """Return the endpoints with a name; one without has just left, or just come."""
    return [info for info in infos if "UNKNOWN" not in info.node_name]


def name_of(info: Any) -> str:
    """Return the full name of the node of an endpoint."""
    return f"{info.node_namespace.rstrip('/')}/{info.node_name}"


def clash(info: Any, own: QoSProfile, topic: str) -> str:
    """Say that the QoS of another's endpoint cannot match `own`; "" if it can."""
    theirs, publishes = info.qos_profile, info.endpoint_type.name == "PUBLISHER"
    if _matches(theirs, own) if publishes else _matches(own, theirs):
        return ""
    verb = "publishes" if publishes else "subscribes to"
    return (
        f"node {name_of(info)} {verb} {topic} with QoS {in_words(theirs)}, which cannot match "
        f"cloudrc's {in_words(own)}"
    )


def _matches(offered: Any, wanted: Any) -> bool:
    """Return whether a subscription with the QoS `wanted` gets what is `offered`.

    rclpy's own check also compares deadlines, which it does not know of cloudrc's side.
    """
    reliable, kept = ReliabilityPolicy.RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL
    is_reliable = offered.reliability == reliable or wanted.reliability != reliable
    is_kept = offered.durability == kept or wanted.durability != kept
    return bool(is_reliable and is_kept)


def in_words(qos: Any) -> str:
    """Return a QoS as users of ROS write it."""
    return f"{qos.reliability.name}, {qos.durability.name}"
