# SPDX-License-Identifier: Apache-2.0

"""Relay the messages of a topic of ROS 2 over the emulated link, until a signal."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cloudrc.config.profile import DIRECTIONS
from cloudrc.doors.bridges.ros2 import require_ros
from cloudrc.flight.interrupts import until_interrupted
from cloudrc.flight.links.carrier import STEP, CarrySettings, LiveLink
from cloudrc.flight.links.programs_report import make_link_report, write_report
from cloudrc.flight.links.verify import Report
from cloudrc.link.carry.engine import Engine
from cloudrc.link.carry.punctual import ask_for_fifo, settle
from cloudrc.link.carry.tcp.medium import Medium
from cloudrc.link.model import HEADER_BYTES

if TYPE_CHECKING:
    from cloudrc.doors.bridges.ros2.relay import TopicRelay

LOOK_PERIOD = 2.0  # time between two looks at the nodes of others, which take 1 ms [s]


@dataclass(frozen=True)
class TopicSettings(CarrySettings):
    """What to relay; a field is the flag of this name."""

    source: str  # topic, the flag --from
    to: str  # topic
    reliable: bool  # publish RELIABLE
    direction: str  # "uplink" or "downlink"
    stream: str  # name of the link
    out: Path | None  # folder for the report and the recording


def relay_topic(settings: TopicSettings, tell: Callable[[str], None]) -> Report:
    """Relay messages until KeyboardInterrupt; return the verdict on the link.

    Raises:
        CloudrcError: If the profile or a topic cannot be used, or ROS 2 and the type are missing.
    """
    require_ros("link relay ros", "relay", "rclpy")
    from cloudrc.doors.bridges.ros2.relay import TopicRelay

    way = settings.direction

    with contextlib.ExitStack() as stack:
        relay = TopicRelay(settings.source, settings.to)
        stack.callback(relay.close)
        link = LiveLink(
            settings,
            "link relay ros",
            tell,
            stack,
            output=settings.out,
            flag="--out",
            stream=settings.stream,
        )
        relay.wait_for_publisher(tell)
        link.carry({way: relay.publish})
        there, back = _media(link, settings)
        engine, carried, quality = relay.open(
            link.ways[way], (there, back), reliable=settings.reliable
        )
        other = "downlink" if way == "uplink" else "uplink"
        link.serve(engine, {way: carried, other: back})
        settle()
        ask_for_fifo()
        tell(
            f"{relay.source} ({relay.kind}) leads to {relay.target}; link: {link.cause}, "
            f"{way}, seed {settings.seed}; QoS {quality}"
        )
        with until_interrupted():
            _run(engine, relay, tell)
        report = {
            **make_link_report(link),
            "from": relay.source,
            "to": relay.target,
            "type": relay.kind,
        }
        if settings.out:
            write_report(settings.out, report, link)
        return report


def _media(link: LiveLink, settings: TopicSettings) -> list[Medium]:
    """Return what repairs the losses of messages: the relayed direction, and the other one."""
    both = sorted(DIRECTIONS, key=lambda way: way != settings.direction)
    more: Any = {"stream": settings.stream, "headers": HEADER_BYTES}
    return [
        Medium(link.profile(way), settings.seed, way == "uplink", link.origins_ns[way], **more)
        for way in both
    ]


def _run(engine: Engine, relay: TopicRelay, tell: Callable[[str], None]) -> None:
    """Carry messages for ever; say what does not take part."""
    told, looked = set[str](), time.monotonic()
    while True:
        engine.step(STEP)
        if time.monotonic() - looked > LOOK_PERIOD:
            looked = time.monotonic()
            for text in relay.problems():
                if text not in told:
                    told.add(text)
                    tell(f"note: {text}")
