# SPDX-License-Identifier: Apache-2.0

"""Hand the messages of a topic on to another topic, each one late, lost or doubled as a link does.

Messages cross as raw bytes, so they may have any type. Each one is a packet of the link, or several
packets. Of several, the losses of a RELIABLE topic are repaired; a message of a BEST_EFFORT one is
lost with any of them.
"""

from __future__ import annotations

import importlib
import os
import time
from collections.abc import Callable, Iterator
from typing import Any

from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.type_support import check_for_type_support

from cloudrc.base.errors import BadInputError
from cloudrc.doors.bridges.ros2 import saying
from cloudrc.doors.bridges.ros2.own_node import LINGERS, OwnNode, clash, in_words, known, name_of
from cloudrc.link.carry.engine import BATCH, Engine, LinkWay, Packet
from cloudrc.link.carry.messages import MessageWay
from cloudrc.link.carry.tcp.medium import Medium

DEPTH = 100
"""Number of messages that ROS keeps until they are read: a burst is no loss of the link."""
CAPACITY = 10_000
"""Largest number of messages on the link; a message beyond that is dropped and counted."""
LOOK_PERIOD = 0.1
"""Time between two looks for a publisher [s]."""
SETTLE = 0.5
"""Time for the other nodes of the topics after the first publisher is found [s]."""
PATIENCE = 1.0
"""Time after which the user is told that there is no publisher [s]: ROS takes time to find one."""


def load_messages() -> None:
    """Load nothing: the type of the messages is known once a node publishes them."""


class TopicRelay(OwnNode):
    """The node between two topics.

    Attributes:
        source: Full name of the topic that the relay hears.
        target: Full name of the topic that it publishes.
        kind: Type of the messages, such as "nav_msgs/msg/Odometry"; "" before
            `wait_for_publisher`.
    """

    def __init__(self, source: str, target: str) -> None:
        """Join ROS; raise a BadInputError if the topics have wrong names, or the same name."""
        super().__init__(f"cloudrc_relay_{os.getpid()}")
        self.source, self.target = self._full("--from", source), self._full("--to", target)
        if self.source == self.target:
            raise BadInputError(f"--from and --to are both {self.source}: give --to another name")
        self.kind = ""
        self._waiting = rclpy_implementation.WaitSet(1, 0, 0, 0, 0, 0, self.context.handle)

    def _full(self, flag: str, name: str) -> str:
        with saying(f"{flag} {name}: no name of a topic", BadInputError):
            return str(self.node.resolve_topic_name(name))

    def wait_for_publisher(self, tell: Callable[[str], None]) -> None:
        """Wait until a node publishes the source; `tell` gets a word if that takes time.

        Raises:
            BadInputError: If one of the topics has another type, too.
        """
        began, told = time.monotonic(), False
        while not (infos := self._publishers(self.source)):
            if not told and time.monotonic() - began > PATIENCE:
                told = True
                tell(f"no node publishes {self.source} in {self.domain}: the relay waits for one")
            time.sleep(LOOK_PERIOD)
        time.sleep(SETTLE)
        self.kind = infos[0].topic_type
        if texts := self._other_types():
            first = f"node {name_of(infos[0])} publishes {self.source} as {self.kind}"
            raise BadInputError(f"{first}, but {texts[0]}; {LINGERS}")

    def open(
        self, way: LinkWay, media: tuple[Medium, Medium], *, reliable: bool
    ) -> tuple[Engine, MessageWay, str]:
        """Begin to hear, with the QoS of the publishers; the output is RELIABLE if `reliable`.

        `media` repair the losses of large messages of a RELIABLE source. Return the engine that
        carries the messages, their way, and the QoS of both topics in words.

        Raises:
            MissingPrerequisiteError: If this ROS does not have the type.
        """
        kind, infos = self._load(), self._publishers(self.source)
        is_reliable = all(i.qos_profile.reliability == ReliabilityPolicy.RELIABLE for i in infos)
        is_kept = all(i.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for i in infos)
        heard, sent = (_qos(reliable=one, kept=is_kept) for one in (is_reliable, reliable))
        way.checked = True  # as the checksum of UDP lets no damaged message pass
        self._way, self._type = way, kind
        self._messages = self.node.create_subscription(
            kind, self.source, lambda data: None, heard, raw=True
        )
        self._publisher = self.node.create_publisher(kind, self.target, sent)
        # The calls of repairs wait in the engine's queue, too: none of them may be dropped.
        engine = Engine(self, (way,), None if is_reliable else CAPACITY)
        self._carried = MessageWay(engine, way, media if is_reliable else None)
        return engine, self._carried, f"{in_words(heard)} in, {in_words(sent)} out"

    def _load(self) -> Any:
        package, _, name = self.kind.partition("/msg/")
        with saying(
            f"{self.source} has the type {self.kind}, which this ROS cannot load: WHY; "
            f"source the workspace that has {package}"
        ):
            kind = getattr(importlib.import_module(f"{package}.msg"), name)
            check_for_type_support(kind)
            return kind

    def problems(self) -> list[str]:
        """Say which nodes do not take part, and which one publishes beside the relay."""
        found = self._other_types()
        for info in self._publishers(self.source):
            found.append(clash(info, self._messages.qos_profile, self.source))
        for info in self._subscribers():
            if text := clash(info, self._publisher.qos_profile, self.target):
                found.append(f"{text}; see --reliable")
        own = self.node.get_fully_qualified_name()
        for info in self._publishers(self.target):
            if name_of(info) != own:
                found.append(f"node {name_of(info)} publishes {self.target}, too, beside the link")
        return [text for text in found if text]

    def _other_types(self) -> list[str]:
        """Name the nodes that use the topics with another type."""
        return [
            f"node {name_of(info)} {verb} {topic} as {info.topic_type}"
            for verb, topic, infos in (
                ("publishes", self.source, self._publishers(self.source)),
                ("publishes", self.target, self._publishers(self.target)),
                ("subscribes to", self.target, self._subscribers()),
            )
            for info in infos
            if info.topic_type != self.kind
        ]

    def _publishers(self, topic: str) -> list[Any]:
        return known(self.node.get_publishers_info_by_topic(topic))

    def _subscribers(self) -> list[Any]:
        return known(self.node.get_subscriptions_info_by_topic(self.target))

    def wait(self, until_ns: int) -> bool:
        """Wait until messages have come, or until a time [ns]; True, as nobody knows which."""
        self._waiting.clear_entities()
        self._waiting.add_subscription(self._messages.handle)
        self._waiting.wait(max(0, until_ns - time.monotonic_ns()))
        return True

    def take(self) -> Iterator[Packet]:
        """Read up to `BATCH` messages."""
        way, handle = self._way, self._messages.handle
        for _ in range(BATCH):
            with handle:
                taken = handle.take_message(self._type, True)
            if taken is None:
                return
            if packet := self._carried.take(taken[0], time.monotonic_ns()):
                yield packet
        way.waited += BATCH

    def publish(self, data: bytes) -> bool:
        """Publish a message."""
        self._publisher.publish(data)
        return True


def _qos(*, reliable: bool, kept: bool) -> QoSProfile:
    reliability = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
    durability = DurabilityPolicy.TRANSIENT_LOCAL if kept else DurabilityPolicy.VOLATILE
    return QoSProfile(depth=DEPTH, reliability=reliability, durability=durability)
