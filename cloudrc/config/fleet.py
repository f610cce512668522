# SPDX-License-Identifier: Apache-2.0

"""Define the keys of a fleet, and of the cell and the traffic that its robots share."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from cloudrc.config.section import Section
from cloudrc.link.profile import NotNegative, Positive


class FleetConfig(Section):
    """Robots that fly at the same time, each in a world of its own."""

    robots: Annotated[int, Field(ge=1, le=1000)] = 1
    """Number of robots. Each has random numbers of its own; those of robot 0 are those of a flight
    without a fleet"""
    vary: tuple[dict[str, Any], ...] = ()
    """Settings of single robots: a list of mappings from dotted keys to values. Robot k has those
    of entry k; after the last entry the list begins again. Or a CSV file with a column per key"""
    only: Annotated[int, Field(ge=0)] | None = None
    """Number of the only robot to fly, as it flies in the fleet; null: all"""
    phase: Literal["random", "equal"] = "random"
    """When the robots' periods begin. random: at random times, made from the seed; equal: at once,
    so that robot k always waits for the packets of robots 0 to k - 1"""

    @model_validator(mode="after")
    def _check_only(self) -> FleetConfig:
        if self.only is not None and self.only >= self.robots:
            raise ValueError(f"only: {self.only}: the robots are 0 to {self.robots - 1}")
        return self


class TrafficConfig(Section):
    """Traffic of others in the cell."""

    kind: Literal["video", "bulk"]
    """video: 30 frames a second, each in packets of 1,228 bytes; bulk: a flow that sends more until
    a packet is dropped and then half as much. It is no TCP: nothing is sent again"""
    rate_kbit: Positive = 4000.0
    """Mean rate of a video [kbit/s]"""
    direction: Literal["uplink", "downlink"] = "uplink"
    """Way that the traffic takes"""


class CellConfig(Section):
    """The radio cell that all robots of a fleet share.

    A packet is lost on its robot's link or else waits in the cell; then follow the link's delays.
    """

    rate_kbit: Positive | None = None
    """Rate of each direction [kbit/s]; each packet counts with 28 bytes of headers; null: no cell
    """
    airtime_us: NotNegative = 0.0
    """Time that each packet takes besides that of its bits [us], as in WiFi"""
    shared: bool = False
    """Whether both directions share one medium, as in WiFi"""
    queue: Literal["fifo", "drr", "priority", "newest"] = "fifo"
    """Which packet leaves next. fifo: the oldest; drr: those of all robots in turn (deficit round
    robin); priority: those of robots before other traffic and before pictures of cameras; newest:
    as fifo, but a packet replaces the waiting one of the same robot and kind, so that no command
    waits behind an older one; fragments of pictures replace nothing"""
    queue_packets: Annotated[int, Field(ge=1)] = 50
    """Largest number of packets in a queue; further packets are dropped. A queue holds the packets
    of all, with drr those of a robot, with priority those of all robots, or of other traffic and
    pictures"""
    traffic: tuple[TrafficConfig, ...] = ()
    """Traffic of others"""
