"""What the figures are drawn from: the flight and what was asked for."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cloudrc.config.schema import Direction
from cloudrc.messages import Vector
from cloudrc.metrics import Flight


@dataclass(frozen=True)
class Subject:
    """A flight, and what was asked for.

    Attributes:
        flight: As recorded.
        uplink: Conditions of the link from world to cloud.
        downlink: Likewise from cloud to world.
    """

    flight: Flight
    uplink: Direction
    downlink: Direction

    @cached_property
    def waypoints(self) -> dict[int, Vector]:
        """Those that were flown to [m], by index: the setpoint as it was when each was new."""
        control = self.flight.control
        indices, rows = np.unique(control["waypoint"], return_index=True)
        points = control["setpoint"][rows].tolist()
        return {
            int(index): (x, y, z)
            for index, (x, y, z) in zip(indices, points, strict=True)
            if index >= 0
        }

    @cached_property
    def duration(self) -> float:
        """From the start to the end of the flight [s]."""
        end_ns = self.flight.end_ns
        return 0.0 if end_ns is None else float(self.flight.seconds(end_ns))

    @cached_property
    def link_start(self) -> float:
        """When the link came up, since the start of the mission [s]: with the first datagram."""
        stamps = self.flight.recording["/telemetry"]["stamp_ns"]
        return float(self.flight.seconds(stamps[0])) if len(stamps) else 0.0
